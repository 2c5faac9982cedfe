"""Maps: outlines, limits, names, legends, panels and the windows of particles."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.path import Path

from pipistrelle.acoustics.paths import Caller
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import no_landmarks
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.figures.maps import (
    MIN_REACH,
    PATH_POSES,
    PLACED,
    RAY,
    Closeup,
    MapPanel,
    add_closeups,
    beam,
    callers_shown,
    cells,
    draw_truth,
    ellipses,
    free_corner,
    head,
    legend_symbols,
    shades,
    vehicle,
    view,
    window_reach,
)
from pipistrelle.figures.recorder import Snapshot
from pipistrelle.geometry import range_and_bearing
from reference.missions import map_with

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
def test_every_point_of_an_outline_is_at_the_chi_square_quantile(a, b, angle):
    spread = covariance(a, b, angle)
    offset = ellipses(np.zeros((1, 2)), spread[None], 0.95)[0]
    root = np.linalg.cholesky(spread)
    distance = np.sum(np.linalg.solve(root, offset.T) ** 2, axis=0)
    tolerance = 1e-14 * (max(a, b) / min(a, b)) ** 2 + 1e-12
    assert distance == pytest.approx(-2.0 * np.log(0.05), rel=10.0 * tolerance)


def test_a_zero_covariance_is_a_point_and_an_infinite_is_not_drawn():
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


def test_the_heavier_hypothesis_is_the_more_opaque():
    opacity = shades("#123456", np.array([0.0, 0.2, 0.7, 1.0]))[:, 3]
    assert np.all(np.diff(opacity) > 0.0)


@given(points=st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=9))
def test_a_view_shows_every_true_point_with_a_margin_and_stays_readable(points):
    places = np.array(points)
    lost = np.full((1, 3), 1e6)
    truth = Truth(
        time=np.zeros(1), path=np.zeros((1, 3)), landmarks=(np.arange(len(places)), places)
    )
    (left, right), (bottom, top) = view(truth, (), [lost], [])
    shown = np.vstack([places, [0.0, 0.0]])
    assert np.all((shown > [left, bottom]) & (shown < [right, top]))
    ratio = (top - bottom) / (right - left)
    assert 0.5 - 1e-9 <= ratio <= 1.2 + 1e-9


def test_a_view_without_truth_shows_the_estimates_that_are_finite():
    path = np.array([[0.0, 0.0, 0.0], [8.0, 4.0, 0.0], [np.nan, 0.0, 0.0]])
    (left, right), (bottom, top) = view(NO_TRUTH, (), [path], [])
    assert left < 0.0 < 8.0 < right < 9.0
    assert bottom < 0.0 < 4.0 < top


DRIVEN = Truth(
    time=np.zeros(2),
    path=np.array([[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0]]),
    landmarks=(np.array([1]), np.array([[5.0, 0.0]])),
)


def frame(std: float, *, x: float = 5.0, rows: int = 1) -> np.ndarray:
    """Return the limits of a drive of ten metres to a landmark believed at x, in as many rows."""
    landmarks = map_with(
        np.ones(rows),
        np.tile([x, 0.0], (rows, 1)),
        np.tile(std**2 * np.eye(2), (rows, 1, 1)),
        np.full(rows, 1.0 / rows),
    )
    return np.array(view(DRIVEN, (), [], [landmarks]))


def test_a_view_grows_until_it_holds_the_ellipse_of_a_placed_landmark():
    radius = np.sqrt(-2.0 * np.log(0.05))  # of 95 %, in standard deviations
    (left, right), (bottom, top) = frame(0.8)
    assert (left, right) == pytest.approx((-5.6, 5.0 + 0.8 * radius))
    assert top - bottom == pytest.approx((right - left) / 2.0)
    assert (frame(0.6 / radius) == frame(0.0)).all(), "it fits into the margin"


@pytest.mark.parametrize("std", [3.0, 1e3, 1e60])
def test_a_view_grows_by_no_more_than_half(std):
    least, most = frame(0.0), frame(std)
    assert np.ptp(most[0]) > np.ptp(least[0])
    assert np.all(np.ptp(most, axis=1) <= 1.5 * np.ptp(least, axis=1) + 1e-9)


def test_a_view_grows_to_contain_the_members_of_a_ray_and_no_distant_ellipses():
    one_std = (-5.6, 5.0 + 0.8)
    assert frame(0.8, rows=2)[0] == pytest.approx(one_std, rel=1e-4)
    for distant in (frame(3.0, x=9.0, rows=2), frame(3.0, x=9.0), frame(3.0, x=np.nan)):
        assert (distant == frame(0.0)).all()


def test_panels_go_line_by_line_unless_strategies_and_filters_make_a_table():
    strategies, filters = ("active", "fused", "passive"), ("ekf", "fastslam")
    both = [(strategy, name) for strategy in strategies for name in filters]
    assert cells(both) == [(0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2)]
    assert cells(both[::2]) == [(0, 0), (0, 1), (0, 2)]
    assert cells([("fused", str(i)) for i in range(4)]) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    many = [(str(i), name) for i in range(4) for name in filters]
    assert cells(many) == [divmod(i, 3) for i in range(8)]


def test_a_head_names_strategy_and_filter_side_by_side_a_strangers_too():
    figure = Figure()
    axes = figure.add_subplot()
    head(axes, "fused", "own")
    figure.canvas.draw()
    strategy, estimator, _ = axes.texts
    assert (strategy.get_text(), estimator.get_text()) == ("fused", "own")
    left, right = strategy.get_window_extent(), estimator.get_window_extent()
    assert left.x1 < right.x0
    assert left.y0 == pytest.approx(right.y0, abs=1.0)
    head(axes, "fused", "$x^{$")
    figure.canvas.draw()  # a title with dollars is no formula


def test_fixed_callers_are_stars_and_moving_callers_are_lines():
    angle = np.linspace(0.0, 6.0, 50)
    path = 40.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    post = Caller(name="post", frequency=30e3, level_db=42.8, place=np.array([3.0, 4.0]))
    boat = Caller(name="boat", frequency=25e3, level_db=42.8, place=path)
    axes = Figure().add_subplot()
    draw_truth(axes, None, (post, boat))
    star, line = axes.lines
    assert (star.get_marker(), star.get_xydata().tolist()) == ("*", [[3.0, 4.0]])
    assert (line.get_marker(), line.get_xydata().tolist()) == ("None", path.tolist())
    assert callers_shown((post, boat)) == {"caller", "moving caller"}
    (left, right), _ = view(NO_TRUTH, (post, boat), [np.zeros((1, 3))], [])
    assert left < path[:, 0].min() < 40.0 < right


def test_callers_are_labelled_except_a_single_beacon():
    beacon = Caller(name="beacon", frequency=30e3, level_db=42.8, place=np.array([3.0, 4.0]))
    post = replace(beacon, name="a $5 post", frequency=25e3, place=np.array([-2.0, 1.0]))
    boat = replace(beacon, name="boat", frequency=20e3, place=np.zeros((9, 2)))

    def drawn(*callers):
        figure = Figure()
        axes = figure.add_subplot()
        draw_truth(axes, None, callers)
        figure.canvas.draw()
        names = {text.get_text(): np.asarray(text.xy).tolist() for text in axes.texts}
        return names, callers_shown(callers)

    assert drawn(beacon) == ({}, {"beacon"})
    assert drawn(beacon, boat) == ({"boat": [0.0, 0.0]}, {"beacon", "moving caller"})
    assert drawn(post) == ({"a $5 post": [-2.0, 1.0]}, {"caller"})
    both = {"beacon": [3.0, 4.0], "a $5 post": [-2.0, 1.0]}
    assert drawn(beacon, post) == (both, {"caller"})
    assert callers_shown((beacon, post, boat)) | callers_shown((beacon,)) <= {*legend_symbols()}


CLOUD = np.random.default_rng(3).normal([4.0, -2.0, 1.0], [0.3, 0.1, 0.2], (200, 3))
WIDE, TALL = (40.0, 20.0), (20.0, 24.0)


def a_map(size=WIDE):
    axes = Figure().add_subplot()
    axes.set(xlim=(-3.0, size[0] - 3.0), ylim=(5.0, size[1] + 5.0), aspect="equal")
    return axes


def panel_of(clouds=(None,), pose=(0.0, 0.0, 0.0)) -> MapPanel:
    """Return a panel of frames with these particles on a map."""
    frames = [
        Snapshot(
            scan=make_scan(0.0, np.empty(0), np.empty(0)),
            pose=np.asarray(pose),
            covariance=np.eye(3),
            landmarks=no_landmarks(),
            cloud=cloud,
        )
        for cloud in clouds
    ]
    panel = MapPanel(("fused", "fastslam"), frames, None)
    panel.draw_on(a_map())
    return panel


def closeup_of(cloud, path, true_path=None, *, reach=0.5) -> Closeup:
    closeup = Closeup(panel_of(), (0.7, 0.4, 0.25, 0.5), reach, len(cloud))
    closeup.show(cloud, path, true_path)
    return closeup


def darts(collection) -> np.ndarray:
    """Outlines (n, 5, 2) of darts, closed."""
    return np.array([outline.vertices for outline in collection.get_paths()])


def test_a_typical_cloud_fills_half_of_its_window_and_a_wild_one_changes_nothing():
    reach = window_reach([CLOUD])
    inside = np.abs(CLOUD[:, :2] - CLOUD[:, :2].mean(axis=0)).max(axis=1) < reach / 2.0
    assert np.mean(inside) == pytest.approx(0.95, abs=1.0 / len(CLOUD))
    assert window_reach([100.0 * CLOUD]) == pytest.approx(100.0 * reach)
    ordinary, lost = [CLOUD, 1.01 * CLOUD, 0.99 * CLOUD], np.full_like(CLOUD, np.nan)
    assert window_reach([*ordinary, lost]) == window_reach(ordinary)
    assert window_reach([*ordinary, 1e6 * CLOUD]) < 1.01 * window_reach(ordinary)
    for nowhere in ([lost], [np.tile(CLOUD[0], (5, 1)), CLOUD[:1]]):
        assert window_reach(nowhere) == MIN_REACH


@pytest.mark.parametrize("size", [WIDE, TALL])
@pytest.mark.parametrize("free", range(4))
def test_the_window_is_in_the_corner_where_no_vehicle_ends(size, free):
    axes = a_map(size)
    x, y = (np.array(axes.get_xlim()), np.array(axes.get_ylim()))
    inset = np.array([1.0, -1.0]) * 0.1 * size[0]
    corners = [np.array([[*at, 0.0]]) for at in itertools.product(x + inset, y + inset)]
    ends = [corner for i, corner in enumerate(corners) if i != free]
    left, bottom, width, height = free_corner(axes, ends, [corners[free][:, :2]] * 9)
    low = np.array([x[0], y[0]]) + np.array([left, bottom]) * size
    high = low + np.array([width, height]) * size
    assert np.all((corners[free][0, :2] > low) & (corners[free][0, :2] < high))
    assert high - low == pytest.approx(0.25 * size[0]), "a square"
    gap = min((low - [x[0], y[0]]).min(), ([x[1], y[1]] - high).min())
    assert gap == pytest.approx(0.015 * size[0])


@pytest.mark.parametrize("pose", [(-9.0, 3.0, 1.0), (0.0, 0.0, 0.0), (0.1, 8.7, -2.0)])
def test_the_window_looks_at_the_vehicle(pose):
    path = np.array([[0.0, 0.0, 0.0], pose])
    window = closeup_of(CLOUD, path, reach=0.7).window
    assert window.get_xlim() == pytest.approx((pose[0] - 0.7, pose[0] + 0.7))
    assert window.get_ylim() == pytest.approx((pose[1] - 0.7, pose[1] + 0.7))


def test_every_particle_is_a_dart_along_its_heading_and_a_dot_on_the_map():
    closeup = closeup_of(CLOUD, CLOUD[:1])
    assert np.array_equal(closeup.dots.get_xydata(), CLOUD[:, :2])
    for outline, pose in zip(darts(closeup.darts), CLOUD, strict=True):
        distance, bearing = range_and_bearing(pose, outline[:1])
        assert bearing[0] == pytest.approx(0.0, abs=1e-9)
        assert distance[0] < 0.5


def test_particles_that_are_lost_are_not_drawn_and_a_lost_vehicle_changes_nothing():
    cloud = CLOUD.copy()
    cloud[::4] = np.nan
    closeup = closeup_of(cloud, CLOUD[:1])
    assert len(darts(closeup.darts)) == 150
    closeup.show(CLOUD, np.full((1, 3), np.nan), None)
    assert len(darts(closeup.darts)) == 150


def test_true_pose_and_path_are_shown_where_they_are_known():
    path = np.cumsum(np.full((2 * PATH_POSES, 3), 0.01), axis=0)
    true = path + np.array([0.0, 0.1, 0.0])
    closeup = closeup_of(CLOUD, path, true)
    assert len(darts(closeup.vehicles)) == 2
    assert np.array_equal(closeup.path.get_xydata(), path[-PATH_POSES:, :2])
    assert np.array_equal(closeup.true.get_xydata(), true[-PATH_POSES:, :2])
    true[-1] = np.nan
    assert len(darts(closeup_of(CLOUD, path, true).vehicles)) == 1
    assert len(darts(closeup_of(CLOUD, path, true[:0]).vehicles)) == 1


@pytest.mark.parametrize("reach", [0.05, 0.099, 0.1, 0.3, 0.73, 1.0, 42.0])
def test_the_bar_has_the_length_of_its_label(reach):
    window = closeup_of(CLOUD, CLOUD[:1], reach=reach).window
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
    start, end = closeup.leader.get_xydata()
    assert np.array_equal(start, CLOUD[0, :2])
    middle = closeup._map.transLimits.transform(end)
    assert middle == pytest.approx([0.7 + 0.125, 0.4 + 0.25])
    assert closeup.leader.zorder < closeup.window.zorder


def test_windows_of_one_figure_share_their_scale_and_their_corner():
    clouds = [CLOUD], [None], [3.0 * CLOUD]
    panels = [panel_of(cloud, CLOUD[0]) for cloud in clouds]
    add_closeups(panels, None)
    first, none, last = (panel.closeup for panel in panels)
    assert none is None
    boxes = []
    for closeup, (cloud,) in ((first, clouds[0]), (last, clouds[2])):
        closeup.show(cloud, CLOUD[:1], None)
        window = closeup.window
        window.figure.draw_without_rendering()
        boxes.append((*window.get_position().bounds, np.ptp(window.get_xlim())))
    assert boxes[0] == pytest.approx(boxes[1])
