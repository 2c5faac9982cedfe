"""Merging: what the callers' tones say of one landmark becomes one measurement.

A sensing strategy takes the rows of some callers, and of the rows of one landmark is made one: the
same is done when an association has said which rows are of one landmark.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import InputError, Strategy
from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    LEVEL,
    NUMBERS,
    OWN,
    RANGE,
    SLOPE,
    UNLABELLED,
    Scan,
    rows_of,
    with_callers,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel
from pipistrelle.refusals import shown

LISTENS_TO = {"active": (True, False), "fused": (True, True), "passive": (False, True)}
"""Whether a strategy takes what the vehicle's own call, and what the others' calls bring back."""


def scan_of(rows: Scan, strategy: Strategy) -> Scan:
    """Select the measurements of a frame that a sensing strategy uses.

    Active takes what the vehicle's own call brings back, passive what those of others do, fused
    both: of the rows of one landmark it makes one (`fused`).

    Parameters
    ----------
    rows : Scan
        All that was heard in a frame.
    strategy : "active", "fused" or "passive"

    Returns
    -------
    Scan

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = make_scan(0.5, np.array([2, 2, 5]), np.array([0.2, 0.4, 1.0]),
    ...                  caller=np.array([0, 1, 1]), range=np.array([4.0, np.nan, np.nan]))
    >>> scan_of(rows, "fused").bearing.round(9).tolist()
    [0.3, 1.0]
    >>> scan_of(rows, "active").landmark.tolist()
    [2]
    """
    own, others = LISTENS_TO[strategy]
    if rows.direct.size:  # rows without labels: nothing is merged
        return rows_of(rows, np.where(rows.caller == OWN, own, others))
    return _fused(rows, rows.landmark, own=own, others=others, labels_only=False)


def labelled(scan: Scan, label: Int[np.ndarray, " m"]) -> Scan:
    r"""Label a scan's rows: one row for each landmark remains; rows without a label are dropped.

    The bearing of several is their mean, weighted by the inverse variances where all are stated,

    .. math:: \bar\phi = \sum_i \phi_i \sigma_i^{-2} \Big/ \sum_i \sigma_i^{-2}, \qquad
              \bar\sigma^{-2} = \sum_i \sigma_i^{-2} ,

    and else the plain mean, whose deviation is not stated. Range and excess path are the first
    among the rows; further excess paths become rows without a bearing, at the end. The label of a
    caller's direct call (`Scan.direct`) becomes that of the caller.

    A scan that is labelled and merged already is returned as it is.

    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.5, np.full(3, UNLABELLED), np.array([0.2, 0.4, 1.0]), bearing_std=0.1)
    >>> merged = labelled(scan, np.array([7, 7, UNLABELLED]))
    >>> merged.landmark, merged.bearing.round(9), merged.bearing_std.round(4)
    (array([7]), array([0.3]), array([0.0707]))
    """
    if label is scan.landmark and settled(label, scan.bearing):
        return scan
    label = _checked(scan, np.asarray(label))
    if scan.direct.size:
        scan = with_callers(scan, np.append(label, UNLABELLED)[scan.direct])  # -1: not heard
    return _fused(scan, label, own=True, others=True, labels_only=True)


def _fused(
    scan: Scan, label: Int[np.ndarray, " m"], *, own: bool, others: bool, labels_only: bool
) -> Scan:
    """Select the rows of some callers and merge those of each label into one."""
    numbers = np.ascontiguousarray(scan.numbers)
    landmark, caller, numbers = _fuse(label, scan.caller, numbers, own, others, labels_only)
    return replace(scan, landmark=landmark, caller=caller, numbers=numbers)


def _checked(scan: Scan, label: np.ndarray) -> Int[np.ndarray, " m"]:
    """Check the labels of a scan's rows."""
    whole = label.dtype.kind in "iu" or not label.size
    if label.shape != scan.landmark.shape or not whole or label.min(initial=0) < UNLABELLED:
        raise InputError(
            f"association at {scan.time} s: found labels {shown(label.tolist())}, expected "
            f"{scan.landmark.size} whole numbers, one for each row: from 0 on, or {UNLABELLED} "
            "for clutter"
        )
    return label.astype(np.int64, copy=False)


@kernel
def settled(label: Int[np.ndarray, " m"], bearing: Float[np.ndarray, " m"]) -> bool:
    """Tell whether every row has a label, and those with a bearing stand first, one a label."""
    for m in range(label.size):
        bare = math.isnan(bearing[m])
        if label[m] == UNLABELLED or (m > 0 and math.isnan(bearing[m - 1]) and not bare):
            return False
        for other in range(m):
            if label[other] == label[m] and not bare:
                return False
    return True


@kernel
def _fuse(
    label: Int[np.ndarray, " m"],
    whose: Int[np.ndarray, " m"],
    given: Float[np.ndarray, "8 m"],
    own: bool,
    others: bool,
    labels_only: bool,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], Float[np.ndarray, "8 k"]]:
    """Select the rows of some callers and merge those of each landmark into one.

    Rows without a label stay as they are, or are left out. Excess paths after a landmark's first
    are rows of their own, at the end.
    """
    most = label.size
    landmark, caller = np.empty(most, np.int64), np.empty(most, np.int64)
    numbers, merged = np.full((NUMBERS, most), np.nan), np.zeros(most, np.int64)
    sums, bearing, std, count = np.zeros((5, most)), given[BEARING], given[BEARING_STD], 0
    further, excess_paths = np.empty(most, np.int64), 0
    for m in range(most):
        if not (own if whose[m] == OWN else others) or (labels_only and label[m] == UNLABELLED):
            continue
        if math.isnan(bearing[m]):
            further[excess_paths], excess_paths = m, excess_paths + 1
            continue
        k = count
        while k > 0 and label[m] != UNLABELLED and landmark[k - 1] != label[m]:
            k -= 1
        if k > 0 and label[m] != UNLABELLED:
            k -= 1
        else:
            k, count = count, count + 1
            landmark[k], caller[k] = label[m], whose[m]
        if not math.isnan(given[EXCESS_PATH, m]):
            if math.isnan(numbers[EXCESS_PATH, k]):
                caller[k] = whose[m]
            else:
                further[excess_paths], excess_paths = m, excess_paths + 1
        _take(numbers, k, given, m)
        off = wrap_angle(bearing[m] - numbers[BEARING, k])  # from the first row's
        merged[k] += 1
        sure, slope = 1.0 / (std[m] * std[m]), given[SLOPE, m]
        for e, part in enumerate((off, off * sure, slope, slope * sure, sure)):
            sums[e, k] += part
    _average(numbers[:, :count], merged, sums)
    for m in further[:excess_paths]:
        landmark[count], caller[count] = label[m], whose[m]
        for number in (EXCESS_PATH, EXCESS_PATH_STD, LEVEL):
            numbers[number, count] = given[number, m]
        count += 1
    return landmark[:count], caller[:count], numbers[:, :count].copy()


@kernel
def _average(
    numbers: Float[np.ndarray, "8 k"],
    merged: Int[np.ndarray, " m"],
    sums: Float[np.ndarray, "5 m"],
) -> None:
    """Turn the first bearing of each row to the mean of all that were merged.

    ``sums``: how far they are from it, plainly and weighted; their slopes likewise; their weight.
    Room may be left.
    """
    turn, weighted, slope, weighted_slope, weight = sums
    for k in range(numbers.shape[1]):
        if merged[k] > 1:
            first = numbers[BEARING, k]
            if math.isnan(weight[k]):
                numbers[BEARING, k] = wrap_angle(first + turn[k] * (1.0 / merged[k]))
                numbers[SLOPE, k] = slope[k] * (1.0 / merged[k])
                numbers[BEARING_STD, k] = np.nan
            else:
                numbers[BEARING, k] = wrap_angle(first + weighted[k] / weight[k])
                numbers[SLOPE, k] = weighted_slope[k] / weight[k]
                numbers[BEARING_STD, k] = 1.0 / math.sqrt(weight[k])


@kernel
def _take(
    numbers: Float[np.ndarray, "8 k"], k: Whole, given: Float[np.ndarray, "8 m"], m: Whole
) -> None:
    """Fill the missing numbers of a landmark's row from another row; keep the higher level."""
    for number in (BEARING, RANGE, EXCESS_PATH):
        if math.isnan(numbers[number, k]):
            spread = number + BEARING_STD
            numbers[number, k], numbers[spread, k] = given[number, m], given[spread, m]
            if number == BEARING:
                numbers[SLOPE, k] = given[SLOPE, m]
    level = given[LEVEL, m]
    if math.isnan(numbers[LEVEL, k]) or level > numbers[LEVEL, k]:
        numbers[LEVEL, k] = level
