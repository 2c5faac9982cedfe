"""The front end: detects calls in matched-filter outputs, and averages faces into measurements.

For a `Layout` of equal lines on faces, `snapshots` detects tones. For microphones anywhere
(`Scattered`), each group is searched separately: a line on a face by `snapshots`, any other by
`beams`; bearings and delays are then relative to the vehicle's centre. Calls that are not tones are
found over their whole band, each separately (`beams`). The leakage of a call into the matched
filter of another is `acoustics.call.cross_talk`; a detection of no more than twice the leakage of a
louder call is dropped.

Several faces may detect the same echo. Detections are averaged per label and caller; the label is a
landmark's or, without labels, the number of the echo: detections of one call, time and direction
(`same_echo`). In a scan without labels, the direct calls of other callers are found by
`pipistrelle.detection.direct`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst, blocks_of, cross_talk, lag_step, on_raster
from pipistrelle.arrays.layout import Layout, Scattered, along_line
from pipistrelle.config import Config, InputError
from pipistrelle.detection.beams import MARGIN, Wide, edge_around, find_wide, wide_of
from pipistrelle.detection.direct import (
    MIN_EDGE_ENERGY,
    DirectCalls,
    Lags,
    direct_calls,
    front_edge,
    without_calls,
)
from pipistrelle.detection.noise import (
    BEARING_FLOOR,
    DIRECT_FLOOR,
    EDGE_FLOOR,
    EXCESS_PATH_FLOOR,
    RANGE_FLOOR,
)
from pipistrelle.detection.scans import (
    BEARING,
    BEARING_STD,
    EXCESS_PATH,
    EXCESS_PATH_STD,
    LEVEL,
    NO_CALLERS,
    NUMBERS,
    OWN,
    RANGE,
    RANGE_STD,
    SLOPE,
    UNLABELLED,
    Scan,
    without_labels,
)
from pipistrelle.detection.snapshots import (
    MAX_SPACING,
    Columns,
    Detections,
    Detector,
    detect,
    detection_columns,
    detections_at,
    detector,
    direct_of_faces,
    joined,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMeasurements:
    """The measurements of a frame, averaged over the faces."""

    rows: Scan
    """Sorted by label, then caller, with the oracle's labels."""
    clutter: int
    """Number of detections without a label."""
    unlabelled: Scan | None = None
    """The same frame without labels, a measurement per echo; None if not requested."""
    causes: Int[np.ndarray, " e"] = field(default_factory=lambda: NO_CALLERS)
    """True label of each unlabelled measurement's landmark, or UNLABELLED."""
    between: bool = False
    """Whether the call came between two calls of the vehicle."""


def average_faces(
    time: float,
    detections: Detections,
    label: Int[np.ndarray, " d"],
    *,
    averaging: str,
    speed_of_sound: float,
    callers: Int[np.ndarray, " c"] = NO_CALLERS,
) -> FrameMeasurements:
    r"""Average the strongest detections of all faces to a measurement per label and caller.

    Bearings are averaged as directions, ``plain`` or ``weighted`` by the inverse variance at the
    array's angle, :math:`\cos^2\theta`. The range, only of the vehicle's own call, is c/2 times the
    mean delay; the excess path, of another caller's, is c times the mean delay after its direct
    call, or NaN while the direct call lasts. Standard deviations combine the signal's with a floor
    that no level removes (first line). The slope of a bearing in the speed of sound is the mean of
    the faces' (second line; a face measures :math:`\sin\theta` as c times a phase):

    .. math:: \sigma^2 &= \sigma_{signal}^2 + \sigma_{floor}^2 \\
              d\phi / d \ln c &= \sum w \tan\theta / \sum w

    `time` [s]; `detections`: (d) rows; `label`: of each detection, or UNLABELLED; `speed_of_sound`
    [m/s]; `callers`: labels of the callers as landmarks, if known.

    Bradley & Abaid, Sec. II-D.

    >>> detections = Detections(
    ...     face=np.array([0, 1]), caller=np.array([0, 0]), angle=np.radians([40.0, -50.0]),
    ...     bearing=np.radians([40.0, 42.0]), delay=np.array([0.02, 0.02]), power=np.ones(2))
    >>> rows = average_faces(
    ...     0.5, detections, np.array([3, 3]), averaging="plain", speed_of_sound=343.0).rows
    >>> np.degrees(rows.bearing).round(6), rows.range.round(6)
    (array([41.]), array([3.43]))
    """
    direct = detections.direct or DirectCalls(np.empty(0, np.int64), np.empty(0), np.empty(0), 0.0)
    found, clutter = tuple(detection_columns(detections)), np.count_nonzero(label == UNLABELLED)
    landmark, caller, numbers = _average(
        label, found, tuple(direct), averaging == "weighted", speed_of_sound
    )
    rows = Scan(time=time, landmark=landmark, caller=caller, numbers=numbers, callers=callers)
    return FrameMeasurements(rows=rows, clutter=int(clutter))


def same_echo(
    detections: Detections, *, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Return for each detection the number of its echo, which several faces may detect.

    Each echo begins with the strongest remaining detection, and takes the strongest matching
    detection of every other face.

    `detections`: (d) rows; `delay_gate` [s]; `bearing_gate` [rad]: largest differences within an
    echo. Returns numbers from 0, the strongest echo first.

    >>> detections = Detections(
    ...     face=np.array([0, 1, 1]), caller=np.zeros(3, int), angle=np.radians([40.0, -50.0, 9.0]),
    ...     bearing=np.radians([40.0, 41.0, 99.0]), delay=np.full(3, 0.02), power=np.ones(3))
    >>> same_echo(detections, delay_gate=7e-4, bearing_gate=0.1)
    array([0, 0, 1])
    """
    order = np.argsort(-detections.power, kind="stable")
    return _number(order, detection_columns(detections), delay_gate, bearing_gate)


@kernel
def _distinct(label: Int[np.ndarray, " d"]) -> Int[np.ndarray, " n"]:
    """Return the sorted distinct labels, without UNLABELLED."""
    labels, count = np.empty_like(label), 0
    for d in range(label.size):
        place = count
        while place > 0 and labels[place - 1] > label[d]:
            place -= 1
        if label[d] == UNLABELLED or (place > 0 and labels[place - 1] == label[d]):
            continue
        for i in range(count, place, -1):
            labels[i] = labels[i - 1]
        labels[place] = label[d]
        count += 1
    return labels[:count]


@kernel
def _average(
    label: Int[np.ndarray, " d"],
    detections: tuple,
    calls: tuple,
    weighted: bool,
    speed_of_sound: float,
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]]:
    """Return label, caller and numbers of measurements, averaged over the faces' detections."""
    found, direct, labels = Columns(*detections), DirectCalls(*calls), _distinct(label)
    faces = callers = 0
    for d in range(label.size):
        faces, callers = max(faces, found.face[d] + 1), max(callers, found.caller[d] + 1)
    landmark = np.empty(labels.size * callers, dtype=np.int64)
    caller, row = np.empty(landmark.size, dtype=np.int64), 0
    numbers = np.full((NUMBERS, landmark.size), np.nan)
    strongest = np.empty(faces, dtype=np.int64)
    for i in range(labels.size):
        for p in range(callers):
            _take_strongest(label, labels[i], p, found, strongest)
            total = east = north = late = loudest = across = along = slope = 0.0
            for f in range(faces):
                d = strongest[f]
                if d >= 0:
                    weight = math.cos(found.angle[d]) ** 2 if weighted else 1.0
                    total += weight
                    east += weight * math.cos(found.bearing[d])
                    north += weight * math.sin(found.bearing[d])
                    late += weight * found.delay[d]
                    slope += weight * math.tan(found.angle[d])
                    across += (weight * found.bearing_std[d]) ** 2
                    along += (weight * found.delay_std[d]) ** 2
                    loudest = max(loudest, found.power[d])
            if total > 0.0:
                landmark[row], caller[row] = labels[i], p
                numbers[BEARING, row] = wrap_angle(math.atan2(north, east))
                floor = BEARING_FLOOR[0] if p == OWN else BEARING_FLOOR[1]
                numbers[BEARING_STD, row] = math.hypot(math.sqrt(across) / total, floor)
                delay, spread = late / total, math.sqrt(along) / total
                if p == OWN:
                    metres = 0.5 * speed_of_sound
                    numbers[RANGE, row] = metres * delay
                    numbers[RANGE_STD, row] = math.hypot(metres * spread, RANGE_FLOOR)
                elif p < direct.delay.size and delay - direct.delay[p] >= direct.pulse:
                    spread = speed_of_sound * math.hypot(spread, direct.delay_std[p])
                    numbers[EXCESS_PATH, row] = speed_of_sound * (delay - direct.delay[p])
                    numbers[EXCESS_PATH_STD, row] = math.hypot(spread, EXCESS_PATH_FLOOR)
                numbers[SLOPE, row] = slope / total
                numbers[LEVEL, row] = 10.0 * math.log10(loudest)
                row += 1
    return landmark[:row], caller[:row], numbers[:, :row].copy()


@kernel
def _take_strongest(
    label: Int[np.ndarray, " d"],
    wanted: Whole,
    caller: Whole,
    found: Columns,
    strongest: Int[np.ndarray, " f"],
) -> None:
    """Write the index of each face's strongest detection of a label and a caller, or -1."""
    strongest[:] = -1
    for d in range(label.size):
        if label[d] == wanted and found.caller[d] == caller:
            best = strongest[found.face[d]]
            if best < 0 or found.power[d] > found.power[best]:
                strongest[found.face[d]] = d


@kernel
def _number(
    order: Int[np.ndarray, " d"], found: Columns, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Return for each detection the number of its echo, assigned greedily in a given order."""
    number, count = np.full(order.size, UNLABELLED, dtype=np.int64), 0
    for first in order:
        if number[first] != UNLABELLED:
            continue
        for d in order:
            if number[d] != UNLABELLED or found.caller[d] != found.caller[first]:
                continue
            late = abs(found.delay[d] - found.delay[first])
            off = abs(wrap_angle(found.bearing[d] - found.bearing[first]))
            taken = False
            for other in order:
                taken |= number[other] == count and found.face[other] == found.face[d]
            if late <= delay_gate and off <= bearing_gate and not taken:
                number[d] = count
        count += 1
    return number


def with_edge_floor(detections: Detections, config: Config) -> Detections:
    """Add a floor to the std of direct calls' start times, if overlapping echoes are resolved."""
    direct = detections.direct
    if direct is None or config.detection.overlaps != "resolve":
        return detections
    floor = EDGE_FLOOR / config.assumed_sound_speed
    delay_std = np.hypot(direct.delay_std, floor)
    return replace(detections, direct=direct._replace(delay_std=delay_std))


def unlabelled_scan(
    time: float, detections: Detections, config: Config, missable: Bool[np.ndarray, " c"]
) -> tuple[Scan, Int[np.ndarray, " d"]]:
    """Average a frame's detections into a scan without labels, a measurement per echo.

    `missable`: callers with a beam or an independent clock, whose direct call may be missed; the
    first of their tone may be an echo, so without labels they have no excess paths. Returns the
    scan, and each detection's echo, a row of the scan.
    """
    gates, direct = config.matching, detections.direct
    echo = same_echo(
        detections,
        delay_gate=gates.delay_gate * config.emitter.call_duration,
        bearing_gate=gates.bearing_gate,
    )
    callers = np.full(missable.size, UNLABELLED)
    if direct is not None:
        direct = without_calls(direct, missable)
        detections = replace(detections, direct=direct)
        callers = np.append(echo, UNLABELLED)[direct.detection]
    averaged = average_faces(
        time,
        detections,
        echo,
        averaging=config.detection.averaging,
        speed_of_sound=config.assumed_sound_speed,
    )
    scan = without_labels(averaged.rows, callers)
    rows, numbers = scan.direct[scan.direct >= 0], scan.numbers.copy()
    numbers[BEARING_STD, rows] = np.hypot(numbers[BEARING_STD, rows], DIRECT_FLOOR)
    return replace(scan, numbers=numbers), echo


class Finder(NamedTuple):
    """A detector of some callers' calls at a group of microphones."""

    callers: Int[np.ndarray, " c"]
    group: int
    """Number of the face or group; 0 for all faces of a layout at once."""
    faces: slice
    members: Int[np.ndarray, " k"] | slice
    """`faces` and `members`: rows and indices of its microphones in a recording."""
    detector: Detector | Wide
    """Detector of tones on faces, or of a call at any microphones."""
    lead: Float[np.ndarray, "2"]
    """Phase centre of a line, over the speed of sound [s]; 0 for other groups."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finders:
    """All detectors of an array with microphones anywhere, or of calls that are not all tones."""

    finders: tuple[Finder, ...]
    narrow: Int[np.ndarray, " n"]
    """Callers of tones, and the vehicle."""
    silent: bool
    """Whether the vehicle's call is not a tone."""
    talk: Float[np.ndarray, "c c"]
    """Share of a call's power (column) in the filter of another (row), unless all are tones."""
    least_snr: float
    """Least signal-to-noise ratio of an output of gain 0 dB for a detection, as a power ratio."""

    def of(self, caller: int, group: int) -> Finder:
        """Return the detector of a caller's calls at a group of microphones.

        The detectors of tones come first, and include the vehicle even if it is silent.
        """
        heard = (one for one in reversed(self.finders) if caller in one.callers)
        return next(one for one in heard if one.group == group or one.faces == slice(None))


FrontEnd = Detector | Finders


def front_end(
    config: Config,
    layout: Layout | Scattered,
    tones: Float[np.ndarray, " c"],
    where: str = "receiver.array",
    calls: Sequence[Call] = (),
) -> FrontEnd:
    """Build the detectors of all callers' calls in the matched-filter outputs of an array.

    `where`: origin of the layout, for errors; `calls`: needed if some are not tones, or tones are
    not whole bins, at the rate ``receiver.sample_rate``. Raises InputError as `detector` does, if
    microphones are too far apart, and for detection settings that require lines on faces.

    >>> from pipistrelle.arrays.layout import microphones_of
    >>> from pipistrelle.arrays.layout import scattered
    >>> cross = [(0.02, 0.0), (0.0, 0.02), (-0.02, 0.0), (0.0, -0.02)]
    >>> layout = scattered(microphones_of([(x, y, 0.0, 0.0, "") for x, y in cross]))
    >>> found = front_end(Config(), layout, np.array([35e3, 30e3])).finders[0].detector
    >>> round(found.threshold, 1), found.beams.bearing.size
    (18.8, 143)
    """
    rate, pulse = config.receiver.sample_rate, config.emitter.call_duration
    sent = calls or tuple(ToneBurst(tone, pulse) for tone in tones)
    wide = [p for p, call in enumerate(sent) if not isinstance(call, ToneBurst)]
    narrow = np.unique(np.append(0, np.setdiff1d(np.arange(tones.size), wide)))
    tonal = [call for call in sent if isinstance(call, ToneBurst)]
    lines = config if on_raster(rate, pulse, tones) else _leaking(config, tonal)
    if isinstance(layout, Layout) and not wide:
        return detector(lines, layout, tones)
    step = lag_step(sent, rate) if wide else blocks_of(rate, pulse, tones)[0]
    talk, silent = cross_talk(sent, rate) if wide else np.zeros((tones.size, tones.size)), 0 in wide
    found, around, equal = [], [], {}
    if len(narrow) > silent:
        found = list(_tone_finders(lines, layout, tones[narrow], narrow))
    if isinstance(layout, Scattered):
        around = np.flatnonzero(np.isnan(layout.normal)).tolist()
    heard = np.setdiff1d(narrow, wide)
    if around and heard.size:
        leak = 10.0 ** (lines.detection.leakage_db / 10.0) / MARGIN
        talk[np.ix_(heard, heard)] = np.maximum(talk[np.ix_(heard, heard)], leak)
        for key, usual in (("snapshots", "maxima"), ("overlaps", "merge")):
            if (value := getattr(config.detection, key)) != usual:
                raise InputError(
                    f"detection.{key}: found {value!r}, which only lines on faces have, for the "
                    f"microphones of {where} that hear all around; expected {usual!r}"
                )
    np.fill_diagonal(talk, 0.0)
    each = product(heard.tolist(), around), product(wide, range(layout.normal.size))
    for caller, g in chain(*each):
        row, members = layout.members(g)
        if np.ptp(members) == members.size - 1:  # a view of the outputs, not a copy
            members = slice(int(members[0]), int(members[-1]) + 1)
        if caller in heard:
            wave = config.assumed_sound_speed / tones[narrow].max()
            _refuse_far_apart(layout.places(g)[0], wave, where)
        one = equal.get(caller) or wide_of(config, layout, g, sent[caller], step)
        if isinstance(layout, Layout):  # all faces are equal
            one = equal[caller] = one._replace(normal=float(layout.normal[g]))
        alone = Finder(np.array([caller]), g, slice(row, row + 1), members, one, np.zeros(2))
        found.append(((one.threshold - 1.0) / np.sum(layout.places(g)[1] ** 2), alone))
    return Finders(
        finders=tuple(finder for _, finder in found),
        narrow=narrow,
        silent=silent,
        talk=talk,
        least_snr=float(np.nanmin([snr for snr, _ in found])),
    )


def _tone_finders(
    config: Config,
    layout: Layout | Scattered,
    tones: Float[np.ndarray, " n"],
    callers: Int[np.ndarray, " n"],
) -> Iterator[tuple[float, Finder]]:
    """Yield the least detectable signal-to-noise ratio and the tone detector of lines on faces."""
    if isinstance(layout, Layout):
        of_all = detector(config, layout, tones)
        yield math.nan, Finder(callers, 0, slice(None), slice(None), of_all, np.zeros(2))
        return
    for g in np.flatnonzero(~np.isnan(layout.normal)).tolist():
        members, line = along_line(layout, g)
        one = detector(config, line, tones)
        lead = layout.position[members].mean(axis=0) / config.assumed_sound_speed
        snr = (one.threshold - members.size) / np.sum(layout.amplitude[members] ** 2)
        yield snr, Finder(callers, g, slice(1), members, one, lead)


def find_calls(
    matched: Complex[np.ndarray, "l f c e"],
    end: FrontEnd,
    *,
    start: float,
    interval: float,
    pulse: int,
    cut: int = 0,
) -> Detections:
    """Return the detections and direct calls of all calls that exceed the noise (see `detect`).

    `cut`: lags at each end, before `start` and after the last whole call, at which a call is only
    partly in the record (`BandFilters.cut`); such calls merely mask fainter ones.
    """
    lags = Lags(start, interval, pulse)
    if isinstance(end, Detector):
        whole = np.ascontiguousarray(matched[cut : len(matched) - cut])
        return detect(whole, end, **lags._asdict())
    parts, whole = zip(*(_found(matched, end, one, lags, cut) for one in end.finders), strict=True)
    matched = matched[cut : len(matched) - cut]
    found = joined(parts)
    near = np.abs(found.delay[:, np.newaxis] - found.delay) <= pulse * interval
    share = end.talk[found.caller[:, np.newaxis], found.caller]
    leaked = np.where(near, MARGIN * share * found.power, 0.0).max(axis=1, initial=0.0)
    found = detections_at(found, np.concatenate(whole) & (found.power > leaked))
    return replace(found, direct=_direct_of(matched, end, found, lags))


def call_in(
    matched: Complex[np.ndarray, "l f c e"],
    end: FrontEnd,
    found: Detections,
    caller: int,
    stretch: tuple[float, float],
    *,
    start: float,
    interval: float,
    pulse: int,
) -> Detections:
    """Select the detections of one call of a caller with an independent clock, and its direct call.

    They are all detections of its tone in a `stretch` of the frame [s]; the other arguments are as
    in `find_calls`.
    """
    begin, until = stretch
    inside = (begin <= found.delay) & (found.delay < until)
    near = detections_at(found, inside | (found.caller != caller))  # others may leak
    if found.direct is not None:
        direct = _direct_of(matched, end, near, Lags(start, interval, pulse))
        near = replace(near, direct=direct)
    return detections_at(near, near.caller == caller)


def _leaking(config: Config, tones: Sequence[Call]) -> Config:
    """Return settings with a leakage threshold of at least the cross talk between the tones."""
    if len(tones) < 2:
        return config
    talk = cross_talk(tones, config.receiver.sample_rate)
    np.fill_diagonal(talk, 0.0)
    most = 10.0 * math.log10(MARGIN * max(float(talk.max()), 1e-30))
    level_db = max(config.detection.leakage_db, most)
    found = config.detection.model_copy(update={"leakage_db": level_db})
    return config.model_copy(update={"detection": found})


def _outputs(
    matched: Complex[np.ndarray, "l f c e"], end: Finders, finder: Finder
) -> Complex[np.ndarray, "l g n k"]:
    """Select the matched-filter outputs that a detector uses, with the phases that it expects."""
    outputs = np.ascontiguousarray(matched[:, finder.faces, finder.callers][..., finder.members])
    if end.silent:
        outputs[:, :, 0] = 0.0
    return outputs


def _ahead(finder: Finder, bearing: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
    """Return a line array's time lead over the vehicle's centre for sound from a bearing [s]."""
    x, y = finder.lead
    return x * np.cos(bearing) + y * np.sin(bearing)


def _found(
    matched: Complex[np.ndarray, "l f c e"], end: Finders, finder: Finder, lags: Lags, cut: int
) -> tuple[Detections, Bool[np.ndarray, " m"]]:
    """Detect calls at a group of microphones; also return a mask of calls recorded in full."""
    if isinstance(finder.detector, Wide):
        around = 0 if finder.detector.call.tone else cut
        outputs = _of_call(matched[cut - around : len(matched) - cut + around], finder)
        numbers, whole = find_wide(outputs, finder.detector, lags.start, around)
        delay, bearing, power, bearing_std, delay_std, angle = numbers
        return Detections(
            face=np.full(whole.size, finder.group),
            caller=np.full(whole.size, finder.callers[0]),
            angle=angle,
            bearing=bearing,
            delay=delay,
            power=power,
            bearing_std=bearing_std,
            delay_std=delay_std,
        ), whole
    outputs = _outputs(matched[cut : len(matched) - cut], end, finder)
    found = detect(outputs, finder.detector, **lags._asdict())
    found = replace(
        found,
        face=finder.group + found.face,
        caller=finder.callers[found.caller],
        delay=found.delay + _ahead(finder, found.bearing),
        direct=None,
    )
    return found, np.ones(found.caller.size, dtype=bool)


def _of_call(matched: Complex[np.ndarray, "l f c e"], finder: Finder) -> Complex[np.ndarray, "k l"]:
    """Select the matched-filter outputs of a detector's only call."""
    return matched[:, finder.faces, finder.callers[0]].transpose(1, 2, 0)[0][finder.members]


def _direct_of(
    matched: Complex[np.ndarray, "l f c e"], end: FrontEnd, found: Detections, lags: Lags
) -> DirectCalls:
    """Return the direct calls among detections, with a wideband call's time at its peak."""
    if isinstance(end, Detector):
        return direct_of_faces(matched, found, lags)
    tones = np.where(np.isin(found.caller, end.narrow), found.power, 0.0)
    powers = [tones if p in end.narrow else found.power for p in range(len(end.talk))]
    whose = zip(found.caller.tolist(), found.face.tolist(), strict=True)
    finders = [end.of(caller, group) for caller, group in whose]

    def edge(d: int, p: int, b: int) -> tuple[float, float]:
        finder = finders[d]
        if b >= len(matched):
            return math.nan, math.nan
        if isinstance(finder.detector, Wide):
            outputs = _of_call(matched, finder)
            return edge_around(outputs, finder.detector, b, float(found.bearing[d]))
        number = int(np.searchsorted(finder.callers, p))
        outputs, face = _outputs(matched, end, finder), int(found.face[d]) - finder.group
        return front_edge(outputs, b, face, number, lags.pulse, MIN_EDGE_ENERGY)

    bearings = found.bearing.tolist()
    lead = np.array([_ahead(one, bearing) for one, bearing in zip(finders, bearings, strict=True)])
    return direct_calls((found.caller, found.delay, found.delay_std), powers, lags, edge, lead)


def _refuse_far_apart(place: Float[np.ndarray, "k 2"], wavelength: float, where: str) -> None:
    """Raise if a microphone is too many wavelengths from its nearest neighbour."""
    apart = np.linalg.norm(place[:, np.newaxis] - place, axis=-1)
    np.fill_diagonal(apart, np.inf)
    if (gap := float(apart.min(axis=1).max())) > MAX_SPACING * wavelength:
        raise InputError(
            f"{where}: found a microphone {gap:g} m, {gap / wavelength:.0f} waves, from the "
            f"next; expected at most {MAX_SPACING}; if x, y, z are millimetres, divide by 1000"
        )
