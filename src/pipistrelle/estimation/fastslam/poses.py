r"""Kernels on particle poses, and resampling: predict, summarise, weigh and draw ancestors.

The weights give the effective number of particles,

.. math:: N_\mathrm{eff} = \left( \sum_j w_j^2 \right)^{-1}

(Eq. (15)); below a threshold the particles are resampled. Resampling is *stratified*: a uniform
number in each of N equal strata of [0, 1) gives particle j :math:`N w_j` copies on average, within
less than two. Weights are stored as logarithms, as the product of a frame's likelihoods underflows.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arithmetic.elementary import cosine_and_sine, wrapped
from pipistrelle.estimation.fastslam.block import (
    HEADING,
    LANES,
    PHH,
    POSE,
    PXH,
    PXX,
    PXY,
    PYH,
    PYY,
    Lanes,
    Poses,
    X,
    Y,
)
from pipistrelle.estimation.motion import BY_POSES, MotionNumbers, motion_increment, relative_noise
from pipistrelle.jit import kernel, no_alloc


def normalised(log_weight: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return the weights that sum to 1, from their logs; equal weights if no log is finite.

    The sum is rounded only once, so that it is independent of the order of particles.

    >>> normalised(np.array([-1000.0, -1000.0 + np.log(3.0)])).round(12)
    array([0.25, 0.75])
    """
    weight = _shifted(log_weight)
    total = math.fsum(weight.tolist())
    return weight / total if total > 0.0 else np.full(weight.size, 1.0 / weight.size)


@kernel
def _shifted(log_weight):
    """Return the exponentials relative to the largest; zero where the log is not finite."""
    weight, largest = np.zeros(log_weight.size), -np.inf
    for j in range(log_weight.size):
        if math.isfinite(log_weight[j]):
            largest = max(largest, log_weight[j])
    for j in range(log_weight.size):
        if math.isfinite(log_weight[j]):
            weight[j] = math.exp(log_weight[j] - largest)
    return weight


def effective_particles(weight: Float[np.ndarray, " p"]) -> float:
    r"""Return the effective number of particles, in [1, p], for weights that sum to 1.

    .. math:: N_\mathrm{eff} = 1 / \sum_j w_j^2
       :label: eq-15

    Bradley & Abaid, Eq. (15).

    >>> effective_particles(np.array([0.5, 0.5, 0.0, 0.0]))
    2.0
    """
    return 1.0 / float(np.sum(weight * weight))


def stratified(
    weight: Float[np.ndarray, " p"], uniform: Float[np.ndarray, " p"]
) -> Int[np.ndarray, " p"]:
    """Draw each particle's ancestor, from the strata of the cumulated weights, in rising order.

    The weights sum to 1, ``uniform`` is in [0, 1). Bradley & Abaid, Sec. III-B; Douc, Cappe &
    Moulines (2005).

    >>> stratified(np.array([0.1, 0.6, 0.3]), np.array([0.2, 0.9, 0.5])).tolist()
    [0, 1, 2]
    """
    points = (np.arange(weight.size) + uniform) / weight.size
    bounds = np.cumsum(weight)
    bounds /= bounds[-1]
    last = np.flatnonzero(weight)[-1]  # a point may round to 1
    return np.minimum(np.searchsorted(bounds, points, side="right"), last)


SMALLEST_STD = 1e-6
"""Added in quadrature to x, y [m] and heading [rad] of the estimate, as stationary particles or
copies of an ancestor have a singular covariance."""


LEAST = SMALLEST_STD**2


@no_alloc
def _add_moments(pose: Poses, weight: Lanes, sums: Poses) -> None:
    """Add a block's weighted positions and directions, lane by lane."""
    for i in range(LANES):
        c, s = cosine_and_sine(pose[HEADING + i])
        sums[X + i] += weight[i] * pose[X + i]
        sums[Y + i] += weight[i] * pose[Y + i]
        sums[PXX + i] += weight[i] * c
        sums[PXY + i] += weight[i] * s


@no_alloc
def _add_spread(
    pose: Poses, weight: Lanes, x: float, y: float, heading: float, sums: Poses
) -> None:
    """Add a block's weighted covariances and squared distances from the mean, lane by lane."""
    for i in range(LANES):
        dx, dy, turn = pose[X + i] - x, pose[Y + i] - y, wrapped(pose[HEADING + i] - heading)
        sums[PXX + i] += weight[i] * (dx * dx + pose[PXX + i])
        sums[PXY + i] += weight[i] * (dx * dy + pose[PXY + i])
        sums[PYY + i] += weight[i] * (dy * dy + pose[PYY + i])
        sums[PXH + i] += weight[i] * (dx * turn + pose[PXH + i])
        sums[PYH + i] += weight[i] * (dy * turn + pose[PYH + i])
        sums[PHH + i] += weight[i] * (turn * turn + pose[PHH + i])


@kernel
def _add_lanes(sums: Poses) -> Float[np.ndarray, "9"]:
    """Return the sum of each row over its lanes."""
    total = np.empty(POSE // LANES)
    for row in range(total.size):
        so_far = 0.0
        for i in range(row * LANES, (row + 1) * LANES):
            so_far += sums[i]
        total[row] = so_far
    return total


@kernel
def summarise(
    pose: Float[np.ndarray, "b rows"], weight: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return mean (circular in the heading) and covariance of all particles with theirs."""
    blocks = pose.shape[0]
    lanes, sums = np.zeros((blocks, LANES)), np.zeros(POSE)
    for p in range(weight.size):
        lanes[p // LANES, p % LANES] = weight[p]
    for b in range(blocks):
        _add_moments(pose[b], lanes[b], sums)
    mean = _add_lanes(sums)
    mean[2] = math.atan2(mean[4], mean[3])
    sums[:] = 0.0
    for b in range(blocks):
        _add_spread(pose[b], lanes[b], mean[0], mean[1], mean[2], sums)
    spread, covariance = _add_lanes(sums), np.empty((3, 3))
    covariance[0, 0] = spread[3] + LEAST
    covariance[0, 1] = covariance[1, 0] = spread[4]
    covariance[1, 1] = spread[5] + LEAST
    covariance[0, 2] = covariance[2, 0] = spread[6]
    covariance[1, 2] = covariance[2, 1] = spread[7]
    covariance[2, 2] = spread[8] + LEAST
    mean[2] = wrapped(mean[2])
    return mean[:3].copy(), covariance


@no_alloc
def _propagate_block(pose: Poses, step: tuple[float, ...], q0: float, q1: float) -> None:
    """Predict a block's poses by a control step in the vehicle's frame (Eq. (10))."""
    ahead, aside, turn, u00, u10, u20, u01, u11, u21 = step
    for i in range(LANES):
        c, s = cosine_and_sine(pose[HEADING + i])
        dx, dy = c * ahead - s * aside, s * ahead + c * aside
        v00, v10 = c * u00 - s * u10, s * u00 + c * u10
        v01, v11 = c * u01 - s * u11, s * u01 + c * u11
        xh, yh, hh = pose[PXH + i], pose[PYH + i], pose[PHH + i]
        pose[X + i] += dx
        pose[Y + i] += dy
        pose[HEADING + i] = wrapped(pose[HEADING + i] + turn)
        pose[PXX + i] += dy * dy * hh - 2.0 * dy * xh + q0 * v00 * v00 + q1 * v01 * v01
        pose[PXY + i] += dx * xh - dy * yh - dx * dy * hh + q0 * v00 * v10 + q1 * v01 * v11
        pose[PYY + i] += 2.0 * dx * yh + dx * dx * hh + q0 * v10 * v10 + q1 * v11 * v11
        pose[PXH + i] = xh - dy * hh + q0 * v00 * u20 + q1 * v01 * u21
        pose[PYH + i] = yh + dx * hh + q0 * v10 * u20 + q1 * v11 * u21
        pose[PHH + i] = hh + q0 * u20 * u20 + q1 * u21 * u21


@no_alloc
def _propagate_block_by(pose: Poses, step: tuple[float, ...], noise: tuple[float, ...]) -> None:
    """Predict a block's poses by a motion and its covariance, both in the vehicle's frame."""
    ahead, aside, turn = step[0], step[1], step[2]
    qxx, qxy, qxh, qyy, qyh, qhh = noise
    for i in range(LANES):
        c, s = cosine_and_sine(pose[HEADING + i])
        dx, dy = c * ahead - s * aside, s * ahead + c * aside
        xh, yh, hh = pose[PXH + i], pose[PYH + i], pose[PHH + i]
        pose[X + i] += dx
        pose[Y + i] += dy
        pose[HEADING + i] = wrapped(pose[HEADING + i] + turn)
        noise_xx = c * c * qxx - 2.0 * c * s * qxy + s * s * qyy
        noise_xy = c * s * (qxx - qyy) + (c * c - s * s) * qxy
        noise_yy = s * s * qxx + 2.0 * c * s * qxy + c * c * qyy
        pose[PXX + i] += dy * dy * hh - 2.0 * dy * xh + noise_xx
        pose[PXY + i] += dx * xh - dy * yh - dx * dy * hh + noise_xy
        pose[PYY + i] += 2.0 * dx * yh + dx * dx * hh + noise_yy
        pose[PXH + i] = xh - dy * hh + c * qxh - s * qyh
        pose[PYH + i] = yh + dx * hh + s * qxh + c * qyh
        pose[PHH + i] = hh + qhh


@kernel
def propagate(
    pose: Float[np.ndarray, "b rows"],
    weight: Float[np.ndarray, " p"],
    controls: Float[np.ndarray, "k c"],
    dt: Float[np.ndarray, " k"],
    motion: MotionNumbers,
    pose_means: Float[np.ndarray, "k 3"],
    pose_covariances: Float[np.ndarray, "k 3 3"],
) -> None:
    """Predict all particles through control steps, in place, and summarise after each."""
    for k in range(dt.size):
        control = controls[k]
        step = motion_increment(motion, 0.0, control, dt[k])
        if motion.model == BY_POSES:
            noise = relative_noise(control, motion)
            for b in range(pose.shape[0]):
                _propagate_block_by(pose[b], step, noise)
        else:
            noisy = 1.0 if motion.noise_at_rest or control[0] != 0.0 or control[1] != 0.0 else 0.0
            q0, q1 = noisy * motion.speed_variance, noisy * motion.turn_variance
            for b in range(pose.shape[0]):
                _propagate_block(pose[b], step, q0, q1)
        mean, covariance = summarise(pose, weight)
        for a in range(3):
            pose_means[k, a] = mean[a]
            for b in range(3):
                pose_covariances[k, a, b] = covariance[a, b]
