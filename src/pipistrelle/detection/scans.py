"""Scans: what one frame measured, a row per measurement, as associations and filters see it."""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

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

    Examples
    --------
    >>> scan = make_scan(0.5, np.array([3, 8]), np.array([0.2, 1.0]), bearing_std=0.15)
    >>> scan.range, scan.bearing_std
    (array([nan, nan]), array([0.15, 0.15]))
    """
    rows, given = len(landmark), {"caller": OWN} | columns
    filled = {
        name: np.full(rows, given.get(name, np.nan), dtype=int if name == "caller" else float)
        for name in COLUMNS
        if name not in ("landmark", "bearing")
    }
    return Scan(time=time, landmark=landmark, bearing=bearing, **filled)


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
