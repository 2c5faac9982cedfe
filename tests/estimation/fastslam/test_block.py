"""Kernels on a block of particles, lane by lane."""

import math

import numpy as np
import pytest

from pipistrelle.estimation.fastslam.block import (
    HEADING,
    LANES,
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
    refine_by_active,
    refine_by_bearing,
)
from pipistrelle.estimation.measurement import NEAREST


def uncertain_pair(offset):
    """A block of uncertain poses, each with an uncertain member so far ahead."""
    pose, member = np.zeros(POSE), np.zeros(MEMBER)
    for row, value in ((X, 2.0), (Y, -1.0), (HEADING, 0.0), (PXX, 0.01), (PYY, 0.04), (PHH, 0.02)):
        pose[row : row + LANES] = value
    for row, value in ((X, 2.0 + offset), (Y, -1.0), (XX, 0.25), (YY, 0.09)):
        member[row : row + LANES] = value
    return pose, member


def expected(offset, count, j=0):
    """Log likelihood, with its constant, of a bearing of 0.3 to a member ahead, lane by lane."""
    (pose, member), said = uncertain_pair(offset), np.empty(LANES)
    expect_bearing(pose, member, 0.3, 0.01, np.asarray(count, dtype=np.int64), j, said)
    return said - 0.5 * math.log(2.0 * math.pi)


def test_a_member_at_the_pose_is_uniform_over_the_circle_in_a_ray_and_alone_says_nothing():
    count = np.resize([1, 2, 4], LANES)
    said = expected(0.5 * NEAREST, count)
    assert said[count == 1] == pytest.approx(0.0, abs=1e-15)
    assert said[count > 1] == pytest.approx(-math.log(2.0 * math.pi), rel=1e-15)


def test_a_member_some_way_off_is_as_likely_as_its_gaussian_says_however_many_there_are():
    said = expected(2.0, np.resize([1, 2, 4], LANES))
    S = (0.04 + 0.09) / 2.0**2 + 0.02 + 0.01
    assert said == pytest.approx(-0.5 * (0.3**2 / S + math.log(2.0 * math.pi * S)), rel=1e-12)


def test_a_lane_without_that_member_has_no_likelihood():
    count = np.resize([1, 2, 4], LANES)
    for offset in (0.0, 2.0):
        assert (np.isneginf(expected(offset, count, j=1)) == (count == 1)).all()


@pytest.mark.parametrize(("offset", "says"), [(0.5, False), (2.0, True)])
def test_what_stands_at_the_pose_refines_it_neither_by_its_bearing_nor_by_its_range(offset, says):
    alone, whole = np.ones(LANES, dtype=np.int64), np.ones(LANES)
    for by_range in (False, True):
        pose, member = uncertain_pair(offset * NEAREST)
        before, log_weight = pose.copy(), np.zeros(LANES)
        if by_range:
            refine_by_active(pose, member, 0.01, 0.3, 0.04, 0.01, alone, log_weight)
            assert log_weight.any() == says
        else:
            refine_by_bearing(pose, member, 0.3, 0.01, whole)
        assert np.array_equal(pose, before) == (not says)


@pytest.mark.parametrize(("offset", "beyond"), [(0.5, False), (2.0, True)])
def test_no_gate_drops_what_stands_at_the_pose_for_nothing_was_foreseen_of_it(offset, beyond):
    alone = np.ones(LANES, dtype=np.int64)
    pose, member = uncertain_pair(offset * NEAREST)
    assert bearing_beyond(pose, member, 3.0, 0.01, alone, 0, 1e-9) == beyond
    assert active_beyond(pose, member, 50.0, 3.0, 0.04, 0.01, alone, 1e-9) == beyond
