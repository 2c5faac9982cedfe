"""What is looked at in each trial: six numbers, each better or worse by itself.

`MEASURES` is the only list of them: table, figures, sentences and summary follow.
"""

from dataclasses import dataclass

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
    """

    title: str
    score: str
    unit: str
    ratio: bool = False
    bound: str = ""


MEASURES = (
    Measure(title="position error", score=POSITION, unit="m", bound=POSITION_BOUND),
    Measure(title="aligned position error", score=POSITION_ALIGNED, unit="m"),
    Measure(title="heading error", score=HEADING, unit="rad", bound=HEADING_BOUND),
    Measure(title="map error", score=MAP, unit="m"),
    Measure(title="number of landmarks placed", score="landmarks_full", unit="landmarks"),
    Measure(title="NEES", score="nees_mean", unit="", ratio=True),
)
"""The first is what the answer speaks of."""


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
        number. A map's error is that of the landmarks which both have placed, if they met the same
        ones; of those that only one has placed, nothing can be compared.
    """
    if measure.score == MAP and study.drawing[before[2]] == study.drawing[after[2]]:
        first, second = _shared_maps(study, before, after)
    else:
        first, second = (values(study, measure.score, cell) for cell in (before, after))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(second) - np.log(first) if measure.ratio else second - first


def _shared_maps(study: Study, *cells: Cell) -> list[Float[np.ndarray, " n"]]:
    """Return the map RMSE of cases over the landmarks that all of them have placed."""
    placed, off = [], []
    for name, strategy, number in cells:
        trials = study.trials[name, strategy]
        placed.append(trials.placed[:, trials.at[number]])
        off.append(trials.off[:, trials.at[number]])
    shared = np.all(placed, axis=0)
    return [rmse_of(one, shared) for one in off]
