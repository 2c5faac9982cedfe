"""Kernels on a block of particles: sampled poses with Gaussian uncertainty, and map hypotheses.

Particles are stored in blocks of `LANES`, and every loop runs over the lanes of a block, for
vectorisation. A row (x of all lanes, then y, and so on) has a fixed offset in a flat array:
``pose[PXY + i]`` is the covariance of x and y in lane i. Lanes to be left unchanged get an
information of zero.

``pose`` (9 rows) is a sampled pose and its uncertainty since the last sample. Updates have Kalman
form, as the noise of a control step has rank 2 and no inverse. ``member`` (6 rows) is a hypothesis:
position [m], covariance [m^2] and log of the aggregated likelihood. Given the pose, hypotheses are
independent.

**Rays** are weighed, shared, updated, pruned and merged (method in `estimation.rays`). An
initialised landmark is a ray of a single hypothesis: its share is 1, and it is never pruned.
Weights are logarithms against underflow. ``rows`` (h, 6 `LANES`) are the hypotheses of a landmark;
lane i has the first ``count[i]``. ``turn`` is 1 in lanes to update and 0 elsewhere.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.arithmetic.elementary import (
    arctangent,
    cosine_and_sine,
    exponential,
    logarithm,
    wrapped,
)
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.estimation.observations.rows import Row
from pipistrelle.estimation.rays import (
    AS_PRINTED,
    EXACT,
    SMALLEST_AGGREGATED_SHARE,
    SMALLEST_SHARE,
    UpdateParams,
)
from pipistrelle.jit import Flag, Whole, inlined, kernel, no_alloc

LANES = 32
"""Particles in a block. With half as many, the compiler unrolls the loops instead of vectorising;
with more, small particle sets do not fill a block."""
X, Y, HEADING, PXX, PXY, PYY, PXH, PYH, PHH = range(0, 9 * LANES, LANES)
XX, XY, YY, LOG_WEIGHT = range(2 * LANES, 6 * LANES, LANES)
POSE, MEMBER = 9 * LANES, 6 * LANES
"""Numbers of a block's poses, and of a hypothesis in each of its lanes."""
Poses = Float[np.ndarray, " rows"]
Member = Float[np.ndarray, " numbers"]
Lanes = Float[np.ndarray, " lanes"]
Counts = Int[np.ndarray, " lanes"]
"""Arrays of a block: poses, a hypothesis, a float, and a count for each particle."""
HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)
ROUNDING = 1e-12
"""Share of the variance below which a pivot is rounding error, as a control step's noise has rank
2."""


@inlined
def _bearing(pose: Poses, member: Member, row: Row, i: Whole) -> tuple[float, float, float, Flag]:
    """Return a bearing's innovation, its derivatives by position, and whether it is defined."""
    dx, dy = member[X + i] - pose[X + i], member[Y + i] - pose[Y + i]
    squared = dx * dx + dy * dy
    inverse = 1.0 / max(squared, NEAREST * NEAREST)
    innovation = wrapped(pose[HEADING + i] + row.bearing - arctangent(dy, dx))
    return innovation, dy * inverse, -dx * inverse, squared >= NEAREST * NEAREST


@inlined
def _bearing_gain(pose: Poses, h0: float, h1: float, i: Whole) -> tuple[float, float, float]:
    """Return the cross-covariance of a pose with a bearing, from the bearing's derivatives."""
    return (
        h0 * pose[PXX + i] + h1 * pose[PXY + i] - pose[PXH + i],
        h0 * pose[PXY + i] + h1 * pose[PYY + i] - pose[PYH + i],
        h0 * pose[PXH + i] + h1 * pose[PYH + i] - pose[PHH + i],
    )


@inlined
def _spread(member: Member, h0: float, h1: float, i: Whole) -> float:
    """Return the variance of a bearing that is due to the landmark hypothesis' covariance."""
    cross = 2.0 * h0 * h1 * member[XY + i]
    return h0 * h0 * member[XX + i] + cross + h1 * h1 * member[YY + i]


@inlined
def _foreseen(pose: Poses, member: Member, row: Row, i: Whole) -> tuple[float, float, Flag]:
    """Return the innovation of a bearing, its variance, and whether it is defined."""
    innovation, h0, h1, far = _bearing(pose, member, row, i)
    a0, a1, a2 = _bearing_gain(pose, h0, h1, i)
    S = (h0 * a0 + h1 * a1 - a2 + _spread(member, h0, h1, i)) + row.bearing_variance
    return innovation, S, far


@no_alloc
def expect_bearing(
    pose: Poses,
    member: Member,
    row: Row,
    count: Counts,
    j: Whole,
    printed: bool,
    log_likelihood: Lanes,
) -> None:
    """Write the log likelihood of a bearing under each particle's hypothesis j (Eq. (19)).

    It lacks the constant, and is minus infinity in lanes without hypothesis j. If the hypothesis is
    too near, the bearing is uniform over the circle, or ignored if there is no other. ``printed``:
    the formula's other reading.
    """
    if printed:
        _expect_as_printed(pose, member, row, count, j, log_likelihood)
        return
    for i in range(LANES):
        innovation, S, far = _foreseen(pose, member, row, i)
        value = -0.5 * (innovation * innovation / S + logarithm(S))
        unforeseen = -HALF_LOG_TAU if count[i] > 1 else HALF_LOG_TAU
        value = value if far else unforeseen
        log_likelihood[i] = value if j < count[i] else -np.inf


@no_alloc
def _expect_as_printed(
    pose: Poses, member: Member, row: Row, count: Counts, j: Whole, log_likelihood: Lanes
) -> None:
    """Write each particle's log likelihood of a bearing by the literal reading of Eq. (19)."""
    for i in range(LANES):
        innovation, S, far = _foreseen(pose, member, row, i)
        value = -0.5 * (innovation * innovation / S) / math.sqrt(2.0 * math.pi * S)
        value = value if far else 0.0
        log_likelihood[i] = value if j < count[i] else -np.inf


@no_alloc
def bearing_beyond(
    pose: Poses, member: Member, row: Row, count: Counts, j: Whole, bound: float
) -> bool:
    """Return whether a bearing is gated by hypothesis j in all particles that have it."""
    beyond = 0
    for i in range(LANES):
        innovation, S, far = _foreseen(pose, member, row, i)
        within = not far or innovation * innovation <= bound * S
        beyond += 0 if within and j < count[i] else 1
    return beyond == LANES


@no_alloc
def refine_by_bearing(pose: Poses, member: Member, row: Row, share: Lanes) -> None:
    """Update each particle's pose by a bearing to a hypothesis, with the weight ``share``."""
    for i in range(LANES):
        innovation, h0, h1, far = _bearing(pose, member, row, i)
        a0, a1, a2 = _bearing_gain(pose, h0, h1, i)
        spread = h0 * a0 + h1 * a1 - a2 + _spread(member, h0, h1, i)
        part = share[i] if far else 0.0
        information = part / (part * spread + row.bearing_variance)  # noise variance / part
        k0, k1, k2 = a0 * information, a1 * information, a2 * information
        pose[X + i] += k0 * innovation
        pose[Y + i] += k1 * innovation
        pose[HEADING + i] += k2 * innovation
        pose[PXX + i] -= a0 * k0
        pose[PXY + i] -= a0 * k1
        pose[PYY + i] -= a1 * k1
        pose[PXH + i] -= a0 * k2
        pose[PYH + i] -= a1 * k2
        pose[PHH + i] -= a2 * k2


@no_alloc
def correct_by_bearing(pose: Poses, member: Member, row: Row, share: Lanes) -> None:
    """Update a hypothesis by a bearing from known poses, with a weight ``share`` per particle."""
    for i in range(LANES):
        innovation, h0, h1, far = _bearing(pose, member, row, i)
        a0 = -h0 * member[XX + i] - h1 * member[XY + i]
        a1 = -h0 * member[XY + i] - h1 * member[YY + i]
        part = share[i] if far else 0.0
        information = part / (part * (-h0 * a0 - h1 * a1) + row.bearing_variance)
        k0, k1 = a0 * information, a1 * information
        member[X + i] += k0 * innovation
        member[Y + i] += k1 * innovation
        member[XX + i] -= a0 * k0
        member[XY + i] -= a0 * k1
        member[YY + i] -= a1 * k1


@inlined
def _active(
    pose: Poses, member: Member, row: Row, i: Whole
) -> tuple[float, float, float, float, float, Flag]:
    """Return innovations of range and bearing, direction, inverse range, and validity."""
    dx, dy = member[X + i] - pose[X + i], member[Y + i] - pose[Y + i]
    near = math.sqrt(dx * dx + dy * dy)
    k = 1.0 / max(near, NEAREST)
    turn = wrapped(pose[HEADING + i] + row.bearing - arctangent(dy, dx))
    return row.range - near, turn, dx * k, dy * k, k, near >= NEAREST


@inlined
def _whitened(
    nu0: float, nu1: float, S00: float, S01: float, S11: float
) -> tuple[float, float, float, float, float]:
    """Return two innovations, made independent with unit variance, and the factors used for it."""
    i0 = 1.0 / math.sqrt(S00)
    L10 = S01 * i0
    i1 = 1.0 / math.sqrt(S11 - L10 * L10)
    e0 = nu0 * i0
    return e0, (nu1 - L10 * e0) * i1, i0, i1, L10


@inlined
def _active_spread(
    pose: Poses, member: Member, c: float, s: float, k: float, row: Row, i: Whole
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the covariances of range and bearing with a pose, and of their innovations."""
    h0, h1 = s * k, -c * k
    a0 = -c * pose[PXX + i] - s * pose[PXY + i]
    a1 = -c * pose[PXY + i] - s * pose[PYY + i]
    a2 = -c * pose[PXH + i] - s * pose[PYH + i]
    b0, b1, b2 = _bearing_gain(pose, h0, h1, i)
    u0 = c * member[XX + i] + s * member[XY + i]
    u1 = c * member[XY + i] + s * member[YY + i]
    S00 = -c * a0 - s * a1 + c * u0 + s * u1 + row.range_variance
    S01 = h0 * a0 + h1 * a1 - a2 - h0 * u0 - h1 * u1
    S11 = h0 * b0 + h1 * b1 - b2 + _spread(member, h0, h1, i) + row.bearing_variance
    return a0, a1, a2, b0, b1, b2, S00, S01, S11


@no_alloc
def expect_active(
    pose: Poses, member: Member, row: Row, count: Counts, j: Whole, log_likelihood: Lanes
) -> None:
    """Write the log likelihood of range and bearing under each particle's hypothesis j."""
    for i in range(LANES):
        nu0, nu1, c, s, k, far = _active(pose, member, row, i)
        _, _, _, _, _, _, S00, S01, S11 = _active_spread(pose, member, c, s, k, row, i)
        e0, e1, i0, i1, _ = _whitened(nu0, nu1, S00, S01, S11)
        value = -0.5 * (e0 * e0 + e1 * e1) + logarithm(i0 * i1)
        S00 = member[XX + i] + member[YY + i] + row.range_variance
        unforeseen = -0.5 * (nu0 * nu0 / S00 + logarithm(S00)) - HALF_LOG_TAU
        unforeseen = unforeseen if count[i] > 1 else 2.0 * HALF_LOG_TAU
        value = value if far else unforeseen
        log_likelihood[i] = value if j < count[i] else -np.inf


@no_alloc
def active_beyond(pose: Poses, member: Member, row: Row, count: Counts, bound: float) -> bool:
    """Return whether all particles have a landmark initialised and gate its range and bearing."""
    beyond = 0
    for i in range(LANES):
        nu0, nu1, c, s, k, far = _active(pose, member, row, i)
        _, _, _, _, _, _, S00, S01, S11 = _active_spread(pose, member, c, s, k, row, i)
        e0, e1, _, _, _ = _whitened(nu0, nu1, S00, S01, S11)
        within = not far or e0 * e0 + e1 * e1 <= bound
        beyond += 0 if within or count[i] > 1 else 1
    return beyond == LANES


@no_alloc
def squared_innovation(pose: Poses, member: Member, row: Row, i: Whole) -> float:
    """Return particle i's squared normalised innovation, or NaN if the landmark is too near."""
    nu0, nu1, c, s, k, far = _active(pose, member, row, i)
    _, _, _, _, _, _, S00, S01, S11 = _active_spread(pose, member, c, s, k, row, i)
    if not far:
        return math.nan
    if math.isnan(row.range):
        return nu1 * nu1 / S11
    e0, e1, _, _, _ = _whitened(nu0, nu1, S00, S01, S11)
    return e0 * e0 + e1 * e1


@no_alloc
def refine_by_active(
    pose: Poses, member: Member, row: Row, count: Counts, log_weight: Lanes
) -> None:
    """Update and weigh particles' poses by range and bearing to an initialised landmark."""
    for i in range(LANES):
        nu0, nu1, c, s, k, far = _active(pose, member, row, i)
        a0, a1, a2, b0, b1, b2, S00, S01, S11 = _active_spread(pose, member, c, s, k, row, i)
        e0, e1, i0, i1, L10 = _whitened(nu0, nu1, S00, S01, S11)
        part = 1.0 if far and count[i] == 1 else 0.0
        value = -0.5 * (e0 * e0 + e1 * e1) + logarithm(i0 * i1) - 2.0 * HALF_LOG_TAU
        log_weight[i] += part * value
        i0, i1 = part * i0, part * i1
        a0, a1, a2 = a0 * i0, a1 * i0, a2 * i0
        b0, b1, b2 = (b0 - L10 * a0) * i1, (b1 - L10 * a1) * i1, (b2 - L10 * a2) * i1
        pose[X + i] += a0 * e0 + b0 * e1
        pose[Y + i] += a1 * e0 + b1 * e1
        pose[HEADING + i] += a2 * e0 + b2 * e1
        pose[PXX + i] -= a0 * a0 + b0 * b0
        pose[PXY + i] -= a0 * a1 + b0 * b1
        pose[PYY + i] -= a1 * a1 + b1 * b1
        pose[PXH + i] -= a0 * a2 + b0 * b2
        pose[PYH + i] -= a1 * a2 + b1 * b2
        pose[PHH + i] -= a2 * a2 + b2 * b2


@no_alloc
def correct_by_active(pose: Poses, member: Member, row: Row, count: Counts) -> None:
    """Update a landmark by range and bearing in all particles that have it fully initialised."""
    for i in range(LANES):
        nu0, nu1, c, s, k, far = _active(pose, member, row, i)
        g0, g1 = -s * k, c * k
        a0 = c * member[XX + i] + s * member[XY + i]
        a1 = c * member[XY + i] + s * member[YY + i]
        b0 = g0 * member[XX + i] + g1 * member[XY + i]
        b1 = g0 * member[XY + i] + g1 * member[YY + i]
        S00, S01 = c * a0 + s * a1 + row.range_variance, g0 * a0 + g1 * a1
        S11 = g0 * b0 + g1 * b1 + row.bearing_variance
        e0, e1, i0, i1, L10 = _whitened(nu0, nu1, S00, S01, S11)
        part = 1.0 if far and count[i] == 1 else 0.0
        i0, i1 = part * i0, part * i1
        a0, a1 = a0 * i0, a1 * i0
        b0, b1 = (b0 - L10 * a0) * i1, (b1 - L10 * a1) * i1
        member[X + i] += a0 * e0 + b0 * e1
        member[Y + i] += a1 * e0 + b1 * e1
        member[XX + i] -= a0 * a0 + b0 * b0
        member[XY + i] -= a0 * a1 + b0 * b1
        member[YY + i] -= a1 * a1 + b1 * b1


@no_alloc
def initialise_member(
    pose: Poses, member: Member, row: Row, log_weight: float, count: Counts
) -> None:
    """Initialise a hypothesis by range and bearing in particles without it initialised."""
    distance, range_variance = row.range, row.range_variance
    across = row.bearing_variance * distance * distance
    for i in range(LANES):
        c, s = cosine_and_sine(pose[HEADING + i] + row.bearing)
        x, y = pose[X + i] + distance * c, pose[Y + i] + distance * s
        xx = range_variance * c * c + across * s * s
        xy = (range_variance - across) * c * s
        yy = range_variance * s * s + across * c * c
        here = count[i] != 1
        member[X + i] = x if here else member[X + i]
        member[Y + i] = y if here else member[Y + i]
        member[XX + i] = xx if here else member[XX + i]
        member[XY + i] = xy if here else member[XY + i]
        member[YY + i] = yy if here else member[YY + i]
        member[LOG_WEIGHT + i] = log_weight if here else member[LOG_WEIGHT + i]


@inlined
def _lower(pose: Poses, i: Whole) -> tuple[float, float, float, float, float, float]:
    """Return the Cholesky factor of a pose's covariance of any rank; small pivots become zero."""
    L00 = math.sqrt(max(pose[PXX + i], 0.0))
    i0 = 1.0 / L00 if L00 > 0.0 else 0.0
    L10, L20 = pose[PXY + i] * i0, pose[PXH + i] * i0
    left = pose[PYY + i] - L10 * L10
    L11 = math.sqrt(max(left, 0.0)) if left > ROUNDING * pose[PYY + i] else 0.0
    i1 = 1.0 / L11 if L11 > 0.0 else 0.0
    L21 = (pose[PYH + i] - L20 * L10) * i1
    left = pose[PHH + i] - L20 * L20 - L21 * L21
    L22 = math.sqrt(max(left, 0.0)) if left > ROUNDING * pose[PHH + i] else 0.0
    return L00, L10, L11, L20, L21, L22


@inlined
def _log_density(gaussian: Poses, pose: Poses, i: Whole) -> float:
    """Return the log density of a Gaussian at a pose, without constant and singular directions."""
    L00, L10, L11, L20, L21, L22 = _lower(gaussian, i)
    i0 = 1.0 / L00 if L00 > 0.0 else 0.0
    i1 = 1.0 / L11 if L11 > 0.0 else 0.0
    i2 = 1.0 / L22 if L22 > 0.0 else 0.0
    e0 = (pose[X + i] - gaussian[X + i]) * i0
    e1 = (pose[Y + i] - gaussian[Y + i] - L10 * e0) * i1
    e2 = (wrapped(pose[HEADING + i] - gaussian[HEADING + i]) - L20 * e0 - L21 * e1) * i2
    volume = (i0 if i0 > 0.0 else 1.0) * (i1 if i1 > 0.0 else 1.0) * (i2 if i2 > 0.0 else 1.0)
    return -0.5 * (e0 * e0 + e1 * e1 + e2 * e2) + logarithm(volume)


@no_alloc
def weigh_sample(prior: Poses, proposal: Poses, pose: Poses, log_weight: Lanes) -> None:
    """Multiply particles' weights by the ratio of prior to proposal density at sampled poses."""
    for i in range(LANES):
        log_weight[i] += _log_density(prior, pose, i) - _log_density(proposal, pose, i)


@no_alloc
def sample_pose(pose: Poses, normal: Lanes) -> None:
    """Sample each particle's pose from its Gaussian by standard normals; zero its covariance."""
    for i in range(LANES):
        L00, L10, L11, L20, L21, L22 = _lower(pose, i)
        n0, n1, n2 = normal[X + i], normal[Y + i], normal[HEADING + i]
        pose[X + i] += L00 * n0
        pose[Y + i] += L10 * n0 + L11 * n1
        pose[HEADING + i] = wrapped(pose[HEADING + i] + L20 * n0 + L21 * n1 + L22 * n2)
    pose[PXX:] = 0.0


Members = Float[np.ndarray, "h numbers"]
"""Hypotheses of a landmark."""


class Scratch(NamedTuple):
    """Workspace to update bearing-only landmarks in a block of L = `LANES` particles."""

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
    """Allocate the temporary arrays to update a landmark with a number of hypotheses."""
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
    """Mark which particles of a block have a landmark initialised, and which not, as 1 and 0."""
    for i in range(LANES):
        scratch.alone[i] = 1.0 if count[i] == 1 else 0.0
        scratch.ray[i] = 1.0 - scratch.alone[i]


@no_alloc
def _largest(logs: Float[np.ndarray, "h lanes"], members: Whole, largest: Lanes) -> None:
    """Write each particle's largest log weight over its hypotheses."""
    for i in range(LANES):
        largest[i] = -np.inf
    for j in range(members):
        row = logs[j]
        for i in range(LANES):
            largest[i] = max(largest[i], row[i])


@no_alloc
def _weigh(rows: Members, members: Whole, scratch: Scratch) -> None:
    """Update and normalise each particle's log weights of hypotheses by a bearing (Eq. (18))."""
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
    """Write the share of a bearing's information that each hypothesis receives (Eq. (19))."""
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
def _add(
    log_likelihood: Lanes,
    numbers: Whole,
    count: Counts,
    params: UpdateParams,
    turn: Lanes,
    log_weight: Lanes,
) -> None:
    """Add a measurement's log likelihood to the log weights of particles where ``turn`` is set.

    A ray's is left out if rays do not weigh.
    """
    for i in range(LANES):
        weighs = turn[i] > 0.0 and (params.rays_weigh or count[i] == 1)
        log_weight[i] += log_likelihood[i] - numbers * HALF_LOG_TAU if weighs else 0.0


@no_alloc
def most_members(count: Counts) -> Whole:
    """Return the largest number of hypotheses that any particle has for a landmark."""
    largest = 1
    for i in range(LANES):
        largest = max(largest, count[i])
    return largest


@no_alloc
def _expect_ray(
    pose: Poses, rows: Members, count: Counts, row: Row, printed: bool, scratch: Scratch
) -> None:
    """Write a bearing's log likelihood under each hypothesis of a landmark in each particle."""
    for j in range(most_members(count)):
        likelihood = scratch.likelihood[j]
        expect_bearing(pose, rows[j], row, count, j, printed, likelihood)


@no_alloc
def weigh_by_bearing(
    pose: Poses,
    rows: Members,
    count: Counts,
    row: Row,
    params: UpdateParams,
    turn: Lanes,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Weigh particles by a bearing's mixture likelihood over a landmark's hypotheses."""
    _expect_ray(pose, rows, count, row, False, scratch)
    if most_members(count) == 1:
        _add(scratch.likelihood[0], 1, count, params, turn, log_weight)
        return
    _weigh(rows, most_members(count), scratch)
    _add(scratch.total, 1, count, params, turn, log_weight)


@no_alloc
def refine_by_ray(
    pose: Poses,
    rows: Members,
    count: Counts,
    row: Row,
    params: UpdateParams,
    turn: Lanes,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Update particles' poses by a bearing to a landmark, and weigh them by its likelihood."""
    members = most_members(count)
    weigh_by_bearing(pose, rows, count, row, params, turn, scratch, log_weight)
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
    rows: Members,
    row: Row,
    count: Counts,
    params: UpdateParams,
    turn: Lanes,
    scratch: Scratch,
    log_weight: Lanes,
) -> None:
    """Weigh particles by the likelihood of range and bearing over a landmark's hypotheses."""
    members = most_members(count)
    for j in range(members):
        expect_active(pose, rows[j], row, count, j, scratch.likelihood[j])
    _weigh(rows, members, scratch)
    _add(scratch.total, 2, count, params, turn, log_weight)


@no_alloc
def _refine_to_mixture(
    pose: Poses, rows: Members, members: Whole, row: Row, turn: Lanes, scratch: Scratch
) -> None:
    """Update poses by a bearing: mean and covariance of the mixture over all hypotheses."""
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
    rows: Members,
    count: Counts,
    row: Row,
    params: UpdateParams,
    turn: Lanes,
    scratch: Scratch,
) -> None:
    """Update, weigh, prune and merge a landmark's hypotheses by a bearing from known poses."""
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


@no_alloc
def heaviest_to_range(
    pose: Poses, rows: Members, count: Counts, distance: float, turn: Lanes
) -> None:
    """Move the heaviest hypothesis of a landmark to a range, keeping its bearing and covariance."""
    for i in range(LANES):
        if turn[i] > 0.0:
            best = 0
            for j in range(1, count[i]):
                best = j if rows[j, LOG_WEIGHT + i] > rows[best, LOG_WEIGHT + i] else best
            member = rows[best]
            dx, dy = member[X + i] - pose[X + i], member[Y + i] - pose[Y + i]
            scale = distance / max(math.sqrt(dx * dx + dy * dy), 1e-12)
            member[X + i], member[Y + i] = pose[X + i] + dx * scale, pose[Y + i] + dy * scale


@no_alloc
def _prune(rows: Members, count: Counts, members: Whole, prune: float, scratch: Scratch) -> None:
    """Remove a landmark's hypotheses of small weight, but never the heaviest (Eq. (21))."""
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
def _merge_members(rows: Members, count: Counts, limit: float) -> None:
    """Merge neighbouring hypotheses of a bearing-only landmark that agree, from near to far."""
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
    """Replace the first of two hypotheses by their mixture if they agree; return whether so."""
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
def _close_up(rows: Members, count: Counts, keep: Float[np.ndarray, "_ lanes"]) -> None:
    """Move the kept hypotheses of a landmark to the front in each particle, and count them."""
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
