"""Frames: all that sounds from one call of the vehicle to the next.

A caller without a clock of its own calls when the vehicle does. The calls of the others are heard
in the frames in which their sounds arrive, one or two; what begins to arrive less than a call's
length before the vehicle calls again is drowned.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from pipistrelle.acoustics.arrivals import (
    Arrivals,
    arrivals_at,
    arrivals_of_emissions,
    arrivals_together,
    through_pistons,
)
from pipistrelle.acoustics.callers import callers_at
from pipistrelle.acoustics.medium import Medium, medium_of
from pipistrelle.config import Config
from pipistrelle.experiments.hearing.clocks import TimedCall, calls_heard, with_times
from pipistrelle.experiments.hearing.scenario import Scenario

EMISSIONS_AT_ONCE = 25
"""Emissions whose arrivals are computed at a time: arrays of a few thousand keep NumPy busy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CallHeard:
    """Arrivals that one call of a caller with its own clock brings to the vehicle."""

    number: int
    """Among all such calls of the world."""
    caller: int
    time: float
    """When it is heard directly [s]."""
    until: float
    """When the next call of the same caller is heard directly [s]."""
    sounds: list[Arrivals]
    """One for each piston; their delays count from the time at which it is heard directly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """All arrivals from one call of the vehicle to the next."""

    time: float
    """Of the vehicle's call [s]."""
    aimed: list[Arrivals]
    """One for each piston; their delays count from the vehicle's call."""
    calls: list[CallHeard]
    """Of those with clocks of their own."""


def frames_of(
    scenario: Scenario,
    radii: Sequence[float],
    config: Config,
    beam: Callable[..., Arrivals],
    medium: Medium | None = None,
) -> Iterator[Frame]:
    """Yield the arrivals in each frame of a path, for pistons of several radii [m].

    `medium`: that of the settings by default.
    """
    setup, medium = config.scenario, medium or medium_of(config.medium)
    calls = calls_heard(scenario, setup, medium.speed_of_sound)
    begin = scenario.time[setup.steps_per_frame :: setup.steps_per_frame]
    world = with_times(scenario, [call.time for call in calls]) if calls else scenario
    own_clock = [j for j, caller in enumerate(scenario.callers) if caller.calls is not None]
    heard = _calls_heard(world, calls, radii, config, beam, medium)
    span = setup.steps_per_frame * setup.step - config.emitter.pulse
    last = np.array([one.time + one.sounds[0].delay.max() for one in heard])
    first = np.array([call.time for call in calls])
    steps = np.searchsorted(world.time, begin)
    for time, aimed in zip(
        begin.tolist(), _emissions(world, steps, radii, config, beam, medium), strict=True
    ):
        near = [heard[i] for i in np.flatnonzero((first < time + span) & (last >= time))]
        if own_clock:
            aimed = [
                _together(one, own_clock, [(h.time - time, h.sounds[r]) for h in near], span)
                for r, one in enumerate(aimed)
            ]
        yield Frame(time=time, aimed=aimed, calls=near)


def _together(
    sounds: Arrivals,
    own_clock: Sequence[int],
    calls: Sequence[tuple[float, Arrivals]],
    span: float,
) -> Arrivals:
    """Replace the arrivals of callers with own clocks by those of their calls, delayed by [s]."""
    parts = [arrivals_at(sounds, ~np.isin(sounds.caller, own_clock))]
    for after, heard in calls:
        shifted = replace(heard, delay=heard.delay + after)
        parts.append(arrivals_at(shifted, (shifted.delay >= 0.0) & (shifted.delay < span)))
    return arrivals_together(parts)


def _calls_heard(
    world: Scenario,
    calls: Sequence[TimedCall],
    radii: Sequence[float],
    config: Config,
    beam: Callable[..., Arrivals],
    medium: Medium,
) -> list[CallHeard]:
    """Return the arrivals of each call at the vehicle."""
    following = dict.fromkeys(range(len(world.callers)), np.inf)
    until = []
    for call in reversed(calls):
        until.append(following[call.caller])
        following[call.caller] = call.time
    steps = np.searchsorted(world.time, [call.time for call in calls])
    heard = []
    for number, (call, aimed) in enumerate(
        zip(calls, _emissions(world, steps, radii, config, beam, medium), strict=True)
    ):
        place = np.asarray(world.callers[call.caller].place)
        place = place if place.ndim == 1 else place[steps[number]]
        straight = np.hypot(*(place - world.path[steps[number], :2])) / medium.speed_of_sound
        heard.append(
            CallHeard(
                number=number,
                caller=call.caller,
                time=call.time,
                until=until[-1 - number],
                sounds=[
                    replace(sounds, delay=sounds.delay - straight)
                    for sounds in (arrivals_at(one, one.caller == call.caller) for one in aimed)
                ],
            )
        )
    return heard


def _emissions(
    scenario: Scenario,
    steps: Int[np.ndarray, " k"],
    radii: Sequence[float],
    config: Config,
    beam: Callable[..., Arrivals],
    medium: Medium,
) -> Iterator[list[Arrivals]]:
    """Yield the arrivals of a simultaneous call of all at a step, for each piston.

    Many steps are computed at a time.
    """
    for first in range(0, len(steps), EMISSIONS_AT_ONCE):
        now = steps[first : first + EMISSIONS_AT_ONCE]
        poses, took = scenario.path[now], scenario.time[now] - scenario.time[now - 1]
        velocities = (poses[:, :2] - scenario.path[now - 1, :2]) / took[:, np.newaxis]
        callers = callers_at(scenario.callers, scenario.time, now)
        emission, count = arrivals_of_emissions(
            poses, velocities, scenario.landmarks, callers, config, scenario.bodies, medium
        )
        aimed = [
            through_pistons(
                emission, callers, beam, radius=radius, speed_of_sound=medium.speed_of_sound
            )
            for radius in radii
        ]
        end = np.cumsum(count)
        for rows in map(slice, end - count, end):
            yield [arrivals_at(arrivals, rows) for arrivals in aimed]
