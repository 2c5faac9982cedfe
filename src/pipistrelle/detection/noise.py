"""Measurement noise: the standard deviations of a scan's rows, as an estimator is given them.

It is stated of the rows that a filter is handed, after those of one landmark were merged.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.config import FilterConfig
from pipistrelle.detection.scans import (
    BEARING_STD,
    EXCESS_PATH_STD,
    RANGE_STD,
    SLOPE,
    Scan,
    without,
    without_excess_paths,
)
from pipistrelle.jit import kernel

STDS = BEARING_STD, RANGE_STD, EXCESS_PATH_STD
"""Where the standard deviations stand among the numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantNoise:
    """The same standard deviations for all rows (Bradley & Abaid, Table I).

    Examples
    --------
    >>> from pipistrelle.detection.scans import make_scan
    >>> scan = make_scan(0.5, np.array([3, 8]), np.zeros(2), bearing_std=np.array([0.02, np.nan]))
    >>> ConstantNoise(range_std=0.2, bearing_std=0.15, excess_path_std=0.4)(scan).bearing_std
    array([0.02, 0.15])
    """

    range_std: float
    bearing_std: float
    excess_path_std: float
    """`range_std`, `bearing_std` and `excess_path_std` [m], [rad], [m]."""
    instead: bool = False
    """Whether an estimator is given them in place of what the signal says, too."""

    def __call__(self, scan: Scan) -> Scan:
        """Give rows the standard deviations that they do not have."""
        stds = self.bearing_std, self.range_std, self.excess_path_std
        numbers = _filled(np.ascontiguousarray(scan.numbers), *stds)
        return replace(scan, numbers=numbers)

    def hidden(self, heard: Scan, stated: Scan) -> Scan:
        """Return a scan as an association stated it, without what the signal said of its noise."""
        if not self.instead:
            return stated
        same = (heard.numbers == stated.numbers) | np.isnan(stated.numbers)
        bare = unstated(stated)
        return replace(bare, numbers=np.where(same, bare.numbers, stated.numbers))


@kernel
def _filled(
    numbers: Float[np.ndarray, "8 m"], bearing_std: float, range_std: float, excess_path_std: float
) -> Float[np.ndarray, "8 m"]:
    """Copy numbers, with constants in place of missing standard deviations."""
    filled = numbers.copy()
    for m in range(filled.shape[1]):
        if math.isnan(filled[BEARING_STD, m]):
            filled[BEARING_STD, m] = bearing_std
        if math.isnan(filled[RANGE_STD, m]):
            filled[RANGE_STD, m] = range_std
        if math.isnan(filled[EXCESS_PATH_STD, m]):
            filled[EXCESS_PATH_STD, m] = excess_path_std
    return filled


def unstated(scan: Scan) -> Scan:
    """Return a scan without its standard deviations.

    >>> from pipistrelle.detection.scans import make_scan
    >>> unstated(make_scan(0.5, np.array([3]), np.zeros(1), bearing_std=0.1)).bearing_std
    array([nan])
    """
    return without(scan, *STDS)


def without_hidden(scan: Scan, settings: FilterConfig, *, timing: bool, known: bool = True) -> Scan:
    """Return a scan without the columns that the settings hide from an estimator.

    Parameters
    ----------
    scan : Scan
    settings : FilterConfig
        With "constant" noise standard deviations are hidden, and the slopes of bearings unless the
        speed of sound is to be calibrated.
    timing : bool
        False: excess paths are hidden.
    known : bool
        Whether labels are; else an association sees all standard deviations, and hides them from
        the estimator (`ConstantNoise.hidden`).

    Returns
    -------
    Scan
    """
    hidden = () if "speed_of_sound" in settings.calibrate else (SLOPE,)
    hidden += STDS if known and settings.noise == "constant" else ()
    return without(scan, *hidden) if timing else without_excess_paths(scan, *hidden)


def noise_of(settings: FilterConfig) -> ConstantNoise:
    """Return the noise model that the settings name.

    Parameters
    ----------
    settings : FilterConfig

    Returns
    -------
    ConstantNoise
    """
    return ConstantNoise(
        range_std=settings.range_std,
        bearing_std=settings.bearing_std,
        excess_path_std=settings.excess_path_std,
        instead=settings.noise == "constant",
    )
