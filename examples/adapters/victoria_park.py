"""Victoria Park as a log without labels, and its solution beside the GPS.

    python examples/adapters/victoria_park.py log FILES LOG
    pipistrelle slam LOG --association.method marginal --filter iekf -o RESULT
    python examples/adapters/victoria_park.py score FILES RESULT [PICTURE]

A car drove 4 km through a park in Sydney among trees that a lidar saw: Guivant & Nebot, IEEE
Transactions on Robotics and Automation 17 (2001). FILES is a folder with ``inputs.dat``,
``measurements.dat`` and ``gps.dat``, the set as text, as the folder ``data/VictoriaPark`` of
https://github.com/kykleung/RFS-SLAM has it. Geometry and noise are of that repository's
``cfg/rbphdslam_VictoriaPark.xml``, the variance of measurements with its inflation by 40: all rows
of a trunk from one side are off together. Trunks beyond 50 m are left out, as PHD-SLAM 3.0 does
(https://github.com/okaltiok/PHD-SLAM-3.0), whose rule which GPS fixes count is taken, too.
"""

import sys
from dataclasses import replace
from math import pi, sqrt
from pathlib import Path

import numpy as np

from pipistrelle.detection.logs.folder import write_log
from pipistrelle.detection.logs.recording import assemble
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.evaluation.accuracy import alignment, moved, rmse
from pipistrelle.experiments.drives import carried
from pipistrelle.text_tables import read_table, rows_kept

SENSOR = (3.78, 0.50, 0.0)
"""The lidar in the car: ahead of the middle of the rear axle, to the left [m], and turned [rad]."""
NEAREST, FARTHEST, VIEW = 5.0, 50.0, 2.98
"""Ranges of trunks that are taken [m], and the lidar's field of view [rad]."""
SOON = 0.025
"""PHD-SLAM 3.0 takes a fix of the GPS that has a scan so near [s]."""


def log(files: Path, folder: Path) -> None:
    """Write the log."""
    odometry = read_table(files / "inputs.dat", ("time", "speed", "steering"), separator=None)
    columns = ("time", "range", "bearing", "diameter")
    seen = read_table(files / "measurements.dat", columns, separator=None)
    column = seen.column
    ahead = column["bearing"] - 0.5 * pi  # theirs is from the right
    label = np.full(ahead.size, UNLABELLED)
    trunks = replace(seen, column=column | {"bearing": ahead, "landmark": label})
    near = (column["range"] >= NEAREST) & (column["range"] <= FARTHEST)
    drive = assemble(
        odometry,
        rows_kept(trunks, near),
        name="victoria_park",
        motion="ackermann",
        wheelbase=2.83,
        speed_offset=0.76,
        control_std=(sqrt(0.2), sqrt(0.025)),
        noise_at_rest=False,
        sensor_pose=SENSOR,
        initial_pose=(0.0, 0.0, 0.0),
        initial_pose_std=(0.0, 0.0, 0.0),
        range_std=sqrt(40.0 * 0.025),
        bearing_std=sqrt(40.0 * 0.000025),
        range_bounds=(NEAREST, FARTHEST),
        association={
            "detection_rate": 0.9,
            "clutter_rate": 3.0 / (FARTHEST * VIEW),
        },
    )
    write_log(folder, drive)


def score(files: Path, result: Path, picture: Path | None = None) -> None:
    """Print how far the lidar's track is from the GPS, after their alignment."""
    (mapped,) = result.glob("map_*.csv")
    tracked = result / f"track_{mapped.stem.removeprefix('map_')}.tum"
    fixes = read_table(files / "gps.dat", ("time", "x", "y"), separator=None).column
    time, x, y, _, _, _, z, w = np.loadtxt(tracked).T
    poses = np.column_stack((x, y, 2.0 * np.arctan2(z, w)))
    lidar = carried(Gaussian(mean=poses, covariance=np.zeros((time.size, 3, 3))), SENSOR).mean
    known = (fixes["time"] >= time[0]) & (fixes["time"] <= time[-1])
    at, gps = fixes["time"][known], np.column_stack((fixes["x"], fixes["y"]))[known]
    there = np.column_stack([np.interp(at, time, lidar[:, axis]) for axis in (0, 1)])
    scans = np.loadtxt(files / "measurements.dat", usecols=0)
    soon = np.abs(scans[np.searchsorted(scans, at).clip(1, scans.size - 1)] - at)
    soon = np.minimum(soon, np.abs(scans[np.searchsorted(scans, at) - 1] - at)) <= SOON
    for which, kept in (("all fixes", at > 0.0), ("fixes with a scan", soon)):
        turned = alignment(there[kept], gps[kept])
        off = np.hypot(*(moved(there[kept], turned) - gps[kept]).T)
        print(f"{which}: {off.size}, RMSE {rmse(off):.2f} m, median {np.median(off):.2f} m")
    trees = moved(np.loadtxt(mapped, delimiter=",", skiprows=1, usecols=(1, 2)), turned)
    print(f"{len(trees)} landmarks")
    if picture:
        draw(gps, moved(lidar[:, :2], turned), trees, picture)


def draw(gps: np.ndarray, path: np.ndarray, trees: np.ndarray, picture: Path) -> None:
    """Draw track and map beside the GPS."""
    from pipistrelle.figures.style import picture as figure_of

    figure = figure_of(6.0, 6.0)
    axes = figure.subplots()
    axes.plot(*gps.T, ".", ms=2, color="0.65", label="GPS")
    axes.plot(*path.T, lw=0.8, color="C0", label="track")
    axes.plot(*trees.T, "^", ms=3, color="C2", label="landmarks")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(frameon=False)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5) or sys.argv[1] not in ("log", "score"):
        sys.exit(__doc__)
    {"log": log, "score": score}[sys.argv[1]](*map(Path, sys.argv[2:]))
