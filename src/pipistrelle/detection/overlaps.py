r"""Overlaps: echoes that arrive together, told apart by the phases across one face.

Echoes that overlap in time are summed at each of a face's N elements. A snapshot of the matched
filter's outputs that holds K of them is

.. math:: x = A(u)\, s + n, \qquad A(u) = [a(u_1) \dots a(u_K)], \qquad a_e(u) = e^{i e u}, \qquad
          u = \frac{2\pi f d}{c} \sin\theta ,

with the amplitudes s, which nothing is assumed of, and noise n of unit variance. One beam that is
scanned sees lobes some :math:`2\pi / N` wide in u: of two echoes nearer than that it shows one peak
between them, of others each where the other's lobe pulls it.

**Directions.** The likeliest are those whose waves leave least of the snapshot,

.. math:: \hat u = \arg\min_u \lVert P^\perp_A x \rVert^2, \qquad
          P^\perp_A = I - A (A^H A)^{-1} A^H ,

deterministic maximum likelihood. Echoes of one call are coherent, which does not matter here, and
is why methods that ask for the rank of a covariance (MUSIC, ESPRIT) fail in one snapshot. The
minimum is found by *alternating projection*: each source in turn is put where, beside the others,
it explains most,

.. math:: \hat u_k = \arg\max_u \frac{|a(u)^H P^\perp_{A_k} x|^2}{\lVert P^\perp_{A_k} a(u)\rVert^2}

over a grid, :math:`A_k` being the others' waves; then all are moved by Gauss and Newton's steps
:math:`J^{-1} g`, with :math:`D = [a'(u_1) s_1 \dots a'(u_K) s_K]` and

.. math:: J = \operatorname{Re}(D^H P^\perp_A D), \qquad g = \operatorname{Re}(D^H P^\perp_A x) .

**How sure they are.** Twice J is Fisher's information of the directions, with amplitudes unknown,
so that the Cramér-Rao bound is :math:`\operatorname{cov}(\hat u) \ge \tfrac12 J^{-1}`. For one
source it is that of `certainty`; near another it grows as their distance falls.

**How many there are.** After the right number the residual is noise without what was fitted, two
numbers for each amplitude and one for each direction: :math:`2 \lVert P^\perp_A x \rVert^2` has
the law of :math:`\chi^2` with :math:`2N - 3K` degrees of freedom. From one source on, another is
added until no more is left than noise leaves in all but a thousandth of snapshots
(`certainty.NOISE_QUANTILE`), or `MOST` are found, or the bound of one exceeds `UNSURE`: two that
noise does not tell apart stay one. So of single echoes one in a thousand is parted, and of faint
ones fewer. What then is left beyond noise is noise to the deviations.

**Amplitude and time.** An echo's amplitude is what a beam to it with nulls at the others says,
:math:`w = P^\perp_{A_k} a(u_k)`, :math:`s_k = w^H x / \lVert w \rVert^2`. In that beam the others
are silent at every lag, so that the echo's own time of arrival is found there (`onset`), half a
call around. An echo that two snapshots hold is told once, by the surer (`surest`).

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
"""Most sources in a snapshot: of four, ten elements tell too little."""
NEAREST = 0.01
"""Least share of a wave beside the others for which a grid's direction is tried."""
ROUNDS = 3
"""Rounds of alternating projection."""
STEPS = 8
"""Steps of Gauss and Newton."""
LONGEST_STEP = 0.2
"""Longest of these, in u [rad]: a third of a lobe."""
SHORTEST_SHARE = 1e-3
"""Share of a step below which it is not taken back further."""
SETTLED = 1e-3
"""Energy, in units of the noise's, by which a step must lower the residual for another one."""
UNSURE = 0.2
"""Largest deviation of u with which sources count as told apart [rad]."""
SAME_TIME = 0.25
"""Largest difference of one echo's times of arrival in two snapshots, in calls."""
SAME_SINE = 0.1
"""The same of the sines of its angle."""


def most_left(elements: int) -> Float[np.ndarray, " k"]:
    """Return the energy that noise leaves of 1, 2, ... sources in all but a thousandth of cases.

    In units of the noise of one output; for fewer than `MOST` where the elements tell no more.

    >>> most_left(10).round(1)
    array([20.4, 18.1, 15.6])
    """
    from scipy.special import gammaincinv

    count = np.arange(1, min(MOST, (2 * elements - 1) // 3) + 1)
    return gammaincinv(elements - 1.5 * count, NOISE_QUANTILE)


class Sources(NamedTuple):
    """Sources in a snapshot, and room to find them; the next snapshot overwrites it."""

    u: Float[np.ndarray, " k"]
    """Phase between neighbours of each [rad]."""
    inverse: Float[np.ndarray, "k k"]
    """Of J: half of it is the Cramér-Rao bound of u, at unit noise."""
    beam: Complex[np.ndarray, "k e"]
    """To each with nulls at the others, as `onset.steer` takes it: ``w / |w|``, conjugate."""
    gain: Float[np.ndarray, " k"]
    """Which share of its power the beam to each takes, ``|w|^2 / N``."""
    basis: Complex[np.ndarray, "k e"]
    """Of the waves' space, orthonormal."""
    slope: Complex[np.ndarray, "k e"]
    """D, beside the waves."""
    left: Complex[np.ndarray, " e"]
    """Residual."""
    wave: Complex[np.ndarray, " e"]
    """That of a direction which is tried."""
    score: Float[np.ndarray, " k"]
    """g"""
    fewer: Float[np.ndarray, " k"]
    """u as it was with one source less."""
    step: Float[np.ndarray, " k"]


@kernel
def room_for(most: Whole, elements: Whole) -> Sources:
    """Return room for so many sources."""
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
    """Return a^H b."""
    total = 0.0j
    for e in range(a.size):
        total += a[e].conjugate() * b[e]
    return total


@no_alloc
def _power(z: complex) -> float:
    """Return the square of an amplitude."""
    return z.real * z.real + z.imag * z.imag


@no_alloc
def _leave(x: Complex[np.ndarray, " e"], basis: Complex[np.ndarray, "k e"], count: Whole) -> None:
    """Take from x what lies in the space of the first vectors of a basis."""
    for k in range(count):
        along = _product(basis[k], x)
        for e in range(x.size):
            x[e] -= along * basis[k, e]


@no_alloc
def _span(found: Sources, count: Whole, without: Whole, place: Float[np.ndarray, " p"]) -> Whole:
    """Write an orthonormal basis of the sources' waves but for one's; return its size."""
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
    """Return the direction of a grid that explains most of x beside a basis of that size."""
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
    """Write beams, gains, residual, and J and g in their places; return the residual's energy."""
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
    """Replace the corner of that size of a positive definite matrix by its inverse."""
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
    """Move the sources by a share of the step."""
    for k in range(count):
        found.u[k] += share * found.step[k]


@no_alloc
def _settle(
    x: Complex[np.ndarray, " e"], found: Sources, count: Whole, place: Float[np.ndarray, " p"]
) -> float:
    """Move the sources to the minimum that is near; return the energy of the residual there.

    A step that leads too far is taken back by three quarters, and again.
    """
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
    """Find as many sources as explain a snapshot; return their number and the residual's energy.

    ``scan``: directions that are tried first; ``place``: of the elements, in spacings; empty for
    equally spaced ones.
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
        if count > 1 and not _are_apart(found, count):
            for k in range(count - 1):
                found.u[k] = found.fewer[k]
            return count - 1, _settle(x, found, count - 1, place)
        if energy <= most_left[count - 1]:
            return count, energy
    return most_left.size, energy


@no_alloc
def _are_apart(found: Sources, count: Whole) -> bool:
    """Tell whether each direction is known, in unit noise, to a third of a lobe."""
    apart = 0
    for k in range(count):
        apart += 0.5 * found.inverse[k, k] <= UNSURE * UNSURE
    return apart == count


@no_alloc
def deviation(x: Complex[np.ndarray, " e"], found: Sources, k: Whole, noise: float) -> float:
    """Return the standard deviation of a source's u [rad], in noise of a power.

    As for one beam (`certainty.bearing_std`) faint sources are less sure than the bound.
    """
    heard = 0.0j
    for e in range(x.size):
        heard += x[e] * found.beam[k, e]
    over = max(_power(heard) / noise - 1.0, MIN_POWER_OVER_NOISE)
    return math.sqrt(0.5 * noise * found.inverse[k, k]) * (1.0 + 1.0 / over)


@kernel
def surest(
    whole: Int[np.ndarray, "3 m"], numbers: Float[np.ndarray, "5 m"], apart: float
) -> Bool[np.ndarray, " m"]:
    """Tell which rows are the surest of their echo, which several snapshots may hold.

    ``whole`` are face, caller and snapshot; ``numbers`` begin with delay, sine of the angle, power
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
