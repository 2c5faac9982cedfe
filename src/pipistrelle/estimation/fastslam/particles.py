"""Kernels on all particles: advance, gate, correct, summarise. A block's steps: `particle`.

Landmark n of a block has its members in the rows ``member[b, first[n] : first[n + 1]]``, of which
lane i has the first ``count[b, n, i]``: the particles share the rows, not the members.
"""

import math

import numpy as np

from pipistrelle.arithmetic.elementary import cosine_and_sine, wrapped
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
    X,
    Y,
    active_beyond,
    bearing_beyond,
    correct_by_active,
    correct_by_bearing,
    place_member,
    refine_by_active,
    sample_pose,
)
from pipistrelle.estimation.fastslam.block_rays import correct_ray, refine_by_ray, room
from pipistrelle.estimation.motion import advance
from pipistrelle.jit import kernel, lean

SMALLEST_STD = 1e-6
"""Added in quadrature to the pose estimate's x, y [m] and heading [rad]: a swarm that stands still
or has one ancestor may have no spread, and its covariance no inverse."""
LEAST = SMALLEST_STD**2


@lean
def _add_moments(pose, weight, sums):
    """Add a block's weighted positions and directions, lane by lane."""
    for i in range(LANES):
        c, s = cosine_and_sine(pose[HEADING + i])
        sums[X + i] += weight[i] * pose[X + i]
        sums[Y + i] += weight[i] * pose[Y + i]
        sums[PXX + i] += weight[i] * c
        sums[PXY + i] += weight[i] * s


@lean
def _add_spread(pose, weight, x, y, heading, sums):
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
def _add_lanes(sums):
    """Sum of each row over its lanes."""
    total = np.empty(POSE // LANES)
    for row in range(total.size):
        so_far = 0.0
        for i in range(row * LANES, (row + 1) * LANES):
            so_far += sums[i]
        total[row] = so_far
    return total


@kernel
def summarise(pose, weight):
    """Mean (circular in the heading) and covariance of a swarm's pose, its particles' included."""
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


@lean
def _advance_block(pose, step, q0, q1):
    """Carry a block's poses through a control step, known in the vehicle's frame (Eq. (10))."""
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


@kernel
def advance_swarm(pose, weight, controls, dt, motion, pose_means, pose_covariances):
    """Carry every particle through control steps, in place, and summarise after each."""
    for k in range(dt.size):
        speed, turn = controls[k, 0], controls[k, 1]
        step = advance(motion.model, motion.wheelbase, 0.0, speed, turn, dt[k])
        noisy = 1.0 if motion.noise_at_rest or speed != 0.0 or turn != 0.0 else 0.0
        for b in range(pose.shape[0]):
            _advance_block(
                pose[b], step, noisy * motion.speed_variance, noisy * motion.turn_variance
            )
        mean, covariance = summarise(pose, weight)
        for a in range(3):
            pose_means[k, a] = mean[a]
            for b in range(3):
                pose_covariances[k, a, b] = covariance[a, b]


@kernel
def _slots(landmark, labels):
    """Index of each label among the landmarks; -1 for a new one."""
    slot = np.empty(labels.size, dtype=np.int64)
    for m in range(labels.size):
        slot[m] = -1
        for n in range(landmark.size):
            if landmark[n] == labels[m]:
                slot[m] = n
    return slot


@lean
def _most(count):
    """Members of the lane that has most."""
    most = 1
    for i in range(LANES):
        most = max(most, count[i])
    return most


@kernel
def gated_by_all(pose, landmark, first, count, member, labels, bearings, ranges, sensing):
    """Whether each measurement is beyond the gate of every particle that could use it."""
    slot, gated = _slots(landmark, labels), np.zeros(labels.size, dtype=np.bool_)
    for m in range(labels.size):
        n = slot[m]
        gated[m] = n >= 0
        for b in range(pose.shape[0] if n >= 0 else 0):
            rows, counts = member[b, first[n] : first[n + 1]], count[b, n]
            if not math.isnan(ranges[m]):
                gated[m] = gated[m] and active_beyond(
                    pose[b], rows[0], ranges[m], bearings[m],
                    sensing.range_variance, sensing.bearing_variance, counts, sensing.active_bound,
                )  # fmt: skip
                continue
            for j in range(_most(counts)):
                gated[m] = gated[m] and bearing_beyond(
                    pose[b], rows[j], bearings[m], sensing.bearing_variance, counts, j,
                    sensing.passive_bound,
                )  # fmt: skip
    return gated


@lean
def _range_for_ray(pose, rows, count, distance, bearing, sensing, share):
    """Give partial landmarks their range: of each one member is left, the first.

    ``share`` is room for what each lane takes of the bearing: one where it had a ray, else zero.
    """
    if sensing.reinitialise:
        place_member(
            pose, rows[0], distance, bearing,
            sensing.range_variance, sensing.bearing_variance, 0.0, count,
        )  # fmt: skip
        return
    for i in range(LANES):
        share[i] = 0.0
        if count[i] == 1:
            continue
        share[i], best = 1.0, 0
        for j in range(1, count[i]):
            best = j if rows[j, LOG_WEIGHT + i] > rows[best, LOG_WEIGHT + i] else best
        for k in range(i, MEMBER, LANES):
            rows[0, k] = rows[best, k]
        dx, dy = rows[0, X + i] - pose[X + i], rows[0, Y + i] - pose[Y + i]
        scale = distance / max(math.sqrt(dx * dx + dy * dy), 1e-12)
        rows[0, X + i], rows[0, Y + i] = pose[X + i] + dx * scale, pose[Y + i] + dy * scale
        rows[0, LOG_WEIGHT + i] = 0.0
    correct_by_bearing(pose, rows[0], bearing, sensing.bearing_variance, share)


@lean
def _refine(
    pose, log_weight, first, count, member, slot, bearings, ranges, sensing, exact, scratch
):
    """Refine a block's poses, and weigh them, by all measurements of their landmarks."""
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows = member[first[n] : first[n + 1]]
        if math.isnan(ranges[m]):
            refine_by_ray(
                pose, rows, count[n], _most(count[n]), bearings[m], sensing, exact, scratch,
                log_weight,
            )  # fmt: skip
        else:
            refine_by_active(
                pose, rows[0], ranges[m], bearings[m],
                sensing.range_variance, sensing.bearing_variance, count[n], log_weight,
            )  # fmt: skip


@lean
def _correct(pose, first, count, member, slot, bearings, ranges, sensing, exact, scratch):
    """Correct a block's measured landmarks from its sampled poses, in place."""
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows = member[first[n] : first[n + 1]]
        most = _most(count[n])
        if math.isnan(ranges[m]):
            if most == 1:
                correct_by_bearing(
                    pose, rows[0], bearings[m], sensing.bearing_variance, scratch.whole
                )
            else:
                correct_ray(pose, rows, count[n], most, bearings[m], sensing, exact, scratch)
            continue
        correct_by_active(
            pose, rows[0], ranges[m], bearings[m],
            sensing.range_variance, sensing.bearing_variance, count[n],
        )  # fmt: skip
        if most > 1:
            _range_for_ray(pose, rows, count[n], ranges[m], bearings[m], sensing, scratch.total)
            count[n] = 1


@lean
def _place(pose, rows, count, bearing, distance, sensing):
    """Place a block's new landmark, one member or a ray of them (Eqs. (16) to (18))."""
    if not math.isnan(distance):
        place_member(
            pose, rows[0], distance, bearing,
            sensing.range_variance, sensing.bearing_variance, 0.0, count,
        )  # fmt: skip
        count[:] = 1
        return
    members = sensing.ray_ranges.size
    for j in range(members):
        place_member(
            pose, rows[j], sensing.ray_ranges[j], bearing,
            sensing.ray_stds[j] ** 2, sensing.bearing_variance, -math.log(members), count,
        )  # fmt: skip
    count[:] = members


@kernel
def _rows(landmark, count, slot, labels, ranges, rays):
    """Labels with the new ones, each landmark's first row, and the most rows that one needs."""
    known, widest = landmark.size, 1
    fresh = 0
    for m in range(slot.size):
        fresh += slot[m] < 0
    all_labels = np.empty(known + fresh, dtype=np.int64)
    first = np.zeros(known + fresh + 1, dtype=np.int64)
    for n in range(known):
        most = 1
        for b in range(count.shape[0]):
            most = max(most, _most(count[b, n]))
        all_labels[n], first[n + 1] = landmark[n], first[n] + most
        widest = max(widest, most)
    for m in range(slot.size):
        if slot[m] < 0:
            all_labels[known] = labels[m]
            most = rays if math.isnan(ranges[m]) else 1
            first[known + 1] = first[known] + most
            widest = max(widest, most)
            known += 1
    return all_labels, first, widest


@lean
def _copy_members(old_first, old_count, old_member, first, count, member):
    """Copy a block's members into their new rows."""
    for n in range(old_count.shape[0]):
        for j in range(first[n + 1] - first[n]):
            source, target = old_member[old_first[n] + j], member[first[n] + j]
            for k in range(MEMBER):
                target[k] = source[k]
        for i in range(LANES):
            count[n, i] = old_count[n, i]


@kernel
def correct_swarm(
    old_pose, old_landmark, old_first, old_count, old_member,
    labels, bearings, ranges, normal, sensing, exact,
):  # fmt: skip
    """Refine, sample, correct and place in copies of all particles; returns the belief's arrays."""
    pose, gained = old_pose.copy(), np.zeros((old_pose.shape[0], LANES))
    draw = np.empty(3 * LANES)
    slot, known, blocks = _slots(old_landmark, labels), old_landmark.size, old_pose.shape[0]
    rays = sensing.ray_ranges.size
    landmark, first, widest = _rows(old_landmark, old_count, slot, labels, ranges, rays)
    count = np.zeros((blocks, landmark.size, LANES), dtype=np.int64)
    member = np.empty((blocks, first[-1], MEMBER))
    scratch = room(widest)
    for b in range(blocks):
        _copy_members(old_first, old_count[b], old_member[b], first, count[b], member[b])
        _refine(
            pose[b], gained[b], first, count[b], member[b], slot, bearings, ranges,
            sensing, exact, scratch,
        )  # fmt: skip
        for k in range(draw.size):
            particle = min(b * LANES + k % LANES, normal.shape[0] - 1)
            draw[k] = normal[particle, k // LANES]
        sample_pose(pose[b], draw)
        _correct(
            pose[b], first, count[b], member[b], slot, bearings, ranges, sensing, exact, scratch
        )
        n = known
        for m in range(labels.size):
            if slot[m] < 0:
                rows = member[b, first[n] : first[n + 1]]
                _place(pose[b], rows, count[b, n], bearings[m], ranges[m], sensing)
                n += 1
    return pose, gained.ravel()[: normal.shape[0]], landmark, first, count, member


@kernel
def particle_map(count, member, particle):
    """One particle's members, row by row: the number of each landmark's, and (c, 6) numbers."""
    b, i = particle // LANES, particle % LANES
    rows = np.empty((member.shape[1], MEMBER // LANES))
    for j in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            rows[j, k] = member[b, j, k * LANES + i]
    return count[b, :, i].copy(), rows


@kernel
def mean_full(count, weight):
    """Weighted mean number of landmarks of one member: exact where all particles agree."""
    first, more = 0, 0.0
    for p in range(weight.size):
        full = 0
        for n in range(count.shape[1]):
            full += count[p // LANES, n, p % LANES] == 1
        first = full if p == 0 else first
        more += weight[p] * (full - first)
    return first + more


@kernel
def descend(old_pose, old_count, old_member, ancestor):
    """Put copies of the ancestors in the particles' places; spare lanes follow the last."""
    pose, count = np.empty_like(old_pose), np.empty_like(old_count)
    member = np.empty_like(old_member)
    source = np.empty(LANES, dtype=np.int64)
    for b in range(pose.shape[0]):
        for i in range(LANES):
            source[i] = ancestor[min(b * LANES + i, ancestor.size - 1)]
        for k in range(POSE):
            a = source[k % LANES]
            pose[b, k] = old_pose[a // LANES, k - k % LANES + a % LANES]
        for n in range(count.shape[1]):
            for i in range(LANES):
                count[b, n, i] = old_count[source[i] // LANES, n, source[i] % LANES]
        for j in range(member.shape[1]):
            for k in range(0, MEMBER, LANES):
                for i in range(LANES):
                    member[b, j, k + i] = old_member[source[i] // LANES, j, k + source[i] % LANES]
    return pose, count, member
