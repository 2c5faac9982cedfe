"""Kernels on all particles: advance, gate, correct, summarise. One particle's steps: `particle`.

Landmark n of a particle has ``count[p, n]`` members, in the columns of ``member[p]`` from
``first[n]`` on: the particles share the columns, not the members.
"""

import math

import numpy as np
from numba import njit

from pipistrelle.estimation.models import carry_pose
from pipistrelle.estimation.particle import (
    LOG_TAU,
    UNFORESEEN,
    WEIGHT,
    bearing_spread,
    correct_by_active,
    correct_by_bearing,
    expect_active,
    expect_bearing,
    expect_from,
    place_member,
    refine_by_active,
    refine_by_bearing,
    sample_pose,
)
from pipistrelle.estimation.rays import (
    heaviest,
    log_likelihood,
    survivors,
    weigh_and_share,
)
from pipistrelle.geometry import wrap_angle


@njit(cache=True, error_model="numpy")
def summarise(mean, covariance, weight):
    """Mean (circular in the heading) and covariance of a swarm's pose, its particles' included."""
    x = y = east = north = 0.0
    for i in range(weight.size):
        x += weight[i] * mean[i, 0]
        y += weight[i] * mean[i, 1]
        east += weight[i] * math.cos(mean[i, 2])
        north += weight[i] * math.sin(mean[i, 2])
    centre = np.array([x, y, wrap_angle(math.atan2(north, east))])
    total, off = np.zeros((3, 3)), np.empty(3)
    for i in range(weight.size):
        off[0], off[1] = mean[i, 0] - centre[0], mean[i, 1] - centre[1]
        off[2] = wrap_angle(mean[i, 2] - centre[2])
        for a in range(3):
            for b in range(3):
                total[a, b] += weight[i] * (off[a] * off[b] + covariance[i, a, b])
    return centre, total


@njit(cache=True, error_model="numpy")
def advance_swarm(mean, covariance, weight, controls, dt, motion, pose_means, pose_covariances):
    """Carry every particle through control steps, in place, and summarise after each."""
    for k in range(dt.size):
        for i in range(weight.size):
            carry_pose(mean[i], covariance[i], controls[k, 0], controls[k, 1], dt[k], motion)
        pose_means[k], pose_covariances[k] = summarise(mean, covariance, weight)


@njit(cache=True, error_model="numpy")
def _slots(landmark, labels):
    """Index of each label among the landmarks; -1 for a new one."""
    slot = np.full(labels.size, -1, dtype=np.int64)
    for m in range(labels.size):
        for n in range(landmark.size):
            if landmark[n] == labels[m]:
                slot[m] = n
    return slot


@njit(cache=True, error_model="numpy")
def gated_by_all(
    mean, covariance, landmark, first, count, member, labels, bearings, ranges, sensing
):
    """Whether each measurement is beyond the gate of every particle that could use it."""
    slot, gated = _slots(landmark, labels), np.zeros(labels.size, dtype=np.bool_)
    for m in range(labels.size):
        n = slot[m]
        gated[m] = n >= 0
        passive = math.isnan(ranges[m])
        for i in range(mean.shape[0] if n >= 0 else 0):
            rows = member[i, first[n] : first[n] + count[i, n]]
            if not passive:
                far = count[i, n] == 1 and sensing.active_bound < expect_active(
                    mean[i], covariance[i], rows[0], ranges[m], bearings[m],
                    sensing.range_variance, sensing.bearing_variance,
                )  # fmt: skip
                gated[m] = gated[m] and far
            for row in rows if passive else rows[:0]:
                innovation, S = expect_bearing(
                    mean[i], covariance[i], row, bearings[m], sensing.bearing_variance
                )
                gated[m] = gated[m] and innovation * innovation > sensing.passive_bound * S
    return gated


@njit(cache=True, error_model="numpy")
def _copy_row(source, target):
    """Copy one member, number by number: a copy of slices would first see whether they overlap."""
    for k in range(6):
        target[k] = source[k]


@njit(cache=True, error_model="numpy")
def _refine_by_ray(pose, P, rows, bearing, sensing, exact, scratch):
    """Correct pose and P by the bearing of a partial landmark; returns the log likelihood."""
    members, variance = rows.shape[0], sensing.bearing_variance
    logs, weight, share = scratch[0], scratch[1], scratch[2]
    for j in range(members):
        innovation, S = expect_bearing(pose, P, rows[j], bearing, variance)
        logs[j] = log_likelihood(innovation, S) if math.isfinite(S) else UNFORESEEN
        weight[j] = rows[j, WEIGHT]
    gained = weigh_and_share(logs, weight, members, sensing.power, sensing.aggregated, share)
    if exact:
        _refine_to_mixture(pose, P, rows, weight, bearing, variance)
    else:
        for j in range(members):
            if share[j] > 0.0:
                refine_by_bearing(pose, P, rows[j], bearing, variance / share[j])
    return gained - 0.5 * LOG_TAU


@njit(cache=True, error_model="numpy")
def _refine_to_mixture(pose, P, rows, weight, bearing, variance):
    """Set pose and P to mean and covariance of the mixture of the members' refinements."""
    members = rows.shape[0]
    means, covariances = np.empty((members, 3)), np.empty((members, 3, 3))
    for j in range(members):
        means[j], covariances[j] = pose, P
        refine_by_bearing(means[j], covariances[j], rows[j], bearing, variance)
    start, shift = pose.copy(), np.zeros(3)
    for j in range(members):
        for a in range(3):
            shift[a] += weight[j] * (means[j, a] - start[a])
    P[:, :] = 0.0
    for j in range(members):
        for a in range(3):
            for b in range(3):
                off = (means[j, a] - start[a] - shift[a]) * (means[j, b] - start[b] - shift[b])
                P[a, b] += weight[j] * (covariances[j, a, b] + off)
    for a in range(3):
        pose[a] = start[a] + shift[a]


@njit(cache=True, error_model="numpy")
def _correct_ray(pose, rows, bearing, sensing, exact, scratch, keep):
    """Weigh, correct and prune a ray from a certain pose, in place; returns the members left."""
    members, variance = rows.shape[0], sensing.bearing_variance
    logs, weight, share = scratch[0], scratch[1], scratch[2]
    off, g0, g1 = scratch[3], scratch[4], scratch[5]
    for j in range(members):
        off[j], g0[j], g1[j] = expect_from(pose, rows[j], bearing)
        S = bearing_spread(rows[j], g0[j], g1[j]) + variance
        near = g0[j] == 0.0 and g1[j] == 0.0
        logs[j] = UNFORESEEN if near else log_likelihood(off[j], S)
        weight[j] = rows[j, WEIGHT]
    weigh_and_share(logs, weight, members, sensing.power, sensing.aggregated, share)
    for j in range(members):
        if exact or share[j] > 0.0:
            part = variance if exact else variance / share[j]
            correct_by_bearing(rows[j], off[j], g0[j], g1[j], part)
    survivors(weight, members, sensing.prune, keep)
    left = 0
    for j in range(members):
        if keep[j]:
            _copy_row(rows[j], rows[left])
            rows[left, WEIGHT] = weight[j]
            left += 1
    return left


@njit(cache=True, error_model="numpy")
def _range_for_ray(pose, rows, distance, bearing, sensing):
    """Give a partial landmark its range, in place: one member is left, the first row."""
    if sensing.reinitialise:
        place_member(
            pose, rows[0], distance, bearing, sensing.range_variance, sensing.bearing_variance, 1.0
        )
        return
    _copy_row(rows[heaviest(rows[:, WEIGHT], rows.shape[0])], rows[0])
    dx, dy = rows[0, 0] - pose[0], rows[0, 1] - pose[1]
    scale = distance / max(math.sqrt(dx * dx + dy * dy), 1e-12)
    rows[0, 0], rows[0, 1], rows[0, WEIGHT] = pose[0] + dx * scale, pose[1] + dy * scale, 1.0
    off, g0, g1 = expect_from(pose, rows[0], bearing)
    correct_by_bearing(rows[0], off, g0, g1, sensing.bearing_variance)


@njit(cache=True, error_model="numpy")
def _refine(pose, P, first, count, member, slot, bearings, ranges, sensing, exact, scratch):
    """Refine one particle's pose by all measurements of its landmarks; returns the log weight."""
    gained = 0.0
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows = member[first[n] : first[n] + count[n]]
        if math.isnan(ranges[m]):
            if count[n] == 1:
                gained += refine_by_bearing(pose, P, rows[0], bearings[m], sensing.bearing_variance)
            else:
                gained += _refine_by_ray(pose, P, rows, bearings[m], sensing, exact, scratch)
        elif count[n] == 1:
            gained += refine_by_active(
                pose, P, rows[0], ranges[m], bearings[m],
                sensing.range_variance, sensing.bearing_variance,
            )  # fmt: skip
    return gained


@njit(cache=True, error_model="numpy")
def _correct(pose, first, count, member, slot, bearings, ranges, sensing, exact, scratch, keep):
    """Correct one particle's measured landmarks from its sampled pose, in place."""
    for m in range(slot.size):
        n = slot[m]
        if n < 0:
            continue
        rows = member[first[n] : first[n] + count[n]]
        if math.isnan(ranges[m]):
            if count[n] == 1:
                off, g0, g1 = expect_from(pose, rows[0], bearings[m])
                correct_by_bearing(rows[0], off, g0, g1, sensing.bearing_variance)
            else:
                count[n] = _correct_ray(pose, rows, bearings[m], sensing, exact, scratch, keep)
        elif count[n] == 1:
            correct_by_active(
                pose, rows[0], ranges[m], bearings[m],
                sensing.range_variance, sensing.bearing_variance,
            )  # fmt: skip
        else:
            _range_for_ray(pose, rows, ranges[m], bearings[m], sensing)
            count[n] = 1


@njit(cache=True, error_model="numpy")
def _place(pose, first, count, member, n, bearing, distance, sensing):
    """Place a new landmark of one particle, one member or a ray of them (Eqs. (16) to (18))."""
    if not math.isnan(distance):
        place_member(
            pose, member[first[n]], distance, bearing,
            sensing.range_variance, sensing.bearing_variance, 1.0,
        )  # fmt: skip
        count[n] = 1
        return
    members = sensing.ray_ranges.size
    for j in range(members):
        place_member(
            pose, member[first[n] + j], sensing.ray_ranges[j], bearing,
            sensing.ray_stds[j] ** 2, sensing.bearing_variance, 1.0 / members,
        )  # fmt: skip
    count[n] = members


@njit(cache=True, error_model="numpy")
def _columns(landmark, count, slot, labels, ranges, rays):
    """Labels with the new ones, and each landmark's first column: no more than its members need."""
    known, particles = landmark.size, count.shape[0]
    fresh = 0
    for m in range(slot.size):
        fresh += slot[m] < 0
    all_labels = np.empty(known + fresh, dtype=np.int64)
    first = np.zeros(known + fresh + 1, dtype=np.int64)
    all_labels[:known] = landmark
    for n in range(known):
        most = 1
        for i in range(particles):
            most = max(most, count[i, n])
        first[n + 1] = first[n] + most
    for m in range(slot.size):
        if slot[m] < 0:
            all_labels[known] = labels[m]
            first[known + 1] = first[known] + (rays if math.isnan(ranges[m]) else 1)
            known += 1
    return all_labels, first


@njit(cache=True, error_model="numpy")
def _copy_members(old_first, old_count, old_member, first, count, member):
    """Copy one particle's members into their new columns."""
    for n in range(old_count.size):
        count[n] = old_count[n]
        for j in range(count[n]):
            _copy_row(old_member[old_first[n] + j], member[first[n] + j])


@njit(cache=True, error_model="numpy")
def correct_swarm(
    old_mean, old_covariance, old_log_weight, old_landmark, old_first, old_count, old_member,
    labels, bearings, ranges, normal, sensing, exact,
):  # fmt: skip
    """Refine, sample, correct and place in copies of all particles; returns the belief's arrays."""
    mean, covariance, log_weight = old_mean.copy(), old_covariance.copy(), old_log_weight.copy()
    slot, known, particles = _slots(old_landmark, labels), old_landmark.size, old_mean.shape[0]
    landmark, first = _columns(
        old_landmark, old_count, slot, labels, ranges, sensing.ray_ranges.size
    )
    count = np.zeros((particles, landmark.size), dtype=np.int64)
    member = np.zeros((particles, first[-1], 6))
    scratch = np.empty((6, sensing.ray_ranges.size))
    keep = np.empty(sensing.ray_ranges.size, dtype=np.bool_)
    for i in range(particles):
        _copy_members(old_first, old_count[i], old_member[i], first, count[i], member[i])
        log_weight[i] += _refine(
            mean[i], covariance[i], first, count[i], member[i], slot, bearings, ranges,
            sensing, exact, scratch,
        )  # fmt: skip
        sample_pose(mean[i], covariance[i], normal[i])
        _correct(
            mean[i], first, count[i], member[i], slot, bearings, ranges, sensing, exact,
            scratch, keep,
        )  # fmt: skip
        n = known
        for m in range(labels.size):
            if slot[m] < 0:
                _place(mean[i], first, count[i], member[i], n, bearings[m], ranges[m], sensing)
                n += 1
    return mean, covariance, log_weight, landmark, first, count, member
