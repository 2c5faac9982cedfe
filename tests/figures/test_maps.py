from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from pipistrelle.acoustics.paths import Caller
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.figures.maps import (
    callers_shown,
    cells,
    draw_truth,
    head,
    legend,
    shades,
    view,
)
from reference.missions import map_with


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


def test_a_view_grows_until_it_holds_the_members_of_a_ray_as_they_are_drawn():
    assert frame(0.8, rows=2)[0] == pytest.approx(
        (-5.6, 5.0 + 0.8), rel=1e-4
    )  # one standard deviation


def test_a_view_does_not_grow_for_what_it_could_not_reach():
    assert (frame(3.0, x=9.0, rows=2) == frame(0.0)).all()
    assert (frame(3.0, x=9.0) == frame(0.0)).all()
    assert (frame(3.0, x=np.nan) == frame(0.0)).all()


def test_a_legend_knows_only_symbols_that_exist():
    with pytest.raises(KeyError, match="unicorn"):
        legend(Figure(), ["unicorn"], 1, 0.0, 0.0)


def test_panels_go_line_by_line_unless_strategies_and_filters_make_a_table():
    strategies, filters = ("active", "fused", "passive"), ("ekf", "fastslam")
    both = [(strategy, name) for strategy in strategies for name in filters]
    assert cells(both) == [(0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2)]
    assert cells(both[::2]) == [(0, 0), (0, 1), (0, 2)]
    assert cells([("fused", str(i)) for i in range(4)]) == [(0, 0), (0, 1), (0, 2), (1, 0)]
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


def test_a_head_shows_a_title_with_dollars_as_text(tmp_path):
    figure = Figure()
    head(figure.add_subplot(), "fused", "$x^{$")
    figure.savefig(tmp_path / "head.png")


def test_callers_are_drawn_as_stars_where_they_stand_and_as_lines_where_they_move():
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


def test_stars_and_paths_bear_their_names_but_for_the_one_beacon():
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
    legend(Figure(), sorted(callers_shown((post, boat))), 1, 0.0, 0.0)  # each has its symbol
