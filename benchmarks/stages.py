"""Rows of the stages, from the records of pytest-benchmark."""

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.machine import python
from benchmarks.promises import row
from benchmarks.table import Row

FILE = "benchmarks/test_stages.py"
ROWS = {
    "frame_alone_ms": "test_listening_through_one_beam",
    "frame_amortised_ms": "test_listening_through_twelve_beams",
    "ekf_mission_ms": "test_mission[ekf-fused]",
    "fastslam_mission_ms": "test_mission[fastslam-fused]",
}
"""Benchmark of each row."""
RATIOS = {
    "iekf_over_ekf": "test_estimator[iekf]",
    "smoother_over_ekf": "test_estimator[smoother]",
}
DRIVES = {
    "precise_ekf_m": "test_precise_bearings[ekf]",
    "precise_iekf_m": "test_precise_bearings[iekf]",
    "precise_smoother_m": "test_precise_bearings[smoother]",
}
"""Benchmarks that give a ratio, and an error."""
BOTH = "test_listening_to_sweeps_and_to_tones"


def measure() -> tuple[list[Row], list[float]]:
    """Time the stages in a separate process; return their rows and calibration times [s]."""
    stages = timed_stages()
    return list(rows(stages)), [s["extra_info"]["calibration_s"] for s in stages.values()]


def timed_stages(*options: str) -> dict[str, Any]:
    """Time all or some stages, print pytest-benchmark's table, and return its records by name."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "stages.json"
        print(timed(path, *options))
        return {stage["name"]: stage for stage in json.loads(path.read_text())["benchmarks"]}


def timed(path: Path, *options: str) -> str:
    """Time the stages, write their records to a file, and return pytest-benchmark's table."""
    columns = "--benchmark-columns=min,median,max,rounds"
    only = ["--benchmark-only", columns, f"--benchmark-json={path}", "-m", ""]
    return python("-m", "pytest", FILE, *only, *options)


def rows(stages: dict[str, Any]) -> Iterator[Row]:
    """Yield the rows of the stages that pytest-benchmark's records contain."""
    for name, test in ROWS.items():
        if test not in stages:
            continue
        stage, extra = stages[test], stages[test]["extra_info"]
        seconds, floor = stage["stats"]["median"], extra.get("floor_s")
        yield row(
            name,
            1e3 * seconds / extra.get("frames", 1),
            _command(test),
            ratio=seconds / extra.get("frames", 1) / extra["calibration_s"],
            floor=None if floor is None else 1e3 * floor,
        )
    for name, test in RATIOS.items():
        if test in stages:
            ratio = stages[test]["extra_info"]["over_ekf"]
            note = f"{1e3 * stages[test]['stats']['median']:.1f} ms"
            yield row(name, ratio, _command(test), ratio=ratio, note=note)
    for name, test in DRIVES.items():
        if test in stages:
            error = stages[test]["extra_info"]["aligned_m"]
            note = f"in {1e3 * stages[test]['stats']['median']:.0f} ms"
            yield row(name, error, _command(test), ratio=error, note=note)
    if BOTH in stages:
        ratio = stages[BOTH]["extra_info"]["over_tones"]
        yield row("sweeps_over_tones", ratio, _command(BOTH), ratio=ratio)


def _command(test: str) -> str:
    """Return the command that measures a stage again."""
    return f"./dev bench -k '{test.replace('[', ' and ').replace('-', ' and ').rstrip(']')}'"
