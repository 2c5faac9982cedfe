r"""Kernels on a joint Gaussian of a pose and points: predict, update, initialise and drop.

The state is x, y, heading, then two numbers per point. ``size`` is its length in arrays that may be
longer, ``i`` the state index of a point. An update subtracts :math:`W W^T` with
:math:`W = \bar P H^T L^{-T}, L L^T = S`, in the same order in both triangles, so that the
covariance stays exactly symmetric. An update reads only five rows of the covariance, but changes
all, so its columns of W are deferred: a point's rows catch up when they are read, the others
together in one pass over memory, always in the order of the measurements.

The covariance is of the *linear* error, true state minus mean, or of the *right-invariant* error,
which has no heading column in H: ``turns`` multiplies it, 0 for the
invariant and 1 for the linear error.

**Robust losses** (`inflated`): an innovation :math:`\nu` with the expected variance S has the
factor f of `rows.robust_loss` at :math:`\nu^2 / S`, and

.. math:: R' = R + S\,(f - 1)

makes S' = S f: Huber's loss limits the update to that of an innovation of k standard deviations.
Range and bearing are treated separately, a ray by its hypothesis of least innovation. Applied to
innovations as by Karlgaard & Schaub, Journal of Guidance, Control, and Dynamics 30 (2007).

**The right-invariant error** avoids false information on the heading. The linear error is
linearised at means that change between frames. Updates then reduce the variance of the common
heading of vehicle and map, which no measurement observes, so that the filter becomes overconfident
(Julier & Uhlmann, 2001; Huang et al., 2010). The right-invariant error :math:`\xi` moves the mean
by a rigid motion, and shifts each position:

.. math:: \theta = \hat\theta + \xi_\theta, \quad
          p = R(\xi_\theta)\,\hat p + V(\xi_\theta)\,\xi_p, \quad
          l = R(\xi_\theta)\,\hat l + V(\xi_\theta)\,\xi_l

for vehicle and hypotheses, with V the integral of the rotation. Then

- only noise changes it in the motion: F = I, and the noise of a control (:math:`w_p, w_\theta`)
  enters as :math:`\xi_p \mathrel{+}= w_p - J\hat p\,w_\theta`,
  :math:`\xi_l \mathrel{-}= J\hat l\,w_\theta`, with J a rotation by 90 degrees, summed over the
  steps of a frame;
- a measurement's Jacobian has no heading column, wherever it is linearised;
- a new landmark has the row of the vehicle's position, plus independent noise;
- an update moves the whole mean by the exponential of its step.

The velocity of a moving caller is rotated like points. The origin is the start position, so that
large coordinates cost no precision.

Sources: Barrau & Bonnabel, arXiv:1510.06263 (2015); Zhang, Wu, Song, Huang & Dissanayake, IEEE
Robotics and Automation Letters 2 (2017).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.estimation.motion import (
    Controls,
    Durations,
    MotionNumbers,
    PoseCovariance,
    propagate_pose,
)
from pipistrelle.estimation.observations.bearing import bearing_slopes, observe
from pipistrelle.estimation.observations.range import NEAREST, Slopes, range_slopes
from pipistrelle.estimation.observations.rows import Row, robust_loss
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

Mean = Float[np.ndarray, " d"]
"""x, y [m] and heading [rad], then two numbers for each point."""
Covariance = Float[np.ndarray, "d d"]
Labels = Int[np.ndarray, " h"]
"""Label of each point; the hypotheses of a ray are contiguous."""


def rotated_left(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " m"]:
    """Rotate points by 90 degrees to the left, and flatten them to a vector."""
    return (points @ np.array([[0.0, 1.0], [-1.0, 0.0]])).ravel()


@kernel
def linear_part(
    mean: Mean,
    covariance: Covariance,
    origin: Float[np.ndarray, "2"],
    kept: Bool[np.ndarray, " h"],
    with_pose: bool,
    invariant: bool,
) -> tuple[Durations, Float[np.ndarray, "k k"]]:
    """Return mean and covariance of selected hypotheses in x and y, perhaps with the pose."""
    at, size = np.empty(mean.size, np.int64), 0
    for i in range(mean.size):
        if with_pose if i < 3 else kept[(i - 3) // 2]:
            at[size], size = i, size + 1
    part, linear, rotated = np.empty(size), np.empty((size, size)), np.zeros(size)
    for k in range(size):
        i = at[k]
        along_x = i == 0 or (i > 2 and i % 2 == 1)
        part[k] = mean[i] if i == 2 else mean[i] + origin[0 if along_x else 1]
        if invariant and i != 2:
            rotated[k] = -mean[i + 1] if along_x else mean[i - 1]
    heading, variance = covariance[2][at[:size]], covariance[2, 2]
    for k in range(size):
        row = covariance[at[k]]
        for j in range(size):
            lever = rotated[k] * heading[j] + rotated[j] * heading[k]
            linear[k, j] = row[at[j]] + lever + rotated[k] * rotated[j] * variance
    return part, linear


@no_alloc
def shifted_covariance(P: Covariance, x: float, y: float, shifted: PoseCovariance) -> None:
    """Convert a pose's covariance from the invariant error to the error in x, y and heading.

    Writes M P M^T with M = [[1, 0, -y], [0, 1, x], [0, 0, 1]]; (-x, -y) converts back.
    """
    xh, yh, hh = P[0, 2], P[1, 2], P[2, 2]
    shifted[0, 0] = P[0, 0] - 2.0 * y * xh + y * y * hh
    shifted[1, 1] = P[1, 1] + 2.0 * x * yh + x * x * hh
    shifted[0, 1] = shifted[1, 0] = P[0, 1] + x * xh - y * yh - x * y * hh
    shifted[0, 2] = shifted[2, 0] = xh - y * hh
    shifted[1, 2] = shifted[2, 1] = yh + x * hh
    shifted[2, 2] = hh


@kernel
def propagate_invariant(
    mean: Mean,
    covariance: Covariance,
    controls: Controls,
    dt: Durations,
    motion: tuple[int, float, float, float, float, bool, float],
    pose_means: Float[np.ndarray, "k 3"],
    pose_covariances: Float[np.ndarray, "k 3 3"],
) -> None:
    """Predict mean and covariance of the right-invariant EKF through control steps, in place.

    ``pose_covariances`` are of the linear error.
    """
    pose, P, numbers = mean[:3], covariance[:3, :3].copy(), MotionNumbers(*motion)
    noise, gathered, together = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for k in range(controls.shape[0]):
        propagate_pose(pose, noise, controls[k], dt[k], numbers)
        shifted_covariance(noise, -pose[0], -pose[1], gathered)
        for a in range(3):
            for b in range(3):
                together[a, b] = P[a, b] + gathered[a, b]
        for a in range(3):
            pose_means[k, a] = pose[a]
        shifted_covariance(together, pose[0], pose[1], pose_covariances[k])  # as `EkfBelief.pose`
    turned, root = np.empty(mean.size), math.sqrt(gathered[2, 2])
    for i in range(3, mean.size, 2):  # J l of each hypothesis
        turned[i], turned[i + 1] = -mean[i + 1], mean[i]
    for a in range(3):
        for b in range(3):
            covariance[a, b] += gathered[a, b]
        for j in range(3, mean.size):
            covariance[a, j] -= gathered[a, 2] * turned[j]
            covariance[j, a] = covariance[a, j]
    for i in range(3, mean.size):
        turned[i] *= root
    for i in range(3, mean.size):
        for j in range(3, mean.size):
            covariance[i, j] += turned[i] * turned[j]


GATED, APPLIED = 1, 0
BEYOND, UNFORESEEN = -1.0, math.nan
"""Substitutes for a squared innovation: outside the gate, or of a point too near for a bearing."""
LINEAR, INVARIANT = 1.0, 0.0
"""Factor of the heading column of H for each error definition."""
LANE = 8
"""Doubles in a cache line; a row of a multiple of it starts on a line."""
MAX_WAITING, WAITING = 32, 0
"""Most deferred columns of W, and index of their number in ``taken`` (none for the pose)."""


class Joint(NamedTuple):
    """A Gaussian during an EKF update, in arrays with room for a frame's new points."""

    mean: Float[np.ndarray, " n"]  # (n)
    covariance: Float[np.ndarray, "n m"]
    """Rows i and i + 1 of a point still lack columns ``taken[i]`` to ``taken[WAITING]`` of W; the
    pose's rows are current. Columns beyond n fill the last cache line."""
    W: Float[np.ndarray, "w m"]  # the deferred columns, as rows
    taken: Int[np.ndarray, " n"]
    """Number of columns of W applied to each point; ``taken[WAITING]``: number deferred."""
    turns: float  # LINEAR or INVARIANT


class State(NamedTuple):
    """The joint Gaussian that EKF-SLAM updates, and the labels and weights of its points."""

    joint: Joint
    landmark: Labels
    """Label of each hypothesis; a ray's are contiguous, near to far."""
    weight: Float[np.ndarray, " h"]  # aggregated likelihood of each hypothesis within its landmark
    members: Int[np.ndarray, "1"]  # number of hypotheses; the arrays may be longer


@kernel
def _lanes(size: Whole) -> Whole:
    """Round a number of floats up to a whole number of cache lines."""
    return (size + LANE - 1) // LANE * LANE


@kernel
def _on_cache_lines(rows: Whole, width: Whole) -> Float[np.ndarray, "rows width"]:
    """Allocate an uninitialised array (rows, width) that begins on a cache line."""
    buffer = np.empty(rows * width + LANE)
    start = -(buffer.ctypes.data // 8) % LANE
    return buffer[start : start + rows * width].reshape(rows, width)


@kernel
def joint_of(mean: Mean, covariance: Covariance, room: Whole, turns: float) -> Joint:
    """Copy a mean and a covariance to a `Joint` with room for ``room`` state entries."""
    size, width = mean.size, _lanes(mean.size)
    longer, wider = np.empty(room), _on_cache_lines(room, _lanes(room))
    W = _on_cache_lines(MAX_WAITING, _lanes(room))
    for a in range(size):
        longer[a] = mean[a]
        for b in range(size):
            wider[a, b] = covariance[a, b]
    for b in range(size, width):
        for a in range(size):
            wider[a, b] = 0.0
        for k in range(MAX_WAITING):
            W[k, b] = 0.0
    return Joint(longer, wider, W, np.zeros(room, np.int64), turns)


@no_alloc
def point_rows(
    joint: Joint, size: Whole, i: Whole
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Bring rows i and i + 1 of the covariance up to date with deferred updates; return them."""
    pi, pj, W = joint.covariance[i], joint.covariance[i + 1], joint.W
    first, last, width = joint.taken[i], joint.taken[WAITING], _lanes(size)
    joint.taken[i] = last
    fours = first + (last - first) // 4 * 4
    for k in range(first, fours, 4):
        w0, w1, w2, w3 = W[k], W[k + 1], W[k + 2], W[k + 3]
        x0, x1, x2, x3 = w0[i], w1[i], w2[i], w3[i]
        y0, y1, y2, y3 = w0[i + 1], w1[i + 1], w2[i + 1], w3[i + 1]
        for b in range(width):
            pi[b] = pi[b] - x0 * w0[b] - x1 * w1[b] - x2 * w2[b] - x3 * w3[b]
            pj[b] = pj[b] - y0 * w0[b] - y1 * w1[b] - y2 * w2[b] - y3 * w3[b]
    for k in range(fours, last):
        w0 = W[k]
        x0, y0 = w0[i], w0[i + 1]
        for b in range(width):
            pi[b] -= x0 * w0[b]
            pj[b] -= y0 * w0[b]
    return pi, pj


@no_alloc
def flush(joint: Joint, size: Whole) -> None:
    """Bring the whole covariance up to date with all deferred updates, in place."""
    covariance = joint.covariance
    for i in range(3, size, 2):
        pi, pj = point_rows(joint, i + 2, i)
        joint.taken[i] = 0
        for b in range(i):
            covariance[b, i], covariance[b, i + 1] = pi[b], pj[b]
    joint.taken[WAITING] = 0


@no_alloc
def defer(joint: Joint, size: Whole, w: Float[np.ndarray, " m"], step: float) -> None:
    """Apply a rank-1 Kalman update to mean and pose covariance now; defer it for landmarks."""
    mean, p0, p1, p2 = joint.mean, joint.covariance[0], joint.covariance[1], joint.covariance[2]
    x, y, h = w[0], w[1], w[2]
    for a in range(size):
        mean[a] += w[a] * step
        p0[a] -= x * w[a]
        p1[a] -= y * w[a]
        p2[a] -= h * w[a]
    joint.taken[WAITING] += 1


@no_alloc
def retract(
    mean: Float[np.ndarray, " n"],
    size: Whole,
    w0: Float[np.ndarray, " m"],
    e0: float,
    w1: Float[np.ndarray, " m"],
    e1: float,
) -> None:
    """Move an invariant EKF's mean by the exponential map of the error e0 w0 + e1 w1, in place."""
    turn = e0 * w0[2] + e1 * w1[2]
    c, s = math.cos(turn), math.sin(turn)
    if abs(turn) < 1e-4:
        along, across = 1.0 - turn * turn / 6.0, 0.5 * turn
    else:
        along, across = s / turn, (1.0 - c) / turn
    for point in range((size - 1) // 2):
        i = 0 if point == 0 else 2 * point + 1
        x, y = mean[i], mean[i + 1]
        u, v = e0 * w0[i] + e1 * w1[i], e0 * w0[i + 1] + e1 * w1[i + 1]
        mean[i] = c * x - s * y + along * u - across * v
        mean[i + 1] = s * x + c * y + across * u + along * v
    mean[2] += turn


@kernel
def propagate(
    mean: Mean,
    covariance: Covariance,
    controls: Controls,
    dt: Durations,
    motion: tuple[int, float, float, float, float, bool, float],
    pose_means: Float[np.ndarray, "k 3"],
    pose_covariances: Float[np.ndarray, "k 3 3"],
) -> None:
    """Predict mean and covariance of the EKF through control steps, in place."""
    pose, P, numbers = mean[:3], covariance[:3, :3].copy(), MotionNumbers(*motion)
    shift_x = shift_y = 0.0  # entries (0, 2) and (1, 2) of the product of the F
    for k in range(controls.shape[0]):
        dx, dy = propagate_pose(pose, P, controls[k], dt[k], numbers)
        shift_x -= dy
        shift_y += dx
        for a in range(3):  # assigning slices would compile for a second longer
            pose_means[k, a] = pose[a]
            for b in range(3):
                pose_covariances[k, a, b] = P[a, b]
    for j in range(3, mean.size):
        covariance[0, j] += shift_x * covariance[2, j]
        covariance[1, j] += shift_y * covariance[2, j]
        covariance[j, 0] = covariance[0, j]
        covariance[j, 1] = covariance[1, j]
    for a in range(3):
        for b in range(3):
            covariance[a, b] = P[a, b]


@no_alloc
def relative_covariance(joint: Joint, size: Whole, i: Whole) -> tuple[float, float, float]:
    """Return the covariance xx, xy, yy of the hypothesis at index i relative to the vehicle."""
    p0, p1 = joint.covariance[0], joint.covariance[1]
    pi, pj = point_rows(joint, size, i)
    return (
        p0[0] - 2.0 * p0[i] + pi[i],
        p0[1] - p0[i + 1] - p1[i] + pi[i + 1],
        p1[1] - 2.0 * p1[i + 1] + pj[i + 1],
    )


@no_alloc
def predicted_variance(joint: Joint, size: Whole, i: Whole, slopes: Slopes) -> float:
    """Return the predicted variance of a bearing or range of the hypothesis at index i."""
    (h0, h1, turn), turns = slopes, joint.turns
    p0, p1, p2 = joint.covariance[0], joint.covariance[1], joint.covariance[2]
    pi, pj = point_rows(joint, size, i)
    pxx = p0[0] - 2.0 * p0[i] + pi[i]
    pxy = p0[1] - p0[i + 1] - p1[i] + pi[i + 1]
    pyy = p1[1] - 2.0 * p1[i + 1] + pj[i + 1]
    pxh = p0[2] - p2[i]
    pyh = p1[2] - p2[i + 1]
    return (
        h0 * h0 * pxx + 2.0 * h0 * h1 * pxy + h1 * h1 * pyy
        + turn * turns * 2.0 * (h0 * pxh + h1 * pyh) + turn * turn * turns * p2[2]
    )  # fmt: skip


@no_alloc
def innovation_of(joint: Joint, i: Whole, row: Row) -> tuple[float, Slopes, float, float]:
    """Return the innovation of a bearing, or of a range-only measurement, at index i.

    Returns also its derivatives by the pose, its variance, and the distance.
    """
    mean = joint.mean
    distance, expected, c, s, k = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if math.isnan(row.bearing):
        return row.range - distance, range_slopes(c, s), row.range_variance, distance
    innovation = wrap_angle(row.bearing - expected)
    return innovation, bearing_slopes(c, s, k), row.bearing_variance, distance


@no_alloc
def corrected_by(
    joint: Joint, size: Whole, w: Float[np.ndarray, " m"], innovation: float, S: float, bound: float
) -> float:
    """Update the state by a number of covariances w with it; return squared innovation or BEYOND.

    ``w`` is divided by the root of S: x += w nu / sqrt(S), P -= w w^T.
    """
    if innovation * innovation > bound * S:
        return BEYOND
    root = 1.0 / math.sqrt(S)
    for a in range(size):
        w[a] *= root
    step = root * innovation
    if joint.turns == 0.0:
        retract(joint.mean, size, w, step, w, 0.0)
    defer(joint, size, w, joint.turns * step)
    return step * step


@no_alloc
def correct_scalar(
    joint: Joint, size: Whole, i: Whole, row: Row, bound: float, share: float
) -> float:
    """Update the state by a bearing, or a range-only measurement, at index i, unless gated.

    ``share``: share of its information. Returns the squared normalised innovation, BEYOND or
    UNFORESEEN.
    """
    innovation, (h0, h1, turn), variance, distance = innovation_of(joint, i, row)
    if distance < NEAREST:
        return UNFORESEEN
    if joint.taken[WAITING] == MAX_WAITING:
        flush(joint, size)
    turned = turn * joint.turns
    p0, p1, p2 = joint.covariance[0], joint.covariance[1], joint.covariance[2]
    pi, pj = point_rows(joint, size, i)
    w = joint.W[joint.taken[WAITING]]
    for a in range(size):
        w[a] = h0 * (p0[a] - pi[a]) + h1 * (p1[a] - pj[a]) + turned * p2[a]
    S = h0 * (w[0] - w[i]) + h1 * (w[1] - w[i + 1]) + turned * w[2] + variance / share
    return corrected_by(joint, size, w, innovation, S, bound)


@no_alloc
def correct_active(joint: Joint, size: Whole, i: Whole, row: Row, bound: float) -> float:
    """Update the state by range and bearing unless gated; return squared innovation or BEYOND."""
    mean = joint.mean
    near, expected, c, s, k = observe(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if near < NEAREST:
        return UNFORESEEN
    if joint.taken[WAITING] + 2 > MAX_WAITING:
        flush(joint, size)
    nu0, nu1 = row.range - near, wrap_angle(row.bearing - expected)
    (h0, h1, _), (r0, r1, _), turns = bearing_slopes(c, s, k), range_slopes(c, s), joint.turns
    p0, p1, p2 = joint.covariance[0], joint.covariance[1], joint.covariance[2]
    pi, pj = point_rows(joint, size, i)
    # W = P H^T L^-T with L L^T = S, e = L^-1 nu, x += W e, P -= W W^T
    w0, w1 = joint.W[joint.taken[WAITING]], joint.W[joint.taken[WAITING] + 1]
    for a in range(size):
        east, north = p0[a] - pi[a], p1[a] - pj[a]
        w0[a] = r0 * east + r1 * north
        w1[a] = h0 * east + h1 * north - turns * p2[a]
    S00 = r0 * (w0[0] - w0[i]) + r1 * (w0[1] - w0[i + 1]) + row.range_variance
    S01 = h0 * (w0[0] - w0[i]) + h1 * (w0[1] - w0[i + 1]) - turns * w0[2]
    S11 = h0 * (w1[0] - w1[i]) + h1 * (w1[1] - w1[i + 1]) - turns * w1[2] + row.bearing_variance
    L00 = math.sqrt(S00)
    L10 = S01 / L00
    L11 = math.sqrt(S11 - L10 * L10)
    e0 = nu0 / L00
    e1 = (nu1 - L10 * e0) / L11
    if e0 * e0 + e1 * e1 > bound:
        return BEYOND
    for a in range(size):
        w0[a] /= L00
        w1[a] = (w1[a] - L10 * w0[a]) / L11
    if turns == 0.0:
        retract(joint.mean, size, w0, e0, w1, e1)
    defer(joint, size, w0, turns * e0)
    defer(joint, size, w1, turns * e1)
    return e0 * e0 + e1 * e1


@no_alloc
def initialise(
    joint: Joint,
    size: Whole,
    i: Whole,
    distance: float,
    bearing: float,
    range_variance: float,
    bearing_variance: float,
) -> None:
    """Write a landmark hypothesis at index i, by range and bearing from the pose (Eq. (16))."""
    mean, covariance = joint.mean, joint.covariance
    direction = mean[2] + bearing
    c, s = math.cos(direction), math.sin(direction)
    gx, gy = -joint.turns * distance * s, joint.turns * distance * c
    mean[i], mean[i + 1] = mean[0] + distance * c, mean[1] + distance * s
    for a in range(size):
        if a != i and a != i + 1:
            east = covariance[0, a] + gx * covariance[2, a]
            north = covariance[1, a] + gy * covariance[2, a]
            covariance[i, a] = covariance[a, i] = east
            covariance[i + 1, a] = covariance[a, i + 1] = north
    across = bearing_variance * distance * distance
    P02, P12, P22 = covariance[0, 2], covariance[1, 2], covariance[2, 2]
    xx = covariance[0, 0] + 2.0 * gx * P02 + gx * gx * P22
    xy = covariance[0, 1] + gy * P02 + gx * P12 + gx * gy * P22
    yy = covariance[1, 1] + 2.0 * gy * P12 + gy * gy * P22
    covariance[i, i] = xx + range_variance * c * c + across * s * s
    covariance[i + 1, i + 1] = yy + range_variance * s * s + across * c * c
    cross = xy + (range_variance - across) * c * s
    covariance[i, i + 1] = covariance[i + 1, i] = cross


@no_alloc
def drop_members(
    state: State,
    first: Whole,
    count: Whole,
    keep: Bool[np.ndarray, " h"],
    source: Int[np.ndarray, " n"],
) -> None:
    """Remove a landmark's hypotheses that ``keep`` does not mark from the state, in place."""
    joint, landmark, weight, members = state.joint, state.landmark, state.weight, state.members[0]
    size = 3 + 2 * members
    flush(joint, size)
    left = first
    for a in range(size):
        source[a] = a
    for member in range(first, members):
        if member >= first + count or keep[member - first]:
            landmark[left], weight[left] = landmark[member], weight[member]
            i, j = 3 + 2 * left, 3 + 2 * member
            source[i], source[i + 1] = j, j + 1
            left += 1
    for a in range(3 + 2 * left):
        old, new = joint.covariance[source[a]], joint.covariance[a]
        joint.mean[a] = joint.mean[source[a]]
        for b in range(3 + 2 * left):
            new[b] = old[source[b]]
    state.members[0] = left


@no_alloc
def range_only(row: Row) -> Row:
    """Return a measurement without its bearing."""
    return Row(row.landmark, math.nan, row.range, math.nan, row.range_variance)


@no_alloc
def _excess(joint: Joint, size: Whole, i: Whole, row: Row, loss: Whole) -> tuple[float, float]:
    """Return a bearing's or a range's normalised innovation, and the variance that a loss adds."""
    innovation, slopes, variance, _ = innovation_of(joint, i, row)
    S = predicted_variance(joint, size, i, slopes) + variance
    squared = innovation * innovation / S
    return squared, S * (robust_loss(squared, loss)[0] - 1.0)


@no_alloc
def inflated(state: State, first: Whole, count: Whole, row: Row, loss: Whole) -> Row:
    """Return a measurement with variances inflated by a robust loss, if its innovation is large."""
    joint, size = state.joint, 3 + 2 * state.members[0]
    least, across, along = math.inf, 0.0, 0.0
    for j in range(count):
        squared, excess = _excess(joint, size, 3 + 2 * (first + j), row, loss)
        if squared < least:
            least, across = squared, excess
    if math.isnan(row.bearing):
        across, along = 0.0, across
    elif count == 1 and not math.isnan(row.range):
        along = _excess(joint, size, 3 + 2 * first, range_only(row), loss)[1]
    across, along = row.bearing_variance + across, row.range_variance + along
    return Row(row.landmark, row.bearing, row.range, across, along)
