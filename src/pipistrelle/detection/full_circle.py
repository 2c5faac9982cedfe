r"""Full-circle detection: calls at microphones in any positions, by delay-and-sum beams.

Microphone m, at p_m, receives a wave from the direction :math:`\phi` earlier than the vehicle's
centre, by :math:`a_m = p_m \cdot u(\phi) / c`. The beam is the sum of the delayed matched outputs y
over lags t,

.. math:: z(\phi, t) = \sum_m w_m e^{-2\pi i f a_m} y_m(t - a_m), \qquad
          w_m = g_m \Big/ \sqrt{\textstyle\sum g^2} ,

so that the call's whole band adds up, however wide the array is. The envelope is interpolated
linearly between lags: that of a tone's matched output is a triangle.

**Loudness** of a lag is the largest :math:`|z|^2` over the circle. In noise of unit variance z is
complex normal at every direction, and the maximum of such a process exceeds h, per lag, with
probability

.. math:: P \le e^{-h} \left(1 + \sqrt{\frac{h}{\pi}} \int \sqrt{\kappa}\, d\phi \right), \qquad
          \kappa(\phi) = \sum_m w_m^2 \left(\psi_m' - \bar\psi'\right)^2, \qquad
          \psi_m' = \frac{2\pi f}{c}\, p_m \cdot u'(\phi) ,

from the mean number of upcrossings of h around the circle: the factor of :math:`e^{-h}` is the
number of independent looks. It can also not exceed the energy of all N microphones, which is
Gamma(N). The threshold is where the smaller of the two is the false-alarm rate. :math:`\kappa` is
also the array's aperture: the Cramér-Rao bound of the bearing is

.. math:: \sigma_\phi^2 = \frac{1}{2 p \kappa} .

**Ambiguous bearings.** If other lobes of the scan are nearly as loud as the loudest, as the mirror
image for a line of microphones, or for spacings above half a wave, the call may have come from
there. With a flat prior the odds are the likelihood ratios, and the stated variance is

.. math:: \sigma^2 = \sigma_\phi^2 + \frac{\sum_k o_k (\phi_k - \phi)^2}{1 + \sum_k o_k}, \qquad
          o_k = e^{-(|z|^2 - |z_k|^2) / \eta} ,

with :math:`\eta` the noise (`pipistrelle.detection.noise`).

Sources: Rice, Bell System Technical Journal 24 (1945), and Davies, Biometrika 74 (1987), for the
crossings; Van Trees, Optimum Array Processing (2002), Secs. 2.2 and 8.4, for delay and sum and the
bound.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from pipistrelle.arrays.beamforming import UNKNOWN, spread_towards
from pipistrelle.arrays.layout import Scattered
from pipistrelle.config import Config
from pipistrelle.detection.direct import MIN_EDGE_ENERGY_OF_BEAM, Lags, front_edge
from pipistrelle.detection.matched import reach_of
from pipistrelle.detection.noise import (
    bearing_std,
    candidates,
    delay_std,
    loudest_noise,
    over_noise,
    snapshot,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

BEAM_STEP = 0.4
"""Root mean square phase between two beams over the microphones [rad]: 4 % loss halfway."""
STRIDES = 14
"""Most lags in a call at which the loudness is scanned."""
CLIMBS = 4
"""Steps of the climb to the top of a lobe, each by a parabola, a quarter as wide as the last."""
PARTS = 8
"""Divisions of a lag in the search for the start of a call."""
FINEST = 1e-4
"""Smallest step of the search, in lags."""
RARE = 40.0
"""Lobes this many noise powers below the loudest are ignored: odds of 1 to 1e17."""


class Circle(NamedTuple):
    """The detector of calls in a group of omnidirectional microphones."""

    threshold: float
    """Least loudness of a call at a lag and tone, in units of the noise of one output."""
    leakage: float
    """Least loudness relative to another tone's at nearby lags."""
    loudest_noise: float
    """See `noise.loudest_noise`."""
    beams: int
    """Number of directions that are scanned."""
    speed_of_sound: float
    tones: Float[np.ndarray, " c"]
    position: Float[np.ndarray, "k 2"]
    """Positions in the vehicle's frame [m]."""
    weight: Float[np.ndarray, " k"]
    """Weight of each output; the squares of all sum to 1."""


def circle_of(
    config: Config, layout: Scattered, group: int, tones: Float[np.ndarray, " c"]
) -> Circle:
    """Build the detector of a group of omnidirectional microphones."""
    (position, gain), c = layout.places(group), config.assumed_sound_speed
    weight = gain / np.linalg.norm(gain)
    bearing = np.linspace(-np.pi, np.pi, 3600, endpoint=False)
    slope = 2.0 * np.pi * tones.max() / c * np.sqrt(spread_towards(bearing, position, weight))
    looks = 2.0 * np.pi * float(slope.mean())
    return Circle(
        threshold=loudest_by_chance(config.detection.false_alarm, looks, gain.size),
        leakage=10.0 ** (config.detection.leakage_db / 10.0),
        loudest_noise=loudest_noise(gain.size),
        beams=max(math.ceil(2.0 * np.pi * float(slope.max()) / BEAM_STEP), 8),
        speed_of_sound=c,
        tones=tones,
        position=position,
        weight=weight,
    )


def loudest_by_chance(chance: float, looks: float, microphones: int) -> float:
    r"""Return the loudness that noise exceeds, somewhere on the circle, with a given probability.

    `looks` is :math:`\int \sqrt{\kappa} d\phi` over the circle.

    >>> round(loudest_by_chance(1e-6, 0.0, 8), 2), round(loudest_by_chance(1e-6, 71.0, 8), 2)
    (13.82, 18.98)
    """
    from scipy.optimize import brentq
    from scipy.special import gammainccinv

    def excess(h: float) -> float:
        return math.log1p(looks * math.sqrt(h / math.pi)) - h - math.log(chance)

    energy, alone = float(gammainccinv(microphones, chance)), -math.log(chance)
    if excess(alone) <= 0.0 or excess(energy) >= 0.0:
        return min(alone, energy)
    return float(brentq(excess, alone, energy))  # pyrefly: ignore[bad-argument-type]


def find_around(
    matched: Complex[np.ndarray, "l c k"], circle: Circle, lags: Lags
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Detect the calls at a group of microphones, at most one in each snapshot.

    Returns the caller of each; delay at the vehicle's centre [s], bearing [rad], power, the
    standard deviations of bearing and delay, and the arctangent of the bearing's slope in the
    logarithm of the speed of sound.
    """
    margin = margin_of(circle.position, circle.speed_of_sound * lags.interval)
    return _find(_padded(matched, margin), margin, tuple(circle), lags)


def edge_around(
    matched: Complex[np.ndarray, "l c k"],
    circle: Circle,
    lags: Lags,
    at: tuple[Whole, Whole, float],
) -> tuple[float, float]:
    """Return `direct.front_edge` of a beam, for a detection `at` lag, tone and bearing."""
    b, p, bearing = at
    stride, margin = (
        max(lags.pulse // STRIDES, 1),
        margin_of(circle.position, circle.speed_of_sound * lags.interval),
    )
    low = max((b - 2 * (lags.pulse + stride)) // stride * stride, 0)
    beam = np.empty(min(b + stride + 1, len(matched)) - low, dtype=np.complex128)
    _beam(_padded(matched, margin), margin + low, p, bearing, circle, lags, beam)
    alone = beam[:, np.newaxis, np.newaxis, np.newaxis]
    lag, std = front_edge(alone, b - low, 0, 0, lags.pulse, MIN_EDGE_ENERGY_OF_BEAM)
    return low + lag, std


def margin_of(position: Float[np.ndarray, "k 2"], lag: float) -> int:
    """Return the largest lead or delay of a microphone in lags; `lag`: sound path per lag [m]."""
    return math.ceil(np.linalg.norm(position, axis=1).max() / lag) + 2


def _padded(matched: Complex[np.ndarray, "l c k"], margin: int) -> Complex[np.ndarray, "_ c k"]:
    """Pad outputs with silence before and after."""
    silence = np.zeros((margin, *matched.shape[1:]), dtype=np.complex128)
    return np.concatenate((silence, matched, silence), dtype=np.complex128)


@no_alloc
def _output(
    matched: Complex[np.ndarray, "l c k"],
    b: float,
    p: Whole,
    bearing: float,
    circle: Circle,
    lag: Lags,
) -> tuple[complex, float, float]:
    """Return the beam to a bearing at a fractional lag, its energy, and its noise variance."""
    ahead, left = math.cos(bearing), math.sin(bearing)
    turn = 2.0 * math.pi * circle.tones[p]
    total, energy, noise = 0.0j, 0.0, 0.0
    for m in range(circle.weight.size):
        early = circle.position[m, 0] * ahead + circle.position[m, 1] * left
        k, part, now, after = _delayed(early / circle.speed_of_sound, b, turn, lag.interval)
        y = (1.0 - part) * now * matched[k, p, m] + part * after * matched[k + 1, p, m]
        total += circle.weight[m] * y
        energy += y.real * y.real + y.imag * y.imag
        share = circle.weight[m] * circle.weight[m]
        noise += share * (1.0 - 2.0 * part * (1.0 - part) / lag.pulse)
    return total, energy, noise


@no_alloc
def _power(
    matched: Complex[np.ndarray, "l c k"],
    b: float,
    p: Whole,
    bearing: float,
    circle: Circle,
    lag: Lags,
) -> float:
    """Return the power of the beam to a bearing at a fractional lag, in units of its noise."""
    z, _, noise = _output(matched, b, p, bearing, circle, lag)
    return (z.real * z.real + z.imag * z.imag) / noise


@kernel
def _beam(
    matched: Complex[np.ndarray, "l c k"],
    first: Whole,
    p: Whole,
    bearing: float,
    circle: Circle,
    lag: Lags,
    beam: Complex[np.ndarray, " r"],
) -> None:
    """Write the beam to a bearing at consecutive lags, with the phase of the first."""
    turn = 2.0 * math.pi * circle.tones[p] * lag.interval
    for k in range(beam.size):
        z, _, noise = _output(matched, float(first + k), p, bearing, circle, lag)
        beam[k] = z * complex(math.cos(turn * k), -math.sin(turn * k)) / math.sqrt(noise)


@no_alloc
def _start(
    matched: Complex[np.ndarray, "l c k"],
    b: Whole,
    p: Whole,
    bearing: float,
    circle: Circle,
    lag: Lags,
    within: tuple[Whole, Whole],
) -> float:
    """Return the start of the call in a beam, near lag b, as a fractional lag.

    It is the loudest in units of the noise (`matched.arrival_lag` for outputs at whole lags).
    `within`: the first and last lag.
    """
    reach, best, loudest = reach_of(lag.pulse), float(b), -1.0
    for near in range(max(b - reach, within[0]), min(b + reach, within[1]) + 1):
        power = _power(matched, float(near), p, bearing, circle, lag)
        if power > loudest:
            best, loudest = float(near), power
    centre = best
    for part in range(-PARTS, PARTS + 1):
        power = _power(matched, centre + part / PARTS, p, bearing, circle, lag)
        if power > loudest:
            best, loudest = centre + part / PARTS, power
    step = 0.5 / PARTS
    while step > FINEST:
        for side in (best - step, best + step):
            power = _power(matched, side, p, bearing, circle, lag)
            if power > loudest:
                best, loudest = side, power
        step *= 0.5
    return best


class _Beams(NamedTuple):
    """The beams of a tone: lags and factors of each microphone's outputs."""

    back: Int[np.ndarray, "n k"]
    """Offset from the centre's lag to the first of the two that are interpolated."""
    first: Complex[np.ndarray, "n k"]
    then: Complex[np.ndarray, "n k"]
    """`first` and `then`: factors of the outputs at that lag and the next."""


@kernel
def _find(
    matched: Complex[np.ndarray, "l c k"], margin: Whole, circle: tuple, lag: Lags
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Detect the call of every snapshot; `matched` has silent margins."""
    group = Circle(*circle)
    interval, pulse, tones = lag.interval, lag.pulse, matched.shape[1]
    stride, count = max(pulse // STRIDES, 1), 0
    loudness = np.empty(((matched.shape[0] - 2 * margin + stride - 1) // stride, tones))
    beams = [_beams_of(p, group, interval) for p in range(tones)]
    for p in range(tones):
        _scan(matched, margin, stride, p, beams[p], group.threshold, loudness)
    flat, power = loudness.reshape(-1), np.empty(group.beams)
    tests = candidates(flat, group.threshold, tones)
    caller, numbers = np.empty(tests.size, dtype=np.int64), np.empty((6, tests.size))
    lobes, within = np.empty((2, group.beams)), (margin, matched.shape[0] - margin - 1)
    for test in tests:
        begin, end = snapshot(
            flat, test, tones, tones, pulse // stride, False, group.threshold, group.leakage
        )
        if begin == end:
            continue
        p, b = test % tones, margin + begin * stride
        late = float(b)
        for _ in range(2):  # again at the refined time
            _powers(matched, b, p, beams[p], power)
            best = _lobes(matched, late, p, power, group, lag, lobes)
            late = _start(matched, b, p, lobes[0, best[0]], group, lag, within)
            b = min(max(round(late), within[0]), within[1])
        caller[count] = p
        _write_row(matched, late, p, lobes, best, group, lag, numbers[:, count])
        numbers[0, count] = lag.start + interval * (late - margin)
        count += 1
    return caller[:count], numbers[:, :count]


@no_alloc
def _write_row(
    matched: Complex[np.ndarray, "l c k"],
    b: float,
    p: Whole,
    lobes: Float[np.ndarray, "2 n"],
    best: tuple[Whole, Whole],
    circle: Circle,
    lag: Lags,
    row: Float[np.ndarray, "6"],
) -> None:
    """Write the numbers of a detection, except its delay; `best`: loudest lobe, number of lobes."""
    loudest, count = best
    bearing, top = lobes[0, loudest], lobes[1, loudest]
    _, energy, least = _output(matched, b, p, bearing, circle, lag)
    over = over_noise(top, energy / least, circle.weight.size, circle.loudest_noise)
    noise, odds, square = top / (over + 1.0), 0.0, 0.0
    for k in range(count):
        if k != loudest:
            off = wrap_angle(lobes[0, k] - bearing)
            share = math.exp((lobes[1, k] - top) / noise)
            odds, square = odds + share, square + share * off * off
    spread, slope, off_centre = _geometry(bearing, circle)
    wave = 2.0 * math.pi * circle.tones[p] / circle.speed_of_sound
    std = math.hypot(bearing_std(over, wave, 12.0 * spread), math.sqrt(square / (1.0 + odds)))
    std = min(std, UNKNOWN)
    row[1], row[2], row[3] = wrap_angle(bearing), top, std
    late = lag.interval * delay_std(over, lag.pulse)
    row[4], row[5] = math.hypot(late, off_centre / circle.speed_of_sound * std), math.atan(slope)


@no_alloc
def _geometry(bearing: float, circle: Circle) -> tuple[float, float, float]:
    """Return the geometry of the microphones as seen from a bearing.

    The variance of their positions across it [m^2]; the slope of the bearing in the logarithm of
    the speed of sound; and the offset of their centre across it from the vehicle's [m].
    """
    cosine, sine = math.cos(bearing), math.sin(bearing)
    x = y = xx = xy = 0.0
    for m in range(circle.weight.size):
        share = circle.weight[m] * circle.weight[m]
        along = circle.position[m, 0] * cosine + circle.position[m, 1] * sine
        across = circle.position[m, 1] * cosine - circle.position[m, 0] * sine
        x, y = x + share * along, y + share * across
        xy, xx = xy + share * along * across, xx + share * across * across
    spread = max(xx - y * y, 1e-12)
    return spread, (xy - x * y) / spread, abs(y)


@kernel
def _scan(
    matched: Complex[np.ndarray, "l c k"],
    margin: Whole,
    stride: Whole,
    p: Whole,
    beams: _Beams,
    threshold: float,
    loudness: Float[np.ndarray, "s c"],
) -> None:
    """Write the loudness of a tone at every stride's lag; 0 where even the energy is too low."""
    square, power = _largest_near(matched, p, margin), np.empty(len(beams.back))
    for s in range(len(loudness)):
        b, energy = margin + s * stride, 0.0
        for m in range(square.shape[1]):
            energy += square[b, m]
        loudness[s, p] = 0.0
        if energy >= threshold:
            _powers(matched, b, p, beams, power)
            loudness[s, p] = power.max()


@no_alloc
def _powers(
    matched: Complex[np.ndarray, "l c k"],
    b: Whole,
    p: Whole,
    beams: _Beams,
    power: Float[np.ndarray, " n"],
) -> None:
    """Write the power of every beam at a lag."""
    for i in range(power.size):
        z = 0.0j
        for m in range(matched.shape[2]):
            k = b + beams.back[i, m]
            z += beams.first[i, m] * matched[k, p, m] + beams.then[i, m] * matched[k + 1, p, m]
        power[i] = z.real * z.real + z.imag * z.imag


@kernel
def _lobes(
    matched: Complex[np.ndarray, "l c k"],
    b: float,
    p: Whole,
    power: Float[np.ndarray, " n"],
    circle: Circle,
    lag: Lags,
    lobes: Float[np.ndarray, "2 n"],
) -> tuple[Whole, Whole]:
    """Write bearing and power of the candidate lobes; return the loudest's index and the count."""
    n, count, loudest = power.size, 0, 0
    i = int(power.argmax())
    _, energy, _ = _output(matched, b, p, _bearing_of(i, circle), circle, lag)
    over = over_noise(power[i], energy, circle.weight.size, circle.loudest_noise)
    faintest = 0.9 * power[i] - RARE * power[i] / (over + 1.0)
    for i in range(n):
        if power[i] > power[i - 1] and power[i] >= power[(i + 1) % n] and power[i] >= faintest:
            lobes[0, count], lobes[1, count] = _climb(
                matched, b, p, _bearing_of(i, circle), circle, lag
            )
            loudest = count if lobes[1, count] > lobes[1, loudest] else loudest
            count += 1
    return loudest, count


@no_alloc
def _bearing_of(i: Whole, circle: Circle) -> float:
    """Return the direction of a beam [rad]."""
    return 2.0 * math.pi * i / circle.beams - math.pi


@kernel
def _beams_of(p: Whole, circle: Circle, interval: float) -> _Beams:
    """Return the beams of a tone."""
    shape, turn = (circle.beams, circle.weight.size), 2.0 * math.pi * circle.tones[p]
    back = np.empty(shape, dtype=np.int64)
    first, then = np.empty(shape, dtype=np.complex128), np.empty(shape, dtype=np.complex128)
    for i in range(circle.beams):
        bearing = _bearing_of(i, circle)
        ahead, left = math.cos(bearing), math.sin(bearing)
        for m in range(circle.weight.size):
            early = circle.position[m, 0] * ahead + circle.position[m, 1] * left
            k, part, now, after = _delayed(early / circle.speed_of_sound, 0.0, turn, interval)
            back[i, m] = k
            first[i, m] = circle.weight[m] * (1.0 - part) * now
            then[i, m] = circle.weight[m] * part * after
    return _Beams(back, first, then)


@no_alloc
def _delayed(
    early: float, b: float, turn: float, interval: float
) -> tuple[Whole, float, complex, complex]:
    """Return the interpolation of a microphone's output that leads the centre by `early` [s].

    The first of two lags and the fraction of the way to the next, and the phases that turn the
    outputs there, of a tone of `turn` [rad/s], to the centre's.
    """
    at = b - early / interval
    k = math.floor(at)
    now, after = -turn * (early + (k - b) * interval), -turn * (early + (k + 1 - b) * interval)
    phases = complex(math.cos(now), math.sin(now)), complex(math.cos(after), math.sin(after))
    return k, at - k, phases[0], phases[1]


@kernel
def _largest_near(
    matched: Complex[np.ndarray, "l c k"], p: Whole, margin: Whole
) -> Float[np.ndarray, "l k"]:
    """Return the largest squared output of each microphone within a margin of each lag."""
    lags, _, microphones = matched.shape
    square = np.zeros((lags, microphones))
    for m in range(microphones):
        for b in range(lags):
            y = matched[b, p, m]
            level = y.real * y.real + y.imag * y.imag
            for near in range(max(b - margin, 0), min(b + margin + 1, lags)):
                square[near, m] = max(square[near, m], level)
    return square


@no_alloc
def moved(before: float, here: float, after: float) -> float:
    """Return the offset of a parabola's peak from the middle of three powers, one step at most."""
    bend = 2.0 * here - before - after
    move = 0.5 * (after - before) / bend if bend > 0.0 else math.copysign(1.0, after - before)
    return min(max(move, -1.0), 1.0)


@no_alloc
def _climb(
    matched: Complex[np.ndarray, "l c k"],
    b: float,
    p: Whole,
    bearing: float,
    circle: Circle,
    lag: Lags,
) -> tuple[float, float]:
    """Climb to the top of a lobe near a beam; return its bearing and power."""
    step = 2.0 * math.pi / circle.beams
    for _ in range(CLIMBS):
        before = _power(matched, b, p, bearing - step, circle, lag)
        here = _power(matched, b, p, bearing, circle, lag)
        after = _power(matched, b, p, bearing + step, circle, lag)
        bearing += step * moved(before, here, after)
        step *= 0.25
    return bearing, _power(matched, b, p, bearing, circle, lag)
