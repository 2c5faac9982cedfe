"""Effects in words: a sentence for one effect, with one number and its interval."""

from pipistrelle.evaluation.comparison import Finding
from pipistrelle.report.effects.comparing import FILTER, STRATEGY, Effect
from pipistrelle.report.numbers import amount, interval, listed
from pipistrelle.report.studied import Study, filter_titles
from pipistrelle.report.variables import BEAM, Variable

VERBS = {1: "raises", -1: "lowers"}


def variable_of(study: Study, effect: Effect) -> Variable | None:
    """Find the variable of an effect; None where strategies or filters are compared."""
    return next((v for v in study.variables if v.name == effect.contrast.factor), None)


def direction(finding: Finding) -> int:
    """Return 1 or -1 where a rise or a fall is shown, else 0."""
    return {True: 1, False: -1, None: 0}[finding.holds]


def with_article(variable: Variable) -> str:
    """Name a variable within a sentence: the beamwidth takes an article, a setting takes none."""
    return f"the {variable.name}" if variable.name == BEAM else variable.name


def sentence(study: Study, effect: Effect) -> str:
    """Say what one effect is, with its size and interval; end without a full stop."""
    change, owner = _subject(study, effect), _owner(study, effect)
    finding, unit = effect.finding, effect.measure.unit
    if effect.untouched:
        return f"{change} leaves {owner} as it is, to the last digit"
    if finding.n < 2:
        return f"{change} has numbers of too few worlds to tell of {owner}"
    sign, worlds = direction(finding), len(study.worlds)
    if finding.n < worlds:
        owner = f"{owner}, in the {finding.n} of {worlds} worlds that have a number,"
    if not finding.std > 0.0:
        return f"{change} changes {owner} by {amount(finding.mean, unit)} in every world alike"
    if sign:
        return f"{change} {VERBS[sign]} {owner} by {_size(finding, unit, sign)}"
    return f"{change} shows no effect on {owner}; the change is {_size(finding, unit, 1)}"


def _size(finding: Finding, unit: str, sign: int) -> str:
    """Write how large a difference is, with its interval, both times a sign."""
    low, high = sorted(sign * end for end in finding.family)
    return f"{amount(sign * finding.mean, unit)} {interval((low, high), unit)}"


def _subject(study: Study, effect: Effect) -> str:
    """Name what changes: the values of a variable, two strategies or two filters."""
    contrast, variable = effect.contrast, variable_of(study, effect)
    if variable is None:
        sensing = " sensing" if contrast.factor == STRATEGY else ""
        return f"{contrast.after} instead of {contrast.before}{sensing}"
    words = f"{with_article(variable)} from {contrast.before} to {contrast.after}"
    if variable.numbers is None:
        words = f"{variable.name} = {contrast.after} instead of {contrast.before}"
    others = [with_article(other) for other in study.variables if other is not variable]
    return f"{words}, on average over {listed(others)}," if len(contrast.pairs) > 1 else words


def _owner(study: Study, effect: Effect) -> str:
    """Name a measure and whose it is."""
    contrast, title = effect.contrast, effect.measure.title
    if contrast.factor == FILTER:
        return f"the {title} of {contrast.strategy} sensing"
    return f"{contrast.strategy} {filter_titles(study)[contrast.filter]}'s".strip() + f" {title}"
