"""Measurement noise: how surely the rows of a scan were measured. Nowhere else is R stated.

It is stated of the rows that a filter is handed, after those of one landmark were merged.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.config import FilterConfig
from pipistrelle.detection.scans import Scan
from pipistrelle.jit import kernel

Noise = Callable[[Scan], Scan]
"""Gives rows the standard deviations that they do not have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantNoise:
    """The same standard deviations for all rows (Bradley & Abaid, Table I).

    Attributes
    ----------
    range_std, bearing_std : [m], [rad]

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.5, np.array([3, 8]), np.zeros(2), bearing_std=np.array([0.02, np.nan]))
    >>> ConstantNoise(range_std=0.2, bearing_std=0.15)(scan).bearing_std
    array([0.02, 0.15])
    """

    range_std: float
    bearing_std: float

    def __call__(self, scan: Scan) -> Scan:
        """Give rows the standard deviations that they do not have."""
        return Scan(  # by all its fields: `replace` would take twice as long
            time=scan.time,
            landmark=scan.landmark,
            caller=scan.caller,
            bearing=scan.bearing,
            range=scan.range,
            detour=scan.detour,
            bearing_std=_filled(scan.bearing_std, self.bearing_std),
            range_std=_filled(scan.range_std, self.range_std),
            detour_std=scan.detour_std,
            level_db=scan.level_db,
        )


@kernel
def _filled(std: Float[np.ndarray, " m"], constant: float) -> Float[np.ndarray, " m"]:
    """Copy a column with a constant where it says nothing."""
    filled = np.empty(std.size)
    for m in range(std.size):
        filled[m] = constant if math.isnan(std[m]) else std[m]
    return filled


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
    return ConstantNoise(range_std=settings.range_std, bearing_std=settings.bearing_std)
