"""Effects: two values of one variable in the same world, all else alike, over many worlds.

Every value is compared with the first: of numbers the least, of words the one listed first; of
what filters may assume wrongly, and of biases, with the truth. What else varies is averaged over,
world by world, and looked at one by one besides. Strategies and filters are compared in the same
way, the first of them with each other one. All contrasts of a variable with a filter are one
family for each measure (`pipistrelle.evaluation.comparison`): of numbers the ends, which are what
the answer speaks of, and the values between them another. What a variable does to the gain of
listening is compared alike: a gain is a measure, too (`measures.gains_of`).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.comparison import Finding, Statement, judge
from pipistrelle.report.effects.measures import Measure, cells_of, change, gains_of, measures_of
from pipistrelle.report.studied import (
    Cell,
    Rule,
    Selection,
    Study,
    Way,
    along,
    combination_name,
    filter_titles,
    kept,
)
from pipistrelle.report.variables import Variable

STRATEGY, FILTER = "strategy", "filter"
"""What a study compares beside its variables."""
Pair = tuple[Cell, Cell]


@dataclass(frozen=True, slots=True, kw_only=True)
class Contrast:
    """Two values of one variable, all else alike."""

    factor: str
    """The variable's name, `STRATEGY` or `FILTER`."""
    filter: str
    strategy: str
    """With which they are compared; empty for the one that is itself compared."""
    before: str
    after: str
    """The two values, as words."""
    end: bool = True
    """It is what the answer speaks of: of numbers the least or the greatest, of words any two."""
    pairs: tuple[Pair, ...]
    """One for each combination of the rest."""
    names: tuple[str, ...]
    """Of those combinations."""
    measures: tuple[Measure, ...]
    """What is compared; `measures.gains_of` where it is what the strategy gains."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """A contrast judged in one measure over the worlds."""

    contrast: Contrast
    measure: Measure
    finding: Finding
    """Of the mean over the combinations of the rest; of a ratio, of its logarithm."""
    untouched: bool
    """The two are the same to the last digit, in every world."""
    apart: tuple[Finding, ...]
    """At each of those combinations, a family of their own; empty where there is one."""


def contrasts_of(study: Study) -> tuple[Contrast, ...]:
    """List what a study compares.

    Returns: those of the variables, in their order, then strategies, then filters.
    """
    return (*_of_variables(study), *_of_strategies(study), *_of_filters(study))


def effects_of(selection: Selection) -> tuple[Effect, ...]:
    """Judge everything that a study compares, in every measure."""
    families: dict[tuple[Any, ...], list[Contrast]] = {}
    for one in contrasts_of(selection.study):
        family = one.factor, one.filter or one.strategy, one.end, one.measures
        families.setdefault(family, []).append(one)
    return tuple(
        effect
        for family in families.values()
        for measure in family[0].measures
        for effect in _judged(selection, family, measure)
    )


def families_of(study: Study, effects: Sequence[Effect]) -> dict[tuple[str, str], list[Effect]]:
    """Group effects by what is compared, and by the filter or the strategy with which.

    Returns: of a study that has variables, these alone: not strategies, nor filters.
    """
    families: dict[tuple[str, str], list[Effect]] = {}
    for effect in effects:
        contrast = effect.contrast
        if not study.variables or contrast.factor not in (STRATEGY, FILTER):
            family = contrast.factor, contrast.filter or contrast.strategy
            families.setdefault(family, []).append(effect)
    return families


def mean_change(
    selection: Selection, measure: Measure, pairs: Sequence[Pair]
) -> Float[np.ndarray, " m"]:
    """Average a change over some pairs of cases, in the worlds that have all of them.

    Returns: a number per world.
    """
    study = selection.study
    changes = np.array([change(study, measure, *pair) for pair in pairs])
    counts = kept(selection, [cell for pair in pairs for cell in cells_of(measure, *pair)])
    counts &= np.all(np.isfinite(changes), axis=0)
    return np.mean(changes[:, counts], axis=0)


def resolvable(finding: Finding) -> float:
    """Return the smallest effect that would have been significant.

    `finding`: an undecided one. Returns: half the width of its interval, in the sample's unit;
    infinite where nothing could be.
    """
    low, high = finding.family
    return (high - low) / 2.0


def record(by_rule: Mapping[Rule, Sequence[Effect]], headline: Rule) -> list[dict[str, Any]]:
    """Lay effects out for ``summary.json``.

    `by_rule`: the same effects under each exclusion rule. `headline`: by which the study is
    answered: the effect at each combination is given of this alone. Returns: a ratio's mean
    and intervals are ratios; what is not finite is None.
    """
    return [
        {
            "variable": one[0].contrast.factor,
            "filter": one[0].contrast.filter or None,
            "strategy": one[0].contrast.strategy or None,
            "from": one[0].contrast.before,
            "to": one[0].contrast.after,
            "measure": "gain_" * bool(one[0].measure.over) + one[0].measure.score,
            "unit": "ratio" if one[0].measure.ratio else one[0].measure.unit,
            "averaged_over": len(one[0].contrast.pairs),
            "by_exclusion": {
                rule: _plain_effect(effect) for rule, effect in zip(by_rule, one, strict=True)
            },
            "apart": _plain_apart(dict(zip(by_rule, one, strict=True))[headline]),
        }
        for one in zip(*by_rule.values(), strict=True)
    ]


def json_finding(finding: Finding, *, effect: bool = False, ratio: bool = False) -> dict[str, Any]:
    """Return a finding as JSON values.

    `effect`: its interval is the one that shows its size; else the one by which a claim is judged.
    `ratio`: its numbers are logarithms of ratios, and become these. Returns: what is not finite is
    None.
    """

    def size(value: float) -> float | None:
        return value if math.isfinite(value) else None

    def finite(value: float) -> float | None:
        return size(float(np.exp(value))) if ratio and math.isfinite(value) else size(value)

    return {
        "n": finding.n,
        "mean": finite(finding.mean),
        "std": size(finding.std),
        "alone": [finite(bound) for bound in finding.alone],
        "interval": [finite(bound) for bound in (finding.family if effect else finding.interval)],
        "p": size(finding.p),
    }


def _plain_effect(effect: Effect) -> dict[str, Any]:
    """Lay out what one exclusion rule makes of an effect."""
    ratio, finding = effect.measure.ratio, effect.finding
    would = math.nan if finding.holds is not None or effect.untouched else resolvable(finding)
    would = math.exp(would) if ratio and would < 700.0 else would
    return {
        **json_finding(finding, effect=True, ratio=ratio),
        "shown": finding.holds is not None,
        "untouched": effect.untouched,
        "would_have_shown": would if math.isfinite(would) else None,
    }


def _plain_apart(effect: Effect) -> list[dict[str, Any]]:
    """Return the effect at each combination of the other variables, as JSON values."""
    return [
        {"at": name}
        | json_finding(one, effect=True, ratio=effect.measure.ratio)
        | {"shown": one.holds is not None}
        for name, one in zip(effect.contrast.names, effect.apart, strict=False)
    ]


def _of_variables(study: Study) -> Iterator[Contrast]:
    """Compare the values of each variable in every strategy, and in what each gains over active."""
    measures, gains = measures_of(study), gains_of(study)
    for variable in study.variables:
        for name in filter_titles(study):
            ways = [(name, strategy) for strategy in STRATEGIES if (name, strategy) in study.trials]
            for way in ways:
                yield from _of_values(study, variable, [way], measures)
            over = name, "active"
            for way in ways:
                if over in ways and way != over:
                    yield from _of_values(study, variable, [way, over], gains)


def _of_values(
    study: Study, variable: Variable, ways: Sequence[Way], measures: tuple[Measure, ...]
) -> Iterator[Contrast]:
    """Compare every value of a variable with its first, or with the truth, in the first way.

    Two combinations are one where none of the ways tells them apart.
    """
    rows, base = along(study, variable), variable.base
    ends = range(len(rows)) if variable.numbers is None else (0, len(rows) - 1)
    at = np.array([study.trials[way].at[rows] for way in ways])
    if np.all(at == at[:, :1]):
        return  # passive sensing has no beam
    for j in (j for j in range(len(rows)) if j != base):
        cases = at[:, [base, j]].reshape(-1, rows.shape[1])
        first = np.sort(np.unique(cases, axis=1, return_index=True)[1])
        yield Contrast(
            factor=variable.name,
            filter=ways[0][0],
            strategy=ways[0][1],
            before=variable.words[base],
            after=variable.words[j],
            end=j in ends,
            pairs=tuple(
                ((*ways[0], int(rows[base, m])), (*ways[0], int(rows[j, m]))) for m in first
            ),
            names=tuple(combination_name(study, int(rows[base, m]), [variable]) for m in first),
            measures=measures,
        )


def _of_strategies(study: Study) -> Iterator[Contrast]:
    """Compare with each filter the first strategy with the others."""
    for name in filter_titles(study):
        first, *others = (way for way in STRATEGIES if (name, way) in study.trials)
        for other in others:
            pairs, names = _everywhere(study, (name, first), (name, other))
            yield Contrast(factor=STRATEGY, filter=name, strategy="", before=first, after=other,
                           pairs=pairs, names=names,
                           measures=measures_of(study))  # fmt: skip


def _of_filters(study: Study) -> Iterator[Contrast]:
    """Compare in each strategy the first filter with the others."""
    titles = filter_titles(study)
    for strategy in STRATEGIES:
        there = [name for name in titles if (name, strategy) in study.trials]
        for other in there[1:]:
            pairs, names = _everywhere(study, (there[0], strategy), (other, strategy))
            yield Contrast(factor=FILTER, filter="", strategy=strategy, before=titles[there[0]],
                           after=titles[other], pairs=pairs, names=names,
                           measures=measures_of(study))  # fmt: skip


def _everywhere(
    study: Study, before: tuple[str, str], after: tuple[str, str]
) -> tuple[tuple[Pair, ...], tuple[str, ...]]:
    """Pair the cases of two ways at every combination where they differ."""
    at = np.array([study.trials[way].at for way in (before, after)])
    numbers = np.sort(np.unique(at, axis=1, return_index=True)[1]).tolist()
    pairs = tuple(((*before, i), (*after, i)) for i in numbers)
    return pairs, tuple(combination_name(study, i) for i in numbers)


def _judged(selection: Selection, family: Sequence[Contrast], measure: Measure) -> Iterator[Effect]:
    """Judge a family of contrasts in one measure; contrasts without any change are left out."""
    samples = [mean_change(selection, measure, contrast.pairs) for contrast in family]
    untouched = [len(sample) > 0 and not sample.any() for sample in samples]
    means = _findings(samples, untouched)
    apart = [
        [mean_change(selection, measure, [pair]) for pair in contrast.pairs]
        if len(contrast.pairs) > 1
        else []
        for contrast in family
    ]
    flat = [sample for each in apart for sample in each]
    singles = iter(_findings(flat, [len(one) > 0 and not one.any() for one in flat]))
    for contrast, finding, same, each in zip(family, means, untouched, apart, strict=True):
        yield Effect(
            contrast=contrast,
            measure=measure,
            finding=finding,
            untouched=same,
            apart=tuple(next(singles) for _ in each),
        )


def _findings(
    samples: Sequence[Float[np.ndarray, " m"]], untouched: Sequence[bool]
) -> list[Finding]:
    """Judge samples as one family; samples of zeros are left out."""
    statements = [Statement(label="", sample=sample) for sample in samples]
    touched = [one for one, same in zip(statements, untouched, strict=True) if not same]
    judged = iter(judge(touched))
    return [
        judge([one])[0] if same else next(judged)
        for one, same in zip(statements, untouched, strict=True)
    ]
