"""Synthetic missions with a moving caller that follows the filters' random-walk model."""

from dataclasses import replace

import numpy as np

from pipistrelle.detection.scans import COLUMNS, make_scan
from pipistrelle.geometry import range_and_bearing, wrap
from reference.missions import (
    BICYCLE,
    CIRCLE,
    SENSING,
    START,
    STEP,
    STEPS_PER_FRAME,
    draw_mission,
    scattered,
    steady,
)
from reference.timing import excess_paths_to

CALLER = 99
"""Label of the moving caller; its caller number is 1."""
FRAME = STEP * STEPS_PER_FRAME


def scaled(scale):
    """Motion and start of the paper's drive, with their noise scaled."""
    motion = replace(BICYCLE, control_std=(0.1 * scale, 0.03 * scale))
    return motion, replace(START, covariance=scale**2 * START.covariance)


def walk_covariance(seconds, std):
    """Covariance of position and velocity after a time, for a velocity with white noise `std`.

    By definition: velocity is the integral of white noise, position the integral of velocity.
    """
    axis = np.array([[seconds**3 / 3.0, seconds**2 / 2.0], [seconds**2 / 2.0, seconds]])
    return std**2 * np.kron(axis, np.eye(2))


def draw_walk(rng, start, frames, *, speed_std, walk_std):
    """Draw positions (frames + 1, 2), a frame after each other, from a given start."""
    F = np.kron([[1.0, FRAME], [0.0, 1.0]], np.eye(2))
    state = np.append(start, rng.normal(0.0, speed_std, 2))
    places = [state[:2]]
    for _ in range(frames):
        state = rng.multivariate_normal(F @ state, walk_covariance(FRAME, walk_std))
        places.append(state[:2])
    return np.array(places)


def roaming_mission(
    rng,
    frames=24,
    strategy="fused",
    *,
    count=25,
    speed_std=0.7,
    walk_std=0.3,
    scale=0.1,
    ranges=0,
    start=(5.0, -3.0),
):
    """Draw a mission with a moving caller; return it and the caller's positions, by frame.

    The caller's bearing is measured at each frame, its range only at the first `ranges`. Each
    landmark measurement has an excess path. All noise except the caller's motion is scaled,
    including controls and start (`scaled`).
    """
    motion, begin = scaled(scale)
    bearing_std, range_std, excess_path_std = (scale * std for std in (0.05, 0.2, 0.5))
    field, drive = scattered(rng, count, radius=15.0), steady(CIRCLE, frames)
    mission = draw_mission(
        rng, motion, begin, field, drive,
        **SENSING[strategy], bearing_std=bearing_std, range_std=range_std,
    )  # fmt: skip
    places = draw_walk(rng, start, frames, speed_std=speed_std, walk_std=walk_std)
    scans = []
    for frame, (scan, pose) in enumerate(zip(mission.scans, mission.path[1:], strict=True)):
        place = places[frame + 1]
        distance, bearing = range_and_bearing(pose, place[None])
        far = distance + rng.normal(0.0, range_std, 1) if frame < ranges else [np.nan]
        over = excess_paths_to(field[scan.landmark - 1], pose[:2], place)
        told = {
            "bearing": np.append(scan.bearing, wrap(bearing + rng.normal(0.0, bearing_std, 1))),
            "range": np.append(scan.range, far),
            "excess_path": np.append(over + rng.normal(0.0, excess_path_std, over.size), np.nan),
            "caller": np.ones(over.size + 1, np.int64),
            "bearing_std": np.append(np.full(over.size, bearing_std), bearing_std),
            "range_std": np.full(over.size + 1, range_std),
            "excess_path_std": np.full(over.size + 1, excess_path_std),
        }
        told = {name: told[name] for name in COLUMNS if name in told}
        made = make_scan(scan.time, np.append(scan.landmark, CALLER), **told)
        scans.append(replace(made, callers=np.array([-1, CALLER]), moving=np.array([CALLER])))
    return replace(mission, scans=scans), places
