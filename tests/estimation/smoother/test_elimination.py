"""The arrow against general solvers: GTSAM's on the same graph, and dense normal equations."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pipistrelle.estimation.smoother.filter import Smoother
from pipistrelle.estimation.smoother.history import in_hindsight
from pipistrelle.estimation.smoother.sweep import converged, relinearised
from pipistrelle.geometry import wrap
from reference import dense_smoothing
from reference.beacons import UNICYCLE, ranging, winding
from reference.factor_graph import graph_of, optimum, pose_key, turned
from reference.missions import BICYCLE, SENSING, followed, measured_to, paper_mission, ray_config
from reference.optimum import poses_of
from reference.timing import timed
from reference.walking import roaming_mission, scaled


def last_belief(strategy, seed, *, frames=60, callers=(), robust="none"):
    """The belief at the end of a mission."""
    mission = paper_mission(
        strategy, frames=frames, seed=seed, outliers=0.0 if robust == "none" else 0.03
    )
    scans = [measured_to(scan, range_std=0.2, bearing_std=0.05) for scan in mission.scans]
    mission = replace(mission, scans=scans)
    if callers:
        mission = timed(mission, callers, np.random.default_rng(seed), std=0.05)
    slam = Smoother(motion=BICYCLE, rays=ray_config(), robust=robust)
    *_, (belief, _) = followed(slam, mission)
    return belief


def settled(belief):
    """Its optimum to the last bits: Huber's weights converge slowly."""
    solution = converged(belief.solution, belief.history, belief.noise)
    for _ in range(30):
        solution = relinearised(solution, in_hindsight(belief.history), belief.noise, 0.0)
    return solution


def assert_gtsam_agrees(belief, within=1e-6):
    """Cost, poses and landmarks of the optimum, and covariances there, are GTSAM's."""
    ours = settled(belief)
    graph, points = graph_of(belief)
    values = optimum(graph, points)
    assert ours.cost == pytest.approx(2.0 * graph.error(values), rel=1e-6)
    at = poses_of(ours)
    there = gtsam.utilities.extractPose2(values)
    off = at - there
    off[:, 2] = wrap(off[:, 2])
    assert np.abs(off).max() < within
    for number, label in enumerate(belief.history.placed):
        place = values.atPoint2(gtsam.symbol("l", label))
        assert np.hypot(*(ours.points.spots[number] - place)) < 10 * within
    marginals = gtsam.Marginals(graph, values)
    path = belief.path()
    for node in (belief.history.nodes // 2, belief.history.nodes - 1):
        M = turned(there[node, 2])
        expected = M @ marginals.marginalCovariance(pose_key(node)) @ M.T
        row = belief.history.legs.entries(4)[node, 1]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(path.covariance[row], expected, rtol=0, atol=1e-4 * scale)


@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize("robust", ["none", "huber", "cauchy"])
def test_the_optimum_matches_a_general_solver(strategy, robust):
    belief = last_belief(strategy, 5, frames=30 if robust == "none" else 60, robust=robust)
    assert_gtsam_agrees(belief, within=2e-2 if robust == "cauchy" else 1e-6)


@pytest.mark.parametrize("robust", ["none", "cauchy"])
def test_the_optimum_with_ranges_only_matches_a_general_solver(robust):
    slam = Smoother(motion=UNICYCLE, rays=ray_config(), robust=robust)
    *_, belief = ranging(3, winding(40.0)).followed(slam)
    assert len(belief.history.placed) > 1
    assert_gtsam_agrees(belief)


@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize("callers", [(), (13, 45)], ids=["without timing", "with timing"])
def test_the_optimum_matches_dense_normal_equations(strategy, callers):
    """A step that no longer lowers the cost by what can be told is not taken: landmarks show it."""
    belief = last_belief(strategy, 4, frames=12, callers=callers)
    ours = settled(belief)
    poses, places, _, cost = dense_smoothing.solved(belief)
    off = poses_of(ours) - poses
    off[:, 2] = wrap(off[:, 2])
    assert np.abs(off).max() < 1e-9
    off = ours.points.spots - places
    rows = belief.landmarks()
    spread = rows.covariance[[rows.landmark.tolist().index(one) for one in belief.history.placed]]
    assert np.abs(off / np.sqrt(np.diagonal(spread, axis1=1, axis2=2))).max() < 1e-6
    assert ours.cost == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("strategy", ["passive", "fused"])
def test_the_optimum_with_excess_paths_matches_a_general_solver(strategy):
    assert_gtsam_agrees(last_belief(strategy, 4, frames=20, callers=(13, 45)))


def test_the_optimum_with_a_moving_caller_matches_a_general_solver():
    motion, start = scaled(0.1)
    mission, _ = roaming_mission(np.random.default_rng(4), frames=16)
    slam = Smoother(motion=motion, rays=ray_config(), speed_std=0.7, walk_std=0.3)
    *_, (belief, _) = followed(slam, mission, start)
    assert belief.history.callers
    assert_gtsam_agrees(belief)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", SENSING)
@pytest.mark.parametrize("callers", [(), (13,)], ids=["without timing", "with timing"])
@pytest.mark.parametrize("seed", range(7))
def test_the_optimum_of_a_whole_mission_matches_a_general_solver(strategy, callers, seed):
    assert_gtsam_agrees(last_belief(strategy, seed, frames=375, callers=callers), 1e-5)
