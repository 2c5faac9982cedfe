"""One filter runs over one drive: it predicts, associates, updates, and every pose is kept.

What cannot be used is refused here, before or after a filter has it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import nan

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.detection.noise import ConstantNoise
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.association import Association
from pipistrelle.estimation.beliefs import (
    NO_INNOVATIONS,
    B,
    Belief,
    Estimator,
    Gaussian,
    Innovations,
    Track,
    answer,
    in_sight,
)
from pipistrelle.estimation.session import Session, check_poses
from pipistrelle.experiments.drives import Drive


def run_filter(
    estimator: Estimator[B],
    drive: Drive,
    scans: Sequence[Scan],
    rng: np.random.Generator,
    *,
    association: Association | None = None,
    noise: ConstantNoise | None = None,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Scan, B], None] | None = None,
) -> Track:
    """Conduct a `Session` over a drive: predict to each scan, correct with it, keep every pose.

    Where the belief revises its path (it has ``path``), the track is the path as it is believed at
    the end, and the poses that were kept are beside it. Where it revises those of callers, too
    (``tracks``), they are likewise.

    Parameters
    ----------
    estimator : Estimator
    drive : Drive
    scans : sequence of Scan
        In order; the time of each is one of the drive's.
    rng : Generator
    association, noise : optional
        See `Session`.
    progress : callable, optional
        Given the scans done and their number.
    watch : callable, optional
        Given each scan, as the filter had it, and the belief after it.

    Returns
    -------
    Track

    Raises
    ------
    InputError
        For a row that is neither bearing nor excess path, or no number, or has no standard
        deviation, scans out of order or at a time that is not one of the drive's, labels that are
        none, landmarks known beforehand that move, or poses that are not one for each step.
    """
    time = drive.time
    steps = _steps_of(scans, time)
    _check_known(drive, scans)
    session = Session(
        estimator, drive.start, rng, known=drive.known, callers=drive.callers,
        association=association, noise=noise,
    )  # fmt: skip
    path = Gaussian(mean=np.empty((time.size, 3)), covariance=np.empty((time.size, 3, 3)))
    path.mean[0], path.covariance[0] = drive.start.mean, drive.start.covariance
    callers: dict[int, Gaussian] = {}
    done = 0
    for number, (k, scan) in enumerate(zip(steps, scans, strict=True), start=1):
        _move(session, drive, done, k, path)
        done, used = k, session.hear(scan)
        pose = session.belief.pose()
        path.mean[k], path.covariance[k] = pose.mean, pose.covariance
        _follow(callers, scan, session.belief, (k, time.size))
        if watch:
            watch(used, session.belief)
        if progress:
            progress(number, len(scans))
    _move(session, drive, done, len(drive.controls), path)
    track = _track_of(session.belief, time, path, callers)
    if association is None:
        return track
    return replace(track, landmarks=session.landmarks(), labels=tuple(session.labels))


def _track_of(
    belief: Belief, time: Float[np.ndarray, " k"], path: Gaussian, callers: dict[int, Gaussian]
) -> Track:
    """Return a drive as its last belief has it; `path`, `callers`: as believed at their time."""
    online = replace(path, invariant=belief.pose().invariant)
    revised, cloud = answer(belief, "path"), answer(belief, "cloud")
    if revised is not None:
        check_poses("path", revised, time.size)
    return Track(
        time=time,
        pose=revised or online,
        landmarks=belief.landmarks(),
        gated=belief.gated,
        innovations=_innovations(belief),
        cloud=cloud,
        full=None if cloud is None else getattr(belief, "full", None),
        online=online if revised else None,
        calibration=answer(belief, "calibration") or {},
        callers=_retraced(callers, belief, time.size),
    )


def _move(session: Session[B], drive: Drive, first: int, last: int, path: Gaussian) -> None:
    """Move a session through some steps of a drive, and write the pose after each into the path."""
    if last == first:
        return
    dt = np.diff(drive.time[first : last + 1])
    poses, after = session.move(drive.controls[first:last], dt), slice(first + 1, last + 1)
    path.mean[after], path.covariance[after] = poses.mean, poses.covariance


def _check_known(drive: Drive, scans: Sequence[Scan]) -> None:
    """Refuse landmarks that are known beforehand and move."""
    labelled = (scan for scan in scans if not scan.direct.size)
    moving = {*drive.moving, *(label for scan in labelled for label in scan.moving.tolist())}
    if roving := sorted(moving.intersection(drive.known.landmark.tolist())):
        raise InputError(
            f"landmarks known beforehand: found {roving}, which move; expected some that stand"
        )


def _innovations(belief: Belief) -> Innovations:
    """Return the sum of innovations of a belief, or none if it does not keep one."""
    innovations = getattr(belief, "innovations", None)
    return innovations if isinstance(innovations, Innovations) else NO_INNOVATIONS


def _follow(callers: dict[int, Gaussian], scan: Scan, belief: Belief, at: tuple[int, int]) -> None:
    """Write where moving callers in sight are at step k of so many into their tracks."""
    found, (k, steps) = answer(belief, "moving") if scan.moving.size else None, at
    if found is None:
        return
    moving = in_sight(found)
    for row in range(moving.landmark.size):
        nowhere = Gaussian(mean=np.full((steps, 2), nan), covariance=np.full((steps, 2, 2), nan))
        track = callers.setdefault(int(moving.landmark[row]), nowhere)
        track.mean[k], track.covariance[k] = moving.mean[row], moving.covariance[row]


def _retraced(callers: dict[int, Gaussian], belief: Belief, steps: int) -> Mapping[int, Gaussian]:
    """Return the tracks of callers, as the last belief revises them where it does."""
    revised = answer(belief, "tracks") if callers else None
    if revised is None:
        return callers
    tracks = dict(revised)
    for label, track in tracks.items():
        found, expected = (np.shape(track.mean), np.shape(track.covariance)), (steps, 2)
        if found != (expected, (*expected, 2)):
            raise InputError(
                f"tracks: found arrays of {found[0]} and {found[1]} for caller {label}, expected "
                f"{expected} and {(*expected, 2)}: the start and every control step"
            )
        if label in callers:
            tracks[label] = _filled_up(track, callers[label])
    return tracks


def _filled_up(track: Gaussian, online: Gaussian) -> Gaussian:
    """Fill the gaps of a caller's revised track with its position as believed at that time."""
    none = np.isnan(track.mean[:, :1])
    return Gaussian(
        mean=np.where(none, online.mean, track.mean),
        covariance=np.where(none[..., np.newaxis], online.covariance, track.covariance),
    )


def _steps_of(scans: Sequence[Scan], time: Float[np.ndarray, " t"]) -> list[int]:
    """Find the step that ends at each scan; refuse scans that a filter could not use."""
    heard = np.array([scan.time for scan in scans], dtype=float)
    steps = np.searchsorted(time, heard)
    on_time = time[np.minimum(steps, time.size - 1)] == heard
    if not on_time.all():
        stray = scans[int(np.argmin(on_time))]
        raise InputError(f"scan at {stray.time} s: expected the time of the end of a step")
    if np.any(np.diff(steps) < 0):
        late = int(np.argmax(np.diff(steps) < 0))
        raise InputError(
            f"scan at {scans[late + 1].time} s: follows one at {scans[late].time} s; expected "
            "scans in the order of time"
        )
    return steps.tolist()
