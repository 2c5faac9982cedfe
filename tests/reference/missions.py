"""Synthetic missions: a noisy drive among landmarks, measured with Gaussian noise."""

from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from pipistrelle.config import RayConfig
from pipistrelle.detection.scans import Scan, make_scan, with_columns
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.ekf.filter import EkfSlam, InvariantEkfSlam
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.estimation.rays import RANGED
from pipistrelle.geometry import range_and_bearing, wrap

STEP = 0.125
STEPS_PER_FRAME = 4
ROBOT = {"motion": "unicycle", "velocity_std": 0.1, "angular_rate_std": 0.1, "range_std": 0.1}
ROBOT |= {"bearing_std": 0.02, "range_bounds": [0.5, 20.0]}
"""A vehicle of `Slam`."""
BICYCLE = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
START = Gaussian(
    mean=np.array([0.0, -7.408, 0.0]), covariance=np.diag([0.05**2, 0.05**2, 0.0436**2])
)
CIRCLE = (0.75, 0.027)
STEADY = Motion(model="bicycle", control_std=(0.05, 0.005), wheelbase=0.2)
SURE = Gaussian(mean=START.mean, covariance=np.diag([0.02**2, 0.02**2, 0.01**2]))
NOISE = {"range_std": 0.05, "bearing_std": 0.01}
"""Motion, start and noise that are small enough for a consistent linearised filter."""
SENSING = {
    "active": {"beamwidth": np.pi},
    "fused": {"beamwidth": np.radians(33), "hearing": 18.0},
    "passive": {"beamwidth": 0.0, "hearing": 18.0},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """True world of a mission and input of a filter; landmark i (from 0) has the label i + 1.

    `path` holds the start, then the pose at each frame; `controls` (frames, 4, c) are nominal.
    """

    path: np.ndarray
    controls: np.ndarray
    dt: np.ndarray
    landmarks: np.ndarray
    scans: list[Scan]


def draw_mission(
    rng,
    motion,
    start,
    landmarks,
    controls,
    *,
    beamwidth,
    hearing=0.0,
    reach=14.0,
    range_std=0.2,
    bearing_std=0.05,
    outliers=0.0,
):
    """Draw a mission from a Gaussian start.

    Landmarks nearer than `reach` and inside the beam give range and bearing, others nearer than
    `hearing` a bearing only, in random order; a share of `outliers` has a random bearing.
    """
    path, scans = [rng.multivariate_normal(start.mean, start.covariance)], []
    for frame, nominal in enumerate(controls, start=1):
        pose = path[-1]
        for control in nominal:
            moving = motion.noise_at_rest or np.any(control)
            noise = rng.normal(size=len(motion.control_std)) * motion.control_std * moving
            pose = motion_step(motion, pose, control[: noise.size] + noise, STEP)
        path.append(pose)
        distance, bearing = range_and_bearing(pose, landmarks)
        active = (distance < reach) & (np.abs(bearing) < beamwidth / 2)
        noisy = np.abs(distance + rng.normal(0, range_std, distance.size))
        measured = np.where(active, noisy, np.nan)
        turned = wrap(bearing + rng.normal(0, bearing_std, distance.size))
        wrong = rng.random(distance.size) < outliers
        turned = np.where(wrong, rng.uniform(-np.pi, np.pi, distance.size), turned)
        seen = rng.permutation(np.flatnonzero(active | (distance < hearing)))
        time = frame * STEPS_PER_FRAME * STEP
        scans.append(scan_with(seen + 1, turned[seen], measured[seen], time=time))
    dt = np.full(np.shape(controls)[:2], STEP)
    return Mission(path=np.array(path), controls=controls, dt=dt, landmarks=landmarks, scans=scans)


def steady(control, frames):
    """Return the same control for every step."""
    return np.tile(np.asarray(control, float), (frames, STEPS_PER_FRAME, 1))


def scattered(rng, count, radius=25.0, spacing=3.0):
    """Draw positions in a disc, with a minimum distance `spacing`."""
    points = []
    while len(points) < count:
        point = rng.uniform(-radius, radius, size=2)
        if np.hypot(*point) < radius and all(np.hypot(*(point - p)) > spacing for p in points):
            points.append(point)
    return np.array(points)


def scan_of(*rows, time=0.0):
    """Return a scan of rows (label, range or NaN, bearing)."""
    label, distance, bearing = zip(*rows, strict=True) if rows else ((), (), ())
    return scan_with(label, bearing, distance, time=time)


def scan_with(label=(), bearing=(), distance=None, *, time=0.0, **columns):
    """Return a scan of columns, with the paper's noise; without ranges it is passive."""
    known = {"range_std": 0.2, "bearing_std": 0.15} | columns
    if distance is not None:
        known["range"] = np.array(distance, float)
    return make_scan(time, np.array(label, dtype=np.int64), np.array(bearing, dtype=float), **known)


def measured_to(scan, range_std, bearing_std):
    """Return a scan with its standard deviations replaced."""
    return with_columns(scan, range_std=range_std, bearing_std=bearing_std)


def map_with(label=(), mean=None, covariance=None, weight=None):
    """Return a map of columns; by default every row is a certain position at the origin."""
    h = len(label)
    return Landmarks(
        landmark=np.array(label, dtype=np.int64),
        mean=np.zeros((h, 2)) if mean is None else np.array(mean, float).reshape(h, 2),
        covariance=np.zeros((h, 2, 2))
        if covariance is None
        else np.array(covariance, float).reshape(h, 2, 2),
        weight=np.ones(h) if weight is None else np.array(weight, dtype=float),
    )


def ray_config(**changes):
    """Return the rays of Table I, with fixed tau and n even while defaults are being fitted."""
    return RayConfig(**({"prune_threshold": 1e-3, "exponent": 1.0} | changes))


ANY_RAYS = st.builds(
    RayConfig,
    relative_std=st.floats(0.1, 0.5),
    range_ratio=st.floats(1.5, 4),
    range_bounds=st.tuples(st.floats(0.2, 2), st.floats(3, 40)),
    prune_threshold=st.floats(0, 0.3),
    exponent=st.floats(0.5, 8),
    weights=st.sampled_from(["instantaneous", "aggregated"]),
    range_update=st.sampled_from([*RANGED]),
    likelihood=st.sampled_from(["normal", "printed"]),
    merge=st.sampled_from([0.0, 0.5, 2.0]),
)


def assuming(kind):
    """Derive a filter class that assumes the paper's noise for all scans."""

    @dataclass(frozen=True, kw_only=True)
    class Assuming(kind):
        range_std: float = 0.2
        bearing_std: float = 0.15

        def update(self, belief, scan, rng=None):
            assumed = measured_to(scan, self.range_std, self.bearing_std)
            return kind.update(self, belief, assumed, rng)

    return Assuming


KINDS = {kind: assuming(kind) for kind in (EkfSlam, InvariantEkfSlam)}


def paper_filter(kind=EkfSlam, **changes):
    """Return a filter with the paper's settings, except for the changes."""
    return replace(KINDS[kind](motion=BICYCLE, rays=ray_config()), **changes)


def paper_mission(strategy, frames=375, seed=3, **changes):
    """Draw the paper's drive among 50 landmarks."""
    rng = np.random.default_rng(seed)
    field = scattered(rng, 50)
    known = SENSING[strategy] | changes
    return draw_mission(rng, BICYCLE, START, field, steady(CIRCLE, frames), **known)


def active_mission(run):
    """Draw ten seconds of active sensing with `NOISE`; return the random stream and mission."""
    rng = np.random.default_rng([11, run])
    field, drive = scattered(rng, 10, radius=12.0), steady(CIRCLE, 20)
    return rng, draw_mission(rng, STEADY, SURE, field, drive, beamwidth=7.0, reach=40.0, **NOISE)


def nees_of(error, covariance):
    """Return the normalised squared error of a pose, or of a pose and positions."""
    error = np.array(error)
    error[2] = wrap(error[2])
    return error @ np.linalg.solve(covariance, error)


def followed(slam, mission, start=START, *draws):
    """Yield belief and poses, frame by frame; `draws`: a generator for particles."""
    belief = slam.init(start)
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, poses = slam.predict(belief, controls, dt, *draws)
        belief = slam.update(belief, scan, *draws)
        yield belief, poses


def beside(slam, slow, mission, start=START):
    """Yield belief and poses of a filter frame by frame, and the poses of its slow reference."""
    slow.start(start.mean, start.covariance)
    for frame, (belief, poses) in enumerate(followed(slam, mission, start)):
        own = slow.predict(mission.controls[frame], mission.dt[frame])
        slow.update(mission.scans[frame])
        yield belief, poses, own
