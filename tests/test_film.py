"""The film in the README: a short and small copy of the long film."""

import numpy as np
import pytest
from docs.film import EVERY, HELD, PLACE, SHOWN, WIDTH, palette, shrink
from PIL import Image

from pipistrelle.figures.film import write_gif
from pipistrelle.figures.style import STRATEGY_COLOURS


def picture(k: int) -> np.ndarray:
    """Return a white picture with a moving square of a strategy's colour."""
    drawn = np.full((200, 2 * WIDTH, 3), 255, np.uint8)
    drawn[40:120, 100 * k : 100 * k + 80] = (0x1F, 0x4E, 0x96)
    return drawn


def test_a_short_film_keeps_some_pictures_and_the_last(tmp_path):
    write_gif([picture(k) for k in range(6)], tmp_path / "long.gif")
    shrink(tmp_path / "long.gif", tmp_path / "short.gif")
    with Image.open(tmp_path / "short.gif") as film:
        assert (film.size, film.n_frames) == ((WIDTH, 100), 6 // EVERY)
        for number, k in enumerate((1, 3, 5)):
            film.seek(number)
            assert film.info["duration"] == (HELD if k == 5 else SHOWN)
            seen = np.asarray(film.convert("RGB")).astype(int)
            assert seen[40, 50 * k + 20] == pytest.approx([0x1F, 0x4E, 0x96], abs=16)
            gone = np.delete(seen, slice(50 * k - 5, 50 * k + 45), axis=1)
            assert (gone == 255).all(), "the previous picture remains"


def test_the_palette_contains_the_colours_of_the_strategies():
    colours = {"#{:02x}{:02x}{:02x}".format(*colour) for colour in palette()}
    assert {"#ffffff", *STRATEGY_COLOURS.values()} <= colours
    assert len(colours) < 64


def test_the_film_is_light_enough_for_a_readme():
    assert PLACE.stat().st_size < 2_000_000
    with Image.open(PLACE) as film:
        assert film.n_frames > 50
