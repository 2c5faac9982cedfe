r"""Measurement noise: standard deviations from the signal, thresholds of snapshots, constant noise.

**Noise** is the part of a snapshot that the steered beam's wave does not explain: the receiver's,
of unit variance, or, if the residual is larger than that explains in all but a thousandth of
snapshots, the residual, :math:`\eta = (E - P) / (N - 1)`. Overlapping echoes are noise to each
other: they cause most errors above 20 dB. With the power p of the steered beam in units of it,

.. math:: \sigma_\theta = \sqrt{\frac{6}{p\,(N^2 - 1)} \left(1 + \frac{1}{p}\right)}
              \Big/ \left( \frac{2\pi d}{\lambda} \cos\theta \right), \qquad
          p = P / \eta - 1 ,

the variance of the largest beam of a line array (its first term is the Cramer-Rao bound,
`pipistrelle.arrays.beamforming.bearing_bound`). The call of M lags has two edges, each within a
lag, with the first term of

.. math:: \sigma_\tau^2 = \frac{M}{4 p} + \frac{26}{16} \left(\frac{M}{p}\right)^2

in lags. The second is caused by the jumps at the edges: the loudest point of a random walk with
drift to both sides has a variance of 26 in its units.

Sources: Rife & Boorstyn, IEEE Transactions on Information Theory 20 (1974), for the first;
Ibragimov & Has'minskii, Statistical Estimation (1981), Sec. VII.2, for the 26.

An estimator receives standard deviations after measurements of one landmark have been merged.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import FilterConfig
from pipistrelle.detection.scans import KINDS, SLOPE, STD_OF, Scan, without, without_excess_paths
from pipistrelle.jit import Whole, kernel, no_alloc

NOISE_QUANTILE = 0.999
"""Share of snapshots with receiver noise only whose residual is below the threshold."""
MIN_POWER_OVER_NOISE = 0.1
"""Least power over the noise for which a standard deviation is stated."""
BEARING_FLOOR = (0.002, 0.009)
"""Irreducible bearing error [rad], by the vehicle's own call and by another's: overlapping echoes
without a trace in the residual. With these floors, the errors in the paper's worlds have the
stated variances; another's echoes come at all times, and overlap more."""
RANGE_FLOOR = 0.01
"""Irreducible range error [m], from the same cause."""
EXCESS_PATH_FLOOR = 0.006
"""Irreducible excess-path error [m], from the same cause."""
DIRECT_FLOOR = 0.04
"""Bearing error of a caller's direct call [rad]: echoes of landmarks near the line from the caller
begin while it lasts."""

EDGE_FLOOR = 0.015
"""Irreducible error of a direct call's beginning [m], by landmarks near the line; equal for all
rows of a frame. Used if overlaps are resolved, as other errors are then small enough for it to
matter."""


def loudest_noise(elements: int) -> float:
    """Return the residual power of a steered beam that unit noise exceeds in 1 of 1000 cases.

    >>> round(loudest_noise(10), 2)
    2.35
    """
    from scipy.special import gammaincinv

    return float(gammaincinv(elements - 1, NOISE_QUANTILE)) / (elements - 1)


@kernel
def over_noise(power: float, energy: float, elements: Whole, loudest: float) -> float:
    """Return the signal-to-noise power ratio of a steered beam, from its power and all energy.

    >>> over_noise(101.0, 110.0, 10, 2.35), round(over_noise(101.0, 191.0, 10, 2.35), 2)
    (100.0, 9.1)
    """
    noise = (energy - power) / (elements - 1)
    return max(power / (noise if noise > loudest else 1.0) - 1.0, MIN_POWER_OVER_NOISE)


@kernel
def bearing_std(power: float, slope: float, spread: float) -> float:
    """Return the standard deviation of a bearing [rad] from a beam's signal-to-noise ratio.

    `slope`: phase between neighbours per radian; `spread`: twelve times the variance of the
    elements' positions, in spacings: N^2 - 1 if equally spaced.

    >>> round(bearing_std(100.0, math.pi, 99.0), 4)
    0.0079
    """
    return math.sqrt(6.0 * (1.0 + 1.0 / power) / (power * spread)) / slope


@kernel
def delay_std(power: float, pulse: Whole) -> float:
    """Return a delay's std in lags from the signal-to-noise ratio; `pulse`: lags in a call.

    >>> round(delay_std(100.0, 14), 3)
    0.259
    """
    lags = pulse / power
    return math.sqrt(0.25 * lags + 1.625 * lags * lags)


CHUNK = 256
"""Lags in a piece that stays in the cache."""


@kernel
def energy_of(parts: Float[np.ndarray, " i"], elements: Whole) -> Float[np.ndarray, " t"]:
    """Return each output's energy, summed over elements; real and imaginary parts alternate."""
    energy = np.empty(parts.size // (2 * elements))
    square = np.empty(CHUNK * elements)  # stays in the cache
    for start in range(0, energy.size, CHUNK):
        done = energy[start : start + CHUNK]
        part = parts[2 * elements * start :]
        for i in range(done.size * elements):
            square[i] = part[2 * i] * part[2 * i] + part[2 * i + 1] * part[2 * i + 1]
        for g in range(done.size):
            total = 0.0
            for e in range(elements):
                total += square[g * elements + e]
            done[g] = total
    return energy


@kernel
def candidates(
    energy: Float[np.ndarray, " t"], threshold: float, row: Whole
) -> Int[np.ndarray, " k"]:
    """Return the indices of energies above the threshold that are local maxima in time.

    Every test is written and few are kept: a branch on each could not be predicted.
    """
    test, count, kept = np.empty(energy.size + 1, dtype=np.int64), 0, 0
    for t in range(energy.size):
        test[count] = t
        count += energy[t] > threshold
    for k in range(count):
        t = test[k]
        before = energy[t - row] if t >= row else -1.0
        after = energy[t + row] if t + row < energy.size else -1.0
        test[kept] = t
        kept += (energy[t] > before) & (energy[t] >= after)
    return test[:kept]


@no_alloc
def _is_loudest(
    energy: Float[np.ndarray, " t"], test: Whole, row: Whole, reach: Whole, floor: float
) -> bool:
    """Return whether no nearby lag has more energy, within a reach or until it falls to a floor.

    A row of tests is a lag: the neighbour in time is a row away, the other tones are adjacent.
    """
    level, size = energy[test], energy.size
    for away in range(row, (reach + 1) * row, row):
        if test < away or energy[test - away] <= floor:
            break
        if energy[test - away] >= level:
            return False
    for away in range(row, (reach + 1) * row, row):
        if test + away >= size or energy[test + away] <= floor:
            break
        if energy[test + away] > level:
            return False
    return True


@no_alloc
def is_leakage(
    energy: Float[np.ndarray, " t"],
    test: Whole,
    row: Whole,
    tones: Whole,
    pulse: Whole,
    leakage: float,
) -> bool | np.bool_:
    """Return whether the energy of a tone is explained by leakage from another tone nearby."""
    own, strongest = test % tones, 0.0
    for p in range(tones):
        if p != own:
            other = test - own + p
            for away in range(-pulse * row, (pulse + 1) * row, row):
                if 0 <= other + away < energy.size:
                    strongest = max(strongest, energy[other + away])
    return energy[test] <= leakage * strongest


@no_alloc
def _run_of(
    energy: Float[np.ndarray, " t"], test: Whole, row: Whole, floor: float
) -> tuple[Whole, Whole]:
    """Return the half-open range of consecutive lags, around a given lag, above an energy level."""
    first = last = test
    while first >= row and energy[first - row] > floor:
        first -= row
    while last + row < energy.size and energy[last + row] > floor:
        last += row
    return first // row, last // row + 1


@no_alloc
def snapshot(
    energy: Float[np.ndarray, " t"],
    test: Whole,
    row: Whole,
    tones: Whole,
    pulse: Whole,
    runs: bool,
    threshold: float,
    leakage: float,
) -> tuple[Whole, Whole]:
    """Return the half-open range of lags of a candidate's snapshot; empty if it is rejected.

    The leakage test of a run is left to its peaks, as a run may hold other echoes besides leakage.
    """
    if runs:
        if _is_loudest(energy, test, row, energy.size, threshold):
            return _run_of(energy, test, row, threshold)
    elif _is_loudest(energy, test, row, pulse // 2, -1.0) and not is_leakage(
        energy, test, row, tones, pulse, leakage
    ):
        return test // row, test // row + 1
    return 0, 0


STDS = tuple(len(KINDS) + row for row in range(len(KINDS)))
"""Rows of the standard deviations in `Scan.numbers`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstantNoise:
    """Measurement noise with the same std for all measurements (Bradley & Abaid, Table I).

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
    """Whether they replace the signal's standard deviations for an estimator."""

    def __call__(self, scan: Scan) -> Scan:
        """Fill a scan's missing standard deviations with the constants."""
        numbers = scan.numbers.copy()
        stds = numbers[STDS[0] : STDS[-1] + 1]
        np.copyto(stds, [[getattr(self, name)] for name in STD_OF.values()], where=np.isnan(stds))
        return replace(scan, numbers=numbers)

    def hidden(self, heard: Scan, stated: Scan) -> Scan:
        """Remove a scan's standard deviations that come from the signal, after data association."""
        if not self.instead:
            return stated
        same = (heard.numbers == stated.numbers) | np.isnan(stated.numbers)
        bare = unstated(stated)
        return replace(bare, numbers=np.where(same, bare.numbers, stated.numbers))


def unstated(scan: Scan) -> Scan:
    """Set a scan's standard deviations to NaN.

    >>> from pipistrelle.detection.scans import make_scan
    >>> unstated(make_scan(0.5, np.array([3]), np.zeros(1), bearing_std=0.1)).bearing_std
    array([nan])
    """
    return without(scan, *STDS)


def without_hidden(scan: Scan, settings: FilterConfig, *, timing: bool, known: bool = True) -> Scan:
    """Return a scan without the columns that the settings hide from an estimator.

    With "constant" noise and `known` labels, standard deviations are hidden; with unknown labels
    the association uses them, and hides them later (`ConstantNoise.hidden`). Slopes of bearings are
    hidden unless the speed of sound is calibrated, excess paths unless `timing`.
    """
    hidden = () if "speed_of_sound" in settings.calibrate else (SLOPE,)
    hidden += STDS if known and settings.noise == "constant" else ()
    return without(scan, *hidden) if timing else without_excess_paths(scan, *hidden)


def noise_of(settings: FilterConfig) -> ConstantNoise:
    """Return the model of constant measurement noise from the settings."""
    stds = {name: getattr(settings, name) for name in STD_OF.values()}
    return ConstantNoise(**stds, instead=settings.noise == "constant")
