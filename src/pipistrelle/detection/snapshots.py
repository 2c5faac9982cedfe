r"""Detections from matched-filter outputs of line arrays: snapshots, beam scan, time of arrival.

The matched filter's outputs y_e, normalised to unit noise variance, are tested per face and tone by
their energy :math:`E = \sum_e |y_e|^2`, which is Gamma(N) distributed in noise. A *snapshot* is a
lag whose energy passes the test and is the largest within half a call to either side, or, with
``snapshots = "runs"``, a contiguous run of lags that pass. A tone counts at a lag only if its
energy is not explained by the leakage of a stronger tone: the edges of a rectangular call leak -33
dB into the next tone. A snapshot is scanned with a conventional beam, whose power, summed over a
run's lags, needs only the sums over element pairs,

.. math:: P(u) = r_0 + 2 \operatorname{Re} \sum_{l=1}^{N-1} r_l e^{-i l u}, \qquad
          u = \frac{2\pi f d}{c} \sin\theta .

Each peak near the strongest's height is refined by a parabola, the beam is steered to it, and the
time of arrival is where a triangle, the matched filter's response to the call, fits best; in a run,
near the loudest lag of that beam. With ``overlaps = "resolve"``, the sources that explain the
snapshot take the place of peaks (`pipistrelle.detection.overlaps`). Bradley & Abaid, Sec. II-D; the
settings' defaults decide whatever the paper leaves open.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.arrays.layout import Layout
from pipistrelle.config import Config, InputError
from pipistrelle.detection.direct import (
    MIN_EDGE_ENERGY,
    DirectCalls,
    Lags,
    direct_calls,
    front_edge,
)
from pipistrelle.detection.matched import arrival_lag, reach_of, steer, steering_phases
from pipistrelle.detection.noise import (
    MIN_POWER_OVER_NOISE,
    bearing_std,
    candidates,
    delay_std,
    energy_of,
    is_leakage,
    loudest_noise,
    over_noise,
    snapshot,
)
from pipistrelle.detection.overlaps import (
    SAME_TIME,
    deviation,
    most_left,
    resolve,
    room_for,
    surest,
)
from pipistrelle.geometry import wrap
from pipistrelle.jit import Whole, kernel, no_alloc

SCAN_STEP = 0.05
"""Step of the scan's beams in u [rad]: the parabola's bias stays under 2 % of a beam step."""

MAX_SPACING = 100
"""Most waves between two elements; bearings are ambiguous long before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detections:
    """Calls detected in a frame; a row per face, caller, snapshot and peak."""

    face: Int[np.ndarray, " m"]
    caller: Int[np.ndarray, " m"]
    """Number of the caller of the tone: 0 for the vehicle."""
    angle: Float[np.ndarray, " m"]
    """Off the face's normal [rad]."""
    bearing: Float[np.ndarray, " m"]
    """Relative to the heading [rad]."""
    delay: Float[np.ndarray, " m"]
    """Since the emission [s]. For another caller's tone only the oracle uses it."""
    power: Float[np.ndarray, " m"]
    """Power of the steered beam, divided by the number of elements N: N times an element's SNR."""
    bearing_std: Float[np.ndarray, " m"] = field(default_factory=lambda: np.empty(0))
    delay_std: Float[np.ndarray, " m"] = field(default_factory=lambda: np.empty(0))
    """`bearing_std` and `delay_std` [rad], [s] (`detection.noise`); by default NaN, not stated."""
    direct: DirectCalls | None = None
    """Direct calls of the other callers; None if the detector does not find them."""

    def __post_init__(self) -> None:
        """Fill missing standard deviations with NaN."""
        for name in ("bearing_std", "delay_std"):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.full(len(self.power), np.nan))


class Columns(NamedTuple):
    """Columns of `Detections` as a tuple, for compiled functions."""

    face: Int[np.ndarray, " m"]
    caller: Int[np.ndarray, " m"]
    angle: Float[np.ndarray, " m"]
    bearing: Float[np.ndarray, " m"]
    delay: Float[np.ndarray, " m"]
    power: Float[np.ndarray, " m"]
    bearing_std: Float[np.ndarray, " m"]
    delay_std: Float[np.ndarray, " m"]


def detection_columns(detections: Detections) -> Columns:
    """Return the columns of detections as a tuple, for compiled functions."""
    return Columns(*(getattr(detections, name) for name in Columns._fields))


class Detector(NamedTuple):
    """Thresholds and beam tables to detect tones at line arrays (`detector`)."""

    threshold: float
    """Least energy of a face and tone, in units of an output's noise."""
    runs: bool
    """Whether a run of lags above the threshold is a single snapshot."""
    leakage: float
    peak: float
    """`leakage` and `peak` are power ratios."""
    sine_limit: float
    """Sine of the largest angle off the normal that counts."""
    loudest_noise: float
    """0.999 quantile of the residual power of noise, in units of an output's noise."""
    normal: Float[np.ndarray, " f"]
    wave: Float[np.ndarray, " c"]
    """Phase between neighbours at 90 degrees, 2 pi f d / c, per tone [rad]."""
    scan: Float[np.ndarray, "c n"]
    """Scanned u, per tone [rad]."""
    table: Float[np.ndarray, "c 2 k n"]
    """Real and imaginary part of exp(-i l u), per tone; l: 1 ... e - 1, or `place`."""
    place: Float[np.ndarray, " e"]
    """Positions of the elements, in spacings; empty if equally spaced."""
    spread: float
    """See `noise.bearing_std`."""
    most_left: Float[np.ndarray, " k"]
    """Largest residual of 1, 2, ... sources (`overlaps.most_left`); empty to merge overlaps."""


def detector(config: Config, layout: Layout, tones: Float[np.ndarray, " c"]) -> Detector:
    """Compute the thresholds and beam tables to detect tones at line arrays.

    `layout` has two elements or more; if they are not equally spaced, the smallest gap is the
    spacing, and the scan takes longer. `tones`: of the calls [Hz]. Raises InputError if the
    elements are not in rising order, or too far apart.

    >>> from pipistrelle.arrays.layout import square_of_four
    >>> layout, tones = square_of_four(Config().receiver), np.array([35e3, 30e3])
    >>> round(detector(Config(), layout, tones).threshold, 1)
    32.7
    """
    from scipy.special import gammainccinv

    settings, elements = config.detection, layout.position.size
    spacing, place = _spaced(layout)
    wave = 2.0 * np.pi * tones * spacing / config.assumed_sound_speed
    if wave.max() > 2.0 * np.pi * MAX_SPACING:
        found = f"receiver.spacing: found {spacing:g} m, {wave.max() / (2.0 * np.pi):g} waves"
        raise InputError(f"{found}; expected at most {MAX_SPACING}, half a wave for a plain beam")
    edge = wave * math.sin(math.radians(settings.scan_limit_deg))
    step = SCAN_STEP * ((elements - 1) / place[-1] if place.size else 1.0)
    count = 2 * math.ceil(edge.max() / step) + 1
    scan = np.linspace(-1.0, 1.0, count) * edge[:, None]
    apart = place if place.size else np.arange(1, elements)
    turns = np.exp(-1j * apart[None, :, None] * scan[:, None, :])
    return Detector(
        threshold=float(gammainccinv(elements, settings.false_alarm)),
        runs=settings.snapshots == "runs",
        leakage=10.0 ** (settings.leakage_db / 10.0),
        peak=10.0 ** (settings.peak_db / 10.0),
        sine_limit=math.sin(math.radians(settings.angle_limit_deg)),
        loudest_noise=loudest_noise(elements),
        normal=layout.normal,
        wave=wave,
        scan=scan,
        table=np.stack((turns.real, turns.imag), axis=1),
        place=place,
        spread=12.0 * float(np.var(place)) if place.size else float(elements * elements - 1),
        most_left=most_left(elements) if settings.overlaps == "resolve" else np.empty(0),
    )


def _spaced(layout: Layout) -> tuple[float, Float[np.ndarray, " e"]]:
    """Return the spacing of a line's elements [m] and, if unequal, their positions in spacings."""
    position = layout.position
    gaps = np.diff(position)
    if position.size < 2 or not gaps.min() > 0.0:
        raise InputError(
            f"layout: found elements at {position.tolist()} m, expected two or more, rising"
        )
    spacing = float(position[-1] - position[0]) / (position.size - 1)
    if np.allclose(gaps, spacing, rtol=1e-6, atol=0.0):
        return spacing, np.empty(0)
    return float(gaps.min()), (position - position[0]) / gaps.min()


def detect(
    matched: Complex[np.ndarray, "l f c e"],
    detector: Detector,
    *,
    start: float,
    interval: float,
    pulse: int,
) -> Detections:
    """Detect bearings and delays of all calls that exceed the noise at line arrays.

    `matched` has unit noise variance; `start`: delay of lag 0 [s]; `interval`: between two lags
    [s]; `pulse`: lags per call.
    """
    energy = energy_of(matched.reshape(-1).view(matched.real.dtype), matched.shape[3])
    lags = Lags(start, interval, pulse)
    find = _find_sources if detector.most_left.size else _find_peaks
    (face, caller), numbers = find(matched, energy, tuple(detector), lags)
    delay, sine, power, bearing_std, delay_std = numbers
    angle = np.arcsin(sine)
    found = Columns(
        face=face,
        caller=caller,
        angle=angle,
        bearing=wrap(angle + detector.normal[face]),
        delay=delay,
        power=power,
        bearing_std=bearing_std,
        delay_std=delay_std,
    )
    return Detections(**found._asdict(), direct=direct_of_faces(matched, found, lags))


def direct_of_faces(
    matched: Complex[np.ndarray, "l f c e"], found: Columns | Detections, lags: Lags
) -> DirectCalls:
    """Return the callers' direct calls among the detections of tones at line arrays."""

    def edge(d: int, p: int, b: int) -> tuple[float, float]:
        return front_edge(matched, b, found.face[d], p, lags.pulse, MIN_EDGE_ENERGY)

    heard = found.caller, found.delay, found.delay_std
    return direct_calls(heard, [found.power] * matched.shape[2], lags, edge)


def detections_at(found: Detections, rows: Bool[np.ndarray, " m"]) -> Detections:
    """Select detections by a mask; direct calls outside it are dropped."""
    direct = found.direct
    if direct is not None:
        kept = np.append(rows, False)  # the last is for -1
        number = np.where(kept, np.cumsum(kept) - 1, -1)[direct.detection]
        direct = direct._replace(detection=number)
    columns = {name: getattr(found, name)[rows] for name in Columns._fields}
    return Detections(**columns, direct=direct)


def joined(parts: Sequence[Detections]) -> Detections:
    """Concatenate sets of detections; keep the direct calls of the first set."""
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in Columns._fields}
    return Detections(**columns, direct=parts[0].direct)


@no_alloc
def _steered_power(
    matched: Complex[np.ndarray, "l f c e"],
    lags: tuple[Whole, Whole],
    f: Whole,
    p: Whole,
    table: Float[np.ndarray, "2 e n"],
    power: Float[np.ndarray, " n"],
) -> None:
    """Write the beam power in each scanned direction, for unequally spaced elements."""
    for i in range(power.size):
        power[i] = 0.0
        for b in range(lags[0], lags[1]):
            x, total = matched[b, f, p], 0.0j
            for e in range(matched.shape[3]):
                total += x[e] * complex(table[0, e, i], table[1, e, i])
            power[i] += total.real * total.real + total.imag * total.imag


@no_alloc
def _scan_power(
    matched: Complex[np.ndarray, "l f c e"],
    lags: tuple[Whole, Whole],
    f: Whole,
    p: Whole,
    table: Float[np.ndarray, "2 k n"],
    power: Float[np.ndarray, " n"],
) -> None:
    """Write the beam power in each scanned direction, summed over a range of lags."""
    elements, beams = matched.shape[3], power.size
    if table.shape[1] == elements:
        _steered_power(matched, lags, f, p, table, power)
        return
    r0 = 0.0
    for b in range(lags[0], lags[1]):
        x = matched[b, f, p]
        for e in range(elements):
            r0 += x[e].real * x[e].real + x[e].imag * x[e].imag
    for i in range(beams):
        power[i] = r0
    for lag in range(1, elements):
        re, im, cosine, sine = 0.0, 0.0, table[0, lag - 1], table[1, lag - 1]
        for b in range(lags[0], lags[1]):
            x = matched[b, f, p]
            for e in range(elements - lag):
                later, former = x[e + lag], x[e]
                re += later.real * former.real + later.imag * former.imag
                im += later.imag * former.real - later.real * former.imag
        re, im = 2.0 * re, 2.0 * im
        for i in range(beams):
            power[i] += re * cosine[i] - im * sine[i]


@no_alloc
def _loudest_lag(
    matched: Complex[np.ndarray, "l f c e"],
    lags: tuple[Whole, Whole],
    f: Whole,
    p: Whole,
    phases: Complex[np.ndarray, " e"],
    beam: Complex[np.ndarray, " r"],
) -> tuple[Whole, float]:
    """Return the lag with a beam's highest power in a half-open range of lags, and the power."""
    loudest, highest = lags[0], -1.0
    steer(matched, lags[0], lags[1] - lags[0], f, p, phases, beam)
    for k in range(lags[1] - lags[0]):
        power = beam[k].real * beam[k].real + beam[k].imag * beam[k].imag
        if power > highest:
            loudest, highest = lags[0] + k, power
    return loudest, highest


@no_alloc
def _peaks(power: Float[np.ndarray, " n"], ratio: float, place: Int[np.ndarray, " n"]) -> Whole:
    """Write the indices of a beam scan's peaks near the highest in power; return their number."""
    count, kept, last = 0, 0, power.size - 1
    for i in range(1, last):
        place[count] = i
        count += (power[i] > power[i - 1]) & (power[i] >= power[i + 1])
    highest = max(power[0], power[last])
    for k in range(count):
        highest = max(highest, power[place[k]])
    for k in range(count):
        if power[place[k]] >= ratio * highest:
            place[kept] = place[k]
            kept += 1
    return kept


@kernel
def _find_peaks(
    matched: Complex[np.ndarray, "l f c e"],
    energy: Float[np.ndarray, " t"],
    rules: tuple,
    lag: Lags,
) -> tuple[Int[np.ndarray, "2 m"], Float[np.ndarray, "5 m"]]:
    """Return a detection for every beam-scan peak of every snapshot of a tone.

    Returns face and caller; delay, sine of the angle, power, and the standard deviations of bearing
    and delay.
    """
    _, faces, tones, elements = matched.shape
    rule = Detector(*rules)
    scan, wave, pulse = rule.scan, rule.wave, lag.pulse
    whole, numbers = np.empty((2, 128), dtype=np.int64), np.empty((5, 128))
    power, place = np.empty(scan.shape[1]), np.empty(scan.shape[1], dtype=np.int64)
    room = 2 * reach_of(pulse) + 3
    beam = np.empty(max(room, matched.shape[0]) if rule.runs else room, dtype=np.complex128)
    phases = np.empty(elements, dtype=np.complex128)
    row, count = faces * tones, 0
    for test in candidates(energy, rule.threshold, row if pulse > 1 else energy.size):
        within = snapshot(energy, test, row, tones, pulse, rule.runs, rule.threshold, rule.leakage)
        if within[0] == within[1]:
            continue
        f, p = test // tones % faces, test % tones
        _scan_power(matched, within, f, p, rule.table[p], power)
        step = scan[p, 1] - scan[p, 0]
        for i in place[: _peaks(power, rule.peak, place)]:
            slope = power[i + 1] - power[i - 1]
            bend = 2.0 * power[i] - power[i + 1] - power[i - 1]
            u = scan[p, i] + 0.5 * step * slope / bend
            if abs(u / wave[p]) > rule.sine_limit:
                continue
            b, top = within[0], power[i] + 0.125 * slope * slope / bend
            steering_phases(u, rule.place, phases)
            if rule.runs:
                b, top = _loudest_lag(matched, within, f, p, phases, beam)
                if is_leakage(energy, b * row + test % row, row, tones, pulse, rule.leakage):
                    continue
            if count == whole.shape[1]:  # twice the room
                whole = np.concatenate((whole, whole), axis=1)
                numbers = np.concatenate((numbers, numbers), axis=1)
            whole[0, count], whole[1, count] = f, p
            late = arrival_lag(matched, b, f, p, phases, pulse, beam)
            sine, top = u / wave[p], top / elements
            over = over_noise(top, energy[b * row + test % row], elements, rule.loudest_noise)
            across = wave[p] * math.sqrt(1.0 - sine * sine)
            numbers[0, count], numbers[1, count] = lag.start + lag.interval * late, sine
            numbers[2, count], numbers[3, count] = top, bearing_std(over, across, rule.spread)
            numbers[4, count] = lag.interval * delay_std(over, pulse)
            count += 1
    return whole[:, :count], numbers[:, :count]


@kernel
def _find_sources(
    matched: Complex[np.ndarray, "l f c e"],
    energy: Float[np.ndarray, " t"],
    rules: tuple,
    lag: Lags,
) -> tuple[Int[np.ndarray, "2 m"], Float[np.ndarray, "5 m"]]:
    """Return a detection for every resolved source of every snapshot, in `_find_peaks`' columns."""
    _, faces, tones, elements = matched.shape
    rule, pulse, row, count = Detector(*rules), lag.pulse, faces * tones, 0
    tests = candidates(energy, rule.threshold, row if pulse > 1 else energy.size)
    most = tests.size * rule.most_left.size
    whole, numbers = np.empty((3, most), dtype=np.int64), np.empty((5, most))
    found = room_for(rule.most_left.size, elements)
    beam = np.empty(pulse + 5, dtype=np.complex128)
    for test in tests:
        b, end = snapshot(energy, test, row, tones, pulse, False, rule.threshold, rule.leakage)
        if b == end:
            continue
        f, p = test // tones % faces, test % tones
        x = matched[b, f, p]
        sources, left = resolve(x, rule.scan[p, ::2], rule.place, rule.most_left, found)
        noise = left / (elements - 1.5 * sources) if left > rule.most_left[sources - 1] else 1.0
        reach = pulse // 2 if sources > 1 else 0
        within = max(b - reach, 0), min(b + reach + 1, matched.shape[0])
        for k in range(sources):
            sine, std = found.u[k] / rule.wave[p], deviation(x, found, k, noise)
            if not (abs(sine) <= rule.sine_limit and std < math.inf):
                continue
            loudest, power = _loudest_lag(matched, within, f, p, found.beam[k], beam)
            late = arrival_lag(matched, loudest, f, p, found.beam[k], pulse, beam)
            over = max(power / noise - 1.0, MIN_POWER_OVER_NOISE)
            whole[0, count], whole[1, count], whole[2, count] = f, p, b
            numbers[0, count], numbers[1, count] = lag.start + lag.interval * late, sine
            numbers[2, count] = min(power / found.gain[k], energy[loudest * row + test % row])
            numbers[3, count] = std / (rule.wave[p] * math.sqrt(1.0 - sine * sine))
            numbers[4, count] = lag.interval * delay_std(over, pulse)
            count += 1
    best = surest(whole[:, :count], numbers[:, :count], SAME_TIME * pulse * lag.interval)
    return whole[:2, :count][:, best], numbers[:, :count][:, best]
