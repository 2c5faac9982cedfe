"""The answer to a study's own question: what each variable does, in a line and a few sentences.

The line speaks of the position's error. Sentences say by how much each variable changes what
listening gains there, and the error itself; where nothing is shown, how little would have been.
"""

from collections.abc import Mapping, Sequence

from pipistrelle.config import STRATEGIES
from pipistrelle.evaluation.bound import IN_ONE_WORLD
from pipistrelle.report.effects.comparing import FILTER, STRATEGY, Effect, families_of
from pipistrelle.report.effects.levels import diverged, errors_of, times_the_bound
from pipistrelle.report.effects.measures import GAINS, MEASURES, Measure
from pipistrelle.report.effects.wording import (
    VERBS,
    besides,
    clauses,
    direction,
    elsewhere,
    in_between,
    size,
    the,
)
from pipistrelle.report.numbers import listed
from pipistrelle.report.studied import Rule, Selection, Study, filter_titles
from pipistrelle.report.variables import BEAM, Variable, two_sided

HEADLINE: Rule = "none"
"""What the answer leaves out: nothing, for what a setting makes diverge is part of what it does."""
OTHERWISE: Rule = "case"
"""What is so without the cases that diverged stands beside it, where it is another answer."""
FIRST = MEASURES[0]
"""What the line and the sentences speak of."""
MOST_VALUES = 4
"""Of words, that a sentence goes through."""
FEW_CASES = 6
"""Cases of which each is told what listening gains there; of more, the least and the most."""


def question(study: Study) -> str:
    """Put the question that a study asks.

    Parameters
    ----------
    study : Study

    Returns
    -------
    str
    """
    if study.variables:
        verb = "do" if len(study.variables) > 1 else "does"
        return f"What {verb} {listed([the(v) for v in study.variables])} change?"
    titles = list(filter_titles(study).values())
    ways = [way for way in STRATEGIES if any(way == strategy for _, strategy in study.trials)]
    if len(ways) > 1:
        return f"How do {listed(ways)} sensing compare?"
    if len(titles) > 1:
        return f"How do {listed(titles)} compare?"
    return f"How well does {titles[0]} locate the vehicle by {ways[0]} sensing?"


def answer(selection: Selection, by_rule: Mapping[Rule, Sequence[Effect]]) -> list[str]:
    """Answer it.

    Parameters
    ----------
    selection : Selection
        Under the rule `HEADLINE`.
    by_rule : dict of sequence of Effect
        The same effects under each exclusion rule.

    Returns
    -------
    list of str
        A line that stands alone, then sentences.
    """
    study, effects = selection.study, by_rule[HEADLINE]
    beside = dict(zip(effects, by_rule[OTHERWISE], strict=True))
    families = families_of(study, effects)
    levels = [] if study.variables else errors_of(selection)
    lines = [_headline(study, v, families) for v in study.variables] or _compared(families)
    lines = lines or [levels.pop(0) if levels else "Not decided: no world is left"]
    sentences = [
        said for those in (GAINS, MEASURES) for said in _each(study, families, beside, those)
    ]
    bound = [] if not study.variables else [*_gains(study, effects), *_bound(selection)]
    headline = _sentenced("; ".join(lines))
    return [headline, *levels, *sentences, *bound, *filter(None, [diverged(study)])]


def _gains(study: Study, effects: Sequence[Effect]) -> list[str]:
    """Say with each filter what listening adds to one's own calls: in each case, where few are."""
    said = []
    for effect in effects:
        contrast = effect.contrast
        listens = (contrast.before, contrast.after) == ("active", "fused")
        if not listens or effect.measure is not FIRST or effect.finding.n < 2:
            continue
        cases = sorted(zip(effect.apart, contrast.names, strict=False), key=lambda one: one[0].mean)
        each = [(at, size(found, FIRST.unit, signed=True)) for found, at in cases]
        words = clauses(study, [effect], {})
        if len(each) > FEW_CASES:
            least, most = each[0], each[-1]
            words += [
                f"the least is {least[1]} at {least[0]}",
                f"the most is {most[1]} at {most[0]}",
            ]
        else:
            words += [f"at {at} it changes by {change}" for at, change in each]
        said.append(" ".join(map(_sentenced, words)))
    return said


def _sentenced(words: str) -> str:
    """Begin and end words as a sentence does; the name of a setting stays as it is."""
    plain = "." in words.split()[0]
    return f"{words[0] if plain else words[0].upper()}{words[1:].rstrip('.')}."


def _each(
    study: Study,
    families: Mapping[tuple[str, str], Sequence[Effect]],
    beside: Mapping[Effect, Effect],
    measures: Sequence[Measure],
) -> list[str]:
    """Say what each variable does with each filter, of some measures the first at length."""
    chosen = ([one for one in family if one.measure in measures] for family in families.values())
    return [_sentences(study, family, beside, measures) for family in chosen if family]


def _sentences(
    study: Study,
    family: Sequence[Effect],
    beside: Mapping[Effect, Effect],
    measures: Sequence[Measure],
) -> str:
    """Say what a variable does with a filter."""
    first = [effect for effect in family if effect.measure is measures[0]]
    by_value: dict[str, list[Effect]] = {}
    for effect in first:
        if effect.contrast.end:
            by_value.setdefault(effect.contrast.after, []).append(effect)
    values = list(by_value.values())
    if len(values) > MOST_VALUES:
        values = sorted(values, key=_strength, reverse=True)[:MOST_VALUES]
    said = []
    for mine in values:
        said += [*clauses(study, mine, beside), *elsewhere(study, mine)]
    said += in_between(study, first)
    if len(values) < len(by_value):
        said.append(f"{len(by_value) - len(values)} more values are in the table")
    ends = [effect for effect in family if effect.contrast.end]
    return " ".join(map(_sentenced, said)) + besides(ends, measures[1:])


def _strength(effects: Sequence[Effect]) -> tuple[bool, float]:
    """Order values by whether anything of theirs is shown, then by how much."""
    sizes = [abs(effect.finding.mean) for effect in effects if direction(effect.finding)]
    return bool(sizes), max(sizes, default=0.0)


def _headline(
    study: Study, variable: Variable, families: Mapping[tuple[str, str], Sequence[Effect]]
) -> str:
    """Say in a line what a variable does to the position's error."""
    named = [family for (factor, _), family in families.items() if factor == variable.name]
    mine = [effect for family in named for effect in family]
    ends = [effect for effect in mine if effect.contrast.end and effect.measure is FIRST]
    if not ends:
        return f"nothing that was heard depends on {the(variable)}"
    if few := _few(ends):
        return few
    several = two_sided(variable) or (variable.numbers is None and len(variable.given) > 2)
    if said := _by_value(variable, ends) if several else _by_direction(study, variable, ends):
        return said + _of_gain(mine, several)
    if any(effect.measure is FIRST and direction(effect.finding) for effect in mine):
        words = (
            f"{the(variable)} changes the position error, but no effect from end to end is shown"
        )
        return words + _of_gain(mine, several)
    moved = {effect.measure.title for effect in mine if direction(effect.finding)}
    if others := [one.title for one in (*MEASURES, *GAINS) if one.title in moved]:
        of = f"no effect of {the(variable)} on the position error is shown"
        return f"{of}, but one on the {listed(others)}"
    return f"no effect of {the(variable)} is shown"


def _of_gain(effects: Sequence[Effect], several: bool) -> str:
    """Add to a line what a variable does to the gain of listening, where that is shown."""
    gains = (e.finding for e in effects if e.contrast.end and e.measure is GAINS[0])
    verbs = {VERBS[sign] for sign in map(direction, gains) if sign}
    if not verbs:
        return ""
    title = f"the {GAINS[0].title}"
    if several:
        return f", and {title} changes"
    return f", and {verbs.pop() if len(verbs) == 1 else 'changes'} {title}"


def _few(effects: Sequence[Effect]) -> str:
    """Say that nothing is decided, where there are not two worlds to decide it."""
    most = max(effect.finding.n for effect in effects)
    left = "a single world is left" if most else "no world is left"
    return f"not decided: {left}" if most < 2 else ""


def _by_direction(study: Study, variable: Variable, ends: Sequence[Effect]) -> str:
    """Say what another number does, or the second of two words."""
    if variable.name == BEAM:
        what = "a wider beam"
    elif variable.numbers is None:
        what = f"{variable.name} = {variable.words[1]} instead of {variable.words[0]}"
    else:
        what = f"a {'lower' if variable.base else 'higher'} {variable.name}"
    moved = {sign: [e for e in ends if direction(e.finding) == sign] for sign in VERBS}
    parts = []
    for sign, mine in moved.items():
        if mine and len(mine) == len(ends):
            return f"{what} {VERBS[sign]} the position error"
        if mine:
            that = "that" if parts else "the position error"
            parts.append(f"{VERBS[sign]} {that} of {_whose(study, mine, len(ends))}")
    return f"{what} {listed(parts)}" if parts else ""


def _by_value(variable: Variable, ends: Sequence[Effect]) -> str:
    """Say which of several values raise or lower it, against the first or the truth."""
    said = {}
    for sign, verb in VERBS.items():
        moved = [effect for effect in ends if direction(effect.finding) == sign]
        found = {effect.contrast.after for effect in moved}
        values = [word for word in variable.words if word in found]
        if values:
            count = sum(effect.contrast.after in found for effect in ends)
            those = f"{verb[:-1] if len(values) > 1 else verb} the position error"
            some = f" in {len(moved)} of {count} cases" if len(moved) < count else ""
            said[verb] = f"{listed(values)} {those}{some}"
    if not said:
        return ""
    first = variable.words[variable.base]
    return f"{variable.name}: against {first}, {listed(list(said.values()))}"


def _whose(study: Study, effects: Sequence[Effect], count: int) -> str:
    """Name whose errors change, where they are few."""
    if len(effects) > 4:
        return f"{len(effects)} of {count} cases"
    titles = filter_titles(study)
    if len(titles) == 1:
        return f"{listed([effect.contrast.strategy for effect in effects])} sensing"
    return listed([f"{e.contrast.strategy} {titles[e.contrast.filter]}" for e in effects])


def _compared(families: Mapping[tuple[str, str], Sequence[Effect]]) -> list[str]:
    """Say in a line how strategies compare, or else filters."""
    for factor in (STRATEGY, FILTER):
        mine = [
            effect
            for (name, _), family in families.items()
            if name == factor
            for effect in family
            if effect.measure is FIRST
        ]
        if not mine:
            continue
        return [few] if (few := _few(mine)) else _decided(factor, mine)
    return []


def _decided(factor: str, effects: Sequence[Effect]) -> list[str]:
    """Say which of two strategies or filters is ahead, where that is shown."""
    said = []
    sensing = " sensing" if factor == STRATEGY else ""
    pairs = dict.fromkeys((e.contrast.before, e.contrast.after) for e in effects)
    for before, after in pairs:
        mine = [e for e in effects if (e.contrast.before, e.contrast.after) == (before, after)]
        for sign, verb in VERBS.items():
            moved = sum(direction(effect.finding) == sign for effect in mine)
            if moved:
                some = f" in {moved} of {len(mine)} cases" if moved < len(mine) else ""
                what = f"{after} instead of {before}{sensing}"
                said.append(f"{what} {verb} the position error{some}")
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    return said or [f"no difference in position error between {listed(names)}{sensing} is shown"]


def _bound(selection: Selection) -> list[str]:
    """Say how near each filter comes to the bound."""
    said = []
    for name, title in filter_titles(selection.study).items():
        times, online = times_the_bound(selection, name)
        if times:
            when = " (of the path as it was believed at each time)" if online else ""
            said.append(f"{title}{when} {times}")
    lead = "In multiples of the bound, the least position error that the sound leaves to any"
    return (
        [f"{lead} estimator (root mean squares): {'; '.join(said)}. {IN_ONE_WORLD}"] if said else []
    )
