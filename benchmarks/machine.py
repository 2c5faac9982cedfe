"""Description of the machine, and separate processes for measurements."""

import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import mean
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def facts() -> dict[str, Any]:
    """Describe the machine, its load and the relevant versions, without names of host or user."""
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "cpu": _processor(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "memory_gb": round(_memory() / 1e9, 1),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "os": f"{platform.system()} {'.'.join(platform.release().split('.')[:2])}",
        "python": platform.python_version(),
        **{name: _version(name) for name in ("numpy", "numba", "scipy", "polars", "gtsam")},
        "commit": _commit(),
    }


def python(*arguments: str, **changes: str) -> str:
    """Run this interpreter in the repository's root, and return its output.

    If it fails, print the output and exit.
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=os.environ | changes,
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        sys.exit(f"{done.stdout}\nbench: {shlex.join(arguments)} ended with {done.returncode}")
    return done.stdout


def answer(*arguments: str) -> dict[str, Any]:
    """Run this interpreter, and parse the last line of its output as JSON."""
    return json.loads(python(*arguments).splitlines()[-1])


def yardstick() -> float:
    """Time the calibration kernel in a separate process [s]."""
    return float(python("-m", "benchmarks.calibration"))


class Calibrated:
    """Context that times the calibration kernel on entry and exit; `seconds` is the mean."""

    def __enter__(self) -> "Calibrated":
        self._before = yardstick()
        return self

    def __exit__(self, *exception: object) -> None:
        self.seconds = mean((self._before, yardstick()))


def _processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _memory() -> int:
    """Return the machine's memory [bytes]; 0 if unknown."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 0


def _version(name: str) -> str | None:
    """Return the version of a library, if installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit's short name, marked if the tree has changes."""
    try:
        told = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--exclude", "*"],
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return None
    return told.stdout.strip()
