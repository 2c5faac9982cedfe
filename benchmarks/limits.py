"""What the filters' arithmetic costs at best: the rates that floors are counted with."""

import time
from statistics import median

import numpy as np
from numba import njit

from benchmarks.calibration import ELEMENTS, calibrate
from pipistrelle.estimation.elementary import arctangent, exponential, logarithm

NUMBERS, ROUNDS = 4096, 41


@njit(cache=True, error_model="numpy")
def _functions(x, y):
    """Take the three functions of every number, lane by lane."""
    for i in range(x.size):
        y[i] = arctangent(x[i], 1.0) + exponential(x[i]) + logarithm(x[i])


def elementary_function() -> float:
    """Time one of a filter's own elementary functions, the mean of three, in a loop of them [s]."""
    x, took = np.linspace(0.1, 3.0, NUMBERS), []
    y = np.empty_like(x)
    _functions(x, y)
    for _ in range(ROUNDS):
        began = time.process_time()
        for _ in range(100):
            _functions(x, y)
        took.append(time.process_time() - began)
    return median(took) / (100 * 3 * NUMBERS)


def multiply_add() -> float:
    """Time one multiply-add within the second-level cache, at the yardstick's rate [s]."""
    return calibrate(time.process_time) / ELEMENTS
