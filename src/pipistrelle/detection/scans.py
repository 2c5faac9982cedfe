"""Scans: what one frame measured, a row per measurement, as associations and filters see it."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError

UNLABELLED = -1
"""Label of a measurement of which nobody says whose it is."""
OWN = 0
"""Number of the vehicle among the callers, as in `pipistrelle.acoustics.callers`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """Measurements at one time.

    Attributes
    ----------
    time : [s]
    landmark : (m)
        Label, as whoever recorded it says; UNLABELLED where nobody does.
    caller : (m)
        Whose call it is: OWN, or the number of another. Of several calls, the first of theirs.
    bearing : (m) [rad]
        Relative to the heading, counter-clockwise, in [-pi, pi).
    range : (m) [m]
        NaN where passive.
    detour : (m) [m]
        How much longer the way from the caller over the landmark is than the direct one; NaN where
        that was not measured.
    bearing_std, range_std, detour_std : (m) [rad], [m], [m]
        NaN where nobody says yet how surely it was measured (`pipistrelle.detection.noise`).
    level_db : (m) [dB]
        Of the strongest detection behind a row, over the noise of the steered beam; NaN where it is
        not known.
    """

    time: float
    landmark: Int[np.ndarray, " m"]
    caller: Int[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]
    range: Float[np.ndarray, " m"]
    detour: Float[np.ndarray, " m"]
    bearing_std: Float[np.ndarray, " m"]
    range_std: Float[np.ndarray, " m"]
    detour_std: Float[np.ndarray, " m"]
    level_db: Float[np.ndarray, " m"]


COLUMNS = tuple(field.name for field in fields(Scan) if field.name != "time")
"""Names of a scan's arrays."""
NUMBERS = len(COLUMNS) - 2
BEARING, RANGE, DETOUR, BEARING_STD, RANGE_STD, DETOUR_STD, LEVEL = range(NUMBERS)
"""Where the kernels have each, in the order of the fields: label and caller stand apart."""


def scan_from(
    time: float,
    landmark: Int[np.ndarray, " m"],
    caller: Int[np.ndarray, " m"],
    numbers: Float[np.ndarray, "7 m"],
) -> Scan:
    """Make a scan of what a kernel returns: labels, callers and the numbers, a row of each.

    Parameters
    ----------
    time : [s]
    landmark, caller : (m)
    numbers : (7, m)
        The other columns, in their order.

    Returns
    -------
    Scan

    Examples
    --------
    >>> scan_from(0.5, np.array([3]), np.array([0]), np.arange(7.0)[:, np.newaxis]).range
    array([1.])
    """
    bearing, distance, detour, bearing_std, range_std, detour_std, level_db = numbers
    return Scan(
        time=time,
        landmark=landmark,
        caller=caller,
        bearing=bearing,
        range=distance,
        detour=detour,
        bearing_std=bearing_std,
        range_std=range_std,
        detour_std=detour_std,
        level_db=level_db,
    )


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
        For a column that no scan has, or columns of several lengths.

    Examples
    --------
    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]), bearing_std=0.15)
    >>> scan.range, scan.bearing_std
    (array([nan, nan]), array([0.15, 0.15]))
    """
    given = {"landmark": landmark, "bearing": bearing, "caller": OWN} | columns
    if unknown := sorted(given.keys() - set(COLUMNS)):
        raise InputError(f"scan: no such column {unknown[0]}; expected one of {', '.join(COLUMNS)}")
    shape = np.shape(landmark)
    if lengths := {n: np.shape(v) for n, v in given.items() if np.shape(v) not in ((), shape)}:
        raise InputError(
            f"scan: found columns of the shapes {lengths}, expected {shape}, that of landmark"
        )
    filled = {
        name: np.array(
            np.broadcast_to(given.get(name, np.nan), shape),
            dtype=np.int64 if name in ("landmark", "caller") else np.float64,
        )
        for name in COLUMNS
    }
    return Scan(time=time, **filled)


def rows_of(scan: Scan, rows: Bool[np.ndarray, " m"] | Int[np.ndarray, " k"]) -> Scan:
    """Take some rows of a scan.

    Parameters
    ----------
    scan : Scan
    rows : (m) bool, or (k) indices

    Returns
    -------
    Scan

    Examples
    --------
    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]))
    >>> rows_of(scan, scan.bearing > 0.5).landmark
    array([8])
    """
    return Scan(time=scan.time, **{name: getattr(scan, name)[rows] for name in COLUMNS})
