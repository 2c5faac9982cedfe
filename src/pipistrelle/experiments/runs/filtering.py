"""One filter runs over one drive: it predicts, associates, updates, and every pose is kept.

What could not be used, whoever made it, is refused here, before or after a filter has it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import nan

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError
from pipistrelle.detection.merging import labelled
from pipistrelle.detection.noise import Noise, as_said
from pipistrelle.detection.scans import Scan
from pipistrelle.estimation.association import Associate, known_labels
from pipistrelle.estimation.beliefs import (
    NO_INNOVATIONS,
    AcceptsMap,
    B,
    Belief,
    Estimator,
    Gaussian,
    Innovations,
    Track,
    answer,
    in_sight,
)
from pipistrelle.estimation.checking import usable_scan
from pipistrelle.experiments.drives import Drive


def run_filter(
    estimator: Estimator[B],
    drive: Drive,
    scans: Sequence[Scan],
    rng: np.random.Generator,
    *,
    associate: Associate = known_labels,
    noise: Noise = as_said,
    progress: Callable[[int, int], None] | None = None,
    watch: Callable[[Scan, B], None] | None = None,
) -> Track:
    """Predict to each scan, associate its rows, update with it, and keep the pose of every step.

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
    associate : Associate
    noise : Noise
        States how surely the rows were measured that an association has merged.
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
        For a row that is neither bearing nor excess path, or no number, one of which nobody says
        how sure it is, scans out of order or at a time that is not one of the drive's, labels that
        are none, landmarks known beforehand that move, or poses that are not one for each step.
    """
    time = drive.time
    steps = _steps_of(scans, time)
    path = Gaussian(mean=np.empty((time.size, 3)), covariance=np.empty((time.size, 3, 3)))
    path.mean[0], path.covariance[0] = drive.start.mean, drive.start.covariance
    belief, done = _first_belief(estimator, drive, scans), 0
    callers: dict[int, Gaussian] = {}
    for number, (k, scan) in enumerate(zip(steps, scans, strict=True), start=1):
        if k > done:
            belief = _carried(estimator, belief, drive, slice(done, k), rng, path)
            done = k
        named = usable_scan(
            scan if associate is known_labels else _named(scan, belief, associate, noise)
        )
        belief = estimator.update(belief, named, rng)
        if not hasattr(belief, "pose"):
            raise _wrong_return(estimator, "update", belief, "the belief after the scan")
        pose = belief.pose()
        path.mean[k], path.covariance[k] = pose.mean, pose.covariance
        _follow(callers, scan, belief, (k, time.size))
        if watch:
            watch(named, belief)
        if progress:
            progress(number, len(scans))
    if done < len(drive.controls):
        left = slice(done, len(drive.controls))
        belief = _carried(estimator, belief, drive, left, rng, path)
    online = replace(path, invariant=belief.pose().invariant)
    revised, cloud = answer(belief, "path"), answer(belief, "cloud")
    revised = _whole("path", revised, time.size) if revised is not None else None
    return Track(
        time=time,
        pose=revised or online,
        landmarks=belief.landmarks(),
        gated=belief.gated,
        innovations=_innovations(belief),
        cloud=cloud,
        full=None if cloud is None else getattr(belief, "full", None),
        online=online if revised else None,
        callers=_retraced(callers, belief, time.size),
    )


def _innovations(belief: Belief) -> Innovations:
    """Return the sum of innovations of a belief, or none if it does not keep one."""
    innovations = getattr(belief, "innovations", None)
    return innovations if isinstance(innovations, Innovations) else NO_INNOVATIONS


def _named(scan: Scan, belief: B, associate: Associate, noise: Noise) -> Scan:
    """Return a scan labelled by an association, with the noise of the rows that it merged."""
    named = labelled(scan, associate(belief, scan))
    return named if named is scan else noise(named)


def _carried(
    estimator: Estimator[B],
    belief: B,
    drive: Drive,
    steps: slice,
    rng: np.random.Generator,
    path: Gaussian,
) -> B:
    """Predict a belief through steps of a drive, and write the pose after each into the path."""
    controls, dt = drive.controls[steps], np.diff(drive.time[steps.start : steps.stop + 1])
    predicted = estimator.predict(belief, controls, dt, rng)
    if not (isinstance(predicted, tuple) and len(predicted) == 2):
        raise _wrong_return(estimator, "predict", predicted, "the belief and the pose of each step")
    belief, poses = predicted
    poses, after = _whole("predict", poses, len(dt)), slice(steps.start + 1, steps.stop + 1)
    path.mean[after], path.covariance[after] = poses.mean, poses.covariance
    return belief


def _wrong_return(estimator: Estimator[B], method: str, found: object, expected: str) -> InputError:
    """Say what an estimator's method returned in place of what is expected."""
    name = f"{type(estimator).__module__}.{type(estimator).__qualname__}.{method}"
    fix = "does it lack its return?" if found is None else "correct it"
    return InputError(f"{name}: found {type(found).__name__} returned, expected {expected}; {fix}")


def _first_belief(estimator: Estimator[B], drive: Drive, scans: Sequence[Scan]) -> B:
    """Return the belief at the start, with the landmarks that are known beforehand."""
    belief, placed = estimator.init(drive.start), drive.known.landmark.tolist()
    moving = {*drive.moving, *(label for scan in scans for label in scan.moving.tolist())}
    if roving := sorted(moving.intersection(placed)):
        raise InputError(
            f"landmarks known beforehand: found {roving}, which move; expected some that stand"
        )
    if drive.known.landmark.size and isinstance(estimator, AcceptsMap):
        belief = estimator.knowing(belief, drive.known)
    return belief


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


def _whole(who: str, path: Gaussian, poses: int) -> Gaussian:
    """Refuse poses of an estimator that are not one for each step, or lack their covariances."""
    found = np.shape(path.mean), np.shape(path.covariance)
    expected = (poses, 3), (poses, 3, 3)
    if found != expected:
        which = "the start and every control step" if who == "path" else "one after each step"
        raise InputError(
            f"{who}: found arrays of {found[0]} and {found[1]}, expected {expected[0]} and "
            f"{expected[1]}: {which}"
        )
    return path


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
