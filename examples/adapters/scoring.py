"""The score of a result against the truth of a public set, for the adapters beside it."""

from pathlib import Path

import numpy as np

from pipistrelle.evaluation.accuracy import alignment, moved, rmse


def print_score(
    result: Path, time: np.ndarray, path: np.ndarray, places: dict[int, np.ndarray]
) -> None:
    """Print the errors of the trajectory at the times of its truth, and of the landmarks.

    Both after the rigid motion, without scale, that aligns the trajectory with its truth.
    `path` [m] (k, 2) at `time` [s]; `places` [m]: the true position of each landmark by its label.
    """
    (mapped,) = result.glob("map_*.csv")
    tracked = np.loadtxt(result / f"track_{mapped.stem.removeprefix('map_')}.tum")
    known = (time >= tracked[0, 0]) & (time <= tracked[-1, 0])
    there = np.column_stack([np.interp(time[known], tracked[:, 0], tracked[:, k]) for k in (1, 2)])
    turned = alignment(there, path[known])
    off = np.hypot(*(moved(there, turned) - path[known]).T)
    print(f"trajectory, aligned: RMSE {rmse(off):.3f} m at {off.size} times", end=", ")
    print(f"median {np.median(off):.3f} m, greatest {off.max():.3f} m")
    rows = np.loadtxt(mapped, delimiter=",", skiprows=1, usecols=(0, 1, 2), ndmin=2)
    found = dict(zip(rows[:, 0].astype(int).tolist(), moved(rows[:, 1:], turned), strict=True))
    gaps = {
        label: np.hypot(*(found[label] - place))
        for label, place in places.items()
        if label in found
    }
    print(f"landmarks: RMSE {rmse(np.array([*gaps.values()])):.3f} m,", end=" ")
    print(f"{len(gaps)} of {len(places)} mapped:", end=" ")
    print(", ".join(f"{label} {gap:.2f} m" for label, gap in gaps.items()))
