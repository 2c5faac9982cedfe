r"""Positions and paths of callers: given or drawn points, circles, lines, walks, routes, missions.

Callers are drawn after the path and landmarks of the world, each from its own random stream, so
adding a caller changes nothing else. The first is drawn as the paper's beacon, and without a
position of its own it is the beacon.

The velocity of a walk is an Ornstein-Uhlenbeck process along each axis,

.. math:: v_{k+1} = a v_k + \sqrt{1 - a^2} \, \sigma \, n_k, \qquad a = e^{-\Delta_t / \tau},

with normal n; the caller is reflected at the edge of the landmarks' disc.

A mission is the drive of a second vehicle: the course of the first, rotated about the centre by a
drawn angle, with other noise, clear of the landmarks and of the first vehicle.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.call import sound_of
from pipistrelle.acoustics.paths import Caller, moves
from pipistrelle.config import (
    SWEEP,
    TONE,
    CallConfig,
    CallerConfig,
    Config,
    InputError,
    ScenarioConfig,
    caller_names,
)
from pipistrelle.experiments.hearing.landmark_fields import MAX_DRAWS, nearest
from pipistrelle.experiments.hearing.trajectories import Course, course_of, driven, true_motion
from pipistrelle.geometry import points_at, wrap
from pipistrelle.refusals import refusal
from pipistrelle.settings import CALLERS, Layer
from pipistrelle.text_tables import Schema, check_unique, place_of

WALK_STD, WALK_MEMORY = 0.5, 10.0
"""Defaults of a walk: standard deviation of the velocity along an axis [m/s] and its time constant
[s]."""

ROUTE = Schema(
    file="route",
    row="a row is a position of a caller, which rests before the first and after the last",
    columns=("time", "x", "y"),
    optional=("heading",),
)
"""Columns of the file that the key ``route`` of a caller names."""

Points = Float[np.ndarray, "_ 2"]


def with_routes(layer: Layer) -> Layer:
    """Replace the file names of callers' routes in a layer of settings by the files' rows."""
    if CALLERS not in layer:
        return layer
    given = layer[CALLERS]
    return layer | {CALLERS: given._replace(value=routes_read(given.value, given.where))}


def routes_read(callers: Any, where: str) -> Any:
    """Replace names of route files by their rows in an unvalidated list of callers."""
    if not isinstance(callers, (list, tuple)):
        return callers
    tables = [
        one.model_dump(mode="json", exclude_none=True) if isinstance(one, CallerConfig) else one
        for one in callers
    ]
    return [
        one | {"route": _rows(one["route"], f"{where}.{number}.route")}
        if isinstance(one, dict) and isinstance(one.get("route"), str)
        else one
        for number, one in enumerate(tables, start=1)
    ]


def _rows(path: str, where: str) -> list[list[float]]:
    """Read a caller's route file: rows of time [s], x, y [m] and, if given, heading [rad]."""
    try:
        table = ROUTE.read(Path(path))
        check_unique(table, "time")
        silent = np.isnan(table.column["heading"])
        if silent.any() and not silent.all():
            place, fix = place_of(table, int(np.argmax(silent))), "fill it in"
            raise refusal(place, "no heading", "one in every row or in none", fix)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    columns = [*table.column.values()][: 3 if silent.all() else 4]
    return np.column_stack(columns).tolist()


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """The world that callers are added to: settings, and the vehicle's path and landmarks."""

    config: Config
    time: Float[np.ndarray, " t"]
    path: Float[np.ndarray, "t 2"]
    """Positions of the vehicle [m]."""
    landmarks: Points
    course: Course | None = None
    """Course of the vehicle; None: the course that the settings name."""


def callers_among(
    around: Surroundings,
    settings: Sequence[CallerConfig],
    rng: np.random.Generator,
    first: np.random.Generator | None = None,
) -> tuple[Caller, ...]:
    """Create the callers that the settings list, with random positions where none are given.

    `first` replaces the random stream of the first caller by the state of `rng` before the beacon
    was drawn. Each caller has a position, or one for each time; the vehicle is excluded.

    >>> still = Surroundings(
    ...     config=Config(), time=np.arange(3.0), path=np.zeros((3, 2)), landmarks=np.empty((0, 2))
    ... )
    >>> boat = CallerConfig(course="circle", radius=4.0, speed=1.0, centre=(9.0, 0.0))
    >>> (one,) = callers_among(still, [boat], np.random.default_rng(7))
    >>> one.name, one.frequency, np.hypot(*(one.place - [9.0, 0.0]).T)
    ('beacon', 30000.0, array([4., 4., 4.]))
    """
    streams: list[np.random.Generator] = rng.spawn(len(settings))
    if first is not None:
        streams[:1] = [first] * len(settings[:1])
    callers: list[Caller] = []
    names = caller_names(tuple(settings))
    for j, (one, name, stream) in enumerate(zip(settings, names, streams, strict=True), start=1):
        caller = _placeless(one, name, callers, around)
        _check_speed(caller.key, one, around.config)
        is_beacon = first is not None and j == 1 and one.distance is None
        standing = np.array([c.place for c in callers if not moves(c)]).reshape(-1, 2)
        taken = [] if is_beacon and one.way == "stand" else [around.landmarks, standing]
        if one.way == "mission":
            found = _mission(around, taken, stream)
            place = None if found is None else found[0][:, :2]
            heading = None if found is None else found[0][:, 2]
            caller = replace(caller, mission=found, heading=heading)
        elif one.way == "route":
            place, heading = _route(one, around)
            caller = replace(caller, heading=heading)
        else:
            place = _WAYS[one.way](one, around, taken, stream)
        if place is None:
            raise _no_place(caller.key, one, around)
        calls = _times(caller.key, one, around, stream)
        callers.append(replace(caller, place=place, calls=calls))
        world = around.config.scenario.world if first is None else None
        file = "" if world is None else f"{Path(world) / 'world.toml'}: "
        _check_apart(callers, around, file + caller.key + ".route" * (one.way == "route"))
    return tuple(callers)


def _placeless(
    one: CallerConfig, name: str, before: Sequence[Caller], around: Surroundings
) -> Caller:
    """Return a caller with name, call and level from its settings, but without a position."""
    config, key = around.config, f"callers.{len(before) + 1}"
    fields = set(CallConfig.model_fields)
    call = config.beacon.model_dump(include=fields)
    if before:
        call |= {"call": TONE, "frequency": None}
    call |= one.model_dump(exclude_none=True, include=fields)
    if call["call"] != SWEEP and call["frequency"] is None:
        fix = "give one, for only the first may have the beacon's"
        raise refusal(f"{key}.frequency", "none", "a tone of its own", fix)
    sent = CallConfig.model_validate({key: v for key, v in call.items() if v is not None})
    usual = config.emitter if one.way == "mission" else config.beacon
    return Caller(
        name=name,
        frequency=sent.centre,
        level_db=usual.level_db if one.level_db is None else one.level_db,
        key=key,
        sound=sound_of(sent, config.emitter.call_duration, key),
    )


def place_at(
    distance: float, setup: ScenarioConfig, rng: np.random.Generator, clear_of: Iterable[Points]
) -> Float[np.ndarray, "2"] | None:
    """Draw a random position at `distance` [m] from the centre, clear of points; else None."""
    clear_of = [*clear_of]
    for _ in range(MAX_DRAWS):
        direction = rng.uniform(-math.pi, math.pi)
        place = distance * np.array([math.cos(direction), math.sin(direction)])
        if all(nearest(points, place) >= setup.clearance for points in clear_of):
            return place
    return None


def _stand(
    one: CallerConfig, around: Surroundings, taken: Sequence[Points], rng: np.random.Generator
) -> Float[np.ndarray, "2"] | None:
    """Return a fixed caller's position: given, or random and clear of paths and landmarks."""
    if one.place is not None:
        return np.array(one.place)
    setup = around.config.scenario
    return place_at(_distance(one, setup), setup, rng, [around.path, *taken])


def _circle(
    one: CallerConfig, around: Surroundings, taken: Sequence[Points], rng: np.random.Generator
) -> Float[np.ndarray, "t 2"] | None:
    """Return a caller's path on a circle at constant speed, from a random starting angle."""
    setup = around.config.scenario
    radius = setup.beacon_distance if one.radius is None else one.radius
    turned = (setup.speed if one.speed is None else one.speed) / radius * around.time

    def drawn() -> Float[np.ndarray, "t 2"]:
        angle = rng.uniform(-math.pi, math.pi) + turned
        circle = radius * np.column_stack((np.cos(angle), np.sin(angle)))
        return circle + np.array(one.centre or (0.0, 0.0))

    return _away_from_vehicle(drawn, around)


def _walk(
    one: CallerConfig, around: Surroundings, taken: Sequence[Points], rng: np.random.Generator
) -> Float[np.ndarray, "t 2"] | None:
    """Return a caller's random walk, reflected at the edge of the disc of landmarks."""
    setup = around.config.scenario
    std = WALK_STD if one.speed_std is None else one.speed_std
    kept = math.exp(-setup.step / (WALK_MEMORY if one.memory is None else one.memory))
    fresh = std * math.sqrt(1.0 - kept * kept)

    def drawn() -> Float[np.ndarray, "t 2"]:
        begin = np.array(one.place or place_at(_distance(one, setup), setup, rng, []))
        noise = rng.standard_normal((around.time.size, 2))
        path, limit = np.empty_like(noise), max(setup.radius, math.hypot(*begin))
        path[0], velocity = begin, std * noise[0]
        for k in range(1, around.time.size):
            velocity = kept * velocity + fresh * noise[k]
            path[k] = path[k - 1] + velocity * setup.step
            away = math.hypot(*path[k])
            if away > limit:
                normal = path[k] / away
                path[k] = max(2.0 * limit - away, 0.0) * normal
                velocity = velocity - 2.0 * (velocity @ normal) * normal
        return path

    return _away_from_vehicle(drawn, around)


def _line(one: CallerConfig, around: Surroundings, *_: Any) -> Float[np.ndarray, "t 2"]:
    """Return a caller's path along the closed line through its way-points, at constant speed."""
    speed = around.config.scenario.speed if one.speed is None else one.speed
    points = np.array([*(one.waypoints or ()), *(one.waypoints or ())[:1]])
    along = np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())
    if along[-1] == 0.0:
        return np.tile(points[0], (around.time.size, 1))
    here = np.mod(speed * around.time, along[-1])
    return points_at(here, along, points)


def _route(
    one: CallerConfig, around: Surroundings
) -> tuple[Float[np.ndarray, "t 2"], Float[np.ndarray, " t"] | None]:
    """Interpolate a caller's route at all times: positions [m], and headings [rad] if given."""
    rows: Any = _rows(one.route, "callers") if isinstance(one.route, str) else one.route
    time, x, y, *heading = np.array(rows).T
    place = points_at(around.time, time, np.column_stack((x, y)))
    if not heading:
        return place, None
    return place, wrap(np.interp(around.time, time, np.unwrap(heading[0])))


def _mission(
    around: Surroundings, taken: Sequence[Points], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t-1 2"]] | None:
    """Generate random poses and controls of a second vehicle, clear of the first; else None."""
    setup, drive = around.config.scenario, around.config.motion
    motion, bias = true_motion(drive), (drive.speed_bias, drive.turn_bias)
    course = around.course or course_of(setup, motion)
    for _ in range(MAX_DRAWS):
        angle = rng.uniform(-math.pi, math.pi)
        path, controls = driven(course, setup, motion, rng, bias)
        c, s = math.cos(angle), math.sin(angle)
        places = path[:, :2] @ np.array([[c, s], [-s, c]])
        away = [np.hypot(*(places - around.path).T).min()]
        away += [min(nearest(places, point) for point in points) for points in taken if len(points)]
        if min(away) >= setup.clearance:
            return np.column_stack((places, wrap(path[:, 2] + angle))), controls
    return None


_WAYS: dict[str, Callable[..., np.ndarray | None]] = {
    "stand": _stand,
    "circle": _circle,
    "walk": _walk,
    "waypoints": _line,
}


def _distance(one: CallerConfig, setup: ScenarioConfig) -> float:
    """Return a caller's distance from the centre [m], by default the beacon's distance."""
    return setup.beacon_distance if one.distance is None else one.distance


def _times(
    key: str, one: CallerConfig, around: Surroundings, rng: np.random.Generator
) -> Float[np.ndarray, " m"] | None:
    """Return the call times [s] of a caller with an independent clock; None for other callers."""
    if not one.own_clock:
        return None
    if one.times is not None:
        return np.array(one.times)
    setup = around.config.scenario
    period = setup.steps_per_frame * setup.step if one.period is None else one.period
    jitter = 0.0 if one.jitter is None else one.jitter
    if jitter > 0.1 * period:
        most = f"at most a tenth of the period of {period:g} s"
        raise refusal(f"{key}.jitter", f"{jitter:g} s", most, "make it smaller")
    times = np.arange(0.0 if one.offset is None else one.offset, around.time[-1], period)
    return np.unique((times + jitter * rng.standard_normal(len(times))).clip(0.0))


def _check_apart(callers: Sequence[Caller], around: Surroundings, where: str) -> None:
    """Raise if the last caller is exactly at the vehicle or another caller at a vehicle's call."""
    *others, last = callers
    step, shape = around.config.scenario.steps_per_frame, around.path.shape
    here = np.broadcast_to(np.asarray(last.place), shape)
    for name, place in [("vehicle", around.path), *((one.name, one.place) for one in others)]:
        met = np.flatnonzero(~(here - np.asarray(place))[step::step].any(axis=1))
        if met.size:
            k = step * (1 + int(met[0]))
            x, y = here[k].tolist()
            raise InputError(
                f"{where}: at {around.time[k]:.15g} s {last.name} is where {name} is, x {x:g} m, "
                f"y {y:g} m; expected callers apart from each other and from the vehicle; move one"
            )


def _check_speed(key: str, one: CallerConfig, config: Config) -> None:
    """Raise if a caller's speed or its standard deviation is too large for the speed of sound."""
    c = config.medium.sound_speed
    for name, most in (("speed", c), ("speed_std", c / 5.0)):
        speed = getattr(one, name)
        if speed is not None and not abs(speed) < most:
            expected = f"less than {most:.3g} m/s, for sound is to be faster"
            raise refusal(f"{key}.{name}", f"{speed:g} m/s", expected, "slow it down")


def _away_from_vehicle(
    drawn: Callable[[], Float[np.ndarray, "t 2"]], around: Surroundings
) -> Float[np.ndarray, "t 2"] | None:
    """Generate random paths of a caller until a path is clear of the vehicle; else None."""
    for _ in range(MAX_DRAWS):
        path = drawn()
        offset = path - around.path
        if np.hypot(*offset.T).min() >= around.config.scenario.clearance:
            return path
    return None


def _no_place(key: str, one: CallerConfig, around: Surroundings) -> InputError:
    """Return the InputError for a caller without any position or path that is clear enough."""
    setup = around.config.scenario
    if one.way == "mission":
        what = "it comes nearer than that to the vehicle, a landmark or a caller in every drive"
        where = f"{key}: found no mission {setup.clearance:g} m clear, for {what}; expected another"
    elif one.way == "stand":
        what = f"no direction there is {setup.clearance:g} m clear of path, landmarks and callers"
        where = f"{key}.distance: found {_distance(one, setup):g} m, but {what}; expected another"
    else:
        what = f"it comes nearer than {setup.clearance:g} m to the vehicle wherever it sets out"
        where = f"{key}: found a {one.way} on which {what}; expected another"
    return InputError(f"{where}, or a smaller scenario.clearance")
