r"""Calls at microphones in any positions, and calls that are not tones, by delay-and-sum beams.

Microphone m, at p_m, receives a wave from the direction :math:`\phi` earlier than the centre by
:math:`a_m = p_m \cdot u(\phi) / c`. A beam is the sum of the delayed matched outputs y over lags t,

.. math:: z(\phi, t) = \sum_m w_m e^{-2\pi i f a_m} y_m(t - a_m), \qquad
          w_m = g_m \Big/ \sqrt{\textstyle\sum g^2} ,

so that the call's whole band adds up, however wide the array is. Between lags, the envelope of a
tone is interpolated linearly, as its matched output is a triangle; of another call by a windowed
sinc that preserves the band. For a sweep, the distance between two microphones changes the
envelope's time as well as the phase: over 44 mm, 0.13 ms, the matched output of a band of 25 kHz
falls off three times.

**Search.** No beam is louder than the sum of its microphones' moduli,

.. math:: |z(\phi, t)| \le \sum_m w_m |y_m(t - a_m)| ,

which is computed for all beams of a sector at once, as their delays are equal to half a lag. Beams
are summed only at lags at which it reaches the threshold: in noise, a thirtieth. Half lags lose a
little of a call, and leave out noise: beams that this may have hidden are summed by exact delays.

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

**Beginning of a sweep.** An echo soon after a caller's direct call displaces its peak, or is itself
the peak. So two calls are fitted to the beam's output z about the peak, by greatest likelihood:

.. math:: \ln p(\tau_1, \tau_2) = y^H G^{-1} y + \text{const}, \quad
          y = (z(\tau_1), z(\tau_2))^T, \quad
          G = \begin{bmatrix} 1 & r(\tau_1 - \tau_2) \\ r(\tau_2 - \tau_1) & 1 \end{bmatrix} ,

with the call's autocorrelation r, which is both the shape of an arrival and the covariance of the
noise. Where two explain more than one by the threshold of a detection, the direct call begins at
:math:`\tau_1`, with the variance by this likelihood's curvature and that of the search grid.

**Ambiguous bearings.** If other lobes of the scan are nearly as loud as the loudest, as the mirror
image for a line of microphones, or for spacings above half a wave, the call may have come from
there. With a flat prior the odds are the likelihood ratios, and the stated variance is

.. math:: \sigma^2 = \sigma_\phi^2 + \frac{\sum_k o_k (\phi_k - \phi)^2}{1 + \sum_k o_k}, \qquad
          o_k = e^{-(|z|^2 - |z_k|^2) / \eta} ,

with :math:`\eta` the noise.

**Detections.** A tone has a single detection within half its length. Another loud call leaves lobes
at other lags: of its autocorrelation, and of beams to other directions, where some microphones'
peaks come too early. A peak counts only if it exceeds the sum of the amplitudes that all louder
peaks may leave there, computed in advance as the scan's response to the call, from several
directions and with Doppler shifts, plus 3 dB.

**Calls only partly in the record**, as the vehicle is deaf while it calls, are peaks at lags before
its first or after its last. Their skirts reach into the record, wider than a whole call's, as the
received part has less of the band; and outputs that begin or end amid a peak are a step, which a
transform spreads over all lags. So outputs are computed a call's length beyond both ends, as if
silence surrounded the record; peaks there mask the most that their cut call may leave, and are not
detections themselves.

Sources: Rice, Bell System Technical Journal 24 (1945), and Davies, Biometrika 74 (1987), for the
crossings; Van Trees, Optimum Array Processing (2002), Secs. 2.2, 6.13 and 8.4, for delay and sum
and the bound.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import (
    Band,
    Call,
    ToneBurst,
    band_of,
    bins_of,
    carrier_of,
    coupling,
    replica,
    window_lags,
)
from pipistrelle.arrays.beamforming import UNKNOWN, spread_towards
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.config import Config
from pipistrelle.detection.direct import MIN_EDGE_ENERGY_OF_BEAM, front_edge
from pipistrelle.detection.matched import reach_of
from pipistrelle.detection.noise import (
    CHUNK,
    NOISE_QUANTILE,
    bearing_std,
    delay_std,
    loudest_noise,
    over_noise,
)
from pipistrelle.geometry import wrap, wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

BEAM_STEP = 0.4
"""Root mean square phase between two beams over the microphones [rad]: 4 % loss halfway."""
CLIMBS = 4
"""Steps of the climb to the top of a lobe, each by a parabola, a quarter as wide as the last."""
DIVISIONS = 8
"""Divisions of a lag in the search for the start of a tone."""
PAIR_STEP = 0.2
"""Step of the search for two calls that overlap, in the inverse of the band's spread [rad]."""
FINEST = 1e-4
"""Smallest step of the search, in lags."""
RARE = 20.0
"""Lobes this many noise powers below the loudest are ignored: odds of 1 to 5e8, which add 0.15 mrad
at most to a standard deviation."""
TAPS, PARTS, BETA = 12, 256, 8.0
"""Windowed sinc: number of taps, positions between two outputs, shape of its Kaiser window."""
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
    """Directions that are scanned, off the normal of a line on a face [rad]."""
    position: Float[np.ndarray, "k 2"]
    """Positions of the microphones, relative to the beams' centre and the normal [m]."""
    weight: Float[np.ndarray, " k"]
    """Weight of each output; the squares of all sum to 1."""
    speed_of_sound: float
    loudest_noise: float
    """See `noise.loudest_noise`."""


class _Call(NamedTuple):
    """Frequency, length and interpolation between lags of a call's matched-filter outputs."""

    frequency: float
    """Of a tone, or carrier of the band, which is 0 in the outputs [Hz]."""
    tone: bool
    pulse: int
    """Lags in a tone."""
    interval: float
    """Between two lags [s]."""
    taps: Float[np.ndarray, "p t"]
    """Weights of the nearest outputs, for positions between two; of a tone, those two."""


class Wide(NamedTuple):
    """The detector of a call in a group of microphones."""

    threshold: float
    """Least loudness of a call at a lag, in units of an output's noise."""
    sine_limit: float
    """Sine of the largest angle off the normal that counts; 2 for an omnidirectional group."""
    normal: float
    """Normal of a line on a face [rad]; 0 for an omnidirectional group."""
    middle: Float[np.ndarray, "2"]
    """Middle of the microphones, the beams' centre, relative to the normal [m]."""
    call: _Call
    band: Band
    doppler_std: float
    """Standard deviation of a delay, by the call's Doppler shift [s]."""
    beams: Beams
    begin: Int[np.ndarray, " q"]
    """First beam of each sector, in which delays are equal to half a lag, and the beams' number."""
    late: Int[np.ndarray, "s k"]
    """Lag of a sector at each microphone, less the centre's, in half lags."""
    noise_std: Float[np.ndarray, " s"]
    """Standard deviation of a sector's noise, as half lags are means of two."""
    phases: Float[np.ndarray, "2 k n"]
    """Factor of each microphone, for each beam: real and imaginary parts."""
    margin: int
    """Upper bound of any microphone's time lead over the beams' centre, in lags."""
    loss: float
    """Least power of a call from a beam's direction, relative to the sum by exact delays."""
    slack: float
    """Amplitude that noise adds by exact delays, in all but a thousandth of cases."""
    lobes: Float[np.ndarray, " l"]
    """Largest share of its power that a call leaves at each distance from its peak, in lags."""
    cut_lobes: Float[np.ndarray, "s l"]
    """The `lobes` of calls only partly in the record, a row for each missing share."""
    alike: Complex[np.ndarray, " a"]
    """Autocorrelation of a sweep, from 0 to 2 pi in steps of `PAIR_STEP`; empty for a tone."""


def wide_of(config: Config, layout: Layout | Scattered, group: int, call: Call, step: int) -> Wide:
    """Build the detector of a call for the microphones of a face or another group.

    `step`: samples between two outputs.
    """
    rate, c = config.receiver.sample_rate, config.assumed_sound_speed
    normal, (place, gain) = float(layout.normal[group]), layout.places(group)
    weight, around = gain / np.linalg.norm(gain), math.isnan(normal)
    turn = 0.0 if around else normal
    place = place @ np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    middle = weight**2 @ place
    position = place - middle
    band, tone = band_of(call, rate), isinstance(call, ToneBurst)
    limit = math.pi if around else math.radians(config.detection.scan_limit_deg)
    fine = np.linspace(-limit, limit, 3601 if around else 1801)
    wave = math.hypot(2.0 * np.pi * band.centre, band.spread) / c
    slope = wave * np.sqrt(spread_towards(fine, position, weight))
    looks = np.concatenate(([0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(fine))))
    count = max(math.ceil(looks[-1] / BEAM_STEP), 8) + (0 if around else 1)
    even = np.linspace(0.0, looks[-1], count + 1 if around else count)
    moving = 2.0 * abs(config.scenario.speed) / c / math.sqrt(2.0)
    bearing, noise = np.interp(even, looks, fine)[:count], loudest_noise(weight.size)
    beams = Beams(bearing, position, weight, c, noise)
    interval, pulse = step / rate, max(round(call.duration * rate / step), 1)
    carrier = call.frequency if tone else carrier_of(band, interval)
    wide = Wide(
        threshold=loudest_by_chance(config.detection.false_alarm, looks[-1], weight.size),
        sine_limit=2.0 if around else math.sin(math.radians(config.detection.angle_limit_deg)),
        normal=turn,
        middle=middle,
        call=_Call(carrier, tone, pulse, interval, _LINEAR if tone else _SINC),
        band=band,
        doppler_std=abs(coupling(call)) * moving,
        beams=beams,
        **_sectors_of(call, beams, carrier, interval, rate),
        lobes=np.append(np.ones(pulse // 2 + round(2.0 * _lead(beams, interval)) + 1), 0.0),
        cut_lobes=np.ones((1, 1)),
        alike=np.empty(0, dtype=np.complex128),
    )
    if tone:
        return wide
    apart = np.arange(0.0, 2.0 * math.pi, PAIR_STEP) / band.spread
    wide = wide._replace(alike=_alike(call, rate, carrier, apart))
    lobes, cut = _lobes_of(call, wide, step, rate), _cut_lobes_of(call, wide, step, rate)
    return wide._replace(lobes=lobes, cut_lobes=cut)


def _leads(beams: Beams, bearing: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
    """Return each microphone's time lead over the centre, for sound from given bearings [s]."""
    toward = np.column_stack((np.cos(bearing), np.sin(bearing)))
    return toward @ beams.position.T / beams.speed_of_sound


def _alike(
    call: Call, rate: float, carrier: float, delay: Float[np.ndarray, " t"]
) -> Complex[np.ndarray, " t"]:
    """Return the autocorrelation of a call's envelope at given delays [s], 1 at 0."""
    band, sent = band_of(call, rate), replica(call, rate)
    frequency = np.arange(2 * sent.size) * rate / (2 * sent.size)
    inside = (frequency >= band.low) & (frequency <= band.high)
    power = np.abs(np.fft.fft(sent, frequency.size)[inside]) ** 2
    turn = 2.0 * np.pi * (frequency[inside] - carrier)
    return np.exp(1j * np.outer(delay, turn)) @ (power / np.sum(power))


def _sectors_of(
    call: Call, beams: Beams, carrier: float, interval: float, rate: float
) -> dict[str, Any]:
    """Divide a call's beams into sectors within which no delay differs by half a lag."""
    early, begin = _leads(beams, beams.bearing), [0]
    for n in range(len(early)):
        if np.ptp(early[begin[-1] : n + 1], axis=0).max() > 0.5 * interval:
            begin.append(n)
    size = np.diff([*begin, len(early)])
    late = -np.rint(2.0 * np.add.reduceat(early, begin) / interval / size[:, np.newaxis])
    off = np.linspace(-2.0, 2.0, 4 * PARTS + 1)
    alike = _alike(call, rate, carrier, interval * off)
    between = 0.5 * (np.interp(off - 0.5, off, alike) + np.interp(off + 0.5, off, alike))
    odd, sector = late % 2.0 != 0.0, np.repeat(np.arange(size.size), size)
    share = np.where(odd, 0.5 * (1.0 + np.interp(1.0, off, alike).real), 1.0)
    noise_std, error = np.sqrt(share @ beams.weight**2), 0.5 * late[sector] + early / interval
    left = np.where(odd[sector], np.interp(error, off, between), np.interp(error, off, alike))
    left = np.abs(left @ beams.weight**2) / noise_std[sector]
    loss = float(np.min(left**2))
    phases = (beams.weight * np.exp(-2j * np.pi * carrier * early)).T
    return {
        "begin": np.array([*begin, len(early)]),
        "late": late.astype(np.int64),
        "noise_std": noise_std,
        "phases": np.stack((phases.real, phases.imag)).astype(np.float32),
        "margin": math.ceil(_lead(beams, interval)) + 2,
        "loss": loss,
        "slack": math.sqrt((loss - 1.0) * math.log(1.0 - NOISE_QUANTILE)),
    }


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


def edge_around(
    matched: Complex[np.ndarray, "k l"], wide: Wide, b: int, bearing: float
) -> tuple[float, float]:
    """Return start and std of a direct call [lags] in the beam to its bearing; NaN if not found.

    Of a tone by `front_edge`; of a sweep by two calls, if they fit better than one.
    """
    pulse, more, bearing = wide.call.pulse, wide.margin + TAPS, bearing - wide.normal
    if wide.call.tone:
        step, before, after = 1.0, 3 * pulse, pulse - 1
    else:
        step = PAIR_STEP / (wide.band.spread * wide.call.interval)
        before = after = math.ceil(step * wide.alike.size)
    low, high = max(b - before, 0), min(b + after, matched.shape[1] - 1)
    sound = np.empty((len(matched), high - low + 1 + 2 * more), dtype=np.complex64)
    _cut_out(np.ascontiguousarray(matched, dtype=np.complex64), low - more, sound)
    beam = np.empty(int((high - low) / step) + 1, dtype=np.complex128)
    for k in range(beam.size):
        z, _, noise = _output(sound, more + k * step, bearing, wide.beams, wide.call)
        beam[k] = z / math.sqrt(noise)
    if not wide.call.tone:
        first, std = _first_of_two(beam, wide.alike, wide.threshold)
        return low + step * first, math.hypot(step * std, wide.doppler_std / wide.call.interval)
    alone = beam[:, np.newaxis, np.newaxis, np.newaxis]
    lag, std = front_edge(alone, b - low, 0, 0, pulse, MIN_EDGE_ENERGY_OF_BEAM)
    return low + lag, std


@kernel
def _first_of_two(
    beam: Complex[np.ndarray, " n"], alike: Complex[np.ndarray, " a"], threshold: float
) -> tuple[float, float]:
    """Return place and std of the first of two calls in a beam, in its steps; NaN if one fits."""
    fit, single, best = np.zeros(beam.size), 0.0, 0
    for i in range(beam.size):
        single = max(single, abs(beam[i]) ** 2)
        for j in range(i + 1, min(i + alike.size, beam.size)):
            common = (beam[i].conjugate() * alike[j - i].conjugate() * beam[j]).real
            both = abs(beam[i]) ** 2 + abs(beam[j]) ** 2 - 2.0 * common
            fit[i] = max(fit[i], both / (1.0 - abs(alike[j - i]) ** 2))
        best = i if fit[i] > fit[best] else best
    if fit[best] < single + threshold or not 0 < best < beam.size - 2:
        return math.nan, math.nan
    before, here, after = fit[best - 1], fit[best], fit[best + 1]
    variance = 1.0 / (2.0 * here - before - after) + 1.0 / 12.0  # the second is between two steps
    return best + _moved(before, here, after), math.sqrt(variance)


def find_wide(
    matched: Complex[np.ndarray, "k l"], wide: Wide, start: float, cut: int = 0
) -> tuple[Float[np.ndarray, "6 m"], Bool[np.ndarray, " m"]]:
    """Return delay, bearing and power of the calls that a group of microphones detects.

    `start`: delay of the first lag at which whole calls are recorded [s]; `cut`: lags at each end,
    before it, at which a call is only partly in the record. Returns delay at the vehicle's centre
    [s], bearing [rad], power, the standard deviations of bearing and delay, and the arctangent of
    the bearing's slope in the logarithm of the speed of sound, on a face the angle off its normal;
    and a mask of the calls that are wholly in the record.
    """
    if not matched.shape[1]:
        return np.empty((6, 0)), np.empty(0, dtype=bool)
    numbers, peaks = _search(np.ascontiguousarray(matched, dtype=np.complex64), wide, cut)
    numbers[0] += start - cut * wide.call.interval
    whole = (cut <= peaks) & (peaks < matched.shape[1] - cut)
    if wide.sine_limit > 1.0:
        return numbers, whole
    numbers[5] = wrap(numbers[1] - wide.normal)
    seen = np.abs(np.sin(numbers[5])) <= wide.sine_limit
    return numbers[:, seen], whole[seen]


@kernel
def _search(
    matched: Complex[np.ndarray, "k l"], wide: Wide, cut: Whole
) -> tuple[Float[np.ndarray, "6 m"], Int[np.ndarray, " m"]]:
    """Return the rows of all calls in the outputs, and their lags."""
    loudness = _loudness(matched, wide, wide.threshold)
    peaks = _peaks(loudness, wide.threshold, wide.lobes, wide.cut_lobes, cut)
    return _rows(matched, peaks, wide), peaks


@no_alloc
def _cut_out(
    matched: Complex[np.ndarray, "k l"], first: Whole, part: Complex[np.ndarray, "k n"]
) -> None:
    """Write the outputs from a lag on, and silence beyond the record."""
    lags = matched.shape[1]
    low, high = max(first, 0), min(first + part.shape[1], lags)
    part[:] = 0.0
    for m in range(len(part)):
        for b in range(low, high):
            part[m, b - first] = matched[m, b]


def _lead(beams: Beams, interval: float) -> float:
    """Return the largest time lead of a microphone over the beams' centre, in lags."""
    farthest = float(np.linalg.norm(beams.position, axis=1).max())
    return farthest / beams.speed_of_sound / interval


def _sinc() -> Float[np.ndarray, "p t"]:
    """Return the taps of a windowed-sinc interpolator for each fraction between two outputs."""
    away = np.arange(TAPS) - (TAPS // 2 - 1) - np.arange(PARTS + 1)[:, np.newaxis] / PARTS
    window = np.i0(BETA * np.sqrt(np.clip(1.0 - (away / (TAPS // 2)) ** 2, 0.0, None)))
    return np.sinc(away) * window / np.i0(BETA)


_SINC, _LINEAR = _sinc(), np.array([[1.0, 0.0], [0.0, 1.0]])


@no_alloc
def _output(
    matched: Complex[np.ndarray, "k l"], at: float, bearing: float, beams: Beams, call: _Call
) -> tuple[complex, float, float]:
    """Return a beam's output at a bearing and a fractional lag, its energy, and noise variance."""
    ahead, left = math.cos(bearing), math.sin(bearing)
    total, energy, noise = 0.0j, 0.0, 0.0
    parts, taps = call.taps.shape[0] - 1, call.taps.shape[1]
    for m in range(beams.weight.size):
        early = (beams.position[m, 0] * ahead + beams.position[m, 1] * left) / beams.speed_of_sound
        place = at - early / call.interval
        k = math.floor(place)
        part = (place - k) * parts
        row = min(int(part), parts - 1)
        share, y = part - row, 0.0j
        for t in range(taps):
            weight = (1.0 - share) * call.taps[row, t] + share * call.taps[row + 1, t]
            y += weight * matched[m, k - taps // 2 + 1 + t]
        turn = -2.0 * math.pi * call.frequency * early
        total += beams.weight[m] * y * complex(math.cos(turn), math.sin(turn))
        energy += y.real * y.real + y.imag * y.imag
        mean = 2.0 * part * (1.0 - part) / call.pulse if call.tone else 0.0
        noise += beams.weight[m] * beams.weight[m] * (1.0 - mean)
    return total, energy, noise


@no_alloc
def _power(
    matched: Complex[np.ndarray, "k l"], at: float, bearing: float, beams: Beams, call: _Call
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
    matched: Complex[np.ndarray, "k l"],
    at: float,
    bearing: float,
    step: float,
    beams: Beams,
    call: _Call,
) -> tuple[float, float, float]:
    """Return lag, bearing and power at the top of a lobe, climbed from a nearby start.

    The lag of a tone stays: the loudest bearing is found at a given time.
    """
    late = 0.0 if call.tone else 0.5
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
    matched: Complex[np.ndarray, "k l"],
    at: float,
    power: Float[np.ndarray, " n"],
    faintest: float,
    known: tuple[float, float],
    wide: Wide,
    lobes: Float[np.ndarray, "4 n"],
) -> tuple[Whole, Whole]:
    """Write lag, bearing, power and step of a scan's lobes; return the loudest's index, and count.

    ``power``: of each beam at the lag; ``faintest``: least of a lobe; ``known``: bearing of a lobe
    to be left out, or NaN, and the step of a climb [rad], or 0 for half the distance of two beams.
    """
    (besides, step), beams = known, wide.beams
    count, loudest, n = 0, 0, power.size
    for i in range(n):
        before = power[i - 1] if i > 0 else -1.0
        after = power[i + 1] if i + 1 < n else -1.0
        same = abs(wrap_angle(beams.bearing[i] - besides)) < 4.0 * step
        if power[i] > before and power[i] >= after and power[i] >= faintest and not same:
            near = i + 1 if i + 1 < n else i - 1
            half = 0.5 * abs(wrap_angle(beams.bearing[near] - beams.bearing[i]))
            lobes[3, count] = step if step > 0.0 else half
            lobes[0, count], lobes[1, count], lobes[2, count] = _climb(
                matched, at, beams.bearing[i], lobes[3, count], beams, wide.call
            )
            loudest = count if lobes[2, count] > lobes[2, loudest] else loudest
            count += 1
    return loudest, count


@no_alloc
def _write_row(
    lobe: tuple[float, float, float],
    square: float,
    at: float,
    wide: Wide,
    row: Float[np.ndarray, "6"],
) -> None:
    """Write delay, bearing, power and standard deviations of a detection.

    ``lobe``: bearing, power and power over the noise; ``square``: its variance by other lobes.
    """
    (bearing, top, over), beams, band, call = lobe, wide.beams, wide.band, wide.call
    cosine, sine, c = math.cos(bearing), math.sin(bearing), beams.speed_of_sound
    xx = xy = 0.0
    for m in range(beams.weight.size):
        share = beams.weight[m] * beams.weight[m]
        along = beams.position[m, 0] * cosine + beams.position[m, 1] * sine
        across = beams.position[m, 1] * cosine - beams.position[m, 0] * sine
        xy, xx = xy + share * along * across, xx + share * across * across
    spread, wave = max(xx, 1e-12), 2.0 * math.pi * band.centre
    late = call.interval * delay_std(over, call.pulse)
    if not call.tone:
        wave, late = math.hypot(wave, band.spread), math.sqrt(0.5 * (1.0 + 1.0 / over) / over)
        late = math.hypot(late / band.spread, wide.doppler_std)
    std = bearing_std(over, wave / c, 12.0 * spread)
    std = min(math.hypot(std, math.sqrt(square)), UNKNOWN)
    row[0] = at * call.interval + (wide.middle[0] * cosine + wide.middle[1] * sine) / c
    row[1], row[2], row[3] = wrap_angle(bearing + wide.normal), top, std
    aside = (wide.middle[1] * cosine - wide.middle[0] * sine) / c * std
    row[4] = math.hypot(late, aside)
    row[5] = math.atan(xy / spread)


@kernel
def _rows(
    matched: Complex[np.ndarray, "k l"], peaks: Int[np.ndarray, " m"], wide: Wide
) -> Float[np.ndarray, "6 m"]:
    """Return delay, bearing, power and standard deviations of the call at each peak.

    The lag is not yet the peak's, and another of several nearly equal lobes may be the loudest at
    its own time: the top of each is computed.
    """
    beams, call, last = wide.beams, wide.call, matched.shape[1] - 1
    near = wide.margin + TAPS + reach_of(call.pulse) + 2
    sound = np.empty((len(matched), 2 * near + 1), dtype=np.complex64)
    numbers, power = np.empty((6, peaks.size)), np.empty(beams.bearing.size)
    lobes, sums = np.empty((4, power.size)), np.empty((2, power.size), dtype=np.float32)
    for i in range(peaks.size):
        at, first = float(near), peaks[i] - near
        _cut_out(matched, first, sound)
        for s in range(len(wide.late)):
            _scan(sound, near, s, wide, sums, power)
        best, _ = _lobes(sound, at, power, LOBE * power.max(), (math.nan, 0.0), wide, lobes)
        at = min(max(lobes[0, best], float(-first)), float(last - first))
        bearing, top, step = lobes[1, best], lobes[2, best], lobes[3, best]
        if call.tone:
            at = _start(sound, near, bearing, beams, call, (max(-first, 0), last - first))
            _, bearing, top = _climb(sound, at, bearing, step, beams, call)
            for n in range(power.size):
                power[n] = _power(sound, at, beams.bearing[n], beams, call)
        _, energy, least = _output(sound, at, bearing, beams, call)
        over = over_noise(top, energy / least, beams.weight.size, beams.loudest_noise)
        noise = top / (over + 1.0)
        faintest = 0.8 * (top - RARE * noise)
        _, count = _lobes(sound, at, power, faintest, (bearing, step), wide, lobes)
        odds, square = 0.0, 0.0
        for k in range(count):
            off = wrap_angle(lobes[1, k] - bearing)
            if abs(off) >= 4.0 * step:  # else the same lobe
                share = math.exp(min(lobes[2, k] - top, 0.0) / noise)
                odds, square = odds + share, square + share * off * off
        _write_row((bearing, top, over), square / (1.0 + odds), first + at, wide, numbers[:, i])
    return numbers


@no_alloc
def _start(
    matched: Complex[np.ndarray, "k l"],
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
def _modulus(z: complex) -> float:
    """Return the modulus of a complex number of moderate size."""
    return math.sqrt(z.real * z.real + z.imag * z.imag)


@no_alloc
def _scan(
    matched: Complex[np.ndarray, "k l"],
    b: Whole,
    s: Whole,
    wide: Wide,
    sums: Float[np.ndarray, "2 n"],
    power: Float[np.ndarray, " n"],
) -> None:
    """Write the power of each beam of a sector at a lag, by delays rounded to half lags."""
    real, imaginary = sums
    first, last = wide.begin[s], wide.begin[s + 1]
    for n in range(first, last):
        real[n], imaginary[n] = np.float32(0.0), np.float32(0.0)
    for m in range(len(matched)):
        late = wide.late[s, m]
        k = b + (late >> 1)
        heard = matched[m, k]
        if late & 1:
            heard = np.float32(0.5) * (heard + matched[m, k + 1])
        x, y, cosine, sine = heard.real, heard.imag, wide.phases[0, m], wide.phases[1, m]
        for n in range(first, last):
            real[n] += cosine[n] * x - sine[n] * y
            imaginary[n] += cosine[n] * y + sine[n] * x
    scale = 1.0 / wide.noise_std[s] ** 2
    for n in range(first, last):
        power[n] = scale * (real[n] * real[n] + imaginary[n] * imaginary[n])


@kernel
def _loudness(
    matched: Complex[np.ndarray, "k l"], wide: Wide, threshold: float
) -> Float[np.ndarray, " l"]:
    """Return the power of the loudest beam at lags where it may reach the threshold; else 0.

    Sought by delays rounded to half lags, and computed by exact delays.
    """
    (microphones, lags), margin, f = matched.shape, wide.margin + TAPS, np.float32
    tile = np.empty((microphones, CHUNK + 2 * margin + 1), dtype=np.complex64)
    moduli = np.empty((2, microphones, tile.shape[1]), dtype=np.float32)
    totals, most = np.empty((len(wide.late), CHUNK), dtype=np.float32), np.empty(CHUNK, dtype=f)
    loudness, bearing, power = np.zeros(lags), wide.beams.bearing, np.empty(wide.begin[-1])
    sums, inverse = np.empty((2, power.size), dtype=f), (1.0 / wide.noise_std).astype(np.float32)
    least = math.sqrt(wide.loss * threshold)
    for start in range(0, lags, CHUNK):
        _cut_out(matched, start - margin, tile)
        for m in range(microphones):
            sound, weight = tile[m], f(wide.beams.weight[m])
            whole, half = moduli[0, m], moduli[1, m]
            for b in range(whole.size):
                whole[b] = weight * _modulus(sound[b])
            for b in range(whole.size - 1):
                half[b] = f(0.5) * weight * _modulus(sound[b] + sound[b + 1])
        most[:] = f(0.0)
        for s in range(len(totals)):
            total = totals[s]
            total[:] = f(0.0)
            for m in range(microphones):
                late = wide.late[s, m]
                row = moduli[late & 1, m, margin + (late >> 1) :]
                for b in range(CHUNK):
                    total[b] += row[b]
            for b in range(CHUNK):
                total[b] *= inverse[s]
                most[b] = max(most[b], total[b])
        for b in range(min(CHUNK, lags - start)):
            if most[b] < f(least):
                continue
            power[:] = 0.0
            for s in range(len(totals)):
                if totals[s, b] >= f(least):
                    _scan(tile, margin + b, s, wide, sums, power)
            best, at = power.argmax(), float(margin + b)
            if math.sqrt(power[best]) >= least - wide.slack:
                loudest = _power(tile, at, bearing[best], wide.beams, wide.call)
                for n in range(power.size):
                    floor = max(math.sqrt(loudest), least) - wide.slack
                    if n != best and power[n] >= floor * floor:
                        exact = _power(tile, at, bearing[n], wide.beams, wide.call)
                        loudest = max(loudest, exact)
                loudness[start + b] = loudest
    return loudness


def _lobes_of(call: Call, wide: Wide, step: int, rate: float) -> Float[np.ndarray, " l"]:
    """Return a call's highest side lobes by lag from its peak, relative to the peak's power."""
    interval, sent, beams = step / rate, replica(call, rate), wide.beams
    reach = math.ceil(sent.size / step) + 2 * wide.margin
    count, most = window_lags(4 * reach), np.zeros(reach)
    length, (middle, low, high) = count * interval, bins_of(wide.band, count, interval)
    bins = middle + np.arange(low, high + 1)
    own, place = np.fft.fft(sent, step * count)[bins].conj(), bins / length
    early, share = _leads(beams, beams.bearing), beams.weight**2
    spectra = np.zeros((len(early), count), dtype=np.complex64)
    for angle in _ANGLES:
        off = _leads(beams, np.array([angle])) - early
        first, turn = np.exp(2j * np.pi * off * place[0]), np.exp(2j * np.pi * off / length)
        answer = [
            (share * at) @ np.vander(to, bins.size, increasing=True)
            for at, to in zip(first, turn, strict=True)
        ]
        for scale in (1.0 - SHIFT, 1.0, 1.0 + SHIFT):
            power = np.fft.fft(replica(call, rate, scale), step * count)[bins] * own
            power *= np.exp(-1j * np.pi * place * length)
            spectra[:, bins - middle] = power * answer
            loudness = np.max(np.abs(np.fft.ifft(spectra, axis=1)) ** 2, axis=0)
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
    margin = 2 * wide.margin
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
            away = min(away, loudness.size - away) if cut > 0 else away
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
