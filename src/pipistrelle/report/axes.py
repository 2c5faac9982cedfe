"""Axes of charts from variables, and panels and lines from the other variables."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import STRATEGIES
from pipistrelle.figures.chart import Axis
from pipistrelle.report.study import Study, Way, along, combination_name, filter_titles
from pipistrelle.report.variables import BEAM, Variable, geometric, listed, places, with_article

MOST_PANELS = 6
"""Most panels of combinations; more combinations become lines of a panel per strategy."""
SHORTEST = 8
"""Fewest letters of an upright word; words that would be shorter are slanted."""
SLANTED_LETTERS = 12
"""Most letters of a slanted word."""
MAX_LETTERS = 52
"""Letters that fit along an axis."""
ASIDE = {"active": 0.985, "fused": 1.015, "passive": 1.0}
"""Factors by which strategies are shifted along a logarithmic axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line in a chart: the cases of a filter and strategy along the horizontal axis."""

    way: Way
    name: str
    """The strategy, or the combination if the panel has a single strategy."""
    strength: float = 1.0
    x: Float[np.ndarray, " k"]
    aside: Float[np.ndarray, " k"]
    """Positions along the axis, and positions shifted from the other strategies."""
    cells: Int[np.ndarray, " k"]
    """Numbers of the combinations."""


Facet = tuple[str, list[Line]]
"""Title and lines of one panel."""


def axis_of(variable: Variable) -> Axis:
    """Return the chart axis for a variable of a study, with a tick at each value.

    Returns: logarithmic for beamwidths and for geometric series.
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
    """Return a chart axis with words as ticks; long words are slanted or shortened."""
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


def facets_of(study: Study, variable: Variable | None, axis: Axis) -> tuple[list[Facet], bool]:
    """Split a study's cases into chart panels with lines over a variable, or over the filters.

    Returns: a panel per filter and combination of the other variables with the strategies as
    lines; if these are more than `MOST_PANELS`, a panel per filter and strategy with a line per
    distinct combination, the first strongest. And whether the lines are combinations.
    """
    titles, trials = filter_titles(study), study.trials
    if variable is None:
        at = np.arange(len(titles), dtype=np.float64)
        among = [one for one in STRATEGIES if any(one == way for _, way in trials)]
        lines = [
            Line(
                way=(name, strategy),
                name=strategy,
                x=at[[i]],
                aside=beside(axis, at[[i]], strategy, among),
                cells=np.zeros(1, dtype=int),
            )
            for strategy in STRATEGIES
            for i, name in enumerate(titles)
            if (name, strategy) in trials
        ]
        return [("", lines)], False
    rows, x = along(study, variable), places(variable)
    count = rows.shape[1]
    many = count > 1 and len(titles) * count > MOST_PANELS
    names = [combination_name(study, int(i), [variable]) for i in rows[0]]
    facets: list[Facet] = []
    for name, title in titles.items():
        among = [strategy for strategy in STRATEGIES if (name, strategy) in trials]
        for strategy in among if many else ():
            at = trials[name, strategy].at[rows]
            first = np.sort(np.unique(at, axis=1, return_index=True)[1]).tolist()
            last = max(len(first) - 1, 1)
            look = {"way": (name, strategy), "x": x, "aside": x}
            lines = [
                Line(name=names[j], strength=1.0 - 0.75 * i / last, cells=rows[:, j], **look)
                for i, j in enumerate(first)
            ]
            facets.append((f"{title}, {strategy}", lines))
        for j in () if many else range(count):
            lines = [
                Line(
                    way=(name, strategy),
                    name=strategy,
                    x=x,
                    aside=beside(axis, x, strategy, among),
                    cells=rows[:, j],
                )
                for strategy in among
            ]
            parts = [title, names[j]] if len(titles) > 1 or count == 1 else [names[j]]
            facets.append((", ".join(filter(None, parts)), lines))
    return facets, many


def beside(
    axis: Axis,
    x: Float[np.ndarray, " k"],
    strategy: str,
    among: Sequence[str] = STRATEGIES,
    far: float = 1.0,
) -> Float[np.ndarray, " k"]:
    """Shift a strategy's points along the axis, so that the strategies do not overlap.

    `among`: all strategies shown. `far`: multiple of the shift of single worlds.
    """
    middle = float(np.mean([ASIDE[one] for one in among if one in ASIDE] or [1.0]))
    share = far * (ASIDE.get(strategy, middle) - middle)
    if axis.log:
        return x * (1.0 + share)
    low, high = axis.limits
    return x + share * (12.0 if axis.words else 0.5 * (high - low))


def each_combination(study: Study, variable: Variable) -> str:
    """Describe for a caption the lines of a chart that has a line per combination of variables."""
    others = [other for other in study.variables if other is not variable]
    first = combination_name(study, 0, [variable])
    what = (
        f"value of {with_article(others[0])}"
        if len(others) == 1
        else (f"combination of {listed([with_article(other) for other in others])}")
    )
    return f"a line for each {what}, that of {first} the strongest"


def slug(name: str) -> str:
    """Replace characters that are not letters or digits by underscores, for a file's name."""
    return re.sub(r"\W+", "_", name)


def _thinned(
    named: Sequence[tuple[float, str]], limits: tuple[float, float], *, log: bool
) -> tuple[tuple[float, str], ...]:
    """Remove axis ticks with a text that would overlap the text of the tick before."""
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
    """Replace the middle of a word by an ellipsis if it has more than `most` letters."""
    if len(word) <= most:
        return word
    return f"{word[: most - most // 2 - 1]}…{word[len(word) - most // 2 :]}"
