"""Scans: the measurements of a frame as arrays, and their merging by landmark.

A sensing strategy selects the measurements of some callers; measurements of one landmark, by
different callers or after association, are merged into one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError, Strategy
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel
from pipistrelle.refusals import shown

WIDEST = math.pi / 2.0 / math.sqrt(12.0)
"""Standard deviation of a bearing that is uniform over a quarter turn [rad]. A larger one is
useless: the mean of the landmark's possible positions is a tenth nearer than the range."""
UNLABELLED = -1
"""Label of a measurement whose landmark is not known."""
OWN = 0
"""Number of the vehicle among the callers, as in `pipistrelle.acoustics.paths`."""
NO_CALLERS = np.empty(0, dtype=np.int64)
"""An empty array of labels: no caller's label is known, or no caller moves."""

KINDS = ("bearing", "range", "excess_path")
"""Kinds of measurements that a row may have; each has a column, and one of its deviation."""
STD_OF = {kind: f"{kind}_std" for kind in KINDS}
COLUMNS = ("landmark", "caller", *KINDS, *STD_OF.values(), "level_db", "bearing_slope")
"""Names of a scan's columns."""
NUMBERS = len(COLUMNS) - 2
BEARING, RANGE, EXCESS_PATH, BEARING_STD, RANGE_STD, EXCESS_PATH_STD, LEVEL, SLOPE = range(NUMBERS)
"""Row of each column in `Scan.numbers`; label and caller have their own arrays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Measurements of landmarks and callers at the same time, in columns.

    `numbers` is a single array with a row for each column, for kernels; properties name the
    columns. `pipistrelle.detection.noise` states standard deviations.
    """

    time: float
    """[s]."""
    landmark: Int[np.ndarray, " m"]
    """Recorded label, or UNLABELLED."""
    caller: Int[np.ndarray, " m"]
    """OWN, or the number of another caller: of several, the first with an excess path, else the
    first."""
    numbers: Float[np.ndarray, "8 m"]
    """The other columns, in the order of `COLUMNS`."""
    callers: Int[np.ndarray, " c"] = field(default_factory=lambda: NO_CALLERS)
    """Label of each caller as a landmark, by its number; UNLABELLED for the vehicle, and if
    unknown, as for numbers beyond the array."""
    moving: Int[np.ndarray, " v"] = field(default_factory=lambda: NO_CALLERS)
    """Labels of the callers that move; none in a scan without labels."""
    moving_callers: Int[np.ndarray, " w"] = field(default_factory=lambda: NO_CALLERS)
    """Numbers of the callers that move, in a scan without labels."""
    direct: Int[np.ndarray, " d"] = field(default_factory=lambda: NO_CALLERS)
    """Row of each caller's direct call, by the caller's number, in a scan without labels; -1 if
    there is none. The row's label becomes the caller's (`labelled`)."""

    @property
    def bearing(self) -> Float[np.ndarray, " m"]:
        """Bearing from the heading, counter-clockwise [rad]; NaN if not measured."""
        return self.numbers[BEARING]

    @property
    def range(self) -> Float[np.ndarray, " m"]:
        """Range to the landmark [m]; NaN if passive."""
        return self.numbers[RANGE]

    @property
    def excess_path(self) -> Float[np.ndarray, " m"]:
        """Sound path over the landmark less the direct path from the caller [m], or NaN."""
        return self.numbers[EXCESS_PATH]

    @property
    def bearing_std(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the bearing [rad]; NaN if not stated."""
        return self.numbers[BEARING_STD]

    @property
    def range_std(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the range [m]; NaN if not stated."""
        return self.numbers[RANGE_STD]

    @property
    def excess_path_std(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the excess path [m]; NaN if not stated."""
        return self.numbers[EXCESS_PATH_STD]

    @property
    def level_db(self) -> Float[np.ndarray, " m"]:
        """Level of the strongest detection over a steered beam's noise [dB], or NaN."""
        return self.numbers[LEVEL]

    @property
    def bearing_slope(self) -> Float[np.ndarray, " m"]:
        """Derivative of the bearing with respect to the log of the speed of sound [rad], or NaN."""
        return self.numbers[SLOPE]


def make_scan(
    time: float,
    landmark: Int[np.ndarray, " m"],
    bearing: Float[np.ndarray, " m"],
    **columns: np.ndarray | float,
) -> Scan:
    """Make a scan from labels, bearings and any other columns; missing columns are NaN.

    `time` [s]; `bearing` [rad]; `columns`: any others, as arrays or a number for all rows.
    Without a caller column, the caller is the vehicle. Raises InputError for unknown columns,
    and columns of different lengths or not of numbers.

    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]), bearing_std=0.15)
    >>> scan.range, scan.bearing_std
    (array([nan, nan]), array([0.15, 0.15]))
    """
    given = {"landmark": landmark, "bearing": bearing} | columns
    return _made_of(time, _shape("landmark", landmark), given)


def with_columns(scan: Scan, **columns: np.ndarray | float) -> Scan:
    """Return a scan with some of its columns replaced, by arrays or one number for all rows.

    Raises InputError as `make_scan` does.

    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]))
    >>> with_columns(scan, range=2.0, bearing=-scan.bearing).bearing
    array([-0.2, -1. ])
    """
    own = {name: getattr(scan, name) for name in COLUMNS}
    made = _made_of(scan.time, scan.landmark.shape, own | columns)
    kept = ("callers", "moving", "moving_callers", "direct")
    return replace(made, **{name: getattr(scan, name) for name in kept})


def _made_of(time: float, shape: tuple[int, ...], given: dict[str, np.ndarray | float]) -> Scan:
    """Build a scan from columns by name, with defaults for missing columns."""
    if unknown := sorted(given.keys() - set(COLUMNS)):
        raise InputError(f"scan: no such column {unknown[0]}; expected one of {', '.join(COLUMNS)}")
    shapes = {name: _shape(name, value) for name, value in given.items()}
    if lengths := {name: found for name, found in shapes.items() if found not in ((), shape)}:
        raise InputError(
            f"scan: found columns of the shapes {lengths}, expected {shape}, that of landmark"
        )
    whole, numbers = np.empty((2, *shape), dtype=np.int64), np.empty((NUMBERS, *shape))
    given = {"caller": OWN} | given
    for row, name in zip([*whole, *numbers], COLUMNS, strict=True):
        value = np.asarray(given.get(name, np.nan))
        kinds = "fiu" if row.dtype.kind == "f" else "iu"
        if value.size and value.dtype.kind not in kinds:
            kind = "numbers" if row.dtype.kind == "f" else "whole numbers"
            raise InputError(f"scan: found {shown(given[name])} for {name}, expected {kind}")
        row[...] = value
    return Scan(time=time, landmark=whole[0], caller=whole[1], numbers=numbers)


def _shape(name: str, values: np.ndarray | float) -> tuple[int, ...]:
    """Return the shape of a scan's column; raise if its rows have different lengths."""
    try:
        return np.shape(values)
    except ValueError:
        raise InputError(
            f"scan: found rows of unlike lengths for {name}, expected one number for each row"
        ) from None


def rows_of(scan: Scan, rows: Bool[np.ndarray, " m"] | Int[np.ndarray, " k"]) -> Scan:
    """Select rows of a scan by a mask or by indices.

    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]))
    >>> rows_of(scan, scan.bearing > 0.5).landmark
    array([8])
    """
    return replace(
        scan,
        landmark=scan.landmark[rows],
        caller=scan.caller[rows],
        numbers=np.ascontiguousarray(scan.numbers[:, rows]),
        direct=_moved(scan.direct, scan.landmark.size, rows),
    )


def _moved(
    direct: Int[np.ndarray, " c"], size: int, rows: Bool[np.ndarray, " m"] | Int[np.ndarray, " k"]
) -> Int[np.ndarray, " c"]:
    """Renumber the rows of direct calls after a selection of a scan's rows; -1 if removed."""
    if direct.size == 0:
        return direct
    kept, place = np.arange(size)[rows], np.full(size + 1, -1)
    place[kept] = np.arange(kept.size)
    return place[direct]


def columns_of(scans: Sequence[Scan]) -> dict[str, np.ndarray]:
    """Join the columns of scans, by name, below the time of each measurement.

    >>> columns = columns_of([make_scan(t, np.array([3]), np.array([0.2])) for t in (0.5, 1.0)])
    >>> columns["time"], columns["landmark"]
    (array([0.5, 1. ]), array([3, 3]))
    """
    none, sizes = np.empty(0, np.int64), [scan.landmark.size for scan in scans]
    numbers = np.concatenate([np.empty((NUMBERS, 0)), *(scan.numbers for scan in scans)], axis=1)
    return {
        "time": np.repeat([scan.time for scan in scans], sizes),
        "landmark": np.concatenate([none, *(scan.landmark for scan in scans)]),
        "caller": np.concatenate([none, *(scan.caller for scan in scans)]),
    } | dict(zip(COLUMNS[2:], numbers, strict=True))


def without_labels(scan: Scan, callers: Int[np.ndarray, " c"]) -> Scan:
    """Remove the labels of a scan, and record the rows of the direct calls in `Scan.direct`.

    `callers`: the label of each caller's direct call, by its number, or UNLABELLED.

    >>> scan = make_scan(0.5, np.array([4, 9]), np.array([0.2, 1.0]), caller=1)
    >>> hidden = without_labels(scan, np.array([-1, 9]))
    >>> hidden.landmark, hidden.direct
    (array([-1, -1]), array([-1,  1]))
    """
    direct = np.full(callers.size, UNLABELLED)
    for number, label in enumerate(callers):
        rows = np.flatnonzero((scan.landmark == label) & (scan.caller == number))
        if label != UNLABELLED and rows.size:
            direct[number] = rows[0]
    landmark = np.full_like(scan.landmark, UNLABELLED)
    return replace(scan, landmark=landmark, callers=NO_CALLERS, direct=direct)


def with_callers(scan: Scan, callers: Int[np.ndarray, " c"]) -> Scan:
    """Set the callers' labels in a scan without labels, by caller number; UNLABELLED if unknown.

    >>> scan = make_scan(0.5, np.full(2, -1), np.zeros(2), caller=1)
    >>> heard = replace(scan, direct=np.array([-1, 0, 1]), moving_callers=np.array([1, 2]))
    >>> with_callers(heard, np.array([-1, -1, 9])).moving
    array([9])
    """
    moving = callers[scan.moving_callers]
    moving = moving[moving != UNLABELLED]
    known = {"callers": callers, "moving": moving}
    return replace(scan, **known, moving_callers=NO_CALLERS, direct=NO_CALLERS)


def without_excess_paths(scan: Scan, *numbers: int) -> Scan:
    """Remove excess paths, and rows that contain nothing else, from a scan.

    `numbers`: further columns to set to NaN.

    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = np.array([8, 8]), np.array([0.4, np.nan])
    >>> scan = make_scan(0.0, *rows, caller=np.array([1, 2]), excess_path=np.array([3.0, 5.0]))
    >>> without_excess_paths(scan).landmark, without_excess_paths(scan).excess_path
    (array([8]), array([nan]))
    """
    untimed = without(scan, EXCESS_PATH, EXCESS_PATH_STD, *numbers)
    bare = np.isnan(scan.bearing) & np.isnan(scan.range)
    kept = rows_of(untimed, ~bare) if bare.any() else untimed
    known = scan.callers.size or scan.direct.size
    return replace(kept, callers=NO_CALLERS, direct=NO_CALLERS) if known else kept


def without(scan: Scan, *numbers: int) -> Scan:
    """Set some columns of a scan to NaN.

    >>> scan = make_scan(0.5, np.array([3]), np.zeros(1), range=2.0, range_std=0.1)
    >>> without(scan, RANGE_STD).range_std
    array([nan])
    """
    left = scan.numbers.copy()
    for number in numbers:
        left[number] = math.nan
    return replace(scan, numbers=left)


LISTENS_TO = {"active": (True, False), "fused": (True, True), "passive": (False, True)}
"""Whether a strategy uses the echoes of the vehicle's own call, and of the others' calls."""


def scan_of(rows: Scan, strategy: Strategy) -> Scan:
    """Select the measurements of a frame that a sensing strategy uses.

    Active uses the echoes of the vehicle's own call, passive the calls of others and their echoes,
    fused both. Measurements of one landmark are merged.

    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = make_scan(0.5, np.array([2, 2, 5]), np.array([0.2, 0.4, 1.0]),
    ...                  caller=np.array([0, 1, 1]), range=np.array([4.0, np.nan, np.nan]))
    >>> scan_of(rows, "fused").bearing.round(9).tolist()
    [0.3, 1.0]
    >>> scan_of(rows, "active").landmark.tolist()
    [2]
    """
    own, others = LISTENS_TO[strategy]
    if rows.direct.size:  # unlabelled rows are not merged
        return rows_of(rows, np.where(rows.caller == OWN, own, others))
    return _fused(rows, rows.landmark, own=own, others=others, labels_only=False)


def labelled(scan: Scan, label: Int[np.ndarray, " m"]) -> Scan:
    r"""Label a scan's rows, and merge them by landmark; rows without a label are dropped.

    The bearing is the mean, weighted by the inverse variances if all are stated,

    .. math:: \bar\phi = \sum_i \phi_i \sigma_i^{-2} \Big/ \sum_i \sigma_i^{-2}, \qquad
              \bar\sigma^{-2} = \sum_i \sigma_i^{-2} ,

    else the plain mean without a standard deviation. Range and excess path are the first of a
    landmark's rows; further excess paths, and range-only rows, become rows without a bearing, at
    the end. The label of a caller's direct call (`Scan.direct`) becomes the caller's. A scan that
    is already labelled and merged is returned unchanged.

    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.5, np.full(3, UNLABELLED), np.array([0.2, 0.4, 1.0]), bearing_std=0.1)
    >>> merged = labelled(scan, np.array([7, 7, UNLABELLED]))
    >>> merged.landmark, merged.bearing.round(9), merged.bearing_std.round(4)
    (array([7]), array([0.3]), array([0.0707]))
    """
    if label is scan.landmark and is_merged(label, scan.bearing):
        return scan
    label = _checked(scan, np.asarray(label))
    if scan.direct.size:
        scan = with_callers(scan, np.append(label, UNLABELLED)[scan.direct])  # -1: not detected
    return _fused(scan, label, own=True, others=True, labels_only=True)


def _fused(
    scan: Scan, label: Int[np.ndarray, " m"], *, own: bool, others: bool, labels_only: bool
) -> Scan:
    """Select the measurements of some callers in a scan, and merge rows with equal labels."""
    numbers = np.ascontiguousarray(scan.numbers)
    landmark, caller, numbers = _fuse(label, scan.caller, numbers, own, others, labels_only)
    return replace(scan, landmark=landmark, caller=caller, numbers=numbers)


def _checked(scan: Scan, label: np.ndarray) -> Int[np.ndarray, " m"]:
    """Return the labels of a scan's rows as integers; raise if they are invalid."""
    whole = label.dtype.kind in "iu" or not label.size
    if label.shape != scan.landmark.shape or not whole or label.min(initial=0) < UNLABELLED:
        raise InputError(
            f"association at {scan.time} s: found labels {shown(label.tolist())}, expected "
            f"{scan.landmark.size} whole numbers, one for each row: from 0 on, or {UNLABELLED} "
            "for clutter"
        )
    return label.astype(np.int64, copy=False)


@kernel
def is_merged(label: Int[np.ndarray, " m"], bearing: Float[np.ndarray, " m"]) -> bool:
    """Return whether all rows are labelled and merged, with rows without a bearing at the end."""
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
    """Return label, caller and numbers of some callers' measurements, merged by landmark.

    Rows without a label are kept unmerged, or left out. Further excess paths of a landmark and rows
    without a bearing become rows at the end.
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
        for number in (RANGE, RANGE_STD):
            numbers[number, count] = given[number, m] if math.isnan(bearing[m]) else np.nan
        count += 1
    return landmark[:count], caller[:count], numbers[:, :count].copy()


@kernel
def _average(
    numbers: Float[np.ndarray, "8 k"], merged: Int[np.ndarray, " m"], sums: Float[np.ndarray, "5 m"]
) -> None:
    """Average the bearings that were merged into each row; `sums` are relative to the first."""
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
