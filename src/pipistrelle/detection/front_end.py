"""The front end: detects calls in matched-filter outputs, and averages faces into measurements.

For a `Layout` of equal lines on faces, `snapshots` detects calls. For microphones anywhere
(`Scattered`), each group is searched separately: a line on a face by `snapshots`, any other by
`full_circle`; bearings and delays are then relative to the vehicle's centre.

Calls that are not tones are found over their whole band, each separately (`wideband`). The leakage
of a call into the matched filter of another is `acoustics.call.cross_talk`; a detection of no more
than twice the leakage of a louder one is dropped.

Several faces may detect one echo. Detections are averaged per label and caller; the label is a
landmark's or, without labels, the number of the echo: detections of one call, time and direction
(`same_echo`). In a scan without labels, the direct calls of other callers are found by
`pipistrelle.detection.direct`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst, cross_talk
from pipistrelle.arrays.layout import Layout, Scattered, along_line
from pipistrelle.config import Config, InputError
from pipistrelle.detection.direct import (
    MIN_EDGE_ENERGY,
    DirectCalls,
    Lags,
    front_edge,
    loudest_first,
    may_leak,
    without_calls,
)
from pipistrelle.detection.full_circle import Circle, circle_of, edge_around, find_around
from pipistrelle.detection.matched import reach_of
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
    columns_of,
    detect,
    detections_at,
    detector,
    direct_of_faces,
    joined,
)
from pipistrelle.detection.wideband import MARGIN, Wide, find_wide, wide_of
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
    r"""Average the strongest detection of each face, for each label and caller.

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
    labels, clutter = _distinct(label)
    found, direct = tuple(columns_of(detections)), tuple(detections.direct or _NO_DIRECT)
    landmark, caller, numbers = _average(
        labels, label, found, direct, averaging == "weighted", speed_of_sound
    )
    rows = Scan(time=time, landmark=landmark, caller=caller, numbers=numbers, callers=callers)
    return FrameMeasurements(rows=rows, clutter=int(clutter))


def same_echo(
    detections: Detections, *, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Number the echoes: detections of one call by different faces, at one time and direction.

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
    found = columns_of(detections)
    return _number(order, found, delay_gate, bearing_gate)


_NO_DIRECT = DirectCalls(np.empty(0, np.int64), np.empty(0), np.empty(0), 0.0)


@kernel
def _distinct(label: Int[np.ndarray, " d"]) -> tuple[Int[np.ndarray, " n"], Whole]:
    """Return the sorted distinct labels, and the number of detections without a label."""
    labels, count, clutter = np.empty_like(label), 0, 0
    for d in range(label.size):
        if label[d] == UNLABELLED:
            clutter += 1
            continue
        place = count
        while place > 0 and labels[place - 1] > label[d]:
            place -= 1
        if place > 0 and labels[place - 1] == label[d]:
            continue
        for i in range(count, place, -1):
            labels[i] = labels[i - 1]
        labels[place] = label[d]
        count += 1
    return labels[:count].copy(), clutter


@kernel
def _average(
    labels: Int[np.ndarray, " n"],
    label: Int[np.ndarray, " d"],
    detections: tuple,
    calls: tuple,
    weighted: bool,
    speed_of_sound: float,
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, "8 m"]]:
    """Average each label's and caller's strongest detections; return label, caller and numbers."""
    found, direct = Columns(*detections), DirectCalls(*calls)
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
                delay = _after(direct, p, delay, spread) if p != OWN else (delay, spread)
                _write_way(numbers, row, p == OWN, delay, speed_of_sound)
                numbers[SLOPE, row] = slope / total
                numbers[LEVEL, row] = 10.0 * math.log10(loudest)
                row += 1
    return landmark[:row], caller[:row], numbers[:, :row].copy()


@kernel
def _write_way(
    numbers: Float[np.ndarray, "8 m"],
    row: Whole,
    own: bool,
    delay: tuple[float, float],
    speed_of_sound: float,
) -> None:
    """Write the range from the delay of the vehicle's own call, else the excess path."""
    late, spread = delay
    if own:
        metres = 0.5 * speed_of_sound
        numbers[RANGE, row] = metres * late
        numbers[RANGE_STD, row] = math.hypot(metres * spread, RANGE_FLOOR)
    else:
        numbers[EXCESS_PATH, row] = speed_of_sound * late
        numbers[EXCESS_PATH_STD, row] = math.hypot(speed_of_sound * spread, EXCESS_PATH_FLOOR)


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
def _after(direct: DirectCalls, caller: Whole, delay: float, std: float) -> tuple[float, float]:
    """Return an echo's delay after its caller's direct call [s], and its deviation; else NaN."""
    if caller >= direct.delay.size or not delay - direct.delay[caller] >= direct.pulse:
        return math.nan, math.nan
    return delay - direct.delay[caller], math.hypot(std, direct.delay_std[caller])


@kernel
def _number(
    order: Int[np.ndarray, " d"], found: Columns, delay_gate: float, bearing_gate: float
) -> Int[np.ndarray, " d"]:
    """Number the echoes greedily, in a given order of the detections."""
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
    """Add `EDGE_FLOOR` to the standard deviation of the direct calls' beginning."""
    direct = detections.direct
    if direct is None or config.detection.overlaps != "resolve":
        return detections
    floor = EDGE_FLOOR / config.assumed_sound_speed
    delay_std = np.hypot(direct.delay_std, floor)
    return replace(detections, direct=direct._replace(delay_std=delay_std))


def unlabelled_scan(
    time: float, detections: Detections, config: Config, missable: Bool[np.ndarray, " c"]
) -> tuple[Scan, Int[np.ndarray, " d"]]:
    """Average a frame's detections by echo into a scan without labels.

    `missable`: callers with a beam or an independent clock, whose direct call may be missed; the
    first of their tone may be an echo, so without labels they have no excess paths. Returns the
    scan, and each detection's echo, a row of the scan.
    """
    gates, direct = config.matching, detections.direct
    echo = same_echo(
        detections,
        delay_gate=gates.delay_gate * config.emitter.pulse,
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
    return _with_unsure_calls(without_labels(averaged.rows, callers)), echo


def _with_unsure_calls(scan: Scan) -> Scan:
    """Add `DIRECT_FLOOR` to the bearing standard deviation of direct calls."""
    rows, numbers = scan.direct[scan.direct >= 0], scan.numbers.copy()
    numbers[BEARING_STD, rows] = np.hypot(numbers[BEARING_STD, rows], DIRECT_FLOOR)
    return replace(scan, numbers=numbers)


@dataclass(frozen=True, slots=True, kw_only=True)
class Groups:
    """Detectors of microphones anywhere, for each group."""

    members: tuple[Int[np.ndarray, " k"], ...]
    """Microphones of each group."""
    finders: tuple[Detector | Circle, ...]
    """Detector of each group: a `Detector` for a line on a face, else a `Circle`."""
    centre: Float[np.ndarray, "f 2"]
    """Phase centre of each line; the origin for other groups [m]."""
    speed_of_sound: float
    least_snr: float
    """Least signal-to-noise ratio of an output of gain 0 dB for a detection, as a power ratio."""
    from_start: bool
    """Whether outputs keep the phase of the record's start, not of a call at their lag."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixed:
    """Detectors of calls that are not all tones."""

    tones: "FrontEnd"
    """Detector of the tones; its caller 0 is the vehicle, even if that sends no tone."""
    narrow: Int[np.ndarray, " n"]
    """Callers of the tones, and the vehicle."""
    silent: bool
    """Whether the vehicle's call is not a tone."""
    wide: tuple[tuple[int, int, Wide], ...]
    """Detectors of the other calls: caller, group, detector."""
    layout: Layout | Scattered
    talk: Float[np.ndarray, "c c"]
    """Share of a call's power (column) in the filter of another (row); 0 on the diagonal."""
    least_snr: float
    """Least signal-to-noise ratio of an output of gain 0 dB for a detection, as a power ratio."""


FrontEnd = Detector | Groups | Mixed


def front_end(
    config: Config,
    layout: Layout | Scattered,
    tones: Float[np.ndarray, " c"],
    where: str = "receiver.array",
    calls: Sequence[Call] = (),
) -> FrontEnd:
    """Build the detector of calls with given tones [Hz] in the outputs of a layout.

    `where`: origin of the layout, for errors; `calls`: needed if some are not tones, or tones are
    not whole bins, at the rate ``receiver.sample_rate``. Raises InputError as `detector` does, if
    microphones are too far apart, and for detection settings that require lines on faces.

    >>> from pipistrelle.arrays.layout import microphones_of
    >>> from pipistrelle.arrays.layout import scattered
    >>> cross = [(0.02, 0.0), (0.0, 0.02), (-0.02, 0.0), (0.0, -0.02)]
    >>> layout = scattered(microphones_of([(x, y, 0.0, 0.0, "") for x, y in cross]))
    >>> found = front_end(Config(), layout, np.array([35e3, 30e3]))
    >>> round(found.finders[0].threshold, 1), found.finders[0].beams
    (18.8, 143)
    """
    if not all(isinstance(call, ToneBurst) for call in calls):
        return _mixed(config, layout, tones, where, calls)
    config = _leaking(config, calls)
    if isinstance(layout, Layout):
        return detector(config, layout, tones)
    members, finders, snrs = [], [], []
    centre = np.zeros((layout.normal.size, 2))
    for g, normal in enumerate(layout.normal):
        if math.isnan(normal):
            members.append(layout.members(g)[1])
            position, gain = layout.places(g)
            _refuse_lines_own(config, where)
            wavelength = config.assumed_sound_speed / tones.max()
            _refuse_far_apart(position, wavelength, where)
            finders.append(circle_of(config, layout, g, tones))
            snrs.append((finders[-1].threshold - 1.0) / np.sum(gain**2))
        else:
            line, alone = along_line(layout, g)
            members.append(line)
            finders.append(detector(config, alone, tones))
            centre[g] = layout.position[line].mean(axis=0)
            gain = np.sum(layout.amplitude[line] ** 2)
            snrs.append((finders[-1].threshold - line.size) / gain)
    return Groups(
        members=tuple(members),
        finders=tuple(finders),
        centre=centre,
        speed_of_sound=config.assumed_sound_speed,
        least_snr=float(min(snrs)),
        from_start=bool(calls),
    )


def find_calls(
    matched: Complex[np.ndarray, "l f c e"],
    end: FrontEnd,
    *,
    start: float,
    interval: float,
    pulse: int,
    around: Callable[[], Complex[np.ndarray, "l f c e"]] | None = None,
) -> Detections:
    """Detect bearings and delays of all calls that exceed the noise, as in `detect`.

    `around`: returns the outputs also at lags at which a call is only partly in the record, equally
    many at each end (`BandFilters.around`); without it, such calls are not considered.
    """
    lags = Lags(start, interval, pulse)
    if isinstance(end, Detector):
        return detect(matched, end, **lags._asdict())
    if isinstance(end, Mixed):
        return _of_mixed(matched, end, lags, around and cache(around))
    found = joined([_of_group(matched, end, g, lags) for g in range(len(end.finders))])
    return replace(found, direct=_direct_of_groups(matched, end, found, lags))


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
        lags = Lags(start, interval, pulse)
        near = replace(near, direct=_direct_of(matched, end, near, lags))
    return detections_at(near, near.caller == caller)


def _leaking(config: Config, tones: Sequence[Call]) -> Config:
    """Raise the leakage threshold to the tones' cross talk, if that is higher."""
    if len(tones) < 2:
        return config
    talk = cross_talk(tones, config.receiver.sample_rate)
    np.fill_diagonal(talk, 0.0)
    most = 10.0 * math.log10(MARGIN * max(float(talk.max()), 1e-30))
    level_db = max(config.detection.leakage_db, most)
    found = config.detection.model_copy(update={"leakage_db": level_db})
    return config.model_copy(update={"detection": found})


def _mixed(
    config: Config,
    layout: Layout | Scattered,
    tones: Float[np.ndarray, " c"],
    where: str,
    calls: Sequence[Call],
) -> Mixed:
    """Build the detectors of calls that are not all tones."""
    is_tone = np.array([isinstance(call, ToneBurst) for call in calls])
    narrow = np.unique(np.append(0, np.flatnonzero(is_tone)))
    talk = cross_talk(calls, config.receiver.sample_rate)
    np.fill_diagonal(talk, 0.0)
    wide, snrs = [], []
    for caller in np.flatnonzero(~is_tone):
        for g in range(layout.normal.size):
            finder = wide_of(config, layout, g, calls, int(caller))
            wide.append((int(caller), g, finder))
            snrs.append((finder.threshold - 1.0) / finder.weight.size)
    config = _leaking(config, [call for call in calls if isinstance(call, ToneBurst)])
    tones_end = front_end(config, layout, tones[narrow], where)
    if isinstance(tones_end, Groups):
        tones_end = replace(tones_end, from_start=True)
    return Mixed(
        tones=tones_end,
        narrow=narrow,
        silent=not is_tone[0],
        wide=tuple(wide),
        layout=layout,
        talk=talk,
        least_snr=float(min(snrs)),
    )


def _tones_of(matched: Complex[np.ndarray, "l f c e"], end: Mixed) -> Complex[np.ndarray, "..."]:
    """Select the tones' matched-filter outputs; zero the vehicle's if it sends no tone."""
    outputs = np.ascontiguousarray(matched[:, :, end.narrow])
    if end.silent:
        outputs[:, :, 0] = 0.0
    return outputs


def _of_mixed(
    matched: Complex[np.ndarray, "l f c e"],
    end: Mixed,
    lags: Lags,
    around: Callable[[], Complex[np.ndarray, "l f c e"]] | None,
) -> Detections:
    """Detect tones and other calls; calls only partly in the record merely mask fainter ones."""
    parts, whole = [], []
    if len(end.narrow) > end.silent:
        found = find_calls(_tones_of(matched, end), end.tones, **lags._asdict())
        parts.append(replace(found, caller=end.narrow[found.caller]))
        whole.append(np.ones(found.caller.size, dtype=bool))
    for caller, g, finder in end.wide:
        row, members = end.layout.members(g)
        outputs = _of_members(lambda: matched, row, caller, members)
        more = around and partial(_of_members, around, row, caller, members)
        numbers, heard = find_wide(outputs, finder, lags, more)
        delay, bearing, power, across, late, angle = numbers
        whole.append(heard)
        parts.append(
            Detections(
                face=np.full(delay.size, g),
                caller=np.full(delay.size, caller),
                angle=angle,
                bearing=bearing,
                delay=delay,
                power=power,
                bearing_std=across,
                delay_std=late,
            )
        )
    found = joined(parts)
    kept = np.concatenate(whole) & ~_cross_talk_in(found, end, lags)
    found = detections_at(replace(found, direct=None), kept)
    return replace(found, direct=_direct_of(matched, end, found, lags))


def _of_members(
    outputs: Callable[[], Complex[np.ndarray, "l f c e"]],
    row: int,
    caller: int,
    members: Int[np.ndarray, " k"],
) -> Complex[np.ndarray, "l k"]:
    """Return a caller's outputs at the microphones of a group."""
    return np.ascontiguousarray(outputs()[:, row, caller, members])


def _cross_talk_in(found: Detections, end: Mixed, lags: Lags) -> Bool[np.ndarray, " m"]:
    """Return a mask of the detections that may be leakage of a louder call of another caller."""
    near = np.abs(found.delay[:, np.newaxis] - found.delay) <= lags.pulse * lags.interval
    share = end.talk[found.caller[:, np.newaxis], found.caller]
    left = np.where(near, MARGIN * share * found.power, 0.0)
    return found.power <= left.max(axis=1, initial=0.0)


def _direct_of(
    matched: Complex[np.ndarray, "l f c e"], end: FrontEnd, found: Detections, lags: Lags
) -> DirectCalls:
    """Find the direct calls among detections; the time of a wideband call is its peak's."""
    if isinstance(end, Detector):
        return direct_of_faces(matched, found, lags)
    if isinstance(end, Groups):
        return _direct_of_groups(matched, end, found, lags)
    callers, length = len(end.talk), lags.pulse * lags.interval
    detection, when = np.full(callers, -1), np.full((2, callers), np.nan)
    rows = np.flatnonzero(np.isin(found.caller, end.narrow))
    if len(end.narrow) > end.silent:
        tones = detections_at(replace(found, direct=None), np.isin(found.caller, end.narrow))
        tones = replace(tones, caller=np.searchsorted(end.narrow, tones.caller))
        direct = _direct_of(_tones_of(matched, end), end.tones, tones, lags)
        heard = direct.detection >= 0
        detection[end.narrow] = np.where(heard, np.append(rows, -1)[direct.detection], -1)
        when[:, end.narrow] = direct.delay, direct.delay_std
    for p in range(1, callers):
        d = -1 if p in end.narrow else int(loudest_first(found.caller, found.delay, found.power, p))
        if d >= 0 and not may_leak(found.delay, found.power, d, length):
            detection[p], when[0, p], when[1, p] = d, found.delay[d], found.delay_std[d]
    return DirectCalls(detection=detection, delay=when[0], delay_std=when[1], pulse=length)


def _refuse_lines_own(config: Config, where: str) -> None:
    """Raise if a setting is used that requires line arrays on faces."""
    for key, usual in (("snapshots", "maxima"), ("overlaps", "merge")):
        if (found := getattr(config.detection, key)) != usual:
            raise InputError(
                f"detection.{key}: found {found!r}, which only lines on faces have, for the "
                f"microphones of {where} that hear all around; expected {usual!r}"
            )


def _refuse_far_apart(place: Float[np.ndarray, "k 2"], wavelength: float, where: str) -> None:
    """Raise if a microphone is too many wavelengths from its nearest neighbour."""
    apart = np.linalg.norm(place[:, np.newaxis] - place, axis=-1)
    np.fill_diagonal(apart, np.inf)
    if (gap := float(apart.min(axis=1).max())) > MAX_SPACING * wavelength:
        raise InputError(
            f"{where}: found a microphone {gap:g} m, {gap / wavelength:.0f} waves, from the "
            f"next; expected at most {MAX_SPACING}; if x, y, z are millimetres, divide by 1000"
        )


def _outputs(
    matched: Complex[np.ndarray, "l 1 c e"], end: Groups, g: int, lags: Lags
) -> Complex[np.ndarray, "l c k"]:
    """Return a group's outputs; for a circle, with the phase of a call that starts at their lag."""
    outputs, finder = matched[:, 0, :, end.members[g]].transpose(1, 2, 0), end.finders[g]
    if end.from_start and isinstance(finder, Circle):
        turns = finder.tones * lags.interval
        if np.abs(turns - np.rint(turns)).max() > 1e-6:
            phase = np.exp(2j * np.pi * np.outer(np.arange(len(outputs)), turns))
            outputs = outputs * phase[:, :, np.newaxis]
    return np.ascontiguousarray(outputs)


def _of_group(
    matched: Complex[np.ndarray, "l 1 c e"], end: Groups, g: int, lags: Lags
) -> Detections:
    """Detect the calls at one group of microphones."""
    outputs, finder = _outputs(matched, end, g, lags), end.finders[g]
    if isinstance(finder, Circle):
        caller, (delay, bearing, power, bearing_std, delay_std, angle) = find_around(
            outputs, finder, lags
        )
    else:
        found = detect(outputs[:, np.newaxis], finder, **lags._asdict())
        caller, bearing, power, angle = found.caller, found.bearing, found.power, found.angle
        delay, bearing_std = found.delay + _ahead(end, g, bearing), found.bearing_std
        delay_std = found.delay_std
    return Detections(
        face=np.full(caller.size, g),
        caller=caller,
        angle=angle,
        bearing=bearing,
        delay=delay,
        power=power,
        bearing_std=bearing_std,
        delay_std=delay_std,
    )


def _ahead(
    end: Groups, g: int, bearing: Float[np.ndarray, "*m"] | float
) -> Float[np.ndarray, "*m"]:
    """Return the lead of a line over the vehicle's centre for sound from a bearing [s]."""
    x, y = end.centre[g] / end.speed_of_sound
    return x * np.cos(bearing) + y * np.sin(bearing)


def _direct_of_groups(
    matched: Complex[np.ndarray, "l 1 c e"], end: Groups, found: Detections, lags: Lags
) -> DirectCalls:
    """Find the direct call of every other caller, and its beginning, as in `direct_calls`."""
    start, interval, pulse = lags
    tones, length = matched.shape[2], pulse * interval
    detection, when = np.full(tones, -1), np.full((2, tones), np.nan)
    for p in range(1, tones):
        d = int(loudest_first(found.caller, found.delay, found.power, p))
        if d < 0 or may_leak(found.delay, found.power, d, length):
            continue
        g, bearing = int(found.face[d]), float(found.bearing[d])
        early = float(_ahead(end, g, bearing))
        b = int((found.delay[d] - early - start) / interval + 0.5)
        lag, std = math.nan, math.nan
        if pulse + reach_of(pulse) < b < len(matched):
            lag, std = _edge(matched, end, g, lags, (b, p, bearing))
        if std != math.inf:
            detection[p] = d
            when[:, p] = start + interval * lag + early, interval * std
        if math.isnan(std):
            when[:, p] = found.delay[d], found.delay_std[d]
    return DirectCalls(detection=detection, delay=when[0], delay_std=when[1], pulse=length)


def _edge(
    matched: Complex[np.ndarray, "l 1 c e"],
    end: Groups,
    g: int,
    lags: Lags,
    at: tuple[int, int, float],
) -> tuple[float, float]:
    """Return the first lag of a tone's first call in a group, and its standard deviation."""
    outputs, finder = _outputs(matched, end, g, lags), end.finders[g]
    if isinstance(finder, Circle):
        return edge_around(outputs, finder, lags, at)
    return front_edge(outputs[:, np.newaxis], at[0], 0, at[1], lags.pulse, MIN_EDGE_ENERGY)
