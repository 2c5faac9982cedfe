"""Studies as arrays: worlds in rows, cases in columns, a record per filter and strategy.

A combination is one value of each variable. Combinations are numbered as a product, the last
variable fastest; if the beamwidth is the only variable, they are the beamwidths, narrowest first.
A `Selection` is a study under an exclusion rule: every claim, chart and table is made from one.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import degrees, inf, isclose, pi, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import Config, InputError
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.evaluation.scores import NOT_MEANS, POSITION, SCORES
from pipistrelle.experiments.hearing.scenario import Scenario, standing_landmarks, world_of
from pipistrelle.experiments.studies.plan import MAKERS, RADIUS, Plan, cases_of, common
from pipistrelle.experiments.studies.study import load_finished
from pipistrelle.experiments.studies.world import (
    STEPS,
    damaged,
    done_worlds,
    heard_settings,
    world_file,
    world_schemas,
)
from pipistrelle.files import read_file
from pipistrelle.report.variables import BEAM, Variable, beam_variable, setting_variable, word_of

if TYPE_CHECKING:
    import polars as pl

Rule = Literal["world", "case", "none"]
RULES: dict[Rule, str] = {
    "world": "a world is dropped for a filter where the mean NEES of a strategy's cases diverged",
    "case": "a world is dropped where a case at hand diverged",
    "none": "nothing is dropped but what has no number",
}
"""Exclusion rules, the paper's first."""
Way = tuple[str, str]
"""Filter and strategy."""
Cell = tuple[str, str, int]
"""Filter, strategy and number of the combination."""
HEADING, MAP_ALIGNED = "heading_rmse_rad", "map_rmse_aligned_m"
MAP = "map_rmse_m"
"""Map RMSE over the landmarks that the case itself has placed."""
POSITION_BOUND, HEADING_BOUND = "position_bound_m", "heading_bound_rad"
LANDMARKS, NEES = "landmarks_full", "nees_mean"
ONLINE_POSITION = "online_position_rmse_m"
"""Position RMSE of the path as estimated at each time, if the filter revises it later."""
READ = (*(name for name in SCORES if name not in NOT_MEANS), ONLINE_POSITION, "landmarks_full_mean")
"""Columns of a study's table of trials that are read."""
LATER = (ONLINE_POSITION, "caller_rmse_m", "caller_rmse_aligned_m")
"""Columns that studies may lack: no path is revised, or the study is older than the score."""
COMMON = "common_map_rmse_m"
"""Map RMSE over the landmarks that every strategy has placed."""
SAME = 1e-4
"""Relative difference below which an assumed value counts as the truth: 337.1 m/s at 10 °C."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trials:
    """Trials of a single filter and strategy, as arrays over n worlds and b cases."""

    at: Int[np.ndarray, " c"]
    """Case of each combination: passive sensing has a single case for all beamwidths."""
    failed: Bool[np.ndarray, "n b"]
    """The trial raised an error, or is missing."""
    diverged: Bool[np.ndarray, "n b"]
    """The NEES is not finite or passes the filter's limit."""
    scores: dict[str, Float[np.ndarray, "n _"]]
    """By the names of `READ`; NaN if there is no number. `COMMON` has a column for each
    combination, since the shared landmarks depend on the other strategies' cases."""
    placed: Bool[np.ndarray, "n b l"]
    """Fully initialised landmarks at the end, by label."""
    off: Float[np.ndarray, "n b l"]
    """[m] Distance of each placed landmark from the truth."""
    nees: Float[np.ndarray, "n b k"]
    """At each frame."""
    consistent: Float[np.ndarray, "2 b k"]
    """Mean and variance of a consistent filter's NEES at each frame, averaged over the worlds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """The finished worlds of a study as arrays: n worlds, c combinations of the variables."""

    name: str
    """The plan's name, which may hold any text."""
    variables: tuple[Variable, ...]
    """Settings with two values or more, in the plan's order."""
    grid: dict[str, tuple[Any, ...]]
    """All settings of the plan's grid, by dotted name."""
    planned: int
    """Number of worlds that the plan asks for."""
    worlds: Int[np.ndarray, " n"]
    """Numbers of the finished worlds."""
    config: Config
    configs: tuple[Config, ...]
    """Of each combination, without settings of single filters."""
    beamwidth: Float[np.ndarray, " c"]
    """[deg] Of the vehicle's call."""
    drawing: Int[np.ndarray, " c"]
    """Combinations with equal numbers have the same landmarks in every world."""
    example: Scenario | None
    """First world of the first combination; None if it cannot be drawn again."""
    trials: dict[Way, Trials]
    """By filter and strategy."""
    errors: tuple[Mapping[str, Any], ...]
    """The failed trials of ``summary.json``: world, case and traceback."""
    cpu_s: float
    """[s] Processor time of all filters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """A study together with a rule that excludes diverged trials or worlds from comparisons."""

    study: Study
    rule: Rule
    lost: Mapping[str, Bool[np.ndarray, " n"]]
    """By filter, the worlds in which it diverged (`lost_worlds`)."""


def selections(study: Study) -> dict[Rule, Selection]:
    """Apply every exclusion rule for diverged trials to a study; return the results by rule."""
    return {rule: select(study, rule) for rule in RULES}


def select(study: Study, rule: Rule) -> Selection:
    """Apply an exclusion rule for diverged trials to a study."""
    lost = {name: lost_worlds(study, name) for name in filter_titles(study)}
    return Selection(study=study, rule=rule, lost=lost)


def has_numbers(study: Study, score: str) -> bool:
    """Return whether a score is finite in any trial of a study."""
    return any(np.isfinite(trials.scores[score]).any() for trials in study.trials.values())


def along(study: Study, variable: Variable) -> Int[np.ndarray, "k m"]:
    """Return the indices of all combinations of variables, with a row per value of `variable`.

    `variable`: one of the study's. Returns: columns are the combinations of the other variables.
    """
    shape = [len(one.given) for one in study.variables]
    numbers = np.arange(len(study.beamwidth)).reshape(shape)
    return np.moveaxis(numbers, study.variables.index(variable), 0).reshape(len(variable.given), -1)


def combination_name(study: Study, number: int, without: Sequence[Variable] = ()) -> str:
    """Return a name for a combination of variables from their values, except `without`."""
    at = np.unravel_index(number, [len(one.given) for one in study.variables] or [1])
    return ", ".join(
        variable.words[i] if variable.name == BEAM else f"{variable.name} = {variable.words[i]}"
        for variable, i in zip(study.variables, at, strict=False)
        if variable not in without
    )


def case_name(study: Study, way: Way, number: int) -> str:
    """Return a name for a combination from the variables that affect a filter and strategy.

    Returns: empty for passive sensing if only the beam varies.
    """
    at = study.trials[way].at
    idle = [v for v in study.variables if np.all(at[along(study, v)] == at[along(study, v)][:1])]
    return combination_name(study, number, idle)


def own_cases(trials: Trials) -> Int[np.ndarray, " b"]:
    """Return for each case the index of the first combination of variables that it belongs to."""
    return np.unique(trials.at, return_index=True)[1]


def filter_titles(study: Study) -> dict[str, str]:
    """Return the titles of a study's filters by name, filters of the catalogue first.

    Other filters (``module:Class``) follow by name. Their title is the name of their class, or the
    whole name if two titles would be equal; their code is not needed to read a study.
    """
    names = {name for name, _ in study.trials}
    outside = sorted(names - CATALOGUE.keys())
    classes = {name: name.rpartition(":")[2] for name in outside}
    used = Counter([*classes.values(), *(entry.title for entry in CATALOGUE.values())])
    titles = {name: entry.title for name, entry in CATALOGUE.items() if name in names}
    return titles | {name: name if used[classes[name]] > 1 else classes[name] for name in outside}


def lost_worlds(study: Study, name: str) -> Bool[np.ndarray, " n"]:
    """Return a mask of worlds where a case failed, or the mean NEES of a strategy's cases diverged.

    Bradley & Abaid, Sec. V-A: the ANEES of an iteration. Without a limit in the catalogue, any
    diverged case counts.
    """
    lost = np.zeros(len(study.worlds), dtype=bool)
    limit = CATALOGUE[name].nees_limit if name in CATALOGUE else inf
    for trials in (of for (other, _), of in study.trials.items() if other == name):
        count = np.sum(~np.isnan(trials.nees), axis=1)
        mean = np.nansum(trials.nees, axis=1) / np.maximum(count, 1)
        alone = trials.diverged & (~np.isfinite(trials.scores[NEES]) | (limit == inf))
        lost |= (trials.failed | alone).any(axis=1) | (mean > limit).any(axis=1)
    return lost


def kept(selection: Selection, cells: Sequence[Cell]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the worlds where no compared case failed or is excluded.

    A failed trial counts as diverged; under the rule "none" it has no number.
    """
    counts = np.ones(len(selection.study.worlds), dtype=bool)
    for name, strategy, number in cells:
        trials = selection.study.trials[name, strategy]
        column = trials.at[number]
        counts &= ~trials.failed[:, column]
        if selection.rule == "case":
            counts &= ~trials.diverged[:, column]
    if selection.rule == "world":
        for name in {name for name, _, _ in cells}:
            counts &= ~selection.lost[name]
    return counts


def values(study: Study, score: str, cell: Cell) -> Float[np.ndarray, " n"]:
    """Return a score of a case in all worlds; NaN where it is missing."""
    name, strategy, number = cell
    trials = study.trials[name, strategy]
    return trials.scores[score][:, number if score == COMMON else trials.at[number]]


def samples(
    selection: Selection, score: str, cells: Sequence[Cell]
) -> list[Float[np.ndarray, " m"]]:
    """Return a score of several cases, in the worlds where all of them count and have a number.

    `score`: one of `READ`, or `COMMON`. Returns: an array per cell, over the same worlds.
    """
    columns = np.array([values(selection.study, score, cell) for cell in cells])
    both = kept(selection, cells) & np.all(np.isfinite(columns), axis=0)
    return list(columns[:, both])


def frame_time(study: Study, frames: int, number: int = 0) -> Float[np.ndarray, " k"]:
    """Return the times of the frames of a combination [s]."""
    scenario = study.configs[number].scenario
    return np.arange(1, frames + 1) * (scenario.steps_per_frame * scenario.step)


def lap_time(study: Study, number: int = 0) -> float:
    r"""Return the time of a lap without noise at a combination [s]; infinite for a straight drive.

    .. math:: 2 \pi B / (V |\sin\gamma|)

    Bradley & Abaid, Eq. (5).
    """
    config = study.configs[number]
    rate = config.scenario.speed * abs(sin(config.scenario.steering)) / config.motion.wheelbase
    return 2.0 * pi / rate if rate > 0.0 else inf


def rmse_of(
    off: Float[np.ndarray, "*n l"], shared: Bool[np.ndarray, "*n l"]
) -> Float[np.ndarray, "*n"]:
    """Return the root mean square distance [m] of the landmarks in a mask; NaN if it is empty."""
    count = np.sum(shared, axis=-1)
    square = np.sum(np.where(shared, np.asarray(off, dtype=np.float64) ** 2, 0.0), axis=-1)
    mean = np.divide(square, count, out=np.full(count.shape, np.nan), where=count > 0)
    return np.sqrt(mean)


def mean_std(sample: Float[np.ndarray, " m"]) -> tuple[float, float]:
    """Return the mean and standard deviation of a sample; NaN if it is empty."""
    if len(sample) == 0:
        return np.nan, np.nan
    return float(np.mean(sample)), float(np.std(sample, ddof=1)) if len(sample) > 1 else 0.0


def times_the_bound(selection: Selection, cell: Cell) -> float | None:
    """Return a case's position RMSE divided by its bound, both root mean squares over worlds.

    The bound is one of squares: the mean RMSE of an efficient estimator may be as low as 0.8 of it.
    If the filter revises its path, the path as estimated at each time counts. None if there is no
    bound.
    """
    score = ONLINE_POSITION if has_numbers(selection.study, ONLINE_POSITION) else POSITION
    errors, least = (samples(selection, name, [cell])[0] for name in (score, POSITION_BOUND))
    if score == ONLINE_POSITION and not len(errors):
        errors = samples(selection, POSITION, [cell])[0]
    if not len(errors) or not len(least):
        return None
    return float(np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(least))))


def read_study(folder: Path) -> Study:
    """Read the finished worlds of a study from its folder.

    `folder`: as `pipistrelle study` fills it. Raises InputError: no study, no finished world, or a
    file that cannot be read.
    """
    import polars as pl

    stored = load_finished(folder)
    try:
        tables = (table.collect() for table in (stored.trials, stored.steps, stored.landmarks))
        return _study(stored.plan, *tables)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise _unreadable(folder, stored.plan) from error


def _unreadable(folder: Path, plan: Plan) -> InputError:
    """Return the InputError for the first file of a study that has unexpected columns."""
    import polars as pl

    for world in sorted(done_worlds(folder)):
        for table, schema in world_schemas(plan).items():
            file = world_file(folder, table, world)
            if pl.read_parquet(read_file(file)).schema != pl.Schema(schema):
                return damaged(folder, table, world, "has not the columns of this study")
    return InputError(f"{folder}: could not be read, though each file can; run the report again")


def _study(
    plan: Plan, trials: "pl.DataFrame", steps: "pl.DataFrame", landmarks: "pl.DataFrame"
) -> Study:
    """Convert the three tables of a study to arrays."""
    variables = _variables(plan)
    fixed = {setting: values[0] for setting, values in plan.grid.items() if len(values) == 1}
    names = [variable.setting for variable in variables]
    grid = product(*(variable.given for variable in variables))
    configs = tuple(common(plan, fixed | dict(zip(names, row, strict=True))) for row in grid)
    variables = tuple(_against_truth(variable, configs) for variable in variables)
    worlds = np.unique(trials["iteration"].to_numpy())
    cases = trials.select("case", "filter", "strategy").unique().sort("case")
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
        trials=_trials(plan, _numbers(plan, cases, variables), worlds, trials, steps, landmarks),
        errors=_failures(plan, trials, variables),
        cpu_s=float(trials["cpu_s"].sum()),
    )


def _variables(plan: Plan) -> tuple[Variable, ...]:
    """Return the variables of a plan; emitter radii become beamwidths if these are unambiguous."""
    variables = []
    for setting, values in plan.grid.items():
        if len(values) < 2:
            continue
        variable = setting_variable(setting, values)
        if setting == RADIUS and not plan.grid.keys() & set(MAKERS):
            widths = [_degrees(common(plan, {RADIUS: radius})) for radius in values]
            if len(set(widths)) == len(widths):
                variable = beam_variable(RADIUS, values, widths)
        variables.append(variable)
    return tuple(variables)


def _against_truth(variable: Variable, configs: Sequence[Config]) -> Variable:
    """Use the true value of a setting as its reference value, if it is among the varied values."""
    truths = {_truth(variable.setting, config) for config in configs}
    truth = truths.pop() if len(truths) == 1 else None
    if truth is None or variable.numbers is None:
        return variable
    near = [i for i, one in enumerate(variable.numbers) if isclose(one, truth, rel_tol=SAME)]
    return replace(variable, base=near[0]) if len(near) == 1 else variable


def _truth(setting: str, config: Config) -> float | None:
    """Return the true value of an assumed setting or a bias; None for other settings."""
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


def _numbers(
    plan: Plan, cases: "pl.DataFrame", variables: Sequence[Variable]
) -> dict[Way, Int[np.ndarray, " c"]]:
    """Return the case number of each combination of variables, by filter and strategy."""
    given = [[repr(value) for value in variable.given] for variable in variables]
    values = {case.number: case.values for case in cases_of(plan)}
    numbers: dict[Way, Int[np.ndarray, ...]] = {}
    for case, name, strategy in cases.rows():
        of_way = numbers.setdefault((name, strategy), np.empty(list(map(len, given)), dtype=int))
        wanted = [values[case][variable.setting] for variable in variables]
        index = tuple(
            slice(None) if value is None else texts.index(repr(value))
            for value, texts in zip(wanted, given, strict=True)
        )
        of_way[index] = case
    return {way: of_way.reshape(-1) for way, of_way in sorted(numbers.items())}


def _drawn(plan: Plan, config: Config, world: int) -> Scenario | None:
    """Generate a world of a plan again; None if that is impossible, as without its folder."""
    try:
        return world_of(config, world, plan.world(config))
    except InputError:
        return None


def _drawings(plan: Plan, configs: Sequence[Config], world: int) -> Int[np.ndarray, " c"]:
    """Number the combinations so that equal numbers mean equal landmarks in every world."""
    numbers: dict[Any, int] = {}
    by_settings: dict[str, int] = {}
    drawings = []
    for number, config in enumerate(configs):
        if (same := heard_settings(config)) not in by_settings:
            key: Any = number
            if drawn := _drawn(plan, config, world):
                key = tuple(part.tobytes() for part in standing_landmarks(drawn))
            by_settings[same] = numbers.setdefault(key, len(numbers))
        drawings.append(by_settings[same])
    return np.array(drawings)


def _failures(
    plan: Plan, trials: "pl.DataFrame", variables: Sequence[Variable]
) -> tuple[dict[str, Any], ...]:
    """List the failed trials of a study with their settings and error messages."""
    import polars as pl

    values = {case.number: case.values for case in cases_of(plan)}
    others = [variable for variable in variables if variable.name != BEAM]
    broken = trials.filter(pl.col("status") != "done").sort("iteration", "case")
    keys = ("iteration", "strategy", "filter", "beamwidth_deg")
    return tuple(
        {key: row[key] for key in keys}
        | {"settings": {v.name: word_of(v, values[row["case"]][v.setting]) for v in others}}
        | {"error": row["error"] or ""}
        for row in broken.iter_rows(named=True)
    )


def _trials(
    plan: Plan,
    numbers: Mapping[Way, Int[np.ndarray, " c"]],
    worlds: Int[np.ndarray, " n"],
    trials: "pl.DataFrame",
    steps: "pl.DataFrame",
    landmarks: "pl.DataFrame",
) -> dict[Way, Trials]:
    """Return the trials of each filter and strategy as arrays, from a study's tables."""
    shape = len(worlds), len(cases_of(plan))
    # Labels below 0 are of map entries that a data association took for no true landmark.
    landmarks = landmarks.filter(landmarks["landmark"] >= 0)
    failed = ~_array(trials, trials["status"] == "done", worlds, shape, empty=False)
    diverged = _array(trials, trials["diverged"].fill_null(value=False), worlds, shape, empty=False)
    scores = {
        score: _array(trials, trials[score].cast(float).fill_null(np.nan), worlds, shape)
        if score not in LATER or score in trials.columns
        else np.full(shape, np.nan)
        for score in READ
    }
    nees, *ideal = (
        _array(steps, steps[column], worlds, shape, at=steps["frame"].to_numpy().astype(int) - 1)
        for column in STEPS[2:]
    )
    label = landmarks["landmark"].to_numpy()
    full = _array(landmarks, landmarks["full"], worlds, shape, at=label, empty=False)
    none = np.float32(0.0)
    error = _array(landmarks, landmarks["error_m"], worlds, shape, at=label, empty=none)
    common: dict[Way, Float[np.ndarray, "n c"]] = {}
    for name in {name for name, _ in numbers}:
        of_filter = {way: cases for way, cases in numbers.items() if way[0] == name}
        shared = np.all([full[:, cases] for cases in of_filter.values()], axis=0)
        common |= {way: rmse_of(error[:, cases], shared) for way, cases in of_filter.items()}
    with np.errstate(invalid="ignore"):  # the mean of NaN only is NaN
        means = [np.nansum(one, axis=0) / np.sum(np.isfinite(one), axis=0) for one in ideal]
    by_way = {}
    for way, cases in numbers.items():
        first = np.sort(np.unique(cases, return_index=True)[1])
        c = cases[first]
        by_way[way] = Trials(
            at=np.argmax(cases[:, None] == c, axis=1),
            failed=failed[:, c],
            diverged=diverged[:, c],
            scores={score: table[:, c] for score, table in scores.items()} | {COMMON: common[way]},
            placed=full[:, c],
            off=error[:, c],
            nees=nees[:, c],
            consistent=np.array([mean[c] for mean in means]),
        )
    return by_way


def _array(
    table: "pl.DataFrame",
    values: "pl.Series",
    worlds: Int[np.ndarray, " n"],
    shape: tuple[int, ...],
    *,
    at: Int[np.ndarray, " r"] | None = None,
    empty: Any = np.nan,
) -> np.ndarray:
    """Arrange a table's values in an array by world and case, and by a third index if given.

    `empty`: the value without a row.
    """
    index = [np.searchsorted(worlds, table["iteration"].to_numpy()), table["case"].to_numpy()]
    if at is not None:
        index.append(at)
        shape = (*shape, int(np.max(at, initial=-1)) + 1)
    array = np.full(shape, empty)
    array[tuple(part.astype(np.intp) for part in index)] = values.to_numpy()
    return array
