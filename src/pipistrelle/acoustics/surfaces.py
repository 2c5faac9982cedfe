"""Where a body throws sound: the point of its surface on the way from a caller to the vehicle.

In the plane of the map a body is a circle: a vertical cylinder, or a sphere at the ears' height.
"""

import numpy as np
from jaxtyping import Float

_MAX_NEWTON_STEPS = 60
"""Newton steps at most; a dozen do, even from 1e-6 m before a surface."""
_MAX_LAST_STEP = 1e-13
"""Length of the last Newton step, along the surface [m]."""


def reflecting_points(
    source: Float[np.ndarray, "_ 1 2"],
    receiver: Float[np.ndarray, "k 1 2"],
    centre: Float[np.ndarray, "_ t 2"],
    radius: Float[np.ndarray, " t"],
) -> Float[np.ndarray, "k t 2"]:
    r"""Return the points of bodies on the shortest path of sound from a source to a receiver.

    On the lit side it is the mirror's point (Alhazen's problem): at the angle t along the surface,
    from below the receiver, that makes both angles of incidence the same,

    .. math:: i(t; b) = i(w - t; a), \qquad
              i(u; d) = \operatorname{atan2}(d \sin u, d \cos u - r)

    with a and b the distances of source and receiver from the centre, w the angle between them
    there and r the radius. Both sides are monotonic in t. For a source at the receiver's place t =
    0: the echo is straight back, from the distance of the centre less the radius.

    Where the body stands between the two, the least way is the straight one, that of the wave which
    makes the shadow: its point is the one of the line that is nearest the centre. Where the line
    grazes the surface both points are the same, so nothing jumps.

    `source` [m]; `receiver` [m]: both outside the bodies; `centre` [m]; `radius` [m]: 0 of a point,
    which is its own. Returns [m]: to 1e-12 m.

    A departure: the landmarks of Bradley & Abaid are points.

    Straight back, in a right angle, and in the shadow.

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
    with np.errstate(invalid="ignore"):  # no line from a place to itself
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
    """Solve Alhazen's problem by Newton steps kept in a bracket; vectors start at the centres."""
    out, home = _length(source), _length(receiver)
    cross = receiver[..., 0] * source[..., 1] - receiver[..., 1] * source[..., 0]
    turn = np.arctan2(cross, np.sum(receiver * source, axis=-1))
    span = np.abs(turn)
    low, high = np.zeros_like(span), span
    near_out, near_home = out / (out - radius), home / (home - radius)  # slopes at an angle of 0
    angle = span * near_out / (near_out + near_home)
    going = np.ones(span.shape, dtype=bool)  # each by itself: its bits hang on no other
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
    """Return the angle of incidence on a body's surface, and its slope (above 0)."""
    cos = np.cos(angle)
    along, across = distance * cos - radius, distance * np.sin(angle)
    slope = distance * (distance - radius * cos) / (along * along + across * across)
    return np.arctan2(across, along), slope
