"""Figures of comparisons: paths of several runs in a map, differences of studies by case."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from pipistrelle.estimation.catalogue import title_of
from pipistrelle.evaluation.scores import heading, shown_in
from pipistrelle.experiments.comparing import (
    LETTERS,
    SIGNIFICANCE,
    ComparedEstimate,
    ComparedMissions,
    ComparedStudies,
)
from pipistrelle.figures.chart import PLAIN
from pipistrelle.figures.style import INK, STYLE, TRUTH
from pipistrelle.files import spelt

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RUNS = ("#0b6e69", "#c8501e", "#6a3fa0", "#7d8a12", "#b03a7a", "#2f6db3")
"""Colours of folders, distinct from the strategies'."""
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.2, 1.4)), (0, (6, 2, 1.2, 2)))
WIDTH, ROW, REST = 12.0, 3.7, 0.75
"""Width of a figure of paths, height of an estimate's row, and of the legend [inch]."""
ACROSS, TITLE, LONGEST = 4, 22, 40
"""Most panels side by side in a figure of studies; most letters in a line of a title, and of a
folder's name."""


def draw_comparison(compared: ComparedMissions | ComparedStudies) -> "Figure":
    """Draw a comparison of missions (maps and errors) or of studies (score differences).

    Missions have a row for each estimate: paths and landmarks as recorded, the same after a rigid
    motion onto the truth, and the distance from it over time. Studies have a panel for each score
    with the difference of each case: a thick line for its interval by itself, a thin line for its
    interval within the family, and a cross if any of its worlds diverged or failed.

    Returns: a figure that pyplot does not keep.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE | PLAIN):
        if isinstance(compared, ComparedMissions):
            return _draw_missions(compared)
        return _draw_studies(compared)


def _draw_missions(compared: ComparedMissions) -> "Figure":
    """Draw for each compared estimate a row with maps, before and after alignment, and errors."""
    from matplotlib.figure import Figure

    rows = len(compared.estimates)
    figure = Figure(figsize=(WIDTH, rows * ROW + REST), layout="constrained")
    grid = figure.add_gridspec(2 * rows, 3)
    known = any(truth is not None for truth in compared.truths)
    for row, estimate in enumerate(compared.estimates):
        raw = figure.add_subplot(grid[2 * row : 2 * row + 2, 0])
        aligned = figure.add_subplot(grid[2 * row : 2 * row + 2, 1])
        limits = _limits(compared, estimate)
        for axes, fitted in ((raw, False), (aligned, True)):
            _draw_paths(axes, compared, estimate, fitted=fitted)
            axes.set(xlim=limits[0], ylim=limits[1], aspect="equal", xlabel="x [m]")
        raw.set_ylabel("y [m]")
        title = ", ".join(filter(None, [estimate.title, "as they are"]))
        raw.set_title(title, loc="left")
        whom = "its truth" if known else "the first"
        aligned.set_title(f"each turned and shifted onto {whom}", loc="left")
        _draw_errors(figure, (grid[2 * row, 2], grid[2 * row + 1, 2]), estimate, known=known)
    truth = {"color": TRUTH, "lw": 3.2, "alpha": 0.35}
    each = "" if compared.one_drive else " of each, in its colour"
    entries = [(f"true path{each}", truth)] if known else []
    for i, (letter, folder) in enumerate(compared.folders.items()):
        filters = dict.fromkeys(title_of(e.estimates[i][1]) for e in compared.estimates)
        name = f"{_named(letter, folder)} ({' and '.join(filters)})"
        entries.append((name, {"lw": 1.3} | _look(i)))
    circle = {"color": INK, "lw": 0, "marker": "o", "ms": 3.2, "mfc": "none"}
    entries.append(("placed landmarks", circle))
    _draw_legend(figure, entries)
    return figure


def _limits(
    compared: ComparedMissions, estimate: ComparedEstimate
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a map's x and y limits around the true paths (or all paths) and points near them."""
    truths = [truth.pose[:, :2] for truth in compared.truths if truth is not None]
    paths = [points for view in estimate.views for points in (view.raw, view.aligned)]
    marks = [points for view in estimate.views for points in (view.placed, view.placed_aligned)]
    shown, rest = (np.concatenate(parts) for parts in (truths or paths, [*paths, *marks]))
    shown, rest = (points[np.isfinite(points).all(axis=1)] for points in (shown, rest))
    shown = shown if len(shown) else np.zeros((1, 2))
    low, high = shown.min(axis=0), shown.max(axis=0)
    room = 0.5 * np.max(high - low) + 0.5
    near = np.clip(rest, low - room, high + room)
    low, high = (f(np.concatenate([shown, near]), axis=0) for f in (np.min, np.max))
    centre, half = (low + high) / 2.0, np.full(2, 0.55 * np.max(high - low) + 0.25)
    (left, bottom), (right, top) = (centre - half).tolist(), (centre + half).tolist()
    return (left, right), (bottom, top)


def _draw_paths(
    axes: "Axes", compared: ComparedMissions, estimate: ComparedEstimate, *, fitted: bool
) -> None:
    """Draw on a map the true paths, broad, and each folder's estimated path and landmarks."""
    truths = {i: truth for i, truth in enumerate(compared.truths) if truth is not None}
    for i, truth in list(truths.items())[: 1 if compared.one_drive else None]:
        colour = TRUTH if compared.one_drive else _look(i)["color"]
        axes.plot(*truth.pose[:, :2].T, color=colour, lw=3.2, alpha=0.35, zorder=2)
    for i, view in enumerate(estimate.views):
        path, placed = (view.aligned, view.placed_aligned) if fitted else (view.raw, view.placed)
        axes.plot(*path.T, lw=1.3, zorder=4 + 0.1 * i, **_look(i))
        colour = _look(i)["color"]
        axes.plot(*placed.T, "o", ms=3.2, mfc="none", mec=colour, mew=0.8, zorder=3)


def _draw_errors(
    figure: "Figure", places: Sequence[Any], estimate: ComparedEstimate, *, known: bool
) -> None:
    """Draw the position errors of paths over time, as recorded and after alignment."""
    first: Axes | None = None
    for place, name in zip(places, ("as it is", "aligned"), strict=True):
        axes = figure.add_subplot(place, sharex=first)
        for i, view in enumerate(estimate.views):
            error = view.error if first is None else view.error_aligned
            axes.plot(view.time, error, lw=1.1, **_look(i))
        what = "error" if known else "from the first"
        axes.set_ylabel(f"{what},\n{name} [m]", multialignment="center")
        errors = [np.asarray(line.get_ydata()) for line in axes.lines]
        most = [np.max(e[np.isfinite(e)], initial=0.0) for e in errors]
        # Errors of diverged paths are cut.
        axes.set_ylim(0.0, float(1.08 * min(max(most), 20.0 * max(min(most), 0.5))) or 1.0)
        axes.set_xlim(0.0, max(view.time[-1] for view in estimate.views))
        if first is None:
            axes.tick_params(labelbottom=False)
            diverged = zip(LETTERS, estimate.scores.get("diverged", ()), strict=False)
            if lost := [letter for letter, is_lost in diverged if is_lost]:
                axes.set_title(f"diverged: {', '.join(lost)}", loc="left")
        else:
            axes.set_xlabel("time [s]")
        first = first or axes


def _look(i: int) -> dict[str, Any]:
    """Return the line colour and dash pattern of the folder with index `i`."""
    return {"color": RUNS[i % len(RUNS)], "ls": DASHES[i % len(DASHES)]}


def _named(letter: str, folder: Path) -> str:
    """Return a folder's text for the legend: its letter and the end of its path."""
    name = spelt(folder)
    return f"{letter}  {name if len(name) <= LONGEST else f'…{name[1 - LONGEST :]}'}"


def _draw_legend(figure: "Figure", entries: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Draw a legend of names and line styles below the panels, in as many columns as fit."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **look) for _, look in entries]
    names = [name for name, _ in entries]
    for columns in range(len(entries), 0, -1):
        legend = figure.legend(handles, names, loc="outside lower left", ncols=columns)
        if columns == 1 or legend.get_window_extent().width < figure.bbox.width:
            break
        legend.remove()


def _draw_studies(compared: ComparedStudies) -> "Figure":
    """Draw the differences between studies: a panel for each score, a line for each case."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    first, others = compared.rows[0], len(compared.folders) - 1
    labels = [row["case"] for row in compared.rows if row["score"] == first["score"]][::others]
    there = {row["score"] for row in compared.rows}
    shown = {name: score for name, score in shown_in("studies").items() if name in there}
    rows = -(-len(shown) // ACROSS)
    height = max(2.0, (0.1 + 0.12 * others) * len(labels)) + 0.9
    figure = Figure(figsize=(WIDTH, rows * height + 0.5), layout="constrained")
    grid = figure.subplots(rows, min(ACROSS, len(shown)), sharey=True, squeeze=False)
    panels, empty = grid.flat[: len(shown)], grid.flat[len(shown) :]
    for axes in empty:
        axes.remove()
    for axes, (name, score) in zip(panels, shown.items(), strict=True):
        axes.axvline(0.0, color=INK, lw=0.8, zorder=1)
        for k, row in enumerate(row for row in compared.rows if row["score"] == name):
            other = LETTERS.index(row["letter"])
            place = k // others + (other - 1 - 0.5 * (others - 1)) * 0.6 / others
            colour = RUNS[other % len(RUNS)]
            for low, high, width in (("low", "high", 0.9), ("alone_low", "alone_high", 2.6)):
                if row[low] is not None and row[high] is not None:
                    axes.hlines(place, row[low], row[high], color=colour, lw=width, zorder=2)
            face = colour if row["p"] < SIGNIFICANCE else "white"
            mark, size = ("X", 6.6) if row["diverged_first"] or row["diverged"] else ("o", 4.6)
            axes.plot(row["difference"], place, mark, ms=size, mfc=face, mec=colour, zorder=3)
        title = heading(score).replace(" [", "\u00a0[")  # no line begins with the unit
        axes.set_title(fill(title, TITLE), loc="left", weight="bold")
        axes.set_xlabel("other less A" if others > 1 else "B less A")
        axes.xaxis.set_major_locator(MaxNLocator(4))
    panels[0].set_yticks(range(len(labels)), labels)
    panels[0].set_ylim(len(labels) - 0.5, -0.5)
    entries: list[tuple[str, dict[str, Any]]] = [
        (_named(*one), {"color": RUNS[i % len(RUNS)], "lw": 2.6} if i else {"lw": 0})
        for i, one in enumerate(compared.folders.items())
    ]
    entries += [
        ("95 %, by itself", {"color": INK, "lw": 2.6}),
        ("95 %, as one of all cases", {"color": INK, "lw": 0.9}),
        (
            "full: significant as one of all cases",
            {"color": INK, "lw": 0, "marker": "o", "ms": 4.6},
        ),
    ]
    if any(row["diverged_first"] or row["diverged"] for row in compared.rows):
        cross = {"color": INK, "mfc": "none", "lw": 0, "marker": "X", "ms": 6.6}
        entries.append(("diverged or failed in some worlds", cross))
    _draw_legend(figure, entries)
    return figure
