"""Paths of sound from every target to the vehicle: length, direction and rate of change.

Targets are the landmarks, which stand still, followed by all callers but the vehicle, which may
move. Paths are frozen at the moment of emission; of the motion only the speeds along them are kept.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.callers import VEHICLE, Caller
from pipistrelle.acoustics.surfaces import reflecting_points
from pipistrelle.config import InputError
from pipistrelle.geometry import wrap


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundPaths:
    """Paths from t targets, landmarks and then callers, to the vehicle at each of k emissions."""

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
    """Velocities of the targets; None where all stand [m/s]."""
    approach: Float[np.ndarray, "k t"] | float
    """Speed of the targets towards the vehicle [m/s]."""


def paths_to_vehicle(
    poses: Float[np.ndarray, "k 3"],
    velocities: Float[np.ndarray, "k 2"],
    landmarks: Float[np.ndarray, "n 2"],
    callers: Sequence[Caller],
) -> SoundPaths:
    """Measure the paths from all targets to the vehicle, as they are when it calls.

    `poses` [m, m, rad]: of the vehicle at each emission; `velocities` [m/s]; `landmarks` [m];
    `callers`: the vehicle first; paths of k places.

    >>> from pipistrelle.acoustics.callers import callers_of
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
    """Measure the paths from the points of the targets' surfaces that reflect a caller's sound.

    The points move with caller and vehicle, but the path is the shortest one, so that to first
    order its length changes with its ends alone.

    `paths`: from the targets' centres; `caller`: its number in the list of callers; `extent` [m]:
    radius of each target; 0 of a point. The paths are the same to the bit where all targets are
    points.

    >>> from pipistrelle.acoustics.callers import callers_of
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
    """Measure the paths from all targets, the first of which are landmarks, to the vehicle."""
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
    """Append the callers' positions (or velocities) to those of the landmarks."""
    rows = [np.reshape(np.asarray(caller), (-1, 1, 2)) for caller in callers]
    parts = [landmarks[np.newaxis], *rows]
    count = max(len(part) for part in parts)
    return np.concatenate([np.broadcast_to(p, (count, *p.shape[1:])) for p in parts], axis=1)


def turn_of_sound(
    incoming: Float[np.ndarray, "_ t 2"], offset: Float[np.ndarray, "k t 2"]
) -> Float[np.ndarray, "k t"]:
    """Return the angle by which a target turns sound; pi is straight back.

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
    """Refuse points that coincide, coordinates that are not finite, and points within a body.

    `paths`: from the targets' centres; `extent` [m]: radius of each target; 0 of a point.
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
