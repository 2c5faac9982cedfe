r"""Wideband calls, such as sweeps: detected by beams steered with true delays over the whole band.

For a sweep, the distance between two microphones changes the envelope's time as well as the phase:
over 44 mm, 0.13 ms, the matched output of a band of 25 kHz falls off three times. So beams are
steered by delays, frequency by frequency. With Y the spectrum of microphone m's matched output and
:math:`a_m = p_m \cdot u(\phi) / c` its lead over the group's middle,

.. math:: Z(\phi, f) = \sum_m w_m e^{-2\pi i f a_m(\phi)} Y_m(f) , \qquad
          w_m = g_m \Big/ \sqrt{\textstyle\sum g^2} ,

and z is its inverse transform. Near a peak, z is interpolated in time and direction by a windowed
sinc that preserves the band.

**Loudness** of a lag is the largest :math:`|z|^2` over the directions of the scan. In noise of unit
variance it exceeds h at one lag, whatever the call, with a probability of at most

.. math:: P \le e^{-h} \left(1 + \sqrt{\frac{h}{\pi}} \int \sqrt{\kappa}\, d\phi \right), \qquad
          \kappa = \left(\frac{2\pi f_{rms}}{c}\right)^2
                   \sum_m w_m^2 (p_m \cdot u')^2, \qquad f_{rms}^2 = f_c^2 + (\beta / 2\pi)^2 ,

as in `pipistrelle.detection.full_circle`, with the band's root mean square frequency. Lags are
spaced by half the inverse of the widest band (`acoustics.call.lag_step`), and the noise of two is
correlated as the call's autocorrelation.

**One call, one detection.** A loud call leaves lobes at other lags: of its autocorrelation, and of
beams to other directions, in which some microphones' peaks come too early. A peak counts only if it
exceeds the sum of the amplitudes that all louder peaks may leave there, computed in advance as the
scan's response to the call, from several directions and with Doppler shifts, plus 3 dB.

**Calls only partly in the record**, as the vehicle is deaf while it calls, are peaks at lags before
its first or after its last. Their skirts reach into the record, wider than a whole call's, as the
received part has less of the band; and outputs that begin or end amid a peak are a step, which a
transform spreads over all lags. So if a loud peak is near an end, outputs are computed a call's
length beyond both ends, of samples padded with silence; peaks there mask the most that their cut
call may leave, and are not detections themselves.

**Standard deviations.** With the power over the noise p of the beam
(`pipistrelle.detection.noise`),

.. math:: \sigma_\phi^2 = \frac{1 + 1/p}{2 p \kappa}, \qquad
          \sigma_\tau^2 = \frac{1 + 1/p}{2 p \beta^2} + \left(\delta \, \frac{2 v}{c}\right)^2 / 2 ,

the Cramer-Rao bounds with an unknown phase, and the delay error of a sweep by an unknown Doppler
shift: the echo may come from any direction, to a vehicle at the speed v of the settings, and the
mean square cosine of a direction is a half. No delay is corrected for it.

Sources: Van Trees, Optimum Array Processing (2002), Secs. 6.13 and 8.4; Davies, Biometrika 74
(1987).
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
from pipistrelle.detection.direct import Lags
from pipistrelle.detection.full_circle import (
    BEAM_STEP,
    CLIMBS,
    RARE,
    loudest_by_chance,
    margin_of,
    moved,
)
from pipistrelle.detection.noise import bearing_std, loudest_noise, over_noise
from pipistrelle.geometry import wrap, wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

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


class Wide(NamedTuple):
    """The detector of a wideband call in a group of microphones."""

    threshold: float
    """Least loudness of a call at a lag, in units of the noise of one output."""
    loudest_noise: float
    """See `noise.loudest_noise`."""
    sine_limit: float
    """Sine of the largest angle off the normal that counts; 2 for an omnidirectional group."""
    normal: float
    """Normal of a line on a face [rad]; NaN for an omnidirectional group."""
    bearing: Float[np.ndarray, " n"]
    """Directions that are scanned [rad]."""
    position: Float[np.ndarray, "k 2"]
    """Positions of the microphones, relative to their middle [m]."""
    middle: Float[np.ndarray, "2"]
    """Middle of the microphones, in the vehicle's frame [m]."""
    weight: Float[np.ndarray, " k"]
    """Weight of each output; the squares of all sum to 1."""
    speed_of_sound: float
    band: Band
    doppler_std: float
    """Standard deviation of a delay, by the call's Doppler shift [s]."""
    lobes: Float[np.ndarray, " l"]
    """Largest share of its power that a call leaves at each distance from its peak, in lags."""
    cut_lobes: Float[np.ndarray, "s l"]
    """The `lobes` of calls only partly in the record, a row for each missing share."""


def wide_of(
    config: Config, layout: Layout | Scattered, group: int, calls: Sequence[Call], caller: int
) -> Wide:
    """Build the detector of a wideband call for a face, or another group."""
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
        loudest_noise=loudest_noise(weight.size),
        sine_limit=2.0 if around else math.sin(math.radians(config.detection.angle_limit_deg)),
        normal=normal,
        bearing=np.interp(even, looks, fine)[: count or None],
        position=position,
        middle=middle,
        weight=weight,
        speed_of_sound=c,
        band=band,
        doppler_std=abs(coupling(calls[caller])) * moving,
        lobes=np.empty(0),
        cut_lobes=np.empty((0, 0)),
    )
    step = lag_step(calls, rate)
    lobes = _lobes_of(calls[caller], wide, step, rate)
    cut = _cut_lobes_of(calls[caller], wide, step, rate)
    return wide._replace(lobes=lobes, cut_lobes=cut)


def find_wide(
    matched: Complex[np.ndarray, "l k"],
    wide: Wide,
    lags: Lags,
    around: Callable[[], Complex[np.ndarray, "n k"]] | None = None,
) -> tuple[Float[np.ndarray, "6 m"], Bool[np.ndarray, " m"]]:
    """Detect the wideband calls at a group, at most one at each time.

    `around`: returns the outputs also at lags at which a call is only partly in the record, equally
    many at each end; called if a loud peak is near an end. Returns delay at the vehicle's centre
    [s], bearing [rad], power, the standard deviations of bearing and delay, and the angle off a
    face's normal, or for other groups the arctangent of the bearing's slope in the logarithm of the
    speed of sound; and a mask of the calls that are wholly in the record.
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
    silence = np.zeros(
        (TAPS + margin_of(wide.position, wide.speed_of_sound * lags.interval), matched.shape[1]),
        complex,
    )
    slow = np.concatenate((silence, matched * turn[:, np.newaxis], silence))
    numbers = _rows(slow, len(silence), peaks, wide, lags.interval, _SINC)
    delay, bearing = numbers[:2]
    ahead = wide.middle[0] * np.cos(bearing) + wide.middle[1] * np.sin(bearing)
    numbers[0] = lags.start + delay + ahead / wide.speed_of_sound
    numbers[0] -= cut * lags.interval
    whole = (cut <= peaks) & (peaks < len(matched) - cut)
    if math.isnan(wide.normal):
        return numbers, whole
    numbers[5] = wrap(bearing - wide.normal)
    seen = np.abs(np.sin(numbers[5])) <= wide.sine_limit
    return numbers[:, seen], whole[seen]


def _loudness(
    matched: Complex[np.ndarray, "l k"], wide: Wide, interval: float
) -> Float[np.ndarray, " l"]:
    """Return the power of the loudest beam at each lag."""
    from scipy.fft import fft, ifft, next_fast_len

    lags = len(matched)
    count = next_fast_len(lags + 2 * margin_of(wide.position, wide.speed_of_sound * interval))
    spectrum = np.ascontiguousarray(fft(matched, count, axis=0).T, dtype=np.complex128)
    length = count * interval
    first, last = math.ceil(wide.band.low * length), math.floor(wide.band.high * length)
    early = _early(wide)
    loudness = np.zeros(lags)
    for start in range(0, len(early), BEAMS_AT_ONCE):
        some = early[start : start + BEAMS_AT_ONCE]
        beams = np.zeros((len(some), count), dtype=np.complex64)
        _steer(spectrum, some, wide.weight, first, last, 1.0 / length, beams)
        sound = ifft(beams, axis=1, overwrite_x=True)[:, :lags]
        np.maximum(loudness, np.max(sound.real**2 + sound.imag**2, axis=0), out=loudness)
    return loudness


def _early(wide: Wide) -> Float[np.ndarray, "n k"]:
    """Return the lead of each microphone over the middle for each beam [s]."""
    toward = np.stack((np.cos(wide.bearing), np.sin(wide.bearing)))
    return (wide.position @ toward).T / wide.speed_of_sound


def _lobes_of(call: Call, wide: Wide, step: int, rate: float) -> Float[np.ndarray, " l"]:
    """Return the largest share of its power that a call leaves at each lag from its peak."""
    interval, sent = step / rate, replica(call, rate)
    reach = math.ceil(sent.size / step) + 2 * margin_of(
        wide.position, wide.speed_of_sound * interval
    )
    count, most, length = 4 * reach, np.zeros(reach), 4 * reach * interval
    bins = np.arange(math.ceil(wide.band.low * length), math.floor(wide.band.high * length) + 1)
    own, place = np.fft.fft(sent, step * count)[bins], (bins / length)[:, np.newaxis]
    facing = wide.normal if not math.isnan(wide.normal) else 0.0
    for scale in (1.0 - SHIFT, 1.0, 1.0 + SHIFT):
        power = np.fft.fft(replica(call, rate, scale), step * count)[bins] * own.conj()
        for angle in _ANGLES:
            toward = np.array([math.cos(facing + angle), math.sin(facing + angle)])
            early = wide.position @ toward / wide.speed_of_sound
            delayed = np.exp(2j * np.pi * place * (early - 0.5 * length)) * wide.weight
            heard = np.zeros((count, wide.weight.size), dtype=complex)
            heard[bins % count] = power[:, np.newaxis] * delayed
            loudness = _loudness(np.fft.ifft(heard, axis=0), wide, interval)
            peak = int(loudness.argmax())
            around = np.maximum(loudness[peak : peak + reach], loudness[peak : peak - reach : -1])
            most = np.maximum(most, around / loudness[peak])
    return MARGIN * np.maximum.accumulate(most[::-1])[::-1]


def _cut_lobes_of(call: Call, wide: Wide, step: int, rate: float) -> Float[np.ndarray, "s l"]:
    """Return the largest share of power around the peak of a call that is only partly recorded.

    A row for each share of the call that is missing, at its beginning or its end. A beam sums the
    microphones' outputs, each displaced by the error of the beam's delay, two margins at most: away
    from its peak it is no louder than the loudest of them.
    """
    sent = replica(call, rate)
    margin = 2 * margin_of(wide.position, wide.speed_of_sound * step / rate)
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


def _sinc() -> Float[np.ndarray, "p t"]:
    """Return the windowed sinc at positions between two outputs, a row each."""
    away = np.arange(TAPS) - (TAPS // 2 - 1) - np.arange(PARTS + 1)[:, np.newaxis] / PARTS
    window = np.i0(BETA * np.sqrt(np.clip(1.0 - (away / (TAPS // 2)) ** 2, 0.0, None)))
    return np.sinc(away) * window / np.i0(BETA)


_SINC = _sinc()


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
    """Write the spectra of beams, from the first to the last bin, `step` [Hz] wide."""
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


@no_alloc
def _left(lobes: Float[np.ndarray, " r"], away: Whole) -> float:
    """Return the share of a call's power at a distance of lags; extrapolated as 1 / distance^2."""
    last = lobes.size - 1
    return lobes[away] if away <= last else lobes[last] * (last / away) ** 2


@kernel
def _peaks(
    loudness: Float[np.ndarray, " l"],
    threshold: float,
    lobes: Float[np.ndarray, " r"],
    cut_lobes: Float[np.ndarray, "s q"],
    cut: Whole,
) -> Int[np.ndarray, " m"]:
    """Return the lags of peaks that exceed the leakage of all louder ones, the loudest first.

    At the `cut` lags of either end, calls are only partly in the record. Loudness is periodic, as
    it comes from a transform.
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
            if missing > 0:
                row = min(missing * len(cut_lobes) // cut, len(cut_lobes) - 1)
                left += math.sqrt(_left(cut_lobes[row], away) * loudness[found[k]])
            else:
                left += math.sqrt(_left(lobes, away) * loudness[found[k]])
        if loudness[b] > left * left:
            found[kept] = b
            kept += 1
    return found[:kept]


@no_alloc
def _output(
    slow: Complex[np.ndarray, "l k"],
    at: float,
    bearing: float,
    beam: Wide,
    interval: float,
    sinc: Float[np.ndarray, "p t"],
) -> tuple[float, float]:
    """Return the power of the beam to a bearing at a fractional lag, and the energy it sums."""
    ahead, left = math.cos(bearing), math.sin(bearing)
    total, energy = 0.0j, 0.0
    parts = sinc.shape[0] - 1
    for m in range(beam.weight.size):
        early = (beam.position[m, 0] * ahead + beam.position[m, 1] * left) / beam.speed_of_sound
        place = at - early / interval
        k = math.floor(place)
        part = (place - k) * parts
        row = min(int(part), parts - 1)
        share = part - row
        y = 0.0j
        for t in range(sinc.shape[1]):
            weight = (1.0 - share) * sinc[row, t] + share * sinc[row + 1, t]
            y += weight * slow[k - sinc.shape[1] // 2 + 1 + t, m]
        turn = -2.0 * math.pi * beam.band.centre * early
        total += beam.weight[m] * y * complex(math.cos(turn), math.sin(turn))
        energy += y.real * y.real + y.imag * y.imag
    return total.real * total.real + total.imag * total.imag, energy


@no_alloc
def _climb(
    slow: Complex[np.ndarray, "l k"],
    at: float,
    bearing: float,
    step: float,
    beam: Wide,
    interval: float,
    sinc: Float[np.ndarray, "p t"],
) -> tuple[float, float, float]:
    """Climb to the top of a peak near a beam; return its lag, bearing and power."""
    late = 0.5
    for _ in range(CLIMBS):
        here, _ = _output(slow, at, bearing, beam, interval, sinc)
        before, _ = _output(slow, at, bearing - step, beam, interval, sinc)
        after, _ = _output(slow, at, bearing + step, beam, interval, sinc)
        bearing += step * moved(before, here, after)
        here, _ = _output(slow, at, bearing, beam, interval, sinc)
        before, _ = _output(slow, at - late, bearing, beam, interval, sinc)
        after, _ = _output(slow, at + late, bearing, beam, interval, sinc)
        at += late * moved(before, here, after)
        step, late = 0.25 * step, 0.25 * late
    power, _ = _output(slow, at, bearing, beam, interval, sinc)
    return at, bearing, power


@no_alloc
def _top(
    slow: Complex[np.ndarray, "l k"],
    lag: float,
    power: Float[np.ndarray, " n"],
    beam: Wide,
    interval: float,
    sinc: Float[np.ndarray, "p t"],
) -> tuple[float, float, float, float]:
    """Return lag, bearing and power of the loudest peak near a lag, and half the step of its beams.

    The lag is not yet the peak's, and another of several nearly equal lobes may be the loudest at
    its own time: the top of each is computed.
    """
    most, beams, best = power[power.argmax()], power.size, (lag, 0.0, -1.0, 0.0)
    for n in range(beams):
        before = power[n - 1] if n > 0 else -1.0
        after = power[n + 1] if n + 1 < beams else -1.0
        if power[n] >= max(before, after, LOBE * most):
            near = n + 1 if n + 1 < beams else n - 1
            step = 0.5 * abs(wrap_angle(beam.bearing[near] - beam.bearing[n]))
            at, bearing, top = _climb(slow, lag, beam.bearing[n], step, beam, interval, sinc)
            if top > best[2]:
                best = at, bearing, top, step
    return best


@kernel
def _rows(
    slow: Complex[np.ndarray, "l k"],
    margin: Whole,
    peaks: Int[np.ndarray, " m"],
    beam: Wide,
    interval: float,
    sinc: Float[np.ndarray, "p t"],
) -> Float[np.ndarray, "6 m"]:
    """Return the numbers of each peak, its delay from lag 0 [s]; `slow` has silent margins."""
    numbers, beams = np.empty((6, peaks.size)), beam.bearing.size
    power, within = np.empty(beams), (float(margin), float(slow.shape[0] - margin - 1))
    for i in range(peaks.size):
        lag = float(margin + peaks[i])
        for n in range(beams):
            power[n], _ = _output(slow, lag, beam.bearing[n], beam, interval, sinc)
        at, bearing, top, step = _top(slow, lag, power, beam, interval, sinc)
        at = min(max(at, within[0]), within[1])
        _, energy = _output(slow, at, bearing, beam, interval, sinc)
        over = over_noise(top, energy, beam.weight.size, beam.loudest_noise)
        noise = top / (over + 1.0)
        square = _doubles(slow, at, bearing, top, noise, step, beam, interval, sinc)
        spread, slope = _geometry(bearing, beam)
        wave = math.hypot(2.0 * math.pi * beam.band.centre, beam.band.spread)
        std = bearing_std(over, wave / beam.speed_of_sound, 12.0 * spread)
        late = math.sqrt(0.5 * (1.0 + 1.0 / over) / over) / beam.band.spread
        numbers[0, i], numbers[1, i] = (at - margin) * interval, wrap_angle(bearing)
        numbers[2, i], numbers[3, i] = top, min(math.hypot(std, math.sqrt(square)), UNKNOWN)
        numbers[4, i], numbers[5, i] = math.hypot(late, beam.doppler_std), math.atan(slope)
    return numbers


@no_alloc
def _doubles(
    slow: Complex[np.ndarray, "l k"],
    at: float,
    bearing: float,
    top: float,
    noise: float,
    step: float,
    beam: Wide,
    interval: float,
    sinc: Float[np.ndarray, "p t"],
) -> float:
    """Return the mean square bearing difference to other lobes, weighted by their odds."""
    odds, square, beams = 0.0, 0.0, beam.bearing.size
    last = here = -1.0
    for n in range(beams + 1):
        after = -1.0
        if n < beams:
            after, _ = _output(slow, at, beam.bearing[n], beam, interval, sinc)
        if n > 0 and here > last and here >= after and here >= 0.8 * top - RARE * noise:
            _, other, power = _climb(slow, at, beam.bearing[n - 1], step, beam, interval, sinc)
            off = wrap_angle(other - bearing)
            if abs(off) > 4.0 * step:
                share = math.exp(min(power - top, 0.0) / noise)
                odds, square = odds + share, square + share * off * off
        last, here = here, after
    return square / (1.0 + odds)


@no_alloc
def _geometry(bearing: float, beam: Wide) -> tuple[float, float]:
    """Return the positions' variance across a bearing [m^2], and the bearing's slope in log c."""
    cosine, sine = math.cos(bearing), math.sin(bearing)
    xx = xy = 0.0
    for m in range(beam.weight.size):
        share = beam.weight[m] * beam.weight[m]
        along = beam.position[m, 0] * cosine + beam.position[m, 1] * sine
        across = beam.position[m, 1] * cosine - beam.position[m, 0] * sine
        xy, xx = xy + share * along * across, xx + share * across * across
    spread = max(xx, 1e-12)
    return spread, xy / spread
