"""Figures of a log and of a sound recording before it is solved: `draw_log`, `draw_recording`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Shaped

from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import OWN, UNLABELLED
from pipistrelle.experiments.drives import Truth
from pipistrelle.figures.style import INK, STRATEGY_COLOURS, STYLE, TRUTH, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
            axes.grid(True)
            axes.tick_params(labelbottom=axes is (top, *panels)[-1])
            for begin, end in gaps - log.time[0]:
                axes.axvspan(begin, end, color=TRUTH, alpha=0.25, lw=0)
        since = f"time after {log.time[0]:.15g} s [s]"
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
    axes.set_title(f"{log.name}: path by the odometry")
    axes.grid(True)


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
    with rc_context(STYLE):
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
