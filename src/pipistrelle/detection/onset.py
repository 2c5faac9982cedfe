"""Time of arrival: where, to a fraction of a lag, a call starts in a steered beam."""

import math

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.jit import Whole, kernel, no_alloc


@no_alloc
def steering_phases(
    u: float, place: Float[np.ndarray, " e"], phases: Complex[np.ndarray, " e"]
) -> None:
    """Write what turns each element's output to that of the first, for a wave of phase u a spacing.

    `place`: of the elements, in spacings; empty for equally spaced ones.
    """
    turn, phase = complex(math.cos(u), -math.sin(u)), 1.0 + 0.0j
    for e in range(phases.size):
        phases[e] = phase
        phase *= turn
    for e in range(place.size):
        phases[e] = complex(math.cos(u * place[e]), -math.sin(u * place[e]))


@no_alloc
def steer(
    matched: Complex[np.ndarray, "l f c e"],
    low: Whole,
    lags: Whole,
    f: Whole,
    p: Whole,
    phases: Complex[np.ndarray, " e"],
    beam: Complex[np.ndarray, " r"],
) -> None:
    """Write the output of a beamformer of these phases, so many lags from low on."""
    for k in range(lags):
        beam[k] = 0.0
    for e in range(matched.shape[3]):
        for k in range(lags):
            beam[k] += matched[low + k, f, p, e] * phases[e]


@kernel
def _best_fraction(z0: complex, z1: complex, pulse: Whole) -> tuple[float, float]:
    """Return the likeliest start of the call between two lags, a fraction, and its fit.

    A call that starts the fraction q into block 0 weighs the blocks 1 - q, 1, ..., 1, q; its
    likelihood grows with abs((1 - q) z0 + q z1)^2 / (pulse - 2 q + 2 q^2), whose stationary
    points are the roots of a quadratic.
    """
    a = z0.real * z0.real + z0.imag * z0.imag
    h = z0.real * z1.real + z0.imag * z1.imag
    b = z1.real * z1.real + z1.imag * z1.imag
    beta, gamma = 2.0 * (h - a), a + b - 2.0 * h
    A, B, C = -2.0 * (beta + gamma), 2.0 * gamma * pulse - 4.0 * a, beta * pulse + 2.0 * a
    best, fit = 0.0, a / pulse
    if b / pulse > fit:
        best, fit = 1.0, b / pulse
    discriminant = B * B - 4.0 * A * C
    if discriminant >= 0.0:
        root = -0.5 * (B + math.copysign(math.sqrt(discriminant), B))
        for k in range(2):
            numerator, divisor = (root, A) if k == 0 else (C, root)
            if divisor != 0.0 and 0.0 < numerator / divisor < 1.0:
                q = numerator / divisor
                score = (a + q * (beta + gamma * q)) / (pulse - 2.0 * q + 2.0 * q * q)
                if score > fit:
                    best, fit = q, score
    return best, fit


@kernel
def reach_of(pulse: Whole) -> Whole:
    """Return how many lags around a snapshot's the call may start."""
    return max(pulse // 7, 1)


@no_alloc
def arrival_lag(
    matched: Complex[np.ndarray, "l f c e"],
    b: Whole,
    f: Whole,
    p: Whole,
    phases: Complex[np.ndarray, " e"],
    pulse: Whole,
    beam: Complex[np.ndarray, " r"],
) -> float:
    """Return the lag, to a fraction, at which the call starts in a beam, near lag b.

    ``beam`` is room for the beam: the lags within reach and one to either side.
    """
    reach, last = reach_of(pulse), matched.shape[0] - 1
    low, high = max(b - reach, 0), min(b + reach, last)
    first = max(low - 1, 0)
    steer(matched, first, min(high + 1, last) - first + 1, f, p, phases, beam)
    centre, largest = b, -1.0
    for near in range(low, high + 1):
        z = abs(beam[near - first])
        if z > largest:
            centre, largest = near, z
    best, fit = float(centre), -1.0
    for left in range(max(centre - 1, 0), min(centre, last - 1) + 1):
        q, score = _best_fraction(beam[left - first], beam[left + 1 - first], pulse)
        if score > fit:
            best, fit = left + q, score
    return best
