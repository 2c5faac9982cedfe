"""The answer to a study's own question: what each variable does to the position RMSE.

The answer is a line, and for each variable a sentence with its largest effect. All other numbers
are rows of the tables of effects and of cases.
"""

from collections.abc import Mapping, Sequence

from pipistrelle.config import STRATEGIES
from pipistrelle.report.effects.comparing import FILTER, STRATEGY, Effect, families_of
from pipistrelle.report.effects.levels import error_of
from pipistrelle.report.effects.measures import is_first
from pipistrelle.report.effects.wording import VERBS, direction, sentence, with_article
from pipistrelle.report.numbers import listed
from pipistrelle.report.studied import POSITION, Rule, Selection, Study, filter_titles
from pipistrelle.report.variables import BEAM, Variable, two_sided

HEADLINE: Rule = "none"
"""The answer leaves out nothing: what a setting makes diverge is part of what it does."""
OTHERWISE: Rule = "case"
"""Without diverged cases: an effect that then changes its direction has a second row."""


def question(study: Study) -> str:
    """Return the question that a study answers, in words."""
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
    """Answer a study's question, given its effects under the rule `HEADLINE`.

    The first line stands alone; a sentence for each variable follows, or else one for strategies
    and one for filters.
    """
    study = selection.study
    families = families_of(study, effects)
    lines = [_headline(study, v, families) for v in study.variables] or _compared(families)
    if not lines:
        lines = [error_of(selection, next(iter(study.trials))) or "Not decided: no world is left"]
    by_factor: dict[str, list[Effect]] = {}
    for (factor, _), family in families.items():
        by_factor.setdefault(factor, []).extend(family)
    largest = [effect for family in by_factor.values() if (effect := _largest(family))]
    return [_sentenced("; ".join(lines)), *(_sentenced(sentence(study, one)) for one in largest)]


def _largest(family: Sequence[Effect]) -> Effect | None:
    """Find the largest effect on the position RMSE: if possible shown, and from end to end."""
    known = [effect for effect in family if is_first(effect.measure) and effect.finding.n > 1]
    return max(
        known,
        key=lambda effect: (
            bool(direction(effect.finding)),
            effect.contrast.end,
            abs(effect.finding.mean),
        ),
        default=None,
    )


def _sentenced(words: str) -> str:
    """Begin and end words as a sentence does; the name of a setting stays as it is."""
    is_setting = "." in words.split()[0]
    return f"{words[0] if is_setting else words[0].upper()}{words[1:].rstrip('.')}."


def _headline(
    study: Study, variable: Variable, families: Mapping[tuple[str, str], Sequence[Effect]]
) -> str:
    """Say in a line what a variable does to the position RMSE."""
    named = [family for (factor, _), family in families.items() if factor == variable.name]
    of_variable = [effect for family in named for effect in family]
    ends = [effect for effect in of_variable if effect.contrast.end and is_first(effect.measure)]
    if not ends:
        return f"nothing that was heard depends on {with_article(variable)}"
    if few := _few(ends):
        return few
    several = two_sided(variable) or (variable.numbers is None and len(variable.given) > 2)
    if (
        words_found := _by_value(variable, ends)
        if several
        else _by_direction(study, variable, ends)
    ):
        return words_found + _of_gain(of_variable, several)
    if any(is_first(effect.measure) and direction(effect.finding) for effect in of_variable):
        words = (
            f"{with_article(variable)} changes the position RMSE, but no effect from end to end is "
            "shown"
        )
        return words + _of_gain(of_variable, several)
    moved = [effect.measure.title for effect in of_variable if direction(effect.finding)]
    if others := list(dict.fromkeys(moved)):
        of = f"no effect of {with_article(variable)} on the position RMSE is shown"
        return f"{of}, but one on the {listed(others)}"
    return f"no effect of {with_article(variable)} is shown"


def _of_gain(effects: Sequence[Effect], several: bool) -> str:
    """Add to a line what a variable does to the gain of listening, where that is shown."""
    gains = [
        e for e in effects if e.contrast.end and e.measure.over and e.measure.score == POSITION
    ]
    verbs = {VERBS[sign] for sign in (direction(e.finding) for e in gains) if sign}
    if not verbs:
        return ""
    title = f"the {gains[0].measure.title}"
    if several:
        return f", and {title} changes"
    return f", and {verbs.pop() if len(verbs) == 1 else 'changes'} {title}"


def _few(effects: Sequence[Effect]) -> str:
    """Say that nothing is decided if fewer than two worlds are left."""
    most = max(effect.finding.n for effect in effects)
    left = "a single world is left" if most else "no world is left"
    return f"not decided: {left}" if most < 2 else ""


def _by_direction(study: Study, variable: Variable, ends: Sequence[Effect]) -> str:
    """Describe the effect of a larger value, or of the second of two words."""
    if variable.name == BEAM:
        what = "a wider beam"
    elif variable.numbers is None:
        what = f"{variable.name} = {variable.words[1]} instead of {variable.words[0]}"
    else:
        what = f"a {'lower' if variable.base else 'higher'} {variable.name}"
    moved = {sign: [e for e in ends if direction(e.finding) == sign] for sign in VERBS}
    parts = []
    for sign, some in moved.items():
        if some and len(some) == len(ends):
            return f"{what} {VERBS[sign]} the position RMSE"
        if some:
            that = "that" if parts else "the position RMSE"
            parts.append(f"{VERBS[sign]} {that} of {_whose(study, some, len(ends))}")
    return f"{what} {listed(parts)}" if parts else ""


def _by_value(variable: Variable, ends: Sequence[Effect]) -> str:
    """List the values that raise or lower the position RMSE against the reference value."""
    clauses = {}
    for sign, verb in VERBS.items():
        moved = [effect for effect in ends if direction(effect.finding) == sign]
        found = {effect.contrast.after for effect in moved}
        values = [word for word in variable.words if word in found]
        if values:
            count = sum(effect.contrast.after in found for effect in ends)
            those = f"{verb[:-1] if len(values) > 1 else verb} the position RMSE"
            some = f" in {len(moved)} of {count} cases" if len(moved) < count else ""
            clauses[verb] = f"{listed(values)} {those}{some}"
    if not clauses:
        return ""
    first = variable.words[variable.base]
    return f"{variable.name}: against {first}, {listed(list(clauses.values()))}"


def _whose(study: Study, effects: Sequence[Effect], count: int) -> str:
    """Name the cases whose errors change, or count them if they are many."""
    if len(effects) > 4:
        return f"{len(effects)} of {count} cases"
    titles = filter_titles(study)
    if len(titles) == 1:
        return f"{listed([effect.contrast.strategy for effect in effects])} sensing"
    return listed([f"{e.contrast.strategy} {titles[e.contrast.filter]}" for e in effects])


def _compared(families: Mapping[tuple[str, str], Sequence[Effect]]) -> list[str]:
    """Say in a line how strategies compare, or else filters."""
    for factor in (STRATEGY, FILTER):
        compared = [
            effect
            for (name, _), family in families.items()
            if name == factor
            for effect in family
            if is_first(effect.measure)
        ]
        if not compared:
            continue
        return [few] if (few := _few(compared)) else _decided(factor, compared)
    return []


def _decided(factor: str, effects: Sequence[Effect]) -> list[str]:
    """Say which of two strategies or filters is ahead, where that is shown."""
    clauses = []
    sensing = " sensing" if factor == STRATEGY else ""
    pairs = dict.fromkeys((e.contrast.before, e.contrast.after) for e in effects)
    for before, after in pairs:
        of_pair = [e for e in effects if (e.contrast.before, e.contrast.after) == (before, after)]
        for sign, verb in VERBS.items():
            moved = sum(direction(effect.finding) == sign for effect in of_pair)
            if moved:
                some = f" in {moved} of {len(of_pair)} cases" if moved < len(of_pair) else ""
                what = f"{after} instead of {before}{sensing}"
                clauses.append(f"{what} {verb} the position RMSE{some}")
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    return clauses or [f"no difference in position RMSE between {listed(names)}{sensing} is shown"]
