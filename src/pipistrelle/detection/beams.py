r"""Calls at microphones in any positions, and calls that are not tones, by delay-and-sum beams.

Microphone m, at p_m, receives a wave from the direction :math:`\phi` earlier than the centre by
:math:`a_m = p_m \cdot u(\phi) / c`. A beam is the sum of the delayed matched outputs y over lags t,

.. math:: z(\phi, t) = \sum_m w_m e^{-2\pi i f a_m} y_m(t - a_m), \qquad
          w_m = g_m \Big/ \sqrt{\textstyle\sum g^2} ,

so that the call's whole band adds up, however wide the array is. Between lags, the envelope of a
tone is interpolated linearly, as its matched output is a triangle; of another call by a windowed
sinc that preserves the band. For a sweep, the distance between two microphones changes the
envelope's time as well as the phase: over 44 mm, 0.13 ms, the matched output of a band of 25 kHz
falls off three times. So all lags of a sweep are scanned by delays, frequency by frequency:
:math:`Z(\phi, f) = \sum_m w_m e^{-2\pi i f a_m(\phi)} Y_m(f)`, with Y the spectrum of y.

**Loudness** of a lag is the largest :math:`|z|^2` over the directions. In noise of unit variance z
is complex normal at every direction, and the maximum of such a process exceeds h, per lag, with
probability

.. math:: P \le e^{-h} \left(1 + \sqrt{\frac{h}{\pi}} \int \sqrt{\kappa}\, d\phi \right), \qquad
          \kappa(\phi) = \left(\frac{2\pi f}{c}\right)^2 \sum_m w_m^2
                         \Bigl(p_m \cdot u' - \sum_n w_n^2 \, p_n \cdot u'\Bigr)^2 ,

from the mean number of upcrossings of h around the circle: the factor of :math:`e^{-h}` is the
number of independent looks. It can also not exceed the energy of all N microphones, which is
Gamma(N). The threshold is where the smaller of the two is the false-alarm rate. For a call that is
no tone, f is the root mean square frequency, :math:`f^2 = f_c^2 + (\beta / 2\pi)^2`; its lags are
spaced by half the inverse of the widest band (`acoustics.call.lag_step`), and the noise of two is
correlated as the call's autocorrelation.

**Standard deviations.** :math:`\kappa` is also the array's aperture: with the power over the noise
p of the beam (`pipistrelle.detection.noise`), the Cramér-Rao bounds with an unknown phase are

.. math:: \sigma_\phi^2 = \frac{1 + 1/p}{2 p \kappa}, \qquad
          \sigma_\tau^2 = \frac{1 + 1/p}{2 p \beta^2} + \left(\delta \, \frac{2 v}{c}\right)^2 / 2 ,

the second of a sweep, with its delay error by an unknown Doppler shift: the echo may come from any
direction, to a vehicle at the speed v of the settings, and the mean square cosine of a direction is
a half. No delay is corrected for it.

**Ambiguous bearings.** If other lobes of the scan are nearly as loud as the loudest, as the mirror
image for a line of microphones, or for spacings above half a wave, the call may have come from
there. With a flat prior the odds are the likelihood ratios, and the stated variance is

.. math:: \sigma^2 = \sigma_\phi^2 + \frac{\sum_k o_k (\phi_k - \phi)^2}{1 + \sum_k o_k}, \qquad
          o_k = e^{-(|z|^2 - |z_k|^2) / \eta} ,

with :math:`\eta` the noise.

**Detections.** A tone has a single detection in each snapshot. Another loud call leaves lobes at
other lags: of its autocorrelation, and of beams to other directions, where some microphones' peaks
come too early. A peak counts only if it exceeds the sum of the amplitudes that all louder
peaks may leave there, computed in advance as the scan's response to the call, from several
directions and with Doppler shifts, plus 3 dB.

**Calls only partly in the record**, as the vehicle is deaf while it calls, are peaks at lags before
its first or after its last. Their skirts reach into the record, wider than a whole call's, as the
received part has less of the band; and outputs that begin or end amid a peak are a step, which a
transform spreads over all lags. So if a loud peak is near an end, outputs are computed a call's
length beyond both ends, of samples padded with silence; peaks there mask the most that their cut
call may leave, and are not detections themselves.

Sources: Rice, Bell System Technical Journal 24 (1945), and Davies, Biometrika 74 (1987), for the
crossings; Van Trees, Optimum Array Processing (2002), Secs. 2.2, 6.13 and 8.4, for delay and sum
and the bound.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import Band, Call, band_of, coupling, lag_step, replica
from pipistrelle.arrays.beamforming import UNKNOWN, spread_towards
from pipistrelle.arrays.layout import Layout, Scattered
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
from pipistrelle.geometry import wrap, wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

BEAM_STEP = 0.4
"""Root mean square phase between two beams over the microphones [rad]: 4 % loss halfway."""
STRIDES = 14
"""Most lags in a tone at which the loudness is scanned."""
CLIMBS = 4
"""Steps of the climb to the top of a lobe, each by a parabola, a quarter as wide as the last."""
DIVISIONS = 8
"""Divisions of a lag in the search for the start of a tone."""
FINEST = 1e-4
"""Smallest step of the search, in lags."""
RARE = 40.0
"""Lobes this many noise powers below the loudest are ignored: odds of 1 to 1e17."""
TAPS, PARTS, BETA = 12, 256, 8.0
"""Windowed sinc: number of taps, positions between two outputs, shape of its Kaiser window."""
BEAMS_AT_ONCE = 32
"""Beams whose outputs are in memory at a time."""
MARGIN = 2.0
"""Least ratio of a peak's power to the most that louder calls leave there."""
LOBE = 0.7
"""Least power of a lobe, relative to the loudest, that may be the loudest at its own time."""
PARTS_CUT = 16
"""Number of missing shares of a call for which its lobes are tabulated."""
SHIFT = 0.01
"""Largest Doppler shift in the table of lobes, relative."""
_ANGLES = (0.0, 0.7, 1.3)
"""Directions in the table of lobes, off a face's normal or the heading [rad]."""


class Beams(NamedTuple):
    """Directions, microphone positions and weights of the beams of a group of microphones."""

    bearing: Float[np.ndarray, " n"]
    """Directions that are scanned [rad]."""
    position: Float[np.ndarray, "k 2"]
    """Positions of the microphones, relative to the beams' centre [m]."""
    weight: Float[np.ndarray, " k"]
    """Weight of each output; the squares of all sum to 1."""
    speed_of_sound: float
    loudest_noise: float
    """See `noise.loudest_noise`."""
    around: bool
    """Whether the first direction follows the last."""
    centred: bool
    """Whether the centre is the microphones' middle."""


class Circle(NamedTuple):
    """The detector of tones in a group of omnidirectional microphones."""

    threshold: float
    """Least loudness of a call at a lag and tone, in units of an output's noise."""
    leakage: float
    """Least loudness relative to another tone's at nearby lags."""
    tones: Float[np.ndarray, " c"]
    beams: Beams
    """Beams about the vehicle's centre."""


class Wide(NamedTuple):
    """The detector of a wideband call in a group of microphones."""

    threshold: float
    """Least loudness of a call at a lag, in units of an output's noise."""
    sine_limit: float
    """Sine of the largest angle off the normal that counts; 2 for an omnidirectional group."""
    normal: float
    """Normal of a line on a face [rad]; NaN for an omnidirectional group."""
    middle: Float[np.ndarray, "2"]
    """Middle of the microphones, the beams' centre, in the vehicle's frame [m]."""
    band: Band
    doppler_std: float
    """Standard deviation of a delay, by the call's Doppler shift [s]."""
    beams: Beams
    lobes: Float[np.ndarray, " l"]
    """Largest share of its power that a call leaves at each distance from its peak, in lags."""
    cut_lobes: Float[np.ndarray, "s l"]
    """The `lobes` of calls only partly in the record, a row for each missing share."""


class _Call(NamedTuple):
    """Frequency, length and interpolation between lags of a call's matched-filter outputs."""

    frequency: float
    """Of a tone, or centre of the band, shifted to 0 in the outputs [Hz]."""
    pulse: int
    """Lags in a tone."""
    interval: float
    """Between two lags [s]."""
    sinc: Float[np.ndarray, "p t"]
    """Windowed sinc at positions between two outputs; empty for a tone, interpolated linearly."""


def circle_of(
    config: Config, layout: Scattered, group: int, tones: Float[np.ndarray, " c"]
) -> Circle:
    """Build the detector of tones in a group of omnidirectional microphones."""
    (position, gain), c = layout.places(group), config.assumed_sound_speed
    weight = gain / np.linalg.norm(gain)
    bearing = np.linspace(-np.pi, np.pi, 3600, endpoint=False)
    slope = 2.0 * np.pi * tones.max() / c * np.sqrt(spread_towards(bearing, position, weight))
    looks = 2.0 * np.pi * float(slope.mean())
    beams = max(math.ceil(2.0 * np.pi * float(slope.max()) / BEAM_STEP), 8)
    return Circle(
        threshold=loudest_by_chance(config.detection.false_alarm, looks, gain.size),
        leakage=10.0 ** (config.detection.leakage_db / 10.0),
        tones=tones,
        beams=Beams(
            bearing=2.0 * np.pi * np.arange(beams) / beams - np.pi,
            position=position,
            weight=weight,
            speed_of_sound=c,
            loudest_noise=loudest_noise(gain.size),
            around=True,
            centred=False,
        ),
    )


def wide_of(
    config: Config, layout: Layout | Scattered, group: int, calls: Sequence[Call], caller: int
) -> Wide:
    """Build the detector of a wideband call for the microphones of a face or another group."""
    rate, c = config.receiver.sample_rate, config.assumed_sound_speed
    normal, (place, gain) = float(layout.normal[group]), layout.places(group)
    weight = gain / np.linalg.norm(gain)
    middle = weight**2 @ place
    position = place - middle
    band = band_of(calls[caller], rate)
    around = math.isnan(normal)
    limit = math.radians(config.detection.scan_limit_deg)
    fine = np.linspace(-np.pi, np.pi, 3601) if around else normal + np.linspace(-limit, limit, 1801)
    wave = math.hypot(2.0 * np.pi * band.centre, band.spread) / c
    slope = wave * np.sqrt(spread_towards(fine, position, weight))
    looks = np.concatenate(([0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(fine))))
    count = max(math.ceil(looks[-1] / BEAM_STEP), 8) + (0 if around else 1)
    even = np.linspace(0.0, looks[-1], count + 1 if around else count)
    moving = 2.0 * abs(config.scenario.speed) / c / math.sqrt(2.0)
    wide = Wide(
        threshold=loudest_by_chance(config.detection.false_alarm, looks[-1], weight.size),
        sine_limit=2.0 if around else math.sin(math.radians(config.detection.angle_limit_deg)),
        normal=normal,
        middle=middle,
        band=band,
        doppler_std=abs(coupling(calls[caller])) * moving,
        beams=Beams(
            bearing=np.interp(even, looks, fine)[:count],
            position=position,
            weight=weight,
            speed_of_sound=c,
            loudest_noise=loudest_noise(weight.size),
            around=False,
            centred=True,
        ),
        lobes=np.empty(0),
        cut_lobes=np.empty((0, 0)),
    )
    step = lag_step(calls, rate)
    lobes = _lobes_of(calls[caller], wide, step, rate)
    cut = _cut_lobes_of(calls[caller], wide, step, rate)
    return wide._replace(lobes=lobes, cut_lobes=cut)


def loudest_by_chance(chance: float, looks: float, microphones: int) -> float:
    r"""Return the beam power that noise exceeds, in any direction, with a given probability.

    `looks` is :math:`\int \sqrt{\kappa} d\phi` over the scan.

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
    """Return caller, delay, bearing and power of the tones that a group of microphones detects.

    Returns the caller of each; delay at the vehicle's centre [s], bearing [rad], power, the
    standard deviations of bearing and delay, and the arctangent of the bearing's slope in the
    logarithm of the speed of sound.
    """
    margin = _margin(circle.beams, lags.interval)
    return _find(_padded(matched, margin), margin, circle, lags)


def edge_around(
    matched: Complex[np.ndarray, "l c k"],
    circle: Circle,
    lags: Lags,
    b: int,
    p: int,
    bearing: float,
) -> tuple[float, float]:
    """Return start and std of a tone [lags] in the beam to a detection's bearing (`front_edge`)."""
    stride, margin = max(lags.pulse // STRIDES, 1), _margin(circle.beams, lags.interval)
    low = max((b - 2 * (lags.pulse + stride)) // stride * stride, 0)
    beam = np.empty(min(b + stride + 1, len(matched)) - low, dtype=np.complex128)
    call = _Call(float(circle.tones[p]), lags.pulse, lags.interval, _LINEAR)
    _beam(_padded(matched, margin)[p], margin + low, bearing, circle.beams, call, beam)
    alone = beam[:, np.newaxis, np.newaxis, np.newaxis]
    lag, std = front_edge(alone, b - low, 0, 0, lags.pulse, MIN_EDGE_ENERGY_OF_BEAM)
    return low + lag, std


def find_wide(
    matched: Complex[np.ndarray, "l k"],
    wide: Wide,
    lags: Lags,
    around: Callable[[], Complex[np.ndarray, "n k"]] | None = None,
) -> tuple[Float[np.ndarray, "6 m"], Bool[np.ndarray, " m"]]:
    """Return delay, bearing and power of the wideband calls that a group of microphones detects.

    `around`: returns the outputs also at lags at which a call is only partly in the record, equally
    many at each end; called if a loud peak is near an end. Returns the numbers of `find_around`, on
    a face with the angle off its normal in place of the last; and a mask of the calls that are
    wholly in the record.
    """
    if not len(matched):
        return np.empty((6, 0)), np.empty(0, dtype=bool)
    loudness, cut = _loudness(matched, wide, lags.interval), 0
    ends = loudness[: wide.lobes.size], loudness[-wide.lobes.size :]
    if around is not None and max(end.max() for end in ends) > wide.threshold:
        cut, matched = -len(matched), around()
        cut = (len(matched) + cut) // 2
        loudness = _loudness(matched, wide, lags.interval)
    peaks = _peaks(loudness, wide.threshold, wide.lobes, wide.cut_lobes, cut)
    turn = np.exp(-2j * np.pi * wide.band.centre * lags.interval * np.arange(len(matched)))
    margin = TAPS + _margin(wide.beams, lags.interval)
    slow = _padded((matched * turn[:, np.newaxis])[:, np.newaxis], margin)[0]
    call = _Call(wide.band.centre, lags.pulse, lags.interval, _SINC)
    numbers = _rows(slow, margin, peaks, wide, call)
    delay, bearing = numbers[:2]
    ahead = wide.middle[0] * np.cos(bearing) + wide.middle[1] * np.sin(bearing)
    numbers[0] = lags.start + delay + ahead / wide.beams.speed_of_sound
    numbers[0] -= cut * lags.interval
    whole = (cut <= peaks) & (peaks < len(matched) - cut)
    if math.isnan(wide.normal):
        return numbers, whole
    numbers[5] = wrap(bearing - wide.normal)
    seen = np.abs(np.sin(numbers[5])) <= wide.sine_limit
    return numbers[:, seen], whole[seen]


def _margin(beams: Beams, interval: float) -> int:
    """Return an upper bound, in lags, of any microphone's time lead over the beams' centre."""
    lag = beams.speed_of_sound * interval
    return math.ceil(np.linalg.norm(beams.position, axis=1).max() / lag) + 2


def _padded(matched: Complex[np.ndarray, "l c k"], margin: int) -> Complex[np.ndarray, "c _ k"]:
    """Pad the matched-filter outputs of each caller with zeros at both ends."""
    around = ((0, 0), (margin, margin), (0, 0))
    return np.pad(matched.transpose(1, 0, 2).astype(np.complex128), around)


def _sinc() -> Float[np.ndarray, "p t"]:
    """Return the taps of a windowed-sinc interpolator for each fraction between two outputs."""
    away = np.arange(TAPS) - (TAPS // 2 - 1) - np.arange(PARTS + 1)[:, np.newaxis] / PARTS
    window = np.i0(BETA * np.sqrt(np.clip(1.0 - (away / (TAPS // 2)) ** 2, 0.0, None)))
    return np.sinc(away) * window / np.i0(BETA)


_SINC, _LINEAR = _sinc(), np.empty((0, 0))


@no_alloc
def _delayed(
    early: float, at: float, frequency: float, interval: float
) -> tuple[Whole, float, complex, complex]:
    """Return how to interpolate a tone between two lags at a microphone ahead by `early` [s].

    The first of two lags and the fraction of the way to the next, and the phases that turn the
    outputs there to the centre's.
    """
    place, turn = at - early / interval, 2.0 * math.pi * frequency
    k = math.floor(place)
    now, after = -turn * (early + (k - at) * interval), -turn * (early + (k + 1 - at) * interval)
    phases = complex(math.cos(now), math.sin(now)), complex(math.cos(after), math.sin(after))
    return k, place - k, phases[0], phases[1]


@no_alloc
def _output(
    matched: Complex[np.ndarray, "l k"], at: float, bearing: float, beams: Beams, call: _Call
) -> tuple[complex, float, float]:
    """Return a beam's output at a bearing and a fractional lag, its energy, and noise variance."""
    ahead, left = math.cos(bearing), math.sin(bearing)
    total, energy, noise = 0.0j, 0.0, 0.0
    parts = call.sinc.shape[0] - 1
    for m in range(beams.weight.size):
        early = (beams.position[m, 0] * ahead + beams.position[m, 1] * left) / beams.speed_of_sound
        y = 0.0j
        if parts < 0:
            k, part, now, after = _delayed(early, at, call.frequency, call.interval)
            y = (1.0 - part) * now * matched[k, m] + part * after * matched[k + 1, m]
            total += beams.weight[m] * y
            square = beams.weight[m] * beams.weight[m]
            noise += square * (1.0 - 2.0 * part * (1.0 - part) / call.pulse)
        else:
            place = at - early / call.interval
            k = math.floor(place)
            part = (place - k) * parts
            row = min(int(part), parts - 1)
            share = part - row
            for t in range(call.sinc.shape[1]):
                weight = (1.0 - share) * call.sinc[row, t] + share * call.sinc[row + 1, t]
                y += weight * matched[k - call.sinc.shape[1] // 2 + 1 + t, m]
            turn = -2.0 * math.pi * call.frequency * early
            total += beams.weight[m] * y * complex(math.cos(turn), math.sin(turn))
            noise = 1.0
        energy += y.real * y.real + y.imag * y.imag
    return total, energy, noise


@no_alloc
def _power(
    matched: Complex[np.ndarray, "l k"], at: float, bearing: float, beams: Beams, call: _Call
) -> float:
    """Return a beam's power at a bearing and a fractional lag, in units of its noise variance."""
    z, _, noise = _output(matched, at, bearing, beams, call)
    return (z.real * z.real + z.imag * z.imag) / noise


@no_alloc
def _moved(before: float, here: float, after: float) -> float:
    """Return the offset of a parabola's peak from the middle of three powers, at most 1 step."""
    bend = 2.0 * here - before - after
    move = 0.5 * (after - before) / bend if bend > 0.0 else math.copysign(1.0, after - before)
    return min(max(move, -1.0), 1.0)


@no_alloc
def _climb(
    matched: Complex[np.ndarray, "l k"],
    at: float,
    bearing: float,
    step: float,
    beams: Beams,
    call: _Call,
) -> tuple[float, float, float]:
    """Return lag, bearing and power at the top of a lobe, climbed from a nearby start.

    The lag of a tone stays: the loudest bearing is found at a given time.
    """
    late = 0.5 if call.sinc.size else 0.0
    for _ in range(CLIMBS):
        before = _power(matched, at, bearing - step, beams, call)
        here = _power(matched, at, bearing, beams, call)
        bearing += step * _moved(before, here, _power(matched, at, bearing + step, beams, call))
        if late > 0.0:
            before = _power(matched, at - late, bearing, beams, call)
            here = _power(matched, at, bearing, beams, call)
            at += late * _moved(before, here, _power(matched, at + late, bearing, beams, call))
        step, late = 0.25 * step, 0.25 * late
    return at, bearing, _power(matched, at, bearing, beams, call)


@no_alloc
def _lobes(
    matched: Complex[np.ndarray, "l k"],
    at: float,
    power: Float[np.ndarray, " n"],
    faintest: float,
    step: float,
    beams: Beams,
    call: _Call,
    lobes: Float[np.ndarray, "4 n"],
) -> tuple[Whole, Whole]:
    """Write lag, bearing, power and step of a scan's lobes; return the loudest's index, and count.

    ``power``: of each beam at the lag; ``faintest``: least of a lobe; ``step``: of a climb [rad],
    0 for half the distance of two beams.
    """
    count, loudest, n = 0, 0, power.size
    for i in range(n):
        before = power[i - 1] if i > 0 or beams.around else -1.0
        after = power[(i + 1) % n] if i + 1 < n or beams.around else -1.0
        if power[i] > before and power[i] >= after and power[i] >= faintest:
            near = i + 1 if i + 1 < n else i - 1
            half = 0.5 * abs(wrap_angle(beams.bearing[near] - beams.bearing[i]))
            lobes[3, count] = step if step > 0.0 else half
            lobes[0, count], lobes[1, count], lobes[2, count] = _climb(
                matched, at, beams.bearing[i], lobes[3, count], beams, call
            )
            loudest = count if lobes[2, count] > lobes[2, loudest] else loudest
            count += 1
    return loudest, count


@no_alloc
def _ambiguity(
    bearing: float,
    top: float,
    noise: float,
    lobes: Float[np.ndarray, "4 n"],
    own: Whole,
    near: float,
) -> float:
    """Return a bearing's variance from the odds that another lobe of the scan is the true source.

    Of a lobe and its power; lobes of the index `own`, or nearer than `near` [rad], are the same.
    """
    odds, square = 0.0, 0.0
    for k in range(lobes.shape[1]):
        off = wrap_angle(lobes[1, k] - bearing)
        if k != own and abs(off) >= near:
            share = math.exp(min(lobes[2, k] - top, 0.0) / noise)
            odds, square = odds + share, square + share * off * off
    return square / (1.0 + odds)


@no_alloc
def _write_row(
    lobe: tuple[float, float, float],
    wave: float,
    square: float,
    late: tuple[float, float],
    beams: Beams,
    row: Float[np.ndarray, "6"],
) -> None:
    """Write bearing, power and standard deviations of a detection, but not its delay.

    ``lobe``: bearing, power and power over the noise; ``wave``: angular frequency; ``square``: see
    `_ambiguity`; ``late``: standard deviations of the delay at the beams' centre, by the noise and
    by the Doppler shift [s].
    """
    bearing, top, over = lobe
    cosine, sine = math.cos(bearing), math.sin(bearing)
    x = y = xx = xy = 0.0
    for m in range(beams.weight.size):
        share = beams.weight[m] * beams.weight[m]
        along = beams.position[m, 0] * cosine + beams.position[m, 1] * sine
        across = beams.position[m, 1] * cosine - beams.position[m, 0] * sine
        x, y = x + share * along, y + share * across
        xy, xx = xy + share * along * across, xx + share * across * across
    if beams.centred:  # but for rounding
        x = y = 0.0
    spread = max(xx - y * y, 1e-12)
    std = bearing_std(over, wave / beams.speed_of_sound, 12.0 * spread)
    std = min(math.hypot(std, math.sqrt(square)), UNKNOWN)
    row[1], row[2], row[3] = wrap_angle(bearing), top, std
    aside = abs(y) / beams.speed_of_sound * std  # by the microphones' distance from the centre
    row[4] = math.hypot(math.hypot(late[0], aside), late[1])
    row[5] = math.atan((xy - x * y) / spread)


@kernel
def _rows(
    slow: Complex[np.ndarray, "l k"],
    margin: Whole,
    peaks: Int[np.ndarray, " m"],
    wide: Wide,
    call: _Call,
) -> Float[np.ndarray, "6 m"]:
    """Return delay, bearing, power and standard deviations of the wideband call at each peak.

    The lag is not yet the peak's, and another of several nearly equal lobes may be the loudest at
    its own time: the top of each is computed. `slow` has silent margins.
    """
    beams, band = wide.beams, wide.band
    numbers, power = np.empty((6, peaks.size)), np.empty(beams.bearing.size)
    lobes = np.empty((4, power.size))
    wave = math.hypot(2.0 * math.pi * band.centre, band.spread)
    for i in range(peaks.size):
        at = float(margin + peaks[i])
        for n in range(power.size):
            power[n] = _power(slow, at, beams.bearing[n], beams, call)
        best, _ = _lobes(slow, at, power, LOBE * power.max(), 0.0, beams, call, lobes)
        at = min(max(lobes[0, best], float(margin)), float(slow.shape[0] - margin - 1))
        bearing, top, step = lobes[1, best], lobes[2, best], lobes[3, best]
        _, energy, _ = _output(slow, at, bearing, beams, call)
        over = over_noise(top, energy, beams.weight.size, beams.loudest_noise)
        noise = top / (over + 1.0)
        for n in range(power.size):
            power[n] = _power(slow, at, beams.bearing[n], beams, call)
        faintest = 0.8 * top - RARE * noise
        _, count = _lobes(slow, at, power, faintest, step, beams, call, lobes)
        square = _ambiguity(bearing, top, noise, lobes[:, :count], -1, 4.0 * step)
        late = math.sqrt(0.5 * (1.0 + 1.0 / over) / over) / band.spread, wide.doppler_std
        _write_row((bearing, top, over), wave, square, late, beams, numbers[:, i])
        numbers[0, i] = (at - margin) * call.interval
    return numbers


@kernel
def _find(
    matched: Complex[np.ndarray, "c l k"], margin: Whole, circle: Circle, lag: Lags
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, "6 m"]]:
    """Return caller, delay, bearing and power of detected tones; `matched` is zero-padded."""
    beams, pulse, tones = circle.beams, lag.pulse, matched.shape[0]
    stride, count, last = max(pulse // STRIDES, 1), 0, matched.shape[1] - margin - 1
    loudness = np.empty(((matched.shape[1] - 2 * margin + stride - 1) // stride, tones))
    calls = [_Call(f, pulse, lag.interval, np.empty((0, 0))) for f in circle.tones]
    tables = [_table(call, beams) for call in calls]
    for p in range(tones):
        _scan(matched[p], margin, stride, tables[p], circle.threshold, loudness[:, p])
    flat, power = loudness.reshape(-1), np.empty(beams.bearing.size)
    tests = candidates(flat, circle.threshold, tones)
    caller, numbers = np.empty(tests.size, dtype=np.int64), np.empty((6, tests.size))
    lobes, step = np.empty((4, power.size)), 2.0 * math.pi / power.size
    for test in tests:
        begin, end = snapshot(
            flat, test, tones, tones, pulse // stride, False, circle.threshold, circle.leakage
        )
        if begin == end:
            continue
        p, b = test % tones, margin + begin * stride
        sound, call, at, best, found = matched[p], calls[p], float(b), 0, 0
        for _ in range(2):  # again at the refined time
            _powers(sound, b, tables[p], power)
            top = power.argmax()
            _, energy, _ = _output(sound, at, beams.bearing[top], beams, call)
            over = over_noise(power[top], energy, beams.weight.size, beams.loudest_noise)
            faintest = 0.9 * power[top] - RARE * power[top] / (over + 1.0)
            best, found = _lobes(sound, at, power, faintest, step, beams, call, lobes)
            at = _start(sound, b, lobes[1, best], beams, call, (margin, last))
            b = min(max(round(at), margin), last)
        caller[count] = p
        bearing, loudest = lobes[1, best], lobes[2, best]
        _, energy, least = _output(sound, at, bearing, beams, call)
        over = over_noise(loudest, energy / least, beams.weight.size, beams.loudest_noise)
        square = _ambiguity(bearing, loudest, loudest / (over + 1.0), lobes[:, :found], best, 0.0)
        late = lag.interval * delay_std(over, pulse), 0.0
        wave = 2.0 * math.pi * call.frequency
        _write_row((bearing, loudest, over), wave, square, late, beams, numbers[:, count])
        numbers[0, count] = lag.start + lag.interval * (at - margin)
        count += 1
    return caller[:count], numbers[:, :count]


@no_alloc
def _start(
    matched: Complex[np.ndarray, "l k"],
    b: Whole,
    bearing: float,
    beams: Beams,
    call: _Call,
    within: tuple[Whole, Whole],
) -> float:
    """Return the start of a tone in a beam, near lag b, as a fractional lag.

    It is the loudest in units of the noise (`matched.arrival_lag` for outputs at whole lags).
    `within`: the first and last lag.
    """
    reach, best, loudest = reach_of(call.pulse), float(b), -1.0
    for near in range(max(b - reach, within[0]), min(b + reach, within[1]) + 1):
        power = _power(matched, float(near), bearing, beams, call)
        if power > loudest:
            best, loudest = float(near), power
    centre = best
    for part in range(-DIVISIONS, DIVISIONS + 1):
        power = _power(matched, centre + part / DIVISIONS, bearing, beams, call)
        if power > loudest:
            best, loudest = centre + part / DIVISIONS, power
    step = 0.5 / DIVISIONS
    while step > FINEST:
        for side in (best - step, best + step):
            power = _power(matched, side, bearing, beams, call)
            if power > loudest:
                best, loudest = side, power
        step *= 0.5
    return best


@kernel
def _beam(
    matched: Complex[np.ndarray, "l k"],
    first: Whole,
    bearing: float,
    beams: Beams,
    call: _Call,
    beam: Complex[np.ndarray, " r"],
) -> None:
    """Write a beam's outputs at consecutive lags, in units of noise, in phase with the first."""
    turn = 2.0 * math.pi * call.frequency * call.interval
    for k in range(beam.size):
        z, _, noise = _output(matched, float(first + k), bearing, beams, call)
        beam[k] = z * complex(math.cos(turn * k), -math.sin(turn * k)) / math.sqrt(noise)


class _Table(NamedTuple):
    """Lag offsets and factors that sum microphone outputs to a tone's beams at whole lags."""

    back: Int[np.ndarray, "n k"]
    """Offset from the centre's lag to the first of the two that are interpolated."""
    first: Complex[np.ndarray, "n k"]
    then: Complex[np.ndarray, "n k"]
    """`first` and `then`: factors of the outputs at that lag and the next."""


@kernel
def _table(call: _Call, beams: Beams) -> _Table:
    """Compute each microphone's lag offsets and factors for a tone's beams at whole lags."""
    shape = beams.bearing.size, beams.weight.size
    back = np.empty(shape, dtype=np.int64)
    first, then = np.empty(shape, dtype=np.complex128), np.empty(shape, dtype=np.complex128)
    for i in range(shape[0]):
        ahead, left = math.cos(beams.bearing[i]), math.sin(beams.bearing[i])
        for m in range(shape[1]):
            early = beams.position[m, 0] * ahead + beams.position[m, 1] * left
            early /= beams.speed_of_sound
            k, part, now, after = _delayed(early, 0.0, call.frequency, call.interval)
            back[i, m] = k
            first[i, m] = beams.weight[m] * (1.0 - part) * now
            then[i, m] = beams.weight[m] * part * after
    return _Table(back, first, then)


@no_alloc
def _powers(
    matched: Complex[np.ndarray, "l k"], b: Whole, table: _Table, power: Float[np.ndarray, " n"]
) -> None:
    """Write the power of every beam at a whole lag."""
    for i in range(power.size):
        z = 0.0j
        for m in range(matched.shape[1]):
            k = b + table.back[i, m]
            z += table.first[i, m] * matched[k, m] + table.then[i, m] * matched[k + 1, m]
        power[i] = z.real * z.real + z.imag * z.imag


@kernel
def _scan(
    matched: Complex[np.ndarray, "l k"],
    margin: Whole,
    stride: Whole,
    table: _Table,
    threshold: float,
    loudness: Float[np.ndarray, " s"],
) -> None:
    """Write the largest beam power of a tone at every `stride`-th lag; 0 if energy is too low."""
    square, power = _largest_near(matched, margin), np.empty(len(table.back))
    for s in range(len(loudness)):
        b, energy = margin + s * stride, 0.0
        for m in range(square.shape[1]):
            energy += square[b, m]
        loudness[s] = 0.0
        if energy >= threshold:
            _powers(matched, b, table, power)
            loudness[s] = power.max()


@kernel
def _largest_near(matched: Complex[np.ndarray, "l k"], margin: Whole) -> Float[np.ndarray, "l k"]:
    """Return the largest squared output of each microphone within a margin of each lag."""
    lags, microphones = matched.shape
    square = np.zeros((lags, microphones))
    for m in range(microphones):
        for b in range(lags):
            level = (
                matched[b, m].real * matched[b, m].real + matched[b, m].imag * matched[b, m].imag
            )
            for near in range(max(b - margin, 0), min(b + margin + 1, lags)):
                square[near, m] = max(square[near, m], level)
    return square


def _loudness(
    matched: Complex[np.ndarray, "l k"], wide: Wide, interval: float
) -> Float[np.ndarray, " l"]:
    """Return the power of the loudest beam at each lag of a wideband call's outputs."""
    from scipy.fft import fft, ifft, next_fast_len

    lags, beams = len(matched), wide.beams
    count = next_fast_len(lags + 2 * _margin(beams, interval))
    spectrum = np.ascontiguousarray(fft(matched, count, axis=0).T, dtype=np.complex128)
    length = count * interval
    first, last = math.ceil(wide.band.low * length), math.floor(wide.band.high * length)
    toward = np.stack((np.cos(beams.bearing), np.sin(beams.bearing)))
    early = (beams.position @ toward).T / beams.speed_of_sound
    loudness = np.zeros(lags)
    for start in range(0, len(early), BEAMS_AT_ONCE):
        some = early[start : start + BEAMS_AT_ONCE]
        spectra = np.zeros((len(some), count), dtype=np.complex64)
        _steer(spectrum, some, beams.weight, first, last, 1.0 / length, spectra)
        sound = ifft(spectra, axis=1, overwrite_x=True)[:, :lags]
        np.maximum(loudness, np.max(sound.real**2 + sound.imag**2, axis=0), out=loudness)
    return loudness


@kernel
def _steer(
    spectrum: Complex[np.ndarray, "k n"],
    early: Float[np.ndarray, "b k"],
    weight: Float[np.ndarray, " k"],
    first: Whole,
    last: Whole,
    step: float,
    beams: Complex[np.ndarray, "b n"],
) -> None:
    """Write spectra of delay-and-sum beams from the microphones' spectra, in a frequency band."""
    count = spectrum.shape[1]
    total = np.empty(last - first + 1, dtype=np.complex128)
    for b in range(early.shape[0]):
        total[:] = 0.0
        for m in range(weight.size):
            turn = -2.0 * math.pi * early[b, m] * step
            phase = weight[m] * complex(math.cos(turn * first), math.sin(turn * first))
            turned = complex(math.cos(turn), math.sin(turn))
            for i in range(total.size):
                total[i] += phase * spectrum[m, (first + i) % count]
                phase *= turned
        for i in range(total.size):
            beams[b, (first + i) % count] = total[i]


def _lobes_of(call: Call, wide: Wide, step: int, rate: float) -> Float[np.ndarray, " l"]:
    """Return a call's highest side lobes by lag from its peak, relative to the peak's power."""
    interval, sent, beams = step / rate, replica(call, rate), wide.beams
    reach = math.ceil(sent.size / step) + 2 * _margin(beams, interval)
    count, most, length = 4 * reach, np.zeros(reach), 4 * reach * interval
    bins = np.arange(math.ceil(wide.band.low * length), math.floor(wide.band.high * length) + 1)
    own, place = np.fft.fft(sent, step * count)[bins], (bins / length)[:, np.newaxis]
    facing = wide.normal if not math.isnan(wide.normal) else 0.0
    for scale in (1.0 - SHIFT, 1.0, 1.0 + SHIFT):
        power = np.fft.fft(replica(call, rate, scale), step * count)[bins] * own.conj()
        for angle in _ANGLES:
            toward = np.array([math.cos(facing + angle), math.sin(facing + angle)])
            early = beams.position @ toward / beams.speed_of_sound
            delayed = np.exp(2j * np.pi * place * (early - 0.5 * length)) * beams.weight
            heard = np.zeros((count, beams.weight.size), dtype=complex)
            heard[bins % count] = power[:, np.newaxis] * delayed
            loudness = _loudness(np.fft.ifft(heard, axis=0), wide, interval)
            peak = int(loudness.argmax())
            around = np.maximum(loudness[peak : peak + reach], loudness[peak : peak - reach : -1])
            most = np.maximum(most, around / loudness[peak])
    return MARGIN * np.maximum.accumulate(most[::-1])[::-1]


def _cut_lobes_of(call: Call, wide: Wide, step: int, rate: float) -> Float[np.ndarray, "s l"]:
    """Return the highest relative side lobes of a call that is only partly recorded, by lag.

    A row for each share of the call that is missing, at its beginning or its end. A beam sums the
    microphones' outputs, each displaced by the error of the beam's delay, two margins at most: away
    from its peak it is no louder than the loudest of them.
    """
    sent = replica(call, rate)
    margin = 2 * _margin(wide.beams, step / rate)
    reach, count = math.ceil(sent.size / step), 8 * sent.size
    most = np.ones((PARTS_CUT + 1, reach + margin))
    frequency = np.arange(count) * rate / count
    own = np.fft.fft(sent, count).conj()
    own[(frequency < wide.band.low) | (frequency > wide.band.high)] = 0.0
    away = np.minimum(np.arange(count), count - np.arange(count)) // step
    for row, part in enumerate([*range(PARTS_CUT), PARTS_CUT - 0.5]):
        missing, left = round(part / PARTS_CUT * sent.size), np.zeros(away.max() + 1)
        for gone in (slice(missing), slice(sent.size - missing, None)):
            heard = sent.copy()
            heard[gone] = 0.0
            power = np.abs(np.fft.ifft(np.fft.fft(heard, count) * own)) ** 2
            if power[0] > 0.0:  # a file may end in silence
                np.maximum.at(left, away, power / power[0])
        most[row, margin:] = np.maximum.accumulate(left[::-1])[::-1][:reach]
    return MARGIN * np.maximum(most[:-1], most[1:])


@kernel
def _peaks(
    loudness: Float[np.ndarray, " l"],
    threshold: float,
    lobes: Float[np.ndarray, " r"],
    cut_lobes: Float[np.ndarray, "s q"],
    cut: Whole,
) -> Int[np.ndarray, " m"]:
    """Return lags of loudness peaks above the side lobes of all louder peaks, the loudest first.

    At the `cut` lags of either end, calls are only partly in the record. Loudness is periodic, as
    it comes from a transform. Beyond a table, lobes fall with the square of the distance.
    """
    peaks, count = np.empty(loudness.size, dtype=np.int64), 0
    for b in range(loudness.size):
        before = loudness[b - 1] if b > 0 else -1.0
        after = loudness[b + 1] if b + 1 < loudness.size else -1.0
        if loudness[b] > threshold and loudness[b] > before and loudness[b] >= after:
            peaks[count] = b
            count += 1
    order = np.argsort(-loudness[peaks[:count]])
    kept = 0
    found = np.empty(count, dtype=np.int64)
    for i in order:
        b, left = peaks[i], 0.0
        for k in range(kept):
            away = abs(found[k] - b)
            away = min(away, loudness.size - away)
            missing = max(cut - found[k], found[k] - (loudness.size - cut - 1))
            table = lobes
            if missing > 0:
                table = cut_lobes[min(missing * len(cut_lobes) // cut, len(cut_lobes) - 1)]
            last = table.size - 1
            share = table[away] if away <= last else table[last] * (last / away) ** 2
            left += math.sqrt(share * loudness[found[k]])
        if loudness[b] > left * left:
            found[kept] = b
            kept += 1
    return found[:kept]
