"""Plaza 1 or 2 as a log of ranges, and the error of its solution.

    python examples/adapters/plaza.py log FILE LOG [SCALE]
    pipistrelle slam LOG -o RESULT
    python examples/adapters/plaza.py score FILE RESULT

A mower drove over lawns among four radio beacons that it ranged to: Djugash & Singh, "Navigating
with ranging radios: five data sets with ground truth", Journal of Field Robotics 26 (2009). FILE is
``Plaza1_.mat`` or ``Plaza2_.mat``, as the folder ``examples/Data`` of
https://github.com/borglab/gtsam has them.

All ranges are 1.07 times the distances, and scatter by 0.55 m: so says the batch solution of least
cost, without the truth (``gtsam_batch.py LOG RESULT scale``). The log has the ranges as they are,
or divided by SCALE; ``--filter.calibrate range_scale`` estimates it. Odometry is not independent of
the truth: in Plaza 1 the turns are those of the truth's heading, in Plaza 2 they are 0.985 of them,
less 0.007 rad/s, and the ways agree to 0.1 mm. Its noise is stated as of wheels and a cheap gyro.
Rows of odometry are divided at the times of ranges, so that no range counts late.
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

RANGE_STD, SPEED_STD, RATE_STD = 0.55, 0.05, 0.02
"""Of ranges [m], and of speed [m/s] and angular rate [rad/s] in a step."""


def log(file: Path, folder: Path, scale: str = "1") -> None:
    """Write the log, with its ranges divided by a scale, and its truth beside it."""
    drive = loadmat(file)
    seen = drive["TD"][np.argsort(drive["TD"][:, 0], kind="stable")]  # Plaza 1 goes back once
    stamp = np.append(drive["DRp"][0, 0], drive["DR"][:, 0])
    driven = np.vstack((np.zeros(2), np.cumsum(drive["DR"][:, 1:], axis=0)))
    seen = seen[(seen[:, 0] > stamp[0]) & (seen[:, 0] < stamp[-1])]
    time = np.union1d(stamp, seen[:, 0])
    between = np.column_stack([np.interp(time, stamp, total) for total in driven.T])
    bearing = np.full(1, np.nan)
    made = Log(
        name=file.stem.rstrip("_").lower(),
        time=time,
        controls=np.diff(between, axis=0) / np.diff(time)[:, None],
        dt=np.diff(time),
        scans=tuple(
            make_scan(float(at), np.array([int(beacon)]), bearing, range=far / float(scale))
            for at, _, beacon, far in seen
        ),
        motion="unicycle",
        control_std=(SPEED_STD, RATE_STD),
        initial_pose=tuple(drive["DRp"][0, 1:].tolist()),
        initial_pose_std=(0.0, 0.0, 0.0),
        range_std=RANGE_STD,
        bearing_std=1.0,
        range_bounds=(1.0, 100.0),
        ignored_rows={},
    )
    write_log(folder, made)
    path, places = truth(drive)
    posts = np.array([*places]), np.array([*places.values()])
    write_truth(folder, Truth(time=drive["GT"][:, 0], path=path, landmarks=posts))


def truth(drive: dict) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Return the true poses, with headings in the direction of travel, and the beacons."""
    path, places = drive["GT"][:, 1:].copy(), drive["TL"]
    path[:, 2] += np.round((drive["DRp"][0, 3] - path[0, 2]) / np.pi) * np.pi
    return path, dict(zip(places[:, 0].astype(int).tolist(), places[:, 1:], strict=True))


def score(file: Path, result: Path) -> None:
    """Print the errors of a result."""
    drive = loadmat(file)
    path, places = truth(drive)
    print_score(result, drive["GT"][:, 0], path[:, :2], places)


if __name__ == "__main__":
    verb = {"log": log, "score": score}.get(sys.argv[1] if sys.argv[1:] else "")
    given = sys.argv[4:]
    if verb is None or len(sys.argv) < 4 or len(given) > (verb is log):
        sys.exit(__doc__)
    verb(*map(Path, sys.argv[2:4]), *given)
