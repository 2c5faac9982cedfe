"""Scores: how good an estimate is, by the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.config import Config
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, Track, placed
from pipistrelle.estimation.motion import motion_step
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
from pipistrelle.experiments.drives import Drive, Truth, split_at

OF_ASSOCIATION = (
    "associated_right", "associated_found",
    "landmarks_missed", "landmarks_false", "landmarks_twice",
    "gospa_m", "gospa_error_m", "gospa_missed", "gospa_false",
)  # fmt: skip
"""Scores that known labels do not have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathScores:
    """How near a path is to the truth, under the names of `Scores`.

    Attributes
    ----------
    position_rmse_m, heading_rmse_rad, position_rmse_aligned_m, nees_mean, nees_max : float or None
    """

    position_rmse_m: float | None
    heading_rmse_rad: float | None
    position_rmse_aligned_m: float | None
    nees_mean: float | None
    nees_max: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """How one trial did, under the names of ``summary.json``.

    None where there is no truth or nothing to score; infinite or NaN where the trial diverged.
    Errors and NEES are over the control steps, the start excluded.

    Attributes
    ----------
    position_rmse_m, heading_rmse_rad : float or None
        Of the path.
    map_rmse_m : float or None
        Of the fully initialised landmarks whose true positions are known.
    position_rmse_aligned_m, map_rmse_aligned_m : float or None
        The same, path and map each after its own rigid motion; at least two points.
    position_floor_m : float or None
        Of a path that is right after the first scan (`position_floor`).
    position_bound_m, heading_bound_rad : float or None
        Least that any estimator without bias has in the mean over such drives, the start exact and
        the noise as the signal tells it (`evaluation.bound.path_bound`).
    nees_mean, nees_max : float or None
    caller_rmse_m, caller_rmse_aligned_m : float or None
        Of the callers that move and are followed, at the scans since each was placed; the second
        after a rigid motion of all that is estimated of them.
    diverged : bool or None
        Whether any NEES is not finite or above the limit; without truth, True where the path is
        not finite, else None.
    landmarks_full, landmarks_total : int
        Fully initialised; fully and partially.
    measurements_per_frame : float or None
        Mean over the scans.
    gated : int
        Measurements that the gate rejected, of `judged`.
    associated_right : float or None
        Share of the rows that an association gave a label which are of the landmark that the label
        stands for (`evaluation.association`); None if no row of a log has a label. None of known
        labels, as are those that follow.
    associated_found : float or None
        Share of the rows of landmarks that an association gave the right label: low where much of
        the map is lost, or where many rows are too unsure to be used.
    landmarks_missed, landmarks_false, landmarks_twice : int or None
        Heard in three scans or more and not on the map; on the map and none, or near none
        (`map_motion`); there twice. If no row of a log has a label, all true landmarks count as
        heard, and landmarks are matched by their positions.
    gospa_m, gospa_error_m, gospa_missed, gospa_false
        Metric of the map against the landmarks that were heard, and its parts.
    nis_mean : float or None
        Normalised innovation squared per degree of freedom of what was used of placed landmarks:
        about 1 where the filter believes rightly. None where it does not say (`Innovations`).
    """

    position_rmse_m: float | None
    heading_rmse_rad: float | None
    map_rmse_m: float | None
    position_rmse_aligned_m: float | None
    map_rmse_aligned_m: float | None
    position_floor_m: float | None = None
    position_bound_m: float | None = None
    heading_bound_rad: float | None = None
    nees_mean: float | None
    nees_max: float | None
    caller_rmse_m: float | None = None
    caller_rmse_aligned_m: float | None = None
    diverged: bool | None
    landmarks_full: int
    landmarks_total: int
    measurements_per_frame: float | None
    gated: int
    nis_mean: float | None = None
    associated_right: float | None = None
    associated_found: float | None = None
    landmarks_missed: int | None = None
    landmarks_false: int | None = None
    landmarks_twice: int | None = None
    gospa_m: float | None = None
    gospa_error_m: float | None = None
    gospa_missed: int | None = None
    gospa_false: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialResult:
    """One estimate: the scans of a strategy, the track and map of a filter, and their scores."""

    strategy: str
    filter: str
    """The estimator's name."""
    track: Track
    heard: tuple[Scan, ...]
    """Scans of the strategy, one per frame, empty ones included; the same for every filter of the
    same settings."""
    scans: tuple[Scan, ...]
    """The scans as the filter had them, perhaps without callers that move."""
    scores: Scores
    wall_s: float
    """Time that the estimate took."""
    mapped: Landmarks | None = None
    """The map under the names of the true landmarks, where an association has labels of its own;
    numbers below 0 name landmarks that stand for none."""
    online: PathScores | None = None
    """Scores of the path as it was believed at its time, where the filter revises it."""
    left_out: Mapping[str, Float[np.ndarray, " n"]] = field(default_factory=dict)
    """Deviations of a log's rows that the association left out as too unsure, by its setting."""
    causes: Causes | None = None
    """The landmark that caused each row of `heard`, where an association labels the rows and the
    truth is known."""
    error: str | None = None
    """The error with which the filter failed; its path is then NaN."""


def is_placed(trial: TrialResult) -> bool:
    """Return whether the path of a trial is finite everywhere."""
    return bool(np.isfinite(trial.track.pose.mean).all())


def judged(scans: Sequence[Scan]) -> int:
    """Return how many measurements a gate judges: a bearing with its range, or an excess path.

    A row holds one of them, or both, and `Scores.gated` counts each.

    >>> from pipistrelle.detection.scans import make_scan
    >>> ahead = make_scan(0.0, np.array([3, 8]), np.zeros(2), excess_path=np.array([2.0, np.nan]))
    >>> judged([ahead])
    3
    """
    numbers = ([scan.bearing, scan.excess_path] for scan in scans)
    return sum(int(np.count_nonzero(~np.isnan(both))) for both in numbers)


@np.errstate(over="ignore", invalid="ignore")
def score(track: Track, truth: Truth, scans: Sequence[Scan], limit: float) -> Scores:
    """Score a track and its map against the truth, at the same times.

    The scans are those that the filter was given. A NEES above the limit means divergence.

    Notes
    -----
    Bradley & Abaid, Eqs. (23), (26) and (27) and Sec. V-A.

    >>> from pipistrelle.estimation.beliefs import Gaussian, no_landmarks
    >>> pose = Gaussian(mean=np.zeros((2, 3)), covariance=np.tile(np.eye(3), (2, 1, 1)))
    >>> still = Track(time=np.arange(2.0), pose=pose, landmarks=no_landmarks(), gated=0)
    >>> truth = Truth(time=still.time, path=np.array([[0.0, 0, 0], [3, 4, 0]]))
    >>> scores = score(still, truth, (), 50.0)
    >>> scores.position_rmse_m, scores.nees_max, scores.map_rmse_m
    (5.0, 25.0, None)
    """
    path = score_path(track.pose, truth.path)
    worst = path.nees_max
    estimate = heaviest(track.landmarks)
    labels, positions = truth.landmarks or (np.empty(0, int), np.empty((0, 2)))
    mapped, true = scored_landmarks(estimate, labels, positions)
    followed, walked = _followed(track, truth)
    finite = bool(np.all(np.isfinite(track.pose.mean)))
    squared, degrees = track.innovations
    rows = np.count_nonzero(~np.isnan(np.concatenate([[], *(scan.bearing for scan in scans)])))
    return Scores(
        position_rmse_m=path.position_rmse_m,
        heading_rmse_rad=path.heading_rmse_rad,
        map_rmse_m=_rmse(position_error(mapped, true)),
        position_rmse_aligned_m=path.position_rmse_aligned_m,
        map_rmse_aligned_m=_aligned_rmse(mapped, true),
        nees_mean=path.nees_mean,
        nees_max=worst,
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
    """Return the estimated and the true positions of all callers that move, row by row [m]."""
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
    """Return scores with those of an association filled in; ``landmarks``: under its own labels.

    Whether a landmark is near a true one is decided after `motion`.
    """
    away = out_of_place(landmarks, found, *truth.landmarks, motion) if truth.landmarks else ()
    counts = map_counts(landmarks, found, away)
    scores = replace(
        scores,
        associated_right=found.right,
        associated_found=found.found,
        landmarks_missed=counts.missed,
        landmarks_false=counts.false,
        landmarks_twice=counts.twice,
    )
    if truth.landmarks is None:
        return scores
    labels, positions = truth.landmarks
    there = positions[np.isin(labels, list(found.heard))]
    metric = gospa(landmarks.mean[placed(landmarks)], there)
    return replace(
        scores,
        gospa_m=metric.distance,
        gospa_error_m=metric.error,
        gospa_missed=metric.missed,
        gospa_false=metric.false,
    )


@np.errstate(over="ignore", invalid="ignore")
def map_motion(track: Track, truth: Truth) -> Float[np.ndarray, "3"]:
    """Return the rigid motion after which a map is compared with the true landmarks by position.

    It is the alignment of the path, or none: that after which the map is nearer. No measurement
    determines where the whole map lies, so a common shift and turn makes no landmark false.
    """
    if truth.landmarks is None or truth.path is None:
        return STAY
    points, true = track.pose.mean[:, :2], truth.path[:, :2]
    known = np.isfinite(points).all(axis=1) & np.isfinite(true).all(axis=1)
    if not known.any():
        return STAY
    motions = (STAY, alignment(points[known], true[known]))
    return nearest_motion(
        track.landmarks.mean[placed(track.landmarks)], truth.landmarks[1], motions
    )


def position_floor(drive: Drive, scans: Sequence[Scan]) -> float | None:
    r"""Return the RMSE of position [m] if all after the first scan is estimated without error.

    What is heard tells where things are relative to the vehicle, and never where the vehicle was
    before it heard anything. Until then it reckons from its controls; by the first scan that holds
    anything, at step j, the noise has moved and turned it unseen, and so all that follows:

    .. math:: \hat x_k = T x_k, \quad T = \hat x_j \circ x_j^{-1} \quad (k \ge j), \qquad
              \hat x_k \text{ by the controls alone} \quad (k < j)

    The start is excluded; None where the truth is not known at step j.

    Notes
    -----
    The error that is left is one turn and shift of everything: alignment removes it.

    A metre ahead unseen, then a straight drive.

    >>> from pipistrelle.detection.scans import make_scan
    >>> from pipistrelle.estimation.motion import Motion
    >>> path = np.array([[0.0, 0, 0], [2, 0, 0], [3, 0, 0]])
    >>> drive = Drive(
    ...     motion=Motion(model="unicycle", control_std=(1.0, 0.1)),
    ...     start=Gaussian(mean=np.zeros(3), covariance=np.eye(3)),
    ...     time=np.arange(3.0), controls=np.array([[1.0, 0.0], [1.0, 0.0]]),
    ...     truth=Truth(time=np.arange(3.0), path=path),
    ... )
    >>> position_floor(drive, [make_scan(1.0, np.array([4]), np.array([0.2]))])
    1.0
    """
    if drive.truth.path is None:
        return None
    true, steps = drive.truth.path, len(drive.controls)
    heard = [scan.time for scan in scans if len(scan.landmark)]
    first = int(np.searchsorted(drive.time, heard[0] - 1e-9)) if heard else steps
    first = min(first, steps)
    reckoned = [drive.start.mean]
    for control, dt in zip(drive.controls[:first], np.diff(drive.time), strict=False):
        reckoned.append(motion_step(drive.motion, reckoned[-1], control, dt))
    lost, was = reckoned[first], true[first]
    if heard and not np.isfinite(was).all():
        return None
    turned = np.array([lost[0], lost[1], lost[2] - was[2]])
    after = moved(true[first:, :2] - was[:2], turned)
    error = position_error(np.concatenate([np.array(reckoned)[:first, :2], after]), true[:, :2])[1:]
    finite = error[np.isfinite(error)]
    return rmse(finite) if finite.size else None


def drive_bound(
    drive: Drive, scans: Sequence[Scan], config: Config
) -> Float[np.ndarray, "t 3 3"] | None:
    """Return the bound of the pose at every step, its covariance in [m, rad], squared.

    None where the truth is not known at every step, or no landmark is. The scans bear their
    standard deviations; the settings say how callers move, and whether they are followed.
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
        parted.truth.callers if config.listening.timing else NO_ROUTES,
        (settings.caller_speed_std, settings.caller_walk_std),
    )[steps]


def with_bound(scores: Scores, bound: Float[np.ndarray, "t 3 3"] | None) -> Scores:
    """Return scores with the bounds of position and heading filled in."""
    if bound is None:
        return scores
    position, heading = path_bound(bound)
    return replace(scores, position_bound_m=position, heading_bound_rad=heading)


@np.errstate(over="ignore", invalid="ignore")
def score_path(pose: Gaussian, true_path: Float[np.ndarray, "k 3"] | None) -> PathScores:
    """Score a path against the truth, its start excluded.

    Poses of the truth that are NaN are not scored.

    Notes
    -----
    Bradley & Abaid, Eqs. (23) and (26).

    >>> pose = Gaussian(mean=np.zeros((2, 3)), covariance=np.tile(np.eye(3), (2, 1, 1)))
    >>> score_path(pose, np.array([[0.0, 0, 0], [3, 4, 0]])).position_rmse_m
    5.0
    """
    true_poses = np.full_like(pose.mean, np.nan) if true_path is None else true_path
    if len(true_poses) != len(pose.mean):
        raise ValueError(f"{len(pose.mean)} poses, but {len(true_poses)} true ones")
    rows = np.isfinite(true_poses).all(axis=1) & (np.arange(len(true_poses)) > 0)
    path, truth = pose.mean[rows], true_poses[rows]
    error = pose_error(path, truth)
    epsilon = track_nees(pose, true_poses)[1:]
    epsilon = epsilon[~np.isnan(epsilon)]
    return PathScores(
        position_rmse_m=_rmse(position_error(path, truth)),
        heading_rmse_rad=_rmse(error[:, 2]),
        position_rmse_aligned_m=_aligned_rmse(path[:, :2], truth[:, :2]),
        nees_mean=float(np.mean(epsilon)) if len(epsilon) else None,
        nees_max=float(np.max(epsilon)) if len(epsilon) else None,
    )


def _rmse(error: Float[np.ndarray, " n"]) -> float | None:
    """Return the RMSE; None without errors."""
    return rmse(error) if len(error) else None


def _aligned_rmse(points: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "n 2"]) -> float | None:
    """Return the RMSE after the best rigid motion; None for fewer than two points."""
    if len(points) < 2:
        return None
    return rmse(position_error(moved(points, alignment(points, true)), true))
