"""What a study found: worlds in rows, combinations in columns, a record per filter and strategy.

A combination is a value of each variable; they are numbered as a product is, the last variable
fastest. In the paper's study, whose one variable is the beamwidth, their numbers are those of the
beamwidths.

And what of it counts: a `Selection` is a study under one exclusion rule, and everything that is
claimed, charted or written is taken from one.
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
from pipistrelle.evaluation.scores import NOT_MEANS, SCORES
from pipistrelle.experiments.hearing.scenario import Scenario
from pipistrelle.report.variables import BEAM, Variable

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
"""Filter, strategy and number of the combination."""
POSITION, HEADING = "position_rmse_m", "heading_rmse_rad"
POSITION_ALIGNED, MAP_ALIGNED = "position_rmse_aligned_m", "map_rmse_aligned_m"
MAP = "map_rmse_m"
"""Of the landmarks that the case itself has placed."""
POSITION_BOUND, HEADING_BOUND = "position_bound_m", "heading_bound_rad"
"""The least errors that the sound leaves to any estimator."""
LANDMARKS, NEES = "landmarks_full", "nees_mean"
ONLINE_POSITION = "online_position_rmse_m"
"""Of the path as it was believed at its time, where the filter revises it."""
READ = (
    *(name for name in SCORES if name not in NOT_MEANS),
    ONLINE_POSITION,
    "landmarks_full_mean",
)
"""Columns of a study's table of trials that are read."""
LATER = (ONLINE_POSITION, "caller_rmse_m", "caller_rmse_aligned_m")
"""Those that some studies do not have: they revise no path, or are older than the score."""
COMMON = "common_map_rmse_m"
"""Map RMSE over the landmarks that every strategy has placed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trials:
    """One filter's trials with one strategy, in n worlds, b cases in each."""

    at: Int[np.ndarray, " c"]
    """Which case is that of each combination: passive has one for all beamwidths."""
    failed: Bool[np.ndarray, "n b"]
    """The trial raised an error, or is not there."""
    diverged: Bool[np.ndarray, "n b"]
    """Its NEES is not finite or passes the filter's limit."""
    scores: dict[str, Float[np.ndarray, "n _"]]
    """By the names of `READ`; NaN where there is no number. `COMMON` is there too, one for each
    combination, for the landmarks in common change with the other strategies'."""
    placed: Bool[np.ndarray, "n b l"]
    """Which landmarks, by their labels, are fully initialised at the end."""
    off: Float[np.ndarray, "n b l"]
    """[m] How far from the truth those are; of the others without meaning."""
    nees: Float[np.ndarray, "n b k"]
    """At each frame."""
    consistent: Float[np.ndarray, "2 b k"]
    """Mean and variance of a consistent filter's NEES at each frame, averaged over the worlds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A trial that failed."""

    iteration: int
    """Its world."""
    strategy: str
    filter: str
    beamwidth_deg: float | None
    """None for passive."""
    settings: dict[str, str]
    """Its values of the variables, the beam left out, as words."""
    error: str
    """The traceback."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A study, as far as it is done: n worlds, c combinations of its variables."""

    name: str
    """The plan's; not to be trusted."""
    variables: tuple[Variable, ...]
    """In the plan's order, those with two values or more; none where the study varies strategies
    and filters alone."""
    grid: dict[str, tuple[Any, ...]]
    """All dotted settings that the study varies, with their values, as the plan has them."""
    planned: int
    """Worlds asked for."""
    worlds: Int[np.ndarray, " n"]
    """Numbers of those done."""
    config: Config
    """What holds where the variables say nothing."""
    configs: tuple[Config, ...]
    """Without any filter's own."""
    beamwidth: Float[np.ndarray, " c"]
    """[deg] Of the vehicle's call."""
    drawing: Int[np.ndarray, " c"]
    """Combinations with one number meet the same landmarks, world by world."""
    example: Scenario | None
    """The first of the worlds where the variables have their first values, drawn anew; None where
    it cannot be."""
    trials: dict[Way, Trials]
    """By filter and strategy."""
    errors: tuple[Failure, ...]
    cpu_s: float
    """[s] Of all filters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """A study under one exclusion rule, as `claims.contrasts.select` makes it."""

    study: Study
    rule: Rule
    """One of `RULES`."""
    lost: Mapping[str, Bool[np.ndarray, " n"]]
    """Per filter, the worlds in which any of its cases diverged or failed."""
    gains: Mapping[tuple[str, str], tuple[Finding, ...]]
    """Active minus fused at each combination, judged as a family of its own, by filter and score:
    `POSITION`, `POSITION_ALIGNED` and `COMMON`. Empty where the study lacks one of the two."""


def has_numbers(study: Study, score: str) -> bool:
    """Tell whether a score has a number anywhere in a study."""
    return any(np.isfinite(trials.scores[score]).any() for trials in study.trials.values())


def along(study: Study, variable: Variable) -> Int[np.ndarray, "k m"]:
    """Number the combinations by the values of a variable and by those of all the others.

    Parameters
    ----------
    study : Study
    variable : Variable
        One of the study's.

    Returns
    -------
    (k, m)
        A row per value.
    """
    shape = [len(one.given) for one in study.variables]
    numbers = np.arange(len(study.beamwidth)).reshape(shape)
    return np.moveaxis(numbers, study.variables.index(variable), 0).reshape(len(variable.given), -1)


def combination_name(study: Study, number: int, without: Sequence[Variable] = ()) -> str:
    """Name a combination by the values of its variables.

    `without`: left out. Returns: empty where nothing is left to name.
    """
    at = np.unravel_index(number, [len(one.given) for one in study.variables] or [1])
    return ", ".join(
        variable.words[i] if variable.name == BEAM else f"{variable.name} = {variable.words[i]}"
        for variable, i in zip(study.variables, at, strict=False)
        if variable not in without
    )


def case_name(study: Study, way: Way, number: int) -> str:
    """Name a combination by those of its variables that a way's cases depend on.

    Returns: empty for passive sensing where only the beam varies.
    """
    at = study.trials[way].at
    idle = [v for v in study.variables if np.all(at[along(study, v)] == at[along(study, v)][:1])]
    return combination_name(study, number, idle)


def own_cases(trials: Trials) -> Int[np.ndarray, " b"]:
    """Return the number of the first combination of each case."""
    return np.unique(trials.at, return_index=True)[1]


def filter_titles(study: Study) -> dict[str, str]:
    """Return the titles of the filters that a study has, in the order in which they are shown.

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
    classes = {name: name.rpartition(":")[2] for name in outside}
    used = Counter([*classes.values(), *(known.title for known in CATALOGUE.values())])
    titles = {name: known.title for name, known in CATALOGUE.items() if name in there}
    return titles | {name: name if used[classes[name]] > 1 else classes[name] for name in outside}


def lost_worlds(study: Study, name: str) -> Bool[np.ndarray, " n"]:
    """Return a mask of the worlds in which any case of a filter diverged or failed.

    `name`: the filter.
    """
    of_filter = [trials for (other, _), trials in study.trials.items() if other == name]
    return np.any([np.any(t.failed | t.diverged, axis=1) for t in of_filter], axis=0)


def kept(selection: Selection, cells: Sequence[Cell]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the worlds that count when these cells are compared.

    Returns: a failed trial counts as a diverged one, and where nothing is dropped it has no number.
    """
    counts = np.ones(len(selection.study.worlds), dtype=bool)
    for name, strategy, column in cells:
        trials = selection.study.trials[name, strategy]
        column = trials.at[column]
        counts &= ~trials.failed[:, column]
        if selection.rule == "case":
            counts &= ~trials.diverged[:, column]
    if selection.rule == "world":
        for name in {name for name, _, _ in cells}:
            counts &= ~selection.lost[name]
    return counts


def values(study: Study, score: str, cell: Cell) -> Float[np.ndarray, " n"]:
    """Return a score of a cell in all worlds; NaN where there is none."""
    name, strategy, number = cell
    trials = study.trials[name, strategy]
    return trials.scores[score][:, number if score == COMMON else trials.at[number]]


def samples(
    selection: Selection, score: str, cells: Sequence[Cell]
) -> list[Float[np.ndarray, " m"]]:
    """Return a score of several cells in the worlds where all of them count and have a number.

    Parameters
    ----------
    selection : Selection
    score : one of `READ`, or `COMMON`
    cells : sequence of Cell

    Returns
    -------
    list of (m), one per cell, the same worlds in each
    """
    columns = np.array([values(selection.study, score, cell) for cell in cells])
    both = kept(selection, cells) & np.all(np.isfinite(columns), axis=0)
    return list(columns[:, both])


def rmse_of(
    off: Float[np.ndarray, "*n l"], shared: Bool[np.ndarray, "*n l"]
) -> Float[np.ndarray, "*n"]:
    """Return the root mean square over some landmarks.

    `off` [m]. `shared`: which count. Returns [m]: NaN where none counts.

    Examples
    --------
    >>> rmse_of(np.array([[3.0, 4.0, 9.0]]), np.array([[True, True, False]])).round(3)
    array([3.536])
    """
    count = np.sum(shared, axis=-1)
    square = np.sum(np.where(shared, np.asarray(off, dtype=np.float64) ** 2, 0.0), axis=-1)
    mean = np.divide(square, count, out=np.full(count.shape, np.nan), where=count > 0)
    return np.sqrt(mean)


def mean_std(sample: Float[np.ndarray, " m"]) -> tuple[float, float]:
    """Return the mean and standard deviation over worlds.

    Returns: of no world, NaN; the standard deviation of a single one is 0.

    Examples
    --------
    >>> mean_std(np.array([1.0, 3.0, 5.0])), mean_std(np.array([7.0]))
    ((3.0, 2.0), (7.0, 0.0))
    """
    if len(sample) == 0:
        return np.nan, np.nan
    return float(np.mean(sample)), float(np.std(sample, ddof=1)) if len(sample) > 1 else 0.0
