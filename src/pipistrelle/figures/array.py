"""A microphone array: where its microphones are, what its beams hear, how sure its bearings are."""

import math
from typing import TYPE_CHECKING

import numpy as np

from pipistrelle.arrays.array_file import Microphones
from pipistrelle.arrays.beamforming import Pattern, beam_power, spread_towards
from pipistrelle.arrays.layout import Scattered
from pipistrelle.figures.chart_plot import PLAIN
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE, TRUTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR_DB = -30.0
"""Faintest answer that a pattern shows [dB]."""
MOST_NUMBERS = 64
"""Microphones up to which each bears its channel's number."""
SNR = 100.0
"""Power ratio at each microphone for which deviations are drawn: 20 dB."""
_COLOURS = (*STRATEGY_COLOURS.values(), INK)


def draw_array(
    microphones: Microphones,
    layout: Scattered,
    patterns: tuple[Pattern, ...],
    *,
    name: str,
    frequency: float,
    speed_of_sound: float,
) -> "Figure":
    """Draw an array in three panels, the vehicle's heading up.

    `patterns`: of each group; `frequency` [Hz]; `speed_of_sound` [m/s]. The beams are those of the
    largest group: towards its normal or ahead, and the one with the highest other lobe.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE | PLAIN):
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        places = figure.add_subplot(1, 3, 1)
        _draw_places(places, microphones, layout)
        places.set_title(f"{name} at {frequency / 1e3:g} kHz", fontsize=9)
        figure.legend(loc="outside lower left", ncols=6)
        wave = {"frequency": frequency, "speed_of_sound": speed_of_sound}
        beams = figure.add_subplot(1, 3, 2, projection="polar")
        _draw_beams(beams, layout, patterns, wave)
        figure.legend(handles=beams.lines, loc="outside lower center", ncols=2)
        _draw_stds(figure.add_subplot(1, 3, 3, projection="polar"), layout, wave)
    return figure


def _draw_places(axes: "Axes", microphones: Microphones, layout: Scattered) -> None:
    """Draw the microphones as seen from above, in millimetres."""
    x, y = 1e3 * layout.position.T
    for g, name in enumerate(layout.name):
        members, colour = layout.group == g, _COLOURS[g % len(_COLOURS)]
        axes.plot(y[members], x[members], "o", ms=4, color=colour, label=name or "free")
        if not math.isnan(normal := layout.normal[g]):
            size = 0.15 * max(np.ptp(x), np.ptp(y))
            start = y[members].mean(), x[members].mean()
            ahead = size * math.sin(normal), size * math.cos(normal)
            axes.annotate(
                "",
                (start[0] + ahead[0], start[1] + ahead[1]),
                start,
                arrowprops={"arrowstyle": "->", "color": colour},
            )
    if len(x) <= MOST_NUMBERS:
        for number, across, along in zip(microphones.channel, y, x, strict=True):
            axes.annotate(
                str(number), (across, along), (3, 3), textcoords="offset points", fontsize=6.5
            )
    axes.plot([0.0], [0.0], "+", color=TRUTH, ms=9, label="vehicle")
    axes.set(xlabel="y, to the left [mm]", ylabel="x, ahead [mm]", aspect="equal")
    axes.margins(0.2)
    axes.invert_xaxis()
    axes.grid(True)


def _turned(axes: "Axes") -> None:
    """Turn a polar panel as the vehicle looks: ahead is up, the left is left."""
    axes.set_theta_zero_location("N")  # pyrefly: ignore[missing-attribute]
    axes.grid(True)
    axes.tick_params(labelsize=7)


def _draw_beams(
    axes: "Axes", layout: Scattered, patterns: tuple[Pattern, ...], wave: dict[str, float]
) -> None:
    """Draw two beams of the largest group: a plain one and the worst."""
    g = int(np.argmax([pattern.microphones for pattern in patterns]))
    around = np.linspace(-np.pi, np.pi, 3601)
    normal, (worst, _) = layout.normal[g], patterns[g].worst
    if not math.isnan(normal):
        around = normal + np.linspace(-0.5 * np.pi, 0.5 * np.pi, 1801)
    plain = 0.0 if math.isnan(normal) else normal
    for steered, colour in ((worst, _COLOURS[1]), (plain, _COLOURS[0])):
        power = beam_power(layout, g, steered, around, **wave)
        level = np.maximum(10.0 * np.log10(np.maximum(power, 1e-12)), FLOOR_DB)
        toward = round(math.degrees(steered)) % 360
        axes.plot(around, level, color=colour, lw=1.1, label=f"beam to {toward}°")
    axes.set_ylim(FLOOR_DB, 0.0)
    axes.set_yticks([-20.0, -10.0, 0.0], ["−20", "−10", "0 dB"])
    _turned(axes)
    of = f" ({layout.name[g]})" if len(layout.name) > 1 else ""
    axes.set_title(f"beams{of}", fontsize=9)


def _draw_stds(axes: "Axes", layout: Scattered, wave: dict[str, float]) -> None:
    """Draw the Cramer-Rao bound of a bearing by bearing, for each group."""
    turn = 2.0 * np.pi * wave["frequency"] / wave["speed_of_sound"]
    for g, normal in enumerate(layout.normal):
        around, members = np.linspace(-np.pi, np.pi, 721), layout.group == g
        if not math.isnan(normal):
            around = normal + np.radians(np.linspace(-75.0, 75.0, 301))
        weight = layout.amplitude[members] / np.linalg.norm(layout.amplitude[members])
        spread = np.maximum(spread_towards(around, layout.position[members], weight), 1e-12)
        power = SNR * np.sum(layout.amplitude[members] ** 2)
        std = np.degrees((2.0 * power * spread) ** -0.5 / turn)
        top = 4.0 * float(np.median(std))
        axes.plot(around, np.minimum(std, top), color=_COLOURS[g % len(_COLOURS)], lw=1.1)
    axes.set_ylim(0.0)
    _turned(axes)
    axes.set_title("least deviation of a bearing [deg], at 20 dB", fontsize=9)
