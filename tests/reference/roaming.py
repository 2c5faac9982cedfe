"""A moving caller: synthetic missions, and its tracking by the slow EKFs.

Its motion is computed by matrix exponentials (Van Loan, 1978), not by the closed forms.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from pipistrelle.detection.scans import make_scan, rows_of
from reference.missions import STEP, STEPS_PER_FRAME
from reference.timed_ekf import SlowTimedEkfSlam, SlowTimedInvariantEkfSlam

BOAT = 90
"""Label of the moving caller."""
FRAME = STEP * STEPS_PER_FRAME


def drift(blocks, velocity_of, seconds, walk_std):
    """Transition and noise of 2D blocks, some of them velocities of others, driven by white noise.

    ``velocity_of`` gives the index of each block's velocity; blocks with the same velocity share
    its noise.
    """
    size = 2 * blocks
    A, G = np.zeros((size, size)), np.zeros((size, size))
    for place, velocity in velocity_of.items():
        for axis in range(2):
            A[2 * place + axis, 2 * velocity + axis] = 1.0
            G[2 * velocity + axis, 2 * velocity + axis] = walk_std**2
    both = expm(np.block([[-A, G], [np.zeros_like(A), A.T]]) * seconds)
    F = both[size:, size:].T
    return F, F @ both[:size, size:]


def wandering(rng, frames, start, speed_std, walk_std):
    """Draw a caller's position at each frame by its motion model, from `start`."""
    F, Q = drift(2, {0: 1}, FRAME, walk_std)
    L = np.linalg.cholesky(Q + 1e-15 * np.eye(4))
    state, path = np.concatenate([start, speed_std * rng.normal(size=2)]), []
    for _ in range(frames):
        state = F @ state + L @ rng.normal(size=4)
        path.append(state[:2])
    return np.array(path)


def with_boat(mission, path, rng, *, bearing_std=0.05, excess_path_std=0.05, direct=1.0):
    """Return a mission with a caller at a position for each frame, and its excess paths.

    Its bearing is measured in a share `direct` of the frames; it gives an excess path to each
    landmark of the scan.
    """
    scans = []
    for scan, pose, boat in zip(mission.scans, mission.path[1:], path, strict=True):
        scan = rows_of(scan, scan.landmark != BOAT)
        points = mission.landmarks[scan.landmark - 1]
        over = np.hypot(*(points - boat).T) + np.hypot(*(points - pose[:2]).T)
        e = over - np.hypot(*(boat - pose[:2])) + rng.normal(0.0, excess_path_std, len(points))
        towards = np.arctan2(*(boat - pose[:2])[::-1]) - pose[2] + rng.normal(0.0, bearing_std)
        called = rng.random() < direct
        columns = {name: getattr(scan, name) for name in ("range", "range_std", "bearing_std")}
        columns = {name: np.append(column, np.nan) for name, column in columns.items()}
        columns["bearing_std"][-1] = columns["range_std"][-1] = bearing_std
        made = make_scan(
            scan.time,
            np.append(scan.landmark, BOAT),
            np.append(scan.bearing, (towards + np.pi) % (2 * np.pi) - np.pi),
            caller=1,
            excess_path=np.append(np.where(e > 0.5, e, np.nan), np.nan),
            excess_path_std=excess_path_std,
            **columns,
        )
        made = rows_of(made, np.arange(len(made.landmark)) < len(points) + called)
        scans.append(replace(made, callers=np.array([-1, BOAT]), moving=np.array([BOAT])))
    return replace(mission, scans=scans)


class Roaming:
    """Tracking of a moving caller, added to a slow EKF."""

    speed_std, walk_std = 1.0, 0.2

    def predict(self, controls, dt):
        told = super().predict(controls, dt)
        members = self.all_members()
        at = {block: i for i, block in enumerate(members)}
        velocity = {
            i: at["member", -2 - block[1], 0]
            for block, i in at.items()
            if ("member", -2 - block[1], 0) in at and block[1] >= 0
        }
        if velocity:
            F, Q = drift(len(members), velocity, float(np.sum(dt)), self.walk_std)
            order = self.order[3:]
            whole, noise = np.eye(self.X.size), np.zeros_like(self.P)
            whole[np.ix_(order, order)], noise[np.ix_(order, order)] = F, Q
            self.X, self.P = whole @ self.X, whole @ self.P @ whole.T + noise
        return told

    def update(self, scan):
        super().update(scan)
        for label in scan.moving.tolist():
            block = ("member", -2 - label, 0)
            if self.members(label) and block not in self.blocks:
                nothing = np.zeros((2, self.X.size))
                self.insert(
                    len(self.blocks), block, np.zeros(2), nothing, self.speed_std**2 * np.eye(2)
                )
                self.aggregated[block] = 1.0


class SlowRoamingEkfSlam(Roaming, SlowTimedEkfSlam):
    pass


class SlowRoamingInvariantEkfSlam(Roaming, SlowTimedInvariantEkfSlam):
    pass
