"""The paper's ten figures of results, in its own form, from a whole study.

    python papers/bradley_abaid/figures.py STUDY [--output docs/images]

STUDY is a folder of `pipistrelle study`, or what `kept_studies.py unpack` makes. Three pictures:

    NAME_nees.png       Figs. 4 and 5: the NEES averaged over the worlds, a line per beamwidth
    NAME_errors.png     Figs. 6 to 9, 12 and 13: RMSE of position and map, and of heading
    NAME_landmarks.png  Figs. 10 and 11: landmarks fully initialised

As in the paper, beamwidths stand at equal distances, rounded; a marked line is the mean over the
worlds that a filter does not lose, the band one standard deviation on either side, and a single
marker a world above the band; landmarks have error bars instead. Passive sensing, which has no
beamwidth, is the same at each but in the map, whose landmarks every strategy has placed.
"""

import argparse
import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipistrelle.config import STRATEGIES, InputError
from pipistrelle.evaluation.consistency import anees, anees_bounds
from pipistrelle.figures.style import STYLE, strategy_colour
from pipistrelle.report.sentences import FILTERS, curves
from pipistrelle.report.study import (
    COMMON,
    HEADING,
    LANDMARKS,
    POSITION,
    Selection,
    frame_time,
    read_study,
    samples,
    select,
)
from pipistrelle.report.variables import width_name

IMAGES = Path(__file__).parents[2] / "docs/images"
MARKERS = {"active": "o", "fused": "s", "passive": "^"}
SHIFT = {"active": -0.12, "fused": 0.0, "passive": 0.12}
"""Of single markers and error bars, that they do not cover each other."""
ERRORS = {
    POSITION: "RMSE of the position [m]",
    COMMON: "RMSE of the map [m]",
    HEADING: "RMSE of the heading [rad]",
}


def main() -> None:
    """Read the study, and draw."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("study", type=Path, help="folder of `pipistrelle study`")
    options.add_argument("--output", type=Path, default=IMAGES, help="folder [docs/images]")
    chosen = options.parse_args()
    try:
        selection = select(read_study(chosen.study), "world")
    except InputError as mistake:
        sys.exit(str(mistake))
    pictures = {"nees": consistency, "errors": errors, "landmarks": landmarks}
    for name, draw in pictures.items():
        path = chosen.output / f"{selection.study.name}_{name}.png"
        with matplotlib.rc_context(STYLE):
            draw(selection).savefig(path, dpi=110, metadata={"Software": None})
        print(path)


def consistency(selection: Selection) -> Figure:
    """Draw ANEES over time: a row per filter, a panel per strategy, a line per beamwidth."""
    study = selection.study
    figure = Figure(figsize=(10.0, 5.6), layout="constrained")
    grid = figure.subplots(len(FILTERS), len(STRATEGIES), sharex=True, squeeze=False)
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 0.9, len(study.beamwidth)))
    for row, (name, title) in zip(grid, FILTERS.items(), strict=True):
        for axes, strategy in zip(row, STRATEGIES, strict=True):
            (nees,) = curves(selection, [(name, strategy)]) or [np.empty((0, 0, 0))]
            axes.set_title(f"{title}, {strategy}", fontsize=9)
            if not nees.size:
                continue
            time = frame_time(study, nees.shape[2])
            for i in range(nees.shape[1]):
                label = width_name(study.beamwidth[i])
                colour = shades[i] if nees.shape[1] > 1 else strategy_colour(strategy)
                axes.plot(time, anees(nees[:, i]), color=colour, label=label, lw=0.9)
            low, high = anees_bounds(len(nees))
            axes.fill_between(time, low, high, color="0.75", zorder=0.9, lw=0)
            axes.set_yscale("log")
            axes.grid(visible=True)
        low = min(axes.get_ylim()[0] for axes in row)
        high = max(axes.get_ylim()[1] for axes in row)
        for axes in row:
            axes.set_ylim(low, high)
        row[0].set_ylabel("ANEES")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    grid[0, 0].legend(ncols=3, fontsize=7, title="half-power beamwidth", title_fontsize=7)
    return figure


def errors(selection: Selection) -> Figure:
    """Draw RMSE by beamwidth: a row per error, a column per filter."""
    figure = Figure(figsize=(10.0, 10.5), layout="constrained")
    grid = figure.subplots(len(ERRORS), len(FILTERS), sharex=True, sharey="row", squeeze=False)
    for row, (score, unit) in zip(grid, ERRORS.items(), strict=True):
        for axes, (name, title) in zip(row, FILTERS.items(), strict=True):
            for strategy in STRATEGIES:
                _band(axes, selection, score, name, strategy)
            axes.set_title(title, fontsize=9)
            axes.grid(visible=True)
        row[0].set_ylabel(unit)
        row[0].set_ylim(0.0, max(axes.dataLim.y1 for axes in row) * 1.03)
    _name_beams(grid, selection)
    return figure


def _band(axes: Axes, selection: Selection, score: str, name: str, strategy: str) -> None:
    """Draw mean, band of one standard deviation, and the worlds above it."""
    colour, x = strategy_colour(strategy), np.arange(len(selection.study.beamwidth))
    worlds = [samples(selection, score, [(name, strategy, i)])[0] for i in x]
    mean = np.array([np.mean(one) for one in worlds])
    std = np.array([np.std(one, ddof=1) for one in worlds])
    axes.fill_between(x, mean - std, mean + std, color=colour, alpha=0.18, lw=0)
    axes.plot(x, mean, color=colour, marker=MARKERS[strategy], ms=4, label=strategy)
    if score != COMMON:
        for i, one in zip(x, worlds, strict=True):
            above = one[one > mean[i] + std[i]]
            place = np.full(len(above), i + SHIFT[strategy])
            axes.plot(place, above, MARKERS[strategy], color=colour, ms=2.6, alpha=0.6, mew=0)


def landmarks(selection: Selection) -> Figure:
    """Draw the number of fully initialised landmarks by beamwidth: a panel per filter."""
    figure = Figure(figsize=(10.0, 3.8), layout="constrained")
    grid = figure.subplots(1, len(FILTERS), sharey=True, squeeze=False)
    x = np.arange(len(selection.study.beamwidth))
    for axes, (name, title) in zip(grid[0], FILTERS.items(), strict=True):
        for strategy in STRATEGIES:
            worlds = [samples(selection, LANDMARKS, [(name, strategy, i)])[0] for i in x]
            axes.errorbar(
                x + SHIFT[strategy],
                [np.mean(one) for one in worlds],
                [np.std(one, ddof=1) for one in worlds],
                color=strategy_colour(strategy), marker=MARKERS[strategy], ms=4, capsize=2, lw=1,
                label=strategy,
            )  # fmt: skip
        axes.set_title(title, fontsize=9)
        axes.grid(visible=True)
    grid[0, 0].set_ylabel("landmarks fully initialised")
    _name_beams(grid, selection)
    return figure


def _name_beams(grid: np.ndarray, selection: Selection) -> None:
    """Label the beamwidths below the last row, and name the strategies once."""
    width = selection.study.beamwidth
    for axes in grid[-1]:
        axes.set_xticks(np.arange(len(width)), [width_name(beam) for beam in width])
        axes.set_xlabel("half-power beamwidth")
    grid[0, 0].legend()


if __name__ == "__main__":
    main()
