import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure

from pipistrelle.figures.closeup import (
    MARGIN,
    MIN_REACH,
    PATH_POSES,
    SIDE,
    Closeup,
    _free_corner,
    _reach,
    add_closeups,
)
from pipistrelle.geometry import range_and_bearing

CLOUD = np.random.default_rng(3).normal([4.0, -2.0, 1.0], [0.3, 0.1, 0.2], (200, 3))
NOWHERE = np.empty((0, 2))
WIDE, TALL = (40.0, 20.0), (20.0, 24.0)


def a_map(size=WIDE):
    axes = Figure().add_subplot()
    axes.set(xlim=(-3.0, size[0] - 3.0), ylim=(5.0, size[1] + 5.0), aspect="equal")
    return axes


def closeup_of(cloud, path, true_path=None, *, reach=0.5) -> Closeup:
    closeup = Closeup(a_map(), "tab:blue", (0.7, 0.4, 0.25, 0.5), reach, len(cloud))
    closeup.show(cloud, path, true_path)
    return closeup


def darts(collection) -> np.ndarray:
    """Outlines (n, 5, 2) of darts, closed."""
    return np.array([outline.vertices for outline in collection.get_paths()])


def test_a_typical_cloud_fills_half_of_its_window_whatever_its_scale():
    inside = np.abs(CLOUD[:, :2] - CLOUD[:, :2].mean(axis=0)).max(axis=1) < _reach([CLOUD]) / 2.0
    assert np.mean(inside) == pytest.approx(0.95, abs=1.0 / len(CLOUD))
    assert _reach([100.0 * CLOUD]) == pytest.approx(100.0 * _reach([CLOUD]))


def test_one_wild_or_infinite_cloud_does_not_change_the_window():
    ordinary = [CLOUD, 1.01 * CLOUD, 0.99 * CLOUD]
    lost = np.full_like(CLOUD, np.nan)
    assert _reach([*ordinary, lost]) == _reach(ordinary)
    assert _reach([*ordinary, 1e6 * CLOUD]) < 1.01 * _reach(ordinary)
    assert _reach([lost]) == MIN_REACH


def test_particles_in_one_place_have_a_window_that_can_be_drawn():
    assert _reach([np.tile(CLOUD[0], (5, 1)), CLOUD[:1]]) == MIN_REACH


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("free", range(4))
def test_the_window_is_in_the_corner_where_no_vehicle_ends(size, free):
    axes = a_map(size)
    x, y = (np.array(axes.get_xlim()), np.array(axes.get_ylim()))
    inset = np.array([1.0, -1.0]) * 0.1 * size[0]
    corners = [np.array([[*at, 0.0]]) for at in itertools.product(x + inset, y + inset)]
    ends = [corner for i, corner in enumerate(corners) if i != free]
    left, bottom, width, height = _free_corner(axes, ends, [corners[free][:, :2]] * 9)
    low = np.array([x[0], y[0]]) + np.array([left, bottom]) * size
    high = low + np.array([width, height]) * size
    assert np.all((corners[free][0, :2] > low) & (corners[free][0, :2] < high))
    assert high - low == pytest.approx(SIDE * size[0]), "a square"
    gap = min((low - [x[0], y[0]]).min(), ([x[1], y[1]] - high).min())
    assert gap == pytest.approx(MARGIN * size[0])


@settings(max_examples=20)
@given(pose=st.tuples(*[st.floats(-9.0, 9.0)] * 3))
def test_the_window_looks_at_the_vehicle(pose):
    path = np.array([[0.0, 0.0, 0.0], pose])
    window = closeup_of(CLOUD, path, reach=0.7)._window
    assert window.get_xlim() == pytest.approx((pose[0] - 0.7, pose[0] + 0.7))
    assert window.get_ylim() == pytest.approx((pose[1] - 0.7, pose[1] + 0.7))


def test_every_particle_is_a_dart_along_its_heading_and_a_dot_on_the_map():
    closeup = closeup_of(CLOUD, CLOUD[:1])
    dots, _, _ = closeup.artists
    assert np.array_equal(dots.get_xydata(), CLOUD[:, :2])
    for outline, pose in zip(darts(closeup._darts), CLOUD, strict=True):
        distance, bearing = range_and_bearing(pose, outline[:1])
        assert bearing[0] == pytest.approx(0.0, abs=1e-9)
        assert distance[0] < 0.5


def test_particles_that_are_lost_are_not_drawn_and_a_lost_vehicle_changes_nothing():
    cloud = CLOUD.copy()
    cloud[::4] = np.nan
    closeup = closeup_of(cloud, CLOUD[:1])
    assert len(darts(closeup._darts)) == 150
    closeup.show(CLOUD, np.full((1, 3), np.nan), None)
    assert len(darts(closeup._darts)) == 150


def test_true_pose_and_path_are_shown_where_they_are_known():
    path = np.cumsum(np.full((2 * PATH_POSES, 3), 0.01), axis=0)
    true = path + np.array([0.0, 0.1, 0.0])
    closeup = closeup_of(CLOUD, path, true)
    assert len(darts(closeup._vehicles)) == 2
    assert np.array_equal(closeup._path.get_xydata(), path[-PATH_POSES:, :2])
    assert np.array_equal(closeup._true.get_xydata(), true[-PATH_POSES:, :2])
    true[-1] = np.nan
    assert len(darts(closeup_of(CLOUD, path, true)._vehicles)) == 1
    assert len(darts(closeup_of(CLOUD, path, true[:0])._vehicles)) == 1


@pytest.mark.parametrize("reach", [0.05, 0.099, 0.1, 0.3, 0.73, 1.0, 42.0])
def test_the_bar_is_as_long_as_it_says(reach):
    window = closeup_of(CLOUD, CLOUD[:1], reach=reach)._window
    length, count = (text.get_text() for text in window.texts)
    bar = window.lines[-1]
    start, end = window.transData.inverted().transform(
        bar.get_transform().transform(bar.get_xydata())
    )
    assert end[0] - start[0] == pytest.approx(float(length.removesuffix(" m")), rel=2e-6)
    share = (end[0] - start[0]) / (2.0 * reach)
    assert 0.2 - 1e-9 <= share <= 0.5 + 1e-9, "of the window"
    assert count == "200 particles"


def test_a_line_leads_from_the_vehicle_into_the_window():
    closeup = closeup_of(CLOUD, CLOUD[:1])
    _, leader, window = closeup.artists
    start, end = leader.get_xydata()
    assert np.array_equal(start, CLOUD[0, :2])
    middle = closeup._map.transLimits.transform(end)
    assert middle == pytest.approx([0.7 + 0.125, 0.4 + 0.25])
    assert leader.zorder < window.zorder


def test_windows_of_one_figure_share_their_scale_and_their_corner():
    maps = [a_map() for _ in range(3)]
    clouds, path = [[CLOUD], [], [3.0 * CLOUD]], CLOUD[:1]
    first, none, last = add_closeups(maps, ["r", "g", "b"], clouds, [path] * 3, [NOWHERE], None)
    assert none is None
    boxes = []
    for closeup, axes, cloud in ((first, maps[0], CLOUD), (last, maps[2], 3.0 * CLOUD)):
        closeup.show(cloud, path, None)
        axes.figure.canvas.draw()
        window = closeup._window
        boxes.append((*window.get_position().bounds, np.ptp(window.get_xlim())))
    assert boxes[0] == pytest.approx(boxes[1])
