"""Time of the paper's whole study, extrapolated from some of its worlds.

The first worlds, one per worker, include the start-up; the others give the rate:
T = t_W + (115 - W) (t_N - t_W) / (N - W), with t_i when the i-th world is done, W workers and N
worlds. The times are the modification times of the files that the command writes.
"""

import os
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.machine import ROOT, Calibrated, answer
from benchmarks.promises import row
from benchmarks.table import Row

WORLDS = 115


@dataclass(frozen=True, slots=True, kw_only=True)
class Slice:
    """Cost of a part of the study.

    `seconds` is for all 115 worlds, `peak` [bytes] of the largest process, `disk` [bytes] for all.
    """

    seconds: float
    peak: int
    disk: float


def measure(worlds: int) -> tuple[list[Row], list[float]]:
    """Run part of the study with one and two workers; return rows and calibration times [s]."""
    with Calibrated() as around_one:
        one, stages = command_slice(worlds, 1), answer("-m", "benchmarks.overhead", str(worlds))
    with Calibrated() as around_two:
        two = command_slice(worlds, 2)
    share = f"{worlds} of {WORLDS} worlds"
    command = f"./dev bench --only study --worlds {worlds}"
    # stages: CPU seconds per world in listening and filters; whole: all CPU time of the process.
    whole = stages["before"] + WORLDS * stages["world"]
    within = WORLDS * (stages["listening"] + stages["filters"])
    rows = [
        row(
            "study_minutes",
            two.seconds / 60.0,
            command,
            ratio=two.seconds / around_two.seconds,
            floor=within / 2 / 60.0,
            note=f"two workers, told from {share}; the floor is the stages' CPU time over two: by "
            f"the clock, everything else takes {two.seconds / (within / 2) - 1.0:.0%} of that",
        ),
        row(
            "study_overhead",
            1.0 - within / whole,
            command,
            ratio=1.0 - within / whole,
            note=f"CPU time of one worker outside listening ({stages['listening']:.2f} s a world) "
            f"and filters ({stages['filters']:.2f} s), told from {share}",
        ),
        row("worker_mb", two.peak / 1e6, command, note="peak of the largest process"),
        row("disk_mb", two.disk / 1e6, command, note=f"told from {share}"),
        row(
            "scaling_2_workers",
            one.seconds / two.seconds,
            command,
            ratio=one.seconds / two.seconds,
            note=f"the whole study by one worker ({one.seconds / 60:.1f} min) over that by two",
        ),
    ]
    return rows, [around_one.seconds, around_two.seconds]


def command_slice(worlds: int, workers: int) -> Slice:
    """Run the command on the first worlds of the paper's study."""
    with TemporaryDirectory() as name:
        folder = Path(name) / "study"
        words = ["study", "paper", "--quiet", "--iterations", str(worlds), "--workers"]
        command = [sys.executable, "-m", "pipistrelle", *words, str(workers), "-o", str(folder)]
        began = time.time()
        peak = peak_of(command)
        files = [path for path in folder.rglob("*") if path.is_file()]
        done = sorted(path.stat().st_mtime - began for path in (folder / "trials").iterdir())
        disk = sum(path.stat().st_size for path in files) / worlds * WORLDS
    return Slice(seconds=whole_study(done, workers), peak=peak, disk=disk)


def whole_study(done: list[float], workers: int) -> float:
    """Extrapolate the time of all worlds from the rising finish times of some [s].

    >>> whole_study([5.0, 5.0, 7.0, 7.0], 2)
    118.0
    """
    first, rate = done[workers - 1], (done[-1] - done[workers - 1]) / (len(done) - workers)
    return first + (WORLDS - workers) * rate


def peak_of(command: list[str]) -> int:
    """Run a command, and return the peak memory of its largest process [bytes]."""
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"bench: {shlex.join(command)} ended with {process.returncode}")
    return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
