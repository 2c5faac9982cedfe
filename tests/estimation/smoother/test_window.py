"""A border as wide as what is around: landmarks leave it unheard, and come back when heard."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.estimation.smoother.history import NEVER, STRETCH
from reference.missions import draw_mission, followed, map_with, measured_to, ray_config, steady

CAR = Motion(model="bicycle", control_std=(0.05, 0.002), wheelbase=0.2)
START = Gaussian(mean=np.array([20.0, 0.0, np.pi / 2]), covariance=np.diag([0.01, 0.01, 0.01]) ** 2)
ROUND = 168
"""Frames of a lap of 20 m radius."""
STDS = {"range_std": 0.05, "bearing_std": 0.01}


def round_trip(frames, seed=2):
    """A drive on a circle among landmarks of which a few are near enough to be heard."""
    rng = np.random.default_rng(seed)
    angle, radius = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False), rng.uniform(17.0, 23.0, 60)
    field = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    controls = steady((1.5, 0.01), frames)
    hearing = {"beamwidth": np.pi, "reach": 6.0, "hearing": 6.0}
    mission = draw_mission(rng, CAR, START, field, controls, **hearing, **STDS)
    return replace(mission, scans=[measured_to(scan, **STDS) for scan in mission.scans])


def smoother(**changes):
    return Smoother(motion=CAR, rays=ray_config(), **changes)


def driven(frames=220, known=None, **changes):
    """All beliefs of a drive."""
    slam = smoother(**changes)
    mission = round_trip(frames)
    beliefs = [slam.init(START) if known is None else slam.knowing(slam.init(START), known)]
    for controls, dt, scan in zip(mission.controls, mission.dt, mission.scans, strict=True):
        belief, _ = slam.predict(beliefs[-1], controls, dt)
        beliefs.append(slam.update(belief, scan))
    return beliefs


@pytest.fixture(scope="module")
def forgetful():
    return driven(window=10.0)


@pytest.fixture(scope="module")
def whole():
    return driven()


def test_the_separator_is_as_wide_as_the_surroundings(forgetful, whole):
    """Some seven landmarks are heard at once; a stretch and the window hold some 45 of sixty."""
    widest = max(belief.solution.beta.size for belief in forgetful)
    assert whole[ROUND].solution.beta.size > 115
    assert widest < 100
    assert (forgetful[ROUND].solution.columns == 0).sum() > 15


def test_landmarks_measured_again_return_to_the_separator(forgetful):
    before, after = forgetful[ROUND - 20], forgetful[ROUND + 20]
    left = np.flatnonzero((before.solution.columns == 0) & (before.history.leaves != NEVER))
    again = left[after.solution.columns[left] > 0]
    assert again.size > 3
    assert (after.history.leaves[again] == NEVER).all()


def test_a_window_gives_the_estimates_of_the_whole_map(forgetful, whole):
    """Path, map and their covariances at the end; poses at their time but for their points."""
    ours, theirs = forgetful[-1], whole[-1]
    np.testing.assert_allclose(ours.path().mean, theirs.path().mean, rtol=0, atol=1e-6)
    scale = np.abs(theirs.path().covariance).max()
    np.testing.assert_allclose(
        ours.path().covariance, theirs.path().covariance, rtol=0, atol=1e-6 * scale
    )
    np.testing.assert_allclose(ours.landmarks().mean, theirs.landmarks().mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        ours.landmarks().covariance, theirs.landmarks().covariance, rtol=0, atol=1e-6 * scale
    )
    for one, other in zip(forgetful[1:], whole[1:], strict=True):
        off = np.abs(one.pose().mean - other.pose().mean)
        assert (off < 0.05 * np.sqrt(np.diag(other.pose().covariance))).all()


def test_a_landmark_leaves_at_the_end_of_a_stretch_after_the_window(forgetful):
    """Frames are half a second: what has left was not heard for 20 of them."""
    last = forgetful[2 * STRETCH].history
    left = np.flatnonzero(last.leaves != NEVER)
    assert left.size
    assert sorted({*last.leaves[left].tolist()}) == [0, 1]
    assert (last.silent[left] < STRETCH * (last.leaves[left] + 1) - 20).all()
    assert not (forgetful[STRETCH - 1].history.leaves != NEVER).any()


def test_landmarks_known_beforehand_leave_and_come_as_others_do():
    """Also those that are never heard: they stay what was known of them."""
    field = round_trip(1).landmarks
    known = map_with(
        [*range(1, 61), 99], np.vstack([field, [90.0, 90.0]]), np.tile(0.01 * np.eye(2), (61, 1, 1))
    )
    ours, theirs = driven(150, known, window=10.0)[-1], driven(150, known)[-1]
    assert (ours.solution.columns == 0).sum() > 20
    np.testing.assert_allclose(ours.landmarks().mean, theirs.landmarks().mean, rtol=0, atol=1e-6)
    rows = ours.landmarks()
    far = rows.covariance[rows.landmark == 99]
    np.testing.assert_allclose(far, 0.01 * np.eye(2)[None], rtol=1e-6, atol=1e-9)


def test_earlier_beliefs_are_unchanged_when_landmarks_leave_the_window():
    slam, mission = smoother(window=10.0), round_trip(2 * STRETCH + 2)
    *_, before, _, last = (belief for belief, _ in followed(slam, mission, START))
    state = before.solution.state.copy()
    cost, columns = before.solution.cost, before.solution.columns.copy()
    slam.update(last, mission.scans[0])
    again = slam.update(before, mission.scans[-1])
    assert (before.solution.cost, before.solution.state.tolist()) == (cost, state.tolist())
    np.testing.assert_array_equal(before.solution.columns, columns)
    assert again.history.nodes == before.history.nodes + 1
