r"""The right-invariant error of EKF-SLAM, which avoids false information on the heading.

The linear error, true state minus mean, is linearised at means that change between frames. Updates
then reduce the variance of the common heading of vehicle and map, which no measurement observes, so
that the filter becomes overconfident (Julier & Uhlmann, 2001; Huang et al., 2010). The
right-invariant error :math:`\xi` moves the mean by a rigid motion, and shifts each position:

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

import numpy as np
from jaxtyping import Bool, Float

from pipistrelle.estimation.motion import MotionNumbers, propagate_pose
from pipistrelle.jit import kernel, no_alloc


def rotated_left(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " m"]:
    """Rotate points by 90 degrees to the left (J l), and flatten them."""
    return (points @ np.array([[0.0, 1.0], [-1.0, 0.0]])).ravel()


@kernel
def linear_part(
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    origin: Float[np.ndarray, "2"],
    kept: Bool[np.ndarray, " h"],
    with_pose: bool,
    invariant: bool,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Return mean and covariance of the linear error of selected hypotheses, or with the pose."""
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
def shifted_covariance(
    P: Float[np.ndarray, "d d"], x: float, y: float, shifted: Float[np.ndarray, "3 3"]
) -> None:
    """Convert a pose's covariance from invariant to linear error, at (x, y).

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
    mean: Float[np.ndarray, " d"],
    covariance: Float[np.ndarray, "d d"],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: tuple[int, float, float, float, float, bool, float],
    pose_means: Float[np.ndarray, "k 3"],
    pose_covariances: Float[np.ndarray, "k 3 3"],
) -> None:
    """Predict mean and covariance of the invariant error in place, through control steps.

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
