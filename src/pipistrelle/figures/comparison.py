"""Figures of comparisons: paths of several runs in a map, differences of studies by case."""

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from pipistrelle.estimation.catalogue import title_of
from pipistrelle.evaluation.scores import heading, shown_in
from pipistrelle.experiments.comparing import (
    ComparedCase,
    ComparedEstimate,
    ComparedMissions,
    ComparedStudies,
)
from pipistrelle.experiments.comparison_files import lettered
from pipistrelle.figures.style import INK, STYLE, TRUTH
from pipistrelle.files import spelt

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RUNS = ("#0b6e69", "#c8501e", "#6a3fa0", "#7d8a12", "#b03a7a", "#2f6db3")
"""Colours of folders, distinct from the strategies'."""
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.2, 1.4)), (0, (6, 2, 1.2, 2)))
WIDTH, ROW, REST = 12.0, 3.7, 0.75
"""Width of a figure of paths, height of an estimate's row, and of the legend [inch]."""
ACROSS, TITLE = 4, 22
"""Most panels side by side in a figure of studies, and most letters in a line of a title."""
SIGNIFICANCE = 0.05
"""Points with a smaller p, corrected for all cases, are filled."""


def draw_comparison(compared: ComparedMissions | ComparedStudies) -> "Figure":
    """Draw a comparison of missions or studies.

    Missions have a row for each estimate: paths and landmarks as recorded, the same after a rigid
    motion onto the truth, and the distance from it over time. Studies have a panel for each score
    with the difference of each case: a thick line for its interval by itself, a thin line for its
    interval within the family.

    Returns: a figure that pyplot does not keep.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):
        if isinstance(compared, ComparedMissions):
            return _draw_missions(compared)
        return _draw_studies(compared)


def _draw_missions(compared: ComparedMissions) -> "Figure":
    """Draw a row of maps and errors for each estimate."""
    from matplotlib.figure import Figure

    rows = len(compared.compared)
    figure = Figure(figsize=(WIDTH, rows * ROW + REST), layout="constrained")
    grid = figure.add_gridspec(2 * rows, 3)
    known = any(truth is not None for truth in compared.truths)
    for row, estimate in enumerate(compared.compared):
        raw = figure.add_subplot(grid[2 * row : 2 * row + 2, 0])
        aligned = figure.add_subplot(grid[2 * row : 2 * row + 2, 1])
        limits = _limits(compared, estimate)
        for axes, fitted in ((raw, False), (aligned, True)):
            _draw_paths(axes, compared, estimate, fitted=fitted)
            axes.set(xlim=limits[0], ylim=limits[1], aspect="equal", xlabel="x [m]")
        raw.set_ylabel("y [m]")
        title = ", ".join(filter(None, [estimate.title, "as they are"]))
        raw.set_title(title, loc="left", parse_math=False)
        whom = "its truth" if known else "the first"
        aligned.set_title(f"each turned and shifted onto {whom}", loc="left")
        _draw_errors(figure, (grid[2 * row, 2], grid[2 * row + 1, 2]), estimate, known=known)
    _name_folders(figure, compared)
    return figure


def _limits(
    compared: ComparedMissions, estimate: ComparedEstimate
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return axis limits around the truths (or all paths) and the points near them."""
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
    """Draw the true path as a broad line, and each estimated path with its landmarks."""
    axes.grid(True)
    axes.set_axisbelow(True)
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
    """Draw the distances over time of the recorded and the aligned paths."""
    first: Axes | None = None
    for place, name in zip(places, ("as it is", "aligned"), strict=True):
        axes = figure.add_subplot(place, sharex=first)
        for i, view in enumerate(estimate.views):
            error = view.error if first is None else view.error_aligned
            axes.plot(view.time, error, lw=1.1, **_look(i))
        axes.grid(True)
        axes.set_axisbelow(True)
        what = "error" if known else "from the first"
        axes.set_ylabel(f"{what},\n{name} [m]", multialignment="center")
        axes.set_ylim(0.0, _highest([line.get_ydata() for line in axes.lines]))
        axes.set_xlim(0.0, max(view.time[-1] for view in estimate.views))
        if first is None:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("time [s]")
        first = first or axes


def _highest(errors: Sequence[Any]) -> float:
    """Return the upper end of an error axis; errors of diverged paths are cut."""
    most = [np.max(e[np.isfinite(e)], initial=0.0) for e in map(np.asarray, errors)]
    return float(1.08 * min(max(most), 20.0 * max(min(most), 0.5))) or 1.0


def _look(i: int) -> dict[str, Any]:
    """Return colour and dashes of a folder."""
    return {"color": RUNS[i % len(RUNS)], "ls": DASHES[i % len(DASHES)]}


def _name_folders(figure: "Figure", compared: ComparedMissions) -> None:
    """Draw the legend of the folders and their filters."""
    from matplotlib.lines import Line2D

    handles: list[Artist] = []
    names: list[str] = []
    if any(truth is not None for truth in compared.truths):
        handles.append(Line2D([], [], color=TRUTH, lw=3.2, alpha=0.35))
        names.append("true path")
    for i, (letter, folder) in enumerate(lettered(compared.folders)):
        handles.append(Line2D([], [], lw=1.3, **_look(i)))
        filters = dict.fromkeys(title_of(e.estimates[i][1]) for e in compared.compared)
        names.append(f"{letter}  {_short(spelt(folder))} ({' and '.join(filters)})")
    handles.append(Line2D([], [], lw=0, marker="o", ms=3.2, mfc="none", mec=INK))
    names.append("placed landmarks")
    legend = figure.legend(handles, names, loc="outside lower left", ncols=min(len(names), 5))
    for text in legend.get_texts():
        text.set_parse_math(False)


def _short(name: str, most: int = 40) -> str:
    """Return the end of a long name."""
    return name if len(name) <= most else f"…{name[1 - most :]}"


def _draw_studies(compared: ComparedStudies) -> "Figure":
    """Draw the differences of each score in a panel, a line for each case."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    first = compared.cases[0]
    labels = [c.label for c in compared.cases if (c.score, c.other) == (first.score, first.other)]
    others = len(compared.folders) - 1
    there = {case.score for case in compared.cases}
    shown = {name: score for name, score in shown_in("studies").items() if name in there}
    rows = -(-len(shown) // ACROSS)
    height = max(2.0, (0.1 + 0.12 * others) * len(labels)) + 0.9
    figure = Figure(figsize=(WIDTH, rows * height + 0.5), layout="constrained")
    grid = figure.subplots(rows, min(ACROSS, len(shown)), sharey=True, squeeze=False)
    panels, empty = grid.flat[: len(shown)], grid.flat[len(shown) :]
    for axes in empty:
        axes.remove()
    for axes, (name, score) in zip(panels, shown.items(), strict=True):
        of_score = [case for case in compared.cases if case.score == name]
        axes.axvline(0.0, color=INK, lw=0.8, zorder=1)
        for k, case in enumerate(of_score):
            place = k // others + (case.other - 1 - 0.5 * (others - 1)) * 0.6 / others
            _draw_case(axes, case, place)
        title = heading(score).replace(" [", "\u00a0[")  # no line begins with the unit
        axes.set_title(fill(title, TITLE), loc="left", weight="bold")
        axes.set_xlabel("other less A" if others > 1 else "B less A")
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(True, axis="x")
        axes.set_axisbelow(True)
    panels[0].set_yticks(range(len(labels)), labels)
    panels[0].set_ylim(len(labels) - 0.5, -0.5)
    for text in (text for axes in grid[:, 0] for text in axes.get_yticklabels()):
        text.set_parse_math(False)
    _name_studies(figure, compared)
    return figure


def _draw_case(axes: "Axes", case: ComparedCase, place: float) -> None:
    """Draw a difference with its finite intervals."""
    finding, colour = case.contrast.finding, RUNS[case.other % len(RUNS)]
    for bounds, width in ((finding.family, 0.9), (finding.alone, 2.6)):
        if np.isfinite(bounds).all():
            axes.hlines(place, *bounds, color=colour, lw=width, zorder=2)
    face = colour if finding.p < SIGNIFICANCE else "white"
    axes.plot(finding.mean, place, "o", ms=4.6, mfc=face, mec=colour, zorder=3)


def _name_studies(figure: "Figure", compared: ComparedStudies) -> None:
    """Draw the legend of the folders, lines and points."""
    from matplotlib.lines import Line2D

    handles: list[Artist] = [Line2D([], [], lw=0)]
    names = [f"A  {_short(spelt(compared.folders[0]))}"]
    for i, (letter, folder) in list(enumerate(lettered(compared.folders)))[1:]:
        colour = RUNS[i % len(RUNS)]
        handles.append(Line2D([], [], color=colour, lw=2.6))
        names.append(f"{letter}  {_short(spelt(folder))}")
    handles += [
        Line2D([], [], color=INK, lw=2.6),
        Line2D([], [], color=INK, lw=0.9),
        Line2D([], [], color=INK, lw=0, marker="o", ms=4.6),
    ]
    names += ["95 %, by itself", "95 %, as one of all cases", "significant so"]
    legend = figure.legend(handles, names, loc="outside lower left", ncols=min(len(names), 6))
    for text in legend.get_texts():
        text.set_parse_math(False)
