"""Kernels on all particles: gate, update and resample.

Landmark n of block b has its hypotheses in the rows ``member[b, first[n] : first[n + 1]]``, and
lane i uses the first ``count[b, n, i]``.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.detection.scans import RANGE
from pipistrelle.estimation.fastslam.block import (
    LANES,
    LOG_WEIGHT,
    MEMBER,
    POSE,
    Counts,
    Lanes,
    Poses,
    active_beyond,
    bearing_beyond,
    correct_by_active,
    correct_by_bearing,
    initialise_member,
    refine_by_active,
    sample_pose,
    squared_innovation,
    weigh_sample,
)
from pipistrelle.estimation.fastslam.block_rays import (
    Rows,
    Scratch,
    correct_ray,
    drop_heaviest,
    heaviest_to_range,
    keep_heaviest,
    most_members,
    part_lanes,
    refine_by_ray,
    reset_member,
    scratch_for,
    weigh_by_active,
    weigh_by_bearing,
)
from pipistrelle.estimation.measurement import Columns, Row, row_of, rows_with_bearing
from pipistrelle.estimation.rays import ANEW, BEARING, CORRECTED, MOVED, OTHERS, RESET, UpdateParams
from pipistrelle.jit import Whole, kernel, no_alloc, no_alloc_inlined


class Particles(NamedTuple):
    """All particles: arrays of a `FastSlamBelief`."""

    pose: Float[np.ndarray, "b rows"]
    landmark: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " n+1"]
    count: Int[np.ndarray, "b n lanes"]
    member: Float[np.ndarray, "b c numbers"]


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""`Particles` as a plain tuple, which kernels take faster."""


class Block(NamedTuple):
    """Poses, log-weight gains and maps of a block of particles."""

    pose: Poses
    gained: Lanes
    first: Int[np.ndarray, " n+1"]
    count: Int[np.ndarray, "n lanes"]
    member: Float[np.ndarray, "c numbers"]


@kernel
def _slots(landmark: Int[np.ndarray, " n"], columns: Columns) -> Int[np.ndarray, " m"]:
    """Return the index of each measurement's landmark on the map; -1 if new."""
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
    """Sum a particle's squared innovations of initialised landmarks and their dimensions."""
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
    pose: Poses, rows: Rows, count: Counts, row: Row, params: UpdateParams, scratch: Scratch
) -> None:
    """Update a landmark by range and bearing, a ray as ``rays.ranged`` selects, in place."""
    ranged = params.ranged
    if ranged == CORRECTED:
        keep_heaviest(rows, count)
    part_lanes(count, scratch)
    correct_by_active(pose, rows[0], row, count)
    if most_members(count) == 1:
        return
    if ranged == ANEW:
        initialise_member(pose, rows[0], row, 0.0, count)
        count[:] = 1
    elif ranged < BEARING:
        keep_heaviest(rows, count)
        heaviest_to_range(pose, rows, count, row.range, scratch.ray)
        if ranged == RESET:
            reset_member(pose, rows[0], row, scratch.ray)
        correct_by_bearing(pose, rows[0], row, scratch.ray)
    else:
        if ranged == MOVED:
            heaviest_to_range(pose, rows, count, row.range, scratch.ray)
        elif ranged == OTHERS:
            drop_heaviest(rows, count)
        correct_ray(pose, rows, count, row, params, scratch.ray, scratch)


@no_alloc
def _refine(
    block: Block,
    slot: Int[np.ndarray, " m"],
    columns: Columns,
    params: UpdateParams,
    scratch: Scratch,
) -> None:
    """Refine and weigh a block's poses by all measurements of mapped landmarks."""
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
            if params.ranged >= BEARING:
                refine_by_ray(pose, rows, count, row, params, scratch.ray, scratch, gained)
            else:
                weigh_by_active(pose, rows, row, count, scratch.ray, scratch, gained)
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
    """Weigh a block's sampled poses by prior x likelihood / proposal at the sample."""
    block.gained[:] = 0.0
    weigh_sample(before[0], before[1], block.pose, block.gained)
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows, count = block.member[block.first[n] : block.first[n + 1]], block.count[n]
        row, pose, gained = row_of(columns, m), block.pose, block.gained
        if math.isnan(row.range):
            whole = scratch.whole
            weigh_by_bearing(pose, rows, count, row, whole, scratch, gained)
            continue
        part_lanes(count, scratch)
        by_range = scratch.alone if params.ranged >= BEARING else scratch.whole
        weigh_by_active(pose, rows, row, count, by_range, scratch, gained)
        if params.ranged >= BEARING and most_members(count) > 1:
            weigh_by_bearing(pose, rows, count, row, scratch.ray, scratch, gained)


@no_alloc
def _correct(
    block: Block,
    slot: Int[np.ndarray, " m"],
    columns: Columns,
    params: UpdateParams,
    scratch: Scratch,
) -> None:
    """Update a block's measured landmarks from its sampled poses, in place."""
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
def _add_new(pose: Poses, rows: Rows, count: Counts, row: Row, params: UpdateParams) -> None:
    """Initialise a block's new landmark: a single hypothesis, or a ray (Eqs. (16) to (18))."""
    if not math.isnan(row.range):
        initialise_member(pose, rows[0], row, 0.0, count)
        count[:] = 1
        return
    members = params.ray_ranges.size
    for j in range(members):
        far, spread = params.ray_ranges[j], params.ray_stds[j] ** 2
        member = Row(row.landmark, row.bearing, far, row.bearing_variance, spread)
        initialise_member(pose, rows[j], member, -math.log(members), count)
    count[:] = members


@no_alloc
def _place(
    block: Block,
    slot: Int[np.ndarray, " m"],
    known: Whole,
    columns: Columns,
    params: UpdateParams,
) -> None:
    """Initialise a block's new landmarks."""
    new = known
    for m in range(slot.size):
        if slot[m] < 0:
            rows = block.member[block.first[new] : block.first[new + 1]]
            _add_new(block.pose, rows, block.count[new], row_of(columns, m), params)
            new += 1


@kernel
def _rows(
    particles: Particles, slot: Int[np.ndarray, " m"], columns: Columns, rays: Whole
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n+1"], Whole]:
    """Return all labels, each landmark's first row, and the largest number of rows."""
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
    """Copy the hypotheses of a block to their new rows."""
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
    """Refine, sample, update and extend a copy of all particles; return it and its log weights.

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
def particle_map(
    count: Int[np.ndarray, "b n lanes"], member: Float[np.ndarray, "b c numbers"], particle: Whole
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "c 6"]]:
    """Return a particle's map: the number of each landmark's hypotheses, and their rows."""
    b, i = particle // LANES, particle % LANES
    rows = np.empty((member.shape[1], MEMBER // LANES))
    for j in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            rows[j, k] = member[b, j, k * LANES + i]
    return count[b, :, i].copy(), rows


@kernel
def mean_full(count: Int[np.ndarray, "b n lanes"], weight: Float[np.ndarray, " p"]) -> float:
    """Return the mean number of fully initialised landmarks; exact if all particles agree."""
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
    """Copy the ancestors to the resampled particles; spare lanes repeat the last."""
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
    """Give the hypotheses of each ray equal weights, in place."""
    for b in range(count.shape[0]):
        for n in range(count.shape[1]):
            for j in range(first[n], first[n + 1]):
                for i in range(LANES):
                    member[b, j, LOG_WEIGHT + i] = -math.log(count[b, n, i])
