"""Charts of how large each error is, over a variable: the bound beside it, every combination shown.

Of several variables each has charts of its own. Which scores are charted, `evaluation.scores` says.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.scores import Score, shown_in
from pipistrelle.figures.chart import MARKS, Axis, Chart, Panel, Series, ends, linear_axis, log_axis
from pipistrelle.report.charts.axes import (
    Facet,
    Line,
    axis_of,
    axis_of_words,
    each_combination,
    facets_of,
    slug,
)
from pipistrelle.report.effects.wording import with_article
from pipistrelle.report.numbers import UNITS
from pipistrelle.report.studied import (
    COMMON,
    LANDMARKS,
    MAP,
    MAP_ALIGNED,
    NEES,
    POSITION_ALIGNED,
    Selection,
    Study,
    filter_titles,
    has_numbers,
    mean_std,
    samples,
)
from pipistrelle.report.variables import BEAM, Variable

EDGE = 1.08
"""Where single worlds stand that do not depend on the beam, as a share of the widest."""
WORLDS = "Mean ± σ over worlds; dots: single worlds above that"
PASSIVE = " (passive's at the right edge, where they do not depend on the beam)"
BOUND = (
    "; dashed: the bound, the least root mean square that any estimator has, the noise as the "
    "signal tells it (a mean of RMSEs may be a fifth below, and one world's farther)"
)
"""What captions say of each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """A chart of a score over a variable."""

    name: str
    """Of the chart and its files."""
    title: str
    score: str
    """One of `studied.READ`, or `studied.COMMON`."""
    label: str
    """Of the vertical axis."""
    column: str
    """Of the CSV."""
    scale: float = 1.0
    """From the score to the axis."""
    caption: str = WORLDS
    more: str = ""
    """The caption's end."""
    beside: str = ""
    """The score whose mean is drawn dashed, if any."""
    named: str = "bound"
    """What that score is, after the name of its line."""
    worlds: bool = True
    """Single worlds are shown."""
    log: bool = False
    """The axis is logarithmic; means and deviations are those of logarithms."""


_OWN: dict[str, dict[str, Any]] = {
    POSITION_ALIGNED: {
        "more": ". Each path after the rigid motion that fits it best: without the one turn of "
        "everything that is most of the raw error",
    },
    MAP: {"score": COMMON, "title": "Map RMSE of the landmarks that every strategy has placed"},
    MAP_ALIGNED: {
        "title": "Map RMSE of each strategy's own landmarks, aligned",
        "more": ". Each map after the rigid motion that fits it best; strategies place different "
        "landmarks",
    },
    LANDMARKS: {
        "name": "landmarks",
        "column": "landmarks",
        "caption": "Fully initialised landmarks at the end, mean ± σ over worlds; dashed: fully "
        "and partially initialised, mean",
        "beside": "landmarks_total",
        "named": "total",
        "worlds": False,
    },
    NEES: {
        "name": "nees",
        "column": "nees",
        "caption": "Geometric mean over worlds, within a factor of one σ either way; a consistent "
        "filter's is 3, and less after a start that is exact and thought uncertain",
        "worlds": False,
    },
}
"""What a score's chart has that the table of scores does not say."""


def levels() -> tuple[Level, ...]:
    """List the charts of the scores that `evaluation.scores` shows over a variable."""
    return tuple(_level(name, score) for name, score in shown_in("levels").items())


def _level(name: str, score: Score) -> Level:
    """Describe the chart of a score."""
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
    return Level(**drawn | _OWN.get(name, {}))


def error_charts(selection: Selection) -> list[Chart]:
    """Chart each RMSE over the variables, a panel per filter, a colour per strategy.

    Worlds more than σ above the mean are single marks (Bradley & Abaid, Secs. V-C and V-D and
    Appendix A).
    """
    return _charts(selection, [one for one in levels() if "RMSE" in one.label])


def landmark_charts(selection: Selection) -> list[Chart]:
    """Chart how many landmarks are initialised, over the variables (Bradley & Abaid, Sec. V-E)."""
    return _charts(selection, [one for one in levels() if one.score == LANDMARKS])


def level_charts(selection: Selection) -> list[Chart]:
    """Chart every level over each variable; without one, over the filters."""
    return _charts(selection, levels())


def _charts(selection: Selection, levels: Sequence[Level]) -> list[Chart]:
    """Chart those levels that have numbers, over each variable."""
    axes = selection.study.variables or (None,)
    there = [what for what in levels if has_numbers(selection.study, what.score)]
    return [_chart(selection, what, variable) for variable in axes for what in there]


def _chart(selection: Selection, what: Level, variable: Variable | None) -> Chart:
    """Chart one level over one variable."""
    study = selection.study
    axis = axis_of(variable) if variable else axis_of_words([*filter_titles(study).values()])
    facets = facets_of(study, variable, axis)
    found = [_drawn(selection, what, facet, axis) for facet in facets]
    lines = [s for drawn in found for s in drawn if not MARKS[s.style].pinned]
    vertical = _vertical(what, lines)
    name, title = what.name, what.title
    if variable and len(study.variables) > 1:
        name, title = f"{name}_by_{slug(variable.name)}", f"{title}, over {with_article(variable)}"
    return Chart(
        name=name,
        title=title,
        caption=_many(study, what, variable)
        if variable and facets[0].many
        else _caption(what, variable),
        panels=tuple(
            Panel(title=facet.title, role=facet.role, x=axis, y=vertical, series=tuple(series))
            for facet, series in zip(facets, found, strict=True)
        ),
        columns=(variable.column if variable else "filter", what.column),
    )


def _vertical(what: Level, lines: Sequence[Series]) -> Axis:
    """Return the axis of a level, the same in all panels."""
    if what.log:
        return log_axis(what.label, ends(lines))
    room = 1.07 if what.worlds else 1.0
    return linear_axis(what.label, [room * end for end in ends(lines)], floor=0.0)


def _many(study: Study, what: Level, variable: Variable) -> str:
    """Say what a chart of many lines shows."""
    mean = "Geometric mean" if what.log else "Mean"
    dashed = f"; dashed: {'the bound' if what.named == 'bound' else what.named}"
    more = "" if what.more == BOUND else what.more
    lines = each_combination(study, variable)
    return f"{mean} over worlds; {lines}{dashed if what.beside else ''}{more}"


def _caption(what: Level, variable: Variable | None) -> str:
    """Say what a chart shows."""
    words = what.caption
    if what.worlds:
        words += PASSIVE if variable and variable.name == BEAM else ""
        words += ", triangles: those beyond the panel"
    return words + what.more


def _drawn(selection: Selection, what: Level, facet: Facet, axis: Axis) -> list[Series]:
    """Draw the lines of a panel, single worlds above each, and the dashed bound."""
    found, apart = [], axis.words and not facet.many
    for line in facet.lines:
        at = selection.study.trials[line.way].at[line.cells]
        flat = len(at) > 1 and what.score != COMMON and bool(np.all(at == at[0]))
        per_place = [what.scale * sample for sample in _samples(selection, line, what.score)]
        style = "points" if apart else ("line" if flat else "dots")
        mean = _mean_line(line, per_place, style, log=what.log)
        found.append(replace(mean, low=None, high=None) if facet.many else mean)
        if what.worlds and not facet.many:
            found.append(_worlds_above(line, mean, per_place, flat=flat))
        if what.beside:
            found.append(_dashed(selection, line, what, apart=apart))
    return found


def _samples(selection: Selection, line: Line, score: str) -> list[Float[np.ndarray, " m"]]:
    """Return a score's values over the worlds, at each place of a line."""
    return [samples(selection, score, [(*line.way, int(i))])[0] for i in line.cells]


def _moments(
    per_place: Sequence[Float[np.ndarray, " m"]], *, log: bool
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return the mean at each place, and one standard deviation below and above it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        values = [np.log(sample[sample > 0.0]) if log else sample for sample in per_place]
    mean, std = np.array([mean_std(sample) for sample in values]).T
    low, high = mean - std, mean + std
    return (np.exp(mean), np.exp(low), np.exp(high)) if log else (mean, low, high)


def _mean_line(
    line: Line, per_place: Sequence[Float[np.ndarray, " m"]], style: str, *, log: bool
) -> Series:
    """Return mean ± σ along the axis; points beside each other where it has words."""
    mean, low, high = _moments(per_place, log=log)
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
    """Return the worlds above the band of a line."""
    top = np.array([np.nan]) if mean.high is None else mean.high
    above = [sample[sample > end] for sample, end in zip(per_place, top, strict=True)]
    at = line.aside
    if flat:
        above, at = above[:1], EDGE * line.x[-1:]
    return Series(
        name=f"{line.name}, worlds above σ",
        role=line.way[1],
        x=np.repeat(at, [len(values) for values in above]),
        y=np.concatenate(above),
        style="marks",
        strength=0.55,
    )


def _dashed(selection: Selection, line: Line, what: Level, *, apart: bool) -> Series:
    """Return the dashed line beside a level: a mean over the worlds that count."""
    beneath = [what.scale * mean_std(one)[0] for one in _samples(selection, line, what.beside)]
    return Series(
        name=f"{line.name}, {what.named}",
        role=line.way[1],
        x=line.aside if apart else line.x,
        y=np.array(beneath),
        style="levels" if apart else "line",
        strength=line.strength,
        dashed=not apart,
    )
