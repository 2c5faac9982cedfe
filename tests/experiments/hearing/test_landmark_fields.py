"""Fields: orchards stand in rows, rooms have corners, all keep clear; what does not fit is told."""

import numpy as np
import pytest
from scipy.stats import kstest

from pipistrelle.config import InputError, ScenarioConfig
from pipistrelle.experiments.hearing.landmark_fields import MAX_ROW_OFFSET, landmarks_in, nearest

NOWHERE = np.empty((0, 2))


def field(kind, seed=7, path=NOWHERE, callers=NOWHERE, **settings):
    setup = ScenarioConfig(field=kind, **settings)
    return landmarks_in(setup, path, callers, np.random.default_rng(seed))


def test_an_orchard_has_rows_between_the_lanes():
    trees = field("rows", landmarks=60, lane=4.0, extent=12.0, spacing=3.0)
    row = (trees[:, 1] + 12.0) / 4.0 - 0.5
    assert np.abs(row - np.rint(row)).max() <= MAX_ROW_OFFSET * 3.0 / 4.0
    one = np.sort(trees[np.rint(row) == np.rint(row[0])][:, 0])
    assert np.abs(np.diff(one) - 3.0).max() <= 2.0 * MAX_ROW_OFFSET * 3.0


def test_rooms_have_their_corners_at_the_corridors_walls_or_behind_them():
    corners = field("rooms", landmarks=40, lane=4.0)
    at_wall = np.isclose(np.abs(corners[:, 1]), 2.0)
    assert 10 < at_wall.sum() < 30
    assert np.abs(corners[~at_wall][:, 1]).min() >= 2.0 + 0.75 * 4.0


@pytest.mark.parametrize("kind", ["disc", "rows", "rooms"])
def test_all_keep_clear_of_path_callers_and_each_other(kind):
    path = np.column_stack((np.linspace(-12.0, 12.0, 200), np.full(200, 1.7)))
    callers = np.array([[0.0, -2.0], [3.0, 4.0]])
    for seed in range(5):
        places = field(kind, seed, path, callers, landmarks=30)
        assert np.hypot(*places.T).max() <= 25.0
        for i, place in enumerate(places):
            assert nearest(path, place) >= 0.5
            assert nearest(callers, place) >= 0.5
            assert nearest(places[:i], place) >= (3.0 if kind == "disc" else 0.5)


@pytest.mark.parametrize(("density", "power"), [("area", 2), ("distance", 1)])
def test_an_annulus_is_uniform_in_area_or_in_distance(density, power):
    places = field("disc", landmarks=4000, spacing=0.0, inner_radius=3.0, density=density)
    distance = np.hypot(*places.T)
    assert distance.min() >= 3.0
    assert distance.max() <= 25.0

    def probability_of_uniform(power):
        share = (distance**power - 3.0**power) / (25.0**power - 3.0**power)
        return kstest(share, "uniform").pvalue

    assert probability_of_uniform(power) > 1e-3
    assert probability_of_uniform(3 - power) < 1e-6


def test_an_annulus_without_room_is_refused():
    with pytest.raises(InputError, match=r"scenario\.inner_radius: found 25 m, expected less than"):
        field("disc", inner_radius=25.0)


@pytest.mark.parametrize("kind", ["rows", "rooms"])
def test_different_seeds_draw_different_fields(kind):
    assert not np.array_equal(field(kind, 1), field(kind, 2))
    assert np.array_equal(field(kind, 1), field(kind, 1))


@pytest.mark.parametrize("kind", ["disc", "rows", "rooms"])
def test_too_many_landmarks_for_a_field_are_refused(kind):
    with pytest.raises(InputError, match=r"scenario\.landmarks: found 400, but (at most|room)"):
        field(kind, landmarks=400, radius=12.0)


def test_trees_without_a_distance_are_refused():
    with pytest.raises(InputError, match=r"scenario\.spacing: found 0"):
        field("rows", spacing=0.0)


@pytest.mark.parametrize("kind", ["disc", "rows", "rooms"])
def test_a_field_may_have_no_landmarks(kind):
    assert field(kind, landmarks=0).shape == (0, 2)
