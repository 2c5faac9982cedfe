"""Charts of a study's results: `CHARTS` of any study, `PAPERS` of the paper's cases.

To add a figure, write a function from a selection to its charts and add it to a list: page, PNG,
PDF and CSV follow. `evaluation.scores` lists the scores that are charted over a variable.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.comparison import Finding
from pipistrelle.evaluation.consistency import anees, anees_bounds_about
from pipistrelle.evaluation.scores import Score, shown_in
from pipistrelle.figures.chart import MARKS, Axis, Chart, Panel, Series, ends, linear_axis, log_axis
from pipistrelle.report import effects as changes
from pipistrelle.report import sentences as paper
from pipistrelle.report.study import (
    COMMON,
    LANDMARKS,
    POSITION,
    Selection,
    Study,
    Way,
    along,
    case_name,
    combination_name,
    filter_titles,
    frame_time,
    has_numbers,
    kept,
    lap_time,
    mean_std,
    own_cases,
    samples,
)
from pipistrelle.report.variables import (
    BEAM,
    UNITS,
    Variable,
    axis_of,
    axis_of_words,
    listed,
    places,
    with_article,
)

WORLDS = "Mean ± σ over worlds; dots: single worlds above that"
PASSIVE = " (passive's at the right edge, where they do not depend on the beam)"
BOUND = (
    "; dashed: the bound, the least root mean square of any estimator, with the noise as measured "
    "in the signal (a mean of RMSEs may be a fifth below, and one world's farther)"
)
"""Parts of captions."""
GAINS = (("position", POSITION), ("map", COMMON))
DIFFERENCE = "active minus fused; open: not significant"
MOST_PANELS = 6
"""Most panels of combinations; more combinations become lines of a panel per strategy."""
ASIDE = {"active": 0.985, "fused": 1.015, "passive": 1.0}
"""Factors by which strategies are shifted along a logarithmic axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line in a chart: the cases of a filter and strategy along the horizontal axis."""

    way: Way
    name: str
    """The strategy, or the combination if the panel has a single strategy."""
    strength: float = 1.0
    x: Float[np.ndarray, " k"]
    aside: Float[np.ndarray, " k"]
    """Positions along the axis, and positions shifted from the other strategies."""
    cells: Int[np.ndarray, " k"]
    """Numbers of the combinations."""


Facet = tuple[str, list[Line]]
"""Title and lines of a panel."""


def facets_of(study: Study, variable: Variable | None, axis: Axis) -> tuple[list[Facet], bool]:
    """Split a study's cases into chart panels with lines over a variable, or over the filters.

    Returns: a panel per filter and combination of the other variables with the strategies as
    lines; if these are more than `MOST_PANELS`, a panel per filter and strategy with a line per
    distinct combination, the first strongest. And whether the lines are combinations.
    """
    titles, trials = filter_titles(study), study.trials

    def plain(way: Way, x: np.ndarray, cells: np.ndarray, among: Sequence[str]) -> Line:
        aside = beside(axis, x, way[1], among)
        return Line(way=way, name=way[1], x=x, aside=aside, cells=cells)

    if variable is None:
        at, first = np.arange(len(titles), dtype=np.float64), np.zeros(1, dtype=int)
        among = [one for one in STRATEGIES if any(one == way for _, way in trials)]
        lines = [
            plain((name, strategy), at[[i]], first, among)
            for strategy in STRATEGIES
            for i, name in enumerate(titles)
            if (name, strategy) in trials
        ]
        return [("", lines)], False
    rows, x = along(study, variable), places(variable)
    count = rows.shape[1]
    many = count > 1 and len(titles) * count > MOST_PANELS
    names = [combination_name(study, int(i), [variable]) for i in rows[0]]
    facets: list[Facet] = []
    for name, title in titles.items():
        among = [strategy for strategy in STRATEGIES if (name, strategy) in trials]
        for strategy in among if many else ():
            at = trials[name, strategy].at[rows]
            first = np.sort(np.unique(at, axis=1, return_index=True)[1]).tolist()
            last = max(len(first) - 1, 1)
            look = {"way": (name, strategy), "x": x, "aside": x}
            lines = [
                Line(name=names[j], strength=1.0 - 0.75 * i / last, cells=rows[:, j], **look)
                for i, j in enumerate(first)
            ]
            facets.append((f"{title}, {strategy}", lines))
        for j in () if many else range(count):
            lines = [plain((name, strategy), x, rows[:, j], among) for strategy in among]
            parts = [title, names[j]] if len(titles) > 1 or count == 1 else [names[j]]
            facets.append((", ".join(filter(None, parts)), lines))
    return facets, many


def beside(
    axis: Axis,
    x: Float[np.ndarray, " k"],
    strategy: str,
    among: Sequence[str] = STRATEGIES,
    far: float = 1.0,
) -> Float[np.ndarray, " k"]:
    """Shift a strategy's points along the axis, so that the strategies do not overlap.

    `among`: all strategies shown. `far`: multiple of the shift of single worlds.
    """
    middle = float(np.mean([ASIDE[one] for one in among if one in ASIDE] or [1.0]))
    share = far * (ASIDE.get(strategy, middle) - middle)
    if axis.log:
        return x * (1.0 + share)
    low, high = axis.limits
    return x + share * (12.0 if axis.words else 0.5 * (high - low))


def each_combination(study: Study, variable: Variable) -> str:
    """Describe for a caption the lines of a chart that has a line per combination of variables."""
    others = [with_article(other) for other in study.variables if other is not variable]
    first = combination_name(study, 0, [variable])
    what = f"value of {others[0]}" if len(others) == 1 else f"combination of {listed(others)}"
    return f"a line for each {what}, that of {first} the strongest"


def slug(name: str) -> str:
    """Replace characters that are not letters or digits by underscores, for a file's name."""
    return re.sub(r"\W+", "_", name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """Description of a chart of a score over a variable: title, axis label, scale, caption."""

    name: str
    """Name of the chart and its files."""
    title: str
    score: str
    """One of `study.READ`, or `study.COMMON`."""
    label: str
    column: str
    """Label of the vertical axis, and column of the CSV."""
    scale: float = 1.0
    """Factor from the score to the axis."""
    caption: str = WORLDS
    more: str = ""
    """End of the caption."""
    beside: str = ""
    named: str = "bound"
    """Score of a dashed line, if any, and its name."""
    worlds: bool = True
    """Whether single worlds are shown."""
    log: bool = False
    """Whether the axis is logarithmic, with means and deviations of logarithms."""


def levels() -> tuple[Level, ...]:
    """Return the descriptions of all charts that show a score over a variable."""
    return tuple(_level(name, score) for name, score in shown_in("levels").items())


def _level(name: str, score: Score) -> Level:
    """Return the description of the chart that shows a score over a variable."""
    factor, sign = UNITS[score.unit]
    stem = name.removesuffix(f"_{score.unit}")
    drawn: dict[str, Any] = {
        "name": stem,
        "title": score.title[0].upper() + score.title[1:],
        "score": name,
        "label": f"{score.title} [{sign}]" if sign else score.title,
        "column": f"{stem}_deg" if score.unit == "rad" else name,
        "scale": factor,
        "more": BOUND if score.bound else "",
        "beside": score.bound,
        "log": score.ratio,
    }
    return Level(**drawn | dict(score.chart))


def level_charts(selection: Selection, only: str = "") -> list[Chart]:
    """Chart every score over each variable of a study, or over the filters without variables.

    A panel per filter, a colour per strategy; worlds more than σ above the mean are single marks.
    `only`: part of the names of the scores. Bradley & Abaid, Secs. V-C, V-D, V-E and Appendix A.
    """
    axes = selection.study.variables or (None,)
    there = [what for what in levels() if has_numbers(selection.study, what.score)]
    return [_chart(selection, what, axis) for axis in axes for what in there if only in what.score]


def _chart(selection: Selection, what: Level, variable: Variable | None) -> Chart:
    """Return the chart of a score over a variable, or over the filters if it is None."""
    study = selection.study
    axis = axis_of(variable) if variable else axis_of_words([*filter_titles(study).values()])
    facets, many = facets_of(study, variable, axis)
    apart = axis.words and not many
    found = [_drawn(selection, what, lines, apart=apart, many=many) for _, lines in facets]
    top = ends(s for drawn in found for s in drawn if not MARKS[s.style].pinned)
    room = 1.07 if what.worlds else 1.0
    vertical = (
        log_axis(what.label, top)
        if what.log
        else linear_axis(what.label, [room * end for end in top], floor=0.0)
    )
    name, title = what.name, what.title
    if variable and len(study.variables) > 1:
        name, title = f"{name}_by_{slug(variable.name)}", f"{title}, over {with_article(variable)}"
    return Chart(
        name=name,
        title=title,
        caption=_caption(study, what, variable, many=many),
        panels=tuple(
            Panel(
                title=title,
                role=lines[0].way[1] if many else "ink",
                x=axis,
                y=vertical,
                series=tuple(series),
            )
            for (title, lines), series in zip(facets, found, strict=True)
        ),
        columns=(variable.column if variable else "filter", what.column),
    )


def _caption(study: Study, what: Level, variable: Variable | None, *, many: bool) -> str:
    """Return a score chart's caption; `many`: its lines are combinations of the variables."""
    if many and variable:
        mean = "Geometric mean" if what.log else "Mean"
        dashed = f"; dashed: {'the bound' if what.named == 'bound' else what.named}"
        more = "" if what.more == BOUND else what.more
        lines = each_combination(study, variable)
        return f"{mean} over worlds; {lines}{dashed if what.beside else ''}{more}"
    passive = PASSIVE if variable and variable.name == BEAM else ""
    beyond = f"{passive}, triangles: those beyond the panel"
    return what.caption + beyond * what.worlds + what.more


def _drawn(
    selection: Selection, what: Level, lines: Sequence[Line], *, apart: bool, many: bool
) -> list[Series]:
    """Return the data series of a panel: means, single worlds above σ, and the dashed bound.

    `apart`: points side by side in place of lines. `many`: lines of combinations.
    """
    found = []
    for line in lines:
        at = selection.study.trials[line.way].at[line.cells]
        flat = len(at) > 1 and what.score != COMMON and bool(np.all(at == at[0]))
        per_place = _samples(selection, line, what.score, what.scale)
        style = "points" if apart else ("line" if flat else "dots")
        mean = _mean_line(line, per_place, style, log=what.log)
        found.append(replace(mean, low=None, high=None) if many else mean)
        if what.worlds and not many:
            found.append(_worlds_above(line, mean, per_place, flat=flat))
        if what.beside:
            found.append(_dashed(selection, line, what, apart=apart))
    return found


def _samples(
    selection: Selection, line: Line, score: str, scale: float
) -> list[Float[np.ndarray, " m"]]:
    """Return a score's values in all worlds at each point of a line, times `scale`."""
    return [scale * samples(selection, score, [(*line.way, int(i))])[0] for i in line.cells]


def _mean_line(
    line: Line, per_place: Sequence[Float[np.ndarray, " m"]], style: str, *, log: bool
) -> Series:
    """Return a score's mean ± σ over the worlds at each point of a line, as a data series."""
    with np.errstate(divide="ignore", invalid="ignore"):
        values = [np.log(sample[sample > 0.0]) if log else sample for sample in per_place]
    mean, std = np.array([mean_std(sample) for sample in values]).T
    low, high = mean - std, mean + std
    if log:
        mean, low, high = np.exp(mean), np.exp(low), np.exp(high)
    return Series(
        name=line.name,
        role=line.way[1],
        x=line.aside if style == "points" else line.x,
        y=mean,
        low=low,
        high=high,
        style=style,
        strength=line.strength,
    )


def _worlds_above(
    line: Line, mean: Series, per_place: Sequence[Float[np.ndarray, " m"]], *, flat: bool
) -> Series:
    """Return the worlds above mean + σ at each point of a line, as a data series of marks."""
    top = np.array([np.nan]) if mean.high is None else mean.high
    above = [sample[sample > end] for sample, end in zip(per_place, top, strict=True)]
    at = line.aside
    if flat:
        above, at = above[:1], 1.08 * line.x[-1:]  # beyond the widest beam
    return Series(
        name=f"{line.name}, worlds above σ",
        role=line.way[1],
        x=np.repeat(at, [len(values) for values in above]),
        y=np.concatenate(above),
        style="marks",
        strength=0.55,
    )


def _dashed(selection: Selection, line: Line, what: Level, *, apart: bool) -> Series:
    """Return the mean of a second score over the worlds, such as the bound, as a dashed line."""
    beneath = [mean_std(one)[0] for one in _samples(selection, line, what.beside, what.scale)]
    return Series(
        name=f"{line.name}, {what.named}",
        role=line.way[1],
        x=line.aside if apart else line.x,
        y=np.array(beneath),
        style="levels" if apart else "line",
        strength=line.strength,
        dashed=not apart,
    )


def effect_charts(selection: Selection) -> list[Chart]:
    """Chart the effects of each variable with each filter, a panel per score.

    Returns: without variables, the effects of strategies and filters.
    """
    study, titles = selection.study, filter_titles(selection.study)
    families: dict[tuple[str, str], list[changes.Effect]] = {}
    for effect in changes.effects_of(selection):
        pairing = effect.pairing
        if not study.variables or pairing.factor not in (changes.STRATEGY, changes.FILTER):
            name = pairing.factor, pairing.filter or pairing.strategy
            families.setdefault(name, []).append(effect)
    charts = []
    for (factor, whose), family in families.items():
        variable = next((v for v in study.variables if v.name == factor), None)
        first = family[0].pairing.before
        afters = dict.fromkeys(effect.pairing.after for effect in family)
        words = variable.words if variable else (first, *afters)
        axis = axis_of(variable) if variable else axis_of_words(words)
        at = dict(zip(words, places(variable) if variable else range(len(words)), strict=True))
        title = titles.get(whose, f"{whose} sensing")
        what = with_article(variable) if variable else f"the {factor}"
        mean = "averaged over the combinations of the rest, " if family[0].apart else ""
        known = {one.measure for one in family if np.isfinite(one.finding.mean)}
        charts.append(
            Chart(
                name=f"effect_{slug(factor)}_{slug(whose)}",
                title=f"What {what} changes, {title}",
                caption=f"Difference to {first} in the same world, {mean}mean over worlds and its "
                "95 % interval as one of its family. Full: shown, by Holm's correction. Map: "
                "landmarks that both have placed. NEES: the ratio",
                panels=tuple(
                    _panel(measure, family, axis, at)
                    for measure in changes.measures_of(study)
                    if measure in known or not known
                ),
                columns=(variable.column if variable else factor, "change"),
            )
        )
    return charts


def gain_charts(selection: Selection) -> list[Chart]:
    """Chart the gain of listening (RMSE of active minus fused sensing) over each variable."""
    return [_gain_chart(selection, variable) for variable in selection.study.variables]


def about(
    name: str,
    role: str,
    x: Float[np.ndarray, " n"],
    mean: Float[np.ndarray, " n"],
    edges: Float[np.ndarray, "n 2"],
    filled: Sequence[bool] | np.ndarray,
) -> Series:
    """Return a data series of points with error bars that end at `edges`."""
    marks: dict[str, Any] = {"style": "points", "filled": np.array(filled, dtype=bool)}
    return Series(name=name, role=role, x=x, y=mean, low=edges[:, 0], high=edges[:, 1], **marks)


def _panel(
    measure: changes.Measure, family: Sequence[changes.Effect], axis: Axis, at: Mapping[str, float]
) -> Panel:
    """Return the panel of a chart with the effects on a score, a data series per strategy."""
    ways: dict[str, list[changes.Effect]] = {}
    for effect in family:
        if effect.measure == measure:
            ways.setdefault(effect.pairing.strategy, []).append(effect)
    series = [_changes(list(ways), strategy, axis, at, one) for strategy, one in ways.items()]
    sign = UNITS[measure.unit][1]
    label = "ratio" if measure.ratio else f"change{f' [{sign}]' if sign else ''}"
    still = 1.0 if measure.ratio else 0.0
    shown = [still, *ends(series)]
    return Panel(
        title=measure.title,
        x=axis,
        y=log_axis(label, shown) if measure.ratio else linear_axis(label, shown),
        series=tuple(series),
        rules=(still,),
    )


def _changes(
    among: Sequence[str],
    strategy: str,
    axis: Axis,
    at: Mapping[str, float],
    effects: Sequence[changes.Effect],
) -> Series:
    """Return a strategy's changes of a score as points with error bars, 0 at the reference."""
    measure, findings = effects[0].measure, [effect.finding for effect in effects]
    mean, edges = _bars(findings)
    mean, edges = np.append(0.0, mean), np.vstack(([np.nan, np.nan], edges))
    factor = UNITS[measure.unit][0]
    mean, edges = (np.exp(one) if measure.ratio else factor * one for one in (mean, edges))
    x = np.array([at[effects[0].pairing.before], *(at[e.pairing.after] for e in effects)])
    shown = [True, *(finding.holds is not None for finding in findings)]
    x = beside(axis, x.astype(np.float64), strategy, among, far=1.0 if axis.words else 3.0)
    rising = np.argsort(x)
    points = x[rising], mean[rising], edges[rising], np.array(shown)[rising]
    return about(strategy or "difference", strategy or "ink", *points)


def _bars(findings: Sequence[Finding]) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of findings and the ends of their intervals; NaN if infinite."""
    edges = np.array([finding.family for finding in findings]).reshape(-1, 2)
    edges[~np.isfinite(edges)] = np.nan
    return np.array([finding.mean for finding in findings]), edges


def _gain_chart(selection: Selection, variable: Variable) -> Chart:
    """Chart the gain of fused over active sensing along a variable."""
    study, axis = selection.study, axis_of(variable)
    panels = []
    for what, score in GAINS:
        found = {
            title: _gains(selection, name, score, variable)
            for name, title in filter_titles(study).items()
            if {(name, "active"), (name, "fused")} <= study.trials.keys()
        }
        shown = ends(one for series in found.values() for one in series)
        vertical = linear_axis(f"{what} gain [m]", [0.0, *shown])
        panels += [
            Panel(title=f"{what}, {title}", x=axis, y=vertical, series=tuple(series), rules=(0.0,))
            for title, series in found.items()
        ]
    several = len(study.variables) > 1
    spread = "mean and its 95 % interval as one of its panel"
    if several:
        spread = f"mean; {each_combination(study, variable)}, points for their {spread}"
    return Chart(
        name=f"gain_by_{slug(variable.name)}" if several else "gain",
        title="What listening to others adds to one's own calls"
        + (f", over {with_article(variable)}" if several else ""),
        caption=f"RMSE of active minus that of fused in the same world, {spread}; "
        "above the line fused is better. Full: shown, by Holm's correction over the panel. Map: "
        "landmarks that every strategy has placed",
        panels=tuple(panels),
        columns=(variable.column, "gain_m"),
    )


def _gains(selection: Selection, name: str, score: str, variable: Variable) -> list[Series]:
    """Return a filter's gains over a variable as data series: their mean, and each combination."""
    rows, x = along(selection.study, variable), places(variable)
    measure = changes.Measure(title="", score=score, unit="m")
    pairs = [((name, "fused", i), (name, "active", i)) for i in range(rows.size)]
    apart = changes.compare(selection, measure, [[pair] for pair in pairs])
    judged = [one.finding for one in apart]
    each = [_judged(DIFFERENCE, "fused", x, [judged[i] for i in column]) for column in rows.T]
    if len(each) == 1:
        return each
    for j, one in enumerate(each):
        named = combination_name(selection.study, int(rows[0, j]), [variable])
        look = {"name": named, "style": "dots", "low": None, "high": None}
        each[j] = replace(one, **look, strength=1.0 - 0.75 * j / (len(each) - 1))
    means = changes.compare(selection, measure, [[pairs[i] for i in row] for row in rows])
    return [_judged(f"mean, {DIFFERENCE}", "ink", x, [one.finding for one in means]), *each]


def _judged(
    name: str, role: str, x: Float[np.ndarray, " n"], findings: Sequence[Finding]
) -> Series:
    """Return findings as points with their intervals as error bars, filled where significant."""
    mean, edges = _bars(findings)
    return about(name, role, x, mean, edges, [one.holds is not None for one in findings])


def anees_charts(selection: Selection) -> list[Chart]:
    """Chart each filter's ANEES over time, a panel per strategy, a line per beamwidth.

    Bradley & Abaid, Sec. V-B and Eqs. (24) and (25).
    """
    titles = filter_titles(selection.study)
    return [_anees_chart(selection, name, title) for name, title in titles.items()]


def _anees_chart(selection: Selection, name: str, title: str) -> Chart:
    """Return the chart of a filter's ANEES over time, a panel per strategy."""
    study = selection.study
    ways = [(name, strategy) for strategy in STRATEGIES if (name, strategy) in study.trials]
    lines = {way: _anees_lines(selection, way) for way in ways}
    lines = {way: series for way, series in lines.items() if series}
    counts = [
        int(np.sum(kept(selection, [(*way, i)])))
        for way in lines
        for i in own_cases(study.trials[way]).tolist()
    ]
    runs = min(filter(None, counts), default=0)
    frames = next(iter(study.trials.values())).nees.shape[2]
    drives = {
        (lap_time(study, i), *frame_time(study, frames, i)[-1:].tolist(), config.scenario.steps)
        for i, config in enumerate(study.configs)
    }
    alike = len(drives) == 1
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
        caption=_anees_caption(study, runs, alike=alike),
        panels=tuple(panels),
        columns=("time_s", "anees"),
    )


def _anees_caption(study: Study, runs: int, *, alike: bool) -> str:
    """Return the caption of a chart of ANEES over time."""
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


def _ideal(study: Study, way: Way, runs: int) -> Series:
    """Return the ANEES of a consistent filter over time with its 95 % band, as a data series."""
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
    """Return the ANEES over time of each case of a filter and strategy, as data series."""
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


def table_ii_charts(selection: Selection) -> list[Chart]:
    """Chart the numbers of landmarks in the study and in the paper's Table II."""
    panels = []
    for kind, score in (("fully initialised", "landmarks_full"), ("total", "landmarks_total")):
        found = {title: _counts(selection, name, score) for name, title in paper.FILTERS.items()}
        axis = linear_axis("landmarks", ends(s for _, drawn in found.values() for s in drawn))
        for title, (rows, series) in found.items():
            names = tuple((float(i), text) for i, text in enumerate(rows))
            limits = (-0.6, len(rows) - 0.4)
            if rows:
                panels.append(
                    Panel(
                        title=f"{kind}, {title}",
                        x=Axis(label="", limits=limits, ticks=names),
                        y=axis,
                        series=series,
                    )
                )
    chart = Chart(
        name="table_ii",
        title="Landmarks as in Table II",
        caption="Mean ± σ over worlds; fused sensing at three beamwidths, and passive",
        panels=tuple(panels),
        columns=("row", "landmarks"),
    )
    return [chart]


Figure = Callable[[Selection], list[Chart]]
CHARTS: tuple[Figure, ...] = (effect_charts, level_charts, gain_charts, anees_charts)
"""Figures of any study, in the page's order."""
PAPERS: tuple[Figure, ...] = (
    gain_charts,
    anees_charts,
    partial(level_charts, only="rmse"),
    partial(level_charts, only=LANDMARKS),
    table_ii_charts,
)
"""Figures of a study that holds the paper's cases."""


def answers(name: str) -> bool:
    """Return whether the chart with a name shows a score that the report's answer is about."""
    answering = {level.name for level in levels()} - {"map_rmse_aligned"} | {"gain"}
    return name.partition("_by_")[0] in answering or name.startswith("effect_")


def study_charts(selection: Selection, charts: Sequence[Figure] | None = None) -> list[Chart]:
    """Return the charts of a study's results, except empty ones.

    `charts`: functions that each return the charts of a figure; by default `PAPERS` if the study
    holds the paper's cases, otherwise `CHARTS`.
    """
    if charts is None:
        charts = PAPERS if paper.papers_cases(selection.study) else CHARTS
    return [chart for drawn in charts for chart in drawn(selection) if chart.panels]


def _counts(selection: Selection, name: str, score: str) -> tuple[list[str], tuple[Series, Series]]:
    """Return for a filter the rows of Table II, the paper's landmark counts and the study's."""
    rows, printed, ours = [], [], []
    for row in paper.TABLE_II:
        cell = paper.cell_of(selection.study, row) if row.filter == name else None
        if cell is not None:
            rows.append(paper.row_name(row).split()[0])
            printed.append(row.full if score == "landmarks_full" else row.total)
            ours.append(mean_std(samples(selection, score, [cell])[0]))
    at = np.arange(len(rows), dtype=np.float64)
    series = []
    for title, role, aside, pairs in (
        ("the paper", "truth", -0.12, printed), ("this study", "fused", 0.12, ours),
    ):  # fmt: skip
        mean, std = np.array(pairs).reshape(-1, 2).T
        ends = np.column_stack([mean - std, mean + std])
        series.append(about(title, role, at + aside, mean, ends, [True] * len(rows)))
    return rows, (series[0], series[1])
