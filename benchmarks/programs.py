"""Waiting times of a user: a warm run, the help, and the first compilation."""

import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from benchmarks.machine import ROOT, Calibrated, python
from benchmarks.promises import row
from benchmarks.table import Row

BARE = """
from cyclopts import App
from pydantic import BaseModel


class Settings(BaseModel):
    number: float = 1.0


app = App(name="bare", help="A bare program.")


@app.command
def run(*, settings: Settings = Settings()):
    "Run."


app(["--help"])
"""
LIBRARIES = "import pipistrelle.experiments.runs.trial, pipistrelle.figures.mission, polars"
COMMAND = "./dev bench --only programs"


def measure(rounds: int) -> tuple[list[Row], list[float]]:
    """Time the programs by wall clock; return their rows and calibration times [s]."""
    with Calibrated() as around_run:
        run, imports = _run(rounds), median(_wall("-c", LIBRARIES) for _ in range(rounds))
    ours, bare = _helps(2 * rounds + 1)
    with Calibrated() as around_compile:
        compiled = _cold_compile()
    rows = [
        row(
            "run_warm_s",
            run,
            COMMAND,
            ratio=run / around_run.seconds,
            floor=imports,
            note="three strategies with the figure; the floor is the import of the libraries",
        ),
        row(
            "help_ratio",
            ours / bare,
            COMMAND,
            ratio=ours / bare,
            note=f"{1e3 * ours:.0f} ms over the {1e3 * bare:.0f} ms of a bare cyclopts and "
            "pydantic program, in turns",
        ),
        row(
            "cold_compile_s",
            compiled,
            COMMAND,
            ratio=compiled / around_compile.seconds,
            note="a whole `pipistrelle run`, with an empty kernel cache",
        ),
    ]
    return rows, [around_run.seconds, around_compile.seconds]


def _wall(*arguments: str, **changes: str) -> float:
    """Time an interpreter by wall clock [s]."""
    began = time.perf_counter()
    python(*arguments, **changes)
    return time.perf_counter() - began


def _run(rounds: int) -> float:
    """Time `./dev run --settings paper` with everything installed and compiled [s]."""
    took = []
    for _ in range(rounds + 1):
        with TemporaryDirectory() as name:
            folder = str(Path(name) / "run")
            command = [
                sys.executable,
                str(ROOT / "dev"),
                "run",
                "--settings",
                "paper",
                "-o",
                folder,
            ]
            began = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            took.append(time.perf_counter() - began)
    return median(took[1:])


def _helps(rounds: int) -> tuple[float, float]:
    """Time the help of Pipistrelle and of a minimal program, alternately [s]."""
    pairs = [(_wall("-m", "pipistrelle", "--help"), _wall("-c", BARE)) for _ in range(rounds)]
    ours, bare = zip(*pairs, strict=True)
    return median(ours), median(bare)


def _cold_compile() -> float:
    """Time a first `pipistrelle run`, which compiles its kernels [s]."""
    with TemporaryDirectory() as name:
        command = ("-m", "pipistrelle", "run", "-o", str(Path(name) / "run"))
        return _wall(*command, NUMBA_CACHE_DIR=str(Path(name) / "kernels"))
