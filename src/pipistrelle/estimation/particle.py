"""Kernels on one particle: a sampled pose with a Gaussian around it, and a Gaussian per point.

A member is a row (x, y, xx, xy, yy, weight): mean [m], covariance [m^2] and aggregated
likelihood. Given the pose, members are independent of each other. ``pose`` (3) and ``P`` (3, 3)
are the pose and its uncertainty since the last sample; refinements are in Kalman form, which
needs no inverse of the motion noise: that of one control step has rank 2 and none.
"""

import math

import numpy as np
from numba import njit

from pipistrelle.estimation.models import NEAREST, sight
from pipistrelle.geometry import wrap_angle

LOG_TAU = math.log(2.0 * math.pi)
ROUNDING = 1e-12
"""A pivot under this share of its variance is rounding: one control step has noise of rank 2."""
UNFORESEEN = -0.5 * LOG_TAU
"""Log likelihood, as `log_likelihood` counts, of the bearing of a member too near to foresee it:
uniform over the circle."""
X, Y, XX, XY, YY, WEIGHT = range(6)


@njit(cache=True, error_model="numpy")
def bearing_spread(member, h0, h1):
    """Variance of the bearing that a member's own uncertainty causes; h = (s, -c) / range."""
    return h0 * h0 * member[XX] + 2.0 * h0 * h1 * member[XY] + h1 * h1 * member[YY]


@njit(cache=True, error_model="numpy")
def expect_bearing(pose, P, member, bearing, variance):
    """Innovation and its variance of a member's bearing; the variance is infinite when too near."""
    distance, expected, c, s, k = sight(pose[0], pose[1], pose[2], member[X], member[Y])
    innovation = wrap_angle(bearing - expected)
    if distance < NEAREST:
        return innovation, np.inf
    h0, h1 = s * k, -c * k
    a0 = h0 * P[0, 0] + h1 * P[0, 1] - P[0, 2]
    a1 = h0 * P[0, 1] + h1 * P[1, 1] - P[1, 2]
    a2 = h0 * P[0, 2] + h1 * P[1, 2] - P[2, 2]
    return innovation, h0 * a0 + h1 * a1 - a2 + bearing_spread(member, h0, h1) + variance


@njit(cache=True, error_model="numpy")
def refine_by_bearing(pose, P, member, bearing, variance):
    """Correct pose and P by a member's bearing; returns the log of its marginal likelihood."""
    distance, expected, c, s, k = sight(pose[0], pose[1], pose[2], member[X], member[Y])
    if distance < NEAREST:
        return 0.0
    innovation = wrap_angle(bearing - expected)
    h0, h1 = s * k, -c * k
    a0 = h0 * P[0, 0] + h1 * P[0, 1] - P[0, 2]
    a1 = h0 * P[0, 1] + h1 * P[1, 1] - P[1, 2]
    a2 = h0 * P[0, 2] + h1 * P[1, 2] - P[2, 2]
    S = h0 * a0 + h1 * a1 - a2 + bearing_spread(member, h0, h1) + variance
    k0, k1, k2 = a0 / S, a1 / S, a2 / S
    pose[0] += k0 * innovation
    pose[1] += k1 * innovation
    pose[2] += k2 * innovation
    P[0, 0] -= a0 * k0
    P[1, 1] -= a1 * k1
    P[2, 2] -= a2 * k2
    P[0, 1] = P[1, 0] = P[0, 1] - a0 * k1
    P[0, 2] = P[2, 0] = P[0, 2] - a0 * k2
    P[1, 2] = P[2, 1] = P[1, 2] - a1 * k2
    return -0.5 * (innovation * innovation / S + math.log(S) + LOG_TAU)


@njit(cache=True, error_model="numpy")
def expect_active(pose, P, member, distance, bearing, range_variance, bearing_variance):
    """Squared Mahalanobis distance of range and bearing from what a member makes expect."""
    near, expected, c, s, k = sight(pose[0], pose[1], pose[2], member[X], member[Y])
    if near < NEAREST:
        return 0.0
    h0, h1 = s * k, -c * k
    pxx, pxy, pyy = P[0, 0] + member[XX], P[0, 1] + member[XY], P[1, 1] + member[YY]
    S00 = c * c * pxx + 2.0 * c * s * pxy + s * s * pyy + range_variance
    S01 = -c * (h0 * pxx + h1 * pxy) - s * (h0 * pxy + h1 * pyy) + c * P[0, 2] + s * P[1, 2]
    S11 = h0 * h0 * pxx + 2.0 * h0 * h1 * pxy + h1 * h1 * pyy + bearing_variance
    S11 += P[2, 2] - 2.0 * (h0 * P[0, 2] + h1 * P[1, 2])
    nu0, nu1 = distance - near, wrap_angle(bearing - expected)
    return (S11 * nu0 * nu0 - 2.0 * S01 * nu0 * nu1 + S00 * nu1 * nu1) / (S00 * S11 - S01 * S01)


@njit(cache=True, error_model="numpy")
def refine_by_active(pose, P, member, distance, bearing, range_variance, bearing_variance):
    """Correct pose and P by range and bearing; returns the log of the marginal likelihood."""
    near, expected, c, s, k = sight(pose[0], pose[1], pose[2], member[X], member[Y])
    if near < NEAREST:
        return 0.0
    h0, h1 = s * k, -c * k
    a0, b0 = -c * P[0, 0] - s * P[0, 1], h0 * P[0, 0] + h1 * P[0, 1] - P[0, 2]
    a1, b1 = -c * P[0, 1] - s * P[1, 1], h0 * P[0, 1] + h1 * P[1, 1] - P[1, 2]
    a2, b2 = -c * P[0, 2] - s * P[1, 2], h0 * P[0, 2] + h1 * P[1, 2] - P[2, 2]
    xx, xy, yy = member[XX], member[XY], member[YY]
    S00 = -c * a0 - s * a1 + c * c * xx + 2.0 * c * s * xy + s * s * yy + range_variance
    S01 = h0 * a0 + h1 * a1 - a2 - c * (h0 * xx + h1 * xy) - s * (h0 * xy + h1 * yy)
    S11 = h0 * b0 + h1 * b1 - b2 + bearing_spread(member, h0, h1) + bearing_variance
    L00 = math.sqrt(S00)
    L10 = S01 / L00
    L11 = math.sqrt(S11 - L10 * L10)
    e0 = (distance - near) / L00
    e1 = (wrap_angle(bearing - expected) - L10 * e0) / L11
    i0, i1 = 1.0 / L00, 1.0 / L11
    a0, a1, a2 = a0 * i0, a1 * i0, a2 * i0
    b0, b1, b2 = (b0 - L10 * a0) * i1, (b1 - L10 * a1) * i1, (b2 - L10 * a2) * i1
    pose[0] += a0 * e0 + b0 * e1
    pose[1] += a1 * e0 + b1 * e1
    pose[2] += a2 * e0 + b2 * e1
    P[0, 0] -= a0 * a0 + b0 * b0
    P[1, 1] -= a1 * a1 + b1 * b1
    P[2, 2] -= a2 * a2 + b2 * b2
    P[0, 1] = P[1, 0] = P[0, 1] - (a0 * a1 + b0 * b1)
    P[0, 2] = P[2, 0] = P[0, 2] - (a0 * a2 + b0 * b2)
    P[1, 2] = P[2, 1] = P[1, 2] - (a1 * a2 + b1 * b2)
    return -0.5 * (e0 * e0 + e1 * e1) - math.log(L00 * L11) - LOG_TAU


@njit(cache=True, error_model="numpy")
def sample_pose(pose, P, draw):
    """Draw the pose from its Gaussian, in place, with three standard normals; P becomes zero."""
    L00 = math.sqrt(max(P[0, 0], 0.0))
    L10 = P[0, 1] / L00 if L00 > 0.0 else 0.0
    L20 = P[0, 2] / L00 if L00 > 0.0 else 0.0
    left = P[1, 1] - L10 * L10
    L11 = math.sqrt(left) if left > ROUNDING * P[1, 1] else 0.0
    L21 = (P[1, 2] - L20 * L10) / L11 if L11 > 0.0 else 0.0
    left = P[2, 2] - L20 * L20 - L21 * L21
    L22 = math.sqrt(left) if left > ROUNDING * P[2, 2] else 0.0
    pose[0] += L00 * draw[0]
    pose[1] += L10 * draw[0] + L11 * draw[1]
    pose[2] = wrap_angle(pose[2] + L20 * draw[0] + L21 * draw[1] + L22 * draw[2])
    P[:, :] = 0.0


@njit(cache=True, error_model="numpy")
def expect_from(pose, member, bearing):
    """Innovation of a member's bearing from a certain pose, and its slopes by x and y.

    The slopes are zero, and teach nothing, when the member is too near.
    """
    distance, expected, c, s, k = sight(pose[0], pose[1], pose[2], member[X], member[Y])
    if distance < NEAREST:
        return 0.0, 0.0, 0.0
    return wrap_angle(bearing - expected), -s * k, c * k


@njit(cache=True, error_model="numpy")
def correct_by_bearing(member, innovation, g0, g1, variance):
    """Correct a member by its bearing from a certain pose, as `expect_from` gives it."""
    a0 = g0 * member[XX] + g1 * member[XY]
    a1 = g0 * member[XY] + g1 * member[YY]
    S = g0 * a0 + g1 * a1 + variance
    k0, k1 = a0 / S, a1 / S
    member[X] += k0 * innovation
    member[Y] += k1 * innovation
    member[XX] -= a0 * k0
    member[XY] -= a0 * k1
    member[YY] -= a1 * k1


@njit(cache=True, error_model="numpy")
def correct_by_active(pose, member, distance, bearing, range_variance, bearing_variance):
    """Correct a member by its range and bearing from a certain pose."""
    near, expected, c, s, k = sight(pose[0], pose[1], pose[2], member[X], member[Y])
    if near < NEAREST:
        return
    g0, g1 = -s * k, c * k
    a0, b0 = c * member[XX] + s * member[XY], g0 * member[XX] + g1 * member[XY]
    a1, b1 = c * member[XY] + s * member[YY], g0 * member[XY] + g1 * member[YY]
    S00 = c * a0 + s * a1 + range_variance
    S01 = g0 * a0 + g1 * a1
    S11 = g0 * b0 + g1 * b1 + bearing_variance
    L00 = math.sqrt(S00)
    L10 = S01 / L00
    L11 = math.sqrt(S11 - L10 * L10)
    e0 = (distance - near) / L00
    e1 = (wrap_angle(bearing - expected) - L10 * e0) / L11
    i0, i1 = 1.0 / L00, 1.0 / L11
    a0, a1 = a0 * i0, a1 * i0
    b0, b1 = (b0 - L10 * a0) * i1, (b1 - L10 * a1) * i1
    member[X] += a0 * e0 + b0 * e1
    member[Y] += a1 * e0 + b1 * e1
    member[XX] -= a0 * a0 + b0 * b0
    member[XY] -= a0 * a1 + b0 * b1
    member[YY] -= a1 * a1 + b1 * b1


@njit(cache=True, error_model="numpy")
def place_member(pose, member, distance, bearing, range_variance, bearing_variance, weight):
    """Put a member at a range and bearing from a certain pose (Eq. (16))."""
    c, s = math.cos(pose[2] + bearing), math.sin(pose[2] + bearing)
    across = bearing_variance * distance * distance
    member[X], member[Y] = pose[0] + distance * c, pose[1] + distance * s
    member[XX] = range_variance * c * c + across * s * s
    member[XY] = (range_variance - across) * c * s
    member[YY] = range_variance * s * s + across * c * c
    member[WEIGHT] = weight
