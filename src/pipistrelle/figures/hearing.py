"""What was heard in a recording: the matched filter's output, and what was taken for an echo."""

from typing import TYPE_CHECKING

import numpy as np

from pipistrelle.detection.sounds.check import Overview
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NEARLY_ALL, SILENCE = 0.98, 1.1
"""Share of the echoes' levels that the axis shows, and how much longer it is."""
_QUIETEST, _LOUDEST = 0.0, 50.0
"""Levels [dB] between which the output is shaded."""


def draw_hearing(overview: Overview) -> "Figure":
    """Draw a row for each who calls: output over call and delay, bearing against delay.

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
    """Return the delay up to which nearly all was heard [ms], each echo by its level.

    What noise makes is faint and comes at any delay: few such rows do not stretch the axis.
    """
    delay = np.concatenate([np.empty(0), *(found.delay for found in overview.detections)])
    if not delay.size:
        return 0.0
    power = np.concatenate([found.power for found in overview.detections])
    order, level = np.argsort(delay), np.log(np.maximum(power, 1.0))
    heard = np.cumsum(level[order])
    last = delay[order][np.searchsorted(heard, NEARLY_ALL * heard[-1])]
    return 1e3 * float(
        min(SILENCE * last, max(found[-1] for found in overview.delay if found.size))
    )


def _output(axes: "Axes", overview: Overview, number: int) -> None:
    """Shade the output of one matched filter, a row for each call, and dot the detections."""
    axes.set(xlabel="delay after the vehicle's call [ms]", ylabel="time of the call [s]")
    if not overview.time:
        return
    end = max(delay[-1] for delay in overview.delay if delay.size)
    grid = np.linspace(0.0, end, 400)
    image = np.array(
        [
            np.interp(grid, delay, level[:, number], left=np.nan, right=np.nan)
            for delay, level in zip(overview.delay, overview.level_db, strict=True)
        ]
    )
    rows = np.array(overview.time)
    step = float(np.median(np.diff(rows))) if rows.size > 1 else 1.0
    shaded = axes.imshow(
        image,
        aspect="auto",
        origin="lower",
        extent=(0.0, 1e3 * end, rows[0] - 0.5 * step, rows[-1] + 0.5 * step),
        cmap="Greys",
        vmin=_QUIETEST,
        vmax=_LOUDEST,
        interpolation="nearest",
    )
    axes.figure.colorbar(shaded, ax=axes, label="over the noise [dB]", pad=0.01)
    for time, found in zip(overview.time, overview.detections, strict=True):
        own = found.caller == number
        axes.plot(
            1e3 * found.delay[own], np.full(own.sum(), time), ".", ms=2.5, color=_colour(number)
        )
    axes.plot(1e3 * overview.direct(number), rows, "|", ms=5, color=INK, alpha=0.7)


def _bearings(axes: "Axes", overview: Overview, number: int) -> None:
    """Dot bearings against delays, fainter echoes smaller."""
    for found in overview.detections:
        own = found.caller == number
        size = 2.0 + 10.0 * np.log10(np.maximum(found.power[own], 1.0)) / 4.0
        place = 1e3 * found.delay[own], np.degrees(found.bearing[own])
        axes.scatter(*place, s=size, color=_colour(number), alpha=0.4, linewidths=0)
    axes.set(xlabel="delay after the vehicle's call [ms]", ylabel="bearing [deg]")
    axes.set(ylim=(-180, 180), yticks=(-180, -90, 0, 90, 180))


def _colour(number: int) -> str:
    """Return the colour of the vehicle's own echoes, or of others'."""
    return STRATEGY_COLOURS["passive" if number else "active"]
