"""A study's folder as arrays.

Only worlds that are whole are read: those whose file of trials stands.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import degrees, isclose
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import Config, InputError
from pipistrelle.experiments.hearing.scenario import Scenario, standing_landmarks, world_of
from pipistrelle.experiments.studies.plan import MAKERS, RADIUS, Plan, cases_of, common
from pipistrelle.experiments.studies.store import load_study
from pipistrelle.experiments.studies.world import (
    STEPS,
    check_world,
    damaged,
    done_worlds,
    heard_settings,
    world_file,
    world_schemas,
)
from pipistrelle.files import read_file
from pipistrelle.report.studied import (
    COMMON,
    LATER,
    READ,
    Failure,
    Study,
    Trials,
    Way,
    rmse_of,
)
from pipistrelle.report.variables import (
    BEAM,
    Variable,
    beam_variable,
    setting_variable,
    word_of,
)

if TYPE_CHECKING:
    import polars as pl

SAME = 1e-4
"""Share by which a value may differ from the truth and be meant to be it: 337.1 m/s at 10 °C."""


def read_study(folder: Path) -> Study:
    """Read what a study has done so far.

    `folder`: as `pipistrelle study` fills it. Raises InputError: no study, no world done, or a file
    that cannot be read.
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
        return _study(stored.plan, trials, steps, landmarks)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise _unreadable(folder, stored.plan) from error


def _unreadable(folder: Path, plan: Plan) -> InputError:
    """Find the file that is whole, but of no use, and say how to have its world anew."""
    import polars as pl

    for world in sorted(done_worlds(folder)):
        for table, schema in world_schemas(plan).items():
            file = world_file(folder, table, world)
            if pl.read_parquet(read_file(file)).schema != pl.Schema(schema):
                return damaged(folder, table, world, "has not the columns of this study")
    return InputError(f"{folder}: could not be read, though each file can; run the report again")


def _variables(plan: Plan) -> tuple[Variable, ...]:
    """Name what a plan varies; of the radius, the beamwidth where nothing else decides it."""
    found = []
    for setting, values in plan.grid.items():
        if len(values) < 2:
            continue
        variable = setting_variable(setting, values)
        if setting == RADIUS and not plan.grid.keys() & set(MAKERS):
            widths = [_degrees(common(plan, {RADIUS: radius})) for radius in values]
            if len(set(widths)) == len(widths):
                variable = beam_variable(RADIUS, values, widths)
        found.append(variable)
    return tuple(found)


def _against_truth(variable: Variable, configs: Sequence[Config]) -> Variable:
    """Compare what may be assumed, or a bias, with the truth, if it is one and among the values."""
    truths = {_truth(variable.setting, config) for config in configs}
    truth = truths.pop() if len(truths) == 1 else None
    if truth is None or variable.numbers is None:
        return variable
    near = [i for i, one in enumerate(variable.numbers) if isclose(one, truth, rel_tol=SAME)]
    return replace(variable, base=near[0]) if len(near) == 1 else variable


def _truth(setting: str, config: Config) -> float | None:
    """Return what a setting is where nothing is assumed wrongly, if it is one of those."""
    section, _, name = setting.partition(".")
    if setting == "assumed.speed_of_sound":
        return config.medium.sound_speed
    if section == "assumed":
        return float(getattr(config.motion, name))
    return 0.0 if section == "motion" and name.endswith("_bias") else None


def _degrees(config: Config) -> float:
    """Return the half-power beamwidth of the vehicle's call [deg]."""
    tone = {"frequency": config.emitter.centre, "speed_of_sound": config.medium.sound_speed}
    return degrees(beamwidth(config.emitter.radius, **tone))


def _combinations(plan: Plan, variables: Sequence[Variable]) -> list[dict[str, Any]]:
    """Lay out the values of each combination, by their settings."""
    alone = {setting: values[0] for setting, values in plan.grid.items() if len(values) == 1}
    return [
        alone | dict(zip((variable.setting for variable in variables), values, strict=True))
        for values in product(*(variable.given for variable in variables))
    ]


def _numbers(
    plan: Plan, cases: "pl.DataFrame", variables: Sequence[Variable]
) -> dict[Way, Int[np.ndarray, " c"]]:
    """Number the case of each combination by filter and strategy."""
    given = [[repr(value) for value in variable.given] for variable in variables]
    values = {case.number: case.values for case in cases_of(plan)}
    found: dict[Way, Int[np.ndarray, ...]] = {}
    for case, name, strategy in cases.rows():
        numbers = found.setdefault((name, strategy), np.empty(list(map(len, given)), dtype=int))
        wanted = [values[case][variable.setting] for variable in variables]
        at = tuple(
            slice(None) if value is None else known.index(repr(value))
            for value, known in zip(wanted, given, strict=True)
        )
        numbers[at] = case
    return {way: numbers.reshape(-1) for way, numbers in sorted(found.items())}


def _drawn(plan: Plan, config: Config, world: int) -> Scenario | None:
    """Draw a world anew, if that can still be done."""
    try:
        return world_of(config, world, plan.world(config))
    except InputError:
        return None


def _drawings(plan: Plan, configs: Sequence[Config], world: int) -> Int[np.ndarray, " c"]:
    """Number the combinations so that those with the same landmarks share a number."""
    numbers: dict[Any, int] = {}
    known: dict[str, int] = {}
    found = []
    for number, config in enumerate(configs):
        if (same := heard_settings(config)) not in known:
            key: Any = number
            if drawn := _drawn(plan, config, world):
                key = tuple(part.tobytes() for part in standing_landmarks(drawn))
            known[same] = numbers.setdefault(key, len(numbers))
        found.append(known[same])
    return np.array(found)


def _study(
    plan: Plan, trials: "pl.DataFrame", steps: "pl.DataFrame", landmarks: "pl.DataFrame"
) -> Study:
    """Lay a study out as arrays."""
    import polars as pl

    variables = _variables(plan)
    settings = _combinations(plan, variables)
    configs = tuple(common(plan, values) for values in settings)
    variables = tuple(_against_truth(variable, configs) for variable in variables)
    worlds = np.unique(trials["iteration"].to_numpy())
    cases = trials.select("case", "filter", "strategy").unique().sort("case")
    numbers = _numbers(plan, cases, variables)
    broken = trials.filter(pl.col("status") != "done").sort("iteration", "case")
    count = len(cases_of(plan))
    return Study(
        name=plan.name,
        variables=variables,
        grid=dict(plan.grid),
        planned=plan.planned,
        worlds=worlds,
        config=plan.config,
        configs=configs,
        beamwidth=np.array(list(map(_degrees, configs))),
        drawing=_drawings(plan, configs, int(worlds[0])),
        example=_drawn(plan, configs[0], int(worlds[0])),
        trials=_trials(
            numbers,
            _scores(trials, worlds, count),
            {column: _over_time(steps, column, worlds, count) for column in STEPS[2:]},
            _maps(landmarks, worlds, count),
        ),
        errors=_failures(plan, broken, variables),
        cpu_s=float(trials["cpu_s"].sum()),
    )


def _failures(
    plan: Plan, broken: "pl.DataFrame", variables: Sequence[Variable]
) -> tuple[Failure, ...]:
    """List the failed trials with their errors and settings."""
    values = {case.number: case.values for case in cases_of(plan)}
    others = [variable for variable in variables if variable.name != BEAM]
    return tuple(
        Failure(
            iteration=row["iteration"],
            strategy=row["strategy"],
            filter=row["filter"],
            beamwidth_deg=row["beamwidth_deg"],
            settings={v.name: word_of(v, values[row["case"]][v.setting]) for v in others},
            error=row["error"] or "",
        )
        for row in broken.iter_rows(named=True)
    )


def _trials(
    numbers: dict[Way, Int[np.ndarray, " c"]],
    scores: dict[str, np.ndarray],
    nees: dict[str, Float[np.ndarray, "n a k"]],
    maps: tuple[Bool[np.ndarray, "n a l"], Float[np.ndarray, "n a l"]],
) -> dict[Way, Trials]:
    """Give each filter and strategy its cases, in the order of the combinations."""
    common = _common(numbers, *maps)
    found = {}
    for way, cases in numbers.items():
        first = np.sort(np.unique(cases, return_index=True)[1])
        c = cases[first]
        found[way] = Trials(
            at=np.argmax(cases[:, None] == c, axis=1),
            failed=scores["failed"][:, c],
            diverged=scores["diverged"][:, c],
            scores={score: scores[score][:, c] for score in READ} | {COMMON: common[way]},
            placed=maps[0][:, c],
            off=maps[1][:, c],
            nees=nees["nees"][:, c],
            consistent=_means(nees["nees_expected"][:, c], nees["nees_variance"][:, c]),
        )
    return found


def _scores(
    trials: "pl.DataFrame", worlds: Int[np.ndarray, " n"], count: int
) -> dict[str, np.ndarray]:
    """Lay the trials out by world and case; one that is not there has failed."""
    import polars as pl

    shape, at = (len(worlds), count), _places(trials, worlds)
    found: dict[str, np.ndarray] = {
        "failed": np.ones(shape, bool),
        "diverged": np.zeros(shape, bool),
    }
    found["failed"][at] = (trials["status"] != "done").to_numpy()
    found["diverged"][at] = trials["diverged"].fill_null(value=False).to_numpy()
    for score in READ:
        found[score] = np.full(shape, np.nan)
        if score in LATER and score not in trials.columns:
            continue
        found[score][at] = trials[score].cast(pl.Float64).fill_null(np.nan).to_numpy()
    return found


def _places(table: "pl.DataFrame", worlds: Int[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the row of the world and the number of the case of each row of a table."""
    case = table["case"].to_numpy().astype(np.intp)
    return np.searchsorted(worlds, table["iteration"].to_numpy()), case


def _over_time(
    steps: "pl.DataFrame", column: str, worlds: Int[np.ndarray, " n"], count: int
) -> Float[np.ndarray, "n a k"]:
    """Lay out a column by world, case and frame."""
    last = max(steps["frame"].to_list(), default=0)
    laid = np.full((len(worlds), count, last), np.nan)
    frame = steps["frame"].to_numpy().astype(np.intp) - 1
    laid[(*_places(steps, worlds), frame)] = steps[column].to_numpy()
    return laid


def _means(*columns: Float[np.ndarray, "n b k"]) -> Float[np.ndarray, "i b k"]:
    """Average columns over the worlds that have them; NaN where none has."""
    counts = [np.sum(np.isfinite(column), axis=0) for column in columns]
    with np.errstate(invalid="ignore"):
        return np.array([np.nansum(c, axis=0) / n for c, n in zip(columns, counts, strict=True)])


def _maps(
    landmarks: "pl.DataFrame", worlds: Int[np.ndarray, " n"], count: int
) -> tuple[Bool[np.ndarray, "n a l"], Float[np.ndarray, "n a l"]]:
    """Lay out which landmarks are fully initialised, and how far off each is."""
    last = max(landmarks["landmark"].to_list(), default=0)
    shape = (len(worlds), count, last + 1)
    full, error = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=np.float32)
    label = landmarks["landmark"].to_numpy().astype(np.intp)
    at = (*_places(landmarks, worlds), label)
    full[at], error[at] = landmarks["full"].to_numpy(), landmarks["error_m"].to_numpy()
    return full, error


def _common(
    numbers: dict[Way, Int[np.ndarray, " c"]],
    full: Bool[np.ndarray, "n a l"],
    error: Float[np.ndarray, "n a l"],
) -> dict[Way, Float[np.ndarray, "n c"]]:
    """Return the map RMSE over the landmarks that all strategies of a filter have placed."""
    found = {}
    for name in {name for name, _ in numbers}:
        of_filter = {way: c for way, c in numbers.items() if way[0] == name}
        shared = np.all([full[:, c] for c in of_filter.values()], axis=0)
        found |= {way: rmse_of(error[:, c], shared) for way, c in of_filter.items()}
    return found
