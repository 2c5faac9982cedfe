"""Listening: a path through a world -> what is heard at each frame, by either engine.

The noise and the other callers' sound are those of the world and shared by all beamwidths, drawn
once and keyed by the frame alone.

The dense engine records until the vehicle calls again, 100,000 samples of 40 channels in the
paper's half a second less the blanked call. The block engine stops after the last arrival. What
follows is noise alone: no label could be given to anything in it, so the scans follow the same law,
and only the count of clutter lacks the false alarms of the silence (about 0.01 a frame).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Complex, Int

from pipistrelle.acoustics.arrivals import (
    Arrivals,
    arrivals_at,
    arrivals_of_emissions,
    through_piston,
    through_pistons,
)
from pipistrelle.acoustics.callers import VEHICLE, callers_at
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.arrays.layout import Layout, square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks, record_samples
from pipistrelle.arrays.sampling import BLOCK, Sampling, block_shape, blocks_to_hear, sampling
from pipistrelle.config import Config
from pipistrelle.detection.direct import own_alone
from pipistrelle.detection.faces import Heard, average_faces, same_echo, unlabelled
from pipistrelle.detection.matched import filter_blocks, filter_samples
from pipistrelle.detection.scans import NOBODY
from pipistrelle.detection.snapshots import Detections, Detector, detect, detector
from pipistrelle.experiments.hearing.oracle import faintest_level_db, label_detections
from pipistrelle.experiments.hearing.scenario import Scenario, caller_labels

TOGETHER = 25
"""Frames whose arrivals are computed at a time: arrays of a few thousand keep NumPy busy."""

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, the frames done and their number."""


def listen(
    scenario: Scenario,
    config: Config,
    radii: Sequence[float],
    *,
    iteration: int = 0,
    beam: Callable[..., Arrivals] | None = None,
    layout: Layout | None = None,
    find: Callable[..., Detections] = detect,
    oracle: Callable[..., Int[np.ndarray, " d"]] | None = label_detections,
    progress: Progress | None = None,
) -> tuple[tuple[Heard, ...], ...]:
    """Hear every frame of a path, once for all beamwidths.

    Parameters
    ----------
    scenario : Scenario
        Its callers count, not the settings' tones and levels.
    config : Config
    radii : sequence of [m]
        Radii of the vehicle's piston; ``config.emitter.radius`` is not used.
    iteration : int
        Number of the world, part of the noise's key.
    beam : callable, optional
        Gives the vehicle's call its directivity, as `through_piston` does: by default the piston
        with the off-axis loss of the settings.
    layout : Layout, optional
        The arrays; those of the settings by default.
    find : callable
        Finds calls in the matched filter's output, as `detect` does.
    oracle : callable, optional
        Tells whose echo each detection is, as `label_detections` does, by the truth. None: nobody
        tells, rows bear no label, and a stage of association has to find one
        (`pipistrelle.estimation.association`).
    progress : callable, optional

    Returns
    -------
    tuple, one per radius, of tuples of Heard, one per frame

    Raises
    ------
    InputError
        When the sampling does not fit the tones, a path the times, or points of the world coincide.

    Notes
    -----
    Bradley & Abaid, Sec. II.

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
    ears = layout or square_of_four(config.receiver)
    rig = _rig(config, scenario, ears, find, oracle)
    purpose = "noise" if setup.vehicle == 1 else f"noise of {setup.vehicle}"
    engine = _dense if config.receiver.engine == "dense" else _blocks
    beams: tuple[list[Heard], ...] = tuple([] for _ in radii)
    frames = range(setup.steps_per_frame, len(scenario.path), setup.steps_per_frame)
    beam = beam or partial(through_piston, off_axis=config.emitter.off_axis)
    emissions = _emissions(scenario, frames, radii, config, beam)
    for number, (k, aimed) in enumerate(zip(frames, emissions, strict=True), start=1):
        key = stream_key(config.seed, iteration, purpose, number)
        recorded = engine(aimed, rig, key)
        for heard, arrivals, detections in zip(beams, aimed, recorded, strict=True):
            heard.append(_heard(float(scenario.time[k]), detections, arrivals, rig))
        if progress:
            progress("listening", number, len(frames))
    return tuple(tuple(heard) for heard in beams)


class Workspace:
    """Arrays that every frame uses anew: fresh memory costs more than the arithmetic on it."""

    def __init__(self) -> None:
        self._flat: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> Complex[np.ndarray, "..."]:
        """Return the array of a name, in a shape; what it held is anybody's guess."""
        size = math.prod(shape)
        if name not in self._flat or self._flat[name].size < size:
            self._flat[name] = np.empty(size + size // 4, dtype=np.complex128)
        return self._flat[name][:size].reshape(shape)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rig:
    """What every frame of a path is heard with."""

    config: Config
    layout: Layout
    sampling: Sampling
    detector: Detector
    find: Callable[..., Detections]
    oracle: Callable[..., Int[np.ndarray, " d"]] | None
    faintest_db: float
    callers: Int[np.ndarray, " c"]
    beamed: Bool[np.ndarray, " c"]
    workspace: Workspace


def _rig(
    config: Config,
    scenario: Scenario,
    layout: Layout,
    find: Callable[..., Detections],
    oracle: Callable[..., Int[np.ndarray, " d"]] | None,
) -> _Rig:
    """Settle what every frame of a path is heard with."""
    settled = sampling(config, scenario.callers)
    finder = detector(config, layout, settled.tones)
    return _Rig(
        config=config,
        layout=layout,
        sampling=settled,
        detector=finder,
        find=find,
        oracle=oracle,
        faintest_db=faintest_level_db(
            finder.threshold,
            elements=layout.position.size,
            samples=settled.pulse * settled.block,
            noise_std=settled.noise_std,
            margin_db=config.association.margin_db,
        ),
        callers=caller_labels(scenario) if oracle else NOBODY,
        beamed=np.array([caller.heading is not None for caller in scenario.callers]),
        workspace=Workspace(),
    )


def _emissions(
    scenario: Scenario,
    frames: Sequence[int],
    radii: Sequence[float],
    config: Config,
    beam: Callable[..., Arrivals],
) -> Iterator[list[Arrivals]]:
    """Yield each frame's arrivals, one per piston; many frames are computed at a time."""
    for first in range(0, len(frames), TOGETHER):
        steps = np.array(frames[first : first + TOGETHER])
        poses = scenario.path[steps]
        velocities = (poses[:, :2] - scenario.path[steps - 1, :2]) / config.scenario.step
        callers = callers_at(scenario.callers, scenario.time, steps)
        emission, count = arrivals_of_emissions(
            poses, velocities, scenario.landmarks, callers, config, scenario.bodies
        )
        aimed = [
            through_pistons(
                emission, callers, beam, radius=radius, speed_of_sound=config.air.celerity
            )
            for radius in radii
        ]
        end = np.cumsum(count)
        for rows in map(slice, end - count, end):
            yield [arrivals_at(arrivals, rows) for arrivals in aimed]


def _heard(time: float, detections: Detections, arrivals: Arrivals, rig: _Rig) -> Heard:
    """Average a frame's detections over the faces, by the truth's labels where it tells them."""
    config, gates = rig.config, rig.config.association
    if rig.oracle is None:
        delay_gate = gates.delay_gate * config.emitter.pulse
        label = same_echo(detections, delay_gate=delay_gate, bearing_gate=gates.bearing_gate)
    else:
        label = rig.oracle(
            detections,
            arrivals,
            rig.layout,
            gates,
            pulse=config.emitter.pulse,
            faintest_db=rig.faintest_db,
        )
        if detections.direct is not None and rig.beamed.any():
            direct = own_alone(detections.direct, label, rig.callers, rig.beamed)
            detections = replace(detections, direct=direct)
    heard = average_faces(
        time,
        detections,
        label,
        averaging=config.detection.averaging,
        speed_of_sound=config.believed_celerity,
        callers=rig.callers,
    )
    return unlabelled(heard) if rig.oracle is None else heard


def _blocks(aimed: Sequence[Arrivals], rig: _Rig, key: int) -> Iterator[Detections]:
    """Yield, per beam, what is detected of its arrivals from block sums."""
    layout, settled, space, pulse = rig.layout, rig.sampling, rig.workspace, rig.sampling.pulse
    own, others = _parted(aimed[0])
    shape = block_shape(blocks_to_hear(aimed[0], settled), layout, settled)
    shared = noise_blocks(shape[0], layout, settled, key, out=space.array("shared", shape))
    add_echo_blocks(shared, arrivals_at(aimed[0], others), layout, settled)
    lags = (shape[0] - pulse + 1, *shape[1:])
    for left, arrivals in zip(range(len(aimed) - 1, -1, -1), aimed, strict=True):
        signal = shared
        if left:  # the last beam may write on what it shares
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
        yield rig.find(matched, rig.detector, start=pulse * BLOCK, interval=BLOCK, pulse=pulse)


def _parted(arrivals: Arrivals) -> tuple[slice | np.ndarray, slice | np.ndarray]:
    """Tell the rows that go through a piston from those that all beamwidths share."""
    if arrivals.departure is None:
        own = np.count_nonzero(arrivals.caller == VEHICLE)  # they come first
        return slice(own), slice(own, None)
    beamed = (arrivals.caller == VEHICLE) | np.isfinite(arrivals.departure)
    return beamed, ~beamed


def _dense(aimed: Sequence[Arrivals], rig: _Rig, key: int) -> Iterator[Detections]:
    """Yield the same from every sample until the next call, in single precision."""
    settled, setup = rig.sampling, rig.config.scenario
    length = settled.pulse * settled.block
    period = math.floor(setup.steps_per_frame * setup.step / BLOCK) - settled.pulse
    for arrivals in aimed:
        samples = record_samples(
            max(period, blocks_to_hear(arrivals, settled)),
            arrivals,
            rig.layout,
            settled,
            np.random.default_rng(key),
            single=True,
        )
        matched = filter_samples(
            samples,
            tones=settled.tones,
            rate=settled.rate,
            length=length,
            noise_std=settled.noise_std,
        )
        start, interval = settled.pulse * BLOCK, 1.0 / settled.rate
        yield rig.find(matched, rig.detector, start=start, interval=interval, pulse=length)
