"""Scores in which two cases of a study are compared, and what listening gains in each.

The scores are those that `evaluation.scores` shows among a report's effects. A gain is the error of
active sensing less that of a strategy that listens, in the same world.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.evaluation.scores import shown_in
from pipistrelle.report.studied import MAP, POSITION, Cell, Study, has_numbers, rmse_of, values


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """A score that is compared, or the gain in it."""

    title: str
    """As a sentence names it."""
    score: str
    """One of `studied.READ`, or `studied.COMMON`."""
    unit: str
    """One of `numbers.UNITS`."""
    ratio: bool = False
    """Two cases are compared by the ratio of their numbers, not by the difference."""
    over: str = ""
    """For a gain, the strategy whose score the case's own is subtracted from; else empty."""


def measures_of(study: Study) -> tuple[Measure, ...]:
    """List the scores in which a study's cases are compared: the position's, and all with numbers.

    The answer speaks of the first.
    """
    return tuple(
        Measure(title=score.title, score=name, unit=score.unit, ratio=score.ratio)
        for name, score in shown_in("effects").items()
        if name == POSITION or has_numbers(study, name)
    )


def gains_of(study: Study) -> tuple[Measure, ...]:
    """List the errors of which listening may gain some: above 0 where listening helps."""
    return tuple(
        replace(one, title=f"gain in {one.title} over active", over="active")
        for one in measures_of(study)
        if one.unit in ("m", "rad")
    )


def is_first(measure: Measure) -> bool:
    """Tell whether the answer speaks of a measure: the position's error."""
    return measure.score == POSITION and not measure.over


def cells_of(measure: Measure, before: Cell, after: Cell) -> list[Cell]:
    """List the cases of which a change is made: two, and of a gain those that it is over."""
    cells = [before, after]
    return cells + [(name, measure.over, number) for name, _, number in cells if measure.over]


def change(study: Study, measure: Measure, before: Cell, after: Cell) -> Float[np.ndarray, " n"]:
    """Return by how much a measure differs between two cases, world by world.

    Returns: after minus before; of a ratio its logarithm; NaN or infinite where one of them has no
    number. A map's error is that of the landmarks which all these cases have placed, as far as they
    met the same ones; of those that only one has placed, nothing can be compared.
    """
    first, second, *over = _numbers(study, measure.score, cells_of(measure, before, after))
    with np.errstate(divide="ignore", invalid="ignore"):
        if over:
            first, second = over[0] - first, over[1] - second
        return np.log(second) - np.log(first) if measure.ratio else second - first


def _numbers(study: Study, score: str, cells: Sequence[Cell]) -> list[Float[np.ndarray, " n"]]:
    """Return a score of cases; of maps, over the landmarks that all who met them have placed."""
    found: dict[Cell, Float[np.ndarray, " n"]] = {}
    for drawing in {study.drawing[number] for _, _, number in cells}:
        alike = [cell for cell in cells if study.drawing[cell[2]] == drawing]
        if score == MAP and len(alike) > 1:
            found |= zip(alike, _shared_maps(study, alike), strict=True)
        else:
            found |= {cell: values(study, score, cell) for cell in alike}
    return [found[cell] for cell in cells]


def _shared_maps(study: Study, cells: Sequence[Cell]) -> list[Float[np.ndarray, " n"]]:
    """Return the map RMSE of cases over the landmarks that all of them have placed."""
    placed, off = [], []
    for name, strategy, number in cells:
        trials = study.trials[name, strategy]
        placed.append(trials.placed[:, trials.at[number]])
        off.append(trials.off[:, trials.at[number]])
    shared = np.all(placed, axis=0)
    return [rmse_of(one, shared) for one in off]
