"""A study's folder as arrays.

A study over further settings falls apart into one `Study` for each combination of them. Only
worlds that are whole are read: those whose file of trials stands.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import Config, InputError
from pipistrelle.experiments.studies.plan import RADIUS, Plan, cases_of, common
from pipistrelle.experiments.studies.store import load_study
from pipistrelle.experiments.studies.world import STEPS, world_schemas
from pipistrelle.experiments.studies.world_files import (
    check_world,
    damaged,
    done_worlds,
    world_file,
)
from pipistrelle.report.studied import COMMON, ONLINE_POSITION, SCORES, Study, Trials

if TYPE_CHECKING:
    import polars as pl


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
    """
    import polars as pl

    stored = load_study(folder)
    for world in sorted(done_worlds(folder)):
        check_world(folder, stored.plan, world)
    try:
        trials = stored.trials.collect()
        if trials.is_empty():
            raise InputError(
                f"{folder}: no world is done yet; `pipistrelle study` with -o {folder} goes on"
            )
        steps, landmarks = stored.steps.collect(), stored.landmarks.collect()
        studies = []
        for settings, config, numbers in _combinations(stored.plan):
            mine = pl.col("case").is_in(numbers)
            tables = [table.filter(mine) for table in (trials, steps, landmarks)]
            studies.append(_study(stored.plan, config, settings, *tables))
    except (OSError, pl.exceptions.PolarsError) as error:
        raise _unreadable(folder, stored.plan) from error
    return tuple(studies)


def _unreadable(folder: Path, plan: Plan) -> InputError:
    """Find the file that is whole, but of no use, and say how to have its world anew."""
    import polars as pl

    for world in sorted(done_worlds(folder)):
        for table, schema in world_schemas(plan).items():
            file = world_file(folder, table, world)
            if pl.read_parquet(file.read_bytes()).schema != pl.Schema(schema):
                return damaged(folder, table, world, "has not the columns of this study")
    return InputError(f"{folder}: could not be read, though each file can; run the report again")


def _combinations(plan: Plan) -> list[tuple[dict[str, Any], Config, list[int]]]:
    """Part the cases by the settings that are not the beamwidth's."""
    found: dict[str, tuple[dict[str, Any], Config, list[int]]] = {}
    for case in cases_of(plan):
        settings = {name: value for name, value in case.values.items() if name != RADIUS}
        if (key := repr(settings)) not in found:
            found[key] = (settings, common(plan, settings), [])
        found[key][2].append(case.number)
    return list(found.values())


def _study(
    plan: Plan,
    config: Config,
    settings: dict[str, Any],
    trials: "pl.DataFrame",
    steps: "pl.DataFrame",
    landmarks: "pl.DataFrame",
) -> Study:
    """Lay one combination out as arrays."""
    import polars as pl

    worlds = np.unique(trials["iteration"].to_numpy())
    key = ["case", "filter", "strategy", "beamwidth_deg"]
    cases = trials.select(key).unique().sort("beamwidth_deg", "case")
    number = {case: i for i, case in enumerate(cases["case"].to_list())}
    broken = trials.filter(pl.col("status") != "done").sort("iteration", "case")
    told = broken.select("iteration", "strategy", "filter", "beamwidth_deg", "error")
    return Study(
        name=plan.name,
        settings=settings,
        grid=dict(plan.grid),
        planned=plan.iterations,
        worlds=worlds,
        config=config,
        beamwidth=cases["beamwidth_deg"].drop_nulls().unique().sort().to_numpy(),
        trials=_trials(
            {
                key: np.array([number[case] for case in group["case"].to_list()])
                for key, group in cases.partition_by("filter", "strategy", as_dict=True).items()
            },
            _scores(trials, worlds, number),
            {column: _over_time(steps, column, worlds, number) for column in STEPS[2:]},
            _maps(landmarks, worlds, number),
        ),
        errors=tuple((i, s, f, b, text or "") for i, s, f, b, text in told.rows()),
        cpu_s=float(trials["cpu_s"].sum()),
    )


def _trials(
    columns: dict[tuple[str, ...], Int[np.ndarray, " b"]],
    scores: dict[str, np.ndarray],
    nees: dict[str, Float[np.ndarray, "n c k"]],
    maps: tuple[Bool[np.ndarray, "n c l"], Float[np.ndarray, "n c l"]],
) -> dict[tuple[str, str], Trials]:
    """Give each filter and strategy its columns."""
    common = _common(columns, *maps)
    return {
        (name, strategy): Trials(
            failed=scores["failed"][:, c],
            diverged=scores["diverged"][:, c],
            scores={score: scores[score][:, c] for score in SCORES}
            | {COMMON: common[name, strategy]},
            nees=nees["nees"][:, c],
            consistent=_means(nees["nees_expected"][:, c], nees["nees_variance"][:, c]),
        )
        for (name, strategy), c in sorted(columns.items())
    }


def _scores(
    trials: "pl.DataFrame", worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> dict[str, np.ndarray]:
    """Lay the trials out by world and case; one that is not there has failed."""
    import polars as pl

    shape, at = (len(worlds), len(number)), _places(trials, worlds, number)
    found: dict[str, np.ndarray] = {
        "failed": np.ones(shape, bool),
        "diverged": np.zeros(shape, bool),
    }
    found["failed"][at] = (trials["status"] != "done").to_numpy()
    found["diverged"][at] = trials["diverged"].fill_null(value=False).to_numpy()
    for score in SCORES:
        found[score] = np.full(shape, np.nan)
        if score == ONLINE_POSITION and score not in trials.columns:
            continue
        found[score][at] = trials[score].cast(pl.Float64).fill_null(np.nan).to_numpy()
    return found


def _places(
    table: "pl.DataFrame", worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of the world and the column of the case of each row of a table."""
    known = np.array(sorted(number))
    columns = np.array([number[case] for case in known.tolist()])
    case = np.searchsorted(known, table["case"].to_numpy())
    return np.searchsorted(worlds, table["iteration"].to_numpy()), columns[case]


def _over_time(
    steps: "pl.DataFrame", column: str, worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> Float[np.ndarray, "n c k"]:
    """Lay out a column by world, case and frame."""
    last = max(steps["frame"].to_list(), default=0)
    laid = np.full((len(worlds), len(number), last), np.nan)
    frame = steps["frame"].to_numpy().astype(np.intp) - 1
    laid[(*_places(steps, worlds, number), frame)] = steps[column].to_numpy()
    return laid


def _means(*columns: Float[np.ndarray, "n b k"]) -> Float[np.ndarray, "i b k"]:
    """Average columns over the worlds that have them; NaN where none has."""
    counts = [np.sum(np.isfinite(column), axis=0) for column in columns]
    with np.errstate(invalid="ignore"):
        return np.array([np.nansum(c, axis=0) / n for c, n in zip(columns, counts, strict=True)])


def _maps(
    landmarks: "pl.DataFrame", worlds: Int[np.ndarray, " n"], number: dict[int, int]
) -> tuple[Bool[np.ndarray, "n c l"], Float[np.ndarray, "n c l"]]:
    """Lay out which landmarks are fully initialised, and how far off each is."""
    last = max(landmarks["landmark"].to_list(), default=0)
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
