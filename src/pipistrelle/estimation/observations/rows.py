"""A scan's measurements as the estimators' kernels take them, and their robust losses."""

import math
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import FilterConfig
from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    RANGE,
    RANGE_STD,
    UNLABELLED,
    Scan,
)
from pipistrelle.jit import Whole, kernel, no_alloc

LOSSES = get_args(FilterConfig.model_fields["robust"].annotation)
"""Names of the robust losses; their codes in kernels are their places."""
SQUARED, HUBER, CAUCHY = range(len(LOSSES))
HUBER_K = 2.0
"""Standard deviations above which Huber's loss down-weights a measurement."""
CAUCHY_K = 2.385
"""Scale of Cauchy's loss [standard deviations]: normal errors keep 95 % of their information."""


@no_alloc
def robust_loss(squared: float, loss: Whole) -> tuple[float, float]:
    r"""Return the factor on the variance of a measurement, and twice its loss.

    With the squared residual :math:`e^2` in units of its variance, the loss is e²/2 (SQUARED),

    .. math:: k e - \tfrac12 k^2 \; (e > k), \qquad \tfrac12 c^2 \ln(1 + e^2 / c^2)

    (HUBER, CAUCHY), and the factor the inverse of its weight: e / k and 1 + e² / c². Sources:
    Huber, Robust Statistics (1981); Holland & Welsch, Communications in Statistics 6 (1977).
    """
    if loss == CAUCHY:
        factor = 1.0 + squared / (CAUCHY_K * CAUCHY_K)
        return factor, CAUCHY_K * CAUCHY_K * math.log(factor)
    if loss == HUBER and squared > HUBER_K * HUBER_K:
        size = math.sqrt(squared)
        return size / HUBER_K, HUBER_K * (2.0 * size - HUBER_K)
    return 1.0, squared


class Row(NamedTuple):
    """A measured bearing and range with their variances, as scalars."""

    landmark: Whole
    bearing: float  # [rad], NaN for a range-only measurement
    range: float  # [m], NaN if passive
    bearing_variance: float  # [rad^2]
    range_variance: float  # [m^2]


class ExcessPaths(NamedTuple):
    """Measured excess paths of a scan, with landmark, caller and variance of each."""

    landmark: Int[np.ndarray, " d"]  # never the caller
    caller: Int[np.ndarray, " d"]
    excess_path: Float[np.ndarray, " d"]  # [m]
    variance: Float[np.ndarray, " d"]  # [m^2]
    row: Int[np.ndarray, " d"]  # index in the scan
    used: Bool[np.ndarray, " d"]  # whether it has initialised a landmark or caller


Columns = tuple[Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]]
"""Labels and numbers of a scan's measurements."""
Timings = tuple[Int[np.ndarray, " m"], Int[np.ndarray, " callers"], Int[np.ndarray, " v"]]
"""Caller of each measurement of a scan; labels of the callers, and of the moving callers."""


def scan_columns(scan: Scan) -> Columns:
    """Return a scan's labels and numbers as a tuple of arrays, for compiled functions."""
    return scan.landmark, np.ascontiguousarray(scan.numbers)


def timings_of(scan: Scan) -> Timings | None:
    """Return a scan's callers as arrays for compiled functions, or None if it names no caller.

    For None, kernels are compiled without code for excess paths.
    """
    if scan.callers.size == 0 and scan.moving.size == 0:
        return None
    return scan.caller, scan.callers, scan.moving


@no_alloc
def rows_with_bearing(columns: Columns) -> Whole:
    """Count a scan's measurements with a bearing; others, a range or an excess path, come last."""
    rows, bearing = columns[0].size, columns[1][BEARING]
    while rows > 0 and math.isnan(bearing[rows - 1]):
        rows -= 1
    return rows


@no_alloc
def row_of(columns: Columns, m: Whole) -> Row:
    """Return bearing and range of measurement m in a scan, with variances, as scalars."""
    landmark, numbers = columns
    across, along = numbers[BEARING_STD, m], numbers[RANGE_STD, m]
    return Row(landmark[m], numbers[BEARING, m], numbers[RANGE, m], across * across, along * along)


@kernel
def excess_paths(columns: Columns, timings: Timings) -> ExcessPaths:
    """Return the excess paths in a scan, without the callers' direct calls.

    >>> from dataclasses import replace
    >>> from pipistrelle.detection.scans import make_scan
    >>> timed = {"excess_path": np.array([3.0, np.nan, 2.0]), "excess_path_std": 0.5}
    >>> scan = make_scan(0.0, np.array([4, 5, 9]), np.zeros(3), caller=1, **timed)
    >>> scan = replace(scan, callers=np.array([-1, 9]))
    >>> of = excess_paths(scan_columns(scan), timings_of(scan))
    >>> of.landmark, of.caller, of.variance
    (array([4]), array([9]), array([0.25]))
    """
    (landmark, numbers), (caller, callers, _) = columns, timings
    count, rows, whose = 0, np.empty(landmark.size, np.int64), np.empty(landmark.size, np.int64)
    for m in range(landmark.size):
        if math.isnan(numbers[EXCESS_PATH, m]) or caller[m] >= callers.size:
            continue
        label = callers[caller[m]]
        if label != UNLABELLED and label != landmark[m]:
            rows[count], whose[count] = m, label
            count += 1
    kept, used = rows[:count], np.zeros(count, np.bool_)
    path, std = numbers[EXCESS_PATH][kept], numbers[EXCESS_PATH_STD][kept]
    return ExcessPaths(landmark[kept], whose[:count], path, std * std, kept, used)


def caller_labels(scan: Scan) -> Int[np.ndarray, " m"]:
    """Return the caller's label for each measurement with an excess path, else UNLABELLED."""
    labels, timings = np.full(scan.landmark.size, UNLABELLED), timings_of(scan)
    if timings is not None:
        found = excess_paths(scan_columns(scan), timings)
        labels[found.row] = found.caller
    return labels
