"""A synthetic recorded drive: turns in place, short drives, precise bearings, near landmarks."""

import numpy as np

from pipistrelle.detection.scans import make_scan, with_columns
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.evaluation.accuracy import alignment, moved, position_error, rmse
from pipistrelle.experiments.drives import Drive, Truth
from pipistrelle.geometry import range_and_bearing, wrap

TURTLE = Motion(model="unicycle", control_std=(0.03, 0.03), noise_at_rest=False)
SIDE = 6.0
"""Half the width of the field [m]."""
GROSS = 0.5
"""Size of a gross error of a bearing [rad]."""


def turn_and_drive(seed, looks=300, landmarks=60, bearing_std=0.003, gross=0.0):
    """Simulate repeated turns in place, drives of 0.4 m, and scans; return the drive and its scans.

    A scan has at most eight bearings, ahead, at ranges from 0.2 to 5 m; a share `gross` of them has
    gross errors. The start is exact.
    """
    rng = np.random.default_rng(seed)
    points = field(rng, landmarks)
    path, controls, scans = [np.zeros(3)], [], []
    for _ in range(looks):
        for control in ((0.0, turn(rng, path[-1])), (0.4, 0.0)):
            noisy = np.array(control) + rng.normal(size=2) * TURTLE.control_std * np.any(control)
            path.append(motion_step(TURTLE, path[-1], noisy, 1.0))
            controls.append(control)
        distance, bearing = range_and_bearing(path[-1], points)
        seen = np.flatnonzero((distance > 0.2) & (distance < 5.0) & (np.abs(bearing) < np.pi / 2))
        seen = np.sort(rng.permutation(seen)[:8])
        measured = wrap(bearing[seen] + rng.normal(0.0, bearing_std, seen.size))
        scans.append(make_scan(float(len(controls)), seen + 1, measured, bearing_std=bearing_std))
    time, true = np.arange(len(path), dtype=float), (np.arange(1, landmarks + 1), points)
    drive = Drive(
        motion=TURTLE,
        start=Gaussian(mean=np.zeros(3), covariance=1e-12 * np.eye(3)),
        time=time,
        controls=np.array(controls),
        truth=Truth(time=time, path=np.array(path), landmarks=true),
    )
    return drive, [with_gross_errors(rng, scan, gross) for scan in scans] if gross else scans


def aligned_rmse(points, true):
    """Return the RMSE of positions after their best rigid motion [m]."""
    return rmse(position_error(moved(points, alignment(points, true)), true))


def with_gross_errors(rng, scan, share):
    """Shift a share of a scan's bearings by half a radian, to either side."""
    turned = GROSS * rng.choice([-1.0, 1.0], scan.bearing.size)
    turned *= rng.random(scan.bearing.size) < share
    return with_columns(scan, bearing=wrap(scan.bearing + turned))


def field(rng, count):
    """Draw points in a square, at least half a metre from each other."""
    points = []
    while len(points) < count:
        point = rng.uniform(-SIDE, SIDE, 2)
        if all(np.hypot(*(point - other)) > 0.5 for other in points):
            points.append(point)
    return np.array(points)


def turn(rng, pose):
    """Return a turn: random, or back towards the centre."""
    if np.hypot(*pose[:2]) < 0.7 * SIDE:
        return float(rng.uniform(-0.6, 0.6))
    home = wrap(np.arctan2(-pose[1], -pose[0]) - pose[2])
    return float(np.clip(home, -0.7, 0.7))
