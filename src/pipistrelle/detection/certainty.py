r"""Certainty: how sure a detection is of its bearing and delay, as the signal itself tells.

**Noise** is what a snapshot holds beside the wave that the beam is steered to: the receiver's own,
of unit variance, or, where more is left than that explains in all but a thousandth of snapshots,
what is left, :math:`\eta = (E - P) / (N - 1)`. Echoes that overlap are each other's noise: most
errors above 20 dB are of that kind. With the power p of the steered beam in units of that noise,

.. math:: \sigma_\theta = \sqrt{\frac{6}{p\,(N^2 - 1)} \left(1 + \frac{1}{p}\right)}
              \Big/ \left( \frac{2\pi d}{\lambda} \cos\theta \right), \qquad
          p = P / \eta - 1 ,

the variance that the largest beam of a line array has (its first term is the Cramer-Rao bound,
`pipistrelle.arrays.beamforming.bearing_bound`). The call of M lags has two edges, of which a lag
holds parts: the first term of

.. math:: \sigma_\tau^2 = \frac{M}{4 p} + \frac{26}{16} \left(\frac{M}{p}\right)^2

in lags. The second is what the jumps at the edges make: the loudest point of a random walk that
falls off to both sides, whose variance is 26 in its own units.

Sources: Rife & Boorstyn, IEEE Transactions on Information Theory 20 (1974), for the first;
Ibragimov & Has'minskii, Statistical Estimation (1981), Sec. VII.2, for the 26.
"""

import math

from pipistrelle.jit import Whole, kernel

NOISE_QUANTILE = 0.999
"""Share of snapshots whose noise is no louder than what is taken for noise alone."""
MIN_POWER_OVER_NOISE = 0.1
"""Least power over the noise for which a deviation is stated."""
BEARING_FLOOR = (0.002, 0.009)
"""Error [rad] of a bearing that no level removes, by the vehicle's own call and by another's: what
echoes that overlap do to each other and leave no trace beside the beam. With these the errors in
the paper's worlds have the variances that are stated; another's echoes come at all times, and
overlap more."""
RANGE_FLOOR = 0.01
"""Error [m] of a range that no level removes, likewise."""
EXCESS_PATH_FLOOR = 0.006
"""Error [m] of an excess path that no level removes, likewise."""
DIRECT_FLOOR = 0.04
"""Error [rad] of the bearing of a caller's direct call: while it lasts, echoes begin of what stands
near the line from the caller."""

EDGE_FLOOR = 0.015
"""Error [m] of where a caller's direct call begins that no level removes: what stands near the line
adds to its first edge. It counts where overlaps are resolved, whose rows are sure enough to show
it; it is the same for all rows of a frame."""


def loudest_noise(elements: int) -> float:
    """Return the 0.999 quantile of the residual power of a steered beam in noise.

    In units of the noise's variance.

    >>> round(loudest_noise(10), 2)
    2.35
    """
    from scipy.special import gammaincinv

    return float(gammaincinv(elements - 1, NOISE_QUANTILE)) / (elements - 1)


@kernel
def over_noise(power: float, energy: float, elements: Whole, loudest: float) -> float:
    """Return the ratio p of the power of a steered beam to the noise, from the snapshot's energy.

    >>> over_noise(101.0, 110.0, 10, 2.35), round(over_noise(101.0, 191.0, 10, 2.35), 2)
    (100.0, 9.1)
    """
    noise = (energy - power) / (elements - 1)
    return max(power / (noise if noise > loudest else 1.0) - 1.0, MIN_POWER_OVER_NOISE)


@kernel
def bearing_std(power: float, slope: float, spread: float) -> float:
    """Return the standard deviation of a bearing [rad].

    `slope`: phase between neighbours per radian; `spread`: twelve times the mean square of the
    elements' places, in spacings, about their mean: N^2 - 1 of equally spaced ones.

    >>> round(bearing_std(100.0, math.pi, 99.0), 4)
    0.0079
    """
    return math.sqrt(6.0 * (1.0 + 1.0 / power) / (power * spread)) / slope


@kernel
def delay_std(power: float, pulse: Whole) -> float:
    """Return the standard deviation of a delay, in lags; the call has so many.

    >>> round(delay_std(100.0, 14), 3)
    0.259
    """
    lags = pulse / power
    return math.sqrt(0.25 * lags + 1.625 * lags * lags)
