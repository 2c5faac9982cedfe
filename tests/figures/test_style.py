import itertools

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from pipistrelle.config import STRATEGIES
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, save_figure, strategy_colour


def lightness(colour: str) -> float:
    channel = np.array(to_rgb(colour))
    linear = np.where(channel <= 0.04045, channel / 12.92, ((channel + 0.055) / 1.055) ** 2.4)
    return 116.0 * float(linear @ [0.2126, 0.7152, 0.0722]) ** (1.0 / 3.0) - 16.0


def test_every_strategy_has_a_colour_and_a_stranger_is_drawn_in_ink():
    assert set(STRATEGY_COLOURS) == set(STRATEGIES)
    assert strategy_colour("someone's own") == INK


def test_strategies_differ_in_lightness():
    steps = [
        abs(lightness(a) - lightness(b))
        for a, b in itertools.combinations(STRATEGY_COLOURS.values(), 2)
    ]
    assert min(steps) > 15.0, "a just noticeable difference is about 1"


def test_saving_twice_gives_the_same_bytes(tmp_path):
    figure = Figure()
    figure.add_subplot().plot([1.0, 2.0])
    first = [path.read_bytes() for path in save_figure(figure, tmp_path / "a", "it")]
    second = [path.read_bytes() for path in save_figure(figure, tmp_path / "b", "it")]
    assert first == second
    assert [data[:4] for data in first] == [b"\x89PNG", b"%PDF"]
