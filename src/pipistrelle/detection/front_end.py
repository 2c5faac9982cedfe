"""The front end: what finds calls in the matched outputs of whatever microphones there are.

Of a `Layout`, equal lines on faces, `snapshots` finds them. Of microphones anywhere (`Scattered`)
each group is asked alone: a line on a face by `snapshots`, any other on the full circle
(`full_circle`); bearings and delays are then those at the vehicle's centre.

Calls that are no tone bursts are found over their whole band, each by itself (`wideband`). What one
call leaves in the matched filter of another is `bands.cross_talk`; what is no more than twice that
of a louder detection of the other is dropped.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst
from pipistrelle.arrays.bands import cross_talk
from pipistrelle.arrays.layout import Layout, Scattered, along_line
from pipistrelle.config import Config, InputError
from pipistrelle.detection.direct import (
    MIN_EDGE_ENERGY,
    DirectCalls,
    Lags,
    front_edge,
    loudest_first,
    may_leak,
)
from pipistrelle.detection.full_circle import Circle, circle_of, edge_around, find_around
from pipistrelle.detection.onset import reach_of
from pipistrelle.detection.snapshots import (
    MAX_SPACING,
    Detections,
    Detector,
    detect,
    detections_at,
    detector,
    direct_of_faces,
    joined,
)
from pipistrelle.detection.wideband import MARGIN, Wide, find_wide, wide_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Groups:
    """Thresholds and tables of microphones anywhere, group by group."""

    members: tuple[Int[np.ndarray, " k"], ...]
    """The microphones of each."""
    finders: tuple[Detector | Circle, ...]
    """The finder of each group; of a line on a face it is a `Detector`."""
    centre: Float[np.ndarray, "f 2"]
    """Phase centre of each line; the origin for other groups [m]."""
    speed_of_sound: float
    """Speed of sound [m/s]."""
    least_snr: float
    """Power ratio of one output of gain 0 dB that some group is expected to hear."""
    from_start: bool
    """Whether outputs keep the phase of the record's start, not that of a call at their lag."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixed:
    """Thresholds and tables of calls of which some are no tones."""

    tones: "FrontEnd"
    """Finder of the tones; its caller 0 is the vehicle, be it a tone or not."""
    narrow: Int[np.ndarray, " n"]
    """Which callers these are."""
    silent: bool
    """Whether the vehicle sends no tone."""
    wide: tuple[tuple[int, int, Wide], ...]
    """Finders of the other calls: caller, group, finder."""
    layout: Layout | Scattered
    talk: Float[np.ndarray, "c c"]
    """Share of a call's power (second) that the filter of another (first) answers; 0 of its own."""
    least_snr: float
    """Power ratio of one output of gain 0 dB that some finder is expected to hear."""


FrontEnd = Detector | Groups | Mixed


def front_end(
    config: Config,
    layout: Layout | Scattered,
    tones: Float[np.ndarray, " c"],
    where: str = "receiver.array",
    calls: Sequence[Call] = (),
) -> FrontEnd:
    """Settle what finds calls of some tones [Hz] in the outputs of a layout.

    `where` the layout is from is said in refusals; `calls`: where they are no tones, or off the
    raster, what is sent, in samples of ``receiver.sample_rate``. Raises InputError as `detector`
    does, for microphones too far apart, and for detection settings that lines on faces alone can
    meet.

    >>> from pipistrelle.arrays.array_file import microphones_of
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
    """Find bearings and delays of everything that stands out of the noise, as `detect` does.

    `around`: returns the outputs also at lags where a call is only partly in the record, as many
    more at each end (`BandFilters.around`); without it, sound that the record cuts is not known.
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
    """Select the detections of one call of a caller with its own clock, and its direct call.

    It is all of the caller's tone in a stretch of the frame [s]; the other arguments are as those
    of `find_calls`.
    """
    begin, until = stretch
    inside = (begin <= found.delay) & (found.delay < until)
    near = detections_at(found, inside | (found.caller != caller))  # others may leak
    if found.direct is not None:
        lags = Lags(start, interval, pulse)
        near = replace(near, direct=_direct_of(matched, end, near, lags))
    return detections_at(near, near.caller == caller)


def _leaking(config: Config, tones: Sequence[Call]) -> Config:
    """Return settings by which a tone counts where others do not leak as much, off the raster."""
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
    """Settle what finds calls of which some are no tones."""
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
    """Return the outputs of the tones, and silence of a vehicle that sends none."""
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
    """Find the calls of tones and others; those that the record cuts only hide fainter ones."""
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
    """Return a caller's outputs of the microphones of a group."""
    return np.ascontiguousarray(outputs()[:, row, caller, members])


def _cross_talk_in(found: Detections, end: Mixed, lags: Lags) -> Bool[np.ndarray, " m"]:
    """Tell which detections may be what a louder call of another leaves in their filter."""
    near = np.abs(found.delay[:, np.newaxis] - found.delay) <= lags.pulse * lags.interval
    share = end.talk[found.caller[:, np.newaxis], found.caller]
    left = np.where(near, MARGIN * share * found.power, 0.0)
    return found.power <= left.max(axis=1, initial=0.0)


def _direct_of(
    matched: Complex[np.ndarray, "l f c e"], end: FrontEnd, found: Detections, lags: Lags
) -> DirectCalls:
    """Find the direct calls among detections; of a call that is no tone its peak tells when."""
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
    """Refuse settings that only line arrays on faces know."""
    for key, usual in (("snapshots", "maxima"), ("overlaps", "merge")):
        if (found := getattr(config.detection, key)) != usual:
            raise InputError(
                f"detection.{key}: found {found!r}, which only lines on faces have, for the "
                f"microphones of {where} that hear all around; expected {usual!r}"
            )


def _refuse_far_apart(place: Float[np.ndarray, "k 2"], wavelength: float, where: str) -> None:
    """Refuse a microphone whose nearest neighbour is too many waves away."""
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
    """Return the outputs of a group.

    A circle takes the phase of a call that starts at their lag; where a tone makes whole turns from
    lag to lag, it is that of the record's start.
    """
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
    """Find the calls that one group hears."""
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
    """Return how much earlier than the vehicle's centre a line hears sound from a bearing [s]."""
    x, y = end.centre[g] / end.speed_of_sound
    return x * np.cos(bearing) + y * np.sin(bearing)


def _direct_of_groups(
    matched: Complex[np.ndarray, "l 1 c e"], end: Groups, found: Detections, lags: Lags
) -> DirectCalls:
    """Find the direct call of every caller but the vehicle, and its edge, as `direct_calls`."""
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
    """Return the lag at which a group hears the first call of a tone begin, and its deviation."""
    outputs, finder = _outputs(matched, end, g, lags), end.finders[g]
    if isinstance(finder, Circle):
        return edge_around(outputs, finder, lags, at)
    return front_edge(outputs[:, np.newaxis], at[0], 0, at[1], lags.pulse, MIN_EDGE_ENERGY)
