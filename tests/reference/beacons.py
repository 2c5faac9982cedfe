"""Drives among beacons that measure only ranges, with their truth."""

from typing import NamedTuple

import numpy as np

from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_step

UNICYCLE = Motion(model="unicycle", control_std=(0.05, 0.03))
DT, EVERY = 0.1, 5
EXACT = Gaussian(mean=np.zeros(3), covariance=1e-12 * np.eye(3))


class Ranging(NamedTuple):
    controls: np.ndarray
    path: np.ndarray
    beacons: np.ndarray
    scans: list

    def followed(self, slam):
        """Yield the belief after each scan."""
        belief, dt = slam.init(EXACT), np.full(EVERY, DT)
        for k, scan in enumerate(self.scans):
            belief, _ = slam.predict(belief, self.controls[EVERY * k : EVERY * (k + 1)], dt)
            belief = slam.update(belief, scan)
            yield belief


def ranging(seed, turns, beacons=6, *, std=0.1, scale=1.0, bias=0.0, reach=30.0):
    """Drive at 1 m/s with rates of turn among beacons, or so many random ones; measure ranges."""
    rng = np.random.default_rng([7, seed])
    controls = np.column_stack([np.ones(len(turns)), turns])
    noise = rng.standard_normal(controls.shape) * UNICYCLE.control_std
    path = [np.zeros(3)]
    for control in controls + noise:
        path.append(motion_step(UNICYCLE, path[-1], control, DT))
    path = np.array(path)
    if isinstance(beacons, int):
        low, high = path[:, :2].min(axis=0) - 8.0, path[:, :2].max(axis=0) + 8.0
        beacons = rng.uniform(low, high, (beacons, 2))
    scans = []
    for k in range(EVERY, len(path), EVERY):
        far = np.hypot(*(beacons - path[k, :2]).T)
        near = np.flatnonzero(far < reach)
        measured = scale * far[near] + bias + std * rng.standard_normal(near.size)
        columns = {"range": np.maximum(measured, 0.01), "range_std": std}
        scans.append(make_scan(k * DT, 1 + near, np.full(near.size, np.nan), **columns))
    return Ranging(controls, path, beacons, scans)


def winding(seconds=120.0):
    """Return rates of turn of two rounds, now narrow and now wide."""
    time = np.arange(0.0, seconds - 0.5 * DT, DT)
    return 4.0 * np.pi / seconds + 0.15 * np.sin(6.0 * np.pi * time / seconds)


def bent():
    """Return rates of turn of a straight way of 60 s, with a right angle from 30 s to 35 s."""
    return np.where((np.arange(600) >= 300) & (np.arange(600) < 350), np.pi / 10.0, 0.0)
