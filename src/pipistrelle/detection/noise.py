"""Measurement noise: how surely the rows of a scan were measured. Nowhere else is R stated."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipistrelle.config import FilterConfig
from pipistrelle.detection.scans import Scan

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
        bearing_std, range_std = scan.bearing_std, scan.range_std
        return replace(
            scan,
            bearing_std=np.where(np.isnan(bearing_std), self.bearing_std, bearing_std),
            range_std=np.where(np.isnan(range_std), self.range_std, range_std),
        )


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
