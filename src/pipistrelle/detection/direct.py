r"""The direct call of another caller: found among the detections of its tone, and its beginning.

The direct call is the first sound of a caller's tone, and rarely fainter than an echo: an echo may
be louder only if its landmark is near the straight line and scatters forward. So it is the first
detection that is not much fainter than the loudest.

**Beginning.** Echoes of landmarks near the line begin while the direct call lasts; they shift the
best fit of a whole call by up to its length, and its bearing. Before the direct call there is only
noise. So its front edge is sought in the differences of the matched filter's outputs between
blocks, the newest block less the oldest,

.. math:: s_k = y_{k+1} - y_k = x_{k+M} - x_k

at each element; noise until the call begins, and its amplitudes A after the block of its beginning,
of which it fills the share :math:`1 - q = \operatorname{Re}(A^H s_k) / \lVert A \rVert^2`. A is the
mean of the two blocks that follow; no direction is needed. The variance of the edge follows from
the level of these blocks and the residual of the fit:

.. math:: \sigma_q^2 = \frac{\sigma_s^2}{2 \lVert A \rVert^2} \left(1 + \frac{(1 - q)^2}{2}\right)
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.detection.matched import reach_of
from pipistrelle.jit import Whole, kernel, no_alloc

MIN_RELATIVE_POWER = 0.1
"""Least power of the direct call, relative to the loudest detection of its tone."""
MIN_EDGE_AMPLITUDE = 0.3
"""Least amplitude of its front edge, relative to the expectation from the loudest lag nearby."""
MAX_LEAKAGE = 0.005
"""Largest relative power of leakage from another tone at the same time."""
MIN_EDGE_ENERGY = 3.0
"""Least energy of its front edge over a face's elements, in means of the noise's."""
MIN_EDGE_ENERGY_OF_BEAM = 16.0
"""`MIN_EDGE_ENERGY` of a single beam, with more variable noise: as rare, one in ten million."""
EDGE_BLOCKS = 2
"""Blocks after the edge that give the amplitude; later echoes do not affect it."""


class Lags(NamedTuple):
    """Time axis of matched-filter outputs: first delay, step, and a call's length in steps."""

    start: float
    """Delay of lag 0 [s]."""
    interval: float
    """Between two lags [s]."""
    pulse: int
    """Lags in a call."""


class DirectCalls(NamedTuple):
    """Index of the detection, and start time, of the direct call of each caller."""

    detection: Int[np.ndarray, " c"]
    """Index of its detection; -1 for the vehicle and for callers that were not detected."""
    delay: Float[np.ndarray, " c"]
    delay_std: Float[np.ndarray, " c"]
    """`delay` and `delay_std`: of its beginning [s]; NaN if not detected."""
    pulse: float
    """Duration of a call [s]."""


def own_alone(
    calls: DirectCalls,
    label: Int[np.ndarray, " d"],
    own: Int[np.ndarray, " c"],
    missable: Bool[np.ndarray, " c"],
) -> DirectCalls:
    """Discard supposed direct calls that are really echoes, for callers that may be missed.

    A caller that calls with the vehicle, equally in all directions, is always received first. A
    caller with a beam may point away, and with an independent clock it may call while the vehicle
    does: the first of its tone is then an echo, with the label of its landmark.

    `label`: of each detection's landmark; `own`: of the callers as landmarks; `missable`: of
    callers.

    >>> time = np.array([np.nan, 0.01])
    >>> heard = DirectCalls(detection=np.array([-1, 0]), delay=time, delay_std=time, pulse=0.003)
    >>> named = np.array([-1, 51]), np.array([False, True])
    >>> own_alone(heard, np.array([51]), *named).delay
    array([ nan, 0.01])
    >>> own_alone(heard, np.array([7]), *named).delay
    array([nan, nan])
    """
    heard = calls.detection >= 0
    of = np.where(heard, label[np.where(heard, calls.detection, 0)], own) if label.size else own
    return without_calls(calls, missable & (of != own))


def without_calls(calls: DirectCalls, dropped: Bool[np.ndarray, " c"]) -> DirectCalls:
    """Mark the direct calls of some callers as undetected."""
    return DirectCalls(
        detection=np.where(dropped, -1, calls.detection),
        delay=np.where(dropped, np.nan, calls.delay),
        delay_std=np.where(dropped, np.nan, calls.delay_std),
        pulse=calls.pulse,
    )


@no_alloc
def loudest_first(
    caller: Int[np.ndarray, " d"],
    delay: Float[np.ndarray, " d"],
    power: Float[np.ndarray, " d"],
    p: Whole,
) -> Whole:
    """Return the index of caller p's direct call among detections; -1 if there is none."""
    loudest, first = 0.0, -1
    for d in range(caller.size):
        if caller[d] == p:
            loudest = max(loudest, power[d])
    for d in range(caller.size):
        earlier = first < 0 or delay[d] < delay[first]
        if caller[d] == p and power[d] >= MIN_RELATIVE_POWER * loudest and earlier:
            first = d
    return first


@kernel
def front_edge(
    matched: Complex[np.ndarray, "l f c e"],
    b: Whole,
    f: Whole,
    p: Whole,
    pulse: Whole,
    least: float,
) -> tuple[float, float]:
    """Return the lag of the front edge of a tone's first call, and its standard deviation.

    Searched from two calls before lag b to b, in blocks of energy above `least` means of the noise.
    NaN if there is none. NaN with an infinite deviation if an edge does not last: a call that an
    immediate echo has nearly cancelled.
    """
    stride, elements = max(pulse // 14, 1), matched.shape[3]
    low = max(b - 2 * (pulse + stride), b % stride)
    count = (min(b + stride, matched.shape[0] - 1) - low) // stride
    gain, loudest = np.empty((count, elements), dtype=np.complex128), 0.0
    energy = np.zeros(count)
    for k in range(count):
        after, before, level = low + (k + 1) * stride, low + k * stride, 0.0
        for e in range(elements):
            y = matched[after, f, p, e]
            gain[k, e] = y - matched[before, f, p, e]
            energy[k] += gain[k, e].real ** 2 + gain[k, e].imag ** 2
            level += y.real**2 + y.imag**2
        loudest = max(loudest, level)
    noise = 2.0 * stride / pulse
    faintest = least * noise * elements
    loud, first = max((MIN_EDGE_AMPLITUDE * stride / pulse) ** 2 * loudest, faintest), count
    for k in range(count - EDGE_BLOCKS):
        first = min(first, k) if energy[k] >= faintest else first
        if energy[k : k + 1 + EDGE_BLOCKS].min() >= loud:
            if first < k - 1:
                break
            lag, std = _fitted(gain, k, noise)
            return low + pulse + stride * lag, stride * std
    return math.nan, math.nan if first == count else math.inf


@no_alloc
def _mean_after(gain: Complex[np.ndarray, "k e"], begin: Whole, e: Whole) -> complex:
    """Return an element's mean output over the `EDGE_BLOCKS` blocks after block `begin`."""
    total = 0.0j
    for a in range(begin + 1, begin + 1 + EDGE_BLOCKS):
        total += gain[a, e]
    return total / EDGE_BLOCKS


@no_alloc
def _fitted(gain: Complex[np.ndarray, "k e"], k: Whole, noise: float) -> tuple[float, float]:
    """Fit the start of a call in block k or k - 1; return the start and its std, in blocks."""
    least, best, std, elements = math.inf, math.nan, math.nan, gain.shape[1]
    for begin in range(max(k - 1, 0), k + 1):
        square, along, misfit = 0.0, 0.0, 0.0
        for e in range(elements):
            A, s = _mean_after(gain, begin, e), gain[begin, e]
            square += A.real * A.real + A.imag * A.imag
            along += A.real * s.real + A.imag * s.imag
        share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        for e in range(elements):
            A = _mean_after(gain, begin, e)
            misfit += abs(gain[begin, e] - share * A) ** 2
            misfit += abs(gain[begin - 1, e]) ** 2 if begin > 0 else 0.0
            for a in range(begin + 1, begin + 1 + EDGE_BLOCKS):
                misfit += abs(gain[a, e] - A) ** 2
        if square > 0.0 and misfit < least:
            left = max(noise, misfit / elements)
            least, best = misfit, begin + 1.0 - share
            std = math.sqrt(0.5 * left * (1.0 + share * share / EDGE_BLOCKS) / square)
    return best, std


def direct_calls(
    heard: tuple[Int[np.ndarray, " d"], Float[np.ndarray, " d"], Float[np.ndarray, " d"]],
    powers: Sequence[Float[np.ndarray, " d"]],
    lags: Lags,
    edge: Callable[[int, int, int], tuple[float, float]],
    lead: Float[np.ndarray, " d"] | None = None,
) -> DirectCalls:
    """Return every other caller's direct call, chosen by loudness and order, and its start time.

    `heard`: caller, delay and the delay's standard deviation of each detection; `powers`: for each
    caller, of the detections of its kind of call; `edge`: finds the beginning of the call of a
    detection, a caller and a lag (`front_edge`); `lead`: of the microphones of each detection over
    the vehicle's centre [s]. If the call began before the record, or its edge is too faint, its
    time is that of the best fit of a whole call.
    """
    (caller, delay, std), length = heard, lags.pulse * lags.interval
    detection, when = np.full(len(powers), -1), np.full((2, len(powers)), np.nan)
    for p, power in enumerate(powers[1:], start=1):
        d = int(loudest_first(caller, delay, power, p))
        if d < 0 or may_leak(delay, power, d, length):
            continue
        ahead = 0.0 if lead is None else lead[d]
        b = int((delay[d] - ahead - lags.start) / lags.interval + 0.5)
        lag, lag_std = math.nan, math.nan
        if b > lags.pulse + reach_of(lags.pulse):
            lag, lag_std = edge(d, p, b)
        if lag_std != math.inf:
            detection[p] = d
            when[:, p] = lags.start + lags.interval * lag + ahead, lags.interval * lag_std
        if math.isnan(lag_std):
            when[:, p] = delay[d], std[d]
    return DirectCalls(detection=detection, delay=when[0], delay_std=when[1], pulse=length)


@no_alloc
def may_leak(
    delay: Float[np.ndarray, " d"], power: Float[np.ndarray, " d"], d: Whole, within: float
) -> bool:
    """Return whether detection d is faint enough to be leakage of a louder simultaneous call.

    The louder has another tone, as no direct call is so faint in its own tone
    (`MIN_RELATIVE_POWER`). It may be at any face, as sound from behind a face also leaks into it
    without a detection there.
    """
    for other in range(delay.size):
        if abs(delay[other] - delay[d]) <= within and power[d] < MAX_LEAKAGE * power[other]:
            return True
    return False
