"""Kernels on a block of particles, lane by lane."""

import math

import numpy as np
import pytest

from pipistrelle.config import FastSlamConfig, RayConfig
from pipistrelle.estimation.fastslam.block import (
    HEADING,
    LANES,
    LOG_WEIGHT,
    MEMBER,
    PHH,
    POSE,
    PXX,
    PYY,
    XX,
    YY,
    X,
    Y,
    active_beyond,
    bearing_beyond,
    expect_bearing,
    part_lanes,
    refine_by_active,
    refine_by_bearing,
    scratch_for,
    weigh_by_active,
)
from pipistrelle.estimation.observations.range import NEAREST
from pipistrelle.estimation.observations.rows import Row
from pipistrelle.estimation.rays import update_params


def uncertain_pair(offset):
    """A block of uncertain poses, each with an uncertain member so far ahead."""
    pose, member = np.zeros(POSE), np.zeros(MEMBER)
    for row, value in ((X, 2.0), (Y, -1.0), (HEADING, 0.0), (PXX, 0.01), (PYY, 0.04), (PHH, 0.02)):
        pose[row : row + LANES] = value
    for row, value in ((X, 2.0 + offset), (Y, -1.0), (XX, 0.25), (YY, 0.09)):
        member[row : row + LANES] = value
    return pose, member


def heard(bearing, distance=math.nan):
    """A bearing, and perhaps a range, with the noise of these tests."""
    return Row(1, bearing, distance, 0.01, 0.04)


def expected(offset, count, j=0):
    """Log likelihood, with its constant, of a bearing of 0.3 to a member ahead, lane by lane."""
    (pose, member), said = uncertain_pair(offset), np.empty(LANES)
    expect_bearing(pose, member, heard(0.3), np.asarray(count, dtype=np.int64), j, False, said)
    return said - 0.5 * math.log(2.0 * math.pi)


def test_a_member_at_the_pose_has_a_uniform_bearing_likelihood():
    count = np.resize([1, 2, 4], LANES)
    said = expected(0.5 * NEAREST, count)
    assert said[count == 1] == pytest.approx(0.0, abs=1e-15)
    assert said[count > 1] == pytest.approx(-math.log(2.0 * math.pi), rel=1e-15)


def test_a_distant_member_has_its_gaussian_likelihood():
    said = expected(2.0, np.resize([1, 2, 4], LANES))
    S = (0.04 + 0.09) / 2.0**2 + 0.02 + 0.01
    assert said == pytest.approx(-0.5 * (0.3**2 / S + math.log(2.0 * math.pi * S)), rel=1e-12)


def test_a_lane_without_that_member_has_no_likelihood():
    count = np.resize([1, 2, 4], LANES)
    for offset in (0.0, 2.0):
        assert (np.isneginf(expected(offset, count, j=1)) == (count == 1)).all()


@pytest.mark.parametrize(("offset", "says"), [(0.5, False), (2.0, True)])
def test_a_landmark_at_the_pose_refines_it_by_neither_measurement(offset, says):
    alone, whole = np.ones(LANES, dtype=np.int64), np.ones(LANES)
    for by_range in (False, True):
        pose, member = uncertain_pair(offset * NEAREST)
        before, log_weight = pose.copy(), np.zeros(LANES)
        if by_range:
            refine_by_active(pose, member, heard(0.3, 0.01), alone, log_weight)
            assert log_weight.any() == says
        else:
            refine_by_bearing(pose, member, heard(0.3), whole)
        assert np.array_equal(pose, before) == (not says)


@pytest.mark.parametrize(("offset", "beyond"), [(0.5, False), (2.0, True)])
def test_a_landmark_at_the_pose_is_never_gated(offset, beyond):
    alone = np.ones(LANES, dtype=np.int64)
    pose, member = uncertain_pair(offset * NEAREST)
    assert bearing_beyond(pose, member, heard(3.0), alone, 0, 1e-9) == beyond
    assert active_beyond(pose, member, heard(3.0, 50.0), alone, 1e-9) == beyond


def weighed(unit, distance=5.0):
    """Log weights by a range and a bearing, lengths in a unit [1/m]: of a ray, of a full landmark.

    Every other lane has three members, of which the second is as the other lanes' only one.
    """
    count = np.resize([3, 1], LANES).astype(np.int64)
    (pose, _), rows = uncertain_pair(0.0), np.zeros((3, MEMBER))
    for j, (offset, weight) in enumerate(((2.0, 0.5), (5.2, 0.3), (14.0, 0.2))):
        rows[j] = uncertain_pair(offset)[1]
        rows[j, LOG_WEIGHT : LOG_WEIGHT + LANES] = math.log(weight)
    rows[0, 1:LANES:2] = rows[1, 1:LANES:2]
    rows[0, LOG_WEIGHT + 1 : LOG_WEIGHT + LANES : 2] = 0.0
    for places, power in ((slice(X, HEADING), 1), (slice(PXX, PYY + LANES), 2)):
        pose[places] *= unit**power
    rows[:, X:XX] *= unit
    rows[:, XX:LOG_WEIGHT] *= unit**2
    log_weight, row = np.zeros(LANES), Row(1, 0.1, distance * unit, 0.01, 0.04 * unit**2)
    scratch = scratch_for(3)
    part_lanes(count, scratch)
    params = update_params(RayConfig(), 1.0, swarm=FastSlamConfig())
    weigh_by_active(pose, rows, row, count, params, scratch.ray, scratch, log_weight)
    assert not log_weight[1::2].any()
    refine_by_active(pose, rows[0], row, count, log_weight)
    return log_weight[:2]


@pytest.mark.parametrize("distance", [2.5, 5.0, 9.0])
def test_relative_weights_do_not_depend_on_the_unit_of_length(distance):
    ray, full = weighed(1.0, distance)
    for unit in (1e3, 1e-2):
        assert np.subtract(*weighed(unit, distance)) == pytest.approx(ray - full, rel=1e-9)
    assert weighed(1e3, distance)[0] == pytest.approx(ray - math.log(1e3), rel=1e-9)


def test_a_range_and_a_bearing_weigh_a_ray_by_the_mixture_of_its_members():
    def density(offset):
        S00, S11 = 0.01 + 0.25 + 0.04, (0.04 + 0.09) / offset**2 + 0.02 + 0.01
        log = -0.5 * ((5.0 - offset) ** 2 / S00 + 0.1**2 / S11)
        return math.exp(log) / (2.0 * math.pi * math.sqrt(S00 * S11))

    mixture = 0.5 * density(2.0) + 0.3 * density(5.2) + 0.2 * density(14.0)
    ray, full = weighed(1.0)
    assert ray == pytest.approx(math.log(mixture), rel=1e-12)
    assert full == pytest.approx(math.log(density(5.2)), rel=1e-12)
