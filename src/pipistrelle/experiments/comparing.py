"""Comparison of result folders: missions or studies, each with the first folder.

Missions, as `run` and `slam` write them, are compared by their scores and paths. A path is shown as
recorded and after the rigid motion that fits it best to its reference: its truth, else another
folder's truth, else the path of the first folder.

Studies are compared case by case: cases match if strategy, filter and all varied values agree.
Cases that drew the same worlds (seed, scenario, motion) are paired world by world; of others the
means are compared. The cases of a score are one family (`evaluation.comparison.contrasts`).
"""

import json
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.evaluation.accuracy import alignment, moved, position_error
from pipistrelle.evaluation.comparison import INTERVALS, Contrast, contrasts
from pipistrelle.evaluation.scores import NOT_MEANS, SCORES
from pipistrelle.experiments.results.reading import (
    Estimate,
    StoredMission,
    StoredPath,
    read_mission,
    results_in,
)
from pipistrelle.experiments.studies.plan import RADIUS, Plan, PlannedCase, cases_of, plan_settings
from pipistrelle.experiments.studies.study import load_study
from pipistrelle.experiments.studies.world import check_world, done_worlds
from pipistrelle.files import read_file, without_links
from pipistrelle.geometry import wrap

if TYPE_CHECKING:
    import polars as pl

K = TypeVar("K", bound=Hashable)
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Short names of folders."""
POSITION = "position_rmse_m"
ROUNDING = 1e-6
"""Paths that differ by less are of the same drive [m, rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathView:
    """A path as recorded, and fitted to its reference by a rigid motion."""

    time: Float[np.ndarray, " k"]
    """[s] From the path's own start."""
    raw: Float[np.ndarray, "k 2"]
    aligned: Float[np.ndarray, "k 2"]
    """[m]"""
    placed: Float[np.ndarray, "n 2"]
    placed_aligned: Float[np.ndarray, "n 2"]
    """[m] Placed landmarks of its map, moved with the path."""
    error: Float[np.ndarray, " k"]
    error_aligned: Float[np.ndarray, " k"]
    """[m] Distance from the reference; NaN if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedEstimate:
    """An estimate that all folders have."""

    title: str
    """Strategy and filter that the estimates share."""
    estimates: tuple[Estimate, ...]
    """One of each folder."""
    scores: tuple[Mapping[str, Any], ...]
    """Under the names of ``summary.json``."""
    views: tuple[PathView, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedMissions:
    """Folders of `run` or `slam`, compared with the first."""

    folders: tuple[Path, ...]
    versions: tuple[str, ...]
    compared: tuple[ComparedEstimate, ...]
    alone: Mapping[Estimate, tuple[int, ...]]
    """Estimates that some folders lack, and the folders that have them."""
    settings: Mapping[str, tuple[Any, ...]]
    """Settings that differ, in the sections that all folders have."""
    sections_alone: Mapping[str, tuple[int, ...]]
    """Sections that some folders lack, as logs lack a world."""
    truths: tuple[StoredPath | None, ...]
    one_drive: bool
    """Whether all folders hold the same drive, as far as known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedCase:
    """A score of a case in the first study and in another."""

    label: str
    strategies: tuple[str, str]
    filters: tuple[str, str]
    values: Mapping[str, Any]
    """Values of all settings that any study varies."""
    beamwidth_deg: float | None
    """Of the vehicle's call, if it matters."""
    score: str
    other: int
    """Index of the other study."""
    diverged: tuple[int, int]
    """Worlds in which the case diverged or failed, of all finished."""
    contrast: Contrast
    """Of the other study with the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedStudies:
    """Folders of studies, compared with the first."""

    folders: tuple[Path, ...]
    versions: tuple[str, ...]
    """Empty if a folder's README does not contain it."""
    done: tuple[int, ...]
    planned: tuple[int, ...]
    """Numbers of worlds."""
    cases: tuple[ComparedCase, ...]
    """By score, then by case, then by study."""
    overall: tuple[Contrast, ...]
    """Position RMSE of each other study, averaged over the cases of a world."""
    alone: tuple[tuple[str, tuple[int, ...]], ...]
    """Cases that some folders lack, and the folders that have them."""
    settings: Mapping[str, tuple[Any, ...]]
    """Settings of the plans that differ."""
    dropped_diverged: bool
    """Whether worlds in which either case diverged are left out."""


Compared = ComparedMissions | ComparedStudies


@dataclass(frozen=True, slots=True, kw_only=True)
class _ReadStudy:
    """A study's plan, its number of finished worlds, and the trials of each case."""

    plan: Plan
    worlds: int
    trials: "Mapping[int, pl.DataFrame]"


def kind_of(folders: Sequence[Path]) -> Literal["missions", "studies"]:
    """Return whether folders hold missions or studies.

    Raises InputError if they are too few or too many, repeated, or not of one kind.

    Examples
    --------
    >>> kind_of([Path("one"), Path("two"), Path("./one")])
    Traceback (most recent call last):
    pipistrelle.config.InputError: one: is given twice, as A and C; name each folder once
    """
    if not 2 <= len(folders) <= len(LETTERS):
        expected = f"expected 2 to {len(LETTERS)} of `run`, `slam` or `study`"
        alone = "; the table of `run` or `slam` compares the estimates of one folder"
        found = f"found {len(folders)} folder{'' if len(folders) == 1 else 's'}"
        raise InputError(f"compare: {found}, {expected}{alone * (len(folders) == 1)}")
    seen: dict[Path, int] = {}
    for i, folder in enumerate(folders):
        first = seen.setdefault(without_links(folder), i)
        if first != i:
            twice = f"is given twice, as {LETTERS[first]} and {LETTERS[i]}"
            also = "" if folders[first].absolute() == folder.absolute() else f" ({folder})"
            raise InputError(f"{folders[first]}: {twice}{also}; name each folder once")
    studies = [(folder / "plan.toml").is_file() for folder in folders]
    if all(studies):
        return "studies"
    if any(studies):
        one, other = folders[studies.index(True)], folders[studies.index(False)]
        results_in(other)
        raise InputError(
            f"{one}: is a study's folder, and {other} is not; expected folders of one kind"
        )
    return "missions"


def distinguishing(folders: Sequence[Sequence[Estimate]]) -> tuple[bool, bool]:
    """Return whether strategies, and whether filters, differ within any folder.

    Others do not name an estimate: folders of one filter each are compared strategy by strategy.

    Examples
    --------
    >>> both = [("active", "ekf"), ("fused", "ekf")]
    >>> distinguishing([both, [("fused", "smoother")]])
    (True, False)
    """
    strategy, name = (
        any(len({estimate[part] for estimate in estimates}) > 1 for estimates in folders)
        for part in (0, 1)
    )
    return strategy, name


def named(estimate: Estimate, parts: tuple[bool, bool] = (True, True)) -> Estimate:
    """Return the key of an estimate, without parts that `distinguishing` excludes.

    Examples
    --------
    >>> named(("fused", "ekf"), (True, False))
    ('fused', '')
    """
    strategy, name = estimate
    return strategy * parts[0], name * parts[1]


def shared_name(estimates: Sequence[Estimate]) -> str:
    """Return the strategy and filter that estimates share.

    Examples
    --------
    >>> shared_name([("fused", "ekf"), ("fused", "mine:Own")]), shared_name([("fused", "mine:Own")])
    ('fused', 'fused Own')
    """
    strategies, filters = ({estimate[part] for estimate in estimates} for part in (0, 1))
    common = [only for (only, *others) in (sorted(strategies), sorted(filters)) if not others]
    return " ".join(map(short_name, common))


def matched(keys: Sequence[Sequence[K]]) -> tuple[tuple[K, ...], dict[K, tuple[int, ...]]]:
    """Return the keys of all folders, and the owners of every other key.

    `keys`: of each folder, without repetition. Returns: in the order of the first folder.

    Examples
    --------
    >>> matched([["a", "b"], ["c", "b"]])
    (('b',), {'a': (0,), 'c': (1,)})
    """
    owners = {
        key: tuple(i for i, own in enumerate(keys) if key in own) for each in keys for key in each
    }
    everywhere = tuple(key for key, who in owners.items() if len(who) == len(keys))
    return everywhere, {key: who for key, who in owners.items() if len(who) < len(keys)}


def differing(settings: Sequence[Mapping[str, Any]]) -> dict[str, tuple[Any, ...]]:
    """Return the settings that differ between folders, with their values (None if missing).

    Examples
    --------
    >>> differing([{"seed": 1, "rays.power": 2.0}, {"seed": 1, "rays.power": 3.0, "x": 0}])
    {'rays.power': (2.0, 3.0), 'x': (None, 0)}
    """
    values = {
        name: tuple(one.get(name) for one in settings)
        for name in dict.fromkeys(name for one in settings for name in one)
    }
    return {name: some for name, some in values.items() if any(v != some[0] for v in some)}


def section(name: str) -> str:
    """Return the section of a dotted setting, or the setting itself without a dot.

    Examples
    --------
    >>> section("rays.power"), section("seed")
    ('rays', 'seed')
    """
    return name.partition(".")[0]


def compare_missions(folders: Sequence[Path]) -> ComparedMissions:
    """Compare the results of `run` or `slam` in two or more folders.

    Raises InputError if a folder cannot be read, or no estimate is in all of them.
    """
    missions = [read_mission(folder) for folder in folders]
    parts = distinguishing([tuple(mission.scores) for mission in missions])
    own = [{named(estimate, parts): estimate for estimate in m.scores} for m in missions]
    common, alone = matched([tuple(keys) for keys in own])
    if not common:
        tried = "; ".join(
            f"{mission.folder} has {', '.join(f'{s} {short_name(f)}' for s, f in mission.scores)}"
            for mission in missions
        )
        raise InputError(
            f"compare: found no estimate that all folders have: {tried}; expected one of the same "
            "--strategy and --filter, or folders of one strategy or one filter each"
        )
    shared, lacking = matched([sorted(set(map(section, mission.settings))) for mission in missions])
    settings_shared = [
        {name: value for name, value in mission.settings.items() if section(name) in shared}
        for mission in missions
    ]
    return ComparedMissions(
        folders=tuple(folders),
        versions=tuple(mission.version for mission in missions),
        compared=tuple(_compared(missions, [keys[key] for keys in own]) for key in common),
        alone={own[who[0]][key]: who for key, who in alone.items()},
        settings=differing(settings_shared),
        sections_alone=lacking,
        truths=tuple(mission.truth for mission in missions),
        one_drive=_one_drive(missions),
    )


def _compared(missions: Sequence[StoredMission], estimates: Sequence[Estimate]) -> ComparedEstimate:
    """Return one estimate of each folder with scores and paths."""
    chosen = list(zip(missions, estimates, strict=True))
    truths = (mission.truth for mission in missions if mission.truth is not None)
    whole = next(truths, missions[0].paths[estimates[0]])
    return ComparedEstimate(
        title=shared_name(estimates),
        estimates=tuple(estimates),
        scores=tuple(mission.scores[estimate] for mission, estimate in chosen),
        views=tuple(
            path_view(mission.paths[estimate], mission.maps[estimate], mission.truth or whole)
            for mission, estimate in chosen
        ),
    )


@np.errstate(over="ignore", invalid="ignore")
def path_view(
    path: StoredPath, placed: Float[np.ndarray, "n 2"], reference: StoredPath
) -> PathView:
    """Fit a path to a reference by a rigid motion; return it before and after.

    `placed` [m]: landmarks, moved with it. `reference`: compared at common times, except the start.
    Returns: unmoved if fewer than two poses can be compared.

    Examples
    --------
    >>> line = StoredPath(time=np.arange(4.0), pose=np.eye(4, 3) * 0.0 + np.arange(4.0)[:, None])
    >>> off = StoredPath(time=line.time, pose=line.pose + [0.0, 3.0, 0.0])
    >>> view = path_view(off, np.zeros((0, 2)), line)
    >>> view.error.tolist(), view.error_aligned.round(9).tolist()
    ([3.0, 3.0, 3.0, 3.0], [0.0, 0.0, 0.0, 0.0])
    """
    raw = path.pose[:, :2]
    _, own_rows, other_rows = np.intersect1d(path.time, reference.time, return_indices=True)
    true = np.full_like(raw, np.nan)
    true[own_rows] = reference.pose[other_rows, :2]
    counted = np.isfinite(true).all(axis=1) & np.isfinite(raw).all(axis=1)
    counted &= path.time > path.time[0]
    fit = alignment(raw[counted], true[counted]) if np.sum(counted) > 1 else np.zeros(3)
    aligned = moved(raw, fit)
    return PathView(
        time=path.time - path.time[0],
        raw=raw,
        aligned=aligned,
        placed=placed,
        placed_aligned=moved(placed, fit),
        error=position_error(raw, true),
        error_aligned=position_error(aligned, true),
    )


def _one_drive(missions: Sequence[StoredMission]) -> bool:
    """Return whether all folders hold the same drive, from their truths and times."""
    truths = [mission.truth for mission in missions if mission.truth is not None]
    paths = [path for mission in missions for path in mission.paths.values()]
    same = all(np.array_equal(path.time, paths[0].time) for path in paths)
    return same and all(_same(truth, truths[0]) for truth in truths)


def _same(path: StoredPath, other: StoredPath) -> bool:
    """Return whether two paths are equal up to rounding."""
    if not np.array_equal(path.time, other.time):
        return False
    off = path.pose - other.pose
    off[:, 2] = wrap(off[:, 2])
    return bool(np.all(np.abs(off) < ROUNDING))


def compare_studies(folders: Sequence[Path], *, drop_diverged: bool = False) -> ComparedStudies:
    """Compare the scores of two or more studies.

    `drop_diverged`: leave out worlds in which either of two cases diverged; otherwise all worlds
    with a number count. Raises InputError if a folder cannot be read, has no finished world, or no
    case is in all of them.
    """
    studies = [_read(folder) for folder in folders]
    varied = tuple(dict.fromkeys(name for one in studies for name in one.plan.grid))
    planned = [cases_of(one.plan) for one in studies]
    parts = distinguishing([[(case.strategy, case.filter) for case in cases] for cases in planned])
    keyed = [{_key(case, varied, parts): case for case in cases} for cases in planned]
    common, alone = matched([tuple(cases) for cases in keyed])
    if not common:
        raise _nothing_in_common(folders, studies)
    rows = [[cases[key] for cases in keyed] for key in common]
    left = [(keyed[who[0]][key], who) for key, who in alone.items()]
    cases, overall = _judged(studies, rows, varied, drop_diverged)
    return ComparedStudies(
        folders=tuple(folders),
        versions=tuple(map(_version, folders)),
        done=tuple(one.worlds for one in studies),
        planned=tuple(one.plan.planned for one in studies),
        cases=cases,
        overall=overall,
        alone=tuple((_label([case], varied, studies[who[0]].trials), who) for case, who in left),
        settings=differing([plan_settings(one.plan) for one in studies]),
        dropped_diverged=drop_diverged,
    )


def _read(folder: Path) -> _ReadStudy:
    """Read a study's trials; raise InputError if a file was changed."""
    import polars as pl

    worlds = sorted(done_worlds(folder))
    if not worlds:
        raise InputError(
            f"{folder}: no world is done yet; `pipistrelle study` with -o {folder} goes on"
        )
    stored = load_study(folder)
    for world in worlds:
        check_world(folder, stored.plan, world)
    try:
        trials = stored.trials.collect()
        parted = trials.partition_by("case", as_dict=True)
        tables = {case: table for (case,), table in parted.items()}
        for table in tables.values():
            table.select("iteration", "status", "diverged", "beamwidth_deg", POSITION)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise InputError(
            f"{folder}: its trials have not the columns of this version; run the study anew"
        ) from error
    return _ReadStudy(plan=stored.plan, worlds=len(worlds), trials=tables)


def _nothing_in_common(folders: Sequence[Path], studies: Sequence[_ReadStudy]) -> InputError:
    """Return the error of studies without a common case."""
    tried = []
    for folder, one in zip(folders, studies, strict=True):
        ways = f"{', '.join(one.plan.strategies)} by {', '.join(map(short_name, one.plan.filters))}"
        varied = "; ".join(f"{name} {list(values)}" for name, values in one.plan.grid.items())
        tried.append(f"{folder} tries {ways}" + f" at {varied}" * bool(varied))
    return InputError(
        f"compare: found no case that all studies have: {'. '.join(tried)}. Expected a strategy, a "
        "filter and values of what either varies that all have"
    )


def _key(
    case: PlannedCase, varied: Sequence[str], parts: tuple[bool, bool]
) -> tuple[str, str, tuple[str, ...]]:
    """Return the key that matches a case between studies."""
    values = tuple(json.dumps(_value(case, name)) for name in varied)
    return *named((case.strategy, case.filter), parts), values


def _value(case: PlannedCase, name: str) -> Any:
    """Return a case's value of a setting; None for the beam of passive sensing."""
    if name == RADIUS and case.strategy == "passive":
        return None
    value: Any = case.config.model_dump(mode="json")
    for part in name.split("."):
        value = value[part]
    return value


def _label(
    cases: Sequence[PlannedCase], varied: Sequence[str], trials: "Mapping[int, pl.DataFrame]"
) -> str:
    """Name matched cases by their common properties; `trials`: of the first study."""
    first, words = cases[0], [shared_name([(case.strategy, case.filter) for case in cases])]
    for name in varied:
        value = _value(first, name)
        if name == RADIUS and first.number in trials:
            value = trials[first.number]["beamwidth_deg"].drop_nulls()[:1].to_list()
            words += [f"{width:.1f}°" for width in value]
        elif value is not None:
            words.append(f"{name} {value if isinstance(value, str) else json.dumps(value)}")
    return ", ".join(filter(None, words)) or "the case"


def draw_of(config: Config) -> str:
    """Return the settings that draw the worlds, as text.

    Worlds of equal text are the same, even if other things are heard in them.

    Examples
    --------
    >>> draw_of(Config()) == draw_of(Config(seed=8))
    False
    """
    return config.model_dump_json(include={"seed", "scenario", "motion"})


def _judged(
    studies: Sequence[_ReadStudy],
    rows: Sequence[Sequence[PlannedCase]],
    varied: Sequence[str],
    drop_diverged: bool,
) -> tuple[tuple[ComparedCase, ...], tuple[Contrast, ...]]:
    """Compare every score case by case, and the position RMSE averaged over the cases.

    `rows`: matched cases, of each study one.
    """
    import polars as pl

    tables, blank = [], next(iter(studies[0].trials.values())).clear()
    draws: dict[str, int] = {}
    scores = dict.fromkeys(_scored(studies), pl.Float64)
    heads: dict[tuple[int, int], dict[str, Any]] = {}
    for number, row in enumerate(rows):
        trials = [
            one.trials.get(case.number, blank) for one, case in zip(studies, row, strict=True)
        ]
        lost = [(one["status"] != "done") | one["diverged"].fill_null(False) for one in trials]
        label = _label(row, varied, studies[0].trials)
        values = {name: _value(row[0], name) for name in varied}
        for folder, (case, table) in enumerate(zip(row, trials, strict=True)):
            draw = draws.setdefault(draw_of(case.config), len(draws))
            drops = table["diverged"].fill_null(False) & drop_diverged
            # The first row never counts: it stands for cases without any trial.
            columns = {"world": [-1, *table["iteration"]], "drops": [True, *drops]}
            columns |= {score: [None, *table[score].cast(float)] for score in scores}
            head = {"case": number, "folder": folder, "draw": draw}
            head = {name: pl.lit(value) for name, value in head.items()}
            tables.append(pl.DataFrame(columns, schema_overrides=scores).with_columns(**head))
            heads[number, folder] = {
                "label": label,
                "strategies": (row[0].strategy, case.strategy),
                "filters": (row[0].filter, case.filter),
                "values": values,
                "beamwidth_deg": next(iter(trials[0]["beamwidth_deg"].drop_nulls()), None),
                "diverged": (int(lost[0].sum()), int(lost[folder].sum())),
            }
    index = ["case", "folder", "draw", "world", "drops"]
    frame = pl.concat(tables).unpivot(index=index, variable_name="score")
    frame = frame.with_columns(value=pl.when(~pl.col("drops")).then("value"))
    judged = contrasts(frame, "folder", ["score", "case"], family=["score"], draw="draw")
    cases = tuple(
        ComparedCase(
            **heads[one.by["case"], one.b], score=one.by["score"], other=one.b, contrast=one
        )
        for one in judged
    )
    paired = set(range(len(studies))) - {one.b for one in judged if not one.paired}
    draw = pl.col("folder").replace(dict.fromkeys(paired, 0))
    position = frame.filter(pl.col("score") == POSITION).with_columns(draw=draw)
    return cases, contrasts(position, "folder", over=["case"], draw="draw")


def _scored(studies: Sequence[_ReadStudy]) -> list[str]:
    """Return the scores that all studies keep and that have any number."""
    tables = [table for one in studies for table in one.trials.values()]
    return [
        name
        for name in SCORES
        if name not in NOT_MEANS and all(name in table.columns for table in tables)
        if name == POSITION or any(table[name].cast(float).is_finite().any() for table in tables)
    ]


def _version(folder: Path) -> str:
    """Return the version that wrote a study, from its README; empty if it is missing."""
    try:
        text = read_file(folder / "README.md").decode()
    except (OSError, UnicodeDecodeError, InputError):
        return ""
    match = re.search(r"Written by Pipistrelle (\S+)\.\s", text)
    return match[1] if match else ""


def notes_of(compared: Compared) -> tuple[str, ...]:
    """Return the remarks on a comparison that a reader needs, a line each."""
    if isinstance(compared, ComparedMissions):
        return _mission_notes(compared)
    notes, paired = [], {case.contrast.paired for case in compared.cases}
    if paired == {True}:
        notes.append("Paired over the worlds that both have met.")
    elif paired == {False}:
        notes.append(
            "Not paired: the worlds are not the same (seed, scenario or motion differ), so means "
            "over different worlds are compared."
        )
    else:
        notes.append("Paired where the worlds are the same, without a mark; ~: means over others.")
    notes.append(f"*: shown, as one of all cases of its table. {INTERVALS}")
    left = "are left out" if compared.dropped_diverged else "count, as far as they have a number"
    notes.append(f"Worlds in which a case diverged {left}.")
    for who in dict.fromkeys(its for _, its in compared.alone):
        labels = [label for label, its in compared.alone if its == who]
        some = "; ".join(labels[:4]) + f"; and {len(labels) - 4} more" * (len(labels) > 4)
        notes.append(f"Only in {_letters(who)}, not compared: {some}")
    return tuple(notes)


def _mission_notes(compared: ComparedMissions) -> tuple[str, ...]:
    """Return the remarks on a comparison of missions."""
    notes = []
    for (strategy, name), who in compared.alone.items():
        notes.append(f"{strategy} {short_name(name)}: only in {_letters(who)}, not compared")
    if not compared.one_drive:
        notes.append("The drives are not the same: each difference is that of one draw.")
    lacking = [i for i, truth in enumerate(compared.truths) if truth is None]
    if 0 < len(lacking) < len(compared.truths):
        notes.append(f"Without truth: {_letters(lacking)}; there is nothing to score it by.")
    for who in dict.fromkeys(compared.sections_alone.values()):
        names = [name for name, its in compared.sections_alone.items() if its == who]
        notes.append(f"Settings of {', '.join(names)}: only in {_letters(who)}, not compared")
    return tuple(notes)


def _letters(who: Sequence[int]) -> str:
    """Return the letters of some folders."""
    return " and ".join(LETTERS[i] for i in who)
