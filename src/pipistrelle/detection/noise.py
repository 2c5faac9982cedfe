"""Measurement noise: how surely the rows of a scan were measured. Nowhere else is R stated.

It is stated of the rows that a filter is handed, after those of one landmark were merged.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.config import FilterConfig
from pipistrelle.detection.faces import Heard
from pipistrelle.detection.scans import (
    BEARING_STD,
    DETOUR_STD,
    OWN,
    RANGE_STD,
    Scan,
    with_columns,
)
from pipistrelle.jit import kernel

Noise = Callable[[Scan], Scan]
"""Gives rows the standard deviations that they do not have."""

BEARING_FLOOR = (0.002, 0.009)
"""Error [rad] of a bearing that no level removes, by the vehicle's own call and by another's: what
echoes that overlap do to each other and leave no trace beside the beam. With these the errors in
the paper's worlds have the variances that are told; another's echoes come at all times, and overlap
more."""
RANGE_FLOOR = 0.01
"""Error [m] of a range that no level removes, likewise."""
DETOUR_FLOOR = 0.006
"""Error [m] of a detour that no level removes, likewise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantNoise:
    """The same standard deviations for all rows (Bradley & Abaid, Table I).

    Attributes
    ----------
    range_std, bearing_std, detour_std : [m], [rad], [m]

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.5, np.array([3, 8]), np.zeros(2), bearing_std=np.array([0.02, np.nan]))
    >>> ConstantNoise(range_std=0.2, bearing_std=0.15, detour_std=0.4)(scan).bearing_std
    array([0.02, 0.15])
    """

    range_std: float
    bearing_std: float
    detour_std: float

    def __call__(self, scan: Scan) -> Scan:
        """Give rows the standard deviations that they do not have."""
        stds = self.bearing_std, self.range_std, self.detour_std
        numbers = _filled(np.ascontiguousarray(scan.numbers), *stds)
        return replace(scan, numbers=numbers)


@kernel
def _filled(
    numbers: Float[np.ndarray, "7 m"], bearing_std: float, range_std: float, detour_std: float
) -> Float[np.ndarray, "7 m"]:
    """Copy numbers, with constants where they say nothing of how surely a row was measured."""
    filled = numbers.copy()
    for m in range(filled.shape[1]):
        if math.isnan(filled[BEARING_STD, m]):
            filled[BEARING_STD, m] = bearing_std
        if math.isnan(filled[RANGE_STD, m]):
            filled[RANGE_STD, m] = range_std
        if math.isnan(filled[DETOUR_STD, m]):
            filled[DETOUR_STD, m] = detour_std
    return filled


def measured(heard: Heard) -> Heard:
    r"""Give the rows of a frame the standard deviations that the signal tells, before they merge.

    .. math:: \sigma^2 = \sigma_{signal}^2 + \sigma_{floor}^2

    Parameters
    ----------
    heard : Heard

    Returns
    -------
    Heard
        The same where the signal tells nothing.

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> rows = make_scan(0.5, np.array([3]), np.zeros(1), range=np.array([2.0]))
    >>> heard = Heard(rows=rows, clutter=0, certainty=np.array([[0.003], [0.0]]))
    >>> measured(heard).rows.bearing_std, measured(heard).rows.range_std
    (array([0.00360555]), array([0.01]))
    """
    if heard.certainty is None:
        return heard
    rows, (across, along) = heard.rows, heard.certainty
    numbers = rows.numbers.copy()
    numbers[BEARING_STD] = np.hypot(across, np.where(rows.caller == OWN, *BEARING_FLOOR))
    numbers[RANGE_STD] = np.hypot(along, RANGE_FLOOR)
    if heard.detour is not None:
        numbers[DETOUR_STD] = np.hypot(heard.detour[1], DETOUR_FLOOR)
    return replace(heard, rows=replace(rows, numbers=numbers))


def unstated(scan: Scan) -> Scan:
    """Forget how surely the rows of a scan say that they were measured.

    Parameters
    ----------
    scan : Scan

    Returns
    -------
    Scan

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> unstated(make_scan(0.5, np.array([3]), np.zeros(1), bearing_std=0.1)).bearing_std
    array([nan])
    """
    return with_columns(scan, bearing_std=math.nan, range_std=math.nan, detour_std=math.nan)


def as_said(scan: Scan) -> Scan:
    """Leave it to the rows themselves.

    Parameters
    ----------
    scan : Scan

    Returns
    -------
    Scan
        The same.
    """
    return scan


def noise_of(settings: FilterConfig) -> Noise:
    """Return the noise that the settings state.

    Parameters
    ----------
    settings : FilterConfig

    Returns
    -------
    Noise
    """
    return ConstantNoise(
        range_std=settings.range_std,
        bearing_std=settings.bearing_std,
        detour_std=settings.detour_std,
    )
