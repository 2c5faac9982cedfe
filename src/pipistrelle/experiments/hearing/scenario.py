"""The true world of a simulated mission: a noisy drive, landmarks around it, and the callers.

A `World` gives known parts (landmarks, course, callers); the rest is drawn into a `Scenario`.

Callers on independent clocks call between the vehicle's calls, zero or more times in a frame. Such
a call is dated, and its geometry taken, at the arrival of its direct sound, a time that the vehicle
can measure. Between control steps all motion is linear, with a constant turn rate.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.acoustics.emitter import Bodies
from pipistrelle.acoustics.paths import VEHICLE, Caller, callers_of, moves
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import CallerConfig, Config, InputError, ScenarioConfig
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.drives import LabelledPoints
from pipistrelle.experiments.hearing.caller_paths import Surroundings, callers_among, place_at
from pipistrelle.experiments.hearing.landmark_fields import landmarks_in
from pipistrelle.experiments.hearing.trajectories import (
    TIME_TOLERANCE,
    Course,
    course_of,
    driven,
    true_motion,
)
from pipistrelle.geometry import path_at, points_at, wrap
from pipistrelle.settings import Layer


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Known parts of a simulated world, such as landmarks or the course; the rest is random."""

    name: str
    landmarks: Float[np.ndarray, "n 2"] | None = None
    """Positions of the landmarks [m]."""
    bodies: Bodies | None = None
    """Shapes of these landmarks."""
    course: Course | None = None
    callers: tuple[CallerConfig, ...] | None = None
    """Callers besides the vehicle, unless the settings list callers."""
    settings: Layer = field(default_factory=dict)
    """Settings of the world, with the lowest priority."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Contents of the files that define the world."""


ALL_DRAWN = World(name="any")
"""A world without known parts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A random world; its n landmarks have the labels 1 to n, caller j (1, 2, ...) has n + j."""

    time: Float[np.ndarray, " t"]
    path: Float[np.ndarray, "t 3"]
    """True poses, the start first [m, m, rad]."""
    controls: Float[np.ndarray, "t-1 2"]
    """Nominal speed [m/s] and steering angle [rad] of each step, as the estimators know them."""
    landmarks: Float[np.ndarray, "n 2"]
    callers: tuple[Caller, ...]
    """The vehicle first; a moving caller has a position for each time."""
    bodies: Bodies | None = None
    """Shapes of the landmarks; None: from the settings."""


def world_of(config: Config, iteration: int = 0, world: World = ALL_DRAWN) -> Scenario:
    """Generate the random world that the settings' seed and a world number determine."""
    key = stream_key(config.seed, iteration, "scenario")
    return draw_scenario(config, np.random.default_rng(key), world)


def draw_scenario(config: Config, rng: np.random.Generator, world: World = ALL_DRAWN) -> Scenario:
    """Generate a random world: the vehicle's path, the beacon, landmarks and listed callers.

    Listed callers are drawn last, so path and landmarks do not depend on them; landmarks keep clear
    of caller positions given by a world's folder. Parts known to `world` are not drawn.

    Bradley & Abaid, Sec. IV.

    >>> world = draw_scenario(Config(), np.random.default_rng(7))
    >>> world.path.shape, world.landmarks.shape
    ((1501, 3), (50, 2))
    """
    setup, motion = config.scenario, true_motion(config.motion)
    time = np.arange(setup.steps + 1) * setup.step
    bias = (config.motion.speed_bias, config.motion.turn_bias)
    course = course_of(setup, motion) if world.course is None else world.course
    path, controls = driven(course, setup, motion, rng, bias)
    given = config.callers is None and world.callers is not None
    settings, first = world.callers if given else config.callers, deepcopy(rng)
    clear_of = [path[:, :2]]
    if world.landmarks is not None and world.bodies is not None:
        clear_of.append(world.landmarks[np.isfinite(world.bodies.radius)])
    beacon = np.zeros(2) if given else _place_beacon(setup, clear_of, rng)
    landmarks = world.landmarks
    if landmarks is None:
        still = [one.place for one in settings or () if one.way == "stand" and one.place]
        clear = np.array(still, dtype=float).reshape(-1, 2) if given else beacon[np.newaxis]
        landmarks = landmarks_in(setup, path[:, :2], clear, rng)
    vehicle, *others = callers_of(config, beacon)
    if settings is not None:
        there = {"path": path[:, :2], "landmarks": landmarks, "course": course}
        around = Surroundings(config=config, time=time, **there)
        others = callers_among(around, settings, rng, None if given else first)
    drawn = Scenario(
        time=time,
        path=path,
        controls=controls,
        landmarks=landmarks,
        callers=(vehicle, *others),
        bodies=world.bodies,
    )
    return _mission_of(drawn, setup.vehicle)


def _mission_of(world: Scenario, vehicle: int) -> Scenario:
    """Swap the roles of the vehicle and a second vehicle; each keeps its tone and level."""
    if vehicle == 1:
        return world
    others = [j for j, caller in enumerate(world.callers) if caller.mission is not None]
    if vehicle > 1 + len(others):
        raise InputError(
            f"scenario.vehicle: found {vehicle}, but {1 + len(others)} in this world have a "
            'mission; expected one of them, or more callers with course = "mission"'
        )
    j = others[vehicle - 2]
    one, other = world.callers[VEHICLE], world.callers[j]
    if other.calls is not None:
        raise InputError(
            f"scenario.vehicle: found {vehicle}, which has a clock of its own ({other.key}), "
            "expected one that calls when the first does; take out its period, offset, jitter and "
            "times"
        )
    path, controls = other.mission or (world.path, world.controls)
    mission = {"place": world.path[:, :2], "heading": world.path[:, 2]}
    callers = list(world.callers)
    callers[VEHICLE] = replace(one, **_voice(other))
    callers[j] = replace(other, **_voice(one), **mission, mission=(world.path, world.controls))
    return replace(world, path=path, controls=controls, callers=tuple(callers))


def _voice(caller: Caller) -> dict[str, Any]:
    """Return the fields that describe a caller's call: frequency, level, key and sound."""
    return {name: getattr(caller, name) for name in ("frequency", "level_db", "key", "sound")}


def standing_landmarks(scenario: Scenario) -> LabelledPoints:
    """Return labels and positions [m] of all landmarks and fixed callers, by rising label."""
    landmarks, others = scenario.landmarks, _others(scenario).items()
    standing = {label: np.asarray(c.place) for label, c in others if not moves(c)}
    labels = np.array([*range(1, len(landmarks) + 1), *standing])
    return labels, np.vstack((landmarks, *standing.values()))


def moving_callers(scenario: Scenario) -> dict[int, Caller]:
    """Return the callers that move, by rising label; the map does not contain them."""
    return {label: caller for label, caller in _others(scenario).items() if moves(caller)}


def _others(scenario: Scenario) -> dict[int, Caller]:
    """Return all callers except the vehicle, by their labels as landmarks."""
    return dict(enumerate(scenario.callers[VEHICLE + 1 :], start=len(scenario.landmarks) + 1))


def caller_labels(scenario: Scenario) -> Int[np.ndarray, " c"]:
    """Return the landmark label of each caller, by caller number; UNLABELLED for the vehicle."""
    labels = len(scenario.landmarks) + np.arange(len(scenario.callers))
    labels[VEHICLE] = UNLABELLED
    return labels


def assumed_motion(config: Config) -> Motion:
    """Return the motion model that estimators assume: the true model with `assumed` settings."""
    given = config.assumed.model_dump(exclude_none=True, exclude={"speed_of_sound"})
    return true_motion(config.motion.model_copy(update=given))


def _place_beacon(
    setup: ScenarioConfig, clear_of: Sequence[Float[np.ndarray, "_ 2"]], rng: np.random.Generator
) -> Float[np.ndarray, "2"]:
    """Draw a random position of the beacon, clear of the path and of bodies with a radius."""
    beacon = place_at(setup.beacon_distance, setup, rng, clear_of)
    if beacon is None:
        found = f"found {setup.beacon_distance:g} m, but no bearing there is {setup.clearance:g} m "
        fix = "expected another distance, or a smaller scenario.clearance"
        raise InputError(f"scenario.beacon_distance: {found}clear of the path and of bodies; {fix}")
    return beacon


def calls_heard(
    scenario: Scenario, setup: ScenarioConfig, speed_of_sound: float
) -> list[tuple[float, int]]:
    """List calls of callers with separate clocks: (time of direct arrival [s], caller index).

    Times are rounded to microseconds, or to a control step within `TIME_TOLERANCE`. Arrivals before
    the vehicle's first call, which begins the first frame, or after the end of the path are
    excluded.
    """
    first, last = setup.steps_per_frame * setup.step, float(scenario.time[-1])
    calls: list[tuple[float, int]] = []
    for j, caller in enumerate(scenario.callers):
        if caller.calls is not None:
            place = _places_at(caller.calls, scenario.time, np.asarray(caller.place))
            heard = caller.calls
            for _ in range(4):  # converges fast, as the vehicle is far slower than sound
                away = place - path_at(heard.clip(0.0, last), scenario.time, scenario.path)[:, :2]
                heard = caller.calls + np.hypot(*away.T) / speed_of_sound
            clock = scenario.time
            near = clock[np.abs(clock[:, np.newaxis] - heard).argmin(axis=0)]
            heard = np.where(np.abs(near - heard) <= TIME_TOLERANCE, near, heard.round(6))
            calls += [(time, j) for time in heard.tolist() if first <= time <= last]
    return sorted(calls)


def with_times(scenario: Scenario, times: Sequence[float]) -> Scenario:
    """Return a world with its paths interpolated at additional times; controls are unchanged."""
    time = np.union1d(scenario.time, np.array(times))
    path = path_at(time, scenario.time, scenario.path)
    clock, callers = scenario.time, [*scenario.callers]
    for j, caller in enumerate(callers[VEHICLE + 1 :], start=VEHICLE + 1):
        if moves(caller):
            there: dict[str, Any] = {"place": _places_at(time, clock, np.asarray(caller.place))}
            if caller.velocity is not None:
                there["velocity"] = _places_at(time, clock, np.asarray(caller.velocity))
            if caller.heading is not None:
                there["heading"] = wrap(np.interp(time, clock, np.unwrap(caller.heading)))
            callers[j] = replace(caller, **there)
    return replace(scenario, time=time, path=path, callers=tuple(callers))


def _places_at(
    times: Float[np.ndarray, " m"], clock: Float[np.ndarray, " t"], place: np.ndarray
) -> Float[np.ndarray, "m 2"]:
    """Interpolate a caller's positions at given times; a fixed position is repeated."""
    if place.ndim == 1:
        return np.tile(place, (len(times), 1))
    return points_at(times, clock, place)
