"""Checks of an estimator's inputs: initial pose, known landmarks, control steps and scans.

Kernels do not check array bounds, and NaNs spread through a belief unnoticed. So each call checks
shapes, types and values once. Valid input is returned unchanged; lists and arrays of other types
are converted.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import (
    FARTHEST,
    FASTEST,
    LARGEST,
    LONGEST_STEP,
    STEEPEST,
    WIDEST,
    InputError,
)
from pipistrelle.detection.scans import (
    BEARING,
    NUMBERS,
    STD_OF,
    UNLABELLED,
    Scan,
    is_merged,
    labelled,
)
from pipistrelle.estimation.beliefs import Gaussian, Landmarks
from pipistrelle.estimation.motion import MOVED, Controls, Durations, Motion
from pipistrelle.estimation.observations.rows import LOSSES
from pipistrelle.jit import Flag, Whole, kernel
from pipistrelle.refusals import shown
from pipistrelle.text_tables import TEXT_COLUMNS

FLOAT, INTEGER = np.dtype(np.float64), np.dtype(np.int64)
WHOLES = ("landmark", "caller", "callers", "moving")
"""Integer columns of a scan."""
MIN_STD = 1e-12
"""Least standard deviation [m] or [rad]; its square is still above rounding errors."""
MAX_CONTROLS = {
    "bicycle": ((FASTEST, WIDEST), f"a speed up to {FASTEST:g} m/s, an angle up to {WIDEST:g} rad"),
    "unicycle": (
        (FASTEST, WIDEST),
        f"a speed up to {FASTEST:g} m/s, a rate up to {WIDEST:g} rad/s",
    ),
    "ackermann": (
        (FASTEST, STEEPEST),
        f"a speed up to {FASTEST:g} m/s, a steering angle up to {STEEPEST:g} rad",
    ),
    "poses": (
        (FARTHEST, FARTHEST, WIDEST),
        f"moves up to {FARTHEST:g} m and a turn up to {WIDEST:g} rad, perhaps with a covariance: "
        "all six numbers, or NaN",
    ),
}
"""Largest controls of each motion model, as numbers and in words."""
BOUNDS = tuple(
    (-column.high if kind == "excess_path" else column.low, column.high, TEXT_COLUMNS[std].high)
    for kind, std in STD_OF.items()
    for column in [TEXT_COLUMNS[kind]]
)
"""Least and largest value, and largest standard deviation, of each kind of measurement."""
LABELS_END = 2**53
"""Upper bound of labels, as in a log."""
INDEFINITE = 1e-6
"""Tolerance for rounding in checks of positive semidefinite correlation matrices."""

UNSETTLED, NO_LABEL, NO_CALLER, TWICE, NO_NUMBER, UNSTATED, NO_CALLERS = range(1, 8)
WORDS = {
    NO_LABEL: "the labels {}; expected whole numbers from 0 on, or -1 for clutter",
    NO_CALLER: "callers below 0 for the landmarks {}; expected 0 for the vehicle, or the number of "
    "another",
    TWICE: "two bearings by one call for the landmarks {}; expected one",
    NO_NUMBER: "numbers that no filter can use, for the landmarks {}; expected finite bearings "
    f"[rad] and ranges above 0 [m], NaN where passive, up to {FARTHEST:g}; a row without a bearing "
    "has a range or an excess path [m]",
    UNSTATED: "no standard deviations above 0 for the landmarks {}; expected "
    f"bearing_std up to {WIDEST:g} rad, and range_std and excess_path_std up to {FARTHEST:g} m "
    "where "
    "there are such, as pipistrelle.detection.noise states them",
}
"""Error messages by fault of a scan's measurements; {} is replaced by labels."""


def check_gate(gate: Any, robust: Any = "none") -> None:
    """Raise InputError unless a gate is in (0, 1], and a robust loss is known by its name."""
    if isinstance(gate, bool) or not isinstance(gate, (int, float)) or not 0.0 < gate <= 1.0:
        raise InputError(
            f"gate: found {shown(gate)}, expected above 0 and up to 1; 1 drops nothing"
        )
    if robust not in LOSSES:
        raise InputError(f"robust: found {shown(robust)}, expected one of {', '.join(LOSSES)}")


def check_belief(belief: Any, kind: type) -> None:
    """Raise InputError unless a belief is of an estimator's belief class."""
    if not isinstance(belief, kind):
        raise InputError(
            f"belief: found {shown(belief)}, expected one of this filter, {kind.__name__}; init "
            "returns the first, and predict and update those that follow"
        )


def usable_pose(pose: Gaussian) -> Gaussian:
    """Return a copy of a start pose with covariance; raise InputError if it is invalid."""
    if not isinstance(pose, Gaussian):
        raise InputError(
            f"init: found {shown(pose)}, expected a Gaussian of a pose, (3), and its covariance, "
            "(3, 3); it is in pipistrelle.estimation.beliefs"
        )
    mean, covariance = _converted(pose.mean, FLOAT), _converted(pose.covariance, FLOAT)
    if mean is None or covariance is None or (mean.shape, covariance.shape) != ((3,), (3, 3)):
        raise InputError(
            f"init: found {_shape_of(pose.mean)} and {_shape_of(pose.covariance)}, expected a pose "
            "of 3 numbers and its covariance, 3 by 3"
        )
    lower = covariance[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    symmetric = np.allclose(covariance, covariance.T)
    if not (symmetric and np.abs(mean).max() <= LARGEST and is_covariance(lower)):
        raise InputError(
            f"init: found the pose {mean.tolist()} and the covariance {covariance.tolist()}, "
            f"expected numbers up to {LARGEST:g} and a symmetric covariance of variances of 0 or "
            "more and correlations between -1 and 1"
        )
    return Gaussian(mean=mean, covariance=covariance)


def usable_known(known: Landmarks) -> Landmarks:
    """Return known landmarks with arrays of valid type; raise InputError if they are invalid."""
    if not isinstance(known, Landmarks):
        raise InputError(
            f"knowing: found {shown(known)}, expected Landmarks; they are in "
            "pipistrelle.estimation.beliefs"
        )
    label, mean = _converted(known.landmark, INTEGER), _converted(known.mean, FLOAT)
    covariance = _converted(known.covariance, FLOAT)
    n = -1 if label is None or label.ndim != 1 else label.size
    if (
        label is None
        or mean is None
        or covariance is None
        or (mean.shape, covariance.shape) != ((n, 2), (n, 2, 2))
    ):
        given = (known.landmark, known.mean, known.covariance)
        raise InputError(
            f"knowing: found {', '.join(map(_shape_of, given))}; expected n labels, whole numbers, "
            "and places (n, 2) with their covariances (n, 2, 2)"
        )
    xx, xy, yx, yy = covariance.reshape(n, 4).T
    good = (label >= 0) & (np.abs(mean).max(axis=1, initial=0.0) <= LARGEST)
    good &= (xx >= 0.0) & (yy >= 0.0) & (xx + yy <= LARGEST**2) & np.isclose(xy, yx)
    good &= xy * xy <= xx * yy * (1.0 + INDEFINITE)
    if not good.all() or np.unique(label).size < n:
        raise InputError(
            f"knowing: found the landmarks {label[~good].tolist() or label.tolist()}; expected "
            f"labels from 0 on, each once, places up to {LARGEST:g} m, and covariances that are "
            "symmetric and positive semidefinite"
        )
    return replace(known, landmark=label, mean=mean, covariance=covariance)


def usable_controls(
    motion: Motion, controls: Controls, dt: Durations
) -> tuple[Controls, Durations]:
    """Return control steps and their durations [s] as arrays; raise InputError if invalid."""
    steps, times = controls, dt
    if not (_is_plain(controls) and _is_plain(dt)):
        steps, times = _converted(controls, FLOAT), _converted(dt, FLOAT)
    poses = motion.model == "poses"
    widths = (MOVED, MOVED + 6) if poses else (2,)
    if (
        steps is None
        or times is None
        or steps.ndim != 2
        or times.shape != steps.shape[:1]
        or steps.shape[1] not in widths
    ):
        raise InputError(
            f"predict: found controls of {_shape_of(controls)} and times of {_shape_of(dt)}, "
            f"expected numbers: a row of {' or '.join(map(str, widths))} controls for each step of "
            f"a {motion.model} model, and as many times"
        )
    most, words = MAX_CONTROLS[motion.model]
    if not _are_steps(steps, times, most, poses):
        raise InputError(
            f"predict: found the controls {steps.tolist()} during {times.tolist()} s, expected "
            f"times above 0, up to {LONGEST_STEP:g} s, and {words}"
        )
    return steps, times


def usable_scan(scan: Scan) -> Scan:
    """Return a scan with one measurement per landmark, all labelled; raise InputError if invalid.

    Measurements of a landmark by several callers are merged (`detection.scans.labelled`). Invalid
    are arrays of unequal length, bad labels, two bearings of a landmark by the same call,
    measurements with neither bearing nor excess path, or without standard deviations.
    """
    if not isinstance(scan, Scan):
        raise InputError(
            f"update: found {shown(scan)}, expected a Scan; pipistrelle.detection.scans.make_scan "
            "makes one of columns"
        )
    if not _is_laid_out(scan):
        columns: dict[str, Any] = {n: _converted(getattr(scan, n), INTEGER) for n in WHOLES}
        columns["numbers"] = _converted(scan.numbers, FLOAT)
        whole = not any(column is None for column in columns.values())
        made = replace(scan, **columns) if whole else scan
        if not _is_laid_out(made):
            shapes = ", ".join(f"{name} {_shape_of(getattr(scan, name))}" for name in columns)
            raise InputError(
                f"scan at {scan.time} s: found {shapes}; expected whole numbers (m) for landmark "
                f"and caller, numbers ({NUMBERS}, m), and rows of whole numbers for callers and "
                "moving; pipistrelle.detection.scans.make_scan makes a scan of columns"
            )
        scan = made
    fault = _fault(scan.landmark, scan.caller, scan.numbers, scan.callers, scan.moving)
    if fault > UNSETTLED:
        raise InputError(f"scan at {scan.time} s: found {_worded(scan, fault)}")
    return labelled(scan, scan.landmark) if fault else scan


def _is_laid_out(scan: Scan) -> bool:
    """Return whether a scan's columns have the types, shapes and layout for compiled functions."""
    # Written out, as it is done twice for each scan.
    landmark, caller, numbers = scan.landmark, scan.caller, scan.numbers
    callers, moving = scan.callers, scan.moving
    return (
        type(landmark) is type(caller) is type(callers) is type(moving) is np.ndarray
        and landmark.dtype == caller.dtype == callers.dtype == moving.dtype == INTEGER
        and landmark.ndim == callers.ndim == moving.ndim == 1
        and caller.shape == landmark.shape
        and _is_plain(numbers)
        and numbers.shape == (NUMBERS, landmark.size)
        and landmark.flags.carray
        and caller.flags.carray
        and callers.flags.carray
        and moving.flags.carray
    )


def _is_plain(values: Any, kind: np.dtype = FLOAT) -> bool:
    """Return whether values are a contiguous array of the given type, for compiled functions."""
    return type(values) is np.ndarray and values.dtype == kind and values.flags.carray


def _converted(values: Any, kind: np.dtype) -> np.ndarray | None:
    """Convert values to a contiguous array of a type; None if their type does not permit it."""
    try:
        given = np.asarray(values)
    except (TypeError, ValueError):  # rows of unequal lengths
        return None
    if given.size and given.dtype.kind not in ("iu" if kind == INTEGER else "fiu"):
        return None
    return np.array(given, dtype=kind, order="C")


def _shape_of(values: Any) -> str:
    """Describe the type and shape of a value for an error message."""
    try:
        given = np.asarray(values)
    except (TypeError, ValueError):
        return "rows of unlike lengths"
    return f"{given.dtype} {given.shape}"


def _worded(scan: Scan, fault: int) -> str:
    """Format an error message for the code of a scan's fault, with the affected landmarks."""
    if fault == NO_CALLERS:
        return (
            f"the callers' labels {scan.callers.tolist()} and {scan.moving.tolist()} for who "
            "moves; expected whole numbers from 0 on, or -1 for an unknown caller"
        )
    columns = scan.landmark, scan.caller, scan.numbers
    rows = [m for m in range(scan.landmark.size) if _fault_of_row(*columns, m) == fault]
    return WORDS[fault].format(scan.landmark[rows].tolist())


@kernel
def _fault(
    landmark: Int[np.ndarray, " m"],
    caller: Int[np.ndarray, " m"],
    numbers: Float[np.ndarray, "8 m"],
    callers: Int[np.ndarray, " c"],
    moving: Int[np.ndarray, " v"],
) -> int:
    """Return the code of the first fault found in a scan's arrays; 0 if they are valid."""
    for m in range(landmark.size):
        fault = _fault_of_row(landmark, caller, numbers, m)
        if fault:
            return fault
    for label in callers:
        if label < UNLABELLED or label >= LABELS_END:
            return NO_CALLERS
    for label in moving:
        if label < 0 or label >= LABELS_END:
            return NO_CALLERS
    return 0 if is_merged(landmark, numbers[BEARING]) else UNSETTLED


@kernel
def _fault_of_row(
    landmark: Int[np.ndarray, " m"],
    caller: Int[np.ndarray, " m"],
    numbers: Float[np.ndarray, "8 m"],
    m: Whole,
) -> int:
    """Return the code of the fault of measurement m in a scan, or 0 if it is valid."""
    if landmark[m] < UNLABELLED or landmark[m] >= LABELS_END:
        return NO_LABEL
    if caller[m] < 0:
        return NO_CALLER
    measured, unstated = False, False
    for kind, (low, high, most) in enumerate(BOUNDS):
        value, std = numbers[kind, m], numbers[len(BOUNDS) + kind, m]
        if math.isnan(value):
            continue
        if not low <= value <= high:
            return NO_NUMBER
        measured, unstated = True, unstated or not MIN_STD <= std <= most
    if not measured or unstated:
        return UNSTATED if measured else NO_NUMBER
    for other in range(0 if math.isnan(numbers[BEARING, m]) or landmark[m] == UNLABELLED else m):
        again = landmark[other] == landmark[m] and caller[other] == caller[m]
        if again and not math.isnan(numbers[BEARING, other]):
            return TWICE
    return 0


@kernel
def _are_steps(steps: Controls, times: Durations, most: tuple[float, ...], poses: Flag) -> Flag:
    """Return whether all control steps and durations are within limits, with valid covariances."""
    for k in range(times.size):
        if not 0.0 < times[k] <= LONGEST_STEP:
            return False
        for c in range(len(most)):
            if not abs(steps[k, c]) <= most[c]:
                return False
        said = poses and steps.shape[1] > MOVED and not np.isnan(steps[k, MOVED:]).all()
        if said and not is_covariance(steps[k, MOVED:]):
            return False
    return True


@kernel
def is_covariance(entries: Float[np.ndarray, "6"]) -> Flag:
    """Return whether six entries (xx, xy, xh, yy, yh, hh) form a covariance, up to rounding."""
    xx, yy, hh = entries[0], entries[3], entries[5]
    if not (0.0 <= xx <= LARGEST**2 and 0.0 <= yy <= LARGEST**2 and 0.0 <= hh <= LARGEST**2):
        return False
    a = _correlation(entries[1], xx, yy)
    b = _correlation(entries[2], xx, hh)
    c = _correlation(entries[4], yy, hh)
    if not max(abs(a), abs(b), abs(c)) <= 1.0 + INDEFINITE:
        return False
    return 1.0 + 2.0 * a * b * c - a * a - b * b - c * c >= -INDEFINITE


@kernel
def _correlation(covariance: float, one: float, other: float) -> float:
    """Return a correlation from a covariance and two variances; infinite if a variance is 0."""
    if covariance == 0.0:
        return 0.0
    return covariance / math.sqrt(one * other)
