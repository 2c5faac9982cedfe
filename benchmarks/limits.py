"""Peak rates of this machine in the inner loops of the benchmarks, for their lower bounds.

python -m benchmarks.limits     # a line for each
"""

import math
import time
from collections.abc import Callable
from statistics import median

import numpy as np
from numba import njit

from benchmarks.calibration import ELEMENTS, calibrate
from pipistrelle.arithmetic.elementary import arctangent, exponential, logarithm

NUMBERS, ROUNDS = 4096, 41


def multiply_add() -> float:
    """Time a multiply-add within the second-level cache, from the calibration kernel [s]."""
    return calibrate(time.process_time) / ELEMENTS


def elementary_function() -> float:
    """Time an elementary function of `arithmetic.elementary`, averaged over three in a loop [s]."""
    x = np.linspace(0.1, 3.0, NUMBERS)
    return _timed(lambda: _functions(x, np.empty_like(x), 100)) / (3 * 100 * NUMBERS)


def library_function() -> float:
    """Time a cosine of the C library, in a loop [s]."""
    x = np.linspace(0.1, 3.0, NUMBERS)
    return _timed(lambda: _cosines(x, np.empty_like(x), 10)) / (10 * NUMBERS)


def copied_byte(size: int) -> float:
    """Time the copy of a byte, read and written, in an array of a given size in bytes [s]."""
    source = np.ones(size // 8)
    target, copies = np.empty_like(source), max(20_000_000 // size, 1)

    def copy() -> None:
        for _ in range(copies):
            np.copyto(target, source)

    return _timed(copy) / (2 * copies * size)


@njit(cache=True, error_model="numpy")
def _functions(x, y, times):
    """Evaluate the three functions of every number, several times."""
    for _ in range(times):
        for i in range(x.size):
            y[i] = arctangent(x[i], 1.0) + exponential(x[i]) + logarithm(x[i])


@njit(cache=True, error_model="numpy")
def _cosines(x, y, times):
    """Evaluate the cosine of every number, several times."""
    for _ in range(times):
        for i in range(x.size):
            y[i] = math.cos(x[i])


def _timed(task: Callable[[], None]) -> float:
    """Time a task after a warm-up: the median of some rounds [s]."""
    task()
    took = []
    for _ in range(ROUNDS):
        began = time.process_time()
        task()
        took.append(time.process_time() - began)
    return median(took)


if __name__ == "__main__":
    print(f"{1e-9 / multiply_add():.3g} multiply-adds a nanosecond, within the second-level cache")
    print(
        f"{1e9 * elementary_function():.3g} ns for an elementary function of the filters', by lanes"
    )
    print(f"{1e9 * library_function():.3g} ns for a cosine of the C library")
    for size, name in ((1_240_000, "a frame's sums"), (200_000_000, "200 MB")):
        print(f"{1e-9 / copied_byte(size):.3g} GB/s, read and written, copying {name}")
