"""Drives converted to odometry by relative motions from pose to pose."""

from dataclasses import replace

import numpy as np

from pipistrelle.estimation.motion import Motion
from reference.ekf_slam import moved, noise_of

COVARIANCE = ("motion_xx", "motion_xy", "motion_xh", "motion_yy", "motion_yh", "motion_hh")
ANYONE = Motion(model="poses", control_std=(0.02, 0.01, 0.03))
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


def as_motions(motion, controls, dt):
    """Return the relative motion of each step and its covariance, (k, 9), by the slow reference."""
    rows = []
    for control, step in zip(controls, dt, strict=True):
        way, _, U = moved(motion, np.zeros(3), control, step)
        rows.append([*way, *(U @ noise_of(motion, control) @ U.T)[UPPER]])
    return np.array(rows).reshape(-1, 9)


def by_poses(motion):
    """Return the motion model of relative poses for a vehicle, with unused default noise."""
    return Motion(model="poses", control_std=(9.0, 8.0, 7.0), noise_at_rest=motion.noise_at_rest)


def as_poses(drive):
    """Convert a drive's controls to relative motions."""
    controls = as_motions(drive.motion, drive.controls, np.diff(drive.time))
    return replace(drive, motion=by_poses(drive.motion), controls=controls)


def wandering(rng, count, *, stated, silent=0.3):
    """Draw random relative motions, some of them zero; with `stated`, most have covariances."""
    motions = rng.uniform([-0.05, -0.05, -0.3], [0.12, 0.05, 0.3], (count, 3))
    motions[rng.random(count) < 0.3] = 0.0
    if not stated:
        return motions
    roots = rng.normal(size=(count, 3, 3)) * 0.02
    covariance = (roots @ np.swapaxes(roots, 1, 2))[:, *UPPER]
    covariance[rng.random(count) < silent] = np.nan
    return np.hstack([motions, covariance])


def poses_file(start, motions, time):
    """Return ``odometry.csv`` with the absolute poses of a drive from an arbitrary start."""
    pose, rows = np.array(start, float), []
    told = np.vstack([np.full(6, np.nan), motions[:, 3:]]) if motions.shape[1] > 3 else None
    for k, stamp in enumerate(time.tolist()):
        if k:
            pose, _, _ = moved(ANYONE, pose, motions[k - 1], 0.0)
        fields = [repr(float(number)) for number in (stamp, *pose)]
        if told is not None:
            fields += ["" if np.isnan(number) else repr(float(number)) for number in told[k]]
        rows.append(",".join(fields))
    header = ["time", "x", "y", "heading", *(COVARIANCE if told is not None else ())]
    return "\n".join([",".join(header), *rows, ""])
