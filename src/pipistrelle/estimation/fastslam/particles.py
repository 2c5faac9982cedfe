r"""Kernels on all particles: predict, gate, update, summarise, weigh and resample.

Landmark n of block b has its hypotheses in the rows ``member[b, first[n] : first[n + 1]]``, and
lane i uses the first ``count[b, n, i]``.

The weights give the effective number of particles,

.. math:: N_\mathrm{eff} = \left( \sum_j w_j^2 \right)^{-1}

(Eq. (15)); below a threshold the particles are resampled. Resampling is *stratified*: a uniform
number in each of N equal strata of [0, 1) gives particle j :math:`N w_j` copies on average, within
less than two. Weights are stored as logarithms, as the product of a frame's likelihoods underflows.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.arithmetic.elementary import cosine_and_sine, wrapped
from pipistrelle.detection.scans import RANGE
from pipistrelle.estimation.fastslam.block import (
    HEADING,
    LANES,
    LOG_WEIGHT,
    MEMBER,
    PHH,
    POSE,
    PXH,
    PXX,
    PXY,
    PYH,
    PYY,
    Counts,
    Lanes,
    Members,
    Poses,
    Scratch,
    X,
    Y,
    active_beyond,
    bearing_beyond,
    correct_by_active,
    correct_ray,
    heaviest_to_range,
    initialise_member,
    most_members,
    part_lanes,
    refine_by_active,
    refine_by_ray,
    sample_pose,
    scratch_for,
    squared_innovation,
    weigh_by_active,
    weigh_by_bearing,
    weigh_sample,
)
from pipistrelle.estimation.motion import (
    BY_POSES,
    SMALLEST_STD,
    Controls,
    Durations,
    MotionNumbers,
    Pose,
    PoseCovariance,
    motion_increment,
    relative_noise,
)
from pipistrelle.estimation.observations.rows import Columns, Row, row_of, rows_with_bearing
from pipistrelle.estimation.rays import ANEW, MOVED, UpdateParams
from pipistrelle.jit import Whole, kernel, no_alloc, no_alloc_inlined


class Particles(NamedTuple):
    """All particles' poses and maps, as the arrays of a `FastSlamBelief`."""

    pose: Float[np.ndarray, "b rows"]
    landmark: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " n+1"]
    count: Int[np.ndarray, "b n lanes"]
    member: Float[np.ndarray, "b c numbers"]


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""`Particles` as a plain tuple, which kernels take faster."""


class Block(NamedTuple):
    """A block of particles: their poses, gains in log weight, and maps."""

    pose: Poses
    gained: Lanes
    first: Int[np.ndarray, " n+1"]
    count: Int[np.ndarray, "n lanes"]
    member: Float[np.ndarray, "c numbers"]


@kernel
def _slots(landmark: Int[np.ndarray, " n"], columns: Columns) -> Int[np.ndarray, " m"]:
    """Return the index of each measurement's landmark on the map; -1 if it is new."""
    slot = np.full(rows_with_bearing(columns), -1)
    for m in range(slot.size):
        for n in range(landmark.size):
            if landmark[n] == columns[0][m]:
                slot[m] = n
    return slot


@kernel
def gated_by_all(arrays: Arrays, columns: Columns, params: UpdateParams) -> Bool[np.ndarray, " m"]:
    """Return a mask of the measurements that are outside the gate of every particle."""
    particles = Particles(*arrays)
    slot = _slots(particles.landmark, columns)
    gated, blocks = np.zeros(columns[0].size, dtype=np.bool_), particles.pose.shape[0]
    for m in range(slot.size):
        n = slot[m]
        gated[m] = n >= 0
        for b in range(blocks if n >= 0 else 0):
            pose, count = particles.pose[b], particles.count[b, n]
            rows = particles.member[b, particles.first[n] : particles.first[n + 1]]
            if not math.isnan(columns[1][RANGE, m]):
                gated[m] = gated[m] and active_beyond(
                    pose, rows[0], row_of(columns, m), count, params.active_bound
                )
                continue
            for j in range(most_members(count)):
                gated[m] = gated[m] and bearing_beyond(
                    pose, rows[j], row_of(columns, m), count, j, params.passive_bound
                )
    return gated


@kernel
def innovations_of(arrays: Arrays, columns: Columns, particle: Whole) -> tuple[float, float]:
    """Return a particle's sum of squared normalised innovations, and their degrees of freedom."""
    particles = Particles(*arrays)
    slot, b, i = _slots(particles.landmark, columns), particle // LANES, particle % LANES
    squared, degrees = 0.0, 0.0
    for m in range(slot.size):
        n = slot[m]
        if n < 0 or particles.count[b, n, i] != 1:
            continue
        member = particles.member[b, particles.first[n]]
        one = squared_innovation(particles.pose[b], member, row_of(columns, m), i)
        if not math.isnan(one):
            squared += one
            degrees += 1.0 if math.isnan(columns[1][RANGE, m]) else 2.0
    return squared, degrees


@no_alloc_inlined
def _correct_by_range(
    pose: Poses, rows: Members, count: Counts, row: Row, params: UpdateParams, scratch: Scratch
) -> None:
    """Update a landmark in a block of particles by range and bearing, in place."""
    part_lanes(count, scratch)
    correct_by_active(pose, rows[0], row, count)
    if most_members(count) == 1:
        return
    if params.ranged == ANEW:
        initialise_member(pose, rows[0], row, 0.0, count)
        count[:] = 1
        return
    if params.ranged == MOVED:
        heaviest_to_range(pose, rows, count, row.range, scratch.ray)
    correct_ray(pose, rows, count, row, params, scratch.ray, scratch)


@no_alloc
def _refine(
    block: Block,
    slot: Int[np.ndarray, " m"],
    columns: Columns,
    params: UpdateParams,
    scratch: Scratch,
) -> None:
    """Update and weigh a block of particles' poses by all measurements of mapped landmarks."""
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows, count = block.member[block.first[n] : block.first[n + 1]], block.count[n]
        row, pose, gained = row_of(columns, m), block.pose, block.gained
        if math.isnan(row.range):
            refine_by_ray(pose, rows, count, row, params, scratch.whole, scratch, gained)
            continue
        if most_members(count) > 1:
            part_lanes(count, scratch)
            if params.ranged != ANEW:
                refine_by_ray(pose, rows, count, row, params, scratch.ray, scratch, gained)
            else:
                weigh_by_active(pose, rows, row, count, params, scratch.ray, scratch, gained)
        refine_by_active(pose, rows[0], row, count, gained)


@no_alloc
def _weigh_at_sample(
    block: Block,
    slot: Int[np.ndarray, " m"],
    columns: Columns,
    before: tuple[Poses, Poses],
    params: UpdateParams,
    scratch: Scratch,
) -> None:
    """Weigh a block of particles by prior times likelihood over proposal at the sampled poses."""
    block.gained[:] = 0.0
    weigh_sample(before[0], before[1], block.pose, block.gained)
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows, count = block.member[block.first[n] : block.first[n + 1]], block.count[n]
        row, pose, gained = row_of(columns, m), block.pose, block.gained
        if math.isnan(row.range):
            weigh_by_bearing(pose, rows, count, row, params, scratch.whole, scratch, gained)
            continue
        part_lanes(count, scratch)
        by_range = scratch.alone if params.ranged != ANEW else scratch.whole
        weigh_by_active(pose, rows, row, count, params, by_range, scratch, gained)
        if params.ranged != ANEW and most_members(count) > 1:
            weigh_by_bearing(pose, rows, count, row, params, scratch.ray, scratch, gained)


@no_alloc
def _correct(
    block: Block,
    slot: Int[np.ndarray, " m"],
    columns: Columns,
    params: UpdateParams,
    scratch: Scratch,
) -> None:
    """Update the measured landmarks of a block of particles from the sampled poses, in place."""
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows, count = block.member[block.first[n] : block.first[n + 1]], block.count[n]
        row = row_of(columns, m)
        if math.isnan(row.range):
            correct_ray(block.pose, rows, count, row, params, scratch.whole, scratch)
        else:
            _correct_by_range(block.pose, rows, count, row, params, scratch)


@no_alloc
def _place(
    block: Block, slot: Int[np.ndarray, " m"], known: Whole, columns: Columns, params: UpdateParams
) -> None:
    """Add new landmarks to a block of particles: a hypothesis, or several along a bearing."""
    new = known
    for m in range(slot.size):
        if slot[m] < 0:
            rows = block.member[block.first[new] : block.first[new + 1]]
            row, count, members = row_of(columns, m), block.count[new], 1
            if math.isnan(row.range):
                members = params.ray_ranges.size
            for j in range(members):
                member = row
                if math.isnan(row.range):
                    far, spread = params.ray_ranges[j], params.ray_stds[j] ** 2
                    member = Row(row.landmark, row.bearing, far, row.bearing_variance, spread)
                initialise_member(block.pose, rows[j], member, -math.log(members), count)
            count[:] = members
            new += 1


@kernel
def _rows(
    particles: Particles, slot: Int[np.ndarray, " m"], columns: Columns, rays: Whole
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n+1"], Whole]:
    """Return all labels, each landmark's first row in the map array, and the largest row count."""
    known, fresh, widest = particles.landmark.size, 0, 1
    for m in range(slot.size):
        fresh += slot[m] < 0
    labels = np.empty(known + fresh, dtype=np.int64)
    first = np.zeros(known + fresh + 1, dtype=np.int64)
    for n in range(known):
        wide = 1
        for b in range(particles.count.shape[0]):
            wide = max(wide, most_members(particles.count[b, n]))
        labels[n], first[n + 1] = particles.landmark[n], first[n] + wide
        widest = max(widest, wide)
    for m in range(slot.size):
        if slot[m] < 0:
            labels[known] = columns[0][m]
            wide = rays if math.isnan(columns[1][RANGE, m]) else 1
            first[known + 1] = first[known] + wide
            widest = max(widest, wide)
            known += 1
    return labels, first, widest


@no_alloc
def _copy_members(particles: Particles, b: Whole, block: Block) -> None:
    """Copy a block of particles' map to an array with room for new landmarks."""
    for n in range(particles.landmark.size):
        for j in range(block.first[n + 1] - block.first[n]):
            source = particles.member[b, particles.first[n] + j]
            target = block.member[block.first[n] + j]
            for k in range(MEMBER):
                target[k] = source[k]
        for i in range(LANES):
            block.count[n, i] = particles.count[b, n, i]


@kernel
def correct_particles(
    arrays: Arrays,
    columns: Columns,
    normal: Float[np.ndarray, "p 3"],
    params: UpdateParams,
    sampled: bool,
) -> tuple[Arrays, Float[np.ndarray, " p"]]:
    """Update a copy of all particles by a scan (FastSLAM 2.0); return it and its log weights.

    With ``sampled``, particles are weighed at the sampled pose.
    """
    old = Particles(*arrays)
    blocks, known, total = old.pose.shape[0], old.landmark.size, normal.shape[0]
    slot = _slots(old.landmark, columns)
    landmark, first, widest = _rows(old, slot, columns, params.ray_ranges.size)
    pose, gained = old.pose.copy(), np.zeros((blocks, LANES))
    count = np.zeros((blocks, landmark.size, LANES), dtype=np.int64)
    member = np.empty((blocks, first[-1], MEMBER))
    scratch, draw, proposal = scratch_for(widest), np.empty(3 * LANES), np.empty(POSE)
    for b in range(blocks):
        block = Block(pose[b], gained[b], first, count[b], member[b])
        _copy_members(old, b, block)
        _refine(block, slot, columns, params, scratch)
        proposal[:] = block.pose
        for k in range(draw.size):
            draw[k] = normal[min(b * LANES + k % LANES, total - 1), k // LANES]
        sample_pose(block.pose, draw)
        if sampled:
            _weigh_at_sample(block, slot, columns, (old.pose[b], proposal), params, scratch)
        _correct(block, slot, columns, params, scratch)
        _place(block, slot, known, columns, params)
    return (pose, landmark, first, count, member), gained.ravel()[:total]


@kernel
def mean_full(count: Int[np.ndarray, "b n lanes"], weight: Float[np.ndarray, " p"]) -> float:
    """Return the mean number of fully initialised landmarks over the weighted particles."""
    first, more = 0, 0.0
    for p in range(weight.size):
        full = 0
        for n in range(count.shape[1]):
            full += count[p // LANES, n, p % LANES] == 1
        first = full if p == 0 else first
        more += weight[p] * (full - first)
    return first + more


@kernel
def resample_into(
    arrays: Arrays, ancestor: Int[np.ndarray, " p"]
) -> tuple[
    Float[np.ndarray, "b rows"], Int[np.ndarray, "b n lanes"], Float[np.ndarray, "b c numbers"]
]:
    """Return arrays of resampled particles, each a copy of its drawn ancestor."""
    old = Particles(*arrays)
    pose, count = np.empty_like(old.pose), np.empty_like(old.count)
    member, source = np.empty_like(old.member), np.empty(LANES, dtype=np.int64)
    for b in range(pose.shape[0]):
        for i in range(LANES):
            source[i] = ancestor[min(b * LANES + i, ancestor.size - 1)]
        for k in range(POSE):
            a = source[k % LANES]
            pose[b, k] = old.pose[a // LANES, k - k % LANES + a % LANES]
        for n in range(count.shape[1]):
            for i in range(LANES):
                count[b, n, i] = old.count[source[i] // LANES, n, source[i] % LANES]
        for j in range(member.shape[1]):
            for k in range(0, MEMBER, LANES):
                for i in range(LANES):
                    member[b, j, k + i] = old.member[source[i] // LANES, j, k + source[i] % LANES]
    return pose, count, member


@kernel
def restart_rays(
    first: Int[np.ndarray, " n+1"],
    count: Int[np.ndarray, "b n lanes"],
    member: Float[np.ndarray, "b c numbers"],
) -> None:
    """Give all hypotheses of each landmark the same weight in every particle, in place."""
    for b in range(count.shape[0]):
        for n in range(count.shape[1]):
            for j in range(first[n], first[n + 1]):
                for i in range(LANES):
                    member[b, j, LOG_WEIGHT + i] = -math.log(count[b, n, i])


def normalised(log_weight: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return particle weights that sum to 1, from log weights; equal weights if none is finite.

    The sum is rounded only once, so that it is independent of the order of particles.

    >>> normalised(np.array([-1000.0, -1000.0 + np.log(3.0)])).round(12)
    array([0.25, 0.75])
    """
    weight = _shifted(log_weight)
    total = math.fsum(weight.tolist())
    return weight / total if total > 0.0 else np.full(weight.size, 1.0 / weight.size)


@kernel
def _shifted(log_weight):
    """Return the exponentials of logs minus their maximum; zero where a log is not finite."""
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
    """Draw each particle's ancestor by stratified resampling; return indices in rising order.

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


@no_alloc
def _add_moments(pose: Poses, weight: Lanes, sums: Poses) -> None:
    """Add a block of particles' weighted positions, and cosines and sines of heading, to sums."""
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
    """Add a block of particles' weighted pose covariances about the mean pose to sums."""
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
    """Return the sum of each of a block's nine pose numbers over its particles."""
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
) -> tuple[Pose, PoseCovariance]:
    """Return the weighted mean pose (circular in heading) of all particles, and its covariance."""
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
    covariance[0, 0] = spread[3] + SMALLEST_STD**2
    covariance[0, 1] = covariance[1, 0] = spread[4]
    covariance[1, 1] = spread[5] + SMALLEST_STD**2
    covariance[0, 2] = covariance[2, 0] = spread[6]
    covariance[1, 2] = covariance[2, 1] = spread[7]
    covariance[2, 2] = spread[8] + SMALLEST_STD**2
    mean[2] = wrapped(mean[2])
    return mean[:3].copy(), covariance


@no_alloc
def _propagate_block(pose: Poses, step: tuple[float, ...], q0: float, q1: float) -> None:
    """Predict the poses of a block of particles through a control step, in place (Eq. (10))."""
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
    """Predict the poses of a block of particles by a relative motion with covariance, in place."""
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
    controls: Controls,
    dt: Durations,
    motion: MotionNumbers,
    pose_means: Float[np.ndarray, "k 3"],
    pose_covariances: Float[np.ndarray, "k 3 3"],
) -> None:
    """Predict all particles through control steps, in place; write the mean pose after each."""
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
