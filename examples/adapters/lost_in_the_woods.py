"""Lost in the Woods as a log, and the error of its solution.

    python examples/adapters/lost_in_the_woods.py log FILE LOG
    pipistrelle slam LOG -o RESULT
    python examples/adapters/lost_in_the_woods.py score FILE RESULT

A wheeled robot drove for 21 minutes among 17 tubes that its laser saw, under cameras that measured
its pose: T. D. Barfoot, data set 2 of the course AER1513, University of Toronto. FILE is
``dataset2.mat`` of https://github.com/utiasASRL/aer1513 (Apache 2.0). The noise is that of the
file, the variances of its errors against the truth.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scoring import print_score

from pipistrelle.detection.logs.folder import write_log
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import make_scan
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.runs.truth_files import write_truth


def log(file: Path, folder: Path) -> None:
    """Write the log, with its truth beside it."""
    sets = loadmat(file)
    time = sets["t"][:, 0]
    std = {name: float(np.sqrt(sets[f"{name}_var"][0, 0])) for name in ("r", "b", "v", "om")}
    path, places = truth(sets)
    scans = [
        make_scan(float(at), np.flatnonzero(far > 0.0) + 1, turned[far > 0.0], range=far[far > 0.0])
        for at, far, turned in zip(time, sets["r"], sets["b"], strict=True)
        if (far > 0.0).any()
    ]
    made = Log(
        name="lost_in_the_woods",
        time=time,
        controls=np.column_stack((sets["v"], sets["om"]))[:-1],
        dt=np.diff(time),
        scans=tuple(scans),
        motion="unicycle",
        control_std=(std["v"], std["om"]),
        sensor_pose=(float(sets["d"][0, 0]), 0.0, 0.0),
        initial_pose=tuple(path[0].tolist()),
        initial_pose_std=(0.0, 0.0, 0.0),
        range_std=std["r"],
        bearing_std=std["b"],
        range_bounds=(0.3, 10.0),
        ignored_rows={},
    )
    write_log(folder, made)
    posts = np.array([*places]), np.array([*places.values()])
    write_truth(folder, Truth(time=time, path=path, landmarks=posts))


def truth(sets: dict) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Return the true poses, NaN where the cameras lost the robot, and the tubes by number."""
    path = np.column_stack([sets[f"{name}_true"] for name in ("x", "y", "th")])
    path[sets["true_valid"][:, 0] == 0] = np.nan
    return path, dict(enumerate(sets["l"], start=1))


def score(file: Path, result: Path) -> None:
    """Print the errors of a result."""
    sets = loadmat(file)
    path, places = truth(sets)
    known = np.isfinite(path[:, 0])
    print_score(result, sets["t"][known, 0], path[known, :2], places)


if __name__ == "__main__":
    if len(sys.argv) != 4 or sys.argv[1] not in ("log", "score"):
        sys.exit(__doc__)
    {"log": log, "score": score}[sys.argv[1]](*map(Path, sys.argv[2:]))
