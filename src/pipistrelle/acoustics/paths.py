"""Callers, and the sound paths from every target to the vehicle: length, direction, Doppler speed.

Targets are the landmarks, which are at rest, then all callers but the vehicle, which may move.
Paths are frozen at the moment of emission; of the motion only the speeds along them are used. A
body is a circle in the plane of the map: a vertical cylinder, or a sphere at the height of the
microphones. It reflects at the point of its surface on the path from caller to vehicle.

The first caller is the vehicle, at the microphones. The vehicle and other vehicles, which have a
heading, may have a beam; other callers are omnidirectional, at rest or on a path. All call when the
vehicle does, unless they have an independent clock. Each has its own tone or sweep, which
identifies it. The paper has two: the vehicle and the beacon.

A caller other than the vehicle is also a landmark: it reflects all calls but its own, and its
direct call is received. Landmarks have the labels 1 to n, caller j the label n + j.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.acoustics.call import Call, sound_of
from pipistrelle.config import MAX_OTHERS, Config, InputError
from pipistrelle.geometry import wrap

_MAX_NEWTON_STEPS = 60
"""Most Newton steps; a dozen suffice, even from 1e-6 m before a surface."""
_MAX_LAST_STEP = 1e-13
"""Length of the last Newton step, along the surface [m]."""


def reflecting_points(
    source: Float[np.ndarray, "_ 1 2"],
    receiver: Float[np.ndarray, "k 1 2"],
    centre: Float[np.ndarray, "_ t 2"],
    radius: Float[np.ndarray, " t"],
) -> Float[np.ndarray, "k t 2"]:
    r"""Return the point of each round body on the shortest sound path from source to receiver.

    On the lit side it is the mirror point (Alhazen's problem): at the angle t along the surface,
    from the direction of the receiver, at which both angles of incidence are equal,

    .. math:: i(t; b) = i(w - t; a), \qquad
              i(u; d) = \operatorname{atan2}(d \sin u, d \cos u - r)

    with a and b the distances of source and receiver from the centre, w the angle between them
    there and r the radius. Both sides are monotonic in t. If source and receiver coincide, t = 0:
    the path is radial.

    If the body is between the two, the shortest path is the straight line, of the wave that makes
    the shadow: the point is the nearest to the centre on the line. If the line grazes the surface
    both points are equal, so the point is continuous.

    `source`, `receiver` [m]: outside the bodies; `centre` [m]; `radius` [m]: 0 for a point body.
    Returns [m], to 1e-12 m. A departure: the landmarks of Bradley & Abaid are points.

    Radial, at a right angle, and in the shadow:

    >>> at, here = np.array([[[5.0, 0.0]]]), np.zeros((1, 1, 2))
    >>> callers = np.array([[[0.0, 0.0]], [[5.0, 5.0]], [[9.0, 0.2]]])
    >>> reflecting_points(callers, here, at, np.array([0.3]))[:, 0].round(3)
    array([[4.7  , 0.   ],
           [4.788, 0.212],
           [4.998, 0.111]])
    """
    shape = np.broadcast_shapes(source.shape, receiver.shape, centre.shape)
    point = np.broadcast_to(centre, shape).copy()
    sized = np.flatnonzero(radius)
    middle, r = point[:, sized], radius[sized]
    line = source - receiver
    with np.errstate(invalid="ignore"):  # undefined from a place to itself
        along = np.sum((middle - receiver) * line, axis=-1) / np.sum(line * line, axis=-1)
    crossing = receiver + np.clip(along, 0.0, 1.0)[..., np.newaxis] * line
    between = _length(crossing - middle) < r
    mirror = _mirror_points(source - middle, receiver - middle, r)
    point[:, sized] = np.where(between[..., np.newaxis], crossing, middle + mirror)
    return point


def _mirror_points(
    source: Float[np.ndarray, "k t 2"],
    receiver: Float[np.ndarray, "k t 2"],
    radius: Float[np.ndarray, " t"],
) -> Float[np.ndarray, "k t 2"]:
    """Return the mirror point between source and receiver on circles, relative to their centres."""
    out, home = _length(source), _length(receiver)
    cross = receiver[..., 0] * source[..., 1] - receiver[..., 1] * source[..., 0]
    turn = np.arctan2(cross, np.sum(receiver * source, axis=-1))
    span = np.abs(turn)
    low, high = np.zeros_like(span), span
    near_out, near_home = out / (out - radius), home / (home - radius)  # slopes at an angle of 0
    angle = span * near_out / (near_out + near_home)
    going = np.ones(span.shape, dtype=bool)  # each row stops independently
    for _ in range(_MAX_NEWTON_STEPS):
        here, rise = _incidence(angle, home, radius)
        there, fall = _incidence(span - angle, out, radius)
        short = here < there
        low, high = np.where(short, angle, low), np.where(short, high, angle)
        step = angle - (here - there) / (rise + fall)
        inside = (low <= step) & (step <= high)
        better = np.where(inside, step, 0.5 * (low + high))
        moved = radius * np.abs(better - angle)
        angle = np.where(going, better, angle)
        going &= moved > _MAX_LAST_STEP
        if not going.any():
            break
    unit = receiver / home[..., np.newaxis]
    across = np.stack((-unit[..., 1], unit[..., 0]), axis=-1) * np.sign(turn)[..., np.newaxis]
    cos, sin = np.cos(angle)[..., np.newaxis], np.sin(angle)[..., np.newaxis]
    return radius[:, np.newaxis] * (cos * unit + sin * across)


def _length(offset: Float[np.ndarray, "k t 2"]) -> Float[np.ndarray, "k t"]:
    return np.hypot(offset[..., 0], offset[..., 1])


def _incidence(
    angle: Float[np.ndarray, "k t"],
    distance: Float[np.ndarray, "k t"],
    radius: Float[np.ndarray, " t"],
) -> tuple[Float[np.ndarray, "k t"], Float[np.ndarray, "k t"]]:
    """Return the incidence angle at a circle's point, and its derivative by the point's angle."""
    cos = np.cos(angle)
    along, across = distance * cos - radius, distance * np.sin(angle)
    slope = distance * (distance - radius * cos) / (along * along + across * across)
    return np.arctan2(across, along), slope


VEHICLE = 0
"""Index of the vehicle in every list of callers."""
MAX_CALLERS = 1 + MAX_OTHERS
"""Most callers in a recording."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """An emitter that the vehicle receives, or the vehicle itself."""

    name: str
    """Name in messages and figures."""
    frequency: float
    """Tone, or centre of the band [Hz]."""
    level_db: float
    """Source level at 1 m; for the vehicle, on its axis [dB]."""
    place: Float[np.ndarray, "2"] | Float[np.ndarray, "t 2"] | None = None
    """Position, or one for each time (of a scenario) or emission; None for the vehicle [m]."""
    velocity: Float[np.ndarray, "2"] | Float[np.ndarray, "t 2"] | None = None
    """Velocity at each position; None if at rest, or if `callers_at` computes it from the path
    [m/s]."""
    key: str = ""
    """Its section of the settings, for errors; empty if it has none."""
    heading: Float[np.ndarray, " t"] | None = None
    """Heading of another vehicle's piston at each position [rad]; None without a beam."""
    mission: tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t-1 2"]] | None = None
    """Poses [m, m, rad] and assumed controls of a caller that also maps the world."""
    calls: Float[np.ndarray, " m"] | None = None
    """Increasing times of its calls [s]; None if it calls when the vehicle does."""
    sound: Call | None = None
    """The call; None is a tone burst."""


def callers_of(config: Config, beacon: Float[np.ndarray, "2"]) -> tuple[Caller, Caller]:
    """Return the paper's two callers, vehicle and beacon, with the settings' tones and levels.

    `beacon`: its position [m]. Bradley & Abaid, Sec. II.

    >>> [(caller.name, caller.frequency) for caller in callers_of(Config(), np.zeros(2))]
    [('vehicle', 35000.0), ('beacon', 30000.0)]
    """
    own, other, pulse = config.emitter, config.beacon, config.emitter.call_duration
    return (
        Caller(
            name="vehicle",
            frequency=own.centre,
            level_db=own.level_db,
            key="emitter",
            sound=sound_of(own, pulse, "emitter"),
        ),
        Caller(
            name="beacon",
            frequency=other.centre,
            level_db=other.level_db,
            place=beacon,
            key="beacon",
            sound=sound_of(other, pulse, "beacon"),
        ),
    )


def check_caller(caller: Caller) -> None:
    """Raise if a caller's tone, level, position or velocity is not finite or has a wrong shape.

    >>> check_caller(Caller(name="boat", frequency=30e3, level_db=42.8, place=np.zeros(3)))
    Traceback (most recent call last):
    pipistrelle.config.InputError: caller boat: place: found an array of shape (3,), expected finite
    x and y [m], or a row of them for each time of a path; correct it
    """
    _check(caller, "frequency", "Hz", pairs=False)
    _check(caller, "level_db", "dB", pairs=False)
    if caller.place is not None:
        _check(caller, "place", "m", pairs=True)
    if caller.velocity is not None:
        _check(caller, "velocity", "m/s", pairs=True)


def _check(caller: Caller, part: str, unit: str, *, pairs: bool) -> None:
    """Raise if a value of a caller is not one finite number or, with `pairs`, finite x and y."""
    value = getattr(caller, part)
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):  # text, or rows of unequal lengths
        found = f"{value!r}"
    else:
        found = f"an array of shape {numbers.shape}"
        if numbers.ndim in (1, 2) and numbers.shape[-1] == 2 if pairs else numbers.ndim == 0:
            bad = ~np.isfinite(numbers)
            if not bad.any():
                return
            found = f"{numbers[bad][0]}"
    expected = f"one finite number [{unit}]"
    if pairs:
        expected = f"finite x and y [{unit}], or a row of them for each time of a path"
    raise InputError(
        f"caller {caller.name}: {part}: found {found}, expected {expected}; correct it"
    )


def moves(caller: Caller) -> bool:
    """Return whether a caller other than the vehicle moves.

    >>> [moves(caller) for caller in callers_of(Config(), np.zeros(2))]
    [False, False]
    """
    check_caller(caller)
    path = caller.place is not None and np.ndim(caller.place) == 2
    return caller.velocity is not None or path


def callers_at(
    callers: Sequence[Caller], time: Float[np.ndarray, " t"], steps: Int[np.ndarray, " k"]
) -> tuple[Caller, ...]:
    """Return the callers with their positions and velocities at given times.

    `callers`: the vehicle first; `time` [s]: of the paths; `steps`: indices of times. Missing
    velocities are computed from the steps that end there, as for the vehicle. Returns paths and
    velocities (k, 2); callers at rest are unchanged.

    >>> path = np.array([[0.0, 5.0], [0.5, 5.0], [1.5, 5.0]])
    >>> vehicle, _ = callers_of(Config(), path[0])
    >>> boat = Caller(name="boat", frequency=30e3, level_db=42.8, place=path)
    >>> callers_at((vehicle, boat), np.arange(3) * 0.5, np.array([2]))[1].velocity
    array([[2., 0.]])
    """
    placeless = [j for j, caller in enumerate(callers) if caller.place is None]
    if placeless != [VEHICLE]:
        raise InputError(
            f"callers: found {', '.join(caller.name for caller in callers) or 'none'}; expected "
            "the vehicle first, without a place, and for each of the others a place or a path"
        )
    if callers[VEHICLE].velocity is not None:
        raise InputError(
            f"caller {callers[VEHICLE].name}: found a velocity, expected none; leave it out, for "
            "the vehicle calls on its own path"
        )
    return tuple(_at(caller, time, steps) if moves(caller) else caller for caller in callers)


def _at(caller: Caller, time: Float[np.ndarray, " t"], steps: Int[np.ndarray, " k"]) -> Caller:
    """Return a moving caller with the positions and velocities at some of its times."""
    path, velocity = np.asarray(caller.place), caller.velocity
    shapes = {path.shape, path.shape if velocity is None else np.shape(velocity)}
    if shapes != {(len(time), 2)}:
        raise InputError(
            f"caller {caller.name}: found a path of shape {path.shape}"
            f"{'' if velocity is None else f' and velocities of shape {np.shape(velocity)}'}; "
            f"expected ({len(time)}, 2), a row for each time of the scenario"
        )
    if velocity is None:
        last = (path[steps] - path[steps - 1]) / (time[steps] - time[steps - 1])[:, np.newaxis]
    else:
        last = np.asarray(velocity)[steps]
    heading = None if caller.heading is None else caller.heading[steps]
    return replace(caller, place=path[steps], velocity=last, heading=heading)


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundPaths:
    """Lengths, bearings and speeds of the sound paths from targets to the vehicle, by emission."""

    poses: Float[np.ndarray, "k 3"]
    """Poses of the vehicle [m, m, rad]."""
    velocities: Float[np.ndarray, "k 2"]
    """Velocities of the vehicle [m/s]."""
    landmarks: int
    """Number of landmarks among the targets."""
    target: Float[np.ndarray, "_ t 2"]
    """Positions of the targets [m]."""
    offset: Float[np.ndarray, "k t 2"]
    """From the vehicle to the target [m]."""
    homeward: Float[np.ndarray, "k t"]
    """Length from the target to the vehicle [m]."""
    bearing: Float[np.ndarray, "k t"]
    """Direction of the target, relative to the heading [rad]."""
    closing: Float[np.ndarray, "k t"]
    """Speed of the vehicle towards each target [m/s]."""
    drift: Float[np.ndarray, "_ t 2"] | None
    """Velocities of the targets; None if all are at rest [m/s]."""
    approach: Float[np.ndarray, "k t"] | float
    """Speed of the targets towards the vehicle [m/s]."""


def paths_to_vehicle(
    poses: Float[np.ndarray, "k 3"],
    velocities: Float[np.ndarray, "k 2"],
    landmarks: Float[np.ndarray, "n 2"],
    callers: Sequence[Caller],
) -> SoundPaths:
    """Compute the sound paths from all targets to the vehicle at each emission.

    `poses` [m, m, rad]: of the vehicle; `velocities` [m/s]; `landmarks` [m]; `callers`: the vehicle
    first; paths of k positions.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> from pipistrelle.config import Config
    >>> ahead, beacon = np.array([[5.0, 0.0]]), np.array([0.0, 9.0])
    >>> drive = {"poses": np.zeros((1, 3)), "velocities": np.array([[2.0, 0.0]])}
    >>> paths = paths_to_vehicle(**drive, landmarks=ahead, callers=callers_of(Config(), beacon))
    >>> paths.homeward, paths.closing
    (array([[5., 9.]]), array([[2., 0.]]))
    """
    others = callers[VEHICLE + 1 :]
    target = _joined(landmarks, [caller.place for caller in others])
    drift, still = None, np.zeros(2)
    if any(caller.velocity is not None for caller in others):
        velocity = [still if c.velocity is None else c.velocity for c in others]
        drift = _joined(np.zeros_like(landmarks), velocity)
    return _measured(poses, velocities, len(landmarks), target, drift)


def paths_over_surfaces(
    paths: SoundPaths, caller: int, extent: Float[np.ndarray, " t"]
) -> SoundPaths:
    """Compute the sound paths to the vehicle from the surface points that reflect a caller's sound.

    The points move with caller and vehicle, but as the path is the shortest, the change of its
    length depends to first order only on its ends.

    `paths`: from the targets' centres; `caller`: its number; `extent` [m]: radius of each target, 0
    for a point. If all targets are points, the paths are returned unchanged.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> from pipistrelle.config import Config
    >>> trunk, callers = np.array([[5.0, 0.0]]), callers_of(Config(), np.array([0.0, 9.0]))
    >>> centre = paths_to_vehicle(np.zeros((1, 3)), np.zeros((1, 2)), trunk, callers)
    >>> paths_over_surfaces(centre, VEHICLE, np.array([0.3, 0.0])).homeward
    array([[4.7, 9. ]])
    """
    if not extent.any():
        return paths
    vehicle = paths.poses[:, np.newaxis, :2]
    itself = paths.landmarks + caller - 1
    source = vehicle if caller == VEHICLE else paths.target[:, itself : itself + 1]
    target = reflecting_points(source, vehicle, paths.target, extent)
    return _measured(paths.poses, paths.velocities, paths.landmarks, target, paths.drift)


def _measured(
    poses: Float[np.ndarray, "k 3"],
    velocities: Float[np.ndarray, "k 2"],
    landmarks: int,
    target: Float[np.ndarray, "_ t 2"],
    drift: Float[np.ndarray, "_ t 2"] | None,
) -> SoundPaths:
    """Compute length, bearing and closing speed of the sound paths from targets to the vehicle."""
    offset = target - poses[:, np.newaxis, :2]
    homeward = np.hypot(offset[..., 0], offset[..., 1])
    east, north = velocities[:, :1], velocities[:, 1:]
    approach = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):  # refused by name, later
        closing = (offset[..., 0] * east + offset[..., 1] * north) / homeward
        if drift is not None:
            approach = -np.sum(drift * offset, axis=-1) / homeward
    return SoundPaths(
        poses=poses,
        velocities=velocities,
        landmarks=landmarks,
        target=target,
        offset=offset,
        homeward=homeward,
        bearing=wrap(np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, 2:]),
        closing=closing,
        drift=drift,
        approach=approach,
    )


def _joined(
    landmarks: Float[np.ndarray, "n 2"], callers: Sequence[np.ndarray | None]
) -> Float[np.ndarray, "_ t 2"]:
    """Append the callers' positions or velocities to the landmarks', along the axis of targets."""
    rows = [np.reshape(np.asarray(caller), (-1, 1, 2)) for caller in callers]
    parts = [landmarks[np.newaxis], *rows]
    count = max(len(part) for part in parts)
    return np.concatenate([np.broadcast_to(p, (count, *p.shape[1:])) for p in parts], axis=1)


def turn_of_sound(
    incoming: Float[np.ndarray, "_ t 2"], offset: Float[np.ndarray, "k t 2"]
) -> Float[np.ndarray, "k t"]:
    """Return the turn of the sound at each target [rad]; pi is straight back.

    `incoming` [m]: from the caller to each target; `offset` [m]: from the vehicle to each target.
    Returns [rad].

    >>> there = np.array([[[3.0, 0.0], [0.0, 2.0]]])
    >>> turn_of_sound(there, there) / np.pi
    array([[1., 1.]])
    """
    x, y = incoming[..., 0], incoming[..., 1]
    u, v = -offset[..., 0], -offset[..., 1]
    return np.arctan2(x * v - y * u, x * u + y * v)


def refuse_impossible(
    paths: SoundPaths, callers: Sequence[Caller], extent: Float[np.ndarray, " t"]
) -> None:
    """Raise if points coincide, coordinates are not finite, or a point is within a body.

    `paths`: from the targets' centres; `extent` [m]: radius of each target, 0 for a point.
    """
    between, within = [paths.homeward], [extent]
    for itself in range(paths.landmarks, paths.homeward.shape[1]):
        before = paths.target[:, :itself] - paths.target[:, itself : itself + 1]
        apart = np.hypot(before[..., 0], before[..., 1])
        between.append(np.broadcast_to(apart, (len(paths.poses), itself)))
        within.append(extent[:itself])
    lengths, least = np.hstack(between), np.concatenate(within)
    farthest, heading = lengths.max(axis=1, initial=0.0), paths.poses[:, 2]
    good = (lengths > least).all(axis=1) & (farthest < math.inf) & np.isfinite(heading)
    if good.all():
        return
    bad, others = int(np.argmin(good)), [caller.name for caller in callers[VEHICLE + 1 :]]
    pose = paths.poses[bad]
    names = [f"landmark {i}" for i in range(1, paths.landmarks + 1)] + others
    ends = [f"vehicle to {name}" for name in names]
    for itself, name in enumerate(others, start=paths.landmarks):
        ends += [f"{name} to {other}" for other in names[:itself]]
    found = [
        f"{end}: {path} m" + (f", within its radius of {radius} m" if radius else "")
        for end, path, radius in zip(ends, lengths[bad], least, strict=True)
        if not radius < path < math.inf
    ]
    raise InputError(
        f"world around the pose {pose}: found {', '.join(found) or 'no finite heading'}; "
        f"expected {', '.join(['vehicle', *others])} and landmarks at distinct, finite points, and "
        "nobody within a body; move them apart (scenario.clearance keeps them so)"
    )
