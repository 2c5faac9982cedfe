"""Kernels on a block's rays: weigh, share, update, prune and merge (method in `estimation.rays`).

An initialised landmark is a ray of a single hypothesis: its share is 1, and it is never pruned.
Weights are logarithms against underflow. ``rows`` (h, 6 `LANES`) are the hypotheses of a landmark;
lane i has the first ``count[i]``. ``turn`` is 1 in lanes to update and 0 elsewhere.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.arithmetic.elementary import exponential, logarithm
from pipistrelle.estimation.fastslam.block import (
    HALF_LOG_TAU,
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
    XX,
    XY,
    YY,
    Counts,
    Lanes,
    Member,
    Poses,
    X,
    Y,
    correct_by_bearing,
    expect_active,
    expect_bearing,
    refine_by_bearing,
)
from pipistrelle.estimation.measurement import NEAREST, Row
from pipistrelle.estimation.rays import (
    AS_PRINTED,
    EXACT,
    SMALLEST_AGGREGATED_SHARE,
    SMALLEST_SHARE,
    UpdateParams,
)
from pipistrelle.jit import Flag, Whole, inlined, kernel, no_alloc

Rows = Float[np.ndarray, "h numbers"]
"""Hypotheses of a landmark."""


class Scratch(NamedTuple):
    """Workspace for updates of a block's rays; L is `LANES`."""

    likelihood: Float[np.ndarray, "h lanes"]  # log, of each hypothesis
    posterior: Float[np.ndarray, "h lanes"]  # log, of each hypothesis
    share: Float[np.ndarray, "h lanes"]
    largest: Lanes
    total: Lanes
    whole: Lanes  # 1 in all lanes
    alone: Lanes  # 1 where a landmark is initialised, else 0 (`part_lanes`)
    ray: Lanes  # 1 where it is a ray
    refined: Float[np.ndarray, "h rows"]  # poses updated by each hypothesis separately


@kernel
def scratch_for(members: Whole) -> Scratch:
    """Allocate a workspace for rays with a number of hypotheses."""
    return Scratch(
        np.empty((members, LANES)),
        np.empty((members, LANES)),
        np.empty((members, LANES)),
        np.empty(LANES),
        np.empty(LANES),
        np.ones(LANES),
        np.empty(LANES),
        np.empty(LANES),
        np.empty((members, POSE)),
    )


@no_alloc
def part_lanes(count: Counts, scratch: Scratch) -> None:
    """Separate the lanes by whether a landmark is initialised or a ray."""
    for i in range(LANES):
        scratch.alone[i] = 1.0 if count[i] == 1 else 0.0
        scratch.ray[i] = 1.0 - scratch.alone[i]


@no_alloc
def _largest(logs: Float[np.ndarray, "h lanes"], members: Whole, largest: Lanes) -> None:
    """Write the largest log of each lane."""
    for i in range(LANES):
        largest[i] = -np.inf
    for j in range(members):
        row = logs[j]
        for i in range(LANES):
            largest[i] = max(largest[i], row[i])


@no_alloc
def _weigh(rows: Rows, members: Whole, scratch: Scratch) -> None:
    """Write normalised log weights (Eq. (18)) to ``posterior``, and log sums to ``total``."""
    largest, total = scratch.largest, scratch.total
    for j in range(members):
        row, likelihood, posterior = rows[j], scratch.likelihood[j], scratch.posterior[j]
        for i in range(LANES):
            posterior[i] = row[LOG_WEIGHT + i] + likelihood[i]
    _largest(scratch.posterior, members, largest)
    total[:] = 0.0
    for j in range(members):
        posterior = scratch.posterior[j]
        for i in range(LANES):
            total[i] += exponential(posterior[i] - largest[i])
    for i in range(LANES):
        total[i] = largest[i] + logarithm(total[i])
    for j in range(members):
        posterior = scratch.posterior[j]
        for i in range(LANES):
            posterior[i] -= total[i]


@no_alloc
def _share(members: Whole, params: UpdateParams, turn: Lanes, scratch: Scratch) -> None:
    """Write shares proportional to a power of the likelihoods, aggregated or not (Eq. (19))."""
    logs = scratch.posterior if params.aggregated else scratch.likelihood
    smallest = SMALLEST_AGGREGATED_SHARE if params.aggregated else SMALLEST_SHARE
    largest, total = scratch.largest, scratch.total
    _largest(logs, members, largest)
    total[:] = 0.0
    for j in range(members):
        row, share = logs[j], scratch.share[j]
        for i in range(LANES):
            share[i] = exponential(params.power * (row[i] - largest[i]))
            total[i] += share[i]
    for j in range(members):
        share = scratch.share[j]
        for i in range(LANES):
            part = share[i] / total[i]
            share[i] = turn[i] * part if part >= smallest else 0.0


@no_alloc
def _add(log_likelihood: Lanes, numbers: Whole, turn: Lanes, log_weight: Lanes) -> None:
    """Add log likelihoods of ``numbers`` measured numbers, with constants, to log weights."""
    for i in range(LANES):
        log_weight[i] += log_likelihood[i] - numbers * HALF_LOG_TAU if turn[i] > 0.0 else 0.0


@no_alloc
def most_members(count: Counts) -> Whole:
    """Return the largest number of hypotheses in a lane."""
    largest = 1
    for i in range(LANES):
        largest = max(largest, count[i])
    return largest


@no_alloc
def _expect_ray(
    pose: Poses, rows: Rows, count: Counts, row: Row, printed: bool, scratch: Scratch
) -> None:
    """Write the log likelihoods of a bearing for all hypotheses to ``likelihood``."""
    for j in range(most_members(count)):
        likelihood = scratch.likelihood[j]
        expect_bearing(pose, rows[j], row, count, j, printed, likelihood)


@no_alloc
def weigh_by_bearing(
    pose: Poses,
    rows: Rows,
    count: Counts,
    row: Row,
    turn: Lanes,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Weigh poses by the mixture density of a bearing over a landmark's hypotheses."""
    _expect_ray(pose, rows, count, row, False, scratch)
    if most_members(count) == 1:
        _add(scratch.likelihood[0], 1, turn, log_weight)
        return
    _weigh(rows, most_members(count), scratch)
    _add(scratch.total, 1, turn, log_weight)


@no_alloc
def refine_by_ray(
    pose: Poses,
    rows: Rows,
    count: Counts,
    row: Row,
    params: UpdateParams,
    turn: Lanes,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Update poses by a bearing to a landmark, and weigh them by its likelihood."""
    members = most_members(count)
    weigh_by_bearing(pose, rows, count, row, turn, scratch, log_weight)
    if members == 1:
        refine_by_bearing(pose, rows[0], row, turn)
        return
    if params.sharing == EXACT:
        _refine_to_mixture(pose, rows, members, row, turn, scratch)
        return
    if params.sharing == AS_PRINTED:
        _expect_ray(pose, rows, count, row, True, scratch)
        _weigh(rows, members, scratch)
    _share(members, params, turn, scratch)
    for j in range(members):
        refine_by_bearing(pose, rows[j], row, scratch.share[j])


@no_alloc
def weigh_by_active(
    pose: Poses,
    rows: Rows,
    row: Row,
    count: Counts,
    turn: Lanes,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Weigh poses by the mixture density of range and bearing over a landmark's hypotheses."""
    members = most_members(count)
    for j in range(members):
        expect_active(pose, rows[j], row, count, j, scratch.likelihood[j])
    _weigh(rows, members, scratch)
    _add(scratch.total, 2, turn, log_weight)


@no_alloc
def _refine_to_mixture(
    pose: Poses, rows: Rows, members: Whole, row: Row, turn: Lanes, scratch: Scratch
) -> None:
    """Set poses to mean and covariance of the mixture of their updates by each hypothesis."""
    for j in range(members):
        refined, weight = scratch.refined[j], scratch.posterior[j]
        for k in range(POSE):
            refined[k] = pose[k]
        refine_by_bearing(refined, rows[j], row, turn)
        for i in range(LANES):
            weight[i] = exponential(weight[i])
    pose[:] = 0.0
    for j in range(members):
        refined, weight = scratch.refined[j], scratch.posterior[j]
        for k in range(0, POSE, LANES):
            for i in range(LANES):
                pose[k + i] += weight[i] * refined[k + i]
    for j in range(members):
        refined, weight = scratch.refined[j], scratch.posterior[j]
        for i in range(LANES):
            x, y = refined[X + i] - pose[X + i], refined[Y + i] - pose[Y + i]
            h = refined[HEADING + i] - pose[HEADING + i]
            pose[PXX + i] += weight[i] * x * x
            pose[PXY + i] += weight[i] * x * y
            pose[PYY + i] += weight[i] * y * y
            pose[PXH + i] += weight[i] * x * h
            pose[PYH + i] += weight[i] * y * h
            pose[PHH + i] += weight[i] * h * h


@no_alloc
def correct_ray(
    pose: Poses,
    rows: Rows,
    count: Counts,
    row: Row,
    params: UpdateParams,
    turn: Lanes,
    scratch: Scratch,
) -> None:
    """Weigh, update, prune and merge a landmark's hypotheses from known poses, in place."""
    members = most_members(count)
    if members == 1:
        correct_by_bearing(pose, rows[0], row, turn)
        return
    _expect_ray(pose, rows, count, row, params.sharing == AS_PRINTED, scratch)
    _weigh(rows, members, scratch)
    if params.sharing != EXACT:
        _share(members, params, turn, scratch)
    for j in range(members):
        share = turn if params.sharing == EXACT else scratch.share[j]
        correct_by_bearing(pose, rows[j], row, share)
    _prune(rows, count, members, params.prune, scratch)
    if params.merge > 0.0:
        _merge_members(rows, count, params.merge)


@inlined
def _heaviest(rows: Rows, count: Counts, i: Whole) -> Whole:
    """Return the index of the heaviest hypothesis in a lane, the first of equals."""
    best = 0
    for j in range(1, count[i]):
        best = j if rows[j, LOG_WEIGHT + i] > rows[best, LOG_WEIGHT + i] else best
    return best


@no_alloc
def keep_heaviest(rows: Rows, count: Counts) -> None:
    """Reduce each lane to its heaviest hypothesis."""
    for i in range(LANES):
        best = _heaviest(rows, count, i)
        for k in range(i, MEMBER, LANES):
            rows[0, k] = rows[best, k]
        rows[0, LOG_WEIGHT + i], count[i] = 0.0, 1


@no_alloc
def drop_heaviest(rows: Rows, count: Counts) -> None:
    """Remove the heaviest hypothesis of a ray from each particle that has several."""
    for i in range(LANES):
        if count[i] == 1:
            continue
        best, total = _heaviest(rows, count, i), 0.0
        for j in range(best, count[i] - 1):
            for k in range(i, MEMBER, LANES):
                rows[j, k] = rows[j + 1, k]
        count[i] -= 1
        second = rows[_heaviest(rows, count, i), LOG_WEIGHT + i]
        for j in range(count[i]):
            total += math.exp(rows[j, LOG_WEIGHT + i] - second)
        for j in range(count[i]):
            rows[j, LOG_WEIGHT + i] -= second + math.log(total)


@no_alloc
def heaviest_to_range(pose: Poses, rows: Rows, count: Counts, distance: float, turn: Lanes) -> None:
    """Move the heaviest hypothesis to a range, keeping its bearing and covariance."""
    for i in range(LANES):
        if turn[i] > 0.0:
            member = rows[_heaviest(rows, count, i)]
            dx, dy = member[X + i] - pose[X + i], member[Y + i] - pose[Y + i]
            scale = distance / max(math.sqrt(dx * dx + dy * dy), 1e-12)
            member[X + i], member[Y + i] = pose[X + i] + dx * scale, pose[Y + i] + dy * scale


@no_alloc
def reset_member(pose: Poses, member: Member, row: Row, turn: Lanes) -> None:
    """Reset the covariance of a hypothesis as if initialised at its position."""
    for i in range(LANES):
        if turn[i] > 0.0:
            dx, dy = member[X + i] - pose[X + i], member[Y + i] - pose[Y + i]
            squared = max(dx * dx + dy * dy, NEAREST * NEAREST)
            along, across = row.range_variance / squared, row.bearing_variance
            member[XX + i] = along * dx * dx + across * dy * dy
            member[XY + i] = (along - across) * dx * dy
            member[YY + i] = along * dy * dy + across * dx * dx


@no_alloc
def _prune(rows: Rows, count: Counts, members: Whole, prune: float, scratch: Scratch) -> None:
    """Remove hypotheses of small aggregated likelihood, but not the heaviest (Eq. (21))."""
    largest, total = scratch.largest, scratch.total
    _largest(scratch.posterior, members, largest)
    least = largest  # reuses the array
    for i in range(LANES):
        least[i] = min(prune / count[i], exponential(largest[i]))
        total[i] = 0.0
    dropped = 0
    for j in range(members):
        posterior, keep = scratch.posterior[j], scratch.share[j]
        for i in range(LANES):
            weight = exponential(posterior[i])
            keep[i] = 1.0 if weight >= least[i] and j < count[i] else 0.0
            total[i] += keep[i] * weight
            dropped += 1 if weight < least[i] and j < count[i] else 0
    for i in range(LANES):
        total[i] = logarithm(total[i])
    for j in range(members):
        row, posterior = rows[j], scratch.posterior[j]
        for i in range(LANES):
            row[LOG_WEIGHT + i] = posterior[i] - total[i]
    if dropped > 0:
        _close_up(rows, count, scratch.share)


@no_alloc
def _merge_members(rows: Rows, count: Counts, limit: float) -> None:
    """Merge neighbouring hypotheses of a ray that agree, near to far, as `ekf.correction` does."""
    for i in range(LANES):
        last = 0
        for j in range(1, count[i]):
            if not _merged(rows[last], rows[j], limit, i):
                last += 1
                for k in range(i, MEMBER, LANES):
                    rows[last, k] = rows[j, k]
        count[i] = last + 1
        if last == 0:
            rows[0, LOG_WEIGHT + i] = 0.0


@no_alloc
def _merged(one: Member, other: Member, limit: float, i: Whole) -> Flag:
    """Replace the first of two hypotheses by their mixture if they agree; return if they do."""
    x, y = other[X + i] - one[X + i], other[Y + i] - one[Y + i]
    xx, xy = 0.5 * (one[XX + i] + other[XX + i]), 0.5 * (one[XY + i] + other[XY + i])
    yy = 0.5 * (one[YY + i] + other[YY + i])
    if yy * x * x - 2.0 * xy * x * y + xx * y * y > limit * limit * (xx * yy - xy * xy):
        return False
    b = 1.0 / (1.0 + math.exp(one[LOG_WEIGHT + i] - other[LOG_WEIGHT + i]))
    a = 1.0 - b
    one[X + i] += b * x
    one[Y + i] += b * y
    one[XX + i] = a * one[XX + i] + b * other[XX + i] + a * b * x * x
    one[XY + i] = a * one[XY + i] + b * other[XY + i] + a * b * x * y
    one[YY + i] = a * one[YY + i] + b * other[YY + i] + a * b * y * y
    one[LOG_WEIGHT + i] -= math.log(a)
    return True


@no_alloc
def _close_up(rows: Rows, count: Counts, keep: Float[np.ndarray, "_ lanes"]) -> None:
    """Move the kept hypotheses to the front of each lane."""
    for i in range(LANES):
        left = 0
        for j in range(count[i]):
            if keep[j, i] > 0.0:
                for k in range(i, MEMBER, LANES):
                    rows[left, k] = rows[j, k]
                left += 1
        count[i] = left
        if left == 1:
            rows[0, LOG_WEIGHT + i] = 0.0
