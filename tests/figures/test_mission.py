import gc
import subprocess
import sys
import weakref
from dataclasses import replace
from itertools import pairwise

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.collections import LineCollection, PolyCollection
from PIL import Image

from pipistrelle.estimation.beliefs import Gaussian, no_landmarks, placed
from pipistrelle.evaluation.accuracy import position_error
from pipistrelle.evaluation.consistency import nees
from pipistrelle.figures.mission import draw_mission
from pipistrelle.figures.style import save_figure

STRATEGIES = ("active", "fused", "passive")


def maps(figure) -> list:
    return [axes for axes in figure.axes if axes.get_aspect() == 1.0]


def words(axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def marks(axes, marker: str, size: float) -> int:
    lines = [ln for ln in axes.lines if (ln.get_marker(), ln.get_markersize()) == (marker, size)]
    return sum(len(line.get_xdata()) for line in lines)


def open_stars(axes) -> np.ndarray:
    """Return the estimated positions of callers on a map."""
    lines = [line for line in axes.lines if line.get_marker() == "*"]
    points = [line.get_xydata() for line in lines if line.get_markerfacecolor() == "none"]
    return np.concatenate([np.empty((0, 2)), *points])


def named(figure) -> list[str]:
    """Return the names in the legend of a figure."""
    return [text.get_text() for text in figure.legends[0].texts]


@pytest.fixture(scope="module")
def three(ekfs, scene):
    return draw_mission(ekfs, **scene)


@pytest.fixture(scope="module")
def six(watched, scene):
    return draw_mission(watched[0].trials, **scene)


@pytest.fixture(scope="module")
def excess(timed, timed_scene):
    return draw_mission(timed[0].trials, **timed_scene)


def test_each_strategy_has_a_map_and_three_rows_of_errors(three):
    assert len(maps(three)) == 3
    assert len(three.axes) == 3 * 4


def test_titles_contain_error_and_counts(three, ekfs):
    for axes, trial in zip(maps(three), ekfs, strict=True):
        scores = trial.scores
        counts = f"{scores.landmarks_full} of 21 landmarks placed"
        outcome = f"RMSE {scores.position_rmse_m:.2f} m · {counts}"
        assert words(axes) == [trial.strategy, "EKF", outcome]


def test_time_labels_of_neighbouring_panels_do_not_touch(ekfs, scene):
    figure = draw_mission(ekfs, **scene)
    rows = figure.axes[3::4]
    for end in (1.0, 5.0, 20.0, 187.5, 1000.0):
        rows[0].set_xlim(0.0, end)
        figure.draw_without_rendering()
        shown = [label for axes in rows for label in axes.get_xticklabels() if label.get_text()]
        inside = [label for label in shown if 0.0 <= label.get_position()[0] <= end]
        boxes = sorted((b.x0, b.x1) for b in (label.get_window_extent() for label in inside))
        assert len(boxes) >= 9
        assert all(left[1] + 2.0 < right[0] for left, right in pairwise(boxes))


def test_all_panels_have_the_same_scales(three):
    for row in range(4):
        limits = {(axes.get_xlim(), axes.get_ylim()) for axes in three.axes[row::4]}
        assert len(limits) == 1


def test_every_landmark_is_drawn(three, ekfs):
    for axes, trial in zip(maps(three), ekfs, strict=True):
        rows = trial.track.landmarks
        full = int(placed(rows).sum())
        areas = [c for c in axes.collections if isinstance(c, PolyCollection)]
        assert marks(axes, "o", 5.0) == 21, "true landmarks"
        assert marks(axes, "o", 2.6) == full
        drawn = [len(area.get_paths()) for area in areas if len(area.get_paths())]
        assert drawn == [part for part in (len(rows.landmark) - full, full) if part]


def test_each_estimate_is_tied_to_its_landmark(three, ekfs, scene):
    rows = ekfs[1].track.landmarks
    lines = [c for c in maps(three)[1].collections if isinstance(c, LineCollection)]
    (ties,) = [part for part in lines if part.zorder == 4.5]
    true = scene["truth"].landmarks[1][rows.landmark[placed(rows)] - 1]
    assert len(true) > 1
    assert np.allclose([path.vertices[1] for path in ties.get_paths()], true)
    assert np.allclose([path.vertices[0] for path in ties.get_paths()], rows.mean[placed(rows)])


def test_heavier_members_of_a_ray_are_more_opaque(three, ekfs):
    rows = ekfs[2].track.landmarks
    weight = rows.weight[~placed(rows)]
    members = next(c for c in maps(three)[2].collections if isinstance(c, PolyCollection))
    opacity = members.get_facecolor()[:, 3]
    assert np.array_equal(np.argsort(opacity), np.argsort(weight))


def test_only_strategies_that_call_have_a_beam(three):
    patches = [len(axes.patches) for axes in maps(three)]
    assert patches == [2, 2, 1], "beam and vehicle, beam and vehicle, vehicle"


def test_error_rows_show_the_errors_of_the_evaluation(three, ekfs, scene):
    track, path = ekfs[0].track, scene["truth"].path
    _, position, _, consistency = three.axes[:4]
    assert np.array_equal(position.lines[0].get_ydata(), position_error(track.pose.mean, path))
    first = nees(track.pose.mean - path, track.pose.covariance)[:100]
    assert np.allclose(consistency.lines[0].get_ydata()[:100], first)


def test_a_mission_without_truth_has_only_maps(ekfs):
    scores = replace(ekfs[1].scores, position_rmse_m=None)
    figure = draw_mission([replace(ekfs[1], scores=scores)])
    assert len(figure.axes) == 1
    assert "RMSE" not in words(figure.axes[0])[2]
    assert not {*named(figure)} & {"true path", "true landmark", "beacon", "its beam"}
    box, height = figure.legends[0], figure.get_figheight()
    figure.draw_without_rendering()
    below = figure.axes[0].get_position().y0 * height
    assert below - box.get_window_extent().y1 / figure.dpi < 0.6, "inches"


def test_other_callers_have_entries_in_the_legend_and_room_for_them(ekfs, scene, three):
    (beacon,) = scene["callers"]
    boat = replace(beacon, name="boat", place=np.zeros((9, 2)))
    figure = draw_mission(ekfs, **scene | {"callers": (beacon, boat)})
    assert len(named(figure)) == 9
    assert named(figure)[5:7] == ["beacon", "moving caller"]
    assert figure.get_figheight() > three.get_figheight()  # a third row of entries
    whistle = replace(beacon, name="whistle", place=-beacon.place)
    figure = draw_mission(ekfs, **scene | {"callers": (beacon, whistle)})
    assert named(figure)[5:7] == ["caller", "vehicle at the end"]
    assert {"beacon", "whistle"} <= set(words(maps(figure)[0]))
    assert "beacon" not in words(maps(three)[0])


def test_a_figure_has_a_single_legend_with_all_symbols(three):
    (legend,) = three.legends
    assert len(legend.texts) == 8
    assert all(axes.get_legend() is None for axes in three.axes)


RAY, BEAM = "unresolved ray, 1σ, darker: likelier", "its beam"
TIED, FULL = "placed landmark, 95 %, and its error", "placed landmark, 95 %"


def names_of(trial, scene, **changes) -> set[str]:
    """Return the names in the legend of a single map."""
    return {*named(draw_mission([trial], **scene | changes))}


def test_the_legend_names_the_symbols_of_the_map(ekfs, trials, scene):
    active, passive = (names_of(ekfs[i], scene) for i in (0, 2))
    assert active ^ passive == {RAY, BEAM}
    assert BEAM in active
    assert TIED in active & passive
    unknown = replace(scene["truth"], landmarks=None)
    assert {FULL, TIED, "true landmark"} & names_of(ekfs[0], scene, truth=unknown) == {FULL}
    track = ekfs[0].track
    empty = replace(ekfs[0], track=replace(track, landmarks=no_landmarks()))
    assert {FULL, TIED, "true landmark"} & names_of(empty, scene) == {"true landmark"}
    assert "particles" in names_of(trials["fused", "fastslam"], scene)
    assert "particles" not in active
    mean = track.pose.mean.copy()
    mean[70:] = np.nan
    lost = replace(ekfs[0], track=replace(track, pose=replace(track.pose, mean=mean)))
    assert not names_of(lost, scene) & {"vehicle at the end", BEAM}
    assert "estimated path" in names_of(lost, scene)


def test_each_filter_has_a_row_and_each_strategy_a_column(six):
    names = [words(axes)[:2] for axes in maps(six)]
    assert names == [[s, f] for s in STRATEGIES for f in ("EKF", "FastSLAM 2.0")]
    boxes = np.array([axes.get_position().extents for axes in maps(six)]).reshape(3, 2, 4)
    left, _, right, top = np.moveaxis(boxes, 2, 0)
    assert np.all(left[:, 0] == left[:, 1])
    assert np.all(left[1:] > right[:-1])
    assert np.ptp(top, axis=0) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert np.all(top[:, 1] < six.axes[3].get_position().y0), "below the errors of the first row"
    assert six.axes[7].get_position().y0 > 0.0
    labelled = [axes.get_ylabel() != "" for axes in maps(six)]
    assert labelled == [True, True, False, False, False, False]
    ticks = [axes.yaxis.get_tick_params()["labelleft"] for axes in maps(six)]
    assert ticks == labelled


def test_two_filters_of_a_strategy_are_side_by_side(trials, scene):
    two = [trials["fused", name] for name in ("ekf", "fastslam")]
    left, right = maps(draw_mission(two, **scene))
    assert left.get_position().y0 == right.get_position().y0
    assert left.get_position().x1 < right.get_position().x0


def test_particles_are_drawn_and_enlarged_where_there_are_any(six, three, trials):
    for axes, particles in zip(maps(six), [0, 100] * 3, strict=True):
        assert marks(axes, "o", 1.6) == particles
        assert len(axes.child_axes) == (particles > 0)
    window = maps(six)[5].child_axes[0]
    pose = trials["passive", "fastslam"].track.pose.mean[-1]
    assert np.mean(window.get_xlim()) == pytest.approx(pose[0])
    assert np.mean(window.get_ylim()) == pytest.approx(pose[1])
    assert [axes.child_axes for axes in maps(three)] == [[], [], []]


def test_a_nees_of_many_digits_is_written_as_a_power(ekfs, scene):
    pose = replace(ekfs[0].track.pose, covariance=1e-8 * ekfs[0].track.pose.covariance)
    lost = replace(ekfs[0], track=replace(ekfs[0].track, pose=pose))
    figure = draw_mission([lost], **scene)
    figure.draw_without_rendering()
    labels = [label.get_text() for label in figure.axes[3].get_yticklabels()]
    assert max(len(label.strip("$").replace("10^", "")) for label in labels) <= 4


def test_a_trial_with_infinite_errors_is_drawn_as_diverged(ekfs, scene, tmp_path):
    trial = ekfs[0]
    mean, covariance = trial.track.pose.mean.copy(), trial.track.pose.covariance.copy()
    mean[70:], covariance[70:] = np.nan, np.inf
    track = replace(trial.track, pose=Gaussian(mean=mean, covariance=covariance))
    scores = replace(trial.scores, diverged=True, position_rmse_m=float("inf"))
    figure = draw_mission([replace(trial, track=track, scores=scores)], **scene)
    save_figure(figure, tmp_path, "lost")
    assert words(maps(figure)[0])[2] == "diverged · RMSE inf m"


def test_a_saved_figure_is_wide_enough_for_a_page(three, tmp_path):
    png, _ = save_figure(three, tmp_path, "mission")
    with Image.open(png) as image:
        assert image.width >= 1200
    assert png.stat().st_size < 1_000_000


def test_without_trials_there_is_nothing_to_draw():
    with pytest.raises(ValueError, match="at least one trial"):
        draw_mission([])


def test_a_figure_keeps_the_settings_of_matplotlib_and_is_freed(ekfs, scene):
    before = dict(matplotlib.rcParams)
    figure = weakref.ref(draw_mission(ekfs[:1], **scene))
    assert dict(matplotlib.rcParams) == before
    gc.collect()
    assert figure() is None
    assert pyplot.get_fignums() == []


def test_importing_loads_no_matplotlib_and_drawing_no_pyplot():
    program = """
import sys
import pipistrelle.figures.film, pipistrelle.figures.mission
print("matplotlib" in sys.modules)
from pipistrelle.figures.maps import legend_symbols
legend_symbols()
print("matplotlib.pyplot" in sys.modules)
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["False", "False"]


def test_estimated_callers_are_marked_with_excess_paths(timed, excess, three):
    names = named(excess)
    assert names.index("caller as estimated") == names.index("caller") + 2, "a moving one between"
    for axes, trial in zip(maps(excess), timed[0].trials, strict=True):
        rows = trial.track.landmarks
        full = placed(rows) & np.isin(rows.landmark, [9, 10])
        assert full.any()
        ends = [caller.mean[-1:] for caller in trial.track.callers.values()]
        np.testing.assert_array_equal(open_stars(axes), np.concatenate([rows.mean[full], *ends]))
    assert "caller as estimated" not in named(three)
    for axes in maps(three):
        assert len(open_stars(axes)) == 0


def test_excess_paths_of_the_last_scan_are_ellipses(excess, three, timed_fused):
    assert "excess-path ellipse, sound path" in named(excess)
    axes, trial, scan = maps(excess)[1], timed_fused, timed_fused.scans[-1]
    lines = [part for part in axes.collections if isinstance(part, LineCollection)]
    ways = [way for part in lines for way in part.get_segments() if way.shape == (3, 2)]
    k = int(np.searchsorted(trial.track.time, scan.time))
    assert 1 <= len(ways) <= 2
    for caller, spot, vehicle in ways:
        np.testing.assert_array_equal(vehicle, trial.track.pose.mean[k, :2])
        e = np.hypot(*(spot - caller)) + np.hypot(*(spot - vehicle)) - np.hypot(*(caller - vehicle))
        assert np.nanmin(np.abs(scan.excess_path - e)) < 0.5
    assert "excess-path ellipse, sound path" not in named(three)


def test_a_tracked_caller_is_drawn_with_its_track(excess, three, timed_fused):
    assert "its estimated track" in named(excess)
    (track,) = timed_fused.track.callers.values()
    known = track.mean[np.isfinite(track.mean).all(axis=1)]
    axes = maps(excess)[1]
    drawn = [line.get_xydata() for line in axes.lines if line.get_linestyle() == ":"]
    assert len(known) > 20
    np.testing.assert_array_equal(drawn[0], known)
    np.testing.assert_array_equal(open_stars(axes)[-1], known[-1])
    assert "its estimated track" not in named(three)


def test_a_caller_out_of_sight_at_the_end_has_no_star(timed_fused, timed_scene):
    ((label, lost),) = timed_fused.track.callers.items()
    mean = np.where(np.arange(len(lost.mean))[:, None] < 100, lost.mean, np.nan)
    track = replace(timed_fused.track, callers={label: replace(lost, mean=mean)})
    figure = draw_mission([replace(timed_fused, track=track)], **timed_scene)
    known = mean[np.isfinite(mean).all(axis=1)]
    lines = [line.get_xydata() for line in maps(figure)[0].lines]
    assert any(np.array_equal(line, known) for line in lines)
    assert known[-1].tolist() not in open_stars(maps(figure)[0]).tolist()
