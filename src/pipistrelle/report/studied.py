"""What a study found: worlds in rows, beamwidths in columns, a record per way of sensing.

And what counts: which worlds are left out where cases are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import Config

Rule = Literal["world", "case", "none"]
RULES: dict[Rule, str] = {
    "world": "a world is dropped for a filter where any of the filter's cases diverged",
    "case": "a world is dropped where a case at hand diverged",
    "none": "nothing is dropped but what has no number",
}
"""What is left out of a mean, the paper's rule first."""
Cell = tuple[str, str, int]
"""Filter, strategy and number of the beamwidth (of no meaning for passive)."""
SCORES = (
    "position_rmse_m",
    "heading_rmse_rad",
    "nees_mean",
    "nees_max",
    "landmarks_full",
    "landmarks_total",
    "landmarks_full_mean",
)
COMMON = "common_map_rmse_m"
"""Map RMSE over the landmarks that every strategy has placed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What one filter made of one strategy, in n worlds at b beamwidths (passive: at one).

    Attributes
    ----------
    failed : (n, b)
        The trial raised an error, or is not there.
    diverged : (n, b)
        Its NEES is not finite or passes the filter's limit.
    scores : dict of (n, b)
        By the names of `SCORES` and `COMMON`; NaN where there is no number. `COMMON` has all
        beamwidths for passive too, for the landmarks in common change with them.
    nees : (n, b, k)
        At each frame.
    """

    failed: Bool[np.ndarray, "n b"]
    diverged: Bool[np.ndarray, "n b"]
    scores: dict[str, Float[np.ndarray, "n _"]]
    nees: Float[np.ndarray, "n b k"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """One combination of a study's settings, as far as it is done.

    Attributes
    ----------
    name : str
        The plan's; not to be trusted.
    settings : dict
        The combination: dotted setting to value; empty where only the beamwidth varies.
    grid : dict
        All dotted settings that the study varies, with their values.
    planned : int
        Worlds asked for.
    worlds : (n)
        Numbers of those done.
    config : Config
        With the combination applied.
    beamwidth : (b) [deg]
        Rising.
    outcomes : dict
        By filter and strategy.
    errors : tuple of world, strategy, filter, beamwidth [deg] or None, text
        Of the trials that failed.
    cpu_s : [s]
        Of all filters.
    """

    name: str
    settings: dict[str, Any]
    grid: dict[str, tuple[Any, ...]]
    planned: int
    worlds: Int[np.ndarray, " n"]
    config: Config
    beamwidth: Float[np.ndarray, " b"]
    outcomes: dict[tuple[str, str], Outcome]
    errors: tuple[tuple[int, str, str, float | None, str], ...]
    cpu_s: float


def kept(study: Study, rule: Rule, cells: Sequence[Cell]) -> Bool[np.ndarray, " n"]:
    """Tell which worlds count where these cells are compared.

    Parameters
    ----------
    study : Study
    rule : one of `RULES`
        A failed trial counts as a diverged one, and where nothing is dropped it has no number.
    cells : sequence of Cell

    Returns
    -------
    (n)
    """
    counts = np.ones(len(study.worlds), dtype=bool)
    for name, strategy, column in cells:
        outcome = study.outcomes[name, strategy]
        column = 0 if strategy == "passive" else column
        counts &= ~outcome.failed[:, column]
        if rule == "case":
            counts &= ~outcome.diverged[:, column]
    if rule == "world":
        for name in {name for name, _, _ in cells}:
            counts &= ~lost(study, name)
    return counts


def lost(study: Study, name: str) -> Bool[np.ndarray, " n"]:
    """Tell in which worlds any of a filter's cases diverged or failed.

    Parameters
    ----------
    study : Study
    name : str
        The filter.

    Returns
    -------
    (n)
    """
    mine = [outcome for (other, _), outcome in study.outcomes.items() if other == name]
    return np.any([np.any(o.failed | o.diverged, axis=1) for o in mine], axis=0)


def values(study: Study, score: str, cell: Cell) -> Float[np.ndarray, " n"]:
    """Return a score of a cell in all worlds; NaN where there is none.

    Parameters
    ----------
    study : Study
    score : one of `SCORES`, or `COMMON`
    cell : Cell

    Returns
    -------
    (n)
    """
    name, strategy, column = cell
    table = study.outcomes[name, strategy].scores[score]
    return table[:, column if table.shape[1] > 1 else 0]


def samples(
    study: Study, rule: Rule, score: str, cells: Sequence[Cell]
) -> list[Float[np.ndarray, " m"]]:
    """Return a score of several cells in the worlds where all of them count and have a number.

    Parameters
    ----------
    study : Study
    rule : one of `RULES`
    score : one of `SCORES`, or `COMMON`
    cells : sequence of Cell

    Returns
    -------
    list of (m), one per cell, the same worlds in each
    """
    columns = np.array([values(study, score, cell) for cell in cells])
    both = kept(study, rule, cells) & np.all(np.isfinite(columns), axis=0)
    return list(columns[:, both])
