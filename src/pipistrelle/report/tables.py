"""A study's folder as arrays: worlds in rows, beamwidths in columns, a record per way of sensing.

A study over further settings falls apart into one `Study` for each combination of them. Only
worlds that are whole are read: those whose file of trials stands.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import Config, InputError
from pipistrelle.settings import from_file, from_flags, resolve

if TYPE_CHECKING:
    import polars as pl

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
AXIS = "emitter.radius"
"""The setting that makes the beamwidth, and the columns."""


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
    planned: int
    worlds: Int[np.ndarray, " n"]
    config: Config
    beamwidth: Float[np.ndarray, " b"]
    outcomes: dict[tuple[str, str], Outcome]
    errors: tuple[tuple[int, str, str, float | None, str], ...]
    cpu_s: float


def read_study(folder: Path) -> tuple[Study, ...]:
    """Read what a study has done so far.

    Parameters
    ----------
    folder : Path
        As `pipistrelle study` fills it.

    Returns
    -------
    tuple of Study
        One for each combination of the settings other than the beamwidth's, in order.

    Raises
    ------
    InputError
        No study, no world done, or a file that cannot be read.

    Examples
    --------
    >>> read_study(Path("nowhere"))
    Traceback (most recent call last):
    pipistrelle.config.InputError: nowhere: holds no plan.toml, so it is no study's folder; ...
    """
    plan = _plan(folder)
    config = resolve(from_file(folder / "config.toml"))
    names = sorted(path.name for path in (folder / "trials").glob("iteration_*.parquet"))
    if not names:
        raise InputError(
            f"{folder}: no world is done yet; `pipistrelle study -o {folder}` goes on with it"
        )
    trials = _table(folder / "trials", names)
    steps, landmarks = _table(folder / "steps", names), _table(folder / "landmarks", names)
    others = [key for key in plan["grid"] if key != AXIS]
    combinations = trials.sort("case").select(others).unique(maintain_order=True)
    studies = []
    for values in combinations.rows(named=True) if others else [{}]:
        rows = trials.filter(**values) if values else trials
        studies.append(_study(plan, _applied(config, values), values, rows, steps, landmarks))
    return tuple(studies)


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


def _plan(folder: Path) -> dict[str, Any]:
    """Read the plan, as far as a report needs it."""
    path = folder / "plan.toml"
    if not path.is_file():
        raise InputError(
            f"{folder}: holds no plan.toml, so it is no study's folder; name the folder that "
            "`pipistrelle study` printed last"
        )
    try:
        plan = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not TOML: {error}") from error
    expected = {"name": str, "iterations": int, "grid": dict}
    for key, kind in expected.items():
        if not isinstance(plan.setdefault(key, {} if kind is dict else None), kind):
            raise InputError(
                f"{path}: {key}: found {plan[key]!r}, expected what `pipistrelle study` writes"
            )
    return plan


def _applied(config: Config, settings: dict[str, Any]) -> Config:
    """Apply a combination of dotted settings."""
    nested: dict[str, Any] = config.model_dump()
    for dotted, value in settings.items():
        *sections, leaf = dotted.split(".")
        table = nested
        for section in sections:
            table = table[section]
        table[leaf] = value
    return resolve(from_flags(nested))


def _table(folder: Path, names: Sequence[str]) -> "pl.DataFrame":
    """Read the worlds' files of one kind."""
    import polars as pl

    parts = []
    for name in names:
        try:
            parts.append(pl.read_parquet(folder / name))
        except (OSError, pl.exceptions.PolarsError) as error:
            raise InputError(
                f"{folder / name}: cannot be read ({str(error).splitlines()[0]}); remove "
                f"trials/{name} and run the study again: it does that world anew"
            ) from error
    return pl.concat(parts)


def _study(
    plan: dict[str, Any],
    config: Config,
    settings: dict[str, Any],
    trials: "pl.DataFrame",
    steps: "pl.DataFrame",
    landmarks: "pl.DataFrame",
) -> Study:
    """Lay one combination out as arrays."""
    import polars as pl

    worlds = np.unique(trials["iteration"].to_numpy())
    cases = (
        trials.select("case", "filter", "strategy", "beamwidth_deg")
        .unique()
        .sort("beamwidth_deg", "case")
    )
    number = {case: i for i, case in enumerate(cases["case"].to_list())}
    shape = (len(worlds), len(number))
    at = _places(trials, worlds, number)
    failed = np.ones(shape, dtype=bool)
    failed[at] = (trials["status"] != "done").to_numpy()
    diverged = np.zeros(shape, dtype=bool)
    diverged[at] = trials["diverged"].fill_null(False).to_numpy()
    scores = {}
    for score in SCORES:
        scores[score] = np.full(shape, np.nan)
        scores[score][at] = trials[score].cast(pl.Float64).fill_null(np.nan).to_numpy()
    nees = _nees(steps.filter(pl.col("case").is_in(list(number))), worlds, number)
    columns = {
        key: np.array([number[case] for case in group["case"].to_list()])
        for key, group in cases.partition_by("filter", "strategy", as_dict=True).items()
    }
    mine = landmarks.filter(pl.col("case").is_in(list(number)))
    common = _common(columns, *_maps(mine, worlds, number))
    outcomes: dict[tuple[str, str], Outcome] = {}
    for (name, strategy), c in sorted(columns.items()):
        mine = {score: table[:, c] for score, table in scores.items()}
        mine[COMMON] = common[name, strategy]
        outcomes[name, strategy] = Outcome(
            failed=failed[:, c], diverged=diverged[:, c], scores=mine, nees=nees[:, c]
        )
    broken = trials.filter(pl.col("status") != "done").sort("iteration", "case")
    told = broken.select("iteration", "strategy", "filter", "beamwidth_deg", "error")
    return Study(
        name=plan["name"],
        settings=settings,
        planned=plan["iterations"],
        worlds=worlds,
        config=config,
        beamwidth=cases["beamwidth_deg"].drop_nulls().unique().sort().to_numpy(),
        outcomes=outcomes,
        errors=tuple((i, s, f, b, text or "") for i, s, f, b, text in told.rows()),
        cpu_s=float(trials["cpu_s"].sum()),
    )


def _places(
    table: "pl.DataFrame", worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of the world and the column of the case of each row of a table."""
    known = np.array(sorted(number))
    columns = np.array([number[case] for case in known.tolist()])
    case = np.searchsorted(known, table["case"].to_numpy())
    return np.searchsorted(worlds, table["iteration"].to_numpy()), columns[case]


def _nees(
    steps: "pl.DataFrame", worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> Float[np.ndarray, "n c k"]:
    """Lay out the NEES by world, case and frame."""
    last = int(steps["frame"].max() or 0) if len(steps) else 0
    nees = np.full((len(worlds), len(number), last), np.nan)
    frame = steps["frame"].to_numpy().astype(np.intp) - 1
    nees[(*_places(steps, worlds, number), frame)] = steps["nees"].to_numpy()
    return nees


def _maps(
    landmarks: "pl.DataFrame", worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> tuple[Bool[np.ndarray, "n c l"], Float[np.ndarray, "n c l"]]:
    """Lay out which landmarks are fully initialised, and how far off each is."""
    last = int(landmarks["landmark"].max() or 0) if len(landmarks) else 0
    shape = (len(worlds), len(number), last + 1)
    full, error = np.zeros(shape, dtype=bool), np.zeros(shape)
    label = landmarks["landmark"].to_numpy().astype(np.intp)
    at = (*_places(landmarks, worlds, number), label)
    full[at], error[at] = landmarks["full"].to_numpy(), landmarks["error_m"].to_numpy()
    return full, error


def _common(
    columns: dict[tuple[str, ...], np.ndarray],
    full: Bool[np.ndarray, "n c l"],
    error: Float[np.ndarray, "n c l"],
) -> dict[tuple[str, ...], Float[np.ndarray, "n b"]]:
    """Return the map RMSE over the landmarks that all strategies of a filter have placed."""
    found = {}
    for name in {name for name, _ in columns}:
        mine = {key: c for key, c in columns.items() if key[0] == name}
        widest = max(len(c) for c in mine.values())
        spread = {key: np.resize(c, widest) for key, c in mine.items()}
        shared = np.all([full[:, c] for c in spread.values()], axis=0)
        count = np.sum(shared, axis=2)
        for key, c in spread.items():
            square = np.sum(np.where(shared, error[:, c] ** 2, 0.0), axis=2)
            mean = np.divide(square, count, out=np.full(count.shape, np.nan), where=count > 0)
            found[key] = np.sqrt(mean)
    return found
