"""What is looked at in each trial: six numbers, each better or worse by itself, and gains.

`MEASURES` is the only list of them: table, figures, sentences and summary follow. A gain is the
error of active sensing less that of a strategy that listens, in the same world.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.report.studied import (
    HEADING,
    HEADING_BOUND,
    MAP,
    POSITION,
    POSITION_ALIGNED,
    POSITION_BOUND,
    Cell,
    Study,
    rmse_of,
    values,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """One number of a trial.

    Attributes
    ----------
    title : str
        In a sentence.
    score : one of `studied.SCORES`
    unit : one of `numbers.UNITS`
    ratio : bool
        Two cases are compared by the ratio of their numbers, not by the difference.
    bound : one of `studied.SCORES`, or nothing
        The least that any estimator has.
    over : strategy, or nothing
        The number is a gain: this strategy's, less the case's own.
    """

    title: str
    score: str
    unit: str
    ratio: bool = False
    bound: str = ""
    over: str = ""


MEASURES = (
    Measure(title="position error", score=POSITION, unit="m", bound=POSITION_BOUND),
    Measure(title="aligned position error", score=POSITION_ALIGNED, unit="m"),
    Measure(title="heading error", score=HEADING, unit="rad", bound=HEADING_BOUND),
    Measure(title="map error", score=MAP, unit="m"),
    Measure(title="number of landmarks placed", score="landmarks_full", unit="landmarks"),
    Measure(title="NEES", score="nees_mean", unit="", ratio=True),
)
"""The first is what the answer speaks of."""
GAINS = tuple(
    replace(
        one, title=f"{one.title.removesuffix(' error')} gain over active", bound="", over="active"
    )
    for one in MEASURES
    if one.unit in ("m", "rad")
)
"""What listening gains, of each error: above 0 where it helps."""


def cells_of(measure: Measure, before: Cell, after: Cell) -> list[Cell]:
    """List the cases of which a change is made: two, and of a gain those that it is over.

    Parameters
    ----------
    measure : Measure
    before, after : Cell

    Returns
    -------
    list of Cell
    """
    cells = [before, after]
    return cells + [(name, measure.over, number) for name, _, number in cells if measure.over]


def change(study: Study, measure: Measure, before: Cell, after: Cell) -> Float[np.ndarray, " n"]:
    """Return by how much a measure differs between two cases, world by world.

    Parameters
    ----------
    study : Study
    measure : Measure
    before, after : Cell

    Returns
    -------
    (n)
        After minus before; of a ratio its logarithm; NaN or infinite where one of them has no
        number. A map's error is that of the landmarks which all these cases have placed, as far as
        they met the same ones; of those that only one has placed, nothing can be compared.
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
        mine = [cell for cell in cells if study.drawing[cell[2]] == drawing]
        if score == MAP and len(mine) > 1:
            found |= zip(mine, _shared_maps(study, mine), strict=True)
        else:
            found |= {cell: values(study, score, cell) for cell in mine}
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
