"""What cannot be solved: another way is tried, then without what is new, and it is remembered."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.smoother import graph
from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.estimation.smoother.graph import Solver, landmark_key, links
from reference.missions import BICYCLE, STEP, STEPS_PER_FRAME, ray_config, scan_with

CONTROLS, DT = np.tile([4.0, 0.0], (STEPS_PER_FRAME, 1)), np.full(STEPS_PER_FRAME, STEP)
SURE = Gaussian(mean=np.zeros(3), covariance=1e-8 * np.eye(3))
MOODY = 9
"""The landmark that cannot be solved."""


@pytest.fixture
def moody(monkeypatch):
    """Let iSAM2 fail where a landmark enters; `thoroughly`, by either kind of factors."""
    made = graph._new

    def moody(*, thoroughly):
        class Moody:
            def __init__(self, thorough):
                self.isam, self.fails = made(thorough), thoroughly or not thorough

            def update(self, *given, **named):
                if self.fails and len(given) > 1 and given[1].exists(landmark_key(MOODY)):
                    raise RuntimeError("Indeterminant linear system detected")
                return self.isam.update(*given, **named)

            def __getattr__(self, name):
                return getattr(self.isam, name)

        monkeypatch.setattr(graph, "_new", Moody)

    return moody


def heard(x, *, moody_range=False):
    """A scan from (x, 0): landmark 1 with a range, 9 without, unless it is to have one."""
    places = np.array([[3.0, 4.0], [2.0, -3.0]]) - [x, 0.0]
    distance = np.hypot(*places.T)
    distance[1] = distance[1] if moody_range else np.nan
    bearing = np.arctan2(places[:, 1], places[:, 0])
    return scan_with([1, MOODY], bearing, distance, bearing_std=0.01, range_std=0.01)


def driven(frames=4, **named):
    """Beliefs after each of some frames, two metres apart."""
    slam = Smoother(motion=BICYCLE, rays=ray_config())
    belief, beliefs = slam.init(SURE), []
    for frame in range(frames):
        belief, _ = slam.predict(belief, CONTROLS, DT)
        belief = slam.update(belief, heard(2.0 * (frame + 1), **named))
        beliefs.append(belief)
    return beliefs


def test_without_a_failure_the_landmark_enters_and_nothing_is_thorough():
    beliefs = driven()
    assert beliefs[0].mapped == (1,)
    assert beliefs[-1].mapped == (1, MOODY)
    assert not any(belief.link.thorough for belief in beliefs)


def test_what_cannot_be_solved_with_new_landmarks_is_solved_without_and_they_wait(moody):
    moody(thoroughly=True)
    beliefs = driven()
    for frame, belief in enumerate(beliefs, start=1):
        assert belief.mapped == (1,)
        assert len(belief.waiting[MOODY]) == frame
        np.testing.assert_allclose(belief.pose().mean, [2.0 * frame, 0.0, 0.0], rtol=0, atol=0.05)
    rows = beliefs[-1].landmarks()
    assert np.sum(rows.landmark == MOODY) >= 2
    assert not placed(rows)[rows.landmark == MOODY].any()
    assert beliefs[-1].path().mean.shape == (1 + 4 * STEPS_PER_FRAME, 3)
    assert np.isfinite(beliefs[-1].path().covariance).all()


def test_a_frame_that_cannot_be_solved_either_way_is_left_out(moody):
    moody(thoroughly=True)
    beliefs = driven(moody_range=True)
    assert all(MOODY not in belief.mapped for belief in beliefs)
    assert beliefs[-1].path().mean.shape == (1 + 4 * STEPS_PER_FRAME, 3)
    np.testing.assert_allclose(beliefs[-1].pose().mean, [8.0, 0.0, 0.0], rtol=0, atol=1e-6)


def test_what_cholesky_cannot_solve_is_solved_by_qr_from_then_on(moody):
    untroubled = [(belief.mapped, belief.path().mean) for belief in driven()]
    moody(thoroughly=False)
    beliefs = driven()
    entered = [belief.link.thorough for belief in beliefs].index(True)
    assert MOODY in beliefs[entered].mapped
    assert all(belief.link.thorough for belief in beliefs[entered:])
    for belief, (known, path) in zip(beliefs, untroubled, strict=True):
        assert belief.mapped == known
        np.testing.assert_allclose(belief.path().mean, path, rtol=0, atol=1e-6)


@pytest.mark.parametrize("question", ["marginalCovariance", "jointMarginalCovariance"])
def test_covariances_that_cholesky_cannot_tell_are_told_by_qr(monkeypatch, question):
    made, expected = graph._new, driven()[-1]

    def answered(thorough):
        class Coarse:
            def __init__(self):
                self.isam = made(thorough)

            def __getattr__(self, name):
                if name == question and not thorough:
                    raise RuntimeError("Indeterminate linear system detected")
                return getattr(self.isam, name)

        return Coarse()

    last = driven()[-1]
    monkeypatch.setattr(graph, "_new", answered)
    found = replace(last, solver=Solver())
    for one, there in (
        (found.path(), expected.path()),
        (found.landmarks(), expected.landmarks()),
    ):
        np.testing.assert_allclose(one.mean, there.mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.covariance, there.covariance, rtol=1e-6, atol=1e-12)


def test_a_solver_built_anew_gives_the_same_bits_whatever_it_stood_at():
    beliefs = driven()
    for belief in (beliefs[1], beliefs[3], beliefs[0]):
        other = replace(belief, solver=Solver())
        for one, there in ((belief.pose(), other.pose()), (belief.path(), other.path())):
            np.testing.assert_array_equal(one.mean, there.mean)
            np.testing.assert_array_equal(one.covariance, there.covariance)


def test_a_solver_that_failed_stands_nowhere_and_begins_anew(moody):
    last = driven()[-1].link
    moody(thoroughly=True)
    solver = Solver()
    with pytest.raises(RuntimeError):
        solver.reach(last)
    assert solver.at is None
    first = next(iter(links(last)))
    solver.reach(first)
    assert solver.at is first
