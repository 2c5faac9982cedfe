r"""The full circle: calls that microphones anywhere hear, found by delay and sum.

Microphone m, at p_m, hears a wave from the direction :math:`\phi` earlier than the vehicle's
centre, by :math:`a_m = p_m \cdot u(\phi) / c`. Its matched output y, over lags t, is delayed by
that, and all are summed,

.. math:: z(\phi, t) = \sum_m w_m e^{-2\pi i f a_m} y_m(t - a_m), \qquad
          w_m = g_m \Big/ \sqrt{\textstyle\sum g^2} ,

so that the call's whole band adds up, however wide the array is. Between two lags the envelope is
linear: that of a tone's matched output, a triangle, is, but for its tip.

**Loudness** of a lag is the largest :math:`|z|^2` over the circle. In noise of unit variance z is
complex normal at every direction, and the largest of such a process exceeds h by chance, per lag,

.. math:: P \le e^{-h} \left(1 + \sqrt{\frac{h}{\pi}} \int \sqrt{\kappa}\, d\phi \right), \qquad
          \kappa(\phi) = \sum_m w_m^2 \left(\psi_m' - \bar\psi'\right)^2, \qquad
          \psi_m' = \frac{2\pi f}{c}\, p_m \cdot u'(\phi) ,

the mean number of times that it rises through h on the way round: what stands beside
:math:`e^{-h}` is the number of independent looks. No more than the energy of all microphones can it
be either, which of N is Gamma(N). The threshold is where the smaller of the two is the false-alarm
rate. :math:`\kappa` is the array's aperture, too: the Cramér-Rao bound of the bearing is

.. math:: \sigma_\phi^2 = \frac{1}{2 p \kappa} .

**What an array cannot tell.** Where other lobes of the scan are nearly as loud as the loudest, of a
line of microphones that from the other side, or those of microphones more than half a wave apart,
the call may have come from there. With a flat prior the odds are those of the likelihoods, and the
deviation that a row states is that about the loudest,

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
"""Distance of two beams, as the root mean square phase between them over the microphones [rad]: a
call halfway between them is 4 % less loud."""
STRIDES = 14
"""Lags in a call of which the loudness is scanned, at most."""
CLIMBS = 4
"""Steps towards the top of a lobe, each by a parabola, a quarter as wide as the one before."""
PARTS = 8
"""Parts of a lag in which the start of a call is sought."""
FINEST = 1e-4
"""Smallest step with which it is sought, in lags."""
RARE = 40.0
"""Lobes fainter than the loudest by so many times the noise are not asked: odds of 1 to 1e17."""


class Circle(NamedTuple):
    """A group of microphones that hear all around, its threshold and its scan."""

    threshold: float
    """Least loudness of a call at a lag and tone, in units of the noise of one output."""
    leakage: float
    """Least loudness, as a share of that of another tone nearby."""
    loudest_noise: float
    """See `certainty.loudest_noise`."""
    beams: int
    """Directions that are scanned."""
    speed_of_sound: float
    """Speed of sound [m/s]."""
    tones: Float[np.ndarray, " c"]
    """Tones [Hz]."""
    position: Float[np.ndarray, "k 2"]
    """In the vehicle's frame [m]."""
    weight: Float[np.ndarray, " k"]
    """Weight of each output; the squares of all sum to 1."""


def circle_of(
    config: Config, layout: Scattered, group: int, tones: Float[np.ndarray, " c"]
) -> Circle:
    """Settle threshold and scan of a group of microphones that hear all around."""
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
    r"""Return the loudness that noise exceeds, somewhere on the circle, with some chance.

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
    """Find the calls that a group hears, one in each snapshot.

    Returns the caller of each; delay at the vehicle's centre [s], bearing [rad], power, the
    standard deviations of bearing and delay, and the arctangent of the bearing's slope by the
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
    """Return the lag at which the first call of a tone begins, as `direct.front_edge` does.

    Sought in the beam to a bearing; `at`: lag, tone and bearing of the detection.
    """
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
    """Return the lags by which the farthest microphone hears earlier or later than the centre.

    `lag`: way of sound from one to the next [m].
    """
    return math.ceil(np.linalg.norm(position, axis=1).max() / lag) + 2


def _padded(matched: Complex[np.ndarray, "l c k"], margin: int) -> Complex[np.ndarray, "_ c k"]:
    """Return outputs with silence before and after."""
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
    """Return the beam to a bearing at a lag, or between two, and the energy that it sums.

    And the variance of its noise, which is least halfway between two lags.
    """
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
    """Return the power of the beam to a bearing at a lag, in units of its noise."""
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
    """Write the beam to a bearing, lag by lag from the first on, turned to the phase of that."""
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
    """Return the likeliest lag, to a fraction, at which the call starts in a beam, near lag b.

    It is the loudest in units of the noise (`onset` solves the same for outputs at one lag).
    `within`: the first lag and the last.
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
    """The beams of a tone: which lags each takes of each microphone, and times what."""

    back: Int[np.ndarray, "n k"]
    """Lags from that of the centre to the first of the two between which a microphone hears."""
    first: Complex[np.ndarray, "n k"]
    then: Complex[np.ndarray, "n k"]
    """`first` and `then`: what the outputs at that lag and the next are multiplied by."""


@kernel
def _find(
    matched: Complex[np.ndarray, "l c k"], margin: Whole, circle: tuple, lag: Lags
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Find the call of every snapshot; `matched` has silent margins."""
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
        for _ in range(2):  # once more at the very time
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
    """Write all of a detection but its delay; `best`: the loudest of so many lobes."""
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
    """Return what the places of the microphones make of a bearing.

    Their variance across it [m^2]; by how much the bearing turns with the logarithm of the speed of
    sound; and how far across it their centre is from the vehicle's [m].
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
    """Write the loudness of a tone at every stride's lag.

    Where not even the energy of all microphones reaches the threshold nothing is scanned: 0.
    """
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
    """Write bearing and power of the lobes that may be the call's; return the loudest's number.

    And how many there are.

    Those are asked whose beams are not much fainter than the loudest beam.
    """
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
    """Return where a microphone that hears so early [s] has what the centre has at a lag.

    The first of two lags and the part of the way to the next, and the phases that turn the outputs
    there, of a tone that turns so fast [rad/s], to that of the centre.
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
    """Return the most that a microphone's output has within a margin of each lag, squared."""
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
    """Return how many steps away a parabola through three powers peaks, one at most."""
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
    """Return the bearing of the top of a lobe near a beam, and the power there."""
    step = 2.0 * math.pi / circle.beams
    for _ in range(CLIMBS):
        before = _power(matched, b, p, bearing - step, circle, lag)
        here = _power(matched, b, p, bearing, circle, lag)
        after = _power(matched, b, p, bearing + step, circle, lag)
        bearing += step * moved(before, here, after)
        step *= 0.25
    return bearing, _power(matched, b, p, bearing, circle, lag)
