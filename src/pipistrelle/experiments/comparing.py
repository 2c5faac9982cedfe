"""Comparison of result folders: missions or studies, each with the first folder.

Missions, as `run` and `slam` write them, are compared by their scores and paths. A path is shown as
recorded and after the rigid motion that fits it best to its reference: its truth, else another
folder's truth, else the path of the first folder.

Studies are compared case by case: cases match if strategy, filter and all varied values agree.
Cases that drew the same worlds (seed, scenario, motion) are paired world by world; of others the
means are compared. The cases of a score are one family (`evaluation.comparison.contrasts`).

`write_comparison` keeps all numbers, the settings that differ, a figure and a README in a folder.
"""

import io
import json
import math
import re
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Float

from pipistrelle import __version__
from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.readers import STUDY, kind_of
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.evaluation.accuracy import alignment, moved, position_error
from pipistrelle.evaluation.comparison import INTERVALS, Contrast, contrasts
from pipistrelle.evaluation.scores import NOT_MEANS, POSITION, POSITION_ALIGNED, SCORES
from pipistrelle.experiments.results.reading import (
    Estimate,
    StoredMission,
    StoredPath,
    read_mission,
    results_in,
)
from pipistrelle.experiments.studies.plan import RADIUS, Plan, PlannedCase, cases_of, plan_settings
from pipistrelle.experiments.studies.study import load_finished
from pipistrelle.experiments.studies.world import cell_of
from pipistrelle.files import OwnFiles, drawn_files, read_file, shipped_text, spelt, without_links
from pipistrelle.geometry import wrap
from pipistrelle.settings import known_settings, leaves

if TYPE_CHECKING:
    import polars as pl

K = TypeVar("K", bound=Hashable)
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Short names of folders."""
SIGNIFICANCE = 0.05
"""Differences with a smaller p, corrected for all cases, are marked as shown."""
ROUNDING = 1e-6
"""Paths that differ by less are of the same drive [m, rad]."""
MISSIONS = (
    "a row for each estimate, folder and score",
    "the paths, as they are and each after the rigid motion that brings it nearest to its truth "
    "(without one, to the first folder's path); beside them the distance from there",
)
STUDIES = (
    "a row for each case, study and score: means, their difference, its interval by itself "
    "(alone_low, alone_high) and as one of all cases (low, high), and p as one of them (Holm)",
    "the differences by case: thick by itself, thin as one of all cases; full points are "
    "significant, crosses had worlds that diverged or failed",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PathView:
    """Estimated path before and after alignment to a reference path, with both position errors."""

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
    """The same estimate (strategy and filter) from every compared folder: scores and paths."""

    title: str
    """Strategy and filter that the estimates share."""
    estimates: tuple[Estimate, ...]
    """One of each folder."""
    scores: Mapping[str, tuple[float | None, ...]]
    """Each score in every folder."""
    views: tuple[PathView, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """Base of a comparison: result folders by letter, settings that differ, and remarks."""

    folders: Mapping[str, Path]
    settings: Mapping[str, tuple[str | None, ...]]
    """Settings and versions that differ, with their texts in all folders."""
    notes: tuple[str, ...]
    """Remarks that a reader needs, a line each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedMissions(Compared):
    """Comparison of result folders of `run` or `slam`: matched estimates and true paths."""

    estimates: tuple[ComparedEstimate, ...]
    truths: tuple[StoredPath | None, ...]
    one_drive: bool
    """Whether all folders hold the same drive, as far as known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedStudies(Compared):
    """Comparison of study folders: score differences with intervals, by case and averaged."""

    worlds: tuple[tuple[int, int], ...]
    """Numbers of finished and of planned worlds."""
    rows: tuple[Mapping[str, Any], ...]
    """Rows of `comparison_table`: by score, then by case, then by study."""
    overall: tuple[tuple[str, Contrast], ...]
    """Position RMSEs, aligned and raw, of each other study, averaged over the cases of a world."""


def are_studies(folders: Sequence[Path]) -> bool:
    """Return whether all folders hold studies; otherwise none does.

    Raises InputError if they are too few or too many, repeated, or not of one kind.
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
    studies = [kind_of(folder) == STUDY for folder in folders]
    if any(studies) and not all(studies):
        one, other = folders[studies.index(True)], folders[studies.index(False)]
        results_in(other)
        expected = "folders of one kind"
        raise InputError(f"{one}: is a study's folder, and {other} is not; expected {expected}")
    return all(studies)


def distinguishing(folders: Iterable[Iterable[Estimate]]) -> tuple[bool, bool]:
    """Return two booleans: whether any folder has several strategies, and several filters.

    Others do not name an estimate: folders of a single filter are compared strategy by strategy.
    """
    parts = [[set(part) for part in zip(*estimates, strict=True)] for estimates in folders]
    strategies, filters = zip(*parts, strict=True)
    return max(map(len, strategies)) > 1, max(map(len, filters)) > 1


def named(estimate: Estimate, parts: tuple[bool, bool]) -> Estimate:
    """Return an estimate's (strategy, filter) with "" for a part that varies in no folder."""
    strategy, name = estimate
    return strategy * parts[0], name * parts[1]


def shared_name(estimates: Sequence[Estimate]) -> str:
    """Return the strategy and filter names that all given estimates have in common, as text."""
    parts = [set(part) for part in zip(*estimates, strict=True)]
    return " ".join(short_name(only) for (only, *others) in map(sorted, parts) if not others)


def matched(keys: Sequence[Iterable[K]]) -> tuple[tuple[K, ...], dict[K, tuple[int, ...]]]:
    """Return the keys that all folders contain, and for each other key the folders that have it."""
    owners: dict[K, tuple[int, ...]] = {}
    for i, own in enumerate(keys):
        for key in own:
            owners[key] = (*owners.get(key, ()), i)
    everywhere = tuple(key for key, who in owners.items() if len(who) == len(keys))
    return everywhere, {key: who for key, who in owners.items() if len(who) < len(keys)}


def differing(settings: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str | None, ...]]:
    """Return the settings with unequal values in the folders, each value as text or None."""
    unlike = {}
    for name in dict.fromkeys(name for one in settings for name in one):
        values = [one.get(name) for one in settings]
        if any(value != values[0] for value in values):
            texts = (v if isinstance(v, str | None) else json.dumps(v) for v in values)
            unlike[name] = tuple(texts)
    return unlike


def _lettered(
    folders: Sequence[Path], versions: Sequence[str], settings: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return two fields of a comparison: its folders by letter, and the settings that differ."""
    version = [{"version of Pipistrelle": version or None} for version in versions]
    return {
        "folders": dict(zip(LETTERS, folders, strict=False)),
        "settings": differing(version) | differing(settings),
    }


def _letters(who: Iterable[int]) -> str:
    """Format folder indices as letters, such as "A and C" for 0 and 2."""
    return " and ".join(LETTERS[i] for i in who)


def compare_missions(folders: Sequence[Path]) -> ComparedMissions:
    """Compare the results of `run` or `slam` in two or more folders.

    Raises InputError if a folder cannot be read, or no estimate is in all of them.
    """
    missions = [read_mission(folder) for folder in folders]
    parts = distinguishing(mission.scores for mission in missions)
    own = [{named(estimate, parts): estimate for estimate in m.scores} for m in missions]
    common, alone = matched(own)
    if not common:
        tried = "; ".join(
            f"{mission.folder} has {', '.join(f'{s} {short_name(f)}' for s, f in mission.scores)}"
            for mission in missions
        )
        raise InputError(
            f"compare: found no estimate that all folders have: {tried}; expected one of the same "
            "--strategy and --filter, or folders of one strategy or one filter each"
        )
    sections = [{name.partition(".")[0] for name in mission.settings} for mission in missions]
    shared, lacking = matched([sorted(some) for some in sections])
    settings = [
        {name: value for name, value in m.settings.items() if name.partition(".")[0] in shared}
        for m in missions
    ]
    truths = tuple(mission.truth for mission in missions)
    one_drive = _one_drive(missions)
    notes = []
    for key, who in alone.items():
        strategy, name = own[who[0]][key]
        notes.append(f"{strategy} {short_name(name)}: only in {_letters(who)}, not compared")
    if not one_drive:
        notes.append("The drives are not the same: each difference is that of one draw.")
    untrue = [i for i, truth in enumerate(truths) if truth is None]
    if 0 < len(untrue) < len(truths):
        notes.append(f"Without truth: {_letters(untrue)}; there is nothing to score it by.")
    for who in dict.fromkeys(lacking.values()):
        names = ", ".join(name for name, its in lacking.items() if its == who)
        notes.append(f"Settings of {names}: only in {_letters(who)}, not compared")
    return ComparedMissions(
        **_lettered(folders, [mission.version for mission in missions], settings),
        notes=tuple(notes),
        estimates=tuple(_compared(missions, [keys[key] for keys in own]) for key in common),
        truths=truths,
        one_drive=one_drive,
    )


def _compared(missions: Sequence[StoredMission], estimates: Sequence[Estimate]) -> ComparedEstimate:
    """Collect the scores and paths of an estimate that is in every mission's folder."""
    chosen = list(zip(missions, estimates, strict=True))
    truths = (mission.truth for mission in missions if mission.truth is not None)
    whole = next(truths, missions[0].paths[estimates[0]])
    scores = []
    for mission, estimate in chosen:
        run = mission.scores[estimate]
        numbers = {n: v for n, v in run.items() if isinstance(v, int | float | None)}
        numbers |= {f"online_{name}": value for name, value in (run.get("online") or {}).items()}
        scores.append({n: None if v is None else float(v) for n, v in numbers.items()})
    return ComparedEstimate(
        title=shared_name(estimates),
        estimates=tuple(estimates),
        scores={
            name: tuple(own.get(name) for own in scores)
            for name in dict.fromkeys(name for own in scores for name in own)
        },
        views=tuple(
            path_view(mission.paths[estimate], mission.maps[estimate], mission.truth or whole)
            for mission, estimate in chosen
        ),
    )


@np.errstate(over="ignore", invalid="ignore")
def path_view(
    path: StoredPath, placed: Float[np.ndarray, "n 2"], reference: StoredPath
) -> PathView:
    """Align a path to a reference by a rigid motion; return both versions and their errors.

    `placed` [m]: landmarks, moved with it. `reference`: compared at common times, except the start.
    Returns: unmoved if fewer than two poses can be compared.
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
    """Return whether missions have equal times and, up to rounding, equal true paths."""
    truths = [mission.truth for mission in missions if mission.truth is not None]
    paths = [path for mission in missions for path in mission.paths.values()]
    for group in (paths, truths):
        if not all(np.array_equal(path.time, group[0].time) for path in group):
            return False
    off = np.array([truth.pose - truths[0].pose for truth in truths]).reshape(-1, 3)
    off[:, 2] = wrap(off[:, 2])
    return bool(np.all(np.abs(off) < ROUNDING))


def compare_studies(folders: Sequence[Path], *, drop_diverged: bool = False) -> ComparedStudies:
    """Compare the scores of two or more studies, case by case.

    `drop_diverged`: leave out worlds where either of two cases diverged; otherwise all worlds
    with a number count. Raises InputError if a folder cannot be read, has no finished world, or no
    case is in all of them.
    """
    plans, trials = zip(*(_read(folder) for folder in folders), strict=True)
    varied = tuple(dict.fromkeys(name for plan in plans for name in plan.grid))
    planned = [cases_of(plan) for plan in plans]
    parts = distinguishing([(case.strategy, case.filter) for case in cases] for cases in planned)
    keyed = [
        {
            (*named((case.strategy, case.filter), parts), json.dumps(_values(case, varied))): case
            for case in cases
        }
        for cases in planned
    ]
    common, alone = matched(keyed)
    if not common:
        raise _nothing_in_common(folders, plans)
    widths = [
        dict(table.drop_nulls("beamwidth_deg").select("case", "beamwidth_deg").rows()[::-1])
        for table in trials
    ]
    matches = [[cases[key] for cases in keyed] for key in common]
    frame = _frame(matches, trials, drop_diverged)
    rows, overall = _judged(folders, matches, frame, varied, widths[0])
    notes, paired = [], {row["paired"] for row in rows}
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
    left = "are left out" if drop_diverged else "count, as far as they have a number"
    notes.append(f"Worlds in which a case diverged {left}.")
    for who in dict.fromkeys(alone.values()):
        i = who[0]
        cases = (keyed[i][key] for key, its in alone.items() if its == who)
        labels = [_label([case], varied, widths[i]) for case in cases]
        some = "; ".join(labels[:4]) + f"; and {len(labels) - 4} more" * (len(labels) > 4)
        notes.append(f"Only in {_letters(who)}, not compared: {some}")
    return ComparedStudies(
        **_lettered(folders, [*map(_version, folders)], [*map(plan_settings, plans)]),
        notes=tuple(notes),
        worlds=tuple(
            (table["iteration"].n_unique(), plan.planned)
            for plan, table in zip(plans, trials, strict=True)
        ),
        rows=rows,
        overall=overall,
    )


def _read(folder: Path) -> tuple[Plan, "pl.DataFrame"]:
    """Read a study's plan and its table of trials; raise InputError if a file was changed."""
    import polars as pl

    stored = load_finished(folder)
    try:
        trials = stored.trials.collect()
        trials.select("case", "iteration", "status", "diverged", "beamwidth_deg", POSITION)
    except (OSError, pl.exceptions.PolarsError) as error:
        why = "its trials have not the columns of this version"
        raise InputError(f"{folder}: {why}; run the study again") from error
    return stored.plan, trials


def _nothing_in_common(folders: Sequence[Path], plans: Sequence[Plan]) -> InputError:
    """Return the InputError for studies without a common case (strategy, filter, settings)."""
    tried = []
    for folder, plan in zip(folders, plans, strict=True):
        ways = f"{', '.join(plan.strategies)} by {', '.join(map(short_name, plan.filters))}"
        varied = "; ".join(f"{name} {list(values)}" for name, values in plan.grid.items())
        tried.append(f"{folder} tries {ways}" + f" at {varied}" * bool(varied))
    return InputError(
        f"compare: found no case that all studies have: {'. '.join(tried)}. Expected a strategy, a "
        "filter and values of what either varies that all have"
    )


def _values(case: PlannedCase, varied: Sequence[str]) -> dict[str, Any]:
    """Return a case's values of the varied settings; a passive case has no emitter radius."""
    settings = leaves(case.config.model_dump(mode="json"), known_settings())
    values = {".".join(key): value for key, value in settings}
    values |= {RADIUS: None} if case.strategy == "passive" else {}
    return {name: values[name] for name in varied}


def _label(cases: Sequence[PlannedCase], varied: Sequence[str], widths: Mapping[int, float]) -> str:
    """Return a label for a group of matched cases: shared strategy and filter, varied values."""
    first, words = cases[0], [shared_name([(case.strategy, case.filter) for case in cases])]
    for name, value in _values(first, varied).items():
        if name == RADIUS and first.number in widths:
            words.append(f"{widths[first.number]:.1f}°")
        elif value is not None:
            words.append(f"{name} {value if isinstance(value, str) else json.dumps(value)}")
    return ", ".join(filter(None, words)) or "the case"


def draw_of(config: Config) -> str:
    """Return as JSON the settings that determine the worlds: seed, scenario and motion.

    Worlds of equal text are the same, even if other things are heard in them.
    """
    return config.model_dump_json(include={"seed", "scenario", "motion"})


def _frame(
    matches: Sequence[Sequence[PlannedCase]], trials: "Sequence[pl.DataFrame]", drop_diverged: bool
) -> "pl.DataFrame":
    """Return the scores of matched cases as a table with a row per study, world and score.

    `matches`: of each study one case. `trials`: of each study. Column `lost`: the trial diverged or
    failed. A case without any trial has a row without a world.
    """
    import polars as pl

    draws: dict[str, int] = {}
    index = [
        (number, folder, case.number, draws.setdefault(draw_of(case.config), len(draws)))
        for number, match in enumerate(matches)
        for folder, case in enumerate(match)
    ]
    scores = [
        name
        for name in SCORES
        if name not in NOT_MEANS and all(name in table.columns for table in trials)
        if name == POSITION or any(table[name].cast(float).is_finite().any() for table in trials)
    ]
    diverged = pl.col("diverged").fill_null(value=False)
    tables = [
        table.select(
            pl.lit(folder).cast(int).alias("folder"),
            pl.col("case").cast(int),
            pl.col("iteration").cast(int).alias("world"),
            (diverged & drop_diverged).alias("drops"),
            ((pl.col("status") != "done") | diverged).alias("lost"),
            pl.col(*scores).cast(float),
        )
        for folder, table in enumerate(trials)
    ]
    columns = dict.fromkeys(("match", "folder", "case", "draw"), pl.Int64)
    frame = pl.DataFrame(index, schema=columns, orient="row").join(
        pl.concat(tables), on=["folder", "case"], how="left", maintain_order="left_right"
    )
    heads = ["match", "folder", "draw", "world", "drops", "lost"]
    frame = frame.with_columns(pl.col("world").fill_null(-1))
    frame = frame.unpivot(scores, index=heads, variable_name="score")
    return frame.with_columns(value=pl.when(~pl.col("drops")).then("value"))


def _judged(
    folders: Sequence[Path],
    matches: Sequence[Sequence[PlannedCase]],
    frame: "pl.DataFrame",
    varied: Sequence[str],
    widths: Mapping[int, float],
) -> tuple[tuple[dict[str, Any], ...], tuple[tuple[str, Contrast], ...]]:
    """Judge the differences between studies: each score by case, and the mean position RMSEs.

    `frame`: of the matched cases. `widths`: beamwidths of the cases of the first study [deg].
    """
    import polars as pl

    judged = contrasts(frame, "folder", ["score", "match"], family=["score"], draw="draw")
    position = frame.filter(pl.col("score") == POSITION)
    counts = position.group_by("match", "folder").agg(pl.col("lost").sum()).rows()
    lost = {(number, folder): count for number, folder, count in counts}
    labels = [_label(match, varied, widths) for match in matches]
    values = [_values(match[0], varied) for match in matches]
    rows = []
    for one in judged:
        finding, number = one.finding, one.by["match"]
        case = matches[number][one.b]
        bounds = [x if math.isfinite(x) else None for x in (*finding.family, *finding.alone)]
        rows.append(
            {
                "case": labels[number],
                "strategy": case.strategy,
                "filter": short_name(case.filter),
                **{name: cell_of(value) for name, value in values[number].items()},
                "beamwidth_deg": widths.get(matches[number][0].number),
                "score": one.by["score"],
                "letter": LETTERS[one.b],
                "folder": spelt(folders[one.b]),
                "paired": one.paired,
                "worlds_first": one.worlds[0],
                "worlds": one.worlds[1],
                "mean_first": one.means[0],
                "mean": one.means[1],
                "difference": finding.mean,
                **dict(zip(("low", "high", "alone_low", "alone_high"), bounds, strict=True)),
                "p": finding.p,
                "diverged_first": lost[number, 0],
                "diverged": lost[number, one.b],
            }
        )
    paired = set(range(len(folders))) - {one.b for one in judged if not one.paired}
    draw = pl.col("folder").replace(dict.fromkeys(paired, 0))
    overall = []
    for score in (POSITION_ALIGNED, POSITION):
        errors = frame.filter(pl.col("score") == score).with_columns(draw=draw)
        overall += [
            (score, one) for one in contrasts(errors, "folder", over=["match"], draw="draw")
        ]
    return tuple(rows), tuple(overall)


def _version(folder: Path) -> str:
    """Return the version of Pipistrelle that wrote a study, from its README; "" if unknown."""
    try:
        text = read_file(folder / "README.md").decode()
    except (OSError, UnicodeDecodeError, InputError):
        return ""
    match = re.search(r"Written by Pipistrelle (\S+)\.\s", text)
    return match[1] if match else ""


def less(value: float | None, first: float | None) -> float | None:
    """Return `value` minus `first`; None if either is missing."""
    return None if value is None or first is None else value - first


def comparison_table(compared: ComparedMissions | ComparedStudies) -> "pl.DataFrame":
    """Return all numbers of a comparison as a Polars table, with null for missing numbers."""
    import polars as pl

    if isinstance(compared, ComparedStudies):
        rows = compared.rows
    else:
        rows = tuple(
            {
                "estimate": estimate.title,
                "score": score,
                "letter": letter,
                "folder": spelt(folder),
                "strategy": strategy,
                "filter": short_name(name),
                "value": value,
                "difference": less(value, values[0]),
            }
            for estimate in compared.estimates
            for score, values in estimate.scores.items()
            for (letter, folder), (strategy, name), value in zip(
                compared.folders.items(), estimate.estimates, values, strict=True
            )
        )
    known = pl.selectors.float().fill_nan(None)
    return pl.DataFrame(rows, infer_schema_length=None).with_columns(known)


def settings_table(compared: Compared) -> "pl.DataFrame":
    """Return a table of the settings that differ: a row per setting, a column per folder."""
    import polars as pl

    rows = [(name, *values) for name, values in compared.settings.items()]
    columns = dict.fromkeys(("setting", *compared.folders), pl.String)
    return pl.DataFrame(rows, schema=columns, orient="row")


def write_comparison(
    own: OwnFiles,
    compared: ComparedMissions | ComparedStudies,
    *,
    command: str,
    notes: Sequence[str],
    draw: Callable[[Path], None] = lambda _: None,
) -> None:
    """Write a comparison (tables, figure, README) into a folder, over any earlier comparison.

    `own`: the folder, as `pipistrelle.files.claim` gives it. `command`: the command line.
    `notes`: remarks for the README. `draw`: writes the figure into a folder. Raises InputError if a
    file cannot be written, or a file to be replaced was changed.
    """
    buffer, table = io.BytesIO(), comparison_table(compared)
    table.write_parquet(buffer)
    content, figure = MISSIONS if isinstance(compared, ComparedMissions) else STUDIES
    text = shipped_text("experiments/comparison_readme.md").format(
        command=command,
        version=__version__,
        folders="\n".join(f"- {x}: {_quoted(spelt(f))}" for x, f in compared.folders.items()),
        notes="\n".join(f"- {note}" for note in notes),
        table=content,
        figure=figure,
    )
    own.replace(
        {
            "comparison.parquet": buffer.getvalue(),
            "comparison.csv": table.write_csv(),
            "settings.csv": settings_table(compared).write_csv(),
            **drawn_files(draw),
            "README.md": text,
        }
    )


def _quoted(text: str) -> str:
    """Format text as inline Markdown code, also if it contains backticks."""
    ticks = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    pad = " " if "`" in text else ""
    return f"{ticks}{pad}{text}{pad}{ticks}"
