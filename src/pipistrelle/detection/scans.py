"""Scans: what one frame measured, a row per measurement, as associations and filters see it.

Merging: what the callers' tones say of one landmark becomes one measurement.

A sensing strategy takes the rows of some callers, and of the rows of one landmark is made one: the
same is done when an association has said which rows are of one landmark.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError, Strategy
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel
from pipistrelle.refusals import shown

WIDEST = math.pi / 2.0 / math.sqrt(12.0)
"""Deviation of a bearing that is anywhere in a quarter turn [rad]. A less sure bearing is of no
use: the mean of the places where its landmark may be is a tenth nearer than the range."""
UNLABELLED = -1
"""Label of a measurement whose landmark is not known."""
OWN = 0
"""Number of the vehicle among the callers, as in `pipistrelle.acoustics.paths`."""
NO_CALLERS = np.empty(0, dtype=np.int64)
"""An empty array of labels: no caller's label is known, or no caller moves."""

COLUMNS = (
    "landmark",
    "caller",
    "bearing",
    "range",
    "excess_path",
    "bearing_std",
    "range_std",
    "excess_path_std",
    "level_db",
    "bearing_slope",
)
"""Names of a scan's columns."""
NUMBERS = len(COLUMNS) - 2
BEARING, RANGE, EXCESS_PATH, BEARING_STD, RANGE_STD, EXCESS_PATH_STD, LEVEL, SLOPE = range(NUMBERS)
"""Where each stands among the numbers: label and caller stand apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Measurements at one time.

    What is measured is one array, a row of it for each column, so that kernels are handed one;
    each column has a name, too. Standard deviations are stated by `pipistrelle.detection.noise`.
    """

    time: float
    """Time [s]."""
    landmark: Int[np.ndarray, " m"]
    """Recorded label; UNLABELLED where none was recorded."""
    caller: Int[np.ndarray, " m"]
    """OWN, or the number of another caller. Of several, the first with an excess path, else the
    first."""
    numbers: Float[np.ndarray, "8 m"]
    """The other columns, in the order of `COLUMNS`."""
    callers: Int[np.ndarray, " c"] = field(default_factory=lambda: NO_CALLERS)
    """Label of each caller as a landmark, by its number; UNLABELLED for the vehicle and where it is
    not known, as for numbers beyond the array."""
    moving: Int[np.ndarray, " v"] = field(default_factory=lambda: NO_CALLERS)
    """Labels of the callers that move; in a scan without labels, their numbers."""
    direct: Int[np.ndarray, " d"] = field(default_factory=lambda: NO_CALLERS)
    """Row of each caller's direct call, by the caller's number, in a scan without labels; -1 where
    none was heard. The row's label becomes that of the caller (`merging.labelled`)."""

    @property
    def bearing(self) -> Float[np.ndarray, " m"]:
        """From the heading, counter-clockwise [rad]; NaN where a row is only an excess path."""
        return self.numbers[BEARING]

    @property
    def range(self) -> Float[np.ndarray, " m"]:
        """To the landmark [m]; NaN where passive."""
        return self.numbers[RANGE]

    @property
    def excess_path(self) -> Float[np.ndarray, " m"]:
        """How much longer than the direct way that over the landmark is [m], or NaN."""
        return self.numbers[EXCESS_PATH]

    @property
    def bearing_std(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the bearing [rad]; NaN where it is not stated."""
        return self.numbers[BEARING_STD]

    @property
    def range_std(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the range [m]; NaN where it is not stated."""
        return self.numbers[RANGE_STD]

    @property
    def excess_path_std(self) -> Float[np.ndarray, " m"]:
        """Standard deviation of the excess path [m]; NaN where it is not stated."""
        return self.numbers[EXCESS_PATH_STD]

    @property
    def level_db(self) -> Float[np.ndarray, " m"]:
        """Of the strongest detection behind a row, over a steered beam's noise [dB], or NaN."""
        return self.numbers[LEVEL]

    @property
    def bearing_slope(self) -> Float[np.ndarray, " m"]:
        """Derivative of the bearing by the logarithm of the speed of sound [rad], or NaN."""
        return self.numbers[SLOPE]


def make_scan(
    time: float,
    landmark: Int[np.ndarray, " m"],
    bearing: Float[np.ndarray, " m"],
    **columns: np.ndarray | float,
) -> Scan:
    """Make a scan of some of its columns.

    Parameters
    ----------
    time : [s]
    landmark : (m)
    bearing : (m) [rad]
    columns : (m), or one number for all rows
        Any of the others. What is not given, says nothing: NaN, and the vehicle's own call.

    Returns
    -------
    Scan

    Raises
    ------
    InputError
        For a column that no scan has, or columns of several lengths, or of no numbers.

    Examples
    --------
    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]), bearing_std=0.15)
    >>> scan.range, scan.bearing_std
    (array([nan, nan]), array([0.15, 0.15]))
    """
    given = {"landmark": landmark, "bearing": bearing} | columns
    return _made_of(time, _shape("landmark", landmark), given)


def with_columns(scan: Scan, **columns: np.ndarray | float) -> Scan:
    """Return a scan with some of its columns replaced.

    Parameters
    ----------
    scan : Scan
    columns : (m), or one number for all rows

    Returns
    -------
    Scan

    Raises
    ------
    InputError
        As `make_scan`.

    Examples
    --------
    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]))
    >>> with_columns(scan, range=2.0, bearing=-scan.bearing).bearing
    array([-0.2, -1. ])
    """
    own = {name: getattr(scan, name) for name in COLUMNS}
    made = _made_of(scan.time, scan.landmark.shape, own | columns)
    return replace(made, callers=scan.callers, moving=scan.moving, direct=scan.direct)


def _made_of(time: float, shape: tuple[int, ...], given: dict[str, np.ndarray | float]) -> Scan:
    """Make a scan of columns; a column that is not given has its default."""
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
    """Return the shape of a column; refuse rows of unlike lengths."""
    try:
        return np.shape(values)
    except ValueError:
        raise InputError(
            f"scan: found rows of unlike lengths for {name}, expected one number for each row"
        ) from None


def rows_of(scan: Scan, rows: Bool[np.ndarray, " m"] | Int[np.ndarray, " k"]) -> Scan:
    """Take some rows of a scan.

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
    """Return where the direct calls are after some of `size` rows were taken; -1: left out."""
    if direct.size == 0:
        return direct
    kept, place = np.arange(size)[rows], np.full(size + 1, -1)
    place[kept] = np.arange(kept.size)
    return place[direct]


def without_labels(scan: Scan, callers: Int[np.ndarray, " c"]) -> Scan:
    """Return a scan without labels that knows which rows are direct calls (`Scan.direct`).

    `callers`: the label that the direct call of each caller has, by its number; UNLABELLED of none.

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
    """Return a scan without labels in which each caller has one, or UNLABELLED, by its number.

    >>> scan = make_scan(0.5, np.full(2, -1), np.zeros(2), caller=1)
    >>> heard = replace(scan, direct=np.array([-1, 0, 1]), moving=np.array([1, 2]))
    >>> with_callers(heard, np.array([-1, -1, 9])).moving
    array([9])
    """
    moving = callers[scan.moving]
    moving = moving[moving != UNLABELLED]
    return replace(scan, callers=callers, moving=moving, direct=NO_CALLERS)


def without_excess_paths(scan: Scan, *numbers: int) -> Scan:
    """Return a scan without excess paths and without rows that hold nothing else.

    `numbers`: what becomes unknown besides.

    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = np.array([8, 8]), np.array([0.4, np.nan])
    >>> scan = make_scan(0.0, *rows, caller=np.array([1, 2]), excess_path=np.array([3.0, 5.0]))
    >>> without_excess_paths(scan).landmark, without_excess_paths(scan).excess_path
    (array([8]), array([nan]))
    """
    untimed, bare = without(scan, EXCESS_PATH, EXCESS_PATH_STD, *numbers), np.isnan(scan.bearing)
    kept = rows_of(untimed, ~bare) if bare.any() else untimed
    known = scan.callers.size or scan.direct.size
    return replace(kept, callers=NO_CALLERS, direct=NO_CALLERS) if known else kept


def without(scan: Scan, *numbers: int) -> Scan:
    """Return a scan with some of its numbers unknown.

    >>> scan = make_scan(0.5, np.array([3]), np.zeros(1), range=2.0, range_std=0.1)
    >>> without(scan, RANGE_STD).range_std
    array([nan])
    """
    left = scan.numbers.copy()
    for number in numbers:
        left[number] = math.nan
    return replace(scan, numbers=left)


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
