"""Charts of differences in the same world: what a variable changes, and what listening gains."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.comparison import Finding, Statement, judge
from pipistrelle.figures.chart import Axis, Chart, Panel, Series, ends, linear_axis, log_axis
from pipistrelle.report.charts.axes import (
    axis_of,
    axis_of_words,
    beside,
    each_combination,
    slug,
)
from pipistrelle.report.effects.comparing import Effect, effects_of, families_of, mean_change
from pipistrelle.report.effects.measures import Measure, measures_of
from pipistrelle.report.effects.wording import with_article
from pipistrelle.report.numbers import UNITS
from pipistrelle.report.studied import (
    COMMON,
    POSITION,
    Selection,
    along,
    combination_name,
    filter_titles,
)
from pipistrelle.report.variables import Variable, places

GAINS = (("position", POSITION), ("map", COMMON))
DIFFERENCE = "active minus fused; open: not significant"


def effect_charts(selection: Selection) -> list[Chart]:
    """Chart what each variable changes with each filter, a panel per measure.

    Returns: without variables, what strategies and filters change.
    """
    study, titles = selection.study, filter_titles(selection.study)
    charts = []
    for (factor, whose), family in families_of(study, effects_of(selection)).items():
        variable = next((v for v in study.variables if v.name == factor), None)
        first = family[0].contrast.before
        words = (first, *dict.fromkeys(effect.contrast.after for effect in family))
        words = variable.words if variable else words
        axis = axis_of(variable) if variable else axis_of_words(words)
        at = dict(zip(words, places(variable) if variable else range(len(words)), strict=True))
        title = titles.get(whose, f"{whose} sensing")
        charts.append(
            Chart(
                name=f"effect_{slug(factor)}_{slug(whose)}",
                title=f"What {'the ' * ('.' not in factor)}{factor} changes, {title}",
                caption=_caption(family, first),
                panels=tuple(_panel(measure, family, axis, at) for measure in measures_of(study)),
                columns=(variable.column if variable else factor, "change"),
            )
        )
    return charts


def gain_charts(selection: Selection) -> list[Chart]:
    """Chart how much better fused is than active over each variable, paired over worlds."""
    study = selection.study
    return [_gain_chart(selection, variable) for variable in study.variables]


def about(
    name: str,
    role: str,
    x: Float[np.ndarray, " n"],
    mean: Float[np.ndarray, " n"],
    edges: Float[np.ndarray, "n 2"],
    filled: Sequence[bool],
) -> Series:
    """Return a series of points with error bars.

    `edges`: ends of the bars.
    """
    return Series(
        name=name,
        role=role,
        x=x,
        y=mean,
        low=edges[:, 0],
        high=edges[:, 1],
        style="points",
        filled=np.array(filled, dtype=bool),
    )


def _caption(family: Sequence[Effect], first: str) -> str:
    """Say what the differences are of."""
    mean = "averaged over the combinations of the rest, " if family[0].apart else ""
    return (
        f"Difference to {first} in the same world, {mean}mean over worlds and its 95 % interval as "
        "one of its family. Full: shown, by Holm's correction. Map: landmarks that both have "
        "placed. NEES: the ratio"
    )


def _panel(
    measure: Measure, family: Sequence[Effect], axis: Axis, at: Mapping[str, float]
) -> Panel:
    """Chart what changes in one measure, a series per strategy."""
    ways: dict[str, list[Effect]] = {}
    for effect in family:
        if effect.measure == measure:
            ways.setdefault(effect.contrast.strategy, []).append(effect)
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
    effects: Sequence[Effect],
) -> Series:
    """Return the differences of one strategy; the difference is 0 at the reference value."""
    measure, findings = effects[0].measure, [effect.finding for effect in effects]
    mean, edges = _bars(findings)
    mean, edges = np.append(0.0, mean), np.vstack(([np.nan, np.nan], edges))
    if measure.ratio:
        mean, edges = np.exp(mean), np.exp(edges)
    else:
        mean, edges = UNITS[measure.unit][0] * mean, UNITS[measure.unit][0] * edges
    x = np.array([at[effects[0].contrast.before], *(at[e.contrast.after] for e in effects)])
    shown = [True, *(finding.holds is not None for finding in findings)]
    x = beside(axis, x.astype(np.float64), strategy, among, far=1.0 if axis.words else 3.0)
    rising = np.argsort(x)
    shown = [shown[i] for i in rising]
    name, role = strategy or "difference", strategy or "ink"
    return about(name, role, x[rising], mean[rising], edges[rising], shown)


def _bars(findings: Iterable[Finding]) -> tuple[np.ndarray, np.ndarray]:
    """Return means, and the ends of each one's interval; NaN where there is none."""
    found = list(findings)
    edges = np.array([finding.family for finding in found]).reshape(-1, 2)
    edges[~np.isfinite(edges)] = np.nan
    return np.array([finding.mean for finding in found]), edges


def _gain_chart(selection: Selection, variable: Variable) -> Chart:
    """Chart the gain of fused over active along one variable."""
    study, axis = selection.study, axis_of(variable)
    panels = []
    for what, score in GAINS:
        found = {
            title: _gains(selection, name, score, variable)
            for name, title in filter_titles(study).items()
            if selection.gains[name, score]
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
    """Return a filter's gains along a variable, a series for each combination of the rest."""
    study = selection.study
    rows = along(study, variable)
    count, series = rows.shape[1], []
    for j in range(count):
        findings = [selection.gains[name, score][i] for i in rows[:, j]]
        mean, edges = _bars(findings)
        shown = [finding.holds is not None for finding in findings]
        one = about(DIFFERENCE, "fused", places(variable), mean, edges, shown)
        if count > 1:  # bars of so many would hide each other
            named = combination_name(study, int(rows[0, j]), [variable])
            faint = 1.0 - 0.75 * j / (count - 1)
            one = replace(one, name=named, style="dots", low=None, high=None, strength=faint)
        series.append(one)
    return [_mean_gains(selection, name, score, variable), *series] if count > 1 else series


def _mean_gains(selection: Selection, name: str, score: str, variable: Variable) -> Series:
    """Return a filter's gains along a variable, in the mean over the combinations of the rest."""
    measure = Measure(title="", score=score, unit="m")
    pairs = [
        [((name, "fused", i), (name, "active", i)) for i in row]
        for row in along(selection.study, variable).tolist()
    ]
    samples = [mean_change(selection, measure, at_value) for at_value in pairs]
    findings = judge([Statement(label="", sample=sample) for sample in samples])
    shown = [finding.holds is not None for finding in findings]
    mean, edges = _bars(findings)
    return about(f"mean, {DIFFERENCE}", "ink", places(variable), mean, edges, shown)
