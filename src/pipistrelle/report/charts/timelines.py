"""ANEES over time as charts, one per filter."""

import math

import numpy as np

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.consistency import anees, anees_bounds_about
from pipistrelle.figures.chart import Chart, Panel, Series, ends, linear_axis, log_axis
from pipistrelle.report.charts.axes import slug
from pipistrelle.report.claims.contrasts import frame_time, lap_time
from pipistrelle.report.numbers import listed
from pipistrelle.report.studied import (
    Selection,
    Study,
    Way,
    case_name,
    filter_titles,
    kept,
    own_cases,
)
from pipistrelle.report.variables import BEAM


def anees_charts(selection: Selection) -> list[Chart]:
    """Chart each filter's ANEES over time, a panel per strategy, a line per beamwidth.

    Bradley & Abaid, Sec. V-B and Eqs. (24) and (25).
    """
    titles = filter_titles(selection.study)
    return [_anees_chart(selection, name, title) for name, title in titles.items()]


def _anees_chart(selection: Selection, name: str, title: str) -> Chart:
    """Chart one filter's ANEES over time."""
    study = selection.study
    ways = [(name, strategy) for strategy in STRATEGIES if (name, strategy) in study.trials]
    lines = {way: _anees_lines(selection, way) for way in ways}
    lines = {way: series for way, series in lines.items() if series}
    runs = min((_runs(selection, way) for way in lines), default=0)
    alike = _drives_alike(study)
    if runs and alike:
        for way, of_way in lines.items():
            of_way.insert(0, _ideal(study, way, runs))
    vertical = log_axis("ANEES", ends(s for of_way in lines.values() for s in of_way) or [1.0, 9.0])
    lap = lap_time(study) if alike else math.inf
    panels = [
        Panel(
            title=way[1],
            role=way[1],
            x=linear_axis("time [s]", [max(s.x[-1] for s in series) / 1.05], floor=0.0),
            y=vertical,
            series=tuple(series),
            posts=tuple(lap * k for k in range(1, int(series[0].x[-1] / lap) + 1)),
        )
        for way, series in lines.items()
    ]
    return Chart(
        name=f"anees_{slug(name)}",
        title=f"Consistency of {title}: average NEES over time",
        caption=_caption(study, runs, alike=alike),
        panels=tuple(panels),
        columns=("time_s", "anees"),
    )


def _caption(study: Study, runs: int, *, alike: bool) -> str:
    """Say what the lines are, and what is grey and dotted."""
    clauses = []
    if [variable.name for variable in study.variables] == [BEAM]:
        clauses.append("The stronger a line, the narrower the beam")
    elif study.variables:
        which = "the lower" if study.variables[0].numbers else "the earlier listed"
        of = listed([variable.name for variable in study.variables])
        clauses.append(f"A line for each combination of {of}; the stronger, {which}")
    if alike:
        one = ", at one beamwidth or another" if BEAM in {v.name for v in study.variables} else ""
        clauses.append(
            "grey: where a consistent filter's ANEES over "
            f"{runs} world{'' if runs == 1 else 's'} lies with 95 %, after a start that is exact "
            f"and thought uncertain{one}"
        )
        clauses.append("dotted: the vehicle is back at its start")
    words = "; ".join(clauses)
    return words[:1].upper() + words[1:]


def _runs(selection: Selection, way: Way) -> int:
    """Count the worlds of the case that has the fewest, of those that have any."""
    cases = own_cases(selection.study.trials[way])
    counts = [int(np.sum(kept(selection, [(*way, int(i))]))) for i in cases]
    return min((count for count in counts if count), default=0)


def _drives_alike(study: Study) -> bool:
    """Return whether all combinations drive the same laps at the same times."""
    frames = next(iter(study.trials.values())).nees.shape[2]
    drives = {
        (lap_time(study, i), *frame_time(study, frames, i)[-1:].tolist(), config.scenario.steps)
        for i, config in enumerate(study.configs)
    }
    return len(drives) == 1


def _ideal(study: Study, way: Way, runs: int) -> Series:
    """Return a consistent filter's ANEES over so many worlds: its mean, and all cases' bounds."""
    expected, variance = study.trials[way].consistent
    low, high = anees_bounds_about(expected, variance, runs)
    return Series(
        name="a consistent filter",
        role="ink",
        x=frame_time(study, expected.shape[1]),
        y=np.mean(expected, axis=0),
        low=np.min(low, axis=0),
        high=np.max(high, axis=0),
        dashed=True,
    )


def _anees_lines(selection: Selection, way: Way) -> list[Series]:
    """Return ANEES over time, the widest beam first and faintest."""
    study = selection.study
    nees = study.trials[way].nees
    cases = own_cases(study.trials[way]).tolist() if nees.shape[2] else []
    found = []
    for column, i in reversed(list(enumerate(cases))):
        counts = kept(selection, [(*way, i)])
        if counts.any():
            found.append(
                Series(
                    name=case_name(study, way, i) or way[1],
                    role=way[1],
                    x=frame_time(study, nees.shape[2], i),
                    y=anees(nees[counts, column]),
                    strength=1.0 - 0.75 * column / max(len(cases) - 1, 1),
                )
            )
    return found
