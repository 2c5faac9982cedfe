"""The points of bodies that throw sound: Alhazen's problem against its laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.acoustics.paths import reflecting_points

law = settings(deadline=None, max_examples=300)
SEEDS = st.integers(0, 2**32 - 1)


def around_a_body(seed):
    """Source, receiver, centre and radius: from nearly touching it to 20 m away."""
    rng = np.random.default_rng(seed)
    radius, centre = 10.0 ** rng.uniform(-3.0, 0.5), rng.uniform(-9.0, 9.0, 2)
    distance, angle = radius + 10.0 ** rng.uniform(-6.0, 1.3, 2), rng.uniform(-np.pi, np.pi, 2)
    ends = centre + (distance * np.array([np.cos(angle), np.sin(angle)])).T
    return *ends, centre, radius


def reflected(source, receiver, centre, radius):
    at = source[None, None], receiver[None, None], centre[None, None]
    return reflecting_points(*at, np.array([radius]))[0, 0]


@given(seed=SEEDS)
@law
def test_angles_of_incidence_and_reflection_are_equal_on_the_lit_side(seed):
    source, receiver, centre, radius = around_a_body(seed)
    point = reflected(source, receiver, centre, radius)
    normal = (point - centre) / radius
    across = np.array([-normal[1], normal[0]])
    angles = [np.arctan2(way @ across, way @ normal) for way in (source - point, receiver - point)]
    if np.hypot(*normal) < 1.0 - 1e-12:  # in the shadow: on the straight line, straight ahead
        whole = np.hypot(*(source - receiver))
        parts = np.hypot(*(source - point)) + np.hypot(*(receiver - point))
        assert parts == pytest.approx(whole, rel=1e-12)
        assert abs((point - centre) @ (source - receiver)) < 1e-9 * whole
    else:
        assert np.hypot(*normal) == pytest.approx(1.0, rel=0, abs=1e-10)
        # an angle is as sharp as the end is far: 1e-12 m of the point, no more
        near = min(np.hypot(*(end - point)) for end in (source, receiver))
        assert angles[0] + angles[1] == pytest.approx(0.0, abs=1e-10 + 1e-12 / near)
        assert abs(angles[0]) < 0.5 * np.pi + 1e-6


@given(seed=SEEDS)
@law
def test_reflection_points_are_symmetric_in_source_and_receiver(seed):
    source, receiver, centre, radius = around_a_body(seed)
    there = reflected(source, receiver, centre, radius)
    back = reflected(receiver, source, centre, radius)
    np.testing.assert_allclose(there, back, rtol=0, atol=1e-12)


@given(seed=SEEDS)
@law
def test_an_own_echo_reflects_at_the_nearest_surface_point(seed):
    _, receiver, centre, radius = around_a_body(seed)
    offset = centre - receiver
    point = reflected(receiver, receiver, centre, radius) - receiver
    reach = np.hypot(*offset)
    np.testing.assert_allclose(point, offset * (reach - radius) / reach, rtol=0, atol=1e-14 * 20)


def test_a_body_of_zero_radius_reflects_at_its_centre_to_the_bit():
    centre = np.random.default_rng(7).uniform(-9.0, 9.0, (1, 5, 2))
    source, receiver = centre[:, 3:4], np.ones((4, 1, 2))
    found = reflecting_points(source, receiver, centre, np.zeros(5))
    assert found.tobytes() == np.broadcast_to(centre, (4, 5, 2)).tobytes()


def test_reflection_points_are_bit_identical_single_and_in_a_batch():
    rng = np.random.default_rng(7)
    centre, radius = rng.uniform(-9.0, 9.0, (1, 200, 2)), rng.uniform(0.05, 0.6, 200)
    source, receiver = np.full((1, 1, 2), 12.0), rng.uniform(-13.0, -10.0, (5, 1, 2))
    together = reflecting_points(source, receiver, centre, radius)
    for k in range(5):
        for t in range(200):
            here = source, receiver[k : k + 1], centre[:, t : t + 1]
            alone = reflecting_points(*here, radius[t : t + 1])
            assert alone.tobytes() == together[k, t].tobytes()
