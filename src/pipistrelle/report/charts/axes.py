"""Variables as axes, and what else varies as panels or lines."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import STRATEGIES
from pipistrelle.figures.chart import Axis
from pipistrelle.report.effects.wording import with_article
from pipistrelle.report.numbers import listed
from pipistrelle.report.studied import Study, Way, along, combination_name, filter_titles
from pipistrelle.report.variables import BEAM, Variable, geometric, places

MOST_PANELS = 6
"""Further combinations become lines of one panel for each filter and strategy."""
SHORTEST = 8
"""Letters to which words are cut that stand side by side; longer ones are slanted."""
SLANTED_LETTERS = 12
"""To which slanted words are cut."""
MAX_LETTERS = 52
"""Of all that is written along an axis."""
ASIDE = {"active": 0.985, "fused": 1.015, "passive": 1.0}
"""Where a strategy stands beside its place along a logarithmic axis, as a share of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """The cases of one filter and strategy along an axis."""

    way: Way
    name: str
    """The strategy; where a panel is of one alone, the combination of the rest."""
    strength: float
    x: Float[np.ndarray, " k"]
    aside: Float[np.ndarray, " k"]
    """Their places, and those a little beside the other strategies'."""
    cells: Int[np.ndarray, " k"]
    """The numbers of their combinations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facet:
    """What one panel shows."""

    title: str
    role: str = "ink"
    """Of the panel."""
    lines: tuple[Line, ...]
    many: bool = False
    """Its lines are combinations of the rest, rather than strategies."""


def axis_of(variable: Variable) -> Axis:
    """Return the axis of a variable, with a tick at each value.

    Parameters
    ----------
    variable : Variable

    Returns
    -------
    Axis
        Logarithmic for beamwidths, and for numbers that are a geometric row.
    """
    at = places(variable).tolist()
    if variable.name == BEAM:
        degrees = (word.removesuffix("°") for word in variable.words)
        ticks = tuple(zip(at, degrees, strict=True))
        return Axis(
            label=variable.label, limits=(0.9 * at[0], 1.12 * at[-1]), log=True, ticks=ticks
        )
    named = tuple(zip(at, variable.words, strict=True))
    if variable.numbers is None:
        return replace(axis_of_words(variable.words), label=variable.label)
    log = geometric(variable.numbers)
    room = 0.06 * (at[-1] - at[0])
    limits = (at[0] - room, at[-1] + room)
    if log:
        ratio = (at[-1] / at[0]) ** 0.06
        limits = (at[0] / ratio, at[-1] * ratio)
    return Axis(
        label=variable.label, limits=limits, log=log, ticks=_thinned(named, limits, log=log),
        named=tuple((x, f"{variable.name} = {word}") for x, word in named),
    )  # fmt: skip


def axis_of_words(words: Sequence[str]) -> Axis:
    """Return an axis whose ticks are words.

    Examples
    --------
    >>> axis_of_words(["EKF", "FastSLAM 2.0"]).ticks
    ((0.0, 'EKF'), (1.0, 'FastSLAM 2.0'))
    """
    named = tuple((float(i), word) for i, word in enumerate(words))
    longest = MAX_LETTERS // len(named)
    slanted = longest < SHORTEST and max(map(len, words)) > longest
    longest = SLANTED_LETTERS if slanted else max(longest, 3)
    return Axis(
        label="",
        limits=(-0.6, len(named) - 0.4),
        ticks=tuple((i, _shortened(word, longest)) for i, word in named),
        named=named,
        words=True,
        slanted=slanted,
    )


def facets_of(study: Study, variable: Variable | None, axis: Axis) -> list[Facet]:
    """Split a study's cases into panels over one of its variables.

    `variable`: along the axis; none: the filters stand there. Returns: a panel per filter and
    combination of the rest, the strategies in it; where these would be many, a panel per filter and
    strategy, with the combinations in it.
    """
    titles = filter_titles(study)
    if variable is None:
        return [_of_filters(study, list(titles), axis)]
    rows, x = along(study, variable), places(variable)
    count = rows.shape[1]
    many = count > 1 and len(titles) * count > MOST_PANELS
    names = [combination_name(study, int(i), [variable]) for i in rows[0]]
    found = []
    for name, title in titles.items():
        ways = [(name, strategy) for strategy in STRATEGIES if (name, strategy) in study.trials]
        if many:
            found += [_of_way(study, way, title, names, rows, x) for way in ways]
            continue
        among = [strategy for _, strategy in ways]
        for j in range(count):
            lines = [_line(way, x, beside(axis, x, way[1], among), rows[:, j]) for way in ways]
            parts = [title, names[j]] if len(titles) > 1 or count == 1 else [names[j]]
            found.append(Facet(title=", ".join(filter(None, parts)), lines=tuple(lines)))
    return found


def beside(
    axis: Axis,
    x: Float[np.ndarray, " k"],
    strategy: str,
    among: Sequence[str] = STRATEGIES,
    far: float = 1.0,
) -> Float[np.ndarray, " k"]:
    """Shift a strategy's points a little along the axis, so that strategies do not overlap.

    `among`: the strategies there. `far`: how many times as far as single worlds stand.
    """
    middle = float(np.mean([ASIDE[one] for one in among if one in ASIDE] or [1.0]))
    share = far * (ASIDE.get(strategy, middle) - middle)
    if axis.log:
        return x * (1.0 + share)
    low, high = axis.limits
    return x + share * (12.0 if axis.words else 0.5 * (high - low))


def each_combination(study: Study, variable: Variable) -> str:
    """Describe lines, one for each combination of all variables but one.

    `variable`: along the axis.
    """
    others = [other for other in study.variables if other is not variable]
    first = combination_name(study, 0, [variable])
    what = (
        f"value of {with_article(others[0])}"
        if len(others) == 1
        else (f"combination of {listed([with_article(other) for other in others])}")
    )
    return f"a line for each {what}, that of {first} the strongest"


def slug(name: str) -> str:
    """Make part of a file's name.

    Examples
    --------
    >>> slug("beacon.level_db")
    'beacon_level_db'
    """
    return re.sub(r"\W+", "_", name)


def _line(
    way: Way,
    x: Float[np.ndarray, " k"],
    aside: Float[np.ndarray, " k"],
    cells: Int[np.ndarray, " k"],
) -> Line:
    """Return the line of a strategy among others."""
    return Line(way=way, name=way[1], strength=1.0, x=x, aside=aside, cells=cells)


def _of_filters(study: Study, names: Sequence[str], axis: Axis) -> Facet:
    """Put every way of a single combination into one panel, filter by filter."""
    only, at = np.zeros(1, dtype=int), np.arange(len(names), dtype=np.float64)
    among = [one for one in STRATEGIES if any(one == strategy for _, strategy in study.trials)]
    lines = [
        _line((name, strategy), at[[i]], beside(axis, at[[i]], strategy, among), only)
        for strategy in STRATEGIES
        for i, name in enumerate(names)
        if (name, strategy) in study.trials
    ]
    return Facet(title="", lines=tuple(lines))


def _of_way(
    study: Study,
    way: Way,
    title: str,
    names: Sequence[str],
    rows: Int[np.ndarray, "k m"],
    x: Float[np.ndarray, " k"],
) -> Facet:
    """Put the combinations of the rest into one panel, each once, the first the strongest."""
    at = study.trials[way].at[rows]
    first = np.sort(np.unique(at, axis=1, return_index=True)[1]).tolist()
    last = max(len(first) - 1, 1)
    lines = [
        Line(
            way=way,
            name=names[j],
            strength=1.0 - 0.75 * i / last,
            x=x,
            aside=x,
            cells=rows[:, j],
        )
        for i, j in enumerate(first)
    ]
    return Facet(title=f"{title}, {way[1]}", role=way[1], lines=tuple(lines), many=True)


def _thinned(
    named: Sequence[tuple[float, str]], limits: tuple[float, float], *, log: bool
) -> tuple[tuple[float, str], ...]:
    """Leave out ticks that would run into each other, never the first."""
    kept: list[tuple[float, str]] = []
    for value, word in named:
        if kept:
            ends = np.array([kept[-1][0], value])
            share = np.diff(np.log(ends) if log else ends)[0]
            share /= np.diff(np.log(limits) if log else limits)[0]
            if share * MAX_LETTERS < 0.5 * (len(word) + len(kept[-1][1])) + 1.0:
                continue
        kept.append((value, word))
    return tuple(kept)


def _shortened(word: str, most: int) -> str:
    """Leave out the middle of a long word."""
    if len(word) <= most:
        return word
    return f"{word[: most - most // 2 - 1]}…{word[len(word) - most // 2 :]}"
