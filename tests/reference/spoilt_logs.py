"""Logs of a synthetic drive with correct columns, or with a single convention violated."""

import numpy as np

from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.geometry import range_and_bearing

DEGREES = 180.0 / np.pi
STEP = 0.1
SPOILED = {
    "clockwise:": lambda b, r, h: (-b, r),
    "in degrees:": lambda b, r, h: (b * DEGREES, r),
    "in degrees and clockwise": lambda b, r, h: (-b * DEGREES, r),
    "swapped:": lambda b, r, h: (r, b),
    "from the rear": lambda b, r, h: (b + np.pi, r),
    "from the x axis": lambda b, r, h: (b + h, r),
    "compass, clockwise": lambda b, r, h: (0.5 * np.pi - b - h, r),
    "compass, in degrees": lambda b, r, h: (90.0 - (b + h) * DEGREES, r),
    "millimetres": lambda b, r, h: (b, 1e3 * r),
    "centimetres": lambda b, r, h: (b, 1e2 * r),
    "kilometres": lambda b, r, h: (b, 1e-3 * r),
}
"""Wrong conventions of bearing and range, by a phrase that names them; the heading is the true
one."""


def noisy_log(*, turn_rate=0.25, speed=0.5, labels=True, seed=5, spoil=None, clutter=0, steps=240):
    """A noisy drive among twelve landmarks, with a scan of the front half every half second."""
    rng = np.random.default_rng(seed)
    middle = 0.25 * steps * STEP * speed
    landmarks = rng.uniform([middle - 6.0, -6.0], [middle + 6.0, 6.0], (12, 2))
    motion, pose = Motion(model="unicycle", control_std=(0.05, 0.05)), np.zeros(3)
    controls, scans, bearings = np.tile([speed, turn_rate], (steps, 1)), [], []
    for k in range(steps):
        noise = 0.05 * rng.standard_normal(2) * (speed != 0.0)
        pose = motion_step(motion, pose, controls[k] + noise, STEP)
        if k % 5 < 4:
            continue
        r, b = range_and_bearing(pose, landmarks)
        ahead = np.flatnonzero(np.abs(b) < 0.5 * np.pi)
        more = rng.uniform([-0.5 * np.pi, 0.5], [0.5 * np.pi, 8.0], (clutter, 2)).T
        b = np.concatenate([b[ahead] + 0.02 * rng.standard_normal(ahead.size), more[0]])
        r = np.concatenate([r[ahead] + 0.05 * rng.standard_normal(ahead.size), more[1]])
        b, r = SPOILED[spoil](b, r, pose[2]) if spoil else (b, r)
        label = ahead if labels else np.full(b.size, UNLABELLED)
        scans.append(make_scan((k + 1) * STEP, label, b, range=r))
        bearings.append(b)
    return Log(
        name="drive", time=np.arange(steps + 1) * STEP, controls=controls,
        dt=np.full(steps, STEP), scans=tuple(scans), bearings=np.concatenate(bearings),
        motion="unicycle", control_std=(0.05, 0.05), initial_pose=(0.0, 0.0, 0.0),
        initial_pose_std=(0.0, 0.0, 0.0), range_std=0.05, bearing_std=0.02,
        range_bounds=(0.3, 20.0), ignored_rows={},
    )  # fmt: skip
