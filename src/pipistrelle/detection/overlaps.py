r"""Overlapping echoes: resolved by maximum likelihood from the phases across a face.

Echoes that overlap in time are summed at each of a face's N elements. A snapshot of the matched
filter's outputs with K echoes is

.. math:: x = A(u)\, s + n, \qquad A(u) = [a(u_1) \dots a(u_K)], \qquad a_e(u) = e^{i e u}, \qquad
          u = \frac{2\pi f d}{c} \sin\theta ,

with arbitrary amplitudes s, and noise n of unit variance. A scanned beam has lobes some
:math:`2\pi / N` wide in u: two closer echoes show a single peak between them, and others are
displaced by each other's lobes.

**Directions.** The most likely minimise the residual,

.. math:: \hat u = \arg\min_u \lVert P^\perp_A x \rVert^2, \qquad
          P^\perp_A = I - A (A^H A)^{-1} A^H ,

deterministic maximum likelihood. Echoes of one call are coherent, which does not matter here, but
is why methods that need the rank of a covariance (MUSIC, ESPRIT) fail in one snapshot. The minimum
is found by *alternating projection*: each source in turn is put where it explains most, given the
others,

.. math:: \hat u_k = \arg\max_u \frac{|a(u)^H P^\perp_{A_k} x|^2}{\lVert P^\perp_{A_k} a(u)\rVert^2}

over a grid, :math:`A_k` being the others' waves; then all are moved by Gauss-Newton steps
:math:`J^{-1} g`, with :math:`D = [a'(u_1) s_1 \dots a'(u_K) s_K]` and

.. math:: J = \operatorname{Re}(D^H P^\perp_A D), \qquad g = \operatorname{Re}(D^H P^\perp_A x) .

**Standard deviations.** Twice J is Fisher's information of the directions, with amplitudes unknown,
so the Cramér-Rao bound is :math:`\operatorname{cov}(\hat u) \ge \tfrac12 J^{-1}`. For one source it
is that of `noise`; near another it grows as their distance falls.

**Number of sources.** With the right number, the residual is noise less the fitted parameters, two
for each amplitude and one for each direction: :math:`2 \lVert P^\perp_A x \rVert^2` is
:math:`\chi^2` distributed with :math:`2N - 3K` degrees of freedom. Sources are added until the
residual is no larger than noise leaves in all but a thousandth of snapshots
(`noise.NOISE_QUANTILE`), or there are `MOST`, or the bound of one exceeds `UNSURE`. So one in a
thousand single echoes is split, and fewer faint ones. Any excess residual counts as noise.

**Amplitude and time.** An echo's amplitude is the output of a beam to it with nulls at the others,
:math:`w = P^\perp_{A_k} a(u_k)`, :math:`s_k = w^H x / \lVert w \rVert^2`. In that beam the others
are silent at every lag, so the echo's time of arrival is found there (`matched.arrival_lag`),
within half a call. An echo found in two snapshots is kept once, with the smaller standard deviation
(`surest`).

Sources: Ziskind & Wax, IEEE Transactions on Acoustics, Speech and Signal Processing 36 (1988), for
alternating projection; Golub & Pereyra, SIAM Journal on Numerical Analysis 10 (1973), and Viberg,
Ottersten & Kailath, IEEE Transactions on Signal Processing 39 (1991), for the steps; Stoica &
Nehorai, IEEE Transactions on Acoustics, Speech and Signal Processing 37 (1989), for the bound;
Ottersten, Viberg, Stoica & Nehorai in Haykin et al. (eds.), Radar Array Processing (1993), for the
whole and the test; Van Trees, Optimum Array Processing (2002), Secs. 8.4 and 8.5.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.detection.matched import steering_phases
from pipistrelle.detection.noise import MIN_POWER_OVER_NOISE, NOISE_QUANTILE
from pipistrelle.jit import Whole, kernel, no_alloc

MOST = 3
"""Most sources in a snapshot: for four, ten elements have too little information."""
NEAREST = 0.01
"""Least share of a wave outside the others' space for a direction of the grid to be tried."""
ROUNDS = 3
"""Rounds of alternating projection."""
STEPS = 8
"""Gauss-Newton steps."""
LONGEST_STEP = 0.2
"""Longest step in u [rad]: a third of a lobe."""
SHORTEST_SHARE = 1e-3
"""Smallest fraction of a step that is tried."""
SETTLED = 1e-3
"""Least decrease of the residual for a further step, in units of the noise."""
UNSURE = 0.2
"""Largest standard deviation of u for sources to count as resolved [rad]."""
SAME_TIME = 0.25
"""Largest difference of one echo's times of arrival in two snapshots, in calls."""
SAME_SINE = 0.1
"""Largest difference of the sines of one echo's angle in two snapshots."""


def most_left(elements: int) -> Float[np.ndarray, " k"]:
    """Return the residual energy after 1, 2, ... fitted sources that 0.1 % of noise exceeds.

    In units of an output's noise; fewer than `MOST` entries if the elements are too few.

    >>> most_left(10).round(1)
    array([20.4, 18.1, 15.6])
    """
    from scipy.special import gammaincinv

    count = np.arange(1, min(MOST, (2 * elements - 1) // 3) + 1)
    return gammaincinv(elements - 1.5 * count, NOISE_QUANTILE)


class Sources(NamedTuple):
    """Directions and beams of the sources in a snapshot, in work arrays that are reused."""

    u: Float[np.ndarray, " k"]
    """Phase between neighbours of each [rad]."""
    inverse: Float[np.ndarray, "k k"]
    """Inverse of J: half of it is the Cramér-Rao bound of u, at unit noise."""
    beam: Complex[np.ndarray, "k e"]
    """Beam to each with nulls at the others, as for `matched.steer`: conjugate of ``w / |w|``."""
    gain: Float[np.ndarray, " k"]
    """Relative power of each source in its beam, ``|w|^2 / N``."""
    basis: Complex[np.ndarray, "k e"]
    """Orthonormal basis of the waves' space."""
    slope: Complex[np.ndarray, "k e"]
    """D, outside the waves' space."""
    left: Complex[np.ndarray, " e"]
    """Residual."""
    wave: Complex[np.ndarray, " e"]
    """Wave of a direction that is tried."""
    score: Float[np.ndarray, " k"]
    """g"""
    fewer: Float[np.ndarray, " k"]
    """u before the last source was added."""
    step: Float[np.ndarray, " k"]


@kernel
def room_for(most: Whole, elements: Whole) -> Sources:
    """Allocate the work arrays for up to `most` sources in a snapshot."""
    return Sources(
        u=np.empty(most),
        inverse=np.empty((most, most)),
        beam=np.empty((most, elements), dtype=np.complex128),
        gain=np.empty(most),
        basis=np.empty((most, elements), dtype=np.complex128),
        slope=np.empty((most, elements), dtype=np.complex128),
        left=np.empty(elements, dtype=np.complex128),
        wave=np.empty(elements, dtype=np.complex128),
        score=np.empty(most),
        fewer=np.empty(most),
        step=np.empty(most),
    )


@no_alloc
def _product(a: Complex[np.ndarray, " e"], b: Complex[np.ndarray, " e"]) -> complex:
    """Return the inner product of two complex vectors, the first conjugated."""
    total = 0.0j
    for e in range(a.size):
        total += a[e].conjugate() * b[e]
    return total


@no_alloc
def _power(z: complex) -> float:
    """Return the squared modulus of a complex number."""
    return z.real * z.real + z.imag * z.imag


@no_alloc
def _leave(x: Complex[np.ndarray, " e"], basis: Complex[np.ndarray, "k e"], count: Whole) -> None:
    """Subtract from a vector its projection on the first vectors of an orthonormal basis."""
    for k in range(count):
        along = _product(basis[k], x)
        for e in range(x.size):
            x[e] -= along * basis[k, e]


@no_alloc
def _span(found: Sources, count: Whole, without: Whole, place: Float[np.ndarray, " p"]) -> Whole:
    """Write an orthonormal basis of the waves of all sources except `without`; return its size."""
    size = 0
    for k in range(count):
        if k != without:
            steering_phases(-found.u[k], place, found.basis[size])
            _leave(found.basis[size], found.basis, size)
            norm = math.sqrt(_product(found.basis[size], found.basis[size]).real)
            for e in range(found.wave.size):
                found.basis[size, e] /= norm
            size += 1
    return size


@no_alloc
def _best_beside(
    x: Complex[np.ndarray, " e"],
    found: Sources,
    size: Whole,
    scan: Float[np.ndarray, " n"],
    place: Float[np.ndarray, " p"],
) -> float:
    """Return the grid direction of a further source that explains most of a snapshot's residual."""
    best, direction = -1.0, 0.0
    for e in range(x.size):
        found.left[e] = x[e]
    _leave(found.left, found.basis, size)
    for i in range(scan.size):
        steering_phases(-scan[i], place, found.wave)
        free = float(x.size)
        for k in range(size):
            free -= _power(_product(found.basis[k], found.wave))
        fit = _power(_product(found.wave, found.left)) / free
        if free > NEAREST * x.size and fit > best:
            best, direction = fit, scan[i]
    return direction


@no_alloc
def _aim(
    x: Complex[np.ndarray, " e"], found: Sources, count: Whole, place: Float[np.ndarray, " p"]
) -> float:
    """Write all beams, the residual and the Gauss-Newton terms; return the residual's energy."""
    for k in range(count):
        size, beam = _span(found, count, k, place), found.beam[k]
        steering_phases(-found.u[k], place, beam)
        for e in range(x.size):
            spaced = place[e] if place.size else float(e)
            found.slope[k, e] = 1j * spaced * beam[e]
        _leave(beam, found.basis, size)
        square = _product(beam, beam).real
        amplitude = _product(beam, x) / square
        found.gain[k] = square / x.size
        for e in range(x.size):
            beam[e] = beam[e].conjugate() / math.sqrt(square)
            found.slope[k, e] *= amplitude
    size = _span(found, count, -1, place)
    for e in range(x.size):
        found.left[e] = x[e]
    _leave(found.left, found.basis, size)
    for k in range(count):
        _leave(found.slope[k], found.basis, size)
        found.score[k] = _product(found.slope[k], found.left).real
        for j in range(k + 1):
            entry = _product(found.slope[k], found.slope[j]).real
            found.inverse[k, j] = found.inverse[j, k] = entry
    return _product(found.left, found.left).real


@no_alloc
def _invert(matrix: Float[np.ndarray, "k k"], size: Whole) -> None:
    """Invert the leading submatrix of a positive definite matrix in place."""
    for k in range(size):
        pivot = 1.0 / matrix[k, k]
        matrix[k, k] = 1.0
        for j in range(size):
            matrix[k, j] *= pivot
        for i in range(size):
            if i != k:
                share = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(size):
                    matrix[i, j] -= share * matrix[k, j]


@no_alloc
def _shift(found: Sources, count: Whole, share: float) -> None:
    """Move the directions of the sources by a fraction of the Gauss-Newton step."""
    for k in range(count):
        found.u[k] += share * found.step[k]


@no_alloc
def _settle(
    x: Complex[np.ndarray, " e"], found: Sources, count: Whole, place: Float[np.ndarray, " p"]
) -> float:
    """Refine the sources' directions by damped Gauss-Newton steps; return the residual's energy."""
    energy = _aim(x, found, count, place)
    for _ in range(STEPS):
        _invert(found.inverse, count)
        longest = 0.0
        for k in range(count):
            found.step[k] = 0.0
            for j in range(count):
                found.step[k] += found.inverse[k, j] * found.score[j]
            longest = max(longest, abs(found.step[k]))
        share = min(1.0, LONGEST_STEP / longest)
        _shift(found, count, share)
        lower = _aim(x, found, count, place)
        while not lower <= energy and share > SHORTEST_SHARE:
            _shift(found, count, -0.75 * share)
            share *= 0.25
            lower = _aim(x, found, count, place)
        gain, energy = energy - lower, lower
        if not gain > SETTLED:
            break
    _invert(found.inverse, count)
    return energy


@no_alloc
def resolve(
    x: Complex[np.ndarray, " e"],
    scan: Float[np.ndarray, " n"],
    place: Float[np.ndarray, " p"],
    most_left: Float[np.ndarray, " k"],
    found: Sources,
) -> tuple[Whole, float]:
    """Find the fewest sources that explain a snapshot; return number and residual energy.

    ``scan``: grid of directions; ``place``: positions of the elements, in spacings; empty if
    equally spaced.
    """
    energy = math.inf
    for count in range(1, most_left.size + 1):
        for k in range(count - 1):
            found.fewer[k] = found.u[k]
        size = _span(found, count - 1, -1, place)
        found.u[count - 1] = _best_beside(x, found, size, scan, place)
        for _ in range(ROUNDS if count > 1 else 0):
            moved = False
            for k in range(count):
                size, before = _span(found, count, k, place), found.u[k]
                found.u[k] = _best_beside(x, found, size, scan, place)
                moved |= abs(found.u[k] - before) > 1.5 * (scan[1] - scan[0])
            if not moved:
                break
        energy = _settle(x, found, count, place)
        apart = 0  # sources whose direction has a std of at most the limit
        for k in range(count):
            apart += 0.5 * found.inverse[k, k] <= UNSURE * UNSURE
        if count > 1 and apart < count:
            for k in range(count - 1):
                found.u[k] = found.fewer[k]
            return count - 1, _settle(x, found, count - 1, place)
        if energy <= most_left[count - 1]:
            return count, energy
    return most_left.size, energy


@no_alloc
def deviation(x: Complex[np.ndarray, " e"], found: Sources, k: Whole, noise: float) -> float:
    """Return the std of a source's phase between neighbour elements [rad], for a noise power."""
    heard = 0.0j
    for e in range(x.size):
        heard += x[e] * found.beam[k, e]
    over = max(_power(heard) / noise - 1.0, MIN_POWER_OVER_NOISE)
    return math.sqrt(0.5 * noise * found.inverse[k, k]) * (1.0 + 1.0 / over)


@kernel
def surest(
    whole: Int[np.ndarray, "3 m"], numbers: Float[np.ndarray, "5 m"], apart: float
) -> Bool[np.ndarray, " m"]:
    """Return a mask of the rows with the smallest std where several snapshots have the same echo.

    ``whole``: face, caller and snapshot; ``numbers``: begin with delay, sine of the angle, power
    and deviation of the bearing; ``apart``: largest difference of an echo's delays [s].
    """
    best = np.ones(whole.shape[1], dtype=np.bool_)
    delay, sine, std = numbers[0], numbers[1], numbers[3]
    for d in range(best.size):
        for other in range(best.size):
            if (
                whole[2, other] != whole[2, d]
                and whole[0, other] == whole[0, d]
                and whole[1, other] == whole[1, d]
                and abs(delay[other] - delay[d]) < apart
                and abs(sine[other] - sine[d]) < SAME_SINE
                and (std[other] < std[d] or (std[other] == std[d] and other < d))
            ):
                best[d] = False
    return best
