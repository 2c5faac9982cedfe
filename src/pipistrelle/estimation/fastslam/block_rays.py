"""Kernels on a block's rays: weigh, share, refine, correct and prune (`rays` tells the method).

A landmark of one member is a ray of one: its share is all, and it is never pruned. The weights
stay logs, so that no product of likelihoods underflows. ``rows`` (h, 6 `LANES`) are the members of
one landmark; lane i has the first ``count[i]`` of them.
"""

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
    Counts,
    Lanes,
    Poses,
    X,
    Y,
    correct_by_bearing,
    expect_active,
    expect_bearing,
    refine_by_bearing,
)
from pipistrelle.estimation.rays import (
    AS_PRINTED,
    EXACT,
    SMALLEST_AGGREGATED_SHARE,
    SMALLEST_SHARE,
    Sensing,
)
from pipistrelle.jit import Whole, kernel, no_alloc

Rows = Float[np.ndarray, "h numbers"]
"""The members of one landmark."""


class Scratch(NamedTuple):
    """Room to work.

    Attributes
    ----------
    likelihood, posterior, share : (h, `LANES`)
        Of each member; the first two are logs.
    largest, total : (`LANES`)
    whole : (`LANES`)
        Shares of one.
    refined : (h, `POSE`)
        Poses as each member alone would have them.
    """

    likelihood: Float[np.ndarray, "h lanes"]
    posterior: Float[np.ndarray, "h lanes"]
    share: Float[np.ndarray, "h lanes"]
    largest: Lanes
    total: Lanes
    whole: Lanes
    refined: Float[np.ndarray, "h rows"]


@kernel
def scratch_for(members: Whole) -> Scratch:
    """Return room to work with rays of so many members."""
    return Scratch(
        np.empty((members, LANES)),
        np.empty((members, LANES)),
        np.empty((members, LANES)),
        np.empty(LANES),
        np.empty(LANES),
        np.ones(LANES),
        np.empty((members, POSE)),
    )


@no_alloc
def _largest(logs: Float[np.ndarray, "h lanes"], members: Whole, largest: Lanes) -> None:
    """Largest of each lane's logs."""
    for i in range(LANES):
        largest[i] = -np.inf
    for j in range(members):
        row = logs[j]
        for i in range(LANES):
            largest[i] = max(largest[i], row[i])


@no_alloc
def _weigh(rows: Rows, members: Whole, scratch: Scratch) -> None:
    """Aggregated likelihoods, in logs and normalised, into ``posterior`` (Eq. (18)).

    Their sum before, in logs, goes to ``total``.
    """
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
def _share(members: Whole, sensing: Sensing, scratch: Scratch) -> None:
    """Divide the measurement: shares go with a power of the likelihoods, now or aggregated."""
    logs = scratch.posterior if sensing.aggregated else scratch.likelihood
    smallest = SMALLEST_AGGREGATED_SHARE if sensing.aggregated else SMALLEST_SHARE
    largest, total = scratch.largest, scratch.total
    _largest(logs, members, largest)
    total[:] = 0.0
    for j in range(members):
        row, share = logs[j], scratch.share[j]
        for i in range(LANES):
            share[i] = exponential(sensing.power * (row[i] - largest[i]))
            total[i] += share[i]
    for j in range(members):
        share = scratch.share[j]
        for i in range(LANES):
            part = share[i] / total[i]
            share[i] = part if part >= smallest else 0.0


@no_alloc
def _add(log_likelihood: Lanes, log_weight: Lanes) -> None:
    """Add log likelihoods, and their constant, to log weights."""
    for i in range(LANES):
        log_weight[i] += log_likelihood[i] - HALF_LOG_TAU


@no_alloc
def most(count: Counts) -> Whole:
    """Members of the lane that has most."""
    largest = 1
    for i in range(LANES):
        largest = max(largest, count[i])
    return largest


@no_alloc
def _expect_ray(
    pose: Poses,
    rows: Rows,
    count: Counts,
    bearing: float,
    variance: float,
    printed: bool,
    scratch: Scratch,
) -> None:
    """Log likelihoods of a bearing of all members, into ``likelihood``."""
    for j in range(most(count)):
        likelihood = scratch.likelihood[j]
        expect_bearing(pose, rows[j], bearing, variance, count, j, printed, likelihood)


@no_alloc
def weigh_by_bearing(
    pose: Poses,
    rows: Rows,
    count: Counts,
    bearing: float,
    variance: float,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Weigh the poses by the bearing of a landmark: the density of its members' mixture."""
    _expect_ray(pose, rows, count, bearing, variance, False, scratch)
    if most(count) == 1:
        _add(scratch.likelihood[0], log_weight)
        return
    _weigh(rows, most(count), scratch)
    _add(scratch.total, log_weight)


@no_alloc
def refine_by_ray(
    pose: Poses,
    rows: Rows,
    count: Counts,
    bearing: float,
    variance: float,
    sensing: Sensing,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Correct the poses by the bearing of a landmark, and weigh them by its likelihood."""
    members = most(count)
    weigh_by_bearing(pose, rows, count, bearing, variance, scratch, log_weight)
    if members == 1:
        refine_by_bearing(pose, rows[0], bearing, variance, scratch.whole)
        return
    if sensing.sharing == EXACT:
        _refine_to_mixture(pose, rows, members, bearing, variance, scratch)
        return
    if sensing.sharing == AS_PRINTED:
        _expect_ray(pose, rows, count, bearing, variance, True, scratch)
        _weigh(rows, members, scratch)
    _share(members, sensing, scratch)
    for j in range(members):
        refine_by_bearing(pose, rows[j], bearing, variance, scratch.share[j])


@no_alloc
def weigh_by_active(
    pose: Poses,
    rows: Rows,
    heard: tuple[float, float, float, float],
    count: Counts,
    least: Whole,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Weigh the poses whose landmark has so many members at least by its range and bearing.

    By the members' mixture, of which one member is a case: a density over range and bearing for
    all, so that weights do not hang on the units of either. ``heard`` are the two and their
    variances.
    """
    members = most(count)
    if members < least:
        return
    distance, bearing, range_variance, bearing_variance = heard
    for j in range(members):
        expect_active(
            pose, rows[j], distance, bearing, range_variance, bearing_variance, count, j,
            scratch.likelihood[j],
        )  # fmt: skip
    _weigh(rows, members, scratch)
    for i in range(LANES):
        log_weight[i] += scratch.total[i] - 2.0 * HALF_LOG_TAU if count[i] >= least else 0.0


@no_alloc
def _refine_to_mixture(
    pose: Poses, rows: Rows, members: Whole, bearing: float, variance: float, scratch: Scratch
) -> None:
    """Set the poses to mean and covariance of the mixture of the members' refinements."""
    for j in range(members):
        refined, weight = scratch.refined[j], scratch.posterior[j]
        for k in range(POSE):
            refined[k] = pose[k]
        refine_by_bearing(refined, rows[j], bearing, variance, scratch.whole)
        for i in range(LANES):
            weight[i] = exponential(weight[i])
    pose[:] = 0.0
    for j in range(members):
        refined, weight = scratch.refined[j], scratch.posterior[j]
        for row in range(0, POSE, LANES):
            for i in range(LANES):
                pose[row + i] += weight[i] * refined[row + i]
    for j in range(members):
        refined, weight = scratch.refined[j], scratch.posterior[j]
        for i in range(LANES):
            x, y = refined[X + i] - pose[X + i], refined[Y + i] - pose[Y + i]
            turn = refined[HEADING + i] - pose[HEADING + i]
            pose[PXX + i] += weight[i] * x * x
            pose[PXY + i] += weight[i] * x * y
            pose[PYY + i] += weight[i] * y * y
            pose[PXH + i] += weight[i] * x * turn
            pose[PYH + i] += weight[i] * y * turn
            pose[PHH + i] += weight[i] * turn * turn


@no_alloc
def correct_ray(
    pose: Poses,
    rows: Rows,
    count: Counts,
    bearing: float,
    variance: float,
    sensing: Sensing,
    scratch: Scratch,
) -> None:
    """Weigh, correct and prune a landmark's members from certain poses, in place."""
    members = most(count)
    if members == 1:
        correct_by_bearing(pose, rows[0], bearing, variance, scratch.whole)
        return
    _expect_ray(pose, rows, count, bearing, variance, sensing.sharing == AS_PRINTED, scratch)
    _weigh(rows, members, scratch)
    if sensing.sharing != EXACT:
        _share(members, sensing, scratch)
    for j in range(members):
        share = scratch.whole if sensing.sharing == EXACT else scratch.share[j]
        correct_by_bearing(pose, rows[j], bearing, variance, share)
    _prune(rows, count, members, sensing.prune, scratch)


@no_alloc
def _prune(rows: Rows, count: Counts, members: Whole, prune: float, scratch: Scratch) -> None:
    """Drop members whose aggregated likelihood is too small; the heaviest stays (Eq. (21))."""
    largest, total = scratch.largest, scratch.total
    _largest(scratch.posterior, members, largest)
    least = largest  # which is not needed any more
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
def _close_up(rows: Rows, count: Counts, keep: Float[np.ndarray, "_ lanes"]) -> None:
    """Move the members that are kept to the front, lane by lane."""
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
