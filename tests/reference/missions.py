"""Made-up missions: a noisy drive among landmarks, measured with Gaussian noise."""

import math
from dataclasses import dataclass

import numpy as np

from pipistrelle.detection.scans import Scan
from reference.ekf_slam import moved, wrapped

DT = 0.125
STEPS_PER_FRAME = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """Truth, controls and scans: `controls` and `dt` hold one row of steps per frame."""

    path: np.ndarray
    controls: np.ndarray
    dt: np.ndarray
    landmarks: np.ndarray
    scans: list


def draw_mission(
    rng,
    motion,
    *,
    start,
    control,
    frames,
    landmarks,
    beamwidth,
    hearing=0.0,
    reach=14.0,
    range_std=0.2,
    bearing_std=0.05,
):
    """Draw a mission.

    Landmarks nearer than `reach` and inside the beam give range and bearing; others nearer than
    `hearing` give a bearing only. `landmarks` are positions (n, 2); labels count from 1. Each
    frame holds its measurements in a random order. A start of (mean, covariance) is drawn from.
    """
    pose = np.array(rng.multivariate_normal(*start), float)
    path, scans = [pose], []
    for frame in range(frames):
        for _ in range(STEPS_PER_FRAME):
            noisy = np.asarray(control) + rng.normal(size=2) * motion.control_std
            path.append(moved(motion, path[-1], noisy, DT)[0])
        rows = []
        for label, (x, y) in enumerate(landmarks, start=1):
            dx, dy = x - path[-1][0], y - path[-1][1]
            distance = math.hypot(dx, dy)
            bearing = wrapped(math.atan2(dy, dx) - path[-1][2])
            noise = rng.normal(size=2) * [range_std, bearing_std]
            measured = wrapped(bearing + noise[1])
            if distance < reach and abs(bearing) < beamwidth / 2:
                rows.append((label, max(distance + noise[0], 0.01), measured))
            elif distance < hearing:
                rows.append((label, math.nan, measured))
        rows = [rows[i] for i in rng.permutation(len(rows))]
        scans.append(scan_of(rows, time=(frame + 1) * STEPS_PER_FRAME * DT))
    controls = np.tile(np.asarray(control, float), (frames, STEPS_PER_FRAME, 1))
    return Mission(
        path=np.array(path),
        controls=controls,
        dt=np.full((frames, STEPS_PER_FRAME), DT),
        landmarks=np.asarray(landmarks, float),
        scans=scans,
    )


def scan_of(rows, time=0.0):
    """Scan of rows (label, range or NaN, bearing)."""
    return Scan(
        time=time,
        landmark=np.array([row[0] for row in rows], dtype=np.int64),
        range=np.array([row[1] for row in rows], dtype=float),
        bearing=np.array([row[2] for row in rows], dtype=float),
    )


def scattered(rng, count, radius=25.0, spacing=3.0):
    """Positions in a disc, at least `spacing` apart."""
    points = []
    while len(points) < count:
        point = rng.uniform(-radius, radius, size=2)
        if np.hypot(*point) < radius and all(np.hypot(*(point - p)) > spacing for p in points):
            points.append(point)
    return np.array(points)
