"""Effects: changes of a score between two values of a variable, in the same world.

Every value is compared with the reference: the least number, the first word, or the truth for
assumed settings and biases. Differences are averaged over the other variables in each world, and
judged at each combination as well. Strategies and filters are compared with the first of them in
the same way. The contrasts of a variable with one filter in one measure are a family; the values
between the ends of a number are another. Gains over active sensing are measures of their own.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.comparison import Contrast, Finding, Statement, contrasts, judge
from pipistrelle.evaluation.scores import POSITION, POSITION_ALIGNED, shown_in
from pipistrelle.report.study import (
    MAP,
    Cell,
    Rule,
    Selection,
    Study,
    Way,
    along,
    combination_name,
    filter_titles,
    has_numbers,
    kept,
    rmse_of,
    samples,
    values,
)
from pipistrelle.report.variables import Variable, amount, interval, listed, with_article

if TYPE_CHECKING:
    import polars as pl

STRATEGY, FILTER = "strategy", "filter"
"""Factors of a study besides its variables."""
HEADLINE: Rule = "none"
"""Rule of the answer: divergence caused by a setting is part of its effect."""
OTHERWISE: Rule = "case"
"""Rule of the second row of an effect whose direction changes without diverged cases."""
ANSWERED = {POSITION_ALIGNED: "aligned position RMSE", POSITION: "position RMSE"}
"""Scores of the answer. Without the rigid motion that is common to an estimate, cases compare."""
MOST_NAMES = 4
"""Most filters and strategies that an answer names."""
Pair = tuple[Cell, Cell]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """A score for the comparison of cases, or the gain in this score over active sensing."""

    title: str
    score: str
    """One of `study.READ`, or `study.COMMON`."""
    unit: str
    """One of `variables.UNITS`."""
    ratio: bool = False
    """Whether cases are compared by the ratio of their numbers."""
    over: str = ""
    """For a gain, the strategy with the score that the case's score is subtracted from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairing:
    """Pairs of cases that differ in a single factor: a variable, the strategy or the filter."""

    factor: str
    """Name of the variable, `STRATEGY` or `FILTER`."""
    filter: str = ""
    strategy: str = ""
    """Empty if it is itself the factor."""
    before: str
    after: str
    """The two values, as words."""
    end: bool = True
    """Whether the value is an end of a number, or a word."""
    pairs: tuple[Pair, ...]
    """A pair of cases for each combination of the other variables."""
    names: tuple[str, ...]
    """Names of these combinations."""
    measures: tuple[Measure, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """The change of a score between paired cases over the worlds, with its significance."""

    pairing: Pairing
    measure: Measure
    finding: Finding
    """Of the mean over the combinations; of a ratio's logarithm."""
    untouched: bool
    """Whether both cases are equal in every world."""
    apart: tuple[Finding, ...]
    """At each of several combinations, as a family."""


def measures_of(study: Study) -> tuple[Measure, ...]:
    """List the scores to compare: the position RMSE, then all others that have numbers."""
    return tuple(
        Measure(title=score.title, score=name, unit=score.unit, ratio=score.ratio)
        for name, score in shown_in("effects").items()
        if name == POSITION or has_numbers(study, name)
    )


def gains_of(study: Study) -> tuple[Measure, ...]:
    """List the gains over active sensing in each error score, positive if listening helps."""
    return tuple(
        replace(one, title=f"gain in {one.title} over active", over="active")
        for one in measures_of(study)
        if one.unit in ("m", "rad")
    )


def measured(
    selection: Selection, measure: Measure, before: Cell, after: Cell
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return a score, or the gain in it, of two cases in each world; NaN in excluded worlds.

    Ratios give logarithms. Map errors are taken over the landmarks that all cases with the same
    landmarks have placed.
    """
    study, cells = selection.study, [before, after]
    cells += [(name, measure.over, number) for name, _, number in cells if measure.over]
    first, second, *over = _numbers(study, measure.score, cells)
    with np.errstate(divide="ignore", invalid="ignore"):
        if over:
            first, second = over[0] - first, over[1] - second
        if measure.ratio:
            first, second = np.log(first), np.log(second)
    counts = kept(selection, cells)
    return np.where(counts, first, np.nan), np.where(counts, second, np.nan)


def _numbers(study: Study, score: str, cells: Sequence[Cell]) -> list[Float[np.ndarray, " n"]]:
    """Return a score of each case in all worlds; map errors over landmarks that all placed."""
    numbers: dict[Cell, Float[np.ndarray, " n"]] = {}
    for drawing in {study.drawing[number] for _, _, number in cells}:
        drawn = [cell for cell in cells if study.drawing[cell[2]] == drawing]
        if score != MAP or len(drawn) < 2:
            numbers |= {cell: values(study, score, cell) for cell in drawn}
            continue
        placed, off = [], []
        for name, strategy, number in drawn:
            trials = study.trials[name, strategy]
            placed.append(trials.placed[:, trials.at[number]])
            off.append(trials.off[:, trials.at[number]])
        shared = np.all(placed, axis=0)
        numbers |= {cell: rmse_of(one, shared) for cell, one in zip(drawn, off, strict=True)}
    return [numbers[cell] for cell in cells]


def compare(
    selection: Selection, measure: Measure, rows: Sequence[Sequence[Pair]]
) -> tuple[Contrast, ...]:
    """Compare pairs of cases, averaged over each row of pairs; the rows are a family of tests."""
    if not any(rows):
        return ()
    frame = _frame(selection, [(0, measure, pairs) for pairs in rows])
    return contrasts(frame, "level", ["row"], over=["combination"])


def _frame(
    selection: Selection, rows: Iterable[tuple[int, Measure, Sequence[Pair]]]
) -> "pl.DataFrame":
    """Return the scores of paired cases in each world as a table, the input of `contrasts`.

    `rows`: family, measure and pairs.
    """
    import polars as pl

    heads, columns, world = [], [], selection.study.worlds
    for row, (family, measure, pairs) in enumerate(rows):
        for i, pair in enumerate(pairs):
            for level, column in enumerate(measured(selection, measure, *pair)):
                heads.append((row, family, i, level))
                columns.append(column)
    index = np.repeat(np.array(heads), len(world), axis=0)
    names = ("row", "family", "combination", "level")
    frame = pl.DataFrame(index, schema=dict.fromkeys(names, pl.Int64))
    worlds = pl.Series("world", np.tile(world, len(heads)))
    return frame.with_columns(worlds, pl.Series("value", np.concatenate(columns)))


def pairings_of(study: Study) -> Iterator[Pairing]:
    """Yield the comparisons of a study: values of variables, gains, strategies and filters."""
    titles, measures, gains = filter_titles(study), measures_of(study), gains_of(study)
    strategies = {
        name: [way for way in STRATEGIES if (name, way) in study.trials] for name in titles
    }
    for variable in study.variables:
        for name, (first, *others) in strategies.items():
            for strategy in (first, *others):
                yield from _of_values(study, variable, [(name, strategy)], measures)
            for strategy in others if first == "active" else ():
                yield from _of_values(study, variable, [(name, strategy), (name, first)], gains)
    for name, (first, *others) in strategies.items():
        for after in others:
            head = {"factor": STRATEGY, "filter": name, "before": first, "after": after}
            yield _of_ways(study, (name, first), (name, after), **head)
    for strategy in STRATEGIES:
        first, *others = [name for name in titles if strategy in strategies[name]] or [""]
        for name in others:
            head = {"factor": FILTER, "before": titles[first], "after": titles[name]}
            yield _of_ways(study, (first, strategy), (name, strategy), strategy=strategy, **head)


def _of_values(
    study: Study, variable: Variable, ways: Sequence[Way], measures: tuple[Measure, ...]
) -> Iterator[Pairing]:
    """Pair the cases of each value of a variable with the cases of its reference value.

    Combinations whose cases are the same in all ways count once; a variable that changes no case,
    as the beam of passive sensing, gives nothing.
    """
    rows, base = along(study, variable), variable.base
    ends = range(len(rows)) if variable.numbers is None else (0, len(rows) - 1)
    at = np.array([study.trials[way].at[rows] for way in ways])
    for j in range(len(rows)) if np.any(at != at[:, :1]) else ():
        if j == base:
            continue
        cases = at[:, [base, j]].reshape(-1, rows.shape[1])
        first = np.sort(np.unique(cases, axis=1, return_index=True)[1])
        before, after = rows[base, first].tolist(), rows[j, first].tolist()
        yield Pairing(
            factor=variable.name,
            filter=ways[0][0],
            strategy=ways[0][1],
            before=variable.words[base],
            after=variable.words[j],
            end=j in ends,
            pairs=tuple(((*ways[0], a), (*ways[0], b)) for a, b in zip(before, after, strict=True)),
            names=tuple(combination_name(study, a, [variable]) for a in before),
            measures=measures,
        )


def _of_ways(study: Study, one: Way, other: Way, **fields: Any) -> Pairing:
    """Pair the cases of two filters or strategies at each combination of the variables."""
    at = np.array([study.trials[way].at for way in (one, other)])
    numbers = np.sort(np.unique(at, axis=1, return_index=True)[1]).tolist()
    return Pairing(
        **fields,
        pairs=tuple(((*one, i), (*other, i)) for i in numbers),
        names=tuple(combination_name(study, i) for i in numbers),
        measures=measures_of(study),
    )


def effects_of(selection: Selection) -> tuple[Effect, ...]:
    """Judge the significance of every comparison of a study, in every score."""
    import polars as pl

    families: dict[tuple[Any, ...], list[Pairing]] = {}
    for pairing in pairings_of(selection.study):
        name = pairing.factor, pairing.filter or pairing.strategy, pairing.end, pairing.measures
        families.setdefault(name, []).append(pairing)
    grouped = [
        [(measure, pairing) for pairing in family]
        for family in families.values()
        for measure in family[0].measures
    ]
    rows = [(number, *one) for number, family in enumerate(grouped) for one in family]
    if not rows:
        return ()
    frame = _frame(selection, [(number, m, pairing.pairs) for number, m, pairing in rows])
    aside = {"family": ["family"], "set_same_aside": True}
    means = contrasts(frame, "level", ["row"], over=["combination"], **aside)
    several = frame.filter(pl.col("combination").max().over("row") > 0)
    apart: dict[int, list[Finding]] = {}
    for contrast in contrasts(several, "level", ["row", "combination"], **aside):
        apart.setdefault(contrast.by["row"], []).append(contrast.finding)
    return tuple(
        Effect(
            pairing=pairing,
            measure=measure,
            finding=mean.finding,
            untouched=mean.same,
            apart=tuple(apart.get(row, ())),
        )
        for row, ((_, measure, pairing), mean) in enumerate(zip(rows, means, strict=True))
    )


def direction(finding: Finding) -> int:
    """Return the sign of a significant change: 1 for a rise, -1 for a fall, otherwise 0."""
    return {True: 1, False: -1, None: 0}[finding.holds]


def record(by_rule: Mapping[Rule, Sequence[Effect]], headline: Rule) -> list[dict[str, Any]]:
    """Return the effects of a study as entries of ``summary.json``.

    `by_rule`: the same effects under each exclusion rule. `headline`: the rule under which effects
    at single combinations are given. Ratios replace logarithms; None replaces numbers that are not
    finite.
    """
    rows = []
    for effects in zip(*by_rule.values(), strict=True):
        same = dict(zip(by_rule, effects, strict=True))
        pairing, measure, apart = effects[0].pairing, effects[0].measure, same[headline].apart
        rows.append(
            {
                "variable": pairing.factor,
                "filter": pairing.filter or None,
                "strategy": pairing.strategy or None,
                "from": pairing.before,
                "to": pairing.after,
                "measure": "gain_" * bool(measure.over) + measure.score,
                "unit": "ratio" if measure.ratio else measure.unit,
                "averaged_over": len(pairing.pairs),
                "by_exclusion": {rule: _plain_effect(effect) for rule, effect in same.items()},
                "apart": [
                    {"at": name}
                    | json_finding(finding, effect=True, ratio=measure.ratio)
                    | {"shown": finding.holds is not None}
                    for name, finding in zip(pairing.names, apart, strict=False)
                ],
            }
        )
    return rows


def _plain_effect(effect: Effect) -> dict[str, Any]:
    """Return an effect under a single exclusion rule as JSON values."""
    ratio, finding = effect.measure.ratio, effect.finding
    low, high = finding.family
    would = math.nan if finding.holds is not None or effect.untouched else (high - low) / 2.0
    would = math.exp(would) if ratio and would < 700.0 else would
    return {
        **json_finding(finding, effect=True, ratio=ratio),
        "shown": finding.holds is not None,
        "untouched": effect.untouched,
        "would_have_shown": would if math.isfinite(would) else None,
    }


def json_finding(finding: Finding, *, effect: bool = False, ratio: bool = False) -> dict[str, Any]:
    """Return a finding (mean, intervals, p) as JSON values; None if a number is not finite.

    `effect`: give Bonferroni's interval, not Holm's. `ratio`: convert logarithms to ratios.
    """

    def finite(value: float, *, ratio: bool = ratio) -> float | None:
        value = float(np.exp(value)) if ratio and math.isfinite(value) else value
        return value if math.isfinite(value) else None

    return {
        "n": finding.n,
        "mean": finite(finding.mean),
        "std": finite(finding.std, ratio=False),
        "alone": [finite(bound) for bound in finding.alone],
        "interval": [finite(bound) for bound in (finding.family if effect else finding.interval)],
        "p": finite(finding.p, ratio=False),
    }


def headline(subject: str, title: str, unit: str, contrast: Contrast, cases: int = 1) -> str:
    """Return a sentence on a change of a score: its direction, size and interval.

    `subject`: the two values, as "B instead of A". `title` and `unit`: of the score. `cases`: over
    which the change is averaged.
    """
    finding, mean_of = contrast.finding, f", averaged over {cases} cases" * (cases > 1)
    begin = subject[0].upper() + subject[1:]
    if finding.n < 2:
        left = "a single world is left" if finding.n else "no world is left"
        return f"{begin}: not decided, {left}{mean_of}."
    if contrast.same:
        return f"{begin} leaves the {title} the same to the last digit{mean_of}."
    if not finding.std > 0.0:
        size = amount(finding.mean, unit)
        return f"{begin} changes the {title} by {size} in every world{mean_of}."
    sign = direction(finding)
    low, high = sorted((sign or 1) * end for end in finding.family)
    size = f"{amount((sign or 1) * finding.mean, unit)} {interval((low, high), unit)}"
    if sign:
        return f"{begin} {'raises' if sign > 0 else 'lowers'} the {title} by {size}{mean_of}."
    return f"{begin}: no effect on the {title} was shown; the change is {size}{mean_of}."


def question(study: Study) -> str:
    """Return the question that a study answers, from its variables, strategies and filters."""
    if study.variables:
        verb = "do" if len(study.variables) > 1 else "does"
        return f"What {verb} {listed([with_article(v) for v in study.variables])} change?"
    titles = list(filter_titles(study).values())
    ways = [way for way in STRATEGIES if any(way == strategy for _, strategy in study.trials)]
    if len(ways) > 1:
        return f"How do {listed(ways)} sensing compare?"
    if len(titles) > 1:
        return f"How do {listed(titles)} compare?"
    return f"How well does {titles[0]} locate the vehicle by {ways[0]} sensing?"


def answer(selection: Selection, effects: Sequence[Effect]) -> list[str]:
    """Return the answer of a study: sentences per variable, else per strategy and filter.

    `effects`: under the rule `HEADLINE`. A sentence is the change of a score of `ANSWERED` between
    two values, averaged over everything else; of several values of a variable the largest shown.
    """
    study, sentences = selection.study, []
    for score in (name for name in ANSWERED if name == POSITION or has_numbers(study, name)):
        own = [e for e in effects if e.measure.score == score and not e.measure.over]
        for variable in study.variables:
            sentences.append(_of_variable(selection, variable, own))
        for factor in () if study.variables else (STRATEGY, FILTER):
            some = [effect for effect in own if effect.pairing.factor == factor]
            sentences += [sentence for _, sentence in _averaged(selection, some)]
        if study.variables or own:
            continue
        (way,) = study.trials
        (errors,) = samples(selection, score, [(*way, 0)])
        if not len(errors):
            return ["Not decided: no world is left."]
        (mean,) = judge([Statement(label="", sample=errors)])
        size = interval(mean.alone, "m") if mean.n > 1 else "in the one world"
        begin = f"{filter_titles(study)[way[0]]}'s {ANSWERED[score]} is {amount(mean.mean, 'm')}"
        sentences.append(f"{begin} {size} by {way[1]} sensing.")
    return [*dict.fromkeys(sentences)]


def _of_variable(selection: Selection, variable: Variable, effects: Sequence[Effect]) -> str:
    """Return the answer's sentence on a variable, for the value with the largest effect."""
    own = [effect for effect in effects if effect.pairing.factor == variable.name]
    if not own:
        return f"No measurement depends on {with_article(variable)}."
    ends, between = (
        _averaged(selection, [e for e in own if e.pairing.end is end], variable)
        for end in (True, False)
    )
    shown = [one for one in (*ends, *between) if direction(one[0])]
    return max(shown or ends, key=lambda one: (one[0].n, abs(one[0].mean)))[1]


def _averaged(
    selection: Selection, effects: Sequence[Effect], variable: Variable | None = None
) -> list[tuple[Finding, str]]:
    """Return a finding and a sentence for each pair of values, averaged over all other factors.

    The findings are a family. The sentence names the effects if they do not all agree with it.
    """
    groups: dict[tuple[str, str], list[Effect]] = {}
    for effect in effects:
        groups.setdefault((effect.pairing.before, effect.pairing.after), []).append(effect)
    pairs = [[pair for e in group for pair in e.pairing.pairs] for group in groups.values()]
    judged = compare(selection, effects[0].measure, pairs) if effects else ()
    answers = []
    for ((before, after), group), some, contrast in zip(groups.items(), pairs, judged, strict=True):
        sensing = " sensing" * (group[0].pairing.factor == STRATEGY)
        subject = f"{after} instead of {before}{sensing}"
        if variable is not None:
            subject = f"{with_article(variable)} from {before} to {after}"
            if variable.numbers is None:
                subject = f"{after} instead of {before} as {with_article(variable)}"
        title = ANSWERED[group[0].measure.score]
        sentence = headline(subject, title, "m", contrast, len(some))
        signs = {direction(effect.finding) for effect in group}
        if len(group) > 1 and signs != {direction(contrast.finding)}:
            sentence += f" {_shown_by(selection.study, group)}"
        answers.append((contrast.finding, sentence))
    return answers


def _shown_by(study: Study, group: Sequence[Effect]) -> str:
    """Return a sentence that lists the filters and strategies with a significant effect."""
    titles, parts = filter_titles(study), []
    for sign, verb in ((1, "rise"), (-1, "fall")):
        shown = [e.pairing for e in group if direction(e.finding) == sign]
        names = [f"{p.strategy} {titles.get(p.filter, 'sensing')}".strip() for p in shown]
        if len(names) > MOST_NAMES:
            names = [f"{len(names)} of {len(group)} filters and strategies"]
        parts += [f"{verb} with {listed(names)}"] if names else []
    if not parts:
        return "No single case shows it by itself."
    return f"It is shown to {listed(parts)}."
