r"""The direct call of another caller: found by what it is, and when it began.

Of all sound in a caller's tone that which came straight is the first, and as loud as anything; an
echo may be louder only where a landmark stands so near the straight line that the sound it bends
forward adds up. So: the loudest in the tone, and of what is not much fainter than that the first.

**When it began.** Echoes of what stands near the line set in while the direct call lasts, and draw
the best fit of a whole call by up to its length, and the beam aside. Before it there is nothing. So
its front edge is sought alone, in what the matched filter's outputs gain from a block to the next:
what a new block brings less what an old one takes,

.. math:: s_k = y_{k+1} - y_k = x_{k+M} - x_k

at each element; which is noise until the call begins, and its amplitudes A after the block in which
it does, of which the call fills the share
:math:`1 - q = \operatorname{Re}(A^H s_k) / \lVert A \rVert^2`. A is the mean of the two blocks that
follow; no direction is asked. The edge is as sure as those few blocks are loud, and as well as they
fit:

.. math:: \sigma_q^2 = \frac{\sigma_s^2}{2 \lVert A \rVert^2} \left(1 + \frac{(1 - q)^2}{2}\right)
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.detection.matched import reach_of
from pipistrelle.jit import Whole, kernel, no_alloc

MIN_RELATIVE_POWER = 0.1
"""Least power of the direct call, as a share of the loudest of its tone."""
MIN_EDGE_AMPLITUDE = 0.3
"""Least amplitude of its front edge, as a share of what the loudest lag near makes expect."""
MAX_LEAKAGE = 0.005
"""Power, as a share of a detection's of another tone at the same time, that may be its leakage."""
MIN_EDGE_ENERGY = 3.0
"""Least energy of its front edge, in means of that of the noise, over a face's elements."""
MIN_EDGE_ENERGY_OF_BEAM = 16.0
"""The same of one beam, whose noise varies more: as rare, one in ten million."""
EDGE_BLOCKS = 2
"""Blocks behind the edge that tell the amplitude: what sets in later does not matter."""


class Lags(NamedTuple):
    """Lags of a matched filter's output."""

    start: float
    """Delay of lag 0 [s]."""
    interval: float
    """Between two lags [s]."""
    pulse: int
    """Lags in a call."""


class DirectCalls(NamedTuple):
    """Direct call of each caller: which detection it is, and when it began."""

    detection: Int[np.ndarray, " c"]
    """Number of a detection of it; -1 for the vehicle and for callers not heard."""
    delay: Float[np.ndarray, " c"]
    delay_std: Float[np.ndarray, " c"]
    """`delay` and `delay_std`: when it began; NaN likewise [s]."""
    pulse: float
    """How long it lasts [s]."""


def own_alone(
    calls: DirectCalls,
    label: Int[np.ndarray, " d"],
    own: Int[np.ndarray, " c"],
    missable: Bool[np.ndarray, " c"],
) -> DirectCalls:
    """Drop direct calls with another label than the caller's own, of callers that may be missed.

    One that calls when the vehicle does, alike in all directions, is always heard first. One with a
    beam may point away, and one with a clock of its own may call while the vehicle does: the first
    of its tone is then an echo, which bears the label of what threw it.

    Parameters
    ----------
    calls : DirectCalls
    label : (d)
        Whose echo each detection is.
    own : (c)
        The labels that the callers bear themselves.
    missable : (c)

    Returns
    -------
    DirectCalls

    Examples
    --------
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
    """Return direct calls without those of some callers, as if these had not been heard."""
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
    """Find the detection that is the direct call of caller p; -1 if there is none."""
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
    """Return the lag at which the first call of a tone begins, and its standard deviation.

    Sought from two calls before lag b to it, among blocks of at least so many means of the noise.
    NaN where none stands out; and with an infinite deviation where something stood out that did not
    last: a call that an echo at its heels has all but extinguished.
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
    """Return the mean of the `EDGE_BLOCKS` blocks after one block, at an element."""
    total = 0.0j
    for a in range(begin + 1, begin + 1 + EDGE_BLOCKS):
        total += gain[a, e]
    return total / EDGE_BLOCKS


@no_alloc
def _fitted(gain: Complex[np.ndarray, "k e"], k: Whole, noise: float) -> tuple[float, float]:
    """Fit the start of a call in block k or the one before; return it with its deviation.

    In blocks from the first. What the fit leaves is noise, where it is more than that.
    """
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


@kernel
def direct_calls(
    matched: Complex[np.ndarray, "l f c e"],
    whole: Int[np.ndarray, "2 d"],
    numbers: Float[np.ndarray, "5 d"],
    tones: Whole,
    lags: Lags,
) -> tuple[Int[np.ndarray, " c"], Float[np.ndarray, "2 c"]]:
    """Find the direct call of every caller but the vehicle, by loudness and order, and its edge.

    ``whole`` are face and caller of each detection, ``numbers`` delay, sine of the angle, power and
    the standard deviations of bearing and delay; ``lags`` the delay of lag 0 [s], the distance of
    two lags [s] and the lags of a call. Returns the columns of `DirectCalls`; of a call
    that began before the record, or rises too little, the whole's best fit.
    """
    start, interval, pulse = lags
    found = np.full(tones, -1, dtype=np.int64)
    when = np.full((2, tones), np.nan)
    for p in range(1, tones):
        d = loudest_first(whole[1], numbers[0], numbers[2], p)
        if d < 0 or may_leak(numbers[0], numbers[2], d, pulse * interval):
            continue
        b = int((numbers[0, d] - start) / interval + 0.5)
        lag, std = math.nan, math.nan
        if b > pulse + reach_of(pulse):
            lag, std = front_edge(matched, b, whole[0, d], p, pulse, MIN_EDGE_ENERGY)
        if std != math.inf:
            found[p], when[0, p], when[1, p] = d, start + interval * lag, interval * std
        if math.isnan(std):
            when[0, p], when[1, p] = numbers[0, d], numbers[4, d]
    return found, when


@no_alloc
def may_leak(
    delay: Float[np.ndarray, " d"], power: Float[np.ndarray, " d"], d: Whole, within: float
) -> bool:
    """Tell whether detection d is faint enough to be the leakage of another at the same time.

    The loud one has another tone, as no direct call is so faint beside its own tone
    (`MIN_RELATIVE_POWER`). It may be at any face: sound from behind a face leaks into it, too, and
    is not listed there.
    """
    for other in range(delay.size):
        if abs(delay[other] - delay[d]) <= within and power[d] < MAX_LEAKAGE * power[other]:
            return True
    return False
