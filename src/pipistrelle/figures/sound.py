"""Figures of a microphone array and of the echoes in a recording."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from pipistrelle.arrays.beamforming import Pattern, beam_power, spread_towards
from pipistrelle.arrays.layout import Microphones, Scattered
from pipistrelle.detection.sounds.check import Overview
from pipistrelle.figures.chart import PLAIN
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE, TRUTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR_DB = -30.0
"""Least level in a beam pattern [dB]."""
MOST_NUMBERS = 64
"""Most microphones that are labelled with their channels."""
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
    """Draw an array's microphones, two beam patterns, and the accuracy of its bearings.

    `patterns`: of each group; `frequency` [Hz]; `speed_of_sound` [m/s]. Two beams of the largest
    group are drawn: along its normal or ahead, and the beam with the highest side lobe.
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
    """Draw the microphones of an array from above [mm], with channels and face normals."""
    x, y = 1e3 * layout.position.T
    for g, name in enumerate(layout.name):
        members, colour = layout.group == g, _COLOURS[g % len(_COLOURS)]
        axes.plot(y[members], x[members], "o", ms=4, color=colour, label=name or "free")
        if not math.isnan(normal := layout.normal[g]):
            size = 0.15 * max(np.ptp(x), np.ptp(y))
            start = y[members].mean(), x[members].mean()
            tip = start[0] + size * math.sin(normal), start[1] + size * math.cos(normal)
            axes.annotate("", tip, start, arrowprops={"arrowstyle": "->", "color": colour})
    if len(x) <= MOST_NUMBERS:
        style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6.5}
        for number, across, along in zip(microphones.channel, y, x, strict=True):
            axes.annotate(str(number), (across, along), (3, 3), **style)
    axes.plot([0.0], [0.0], "+", color=TRUTH, ms=9, label="vehicle")
    axes.set(xlabel="y, to the left [mm]", ylabel="x, ahead [mm]", aspect="equal")
    axes.margins(0.2)
    axes.invert_xaxis()
    axes.grid(True)


def _turned(axes: "Axes") -> None:
    """Turn a polar panel so that the vehicle's heading points up."""
    axes.set_theta_zero_location("N")  # pyrefly: ignore[missing-attribute]
    axes.grid(True)
    axes.tick_params(labelsize=7)


def _draw_beams(
    axes: "Axes", layout: Scattered, patterns: tuple[Pattern, ...], wave: dict[str, float]
) -> None:
    """Draw two beam patterns of an array: along its normal, and with the highest side lobe."""
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
    """Draw the Cramer-Rao bound of a bearing's standard deviation over the bearing, per group."""
    turn = 2.0 * np.pi * wave["frequency"] / wave["speed_of_sound"]
    for g, normal in enumerate(layout.normal):
        around, members = np.linspace(-np.pi, np.pi, 721), layout.group == g
        if not math.isnan(normal):
            around = normal + np.radians(np.linspace(-75.0, 75.0, 301))
        weight = layout.amplitude[members] / np.linalg.norm(layout.amplitude[members])
        spread = np.maximum(spread_towards(around, layout.position[members], weight), 1e-12)
        power = 100.0 * np.sum(layout.amplitude[members] ** 2)  # 20 dB at each microphone
        std = np.degrees((2.0 * power * spread) ** -0.5 / turn)
        top = 4.0 * float(np.median(std))
        axes.plot(around, np.minimum(std, top), color=_COLOURS[g % len(_COLOURS)], lw=1.1)
    axes.set_ylim(0.0)
    _turned(axes)
    axes.set_title("least deviation of a bearing [deg], at 20 dB", fontsize=9)


def draw_hearing(overview: Overview) -> "Figure":
    """Draw the detected echoes of a recording: matched-filter output and bearings per emitter.

    >>> draw_hearing(Overview(names=("vehicle",))).get_axes()[0].get_title()
    'vehicle: matched filter'
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    rows = len(overview.names)
    with rc_context(STYLE):
        figure = Figure(figsize=(10.0, 0.6 + 3.0 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, squeeze=False, width_ratios=(3, 2))
        end = _end(overview)
        for number, name in enumerate(overview.names):
            _output(axes[number, 0], overview, number)
            _bearings(axes[number, 1], overview, number)
            axes[number, 0].set_title(f"{name}: matched filter")
            axes[number, 1].set_title(f"{name}: taken for echoes")
            if end > 0.0:
                axes[number, 0].set_xlim(0.0, end)
                axes[number, 1].set_xlim(0.0, end)
    return figure


def _end(overview: Overview) -> float:
    """Return the end [ms] of the delay axis: past 98 % of the echoes, weighted by level.

    Weighting keeps the faint detections of noise, at any delay, from extending the axis.
    """
    delay = np.concatenate([np.empty(0), *(found.delay for found in overview.detections)])
    if not delay.size:
        return 0.0
    power = np.concatenate([found.power for found in overview.detections])
    order, level = np.argsort(delay), np.log(np.maximum(power, 1.0))
    heard = np.cumsum(level[order])
    last = delay[order][np.searchsorted(heard, 0.98 * heard[-1])]
    return 1e3 * float(min(1.1 * last, max(found[-1] for found in overview.delay if found.size)))


def _output(axes: "Axes", overview: Overview, number: int) -> None:
    """Draw an emitter's matched-filter output as an image, a row per call, and its detections."""
    axes.set(xlabel="delay after the vehicle's call [ms]", ylabel="time of the call [s]")
    if not overview.time:
        return
    end = max(delay[-1] for delay in overview.delay if delay.size)
    grid = np.linspace(0.0, end, 400)
    levels = zip(overview.delay, overview.level_db, strict=True)
    beyond = {"left": np.nan, "right": np.nan}
    image = [np.interp(grid, delay, level[:, number], **beyond) for delay, level in levels]
    rows = np.array(overview.time)
    step = float(np.median(np.diff(rows))) if rows.size > 1 else 1.0
    shaded = axes.imshow(
        image,
        aspect="auto",
        origin="lower",
        extent=(0.0, 1e3 * end, rows[0] - 0.5 * step, rows[-1] + 0.5 * step),
        cmap="Greys",
        vmin=0.0,
        vmax=50.0,
        interpolation="nearest",
    )
    axes.figure.colorbar(shaded, ax=axes, label="over the noise [dB]", pad=0.01)
    for time, found in zip(overview.time, overview.detections, strict=True):
        own = found.caller == number
        times = np.full(own.sum(), time)
        axes.plot(1e3 * found.delay[own], times, ".", ms=2.5, color=_colour(number))
    axes.plot(1e3 * overview.direct(number), rows, "|", ms=5, color=INK, alpha=0.7)


def _bearings(axes: "Axes", overview: Overview, number: int) -> None:
    """Draw the bearings of an emitter's detections over delay, fainter detections smaller."""
    for found in overview.detections:
        own = found.caller == number
        size = 2.0 + 10.0 * np.log10(np.maximum(found.power[own], 1.0)) / 4.0
        place = 1e3 * found.delay[own], np.degrees(found.bearing[own])
        axes.scatter(*place, s=size, color=_colour(number), alpha=0.4, linewidths=0)
    axes.set(xlabel="delay after the vehicle's call [ms]", ylabel="bearing [deg]")
    axes.set(ylim=(-180, 180), yticks=(-180, -90, 0, 90, 180))


def _colour(number: int) -> str:
    """Return the colour of echoes of the vehicle's calls (number 0) or of a caller's calls."""
    return STRATEGY_COLOURS["passive" if number else "active"]
