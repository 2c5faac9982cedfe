"""Synthetic missions with excess paths: echoes that arrive later than their calls."""

from dataclasses import replace

import numpy as np

from pipistrelle.detection.scans import COLUMNS, EXCESS_PATH, EXCESS_PATH_STD, NUMBERS, make_scan
from pipistrelle.estimation.observations.excess_path import excess_path_slopes


def excess_paths_to(points, vehicle, caller):
    """Length of the path over each point (n, 2), minus the direct path from the caller."""
    over = np.hypot(*(points - caller).T) + np.hypot(*(points - vehicle).T)
    return over - np.hypot(*(caller - vehicle))


def excess_path_jacobians(vehicle, point, caller):
    """Derivatives of the excess path by vehicle, point and caller, (2) each."""
    _, *slopes = excess_path_slopes(*vehicle, *point, *caller)
    by_point, by_caller = np.array(slopes[:2]), np.array(slopes[2:])
    return -by_point - by_caller, by_point, by_caller


def timed(mission, callers, rng, *, std=0.05, off=None, share=1.0, least=0.0, direct=True):
    """Add excess paths of callers, which are landmarks by label, to the scans of a mission.

    Each row has the excess path of the first caller, except the caller's own row; other callers
    have rows without bearing. The stated standard deviation is `std`, the true noise `off` (default
    `std`). A `share` of the excess paths longer than `least` [m] is measured and, unless `direct`
    is False, only in scans with the caller itself.
    """
    off = std if off is None else off
    scans = [
        _timed(scan, pose[:2], mission.landmarks, callers, rng, std, off, (share, least, direct))
        for scan, pose in zip(mission.scans, mission.path[1:], strict=True)
    ]
    return replace(mission, scans=scans)


def _timed(scan, vehicle, landmarks, callers, rng, std, off, kept):
    """Add to a scan the excess paths over its landmarks, for each caller in it."""
    share, least, direct = kept
    numbers, landmark = [scan.numbers.copy()], [scan.landmark]
    caller = [np.zeros_like(scan.landmark)]
    first = numbers[0]
    for k, label in enumerate(callers, start=1):
        if direct and label not in scan.landmark:
            continue
        true = excess_paths_to(landmarks[scan.landmark - 1], vehicle, landmarks[label - 1])
        audible = (scan.landmark != label) & (true > least)
        if share < 1.0:
            audible &= rng.random(true.size) < share
        over = np.flatnonzero(audible)
        heard = true[over] + rng.normal(0.0, off, over.size)
        if k == 1:
            first[EXCESS_PATH, over], first[EXCESS_PATH_STD, over], caller[0][over] = heard, std, k
        else:
            more = np.full((NUMBERS, over.size), np.nan)
            more[EXCESS_PATH], more[EXCESS_PATH_STD] = heard, std
            numbers.append(more)
            landmark.append(scan.landmark[over])
            caller.append(np.full(over.size, k))
    columns = dict(zip(COLUMNS[2:], np.concatenate(numbers, axis=1), strict=True))
    made = make_scan(scan.time, np.concatenate(landmark), caller=np.concatenate(caller), **columns)
    return replace(made, callers=np.array([-1, *callers]))
