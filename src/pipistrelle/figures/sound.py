"""Figures of microphone arrays, of recordings and their echoes, and of logs not yet solved."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Shaped

from pipistrelle.arrays.beamforming import Pattern, beam_power, spread_towards
from pipistrelle.arrays.layout import Microphones, Scattered
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import OWN, UNLABELLED
from pipistrelle.detection.sounds.check import Overview
from pipistrelle.experiments.drives import Truth
from pipistrelle.figures.chart import PLAIN
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE, TRUTH, picture

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


def _turned(axes: "Axes") -> None:
    """Turn a polar panel so that the vehicle's heading points up."""
    axes.set_theta_zero_location("N")  # pyrefly: ignore[missing-attribute]
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
    axes.set_title("least standard deviation of a bearing [°], at 20 dB", fontsize=9)


def draw_hearing(overview: Overview) -> "Figure":
    """Draw the detected echoes of a recording: matched-filter output and bearings per emitter.

    >>> draw_hearing(Overview(names=("vehicle",))).get_axes()[0].get_title()
    'vehicle: output of the matched filter'
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    rows = len(overview.names)
    with rc_context(STYLE | {"axes.grid": False}):
        figure = Figure(figsize=(10.0, 0.6 + 3.0 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, squeeze=False, width_ratios=(3, 2))
        for number, name in enumerate(overview.names):
            _output(axes[number, 0], overview, number)
            _bearings(axes[number, 1], overview, number)
            axes[number, 0].set_title(f"{name}: output of the matched filter")
            axes[number, 1].set_title(f"{name}: detected echoes")
            for panel in axes[number]:
                panel.set_xlim(0.0, _end(overview) or None)
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
    extent = (0.0, 1e3 * end, rows[0] - 0.5 * step, rows[-1] + 0.5 * step)
    style = {"cmap": "Greys", "vmin": 0.0, "vmax": 50.0, "interpolation": "nearest"}
    shaded = axes.imshow(image, aspect="auto", origin="lower", extent=extent, **style)
    axes.figure.colorbar(shaded, ax=axes, label="level over the noise [dB]", pad=0.01)
    for time, found in zip(overview.time, overview.detections, strict=True):
        own = found.caller == number
        times = np.full(own.sum(), time)
        axes.plot(1e3 * found.delay[own], times, ".", ms=2.5, color=_colour(number))
    axes.plot(1e3 * overview.direct(number), rows, "|", ms=6, color=STRATEGY_COLOURS["fused"])


def _bearings(axes: "Axes", overview: Overview, number: int) -> None:
    """Draw the bearings of an emitter's detections over delay, fainter detections smaller."""
    for found in overview.detections:
        own = found.caller == number
        size = 2.0 + 10.0 * np.log10(np.maximum(found.power[own], 1.0)) / 4.0
        place = 1e3 * found.delay[own], np.degrees(found.bearing[own])
        axes.scatter(*place, s=size, color=_colour(number), alpha=0.4, linewidths=0)
    axes.set(xlabel="delay after the vehicle's call [ms]", ylabel="bearing [°]")
    axes.set(ylim=(-180, 180), yticks=(-180, -90, 0, 90, 180))


def _colour(number: int) -> str:
    """Return the colour of echoes of the vehicle's calls (number 0) or of a caller's calls."""
    return STRATEGY_COLOURS["passive" if number else "active"]


PANELS = {
    "bearing": "bearing [°]",
    "range": "range [m]",
    "excess_path": "excess path [m]",
    "level_db": "level [dB]",
}
"""Label of the axis of each measured quantity."""
Rows = Mapping[str, Shaped[np.ndarray, " n"]]
"""Columns of all scans of a log, by their names in a scan, and ``time`` [s]."""


def draw_log(
    log: Log,
    truth: Truth,
    path: Float[np.ndarray, "t 3"],
    rows: Rows,
    gaps: Float[np.ndarray, "g 2"],
) -> "Figure":
    """Draw a log before it is solved: its dead-reckoned path, and its rows over time.

    `path`: by odometry only [m, m, rad]. `gaps`: begin and end of intervals to shade [s].
    """
    from matplotlib import rc_context

    shown = [name for name in PANELS if not np.isnan(rows[name]).all()]
    names, line = _lines_of(log, rows)
    heights = (0.7 + 0.1 * len(names), *[1.5] * len(shown))  # inch
    rows = {**rows, "time": rows["time"] - log.time[0]}
    with rc_context(STYLE):
        figure = picture(12.0, 1.5 + max(sum(heights), 3.5))
        figure.set_layout_engine("constrained")
        grid = figure.add_gridspec(len(heights), 2, width_ratios=(1.0, 1.3), height_ratios=heights)
        _draw_path(figure.add_subplot(grid[:, 0]), log, truth, path)
        figure.legend(loc="outside lower left", ncols=6)
        top = figure.add_subplot(grid[0, 1])
        _scatter(top, rows, line)
        top.set(yticks=range(len(names)), yticklabels=names, ylim=(-0.7, len(names) - 0.3))
        top.tick_params(axis="y", labelsize=6.0)
        panels = [figure.add_subplot(grid[1 + k, 1], sharex=top) for k in range(len(shown))]
        for axes, name in zip(panels, shown, strict=True):
            _scatter(axes, rows, np.degrees(rows[name]) if name == "bearing" else rows[name])
            axes.set_ylabel(PANELS[name])
        for axes in (top, *panels):
            axes.tick_params(labelbottom=axes is (top, *panels)[-1])
            for begin, end in gaps - log.time[0]:
                axes.axvspan(begin, end, color=TRUTH, alpha=0.25, lw=0)
        since = f"time after {log.time[0]:.15g} s [s]" if log.time[0] else "time [s]"
        (top, *panels)[-1].set(xlabel=since, xlim=(0.0, log.time[-1] - log.time[0]))
        others = ": blue by the vehicle's call, yellow by others" * bool(rows["caller"].any())
        top.set_title(f"rows{others}{'; grey: no scans' * bool(len(gaps))}")
    return figure


def _draw_path(axes: "Axes", log: Log, truth: Truth, path: Float[np.ndarray, "t 3"]) -> None:
    """Draw the dead-reckoned path with its ends, the truth, and known positions."""
    if truth.path is not None:
        axes.plot(*truth.path[:, :2].T, color=TRUTH, lw=2.5, label="truth")
    if truth.landmarks is not None:
        style = {"ms": 5.0, "mfc": "none", "mec": TRUTH, "ls": ""}
        axes.plot(*truth.landmarks[1].T, marker="o", label="true landmarks", **style)
    known = [*log.landmarks.values(), *(one.place for one in log.callers if one.place)]
    if known:
        axes.plot(*np.transpose(known), "*", ms=10, color=INK, label="known positions")
    axes.plot(*path[:, :2].T, color=STRATEGY_COLOURS["active"], lw=1.0, label="odometry")
    axes.plot(*path[0, :2], "o", ms=6, color=INK, label="start")
    axes.plot(*path[-1, :2], "s", ms=6, color=INK, label="end")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", adjustable="datalim")
    axes.set_title(f"{log.name}: trajectory by odometry")


def _lines_of(log: Log, rows: Rows, most: int = 30) -> tuple[list[str], Float[np.ndarray, " n"]]:
    """Return the names of the most frequent landmarks or callers, and the line of each row."""
    callers = ["vehicle", *(caller.name for caller in log.callers)]
    labelled = bool((rows["landmark"] != UNLABELLED).any())
    kinds = rows["landmark" if labelled else "caller"]
    found, count = np.unique(kinds[kinds != UNLABELLED], return_counts=True)
    kept = np.sort(found[np.argsort(-count, kind="stable")[:most]])
    line = np.searchsorted(kept, kinds).astype(float)
    line[~np.isin(kinds, kept)] = np.nan
    return [str(one) if labelled else callers[one] for one in kept.tolist()], line


def _scatter(axes: "Axes", rows: Rows, values: Float[np.ndarray, " n"]) -> None:
    """Plot the values of rows over time, by the vehicle's call and by other calls."""
    own = rows["caller"] == OWN
    for chosen, strategy in ((own, "active"), (~own, "passive")):
        style = {"ms": 3.0 if values.size < 5000 else 1.5, "rasterized": values.size >= 5000}
        axes.plot(rows["time"][chosen], values[chosen], ".", mew=0.0,
                  color=STRATEGY_COLOURS[strategy], **style)  # fmt: skip


def draw_recording(
    samples: Float[np.ndarray, " t"],
    *,
    rate: float,
    calls: Float[np.ndarray, " k"],
    duration: float,
    bands: Mapping[str, tuple[float, float]],
) -> "Figure":
    """Draw the spectrogram of the first calls in a sound recording.

    `samples` of a channel at `rate` [Hz]; `calls`: times of the vehicle's calls in them [s];
    `duration`: of a call [s]; `bands`: of each caller [Hz].
    """
    from matplotlib import rc_context

    size = max(round(0.5 * duration * rate), 16)
    with rc_context(STYLE | {"axes.grid": False}):
        figure = picture(12.0, 5.0)
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        with np.errstate(divide="ignore"):
            power, *_, image = axes.specgram(samples, NFFT=size, Fs=rate / 1e3, cmap="Greys")
            level = float(10.0 * np.log10(np.median(power)))
        image.set_clim(level, level + 50.0)
        figure.colorbar(image, ax=axes, label="level [dB]", pad=0.01)
        for number, (name, band) in enumerate(bands.items()):
            colour = STRATEGY_COLOURS["passive" if number else "active"]
            for edge, label in zip(band, (name, None), strict=True):
                axes.axhline(edge / 1e3, color=colour, lw=0.8, ls="--", label=label)
        axes.plot(1e3 * calls, np.zeros(calls.size), "^", ms=7, clip_on=False, color=INK,
                  label="calls of the vehicle")  # fmt: skip
        axes.legend(loc="upper right")
        axes.set(xlabel="time after the first call [ms]", ylabel="frequency [kHz]")
    return figure
