"""Made-up missions whose callers are heard: echoes come later than calls, by an excess path."""

from dataclasses import replace

import numpy as np

from pipistrelle.detection.scans import COLUMNS, EXCESS_PATH, EXCESS_PATH_STD, NUMBERS, make_scan


def excess_paths_to(points, vehicle, caller):
    """How much longer the way over each point (n, 2) is than that straight from the caller."""
    over = np.hypot(*(points - caller).T) + np.hypot(*(points - vehicle).T)
    return over - np.hypot(*(caller - vehicle))


def timed(mission, callers, rng, *, std=0.05, off=None, share=1.0, least=0.0, direct=True):
    """Return a mission whose echoes have excess paths of callers, each a landmark by its label.

    A row has that of the first caller, unless it is heard from there; those of others are rows
    without a bearing. All are told to be good to `std`, and off by it, or by `off`; of excess paths
    longer than `least` [m] that share is heard, and unless `direct` is False only where the scan
    holds the caller itself.
    """
    off = std if off is None else off
    scans = [
        _timed(scan, pose[:2], mission.landmarks, callers, rng, std, off, (share, least, direct))
        for scan, pose in zip(mission.scans, mission.path[1:], strict=True)
    ]
    return replace(mission, scans=scans)


def _timed(scan, vehicle, landmarks, callers, rng, std, off, kept):
    """Give a scan the excess paths over what is in it, of all callers that are in it."""
    share, least, direct = kept
    numbers, landmark, caller = (
        [scan.numbers.copy()],
        [scan.landmark],
        [np.zeros_like(scan.landmark)],
    )
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
