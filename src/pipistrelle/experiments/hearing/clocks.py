"""Callers with clocks of their own: when they call, and when each call is heard.

Such a caller calls between the vehicle's calls, once in a frame, twice or not at all. What it calls
is heard from when its sound comes straight to the vehicle; the geometry of a call, its echoes'
among it, is that of this moment, for which the vehicle can know the time. Between two control steps
everybody goes straight and turns evenly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.callers import VEHICLE, Caller, moves
from pipistrelle.config import ScenarioConfig
from pipistrelle.experiments.hearing.scenario import Scenario
from pipistrelle.geometry import path_at, points_at, wrap

MICROSECOND = 1e-6
"""Two times that are no farther apart are one [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedCall:
    """One call of a caller with its own clock."""

    caller: int
    """Its number among the callers."""
    time: float
    """When it is heard directly [s]."""


def calls_heard(
    scenario: Scenario, setup: ScenarioConfig, speed_of_sound: float
) -> list[TimedCall]:
    """List the calls of callers with their own clocks, in the order in which they are heard.

    Nothing is heard before the vehicle's first call, which begins the first frame, and after the
    path's end.
    """
    first, last = setup.steps_per_frame * setup.step, float(scenario.time[-1])
    calls = []
    for j, caller in enumerate(scenario.callers):
        if caller.calls is not None:
            place = _places_at(caller.calls, scenario.time, np.asarray(caller.place))
            heard = caller.calls
            for _ in range(4):  # the vehicle is far slower than sound
                away = place - path_at(heard.clip(0.0, last), scenario.time, scenario.path)[:, :2]
                heard = caller.calls + np.hypot(*away.T) / speed_of_sound
            heard = _on_clock(heard, scenario.time)
            calls += [TimedCall(caller=j, time=t) for t in heard.tolist() if first <= t <= last]
    return sorted(calls, key=lambda call: call.time)


def with_times(scenario: Scenario, times: Sequence[float]) -> Scenario:
    """Return a world with its paths interpolated at further times; controls are unchanged."""
    time = np.union1d(scenario.time, np.array(times))
    path = path_at(time, scenario.time, scenario.path)
    callers = tuple(
        _with_times(caller, time, scenario.time) if moves(caller) else caller
        for caller in scenario.callers[VEHICLE + 1 :]
    )
    return replace(scenario, time=time, path=path, callers=(scenario.callers[VEHICLE], *callers))


def _with_times(
    caller: Caller, time: Float[np.ndarray, " t"], clock: Float[np.ndarray, " n"]
) -> Caller:
    """Return a caller with its path interpolated at other times."""
    heading, velocity = caller.heading, caller.velocity
    return replace(
        caller,
        place=_places_at(time, clock, np.asarray(caller.place)),
        velocity=None if velocity is None else _places_at(time, clock, np.asarray(velocity)),
        heading=None if heading is None else wrap(np.interp(time, clock, np.unwrap(heading))),
    )


def _on_clock(
    times: Float[np.ndarray, " m"], clock: Float[np.ndarray, " t"]
) -> Float[np.ndarray, " m"]:
    """Round times to microseconds, or to a time of the clock within a microsecond."""
    near = clock[np.abs(clock[:, np.newaxis] - times).argmin(axis=0)]
    return np.where(np.abs(near - times) <= MICROSECOND, near, times.round(6))


def _places_at(
    times: Float[np.ndarray, " m"], clock: Float[np.ndarray, " t"], place: np.ndarray
) -> Float[np.ndarray, "m 2"]:
    """Return the places of a caller at some times, by linear interpolation."""
    if place.ndim == 1:
        return np.tile(place, (len(times), 1))
    return points_at(times, clock, place)
