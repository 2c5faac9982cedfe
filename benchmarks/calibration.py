"""Calibration kernel: a fixed computation, timed before and after every benchmark.

A symmetric matrix of 128 x 128 numbers is updated by an outer product two thousand times:
multiply-adds within the second-level cache, much like an EKF update. A time in units of this
kernel's can be compared between runs on similar machines, whatever their load.

    python -m benchmarks.calibration     # seconds
"""

import time
from collections.abc import Callable
from statistics import median

import numpy as np
from numba import njit

SIZE, UPDATES = 128, 2000
ELEMENTS = SIZE * SIZE * UPDATES
"""Multiply-adds of a round."""


@njit(cache=True, error_model="numpy")
def _outer_products(matrix, vector, updates):
    """Subtract outer products of a vector from a matrix."""
    for k in range(updates):
        scale = 1e-3 / (1.0 + k)
        for i in range(vector.size):
            left = scale * vector[i]
            for j in range(vector.size):
                matrix[i, j] -= left * vector[j]


def calibrate(clock: Callable[[], float] = time.perf_counter, rounds: int = 41) -> float:
    """Time the calibration kernel: the median of some rounds [s]."""
    matrix, vector = np.eye(SIZE), np.cos(np.arange(SIZE))
    _outer_products(matrix, vector, 1)
    took = []
    for _ in range(rounds):
        began = clock()
        _outer_products(matrix, vector, UPDATES)
        took.append(clock() - began)
    return median(took)


if __name__ == "__main__":
    print(calibrate())
