"""The synthetic set of PHD-SLAM 3.0 as a log without labels, and GOSPA as its authors have it.

    python examples/adapters/phd_slam.py log FILES LOG [SEED]
    pipistrelle slam LOG --association.method marginal --filter iekf -o RESULT
    python examples/adapters/phd_slam.py score FILES RESULT

FILES is the folder ``Synthetic Data/measurements/SD data set`` of
https://github.com/okaltiok/PHD-SLAM-3.0, with ``Environment_SLAM.mat`` and
``Robot_Measurement.mat``: 4000 s among 160 landmarks, range and bearing up to 150 m and 90° off the
heading. With a SEED, odometry and measurements are drawn anew from its environment, as the authors
do for their means over 100 draws: Kaltiokallio et al., IEEE Transactions on Robotics 40 (2024).
"""

import sys
from math import pi, radians
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from pipistrelle.detection.logs.folder import write_log
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.evaluation.accuracy import rmse
from pipistrelle.evaluation.association import gospa
from pipistrelle.experiments.drives import Truth
from pipistrelle.experiments.runs.truth_files import write_truth
from pipistrelle.geometry import range_and_bearing

FARTHEST, DETECTION, CLUTTER, CUTOFF = 150.0, 0.95, 5.0, 20.0
"""Range [m], probability of detection, rows of clutter in a scan, and the cutoff of GOSPA [m]."""
CONTROL_STD, MEASUREMENT_STD = np.array([0.8, radians(0.5)]), np.array([0.8, radians(0.3)])
"""Of speed and angular rate, and of range and bearing [m, rad]."""


def log(files: Path, folder: Path, seed: Path | None = None) -> None:
    """Write the log, with its truth beside it."""
    world = loadmat(files / "Environment_SLAM.mat")
    path, posts = world["Robot_Groundtruth"].T, world["Landmark_Groundtruth"][:, :3]
    if seed is None:
        told = world["Robot_Odometry"].T
        seen = loadmat(files / "Robot_Measurement.mat")["Robot_Measurement"][0]
    else:
        rng = np.random.default_rng(int(str(seed)))
        told = world["Robot_Control"].T + rng.normal(size=(len(path), 2)) * CONTROL_STD
        seen = [drawn(rng, pose, posts[:, 1:]) for pose in path]
    scans = [
        make_scan(float(k), np.full(z.shape[1], UNLABELLED), z[1], range=z[0])
        for k, z in enumerate(z[:, z[0] > 0.0] for z in seen)
    ]
    time = np.arange(len(path), dtype=float)
    drive = Log(
        name="phd_slam",
        time=time,
        controls=told[1:],
        dt=np.diff(time),
        scans=tuple(scans),
        motion="unicycle",
        control_std=tuple(CONTROL_STD.tolist()),
        initial_pose=tuple(path[0].tolist()),
        initial_pose_std=(0.0, 0.0, 0.0),
        range_std=float(MEASUREMENT_STD[0]),
        bearing_std=float(MEASUREMENT_STD[1]),
        range_bounds=(0.5, FARTHEST + 10.0),
        ignored_rows={},
        association={
            "detection_rate": DETECTION,
            "clutter_rate": CLUTTER / (FARTHEST * pi),
        },
    )
    write_log(folder, drive)
    labels = posts[:, 0].astype(np.int64)
    write_truth(folder, Truth(time=time, path=path, landmarks=(labels, posts[:, 1:])))


def drawn(rng: np.random.Generator, pose: np.ndarray, posts: np.ndarray) -> np.ndarray:
    """Draw ranges and bearings of one scan, (2, m), clutter among them."""
    way, bearing = range_and_bearing(pose, posts)
    near = (way <= FARTHEST) & (np.abs(bearing) <= 0.5 * pi)
    count = rng.poisson(CLUTTER)
    false = rng.uniform((0.0, -0.5 * pi), (FARTHEST, 0.5 * pi), (count, 2))
    rows = np.vstack((np.column_stack((way, bearing))[near], false))
    return (rows + rng.normal(size=rows.shape) * MEASUREMENT_STD)[
        rng.random(len(rows)) < DETECTION
    ].T


def score(files: Path, result: Path) -> None:
    """Print position error and GOSPA of the final map, neither of them aligned."""
    world = loadmat(files / "Environment_SLAM.mat")
    (mapped,) = result.glob("map_*.csv")
    tracked = result / f"track_{mapped.stem.removeprefix('map_')}.tum"
    off = np.loadtxt(tracked)[:, 1:3] - world["Robot_Groundtruth"][:2].T
    points = np.loadtxt(mapped, delimiter=",", skiprows=1, usecols=(1, 2))
    distance, _, missed, false = gospa(points, world["Landmark_Groundtruth"][:, 1:3], CUTOFF)
    print(f"position {rmse(np.hypot(*off.T)):.2f} m, GOSPA {distance:.2f} m", end=", ")
    print(f"{missed} missed, {false} false")


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5) or sys.argv[1] not in ("log", "score"):
        sys.exit(__doc__)
    {"log": log, "score": score}[sys.argv[1]](*map(Path, sys.argv[2:]))
