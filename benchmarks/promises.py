"""Targets of the benchmarks, and lower bounds known beforehand."""

from typing import Literal

from benchmarks.table import Row

Relation = Literal["<=", ">="]

PROMISES: dict[str, tuple[str, float | None, Relation, float | None]] = {
    "frame_alone_ms": ("ms", 0.6, "<=", 0.25),
    "frame_amortised_ms": ("ms", 0.3, "<=", 0.1),
    "sweeps_over_tones": ("1", 30.0, "<=", None),
    "ekf_mission_ms": ("ms", 20.0, "<=", None),
    "fastslam_mission_ms": ("ms", 120.0, "<=", None),
    "study_minutes": ("min", 10.0, "<=", None),
    "study_overhead": ("1", 0.1, "<=", 0.0),
    "worker_mb": ("MB", 500.0, "<=", None),
    "disk_mb": ("MB", 100.0, "<=", None),
    "scaling_2_workers": ("1", 1.8, ">=", 2.0),
    "run_warm_s": ("s", 6.0, "<=", None),
    "help_ratio": ("1", 1.4, "<=", None),
    "cold_compile_s": ("s", 30.0, "<=", None),
    "iekf_over_ekf": ("1", 2.0, "<=", None),
    "smoother_over_ekf": ("1", 4.0, "<=", None),
    "precise_ekf_m": ("m", 0.4, "<=", None),
    "precise_iekf_m": ("m", 0.4, "<=", None),
    "precise_smoother_m": ("m", 0.05, "<=", None),
    "gtsam_isam2_ms": ("ms", None, ">=", None),
    "isam2_over_ekf": ("1", 1.0, ">=", None),
    "isam2_over_smoother": ("1", 15.0, ">=", None),
    "isam2_over_batch": ("1", 100.0, ">=", None),
    "gtsam_batch_over_batch": ("1", None, ">=", None),
    "batch_over_ekf": ("1", 1.0, "<=", None),
    "three_callers_over_one": ("1", 2.0, "<=", None),
    "hear_50_ekf_ms": ("ms", None, "<=", None),
    "hear_50_iekf_ms": ("ms", None, "<=", None),
    "hear_200_ekf_ms": ("ms", 5.0, "<=", None),
    "hear_200_iekf_ms": ("ms", 5.0, "<=", None),
    "hear_1000_ekf_ms": ("ms", None, "<=", None),
    "hear_1000_iekf_ms": ("ms", None, "<=", None),
    "frame_growth": ("1", 1.1, "<=", None),
    "ekf_growth": ("1", 2.1, "<=", None),
    "fastslam_growth": ("1", None, "<=", None),
    "memory_growth_mb": ("MB", 10.0, "<=", 0.0),
}
"""Unit, target, relation and floor by name; other floors are counted or measured."""
REQUIRED = tuple(PROMISES)[:13]
"""Rows of every complete run."""


def row(
    name: str,
    value: float,
    command: str,
    *,
    ratio: float | None = None,
    floor: float | None = None,
    note: str = "",
) -> Row:
    """Create a row from a measured value, with its unit and target."""
    unit, target, relation, known = PROMISES[name]
    return Row(
        name=name,
        value=value,
        unit=unit,
        target=target,
        relation=relation,
        ratio=ratio,
        floor=known if floor is None else floor,
        command=command,
        note=note,
    )
