r"""Kernels on one Gaussian over a pose and points: carry, correct, place and drop.

The state is x, y, heading, then two numbers per point. A correction subtracts :math:`W W^T` with
:math:`W = \bar P H^T L^{-T}, L L^T = S`: the two halves of the covariance get the same products
in the same order, so it stays symmetric to the last bit. ``size`` is the length of the state in
arrays that may be longer, ``i`` the state index of a point.
"""

import math

from numba import njit

from pipistrelle.estimation.models import NEAREST, carry_pose, sight
from pipistrelle.geometry import wrap_angle

GATED, APPLIED = 1, 0


@njit(cache=True, error_model="numpy")
def carry(mean, covariance, controls, dt, motion, pose_means, pose_covariances):
    """Advance mean and covariance in place; cross-covariances once, by the product of the F."""
    pose, P = mean[:3], covariance[:3, :3].copy()
    shift_x = shift_y = 0.0  # entries (0, 2) and (1, 2) of the product of the F
    for k in range(controls.shape[0]):
        dx, dy = carry_pose(pose, P, controls[k, 0], controls[k, 1], dt[k], motion)
        shift_x -= dy
        shift_y += dx
        pose_means[k] = pose
        pose_covariances[k] = P
    for j in range(3, mean.size):
        covariance[0, j] += shift_x * covariance[2, j]
        covariance[1, j] += shift_y * covariance[2, j]
        covariance[j, 0] = covariance[0, j]
        covariance[j, 1] = covariance[1, j]
    covariance[:3, :3] = P


@njit(cache=True, error_model="numpy")
def _subtract_outer(covariance, size, w, columns):
    """Covariance minus the outer product of the columns of w, in place."""
    if columns == 1:
        w0 = w[0]
        for a in range(size):
            row, wa = covariance[a], w0[a]
            for b in range(size):
                row[b] -= wa * w0[b]
    else:
        w0, w1 = w[0], w[1]
        for a in range(size):
            row, wa, va = covariance[a], w0[a], w1[a]
            for b in range(size):
                row[b] -= wa * w0[b] + va * w1[b]


@njit(cache=True, error_model="numpy")
def bearing_variance(covariance, i, c, s, k):
    """Innovation variance H P H^T of the bearing of the member at state index i, without R."""
    h0, h1 = s * k, -c * k  # by pose: (h0, h1, -1); by member: (-h0, -h1)
    pxx = covariance[0, 0] - 2.0 * covariance[0, i] + covariance[i, i]
    pxy = covariance[0, 1] - covariance[0, i + 1] - covariance[1, i] + covariance[i, i + 1]
    pyy = covariance[1, 1] - 2.0 * covariance[1, i + 1] + covariance[i + 1, i + 1]
    pxh = covariance[0, 2] - covariance[2, i]
    pyh = covariance[1, 2] - covariance[2, i + 1]
    return (
        h0 * h0 * pxx + 2.0 * h0 * h1 * pxy + h1 * h1 * pyy
        - 2.0 * (h0 * pxh + h1 * pyh) + covariance[2, 2]
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def correct_bearing(mean, covariance, size, i, bearing, variance, bound, w):
    """Correct the state with the bearing of the member at index i; GATED when beyond bound."""
    distance, expected, c, s, k = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if distance < NEAREST:
        return APPLIED
    innovation = wrap_angle(bearing - expected)
    h0, h1 = s * k, -c * k
    p0, p1, p2 = covariance[0], covariance[1], covariance[2]
    pi, pj = covariance[i], covariance[i + 1]
    w0 = w[0]
    for a in range(size):
        w0[a] = h0 * (p0[a] - pi[a]) + h1 * (p1[a] - pj[a]) - p2[a]
    S = h0 * (w0[0] - w0[i]) + h1 * (w0[1] - w0[i + 1]) - w0[2] + variance
    if innovation * innovation > bound * S:
        return GATED
    root = 1.0 / math.sqrt(S)
    for a in range(size):
        w0[a] *= root
        mean[a] += w0[a] * (root * innovation)
    _subtract_outer(covariance, size, w, 1)
    return APPLIED


@njit(cache=True, error_model="numpy")
def correct_active(
    mean, covariance, size, i, distance, bearing, range_variance, bearing_variance, bound, w
):
    """Correct the state with range and bearing of the member at index i; GATED beyond bound."""
    near, expected, c, s, k = sight(mean[0], mean[1], mean[2], mean[i], mean[i + 1])
    if near < NEAREST:
        return APPLIED
    nu0, nu1 = distance - near, wrap_angle(bearing - expected)
    h0, h1 = s * k, -c * k
    p0, p1, p2 = covariance[0], covariance[1], covariance[2]
    pi, pj = covariance[i], covariance[i + 1]
    w0, w1 = w[0], w[1]
    for a in range(size):
        east, north = p0[a] - pi[a], p1[a] - pj[a]
        w0[a] = -c * east - s * north
        w1[a] = h0 * east + h1 * north - p2[a]
    S00 = -c * (w0[0] - w0[i]) - s * (w0[1] - w0[i + 1]) + range_variance
    S01 = h0 * (w0[0] - w0[i]) + h1 * (w0[1] - w0[i + 1]) - w0[2]
    S11 = h0 * (w1[0] - w1[i]) + h1 * (w1[1] - w1[i + 1]) - w1[2] + bearing_variance
    L00 = math.sqrt(S00)
    L10 = S01 / L00
    L11 = math.sqrt(S11 - L10 * L10)
    e0 = nu0 / L00
    e1 = (nu1 - L10 * e0) / L11
    if e0 * e0 + e1 * e1 > bound:
        return GATED
    for a in range(size):
        w0[a] /= L00
        w1[a] = (w1[a] - L10 * w0[a]) / L11
        mean[a] += w0[a] * e0 + w1[a] * e1
    _subtract_outer(covariance, size, w, 2)
    return APPLIED


@njit(cache=True, error_model="numpy")
def place(mean, covariance, size, i, distance, bearing, range_variance, bearing_variance):
    """Put a member at state index i, at a range and bearing from the pose (Eq. (16)).

    The first ``size`` rows but the member's own are the rest of the state, with which it is
    correlated through the pose.
    """
    direction = mean[2] + bearing
    c, s = math.cos(direction), math.sin(direction)
    gx, gy = -distance * s, distance * c
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


@njit(cache=True, error_model="numpy")
def drop_members(mean, covariance, landmark, weight, members, first, count, keep):
    """Close the gaps that dropped members of one landmark leave; returns the members left."""
    target = first
    for source in range(first, members):
        if source < first + count and not keep[source - first]:
            continue
        if target != source:
            landmark[target], weight[target] = landmark[source], weight[source]
            i, j = 3 + 2 * target, 3 + 2 * source
            mean[i], mean[i + 1] = mean[j], mean[j + 1]
            covariance[i : i + 2, :] = covariance[j : j + 2, :]
            covariance[:, i : i + 2] = covariance[:, j : j + 2]
        target += 1
    return target
