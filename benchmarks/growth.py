"""How cost grows: frames with echoes, filters with landmarks, memory with worlds.

python -m benchmarks.growth     # CPU time at several sizes as JSON
"""

import json
import time
from collections.abc import Callable
from statistics import median

import numpy as np

from benchmarks.machine import answer
from benchmarks.promises import row
from benchmarks.study import command_slice
from benchmarks.table import Row

LANDMARKS = (10, 25, 50, 100, 200)
WORLDS = (2, 6)
COMMAND = "./dev bench --only growth --scaling"
ROWS = {
    "frame_growth": ("arrivals", "frame_s", "frame"),
    "ekf_growth": ("states", "ekf_s", "measurement"),
    "fastslam_growth": ("landmarks", "fastslam_s", "measurement"),
}
"""What is drawn against what."""


def measure() -> tuple[list[Row], list[float]]:
    """Time growing worlds in a process of their own: the rows."""
    sizes = answer("-m", "benchmarks.growth")["points"]
    rows = [_exponent(name, sizes) for name in ROWS]
    few, many = (command_slice(worlds, 1).peak / 1e6 for worlds in WORLDS)
    note = f"peak of {WORLDS[1]} worlds ({many:.0f} MB) less that of {WORLDS[0]} ({few:.0f} MB)"
    return [*rows, row("memory_growth_mb", many - few, COMMAND, note=note)], []


def _exponent(name: str, sizes: list[dict[str, float]]) -> Row:
    """Fit a power of the three largest sizes; name all points."""
    abscissa, ordinate, each = ROWS[name]
    x, y = (np.array([point[key] for point in sizes]) for key in (abscissa, ordinate))
    slope = float(np.polyfit(np.log(x[-3:]), np.log(y[-3:]), 1)[0])
    told = ", ".join(f"{a:.0f}: {1e6 * b:.3g}" for a, b in zip(x, y, strict=True))
    note = f"slope over the three largest; us a {each} by {abscissa}: {told}"
    return row(name, slope, COMMAND, ratio=slope, note=note)


def points() -> list[dict[str, float]]:
    """Time a frame, and a measurement in both filters, in worlds of more and more landmarks."""
    from benchmarks.worlds import scans_of, some_frames, world_of
    from pipistrelle.config import Config, ScenarioConfig
    from pipistrelle.experiments.kernels import compile_kernels
    from pipistrelle.experiments.listening import listen
    from pipistrelle.experiments.machine import keep_freed_memory
    from pipistrelle.experiments.trial import Case, drive_of, run_trial

    keep_freed_memory()  # as the command does
    compile_kernels()
    found = []
    for landmarks in LANDMARKS:
        config = Config(scenario=ScenarioConfig(landmarks=landmarks, spacing=0.5))
        world, radii = world_of(config), (config.emitter.radius,)
        few, drive = some_frames(world, 25), drive_of(world, config)
        scans = scans_of(config, "fused")
        measurements = sum(scan.landmark.size for scan in scans)
        point = {"landmarks": landmarks, "arrivals": 2.0 * landmarks + 1.0}
        point["frame_s"] = _cpu(15, listen, few, config, radii) / (len(few.controls) // 4)
        for name in ("ekf", "fastslam"):
            case = Case(strategy="fused", filter=name)
            point[f"{name}_s"] = _cpu(5, run_trial, case, drive, scans, config) / measurements
        final = run_trial(Case(strategy="fused", filter="ekf"), drive, scans, config)
        point["states"] = 3.0 + 2.0 * final.track.landmarks.landmark.size
        found.append(point)
    return found


def _cpu(rounds: int, task: Callable[..., object], *arguments: object) -> float:
    """Time a task: the median of some rounds [s]."""
    took = []
    for _ in range(rounds + 1):
        began = time.process_time()
        task(*arguments)
        took.append(time.process_time() - began)
    return median(took[1:])


if __name__ == "__main__":
    print(json.dumps({"points": points()}))
