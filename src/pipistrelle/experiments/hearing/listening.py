"""Simulated listening: measurements of each frame along a path, by sums over blocks or in bands.

A frame lasts from each call of the vehicle to the next. The noise is drawn once for all beamwidths,
keyed by the number of the frame, and the arrivals from other callers are shared by all.

A frame is simulated until the last arrival. The rest would be noise, which gets no label, so
labelled scans have the same distribution; only the count of clutter lacks the false alarms of the
silence (about 0.01 a frame).

Callers without a clock call when the vehicle does. A call of a caller with a clock belongs to
all frames that receive its sounds; arrivals that begin less than the duration of a call before
the vehicle's next call are lost.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Int

from pipistrelle.acoustics.arrivals import (
    Arrivals,
    arrivals_at,
    arrivals_of_emissions,
    arrivals_together,
    through_piston,
    through_pistons,
)
from pipistrelle.acoustics.call import Call, ToneBurst, band_of, window_lags
from pipistrelle.acoustics.paths import VEHICLE, callers_at
from pipistrelle.acoustics.propagation import Medium, medium_of
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.arrays.layout import Layout, Scattered, layout_of
from pipistrelle.arrays.receiver import BandRecorder, InBands, add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import Sampling, block_shape, blocks_to_hear, sampling
from pipistrelle.config import Config
from pipistrelle.detection.direct import own_alone
from pipistrelle.detection.front_end import (
    FrameMeasurements,
    FrontEnd,
    average_faces,
    call_in,
    find_calls,
    front_end,
    unlabelled_scan,
    with_edge_floor,
)
from pipistrelle.detection.matched import BandFilters, Workspace, filter_blocks
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.detection.snapshots import Detections, Detector, detections_at, joined
from pipistrelle.experiments.hearing.oracle import faintest_level_db, label_detections
from pipistrelle.experiments.hearing.scenario import (
    Scenario,
    caller_labels,
    calls_heard,
    with_times,
)

EMISSIONS_AT_ONCE = 25
"""Emissions whose arrivals are computed together; a few thousand rows keep NumPy efficient."""


class CallHeard(NamedTuple):
    """Arrivals at the vehicle of a single call from a caller with an independent clock."""

    number: int
    """Number among all such calls of the world."""
    caller: int
    time: float
    """Time of the direct arrival [s]."""
    until: float
    """Time of the direct arrival of the same caller's next call [s]."""
    sounds: list[Arrivals]
    """Arrivals for each piston, with delays from `time`."""


class Frame(NamedTuple):
    """All arrivals at the vehicle between one of its calls and the next."""

    time: float
    """Time of the vehicle's call [s]."""
    aimed: list[Arrivals]
    """Arrivals for each piston, with delays from the vehicle's call."""
    calls: list[CallHeard]
    """Calls from callers on independent clocks."""


def frames_of(
    scenario: Scenario,
    radii: Sequence[float],
    config: Config,
    beam: Callable[..., Arrivals],
    medium: Medium | None = None,
) -> Iterator[Frame]:
    """Yield each frame's arrivals at the vehicle, for several radii [m] of its piston emitter."""
    setup, medium = config.scenario, medium or medium_of(config.medium)
    calls = calls_heard(scenario, setup, medium.speed_of_sound)
    begin = scenario.time[setup.steps_per_frame :: setup.steps_per_frame]
    world = with_times(scenario, [time for time, _ in calls]) if calls else scenario
    own_clock = [j for j, caller in enumerate(scenario.callers) if caller.calls is not None]
    emissions = partial(_emissions, world, radii=radii, config=config, beam=beam, medium=medium)
    heard = _calls_heard(world, calls, emissions, medium.speed_of_sound)
    span = setup.steps_per_frame * setup.step - config.emitter.call_duration
    last = np.array([one.time + one.sounds[0].delay.max() for one in heard])
    first = np.array([one.time for one in heard])
    steps = np.searchsorted(world.time, begin)
    for time, aimed in zip(begin.tolist(), emissions(steps), strict=True):
        near = [heard[i] for i in np.flatnonzero((first < time + span) & (last >= time))]
        if own_clock:
            aimed = [
                _together(one, own_clock, [(h.time - time, h.sounds[r]) for h in near], span)
                for r, one in enumerate(aimed)
            ]
        yield Frame(time=time, aimed=aimed, calls=near)


def _together(
    sounds: Arrivals, own_clock: Sequence[int], calls: Sequence[tuple[float, Arrivals]], span: float
) -> Arrivals:
    """Replace the arrivals of independent callers in a frame by arrivals of their timed `calls`."""
    parts = [arrivals_at(sounds, ~np.isin(sounds.caller, own_clock))]
    for after, heard in calls:
        shifted = replace(heard, delay=heard.delay + after)
        parts.append(arrivals_at(shifted, (shifted.delay >= 0.0) & (shifted.delay < span)))
    return arrivals_together(parts)


def _calls_heard(
    world: Scenario,
    calls: Sequence[tuple[float, int]],
    emissions: Callable[[Int[np.ndarray, " k"]], Iterator[list[Arrivals]]],
    speed_of_sound: float,
) -> list[CallHeard]:
    """Compute the arrivals at the vehicle of every call from callers with independent clocks."""
    following = dict.fromkeys(range(len(world.callers)), np.inf)
    until = []
    for time, caller in reversed(calls):
        until.append(following[caller])
        following[caller] = time
    steps = np.searchsorted(world.time, [time for time, _ in calls])
    heard = []
    for number, ((time, caller), aimed) in enumerate(zip(calls, emissions(steps), strict=True)):
        place = np.asarray(world.callers[caller].place)
        place = place if place.ndim == 1 else place[steps[number]]
        straight = np.hypot(*(place - world.path[steps[number], :2])) / speed_of_sound
        own = (arrivals_at(one, one.caller == caller) for one in aimed)
        sounds = [replace(one, delay=one.delay - straight) for one in own]
        heard.append(CallHeard(number, caller, time, until[-1 - number], sounds))
    return heard


def _emissions(
    scenario: Scenario,
    steps: Int[np.ndarray, " k"],
    radii: Sequence[float],
    config: Config,
    beam: Callable[..., Arrivals],
    medium: Medium,
) -> Iterator[list[Arrivals]]:
    """Yield the arrivals of all emitters' calls at each given step, for each piston radius."""
    for first in range(0, len(steps), EMISSIONS_AT_ONCE):
        now = steps[first : first + EMISSIONS_AT_ONCE]
        poses, took = scenario.path[now], scenario.time[now] - scenario.time[now - 1]
        velocities = (poses[:, :2] - scenario.path[now - 1, :2]) / took[:, np.newaxis]
        callers = callers_at(scenario.callers, scenario.time, now)
        there = scenario.landmarks, callers, config, scenario.bodies, medium
        emission, count = arrivals_of_emissions(poses, velocities, *there)
        through = partial(through_pistons, emission, callers, beam)
        aimed = [through(radius=r, speed_of_sound=medium.speed_of_sound) for r in radii]
        end = np.cumsum(count)
        for rows in map(slice, end - count, end):
            yield [arrivals_at(arrivals, rows) for arrivals in aimed]


Progress = Callable[[str, int, int], None]
"""Called with the stage's name, the number of frames done and the total."""
Keep = Callable[[int, Arrivals, np.ndarray | InBands], None]
"""Called with a frame's number, its arrivals, and its block sums or sound in bands."""


def listen(
    scenario: Scenario,
    config: Config,
    radii: Sequence[float],
    *,
    iteration: int = 0,
    beam: Callable[..., Arrivals] | None = None,
    layout: Layout | Scattered | None = None,
    call: Callable[[float, float], Call] = ToneBurst,
    medium: Medium | None = None,
    find: Callable[..., Detections] = find_calls,
    oracle: Callable[..., Int[np.ndarray, " d"]] = label_detections,
    labels: bool = True,
    keep: Keep | None = None,
    progress: Progress | None = None,
) -> tuple[tuple[FrameMeasurements, ...], ...]:
    """Simulate and detect the echoes in every frame of a drive, for several beamwidths.

    Bradley & Abaid, Sec. II.

    Parameters
    ----------
    scenario : Scenario
        Its callers are used, not the tones and levels of the settings.
    config : Config
    radii : sequence of [m]
        Radii of the vehicle's piston; ``config.emitter.radius`` is not used.
    iteration : int
        Number of the world, part of the noise's key.
    beam : callable, optional
        Directivity of the vehicle's call, as `through_piston`; by default the piston with the
        settings' off-axis loss.
    layout, medium : optional
        Arrays and medium of the sound, by default from the settings. The front end still assumes
        ``assumed.speed_of_sound``.
    call : callable
        Makes the `Call` of each caller that has none, from frequency [Hz] and duration [s].
    find, oracle : callable
        Detector of calls and labels of detections, as `find_calls` and `label_detections`.
    labels : bool
        False: frames also hold their measurements without labels, for data association
        (`pipistrelle.estimation.data_association`).
    keep : callable, optional
        Receives each frame's number, from 1 on, its arrivals, and its block sums, which the next
        frame overwrites, or its sound in the calls' bands.
    progress : callable, optional

    Returns
    -------
    tuple, for each radius, of tuples of FrameMeasurements
        An item per frame, and per call from an independent clock that gives measurements.

    Raises
    ------
    InputError
        If the sampling does not fit the tones, a path does not fit the times, or points coincide.

    Examples
    --------
    >>> from pipistrelle.config import ScenarioConfig
    >>> from pipistrelle.experiments.hearing.scenario import draw_scenario
    >>> config = Config(scenario=ScenarioConfig(steps=8))
    >>> world = draw_scenario(config, np.random.default_rng(7))
    >>> wide, narrow = listen(world, config, (0.0025, 0.025))
    >>> len(wide), wide[1].rows.time
    (2, 1.0)
    """
    setup = config.scenario
    settled = sampling(config, scenario.callers, call=call, medium=medium)
    rig = _Rig(config, scenario, layout or layout_of(config), settled, oracle, labels)
    purpose = "noise" if setup.vehicle == 1 else f"noise of {setup.vehicle}"
    recorded = rig.in_bands if settled.banded else rig.blocks
    beams: tuple[list[FrameMeasurements], ...] = tuple([] for _ in radii)
    beam = beam or partial(through_piston, off_axis=config.emitter.directivity_law)
    calls: dict[int, tuple[CallHeard, list[list[Detections]]]] = {}
    for number, frame in enumerate(frames_of(scenario, radii, config, beam, medium), start=1):
        key = stream_key(config.seed, iteration, purpose, number)
        for timed in frame.calls:
            calls.setdefault(timed.number, (timed, [[] for _ in radii]))
        for r, record in enumerate(recorded(frame.aimed, key)):
            cut = {"cut": record.cut} if record.cut else {}
            found = find(record.matched, rig.front_end, **record.lags, **cut)
            if keep is not None:
                keep(number, frame.aimed[r], record.sums)
            for timed in frame.calls:
                calls[timed.number][1][r].append(rig.of_call(timed, frame.time, record, found))
            if rig.own_clock.any():
                found = detections_at(found, ~rig.own_clock[found.caller])
            beams[r].append(rig.heard(frame.time, found, frame.aimed[r]))
        if progress:
            progress("listening", number, setup.steps // setup.steps_per_frame)
    for timed, parts in calls.values():
        for heard, part, sounds in zip(beams, parts, timed.sounds, strict=True):
            between = rig.heard(timed.time, joined(part), sounds)
            if between.rows.landmark.size:
                heard.append(replace(between, between=True))
    return tuple(tuple(sorted(heard, key=lambda one: one.rows.time)) for heard in beams)


class _Record(NamedTuple):
    """A frame's matched-filter output with its time axis; the next frame reuses the buffers."""

    matched: Complex[np.ndarray, "l f c e"]
    start: float
    """Delay of lag 0 [s]."""
    interval: float
    """Time between two lags [s]."""
    pulse: int
    """Half width of the matched filter's response to a call, in lags."""
    sums: Complex[np.ndarray, "b f c e"] | InBands
    """Block sums before the filter, or the sound in the calls' bands."""
    cut: int = 0
    """Lags at each end, outside the time axis, at which a call is only partly in the record."""

    @property
    def lags(self) -> dict[str, Any]:
        """Time axis of the output (start, interval, pulse length), as a detector's arguments."""
        return {"start": self.start, "interval": self.interval, "pulse": self.pulse}


class _Rig:
    """Simulator and detector of sound: settings, arrays and buffers that all frames use."""

    def __init__(
        self,
        config: Config,
        scenario: Scenario,
        layout: Layout | Scattered,
        settled: Sampling,
        oracle: Callable[..., Int[np.ndarray, " d"]],
        labels: bool,
    ) -> None:
        self.config, self.layout, self.sampling = config, layout, settled
        self.oracle, self.labels = oracle, labels
        self.front_end = front_end(config, layout, settled.tones, calls=settled.calls)
        self.faintest_db = _faintest_db(self.front_end, layout, settled, config)
        self.callers = caller_labels(scenario)
        self.own_clock = np.array([caller.calls is not None for caller in scenario.callers])
        aimed = [caller.heading is not None for caller in scenario.callers]
        self.missable: Bool[np.ndarray, " c"] = self.own_clock | aimed
        self.workspace = Workspace()
        if settled.banded:
            self.filters = BandFilters(settled.calls, settled.rate)
            self.recorder = BandRecorder(layout, settled)

    def of_call(
        self, call: CallHeard, time: float, record: _Record, found: Detections
    ) -> Detections:
        """Select the detections from a caller's timed call; delays count from that call."""
        after, early = call.time - time, 0.5 * record.interval * record.pulse
        stretch = after - early, call.until - time - early
        whole = record.matched[record.cut : len(record.matched) - record.cut]
        part = call_in(whole, self.front_end, found, call.caller, stretch, **record.lags)
        direct = part.direct and part.direct._replace(delay=part.direct.delay - after)
        return replace(part, delay=part.delay - after, direct=direct)

    def heard(self, time: float, detections: Detections, arrivals: Arrivals) -> FrameMeasurements:
        """Label a frame's detections and average them over the array's faces into measurements."""
        config = self.config
        label = self.oracle(
            detections,
            arrivals,
            self.layout,
            config.matching,
            pulse=config.emitter.call_duration,
            faintest_db=self.faintest_db,
        )
        detections = with_edge_floor(detections, config)
        direct = detections.direct
        if direct is not None and self.missable.any():
            direct = own_alone(direct, label, self.callers, self.missable)
        heard = average_faces(
            time,
            replace(detections, direct=direct),
            label,
            averaging=config.detection.averaging,
            speed_of_sound=config.assumed_sound_speed,
            callers=self.callers,
        )
        return heard if self.labels else self._unlabelled(time, detections, label, heard)

    def _unlabelled(
        self,
        time: float,
        detections: Detections,
        label: Int[np.ndarray, " d"],
        heard: FrameMeasurements,
    ) -> FrameMeasurements:
        """Add to a frame its measurements without labels, and the true label of each.

        An echo's label is taken from its strongest labelled detection, a direct call's from its
        caller.
        """
        scan, echo = unlabelled_scan(time, detections, self.config, self.missable)
        causes = np.full(int(echo.max(initial=-1)) + 1, UNLABELLED)
        for d in np.argsort(detections.power, kind="stable").tolist():
            causes[echo[d]] = causes[echo[d]] if label[d] == UNLABELLED else label[d]
        known = np.flatnonzero(scan.direct >= 0)
        causes[scan.direct[known]] = self.callers[known]
        return replace(heard, unlabelled=scan, causes=causes)

    def blocks(self, aimed: Sequence[Arrivals], key: int) -> Iterator[_Record]:
        """Simulate block sums of each beam's arrivals, and yield their matched-filter output."""
        layout, settled, space = self.layout, self.sampling, self.workspace
        pulse = settled.pulse
        own, others = _parted(aimed[0])
        shape = block_shape(blocks_to_hear(aimed[0], settled, layout), layout, settled)
        shared = noise_blocks(shape[0], layout, settled, key, out=space.array("shared", shape))
        add_echo_blocks(shared, arrivals_at(aimed[0], others), layout, settled)
        lags = (shape[0] - pulse + 1, *shape[1:])
        for left, arrivals in zip(range(len(aimed) - 1, -1, -1), aimed, strict=True):
            signal = shared
            if left:  # the last beam may overwrite the shared sums
                signal = space.array("signal", shape)
                np.copyto(signal, shared)
            add_echo_blocks(signal, arrivals_at(arrivals, own), layout, settled)
            matched = filter_blocks(
                signal,
                pulse=pulse,
                block=settled.block,
                noise_std=settled.noise_std,
                out=space.array("matched", lags),
            )
            yield _Record(matched, pulse * settled.interval, settled.interval, pulse, sums=signal)

    def in_bands(self, aimed: Sequence[Arrivals], key: int) -> Iterator[_Record]:
        """Simulate each beam's arrivals in the calls' bands, and yield the matched outputs."""
        settled, filters, recorder = self.sampling, self.filters, self.recorder
        whole = blocks_to_hear(aimed[0], settled, self.layout) * settled.interval
        cut, interval = filters.cut, filters.interval
        lags = window_lags(whole / interval + cut)
        start = settled.pulse * settled.interval
        before = start - cut * interval
        own, others = _parted(aimed[0])
        shared, noise = recorder.silence(lags), recorder.noise(lags, key)
        recorder.add(shared, arrivals_at(aimed[0], others), lags, before)
        for left, arrivals in zip(range(len(aimed) - 1, -1, -1), aimed, strict=True):
            envelopes = [one.copy() for one in shared] if left else shared
            recorder.add(envelopes, arrivals_at(arrivals, own), lags, before)
            outputs = filters.outputs(envelopes, lags, settled.noise_std, noise)
            shape = len(outputs), *self.layout.shape, lags
            matched = outputs.reshape(shape).transpose(3, 1, 0, 2)
            sums = lags, cut, envelopes, noise
            yield _Record(matched, start, interval, filters.pulse, sums=sums, cut=cut)


def _faintest_db(
    end: FrontEnd, layout: Layout | Scattered, settled: Sampling, config: Config
) -> float:
    """Return the level [dB] of the faintest arrival that a detection may be matched with."""
    if isinstance(end, Detector):
        threshold, elements = end.threshold, layout.shape[1]
    else:
        threshold, elements = 1.0 + end.least_snr, 1
    samples = settled.pulse * settled.block
    if settled.banded:
        samples = round(max(band_of(call, settled.rate).energy for call in settled.calls))
    return faintest_level_db(
        threshold,
        elements=elements,
        samples=samples,
        noise_std=settled.noise_std,
        margin_db=config.matching.margin_db,
    )


def _parted(arrivals: Arrivals) -> tuple[slice | np.ndarray, slice | np.ndarray]:
    """Return the rows of arrivals that depend on the beam, and the rows that all beams share."""
    if arrivals.departure is None:
        own = np.count_nonzero(arrivals.caller == VEHICLE)  # they come first
        return slice(own), slice(own, None)
    beamed = (arrivals.caller == VEHICLE) | np.isfinite(arrivals.departure)
    return beamed, ~beamed
