"""Scores of an estimate: errors, consistency and data association, compared with the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, Track, placed
from pipistrelle.evaluation.accuracy import (
    alignment,
    heaviest,
    moved,
    pose_error,
    position_error,
    rmse,
    scored_landmarks,
)
from pipistrelle.evaluation.association import (
    STAY,
    Associated,
    Causes,
    gospa,
    map_counts,
    nearest_motion,
    out_of_place,
)
from pipistrelle.evaluation.bound import NO_ROUTES, path_bound, pose_bound, true_controls
from pipistrelle.evaluation.consistency import diverged, track_nees
from pipistrelle.experiments.drives import Drive, Truth, reckoned, split_at

OF_ASSOCIATION = (
    "associated_right", "associated_found",
    "landmarks_missed", "landmarks_false", "landmarks_twice",
    "gospa_m", "gospa_error_m", "gospa_missed", "gospa_false",
)  # fmt: skip
"""Scores of data association, which known labels lack."""


PathScores = dict[str, float | None]
"""Scores of a path, by their names in `Scores`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Scores of a trial, by their names in ``summary.json``.

    None without truth or data; infinite or NaN if the trial diverged. Errors and NEES are over the
    control steps, the start excluded. "Aligned": after the best rigid motion of path or map, for
    two points or more.
    """

    position_rmse_m: float | None
    heading_rmse_rad: float | None
    map_rmse_m: float | None
    """RMSE of the fully initialised landmarks with known true positions."""
    position_rmse_aligned_m: float | None
    map_rmse_aligned_m: float | None
    map_rmse_shared_m: float | None = None
    """As `map_rmse_aligned_m`, of the landmarks that all strategies of a mission placed."""
    position_floor_m: float | None = None
    """RMSE of a path without errors after the first scan (`position_floor`)."""
    position_bound_m: float | None = None
    heading_bound_rad: float | None = None
    """Lower bound of the RMSE of any unbiased estimator, averaged over such drives, with an exact
    start and the measured noise (`evaluation.bound.path_bound`)."""
    nees_mean: float | None
    nees_max: float | None
    caller_rmse_m: float | None = None
    """RMSE of the tracked callers, at the scans since the initialisation of each."""
    caller_rmse_aligned_m: float | None = None
    diverged: bool | None
    """Whether any NEES is not finite or exceeds the limit. Without truth: True if the path is not
    finite, else None."""
    landmarks_full: int
    landmarks_total: int
    measurements_per_frame: float | None
    """Mean number of bearings per scan."""
    gated: int
    """Number of measurements rejected by the gate, of `judged`."""
    nis_mean: float | None = None
    """Normalised innovation squared per degree of freedom, for fully initialised landmarks: about
    1 for a consistent filter. None if the filter does not provide it (`Innovations`)."""
    associated_right: float | None = None
    """Share of correct labels among all measurements labelled by the association; None for a log
    without labels. This and all following scores are None for known labels."""
    associated_found: float | None = None
    """Share of landmark measurements with a correct label: low if much of the map is lost, or if
    many measurements are too uncertain to be used."""
    landmarks_missed: int | None = None
    """Landmarks measured in three scans or more and not mapped. For a log without labels all true
    landmarks count as measured, and landmarks are matched by position."""
    landmarks_false: int | None = None
    """Mapped landmarks without a true landmark, or far from it (`map_motion`)."""
    landmarks_twice: int | None = None
    gospa_m: float | None = None
    """GOSPA metric of the map against the measured landmarks; its parts follow."""
    gospa_error_m: float | None = None
    gospa_missed: int | None = None
    gospa_false: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialResult:
    """Result of an estimator run on the scans of a strategy: track, map and scores."""

    strategy: str
    filter: str
    track: Track
    heard: tuple[Scan, ...]
    """Scans of the strategy, one per frame, including empty ones; equal for all estimators with
    the same settings."""
    scans: tuple[Scan, ...]
    """Scans that the estimator used, possibly without moving callers."""
    scores: Scores
    wall_s: float
    mapped: Landmarks | None = None
    """The map with the labels of the true landmarks, after data association; negative labels
    have no true landmark."""
    online: PathScores | None = None
    """Scores of the path estimated at each time, if the estimator revises its path."""
    left_out: Mapping[str, Float[np.ndarray, " n"]] = field(default_factory=dict)
    """Standard deviations of measurements of a log that the association discarded as too
    uncertain, by setting."""
    causes: Causes | None = None
    """True landmark of each measurement of `heard`, if an association labels them and the truth
    is known."""
    error: str | None = None
    """Error with which the estimator failed; its path is then NaN."""


def is_placed(trial: TrialResult) -> bool:
    """Return whether the estimated path of a trial is finite everywhere."""
    return bool(np.isfinite(trial.track.pose.mean).all())


def judged(scans: Sequence[Scan]) -> int:
    """Count the measurements that the gate tests: bearings and ranges together, and excess paths.

    `Scores.gated` counts them separately.
    """
    numbers = ([np.fmax(scan.bearing, scan.range), scan.excess_path] for scan in scans)
    return sum(int(np.count_nonzero(~np.isnan(both))) for both in numbers)


@np.errstate(over="ignore", invalid="ignore")
def score(track: Track, truth: Truth, scans: Sequence[Scan], limit: float) -> Scores:
    """Score an estimated track and map against the truth at the same times.

    The scans are the estimator's input. A NEES above `limit` counts as divergence.

    Bradley & Abaid, Eqs. (23), (26) and (27) and Sec. V-A.
    """
    path: dict[str, Any] = score_path(track.pose, truth.path)
    worst = path["nees_max"]
    estimate = heaviest(track.landmarks)
    labels, positions = truth.landmarks or (np.empty(0, int), np.empty((0, 2)))
    mapped, true = scored_landmarks(estimate, labels, positions)
    followed, walked = _followed(track, truth)
    finite = bool(np.all(np.isfinite(track.pose.mean)))
    squared, degrees = track.innovations
    rows = sum(np.count_nonzero(~(np.isnan(s.bearing) & np.isnan(s.range))) for s in scans)
    return Scores(
        **path,
        map_rmse_m=_rmse(position_error(mapped, true)),
        map_rmse_aligned_m=_aligned_rmse(mapped, true),
        caller_rmse_m=_rmse(position_error(followed, walked)),
        caller_rmse_aligned_m=_aligned_rmse(followed, walked),
        diverged=(None if finite else True)
        if worst is None
        else diverged(np.array([worst]), limit),
        landmarks_full=int(np.sum(estimate.full)),
        landmarks_total=len(estimate.landmark),
        measurements_per_frame=rows / len(scans) if scans else None,
        gated=track.gated,
        nis_mean=squared / degrees if degrees else None,
    )


def _followed(
    track: Track, truth: Truth
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Return estimated and true positions [m] of all tracked callers, as matching rows."""
    both = [
        np.hstack((believed.mean, truth.callers[label]))
        for label, believed in track.callers.items()
        if label in truth.callers
    ]
    rows = np.concatenate([np.empty((0, 4)), *both])
    rows = rows[~np.isnan(rows).any(axis=1)]
    return rows[:, :2], rows[:, 2:]


def with_association(
    scores: Scores,
    landmarks: Landmarks,
    found: Associated,
    truth: Truth,
    motion: Float[np.ndarray, "3"] = STAY,
) -> Scores:
    """Add the scores of data association, such as missed and false landmarks, to the scores.

    Landmarks are compared with the true ones by position after the rigid motion `motion`.
    """
    away = out_of_place(landmarks, found, *truth.landmarks, motion) if truth.landmarks else ()
    missed, false, twice = map_counts(landmarks, found, away)
    scores = replace(
        scores,
        associated_right=found.right,
        associated_found=found.found,
        landmarks_missed=missed,
        landmarks_false=false,
        landmarks_twice=twice,
    )
    if truth.landmarks is None:
        return scores
    labels, positions = truth.landmarks
    there = positions[np.isin(labels, list(found.heard))]
    distance, error, missed, false = gospa(landmarks.mean[placed(landmarks)], there)
    metric = {"gospa_m": distance, "gospa_error_m": error}
    return replace(scores, **metric, gospa_missed=missed, gospa_false=false)


@np.errstate(over="ignore", invalid="ignore")
def map_motion(track: Track, truth: Truth) -> Float[np.ndarray, "3"]:
    """Return the rigid motion that aligns a map before it is compared with the true landmarks.

    It is the alignment of the path or the identity, whichever brings the map nearer. No measurement
    determines the position of the map as a whole, so a common shift and turn makes no landmark
    false.
    """
    if truth.landmarks is None or truth.path is None:
        return STAY
    points, true = track.pose.mean[:, :2], truth.path[:, :2]
    known = np.isfinite(points).all(axis=1) & np.isfinite(true).all(axis=1)
    if not known.any():
        return STAY
    motions = (STAY, alignment(points[known], true[known]))
    mapped = track.landmarks.mean[placed(track.landmarks)]
    return nearest_motion(mapped, truth.landmarks[1], motions)


def position_floor(drive: Drive, scans: Sequence[Scan]) -> float | None:
    r"""Return the position RMSE [m] of an estimate that makes no errors after the first scan.

    Measurements give positions relative to the vehicle, never the motion before the first scan.
    Until then the vehicle is dead reckoned; at the first scan with a measurement, at step j, the
    accumulated error shifts and turns everything that follows:

    .. math:: \hat x_k = T x_k, \quad T = \hat x_j \circ x_j^{-1} \quad (k \ge j), \qquad
              \hat x_k \text{ by dead reckoning} \quad (k < j)

    The start is excluded; None if the truth is unknown at step j. Alignment removes this error.
    """
    if drive.truth.path is None:
        return None
    true, steps = drive.truth.path, len(drive.controls)
    heard = [scan.time for scan in scans if len(scan.landmark)]
    first = min(int(np.searchsorted(drive.time, heard[0] - 1e-9)), steps) if heard else steps
    before = reckoned(drive).mean[: first + 1]
    lost, was = before[first], true[first]
    if heard and not np.isfinite(was).all():
        return None
    turned = np.array([lost[0], lost[1], lost[2] - was[2]])
    after = moved(true[first:, :2] - was[:2], turned)
    error = position_error(np.concatenate([before[:first, :2], after]), true[:, :2])[1:]
    finite = error[np.isfinite(error)]
    return rmse(finite) if finite.size else None


def drive_bound(
    drive: Drive, scans: Sequence[Scan], config: Config
) -> Float[np.ndarray, "t 3 3"] | None:
    """Return the lower bound on the pose covariance at every step, in [m, rad] squared.

    None if the truth is not known at every step or no landmark is. The scans contain their standard
    deviations; the settings give the motion of callers and whether they are tracked.
    """
    path, landmarks = drive.truth.path, drive.truth.landmarks
    if path is None or landmarks is None or not np.isfinite(path).all():
        return None
    settings = config.filter
    controls = true_controls(drive.motion, drive.controls, drive.time, path)
    parted, steps = split_at(replace(drive, controls=controls), [scan.time for scan in scans])
    return pose_bound(
        parted.motion,
        parted.controls,
        parted.time,
        path if parted.truth.path is None else parted.truth.path,
        landmarks,
        scans,
        parted.truth.callers if config.listening.excess_paths else NO_ROUTES,
        (settings.caller_speed_std, settings.caller_walk_std),
    )[steps]


def with_bound(scores: Scores, bound: Float[np.ndarray, "t 3 3"] | None) -> Scores:
    """Return scores with the lower bounds of the position and heading RMSE filled in."""
    if bound is None:
        return scores
    position, heading = path_bound(bound)
    return replace(scores, position_bound_m=position, heading_bound_rad=heading)


@np.errstate(over="ignore", invalid="ignore")
def with_shared(trials: Sequence[TrialResult], truth: Truth) -> tuple[TrialResult, ...]:
    """Add the map RMSE over the landmarks that every strategy of an estimator has placed."""
    if truth.landmarks is None:
        return tuple(trials)
    maps = [heaviest(one.track.landmarks if one.mapped is None else one.mapped) for one in trials]
    scored = []
    for trial, own in zip(trials, maps, strict=True):
        of_filter = [m for one, m in zip(trials, maps, strict=True) if one.filter == trial.filter]
        shared = set.intersection(*({*m.landmark[m.full].tolist()} for m in of_filter))
        error = None
        if len(of_filter) > 1:
            kept = replace(own, full=own.full & np.isin(own.landmark, [*shared]))
            error = _aligned_rmse(*scored_landmarks(kept, *truth.landmarks))
        scored.append(replace(trial, scores=replace(trial.scores, map_rmse_shared_m=error)))
    return tuple(scored)


def score_path(pose: Gaussian, true_path: Float[np.ndarray, "k 3"] | None) -> PathScores:
    """Score an estimated path against the true path, without the start and unknown true poses.

    Bradley & Abaid, Eqs. (23) and (26).
    """
    true_poses = np.full_like(pose.mean, np.nan) if true_path is None else true_path
    if len(true_poses) != len(pose.mean):
        raise ValueError(f"{len(pose.mean)} poses, but {len(true_poses)} true ones")
    rows = np.isfinite(true_poses).all(axis=1) & (np.arange(len(true_poses)) > 0)
    path, truth = pose.mean[rows], true_poses[rows]
    error = pose_error(path, truth)
    epsilon = track_nees(pose, true_poses)[1:]
    epsilon = epsilon[~np.isnan(epsilon)]
    return {
        "position_rmse_m": _rmse(position_error(path, truth)),
        "heading_rmse_rad": _rmse(error[:, 2]),
        "position_rmse_aligned_m": _aligned_rmse(path[:, :2], truth[:, :2]),
        "nees_mean": float(np.mean(epsilon)) if len(epsilon) else None,
        "nees_max": float(np.max(epsilon)) if len(epsilon) else None,
    }


def _rmse(error: Float[np.ndarray, " n"]) -> float | None:
    """Return the root mean square of errors; None if there are none."""
    return rmse(error) if len(error) else None


def _aligned_rmse(points: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "n 2"]) -> float | None:
    """Return the RMSE of points after the best rigid motion; None for fewer than two points."""
    if len(points) < 2:
        return None
    return rmse(position_error(moved(points, alignment(points, true)), true))
