"""Effects as clauses: what raises what, by how much, and what would have been seen."""

from collections.abc import Mapping, Sequence

from pipistrelle.evaluation.comparison import Finding
from pipistrelle.report.effects.comparing import FILTER, STRATEGY, Effect, resolvable
from pipistrelle.report.effects.measures import MEASURES
from pipistrelle.report.numbers import amount, interval, listed
from pipistrelle.report.studied import Study, filter_titles
from pipistrelle.report.variables import BEAM, Variable

FIRST = MEASURES[0]
"""What sentences speak of; of the rest they say whether it changes."""
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
    """Write how large a difference is, with its own 95 % interval.

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
    mean, (low, high) = finding.mean, finding.alone
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


def clauses(study: Study, effects: Sequence[Effect], beside: Mapping[Effect, Effect]) -> str:
    """Say what two values of a variable do to the position's error, strategy by strategy.

    Parameters
    ----------
    study : Study
    effects : sequence of Effect
        On the position's error, of the same two values.
    beside : dict of Effect
        What is so without the cases that diverged.

    Returns
    -------
    str
        Verbs with their objects.
    """
    kinds: dict[str, list[Effect]] = {kind: [] for kind in _KINDS}
    for effect in effects:
        kinds[_kind(effect)].append(effect)
    said: list[str] = []
    for kind, mine in kinds.items():
        without = {effect: _otherwise(effect, beside.get(effect)) for effect in mine}
        objects = [
            _KINDS[kind][1].format(
                owner=owner(study, effect, noun=not said and not i),
                size=size(effect.finding, effect.measure.unit),
                mean=amount(effect.finding.mean, effect.measure.unit),
                least=amount(resolvable(effect.finding), effect.measure.unit),
                besides=f" ({without[effect]})" if without[effect] else "",
                otherwise=f"; {without[effect]}" if without[effect] else "",
            )
            for i, effect in enumerate(mine)
        ]
        if objects:
            said.append(_KINDS[kind][0].format(listed(objects)))
    return listed(said)


_KINDS = {
    "up": ("raises {}", "{owner} by {size}{besides}"),
    "down": ("lowers {}", "{owner} by {size}{besides}"),
    "open": (
        "shows no effect on {}",
        "{owner} ({mean}, where {least} would have been shown{otherwise})",
    ),
    "alike": ("changes {}", "{owner} by {mean} in every world alike"),
    "same": ("leaves {} as it is, to the last digit", "{owner}"),
    "few": ("has too few worlds to tell of {}", "{owner}"),
}
"""What is said of an effect, by its kind: of several, and of each."""


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
        On the position's error, of one variable.

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
        low, high = min(0.0, end.finding.alone[0]), max(0.0, end.finding.alone[1])
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
        On the position's error, of the same two values.

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


def besides(effects: Sequence[Effect]) -> str:
    """Say which of the other measures change, and in which direction.

    Parameters
    ----------
    effects : sequence of Effect
        Of one variable with one filter, between its ends.

    Returns
    -------
    str
        A sentence with a blank before it, or nothing.
    """
    told = {verb: _changed(effects, sign) for sign, verb in VERBS.items()}
    said = [f"{verb} {listed(what)}" for verb, what in told.items() if what]
    return f" Besides, it {listed(said)}." if said else ""


def _changed(effects: Sequence[Effect], sign: int) -> list[str]:
    """Name the measures that change in one direction, and where not in all cases, in which."""
    found = []
    for measure in MEASURES[1:]:
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


def _otherwise(effect: Effect, other: Effect | None) -> str:
    """Say what is so without the cases that diverged, where that is not the same."""
    if other is None or direction(other.finding) == direction(effect.finding) or effect.untouched:
        return ""
    if other.finding.n < 2:
        return "without diverged cases too few worlds are left"
    shown = "" if direction(other.finding) else ", not shown"
    return f"without diverged cases {size(other.finding, FIRST.unit, signed=True)}{shown}"
