"""A log solved by GTSAM in a batch, to compare with: odometry, ranges and bearings, robust.

    python examples/adapters/gtsam_batch.py LOG RESULT [scale]

LOG is a log folder with labels and ``motion = "unicycle"`` or ``"poses"``. There is a pose for each
row of odometry; a measurement counts at the end of its step, with Cauchy's loss of scale 1.
The standard deviations are those of the log. Landmarks begin where their first ranges or bearings
cross along the odometry. RESULT has the files ``track_gtsam.tum`` and ``map_gtsam.csv``, which the
verb ``score`` of an adapter reads as it reads those of ``pipistrelle slam``.

With ``scale`` ranges have a common unknown scale, the one of least cost; odometry determines it.

GTSAM (https://github.com/borglab/gtsam) is not needed by Pipistrelle: ``pip install gtsam``.
"""

import sys
import tomllib
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from scipy.optimize import minimize_scalar

from pipistrelle.text_tables import table_text

POSE = ("x", "y", "heading")
EXACT = 1e-4
"""Standard deviation of a motion that the model of a unicycle takes for exact [m, m, rad]."""


def solve(folder: Path, result: Path, *scale: Path) -> None:
    """Solve a log folder, perhaps with the scale of its ranges, and write its track and its map."""
    about = tomllib.loads((folder / "log.toml").read_text())
    drive = table(folder / "odometry.csv")
    rows = table(folder / "measurements.csv")
    step = np.searchsorted(drive["time"], rows["time"] - 1e-6)
    inside = (rows["time"] >= drive["time"][0]) & (step < drive["time"].size)
    inside &= rows["landmark"] >= 0
    rows, step = {name: column[inside] for name, column in rows.items()}, step[inside]
    sensor = gtsam.Pose2(*about.get("sensor_pose", (0.0, 0.0, 0.0)))
    odometry, path = odometry_of(about, drive, sensor)
    labels = np.unique(rows["landmark"]).astype(int)
    values = gtsam.Values()
    for k, pose in enumerate(path):
        values.insert(X(k), pose)
    for label in labels.tolist():
        its = np.flatnonzero(rows["landmark"] == label)
        eyes = np.array([(p.x(), p.y(), p.theta()) for p in (path[k] for k in step[its])])
        place = crossing(eyes, rows["range"][its], rows["bearing"][its])
        values.insert(L(label), gtsam.Point2(*place))

    solution = {1.0: values}

    def cost(ratio: float) -> float:
        """Return the cost of the solution if ranges are so many times the true ones."""
        graph = gtsam.NonlinearFactorGraph(odometry)
        fitting = rows | {"range": rows["range"] / ratio}
        for row, k in enumerate(step.tolist()):
            graph.add(factor(about, fitting, row, k))
        near = min(solution, key=lambda known: abs(known - ratio))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, solution[near])
        solution[ratio] = optimizer.optimize()
        return graph.error(solution[ratio])

    least = cost(1.0)
    ratio = 1.0
    if scale:
        best = minimize_scalar(cost, bounds=(0.8, 1.25), method="bounded", options={"xatol": 1e-3})
        ratio = float(best.x)
        print(f"ranges: {ratio:.3f} times the distances; the cost falls from {least:.0f}", end=" ")
        print(f"to {best.fun:.0f}")
    found = solution[ratio]
    poses = [found.atPose2(X(k)).compose(sensor.inverse()) for k in range(len(path))]
    off = residuals(rows, step, found, ratio)
    if off.size:
        print(f"ranges: robust standard deviation {1.4826 * np.median(np.abs(off)):.3f} m")
    write(result, drive["time"], poses, labels, [found.atPoint2(L(n)) for n in labels.tolist()])


def odometry_of(
    about: dict, drive: dict, sensor: gtsam.Pose2
) -> tuple[gtsam.NonlinearFactorGraph, list[gtsam.Pose2]]:
    """Return the factors of the start and of odometry, for the sensor, and its dead reckoning."""
    graph, carried = gtsam.NonlinearFactorGraph(), sensor.inverse().AdjointMap()
    path = [gtsam.Pose2(*about["initial_pose"]).compose(sensor)]
    std = np.maximum(about["initial_pose_std"], EXACT)
    graph.add(gtsam.PriorFactorPose2(X(0), path[0], gtsam.noiseModel.Diagonal.Sigmas(std)))
    for k, (motion, covariance) in enumerate(zip(*motions(about, drive), strict=True)):
        between = sensor.inverse().compose(motion).compose(sensor)
        noise = gtsam.noiseModel.Gaussian.Covariance(carried @ covariance @ carried.T)
        graph.add(gtsam.BetweenFactorPose2(X(k), X(k + 1), between, noise))
        path.append(path[-1].compose(between))
    return graph, path


def residuals(rows: dict, step: np.ndarray, found: gtsam.Values, ratio: float) -> np.ndarray:
    """Return how much longer ranges, in their own scale, are than the solution's [m]."""
    poses = [found.atPose2(X(k)) for k in step.tolist()]
    places = [found.atPoint2(L(n)) for n in rows["landmark"].astype(int).tolist()]
    far = np.array([p.range(place) for p, place in zip(poses, places, strict=True)])
    off = rows["range"] - ratio * far
    return off[np.isfinite(off)]


def motions(about: dict, drive: dict) -> tuple[list[gtsam.Pose2], list[np.ndarray]]:
    """Return the motion of each step of odometry, and its covariance."""
    if about["motion"] == "poses":
        poses = [gtsam.Pose2(*row) for row in np.column_stack([drive[n] for n in POSE])]
        stds = [about[f"{name}_std"] for name in ("forward", "sideways", "turn")]
        moved = [a.between(b) for a, b in pairwise(poses)]
        return moved, [np.diag(np.square(stds))] * len(moved)
    time = np.diff(drive["time"])
    way, turn = drive["velocity"][:-1] * time, drive["angular_rate"][:-1] * time
    moved = [gtsam.Pose2.Expmap(np.array([w, 0.0, t])) for w, t in zip(way, turn, strict=True)]
    stds = about["velocity_std"] * time, about["angular_rate_std"] * time
    slopes = [np.array([[1.0, 0.0], [0.0, 0.5 * w], [0.0, 1.0]]) for w in way]
    noise = [np.diag(np.square(both)) for both in zip(*stds, strict=True)]
    spread = [j @ q @ j.T + EXACT**2 * np.eye(3) for j, q in zip(slopes, noise, strict=True)]
    return moved, spread


def crossing(eyes: np.ndarray, ranges: np.ndarray, bearings: np.ndarray) -> np.ndarray:
    """Return where ranges or bearings from known poses cross, by linear least squares.

    Of |b - p|² = r² the terms without an unknown are p² - r² = 2 p·b - b², linear in b and b².
    """
    angle = eyes[:, 2] + bearings
    if np.isfinite(bearings).all() and np.isfinite(ranges).all():
        ahead = np.column_stack((np.cos(angle), np.sin(angle)))
        return np.median(eyes[:, :2] + ranges[:, None] * ahead, axis=0)
    if np.isfinite(ranges).all():
        points = eyes[:, :2]
        design = np.column_stack((2.0 * points, -np.ones(len(points))))
        return np.linalg.lstsq(design, np.sum(points**2, axis=1) - ranges**2)[0][:2]
    across = np.column_stack((-np.sin(angle), np.cos(angle)))
    return np.linalg.lstsq(across, np.sum(across * eyes[:, :2], axis=1))[0]


def factor(about: dict, rows: dict, row: int, k: int) -> gtsam.NonlinearFactor:
    """Return the factor of a measurement: range, bearing or both."""
    keys = X(k), L(int(rows["landmark"][row]))
    measured = {name: rows[name][row] for name in ("bearing", "range")}
    stds = []
    for name, value in measured.items():
        if np.isfinite(value):
            own = rows.get(f"{name}_std", np.full(row + 1, np.nan))[row]
            stds.append(own if np.isfinite(own) else about[f"{name}_std"])
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.0),
        gtsam.noiseModel.Diagonal.Sigmas(np.array(stds)),
    )
    bearing, way = measured["bearing"], measured["range"]
    if np.isnan(bearing):
        return gtsam.RangeFactor2D(*keys, way, noise)
    turned = gtsam.Rot2(bearing)
    if np.isnan(way):
        return gtsam.BearingFactor2D(*keys, turned, noise)
    return gtsam.BearingRangeFactor2D(*keys, turned, way, noise)


def table(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a table of numbers; an empty field is NaN, an empty label -1."""
    head, *lines = (line for line in path.read_text().splitlines() if line and line[0] != "#")
    fields = [[float(field or "nan") for field in line.split(",")] for line in lines]
    return dict(zip(head.split(","), np.array(fields).T, strict=True))


def write(result: Path, time: np.ndarray, poses: list, labels: np.ndarray, places: list) -> None:
    """Write the track and the map."""
    result.mkdir(parents=True, exist_ok=True)
    rows = [
        (t, p.x(), p.y(), 0, 0, 0, np.sin(0.5 * p.theta()), np.cos(0.5 * p.theta()))
        for t, p in zip(time, poses, strict=True)
    ]
    np.savetxt(result / "track_gtsam.tum", rows)
    x, y = np.array(places).T
    (result / "map_gtsam.csv").write_text(table_text({"landmark": labels, "x": x, "y": y}))


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4) or sys.argv[3:] not in ([], ["scale"]):
        sys.exit(__doc__)
    solve(*map(Path, sys.argv[1:]))
