"""Effects as clauses: what raises what, by how much, and what would have been seen."""

from collections.abc import Mapping, Sequence

from pipistrelle.evaluation.comparison import Finding
from pipistrelle.report.effects.comparing import FILTER, STRATEGY, Effect, resolvable
from pipistrelle.report.effects.measures import Measure
from pipistrelle.report.numbers import amount, interval, listed
from pipistrelle.report.studied import Study, filter_titles
from pipistrelle.report.variables import BEAM, Variable

VERBS = {1: "raises", -1: "lowers"}


def variable_of(study: Study, effect: Effect) -> Variable | None:
    """Find the variable of an effect.

    Parameters
    ----------
    study : Study
    effect : Effect

    Returns
    -------
    Variable or None
        None where strategies or filters are compared.
    """
    return next((v for v in study.variables if v.name == effect.contrast.factor), None)


def direction(finding: Finding) -> int:
    """Tell in which direction an effect is shown.

    Parameters
    ----------
    finding : Finding

    Returns
    -------
    1, -1, or 0 where none is
    """
    return {True: 1, False: -1, None: 0}[finding.holds]


def size(finding: Finding, unit: str, *, signed: bool = False) -> str:
    """Write how large a difference is, with its interval.

    Parameters
    ----------
    finding : Finding
    unit : one of `numbers.UNITS`
    signed : bool
        As it is, rather than the size of a rise or of a fall.

    Returns
    -------
    str

    Examples
    --------
    >>> import numpy as np
    >>> from pipistrelle.evaluation.comparison import Statement, judge
    >>> (fall,) = judge([Statement(label="", sample=-np.array([0.3, 0.4, 0.5]))])
    >>> size(fall, "m"), size(fall, "m", signed=True)
    ('0.4 m [0.152, 0.648]', '−0.4 m [−0.648, −0.152]')
    """
    mean, (low, high) = finding.mean, finding.family
    if not signed and mean < 0.0:
        mean, low, high = -mean, -high, -low
    return f"{amount(mean, unit)} {interval((low, high), unit)}"


def the(variable: Variable) -> str:
    """Name a variable among words.

    Parameters
    ----------
    variable : Variable

    Returns
    -------
    str
    """
    return f"the {variable.name}" if variable.name == BEAM else variable.name


def subject(study: Study, effect: Effect) -> str:
    """Name what changes: the values of a variable, two strategies or two filters.

    Parameters
    ----------
    study : Study
    effect : Effect

    Returns
    -------
    str
    """
    contrast, variable = effect.contrast, variable_of(study, effect)
    if variable is None:
        sensing = " sensing" if contrast.factor == STRATEGY else ""
        return f"{contrast.after} instead of {contrast.before}{sensing}"
    said = f"{the(variable)} from {contrast.before} to {contrast.after}"
    if variable.numbers is None:
        said = f"{variable.name} = {contrast.after} instead of {contrast.before}"
    others = [the(other) for other in study.variables if other is not variable]
    return f"{said}, on average over {listed(others)}," if len(contrast.pairs) > 1 else said


def clauses(study: Study, effects: Sequence[Effect], beside: Mapping[Effect, Effect]) -> list[str]:
    """Say what two values of a variable do in one measure, strategy by strategy.

    Parameters
    ----------
    study : Study
    effects : sequence of Effect
        Of the same two values.
    beside : dict of Effect
        What is so without the cases that diverged.

    Returns
    -------
    list of str
        Sentences without capital and full stop, each of one strategy.
    """
    said: list[str] = []
    for effect in effects:
        unit = effect.measure.unit
        words = _KINDS[_kind(effect)].format(
            owner=owner(study, effect, noun=not said),
            size=size(effect.finding, unit),
            mean=amount(effect.finding.mean, unit),
            least=amount(resolvable(effect.finding), unit),
        )
        said.append(f"{'it' if said else subject(study, effect)} {words}")
        said += _otherwise(effect, beside.get(effect))
    return said


_KINDS = {
    "up": "raises {owner} by {size}",
    "down": "lowers {owner} by {size}",
    "open": "shows no effect on {owner} ({mean}, where {least} would have been shown)",
    "alike": "changes {owner} by {mean} in every world alike",
    "same": "leaves {owner} as it is, to the last digit",
    "few": "has too few worlds to tell of {owner}",
}
"""What is said of an effect, by its kind."""


def _kind(effect: Effect) -> str:
    """Tell what is to be said of an effect."""
    if effect.untouched:
        return "same"
    if effect.finding.n < 2:
        return "few"
    if not effect.finding.std > 0.0:
        return "alike"
    return {1: "up", -1: "down", 0: "open"}[direction(effect.finding)]


def owner(study: Study, effect: Effect, *, noun: bool) -> str:
    """Name whose error it is.

    Parameters
    ----------
    study : Study
    effect : Effect
    noun : bool
        With what it is; else what it is was said before.

    Returns
    -------
    str
    """
    contrast = effect.contrast
    if contrast.factor == FILTER:
        return f"the {effect.measure.title} of {contrast.strategy} sensing"
    title = filter_titles(study)[contrast.filter]
    whose = f"{contrast.strategy} {title}'s".strip()
    return f"{whose} {effect.measure.title}" if noun else whose


def in_between(study: Study, effects: Sequence[Effect]) -> list[str]:
    """Say what an inner value of a number does, where it is more than the ends tell.

    Parameters
    ----------
    study : Study
    effects : sequence of Effect
        In one measure, of one variable.

    Returns
    -------
    list of str
        A clause for each strategy that has such a value, on either side of the truth.
    """
    variable = variable_of(study, effects[0])
    if variable is None or variable.numbers is None:
        return []
    said = []
    for side in _sides(variable, effects):
        (end,) = (effect for effect in side if effect.contrast.end)
        inner = [effect for effect in side if effect is not end]
        low, high = min(0.0, end.finding.family[0]), max(0.0, end.finding.family[1])
        beyond = [
            effect
            for effect in inner
            if direction(effect.finding)
            and not (direction(end.finding) and low <= effect.finding.mean <= high)
        ]
        if beyond:
            most = max(beyond, key=lambda effect: abs(effect.finding.mean))
            more = "more" if most.finding.mean > 0.0 else "less"
            said.append(
                f"at {most.contrast.after} {owner(study, most, noun=False)} is "
                f"{size(most.finding, most.measure.unit)} {more} than at {most.contrast.before}"
            )
    return said


def _sides(variable: Variable, effects: Sequence[Effect]) -> list[list[Effect]]:
    """Part effects by strategy, and by the side of the value that they are compared with."""
    sides: dict[tuple[str, bool], list[Effect]] = {}
    for effect in effects:
        above = variable.words.index(effect.contrast.after) > variable.base
        sides.setdefault((effect.contrast.strategy, above), []).append(effect)
    return list(sides.values())


def elsewhere(study: Study, effects: Sequence[Effect]) -> list[str]:
    """Say where an effect is another than on average, at one combination of the rest.

    Parameters
    ----------
    study : Study
    effects : sequence of Effect
        In one measure, of the same two values.

    Returns
    -------
    list of str
        A clause for each strategy of which the opposite is shown somewhere, or anything where on
        average nothing is.
    """
    said = []
    for effect in effects:
        mean = direction(effect.finding)
        other = [
            (finding, name)
            for finding, name in zip(effect.apart, effect.contrast.names, strict=False)
            if direction(finding) and direction(finding) != mean
        ]
        if other:
            finding, name = max(other, key=lambda pair: abs(pair[0].mean))
            many = f" and at {len(other) - 1} more" if len(other) > 1 else ""
            verb, whose = VERBS[direction(finding)], owner(study, effect, noun=False)
            said.append(
                f"at {name}{many} it {verb} {whose} by {size(finding, effect.measure.unit)}"
            )
    return said


def besides(effects: Sequence[Effect], measures: Sequence[Measure]) -> str:
    """Say which of the other measures change, and in which direction.

    Parameters
    ----------
    effects : sequence of Effect
        Of one variable with one filter, between its ends.
    measures : sequence of Measure
        Those others.

    Returns
    -------
    str
        A sentence with a blank before it, or nothing.
    """
    changed = {verb: _changed(effects, measures, sign) for sign, verb in VERBS.items()}
    said = [f"{verb} {listed(what)}" for verb, what in changed.items() if what]
    return f" Besides, it {listed(said)}." if said else ""


def _changed(effects: Sequence[Effect], measures: Sequence[Measure], sign: int) -> list[str]:
    """Name the measures that change in one direction, and where not in all cases, in which."""
    found = []
    for measure in measures:
        mine = [effect for effect in effects if effect.measure is measure]
        moved = [effect for effect in mine if direction(effect.finding) == sign]
        if moved:
            which = f" ({', '.join(_cases(moved, mine))})" if len(mine) > len(moved) else ""
            found.append(f"the {measure.title}{which}")
    return found


def _cases(effects: Sequence[Effect], all_of: Sequence[Effect]) -> list[str]:
    """Name effects among others: their strategies, and of one that not all values move, these."""
    named = []
    for strategy in dict.fromkeys(effect.contrast.strategy for effect in effects):
        mine, every = (
            [effect.contrast.after for effect in some if effect.contrast.strategy == strategy]
            for some in (effects, all_of)
        )
        if strategy and len(mine) == len(every):
            named.append(strategy)
        else:
            named += [" ".join(filter(None, (strategy, value))) for value in mine]
    return named


def _otherwise(effect: Effect, other: Effect | None) -> list[str]:
    """Say what is so without the cases that diverged, where that is not the same."""
    if other is None or direction(other.finding) == direction(effect.finding) or effect.untouched:
        return []
    if other.finding.n < 2:
        return ["without diverged cases too few worlds are left"]
    shown = "" if direction(other.finding) else ", which is not shown"
    change = size(other.finding, effect.measure.unit, signed=True)
    return [f"without diverged cases the change is {change}{shown}"]
