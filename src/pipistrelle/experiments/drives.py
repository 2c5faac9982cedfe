"""Drives, simulated or recorded: the input of an estimator, and the truth for scoring only."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.logs.poses import poses_along
from pipistrelle.detection.scans import NO_CALLERS, Scan
from pipistrelle.estimation.beliefs import Gaussian, Landmarks, Track, no_landmarks
from pipistrelle.estimation.motion import Motion, relative_motions
from pipistrelle.geometry import carrying, path_at, points_at, wrap

LabelledPoints = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]
"""Labels and positions [m] of landmarks."""
Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """True trajectory, landmarks and callers of a drive, for scoring and drawing only.

    `time` [s] is the start, then the end of each control step. `path` [m, m, rad] is NaN where
    unknown. `callers` are the positions [m] of the moving callers, by label.
    """

    time: Float[np.ndarray, " k"]
    path: Float[np.ndarray, "k 3"] | None = None
    landmarks: LabelledPoints | None = None
    callers: Mapping[int, Float[np.ndarray, "k 2"]] = field(default_factory=dict)


NO_TRUTH = Truth(time=np.array([]))
"""A drive without ground truth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Input of an estimator (motion model, start, controls, callers), and the truth for scoring."""

    motion: Motion
    start: Gaussian
    time: Float[np.ndarray, " t"]
    """The start, then the end of each control step [s]."""
    controls: Float[np.ndarray, "t-1 c"]
    """Controls of each step, as the motion model takes them."""
    truth: Truth = NO_TRUTH
    """Truth at the same times; its landmarks include callers that do not move."""
    known: Landmarks = field(default_factory=no_landmarks)
    """Landmarks known beforehand."""
    callers: Int[np.ndarray, " c"] = field(default_factory=lambda: NO_CALLERS)
    """Landmark label of each caller, by caller number; empty if only the vehicle calls."""
    moving: Mapping[int, str] = field(default_factory=dict)
    """Names of the moving callers, which are no landmarks of the map, by label."""
    sensor: Pose = (0.0, 0.0, 0.0)
    """Pose of the sensor in the vehicle's axes: ahead, left [m], counter-clockwise [rad]."""


def reckoned(drive: Drive) -> Gaussian:
    """Return the path by the odometry only, from the mean of the start, with zero covariance."""
    ways, _ = relative_motions(drive.motion, drive.controls, np.diff(drive.time))
    poses = poses_along(ways, drive.start.mean.tolist())
    return Gaussian(mean=poses, covariance=np.zeros((len(poses), 3, 3)))


def split_at(drive: Drive, times: Sequence[float]) -> tuple[Drive, Int[np.ndarray, " t"]]:
    r"""Split the control steps of a drive at scan times [s] that fall inside them.

    The part that covers a share :math:`\lambda` of a step's time has that share of its
    displacement, turn and covariance. The controls of the result are relative motions with
    covariances (`pipistrelle.estimation.motion`). Also returns the index of each original time in
    the result. A drive without a scan inside a step is returned as given.
    """
    time, controls, inside = drive.time, drive.controls, np.array(times, dtype=float)
    inside = inside[(inside > time[0]) & (inside < time[-1])]
    if np.isin(inside, time).all():
        return drive, np.arange(time.size)
    fine = np.union1d(time, inside)
    step = np.searchsorted(time, fine[1:]) - 1
    length = np.diff(time)[step]
    begin, end = (fine[:-1] - time[step]) / length, (fine[1:] - time[step]) / length
    way, covariance = relative_motions(drive.motion, controls, np.diff(time))
    before, after = begin[:, np.newaxis] * way[step], end[:, np.newaxis] * way[step]
    turn = carrying(np.zeros((step.size, 2)), -before[:, 2])  # into the axes at the part's begin
    moved = np.einsum("kij,kj->ki", turn, after - before)
    share = (end - begin)[:, np.newaxis, np.newaxis]
    spread = share * turn @ covariance[step] @ turn.transpose(0, 2, 1)
    rows, columns = np.triu_indices(3)
    path, callers = drive.truth.path, drive.truth.callers
    callers = {label: points_at(fine, time, places) for label, places in callers.items()}
    path = None if path is None else path_at(fine, time, path)
    truth = replace(drive.truth, time=fine, path=path, callers=callers)
    motion = Motion(model="poses", control_std=(0.0, 0.0, 0.0))
    parts = np.column_stack((moved, spread[:, rows, columns]))
    split = replace(drive, motion=motion, time=fine, controls=parts, truth=truth)
    return split, np.searchsorted(fine, time)


def at_step_ends(drive: Drive, scans: Sequence[Scan]) -> tuple[Scan, ...]:
    """Date each scan at the end of its control step."""
    ends = drive.time[np.searchsorted(drive.time, [scan.time for scan in scans])].tolist()
    return tuple(replace(scan, time=end) for scan, end in zip(scans, ends, strict=True))


def at_sensor(drive: Drive) -> Drive:
    """Convert a vehicle's drive to the drive of its sensor, which is mounted at `drive.sensor`.

    With the sensor at pose :math:`S` in the vehicle, a vehicle motion D becomes the sensor motion
    :math:`S^{-1} D S`. The controls of the result are relative motions with covariances
    (`pipistrelle.estimation.motion`), so estimators need no sensor pose.

    A sensor 2 m ahead of a vehicle that turns on the spot moves sideways:

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> start = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
    >>> drive = Drive(motion=motion, start=start, time=np.array([0.0, 1.0]),
    ...               controls=np.array([[0.0, 0.01]]), sensor=(2.0, 0.0, 0.0))
    >>> at_sensor(drive).controls[0, :3].round(3) + 0.0, at_sensor(drive).start.mean
    (array([0.  , 0.02, 0.01]), array([2., 0., 0.]))
    """
    if not any(drive.sensor):
        return drive
    way, covariance = relative_motions(drive.motion, drive.controls, np.diff(drive.time))
    moved = carried(Gaussian(mean=way, covariance=covariance), drive.sensor)
    back = carrying(np.zeros(2), -drive.sensor[2])
    ways = np.einsum("ij,kj->ki", back, moved.mean - np.array(drive.sensor))
    ways[:, 2] = way[:, 2]  # turns are not wrapped
    spread = np.einsum("ij,kjl,ml->kim", back, moved.covariance, back)
    rows, columns = np.triu_indices(3)
    return replace(
        drive,
        motion=Motion(model="poses", control_std=(0.0, 0.0, 0.0)),
        start=carried(drive.start, drive.sensor),
        controls=np.column_stack((ways, spread[:, rows, columns])),
        sensor=(0.0, 0.0, 0.0),
    )


def at_vehicle(track: Track, sensor: Pose) -> Track:
    """Convert the estimated track of a sensor at mounting pose `sensor` to its vehicle's track."""
    if not any(sensor):
        return track
    vehicle = vehicle_in(sensor)
    cloud, online = track.cloud, track.online
    if cloud is not None:
        none = np.zeros((len(cloud), 3, 3))
        cloud = carried(Gaussian(mean=cloud, covariance=none), vehicle).mean
    return replace(
        track,
        pose=carried(track.pose, vehicle),
        cloud=cloud,
        online=None if online is None else carried(online, vehicle),
    )


def vehicle_in(sensor: Pose) -> Pose:
    """Invert a sensor's mounting pose: return the vehicle's pose in the sensor's axes."""
    x, y, turned = sensor
    c, s = np.cos(turned), np.sin(turned)
    return -c * x - s * y, s * x - c * y, -turned


def carried(path: Gaussian, place: Pose) -> Gaussian:
    """Compose each Gaussian pose of a path with a fixed relative pose, to first order."""
    x, y, turned = place
    heading = path.mean[..., 2]
    c, s = np.cos(heading), np.sin(heading)
    offset = np.stack((c * x - s * y, s * x + c * y, np.full_like(c, turned)), axis=-1)
    mean = path.mean + offset
    mean[..., 2] = wrap(mean[..., 2])
    slopes = carrying(offset[..., :2])
    spread = np.einsum("...ij,...jk,...lk->...il", slopes, path.covariance, slopes)
    return replace(path, mean=mean, covariance=0.5 * (spread + np.swapaxes(spread, -1, -2)))
