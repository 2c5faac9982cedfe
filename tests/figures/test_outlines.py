import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path

from pipistrelle.figures.outlines import PLACED, RAY, beam, ellipses, vehicle
from pipistrelle.geometry import range_and_bearing

POSE = np.array([3.0, -2.0, 2.5])
lengths = st.floats(1e-3, 1e3)


def covariance(a: float, b: float, angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    return turn @ np.diag([a * a, b * b]) @ turn.T


def share_inside(outline: np.ndarray, draws: np.ndarray) -> float:
    return float(np.mean(Path(outline).contains_points(draws)))


def test_the_ellipse_of_a_placed_landmark_holds_95_percent_of_the_draws():
    count, mean, spread = 20_000, np.array([1.0, -7.0]), covariance(3.0, 0.4, 0.7)
    draws = np.random.default_rng(3).multivariate_normal(mean, spread, count)
    outlines = [ellipses(mean[None], spread[None], p)[0] for p in (PLACED, RAY)]
    # The polygon of 48 sides has 0.9971 of the ellipse's area: the share falls by 0.0004.
    bound = 4.0 * np.sqrt(0.95 * 0.05 / count) + 0.0004
    assert abs(share_inside(outlines[0], draws) - 0.95) < bound
    assert abs(share_inside(outlines[1], draws) - 0.95) > bound, "one standard deviation is not it"


@given(a=lengths, b=lengths, angle=st.floats(-4.0, 4.0))
def test_every_point_of_an_outline_lies_at_the_quantile_of_chi_square(a, b, angle):
    spread = covariance(a, b, angle)
    offset = ellipses(np.zeros((1, 2)), spread[None], 0.95)[0]
    root = np.linalg.cholesky(spread)
    distance = np.sum(np.linalg.solve(root, offset.T) ** 2, axis=0)
    tolerance = 1e-14 * (max(a, b) / min(a, b)) ** 2 + 1e-12
    assert distance == pytest.approx(-2.0 * np.log(0.05), rel=10.0 * tolerance)


def test_a_certain_landmark_is_a_point_and_an_unknown_one_is_not_drawn():
    outlines = ellipses(
        np.ones((2, 2)), np.stack([np.zeros((2, 2)), np.full((2, 2), np.nan)]), 0.95
    )
    assert np.all(outlines[0] == 1.0)
    assert np.all(np.isnan(outlines[1]))


def test_the_beam_spans_half_the_beamwidth_to_each_side_of_the_heading():
    distance, bearing = range_and_bearing(POSE, beam(POSE, 1.2, 5.0)[1:])
    assert distance == pytest.approx(5.0)
    assert (bearing.min(), bearing.max()) == pytest.approx((-0.6, 0.6))


def test_the_vehicle_points_along_its_heading():
    distance, bearing = range_and_bearing(POSE, vehicle(POSE, 2.0))
    assert bearing[0] == pytest.approx(0.0)
    assert distance[0] == distance.max()
