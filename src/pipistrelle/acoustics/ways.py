"""The ways of sound: from every target to the vehicle, how long, from where, how fast they shrink.

Targets are the landmarks, which stand, and then the callers but the vehicle, which may move. Ways
are those of the moment of emission, frozen while sound is on them; of motion the speeds along them
are kept.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.callers import VEHICLE, Caller
from pipistrelle.config import InputError
from pipistrelle.geometry import wrap


@dataclass(frozen=True, slots=True, kw_only=True)
class Ways:
    """From all targets, landmarks and then callers, to the vehicle at each of k emissions.

    Attributes
    ----------
    landmarks : int
        How many of the targets are landmarks.
    target : (1 or k, t, 2) [m]
    offset : (k, t, 2) [m]
        From the vehicle.
    homeward : (k, t) [m]
    bearing : (k, t) [rad]
    closing : (k, t) [m/s]
        The vehicle's speed towards each.
    drift : (1 or k, t, 2) [m/s] or None
        Velocities of the targets; None where all stand.
    approach : (k, t) [m/s] or 0
        The targets' speed towards the vehicle.
    """

    landmarks: int
    target: Float[np.ndarray, "_ t 2"]
    offset: Float[np.ndarray, "k t 2"]
    homeward: Float[np.ndarray, "k t"]
    bearing: Float[np.ndarray, "k t"]
    closing: Float[np.ndarray, "k t"]
    drift: Float[np.ndarray, "_ t 2"] | None
    approach: Float[np.ndarray, "k t"] | float


def ways_home(
    poses: Float[np.ndarray, "k 3"],
    velocities: Float[np.ndarray, "k 2"],
    landmarks: Float[np.ndarray, "n 2"],
    callers: Sequence[Caller],
) -> Ways:
    """Measure the ways from all targets to the vehicle, as they are when it calls.

    Parameters
    ----------
    poses : (k, 3) [m, m, rad]
        Of the vehicle at each emission.
    velocities : (k, 2) [m/s]
    landmarks : (n, 2) [m]
    callers : sequence of Caller
        The vehicle first; paths of k places.

    Returns
    -------
    Ways

    Examples
    --------
    >>> from pipistrelle.acoustics.callers import callers_of
    >>> from pipistrelle.config import Config
    >>> ahead, beacon = np.array([[5.0, 0.0]]), np.array([0.0, 9.0])
    >>> drive = {"poses": np.zeros((1, 3)), "velocities": np.array([[2.0, 0.0]])}
    >>> ways = ways_home(**drive, landmarks=ahead, callers=callers_of(Config(), beacon))
    >>> ways.homeward, ways.closing
    (array([[5., 9.]]), array([[2., 0.]]))
    """
    others = callers[VEHICLE + 1 :]
    target = _joined(landmarks, [caller.place for caller in others])
    offset = target - poses[:, np.newaxis, :2]
    homeward = np.hypot(offset[..., 0], offset[..., 1])
    east, north = velocities[:, :1], velocities[:, 1:]
    drift, approach, still = None, 0.0, np.zeros(2)
    with np.errstate(divide="ignore", invalid="ignore"):  # refused by name, later
        closing = (offset[..., 0] * east + offset[..., 1] * north) / homeward
        if any(caller.velocity is not None for caller in others):
            velocity = [still if c.velocity is None else c.velocity for c in others]
            drift = _joined(np.zeros_like(landmarks), velocity)
            approach = -np.sum(drift * offset, axis=-1) / homeward
    return Ways(
        landmarks=len(landmarks),
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
    """Put the callers' rows, of one emission or of each, behind the landmarks'."""
    rows = [np.reshape(np.asarray(caller), (-1, 1, 2)) for caller in callers]
    parts = [landmarks[np.newaxis], *rows]
    count = max(len(part) for part in parts)
    return np.concatenate([np.broadcast_to(p, (count, *p.shape[1:])) for p in parts], axis=1)


def turn_of_sound(
    incoming: Float[np.ndarray, "_ t 2"], offset: Float[np.ndarray, "k t 2"]
) -> Float[np.ndarray, "k t"]:
    """Angle from the way in to the way on to the vehicle: pi is straight back.

    Parameters
    ----------
    incoming : (1 or k, t, 2) [m]
        From the caller to each target.
    offset : (k, t, 2) [m]
        From the vehicle to each target.

    Returns
    -------
    (k, t) [rad]

    Examples
    --------
    >>> there = np.array([[[3.0, 0.0], [0.0, 2.0]]])
    >>> turn_of_sound(there, there) / np.pi
    array([[1., 1.]])
    """
    x, y = incoming[..., 0], incoming[..., 1]
    u, v = -offset[..., 0], -offset[..., 1]
    return np.arctan2(x * v - y * u, x * u + y * v)


def refuse_impossible(
    poses: Float[np.ndarray, "k 3"], ways: Ways, callers: Sequence[Caller]
) -> None:
    """Refuse points that coincide and coordinates that are not finite.

    Parameters
    ----------
    poses : (k, 3) [m, m, rad]
    ways : Ways
    callers : sequence of Caller

    Raises
    ------
    InputError
        With the two that coincide, or are nowhere.
    """
    between = [ways.homeward]
    for itself in range(ways.landmarks, ways.homeward.shape[1]):
        before = ways.target[:, :itself] - ways.target[:, itself : itself + 1]
        apart = np.hypot(before[..., 0], before[..., 1])
        between.append(np.broadcast_to(apart, (len(poses), itself)))
    paths = np.hstack(between)
    nearest, farthest = paths.min(axis=1, initial=math.inf), paths.max(axis=1, initial=0.0)
    good = (nearest > 0.0) & (farthest < math.inf) & np.isfinite(poses[:, 2])
    if good.all():
        return
    bad, others = int(np.argmin(good)), [caller.name for caller in callers[VEHICLE + 1 :]]
    names = [f"landmark {i}" for i in range(1, ways.landmarks + 1)] + others
    ends = [f"vehicle to {name}" for name in names]
    for itself, name in enumerate(others, start=ways.landmarks):
        ends += [f"{name} to {other}" for other in names[:itself]]
    found = [f"{e}: {d} m" for e, d in zip(ends, paths[bad], strict=True) if not 0.0 < d < math.inf]
    raise InputError(
        f"world around the pose {poses[bad]}: found {', '.join(found) or 'no finite heading'}; "
        f"expected {', '.join(['vehicle', *others])} and landmarks at distinct, finite points; "
        "move them apart (scenario.clearance keeps them so)"
    )
