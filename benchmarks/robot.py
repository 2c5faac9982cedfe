"""Latency of a scan in a robot's loop with `pipistrelle.Slam`, for a full map.

python -m benchmarks.robot     # CPU milliseconds as JSON: by estimator and landmarks
"""

import json
import time
from itertools import product

import numpy as np
from jaxtyping import Float

from benchmarks.machine import answer
from benchmarks.promises import row
from benchmarks.table import Row
from pipistrelle import Slam
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.geometry import range_and_bearing

ROBOT = {
    "motion": "unicycle",
    "velocity_std": 0.05,
    "angular_rate_std": 0.05,
    "range_std": 0.05,
    "bearing_std": 0.01,
    "range_bounds": [0.5, 50.0],
}
MOTION, CONTROL = Motion(model="unicycle", control_std=(0.05, 0.05)), (0.5, 0.1)
ESTIMATORS, LANDMARKS = ("ekf", "iekf"), (50, 200, 1000)
HEARD, SCANS, STEP = 25, 1000, 0.1
"""Measurements per scan, number of timed scans, and time between them [s]."""


def measure() -> tuple[list[Row], list[float]]:
    """Time the loop in a separate process; return the rows, and no calibration times."""
    told = answer("-m", "benchmarks.robot")
    return [
        row(
            f"hear_{landmarks}_{name}_ms",
            told[f"{name} {landmarks}"][1],
            "./dev bench --only robot",
            note="the median {:.2f} ms, the worst {:.2f} ms".format(
                *told[f"{name} {landmarks}"][::2]
            ),
        )
        for landmarks, name in product(LANDMARKS, ESTIMATORS)
    ], []


def latencies(name: str, landmarks: int) -> list[float]:
    """Return the median, 99th percentile and maximum of the time of a scan [ms]."""
    rng, slam, seconds = np.random.default_rng(0), Slam(ROBOT, filter=name), []
    places = rng.uniform(-20.0, 20.0, (landmarks, 2))
    rounds, pose = -(-landmarks // HEARD), np.zeros(3)
    for k in range(rounds + SCANS):
        slam.move(CONTROL, dt=STEP)
        pose = motion_step(MOTION, pose, np.array(CONTROL), STEP)
        if k < rounds:
            heard = np.arange(landmarks)[HEARD * k : HEARD * (k + 1)]
        else:
            heard = rng.choice(landmarks, HEARD, replace=False)
        columns = _measured(pose, places[heard], rng)
        began = time.thread_time()
        slam.hear(landmark=heard, **columns)
        seconds.append(time.thread_time() - began)
    return (1e3 * np.quantile(seconds[rounds:], [0.5, 0.99, 1.0])).round(4).tolist()


def _measured(
    pose: Float[np.ndarray, "3"], places: Float[np.ndarray, "m 2"], rng: np.random.Generator
) -> dict[str, Float[np.ndarray, " m"]]:
    """Return noisy bearings and ranges of positions from a pose."""
    distance, bearing = range_and_bearing(pose, places)
    noise = rng.normal(0.0, 1.0, (2, len(places)))
    return {
        "bearing": bearing + ROBOT["bearing_std"] * noise[0],
        "range": np.maximum(distance + ROBOT["range_std"] * noise[1], ROBOT["range_std"]),
    }


if __name__ == "__main__":
    found = {f"{name} {n}": latencies(name, n) for name, n in product(ESTIMATORS, LANDMARKS)}
    print(json.dumps(found))
