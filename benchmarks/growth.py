"""Growth of cost: of frames with echoes, of filters with landmarks, of memory with worlds.

python -m benchmarks.growth     # CPU time at several sizes as JSON
"""

import json
import time
from collections.abc import Callable

import numpy as np

from benchmarks.machine import answer
from benchmarks.promises import row
from benchmarks.study import command_slice
from benchmarks.table import Row

LANDMARKS = (10, 25, 50, 100, 200)
MAPPED = (25, 50, 100, 200, 400)
BEARINGS = 20
"""Landmarks of the simulated worlds, and of the EKF's maps; bearings in a frame of the EKF."""
WORLDS = (2, 6)
COMMAND = "./dev bench --only growth --scaling"
ROWS = {
    "frame_growth": ("arrivals", "frame_s", "a frame"),
    "ekf_growth": ("states", "ekf_s", f"a frame of {BEARINGS} bearings"),
    "fastslam_growth": ("landmarks", "fastslam_s", "a measurement"),
}
"""Size, cost and unit of each row."""


def measure() -> tuple[list[Row], list[float]]:
    """Time growing worlds in a separate process; return the rows, and no calibration times."""
    sizes = answer("-m", "benchmarks.growth")["points"]
    rows = [_power(name, sizes) for name in ROWS]
    few, many = (command_slice(worlds, 1).peak / 1e6 for worlds in WORLDS)
    note = f"peak of {WORLDS[1]} worlds ({many:.0f} MB) less that of {WORLDS[0]} ({few:.0f} MB)"
    return [*rows, row("memory_growth_mb", many - few, COMMAND, note=note)], []


def _power(name: str, points: list[dict[str, float]]) -> Row:
    """Fit a power law of size to the cost above the smallest; the note lists all costs.

    Costs that all sizes share would hide the growth. If the cost falls, the power law of the whole.
    """
    abscissa, ordinate, each = ROWS[name]
    x, y = np.array([(p[abscissa], p[ordinate]) for p in points if ordinate in p]).T
    rising = (y[-3:] > y[0]).all()
    size, cost = (x[-3:] - x[0], y[-3:] - y[0]) if rising else (x[-3:], y[-3:])
    power = float(np.polyfit(np.log(size), np.log(cost), 1)[0])
    told = ", ".join(f"{a:.0f}: {1e6 * b:.3g}" for a, b in zip(x, y, strict=True))
    fitted = (
        "of what the three largest cost above the smallest" if rising else "of the three largest"
    )
    return row(name, power, COMMAND, ratio=power, note=f"{fitted}; us {each} by {abscissa}: {told}")


def points() -> list[dict[str, float]]:
    """Time frames, the EKF and FastSLAM for growing worlds and maps."""
    from pipistrelle.experiments.machine import keep_freed_memory
    from pipistrelle.experiments.runs.compiling import compile_kernels

    keep_freed_memory()  # as the command does
    compile_kernels()
    return [*map(_heard, LANDMARKS), *map(_mapped, MAPPED)]


def _heard(landmarks: int) -> dict[str, float]:
    """Time a frame, and a measurement in FastSLAM, in a world with a number of landmarks."""
    from benchmarks.worlds import scans_of, some_frames, world_of
    from pipistrelle.config import Config, ScenarioConfig
    from pipistrelle.experiments.hearing.listening import listen
    from pipistrelle.experiments.named_settings import Case
    from pipistrelle.experiments.runs.heard_world import drive_of
    from pipistrelle.experiments.runs.trial import run_trial

    config = Config(scenario=ScenarioConfig(landmarks=landmarks, spacing=0.5))
    world, radii = world_of(config), (config.emitter.radius,)
    few, scans = some_frames(world, 25), scans_of(config, "fused")
    frame_s = _cpu(15, listen, few, config, radii) / (len(few.controls) // 4)
    case, drive = Case(strategy="fused", filter="fastslam"), drive_of(world, config)
    measurements = sum(scan.landmark.size for scan in scans)
    return {
        "landmarks": landmarks,
        "arrivals": 2 * landmarks + 1,
        "frame_s": frame_s,
        "fastslam_s": _cpu(5, run_trial, case, drive, scans, config) / measurements,
    }


def _mapped(landmarks: int) -> dict[str, float]:
    """Time an EKF frame with bearings to some landmarks of a map, including four control steps."""
    from pipistrelle.config import Config
    from pipistrelle.detection.scans import make_scan
    from pipistrelle.estimation.beliefs import Gaussian
    from pipistrelle.estimation.catalogue import entry
    from pipistrelle.experiments.hearing.scenario import true_motion

    rng, label = np.random.default_rng(landmarks), np.arange(landmarks)
    slam = entry("ekf").build(Config(), true_motion(Config().motion))
    start = slam.init(Gaussian(mean=np.zeros(3), covariance=np.eye(3)))
    noise = {"bearing_std": 0.15, "range_std": 0.2}
    bearing, distance = rng.uniform(-3.0, 3.0, landmarks), rng.uniform(2.0, 20.0, landmarks)
    known = slam.update(start, make_scan(0.0, label, bearing, range=distance, **noise), rng)
    some = label[:: landmarks // BEARINGS][:BEARINGS]
    scan = make_scan(1.0, some, bearing[some], **noise)

    def frame() -> None:
        carried, _ = slam.predict(known, np.zeros((4, 2)), np.full(4, 0.25))
        slam.update(carried, scan, rng)

    return {"states": 3 + 2 * landmarks, "ekf_s": _cpu(101, frame)}


def _cpu(rounds: int, task: Callable[..., object], *arguments: object) -> float:
    """Time a task [s]: the minimum of some rounds, as noise only adds."""
    took = []
    for _ in range(rounds + 1):
        began = time.process_time()
        task(*arguments)
        took.append(time.process_time() - began)
    return min(took[1:])


if __name__ == "__main__":
    print(json.dumps({"points": points()}))
