"""What a study found: worlds in rows, beamwidths in columns, a record per filter and strategy.

And what of it counts: a `Selection` is a study under one exclusion rule, and everything that is
claimed, charted or told is taken from one.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import Config
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.evaluation.comparison import Finding

Rule = Literal["world", "case", "none"]
RULES: dict[Rule, str] = {
    "world": "a world is dropped for a filter where any of the filter's cases diverged",
    "case": "a world is dropped where a case at hand diverged",
    "none": "nothing is dropped but what has no number",
}
"""What is left out of a mean, the paper's rule first."""
Way = tuple[str, str]
"""Filter and strategy."""
Cell = tuple[str, str, int]
"""Filter, strategy and number of the beamwidth (of no meaning for passive)."""
POSITION, HEADING = "position_rmse_m", "heading_rmse_rad"
POSITION_ALIGNED, MAP_ALIGNED = "position_rmse_aligned_m", "map_rmse_aligned_m"
POSITION_BOUND, HEADING_BOUND = "position_bound_m", "heading_bound_rad"
"""The least errors that the sound leaves to any estimator."""
ONLINE_POSITION = "online_position_rmse_m"
"""Of the path as it was believed at its time, where the filter revises it."""
SCORES = (
    POSITION,
    ONLINE_POSITION,
    HEADING,
    POSITION_ALIGNED,
    MAP_ALIGNED,
    POSITION_BOUND,
    HEADING_BOUND,
    "nees_mean",
    "nees_max",
    "landmarks_full",
    "landmarks_total",
    "landmarks_full_mean",
)
COMMON = "common_map_rmse_m"
"""Map RMSE over the landmarks that every strategy has placed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trials:
    """One filter's trials with one strategy, in n worlds at b beamwidths (passive: at one).

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
    consistent : (2, b, k)
        Mean and variance of a consistent filter's NEES at each frame, averaged over the worlds.
    """

    failed: Bool[np.ndarray, "n b"]
    diverged: Bool[np.ndarray, "n b"]
    scores: dict[str, Float[np.ndarray, "n _"]]
    nees: Float[np.ndarray, "n b k"]
    consistent: Float[np.ndarray, "2 b k"]


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
    trials : dict
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
    trials: dict[Way, Trials]
    errors: tuple[tuple[int, str, str, float | None, str], ...]
    cpu_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """A study under one exclusion rule, as `claims.contrasts.select` makes it.

    Attributes
    ----------
    study : Study
    rule : one of `RULES`
    lost : dict of (n)
        Per filter, the worlds in which any of its cases diverged or failed.
    gains : dict of tuple of Finding
        Active minus fused at each beamwidth, judged as a family of its own, by filter and score:
        `POSITION`, `POSITION_ALIGNED` and `COMMON`. Empty where the study lacks one of the two.
    """

    study: Study
    rule: Rule
    lost: Mapping[str, Bool[np.ndarray, " n"]]
    gains: Mapping[tuple[str, str], tuple[Finding, ...]]


def filter_titles(study: Study) -> dict[str, str]:
    """Titles of the filters that a study has, in the order in which they are shown.

    Parameters
    ----------
    study : Study

    Returns
    -------
    dict of str
        Title by name. Those of the catalogue come first, in its order. Others (``module:Class``)
        follow by name and bear their class's, or where two would be alike their whole name: to
        read a study it takes none of the code that made it.
    """
    there = {name for name, _ in study.trials}
    outside = sorted(there - CATALOGUE.keys())
    plain = {name: name.rpartition(":")[2] for name in outside}
    used = Counter([*plain.values(), *(known.title for known in CATALOGUE.values())])
    titles = {name: known.title for name, known in CATALOGUE.items() if name in there}
    return titles | {name: name if used[plain[name]] > 1 else plain[name] for name in outside}


def lost_worlds(study: Study, name: str) -> Bool[np.ndarray, " n"]:
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
    mine = [trials for (other, _), trials in study.trials.items() if other == name]
    return np.any([np.any(t.failed | t.diverged, axis=1) for t in mine], axis=0)


def kept(selection: Selection, cells: Sequence[Cell]) -> Bool[np.ndarray, " n"]:
    """Tell which worlds count where these cells are compared.

    Parameters
    ----------
    selection : Selection
    cells : sequence of Cell

    Returns
    -------
    (n)
        A failed trial counts as a diverged one, and where nothing is dropped it has no number.
    """
    counts = np.ones(len(selection.study.worlds), dtype=bool)
    for name, strategy, column in cells:
        trials = selection.study.trials[name, strategy]
        column = 0 if strategy == "passive" else column
        counts &= ~trials.failed[:, column]
        if selection.rule == "case":
            counts &= ~trials.diverged[:, column]
    if selection.rule == "world":
        for name in {name for name, _, _ in cells}:
            counts &= ~selection.lost[name]
    return counts


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
    table = study.trials[name, strategy].scores[score]
    return table[:, column if table.shape[1] > 1 else 0]


def samples(
    selection: Selection, score: str, cells: Sequence[Cell]
) -> list[Float[np.ndarray, " m"]]:
    """Return a score of several cells in the worlds where all of them count and have a number.

    Parameters
    ----------
    selection : Selection
    score : one of `SCORES`, or `COMMON`
    cells : sequence of Cell

    Returns
    -------
    list of (m), one per cell, the same worlds in each
    """
    columns = np.array([values(selection.study, score, cell) for cell in cells])
    both = kept(selection, cells) & np.all(np.isfinite(columns), axis=0)
    return list(columns[:, both])


def mean_std(sample: Float[np.ndarray, " m"]) -> tuple[float, float]:
    """Mean and standard deviation over worlds.

    Parameters
    ----------
    sample : (m)

    Returns
    -------
    float, float
        Of no world, NaN; the standard deviation of a single one is 0.

    Examples
    --------
    >>> mean_std(np.array([1.0, 3.0, 5.0])), mean_std(np.array([7.0]))
    ((3.0, 2.0), (7.0, 0.0))
    """
    if len(sample) == 0:
        return np.nan, np.nan
    return float(np.mean(sample)), float(np.std(sample, ddof=1)) if len(sample) > 1 else 0.0
