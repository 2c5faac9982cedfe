"""Missions side by side: the scores of each estimate that all folders have, and its paths.

A path is seen in two ways: as it was recorded, and after the rigid motion that brings it nearest to
its reference, which is the truth beside it, else another folder's truth, and without either
the path of the first folder. The start is not counted in the fit, as in the scores.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.evaluation.accuracy import alignment, moved, position_error
from pipistrelle.experiments.comparing.folders import LETTERS
from pipistrelle.experiments.comparing.matching import (
    alike,
    differing,
    matched,
    named,
    section,
    worded,
)
from pipistrelle.experiments.results.reading import (
    Estimate,
    StoredMission,
    StoredPath,
    read_mission,
)
from pipistrelle.geometry import wrap

_ROUNDING = 1e-6  # [m, rad]: paths that differ by less are of one drive


@dataclass(frozen=True, slots=True, kw_only=True)
class PathView:
    """A path as it was recorded, and as near to its reference as a rigid motion brings it."""

    time: Float[np.ndarray, " k"]
    """[s] From the path's own start."""
    raw: Float[np.ndarray, "k 2"]
    aligned: Float[np.ndarray, "k 2"]
    """[m]"""
    placed: Float[np.ndarray, "n 2"]
    placed_aligned: Float[np.ndarray, "n 2"]
    """[m] The landmarks of its map that are placed, moved with the path."""
    error: Float[np.ndarray, " k"]
    error_aligned: Float[np.ndarray, " k"]
    """[m] Distance from the reference; NaN where that is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedEstimate:
    """An estimate that all folders have."""

    title: str
    """What the folders' estimates have in common."""
    estimates: tuple[Estimate, ...]
    """One of each folder."""
    scores: tuple[Mapping[str, Any], ...]
    """Under the names of ``summary.json``."""
    views: tuple[PathView, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedMissions:
    """Folders of `run` or `slam`, the first of which the others are held against."""

    folders: tuple[Path, ...]
    versions: tuple[str, ...]
    compared: tuple[ComparedEstimate, ...]
    alone: Mapping[Estimate, tuple[int, ...]]
    """Estimates that only some have, and which of the folders those are."""
    settings: Mapping[str, tuple[Any, ...]]
    """Those that differ, in the sections that all have."""
    sections_alone: Mapping[str, tuple[int, ...]]
    """Sections that only some have, as a log has none of a world."""
    truths: tuple[StoredPath | None, ...]
    one_drive: bool
    """Whether all drove the same way, as far as the folders tell."""


def compare_missions(folders: Sequence[Path]) -> ComparedMissions:
    """Compare what `run` or `slam` left in folders.

    `folders`: two or more, none twice (`folders.kind_of`). Raises InputError where a folder cannot
    be read, or they have no estimate in common.
    """
    missions = [read_mission(folder) for folder in folders]
    parts = alike([tuple(mission.scores) for mission in missions])
    own = [{named(estimate, parts): estimate for estimate in m.scores} for m in missions]
    common, alone = matched([tuple(keys) for keys in own])
    if not common:
        raise _nothing_in_common(missions)
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


def _nothing_in_common(missions: Sequence[StoredMission]) -> InputError:
    """Say what each folder has, where nothing of it is in all."""
    estimates = "; ".join(
        f"{mission.folder} has {', '.join(f'{s} {short_name(f)}' for s, f in mission.scores)}"
        for mission in missions
    )
    return InputError(
        f"compare: found no estimate that all folders have: {estimates}; expected one of the same "
        "--strategy and --filter, or folders of one strategy or one filter each"
    )


def _compared(missions: Sequence[StoredMission], estimates: Sequence[Estimate]) -> ComparedEstimate:
    """Put one estimate of each folder side by side."""
    chosen = list(zip(missions, estimates, strict=True))
    truths = (mission.truth for mission in missions if mission.truth is not None)
    whole = next(truths, missions[0].paths[estimates[0]])
    return ComparedEstimate(
        title=worded(estimates),
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
    """Align a path with a reference by a rigid motion; return it before and after.

    `placed` [m]: landmarks, moved with it. `reference`: compared where both have the same times.
    Returns: where fewer than two poses can be compared, and where a path is not finite, nothing is
    moved.

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
    return bool(np.all(np.abs(off) < _ROUNDING))


def notes_of(compared: ComparedMissions) -> tuple[str, ...]:
    """Say what a reader must know of a comparison, a line each."""
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
    """Name folders by their letters."""
    return " and ".join(LETTERS[i] for i in who)
