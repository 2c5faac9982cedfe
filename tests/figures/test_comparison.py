"""The figure of a comparison: what of it is drawn, where, and that nothing breaks it."""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib import pyplot

from pipistrelle.config import Config
from pipistrelle.evaluation.scores import SCORES, heading, shown_in
from pipistrelle.experiments.comparing import compare_missions, compare_studies
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.figures.comparison import DASHES, RUNS, draw_comparison
from pipistrelle.figures.style import TRUTH as TRUE_COLOUR
from pipistrelle.figures.style import save_figure
from reference.results import TIME, TRUTH, loop, mission_folder, study_folder, turned

OFF = turned(loop(), 0.1, (0.5, -0.2))
LOST = np.full_like(OFF, np.nan)


def missions_of(tmp_path, *paths, names=("one", "two", "three"), truths=(TRUTH,) * 3):
    folders = [
        mission_folder(tmp_path / name, mine, truth=truth)
        for name, mine, truth in zip(names, paths, truths, strict=False)
    ]
    return compare_missions(folders)


def studies_of(tmp_path, *levels, iterations=4):
    plan = Plan(
        name="made-up", iterations=iterations, strategies=("active", "passive"),
        filters=("ekf",), config=Config(), grid={"emitter.radius": (0.0025, 0.025)},
    )  # fmt: skip
    folders = [
        study_folder(tmp_path / f"{k}", plan, lambda case, world, level=level: level * (5 + world))
        for k, level in enumerate(levels)
    ]
    return compare_studies(folders)


def legend(figure):
    return [text.get_text() for text in figure.legends[0].texts]


def lines(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour and line.get_ls() != "None"]


def test_a_row_for_each_estimate_shows_raw_and_aligned_paths_and_their_errors(tmp_path):
    one = {("active", "ekf"): loop(), ("fused", "ekf"): OFF}
    two = {("active", "ekf"): OFF, ("fused", "ekf"): loop()}
    figure = draw_comparison(missions_of(tmp_path, one, two))
    assert len(figure.axes) == 2 * 4
    raw, aligned, error, fitted = figure.axes[4:]
    assert raw.get_title("left") == "fused ekf, as they are"
    (path,) = lines(raw, RUNS[0])
    np.testing.assert_allclose(path.get_xydata(), OFF[:, :2], atol=1e-11)
    (path,) = lines(aligned, RUNS[0])
    np.testing.assert_allclose(path.get_xydata(), loop()[:, :2], atol=1e-9)
    (off,), (exact,) = lines(error, RUNS[0]), lines(error, RUNS[1])
    assert off.get_ydata().max() > 0.5 > 1e-9 > exact.get_ydata().max()
    assert lines(fitted, RUNS[0])[0].get_ydata().max() < 1e-9
    first, one, two, last = legend(figure)
    assert (first, last) == ("true path", "placed landmarks")
    assert (one[0], one[-9:], two[0], two[-9:]) == ("A", "one (EKF)", "B", "two (EKF)")


def test_a_truth_of_all_is_drawn_once_and_others_in_their_folders_colours(tmp_path):
    paths = {("fused", "ekf"): loop()}
    figure = draw_comparison(missions_of(tmp_path / "same", paths, paths))
    assert len(lines(figure.axes[0], TRUE_COLOUR)) == 1
    other = Truth(time=TIME, path=loop(0.3))
    figure = draw_comparison(missions_of(tmp_path / "not", paths, paths, truths=(TRUTH, other)))
    assert lines(figure.axes[0], TRUE_COLOUR) == []
    assert [len(lines(figure.axes[0], colour)) for colour in RUNS[:2]] == [2, 2]


def test_without_truth_the_axes_speak_of_the_first(tmp_path):
    paths = [{("fused", "ekf"): loop()}, {("fused", "ekf"): OFF}]
    figure = draw_comparison(missions_of(tmp_path, *paths, truths=(NO_TRUTH, NO_TRUTH)))
    assert figure.axes[1].get_title("left").endswith("onto the first")
    assert "from the first" in figure.axes[2].get_ylabel()
    assert "true path" not in legend(figure)


def test_folders_differ_in_colour_and_in_dashes(tmp_path):
    paths = {("fused", "ekf"): loop()}
    figure = draw_comparison(missions_of(tmp_path, paths, paths, paths))
    looks = {(line.get_color(), line.get_ls()) for line in figure.axes[2].lines}
    assert len(looks) == 3
    assert len(DASHES) > 2


def test_names_are_no_formulae_and_long_ones_end_as_they_end(tmp_path):
    paths = {("fused", "ekf"): loop()}
    names = ("a$_x$", "b" * 60 + "end")
    figure = draw_comparison(missions_of(tmp_path, paths, paths, names=names))
    (one, two) = legend(figure)[1:3]
    assert one.endswith("a$_x$ (EKF)")
    assert two.startswith("B  …")
    assert two.endswith("bbend (EKF)")
    save_figure(figure, tmp_path / "out", "comparison")


def test_the_title_of_an_estimate_with_dollars_is_shown_as_text(tmp_path):
    paths = {("fused", "own:$x^{$"): loop()}
    figure = draw_comparison(missions_of(tmp_path, paths, paths))
    assert "$x^{$" in figure.axes[0].get_title(loc="left")
    figure.draw_without_rendering()


def test_a_path_that_is_lost_or_far_away_leaves_the_others_to_be_seen(tmp_path):
    far = OFF + np.linspace(0.0, 1e6, len(OFF))[:, None]
    paths = [{("fused", "ekf"): p} for p in (OFF, LOST, far)]
    figure = draw_comparison(missions_of(tmp_path, *paths))
    save_figure(figure, tmp_path / "out", "comparison")
    left, right = figure.axes[0].get_xlim()
    assert 10.0 < right - left < 60.0
    assert figure.axes[2].get_ylim()[1] < 1e3
    assert figure.axes[2].get_title("left") == "diverged: B, C"
    figure = draw_comparison(missions_of(tmp_path / "all", *[{("fused", "ekf"): LOST}] * 2))
    figure.draw_without_rendering()


def test_studies_have_a_panel_for_each_score_and_a_line_for_each_case(tmp_path):
    compared = studies_of(tmp_path, 1.0, 2.0)
    figure = draw_comparison(compared)
    titles = [re.sub(r"\s", " ", axes.get_title("left")) for axes in figure.axes]
    assert titles == [
        heading(SCORES[name])
        for name in (
            "position_rmse_m",
            "position_rmse_aligned_m",
            "map_rmse_aligned_m",
            "landmarks_full",
        )
    ]
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert labels == ["active ekf, 33.0°", "active ekf, 33.0°", "passive ekf"]
    points = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    found = [row["difference"] for row in compared.rows if row["score"] == "position_rmse_m"]
    assert [line.get_xdata().item() for line in points] == found
    assert [line.get_ydata().item() for line in points] == [0.0, 1.0, 2.0]
    assert all(line.get_mfc() == RUNS[1] for line in points), "all are significant"
    assert legend(figure)[0].startswith("A  ")


def test_titles_of_panels_do_not_overlap_however_many_scores_there_are(tmp_path):
    compared = studies_of(tmp_path, 1.0, 2.0)
    rows = [
        row | {"score": name}
        for name in shown_in("studies")
        for row in compared.rows
        if row["score"] == "position_rmse_m"
    ]
    figure = draw_comparison(replace(compared, rows=tuple(rows)))
    figure.draw_without_rendering()
    boxes = [axes._left_title.get_window_extent() for axes in figure.axes]
    assert len(boxes) == len(shown_in("studies"))
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 for box in boxes)


def test_a_difference_that_is_not_sure_is_hollow_and_one_without_an_interval_has_none(tmp_path):
    compared = studies_of(tmp_path, 1.0, 1.0)
    figure = draw_comparison(compared)
    points = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert {line.get_mfc() for line in points} == {"white"}
    assert len(figure.axes[0].collections) == 0


@pytest.mark.parametrize("count", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_figures_are_saved_and_let_go(tmp_path, count):
    compared = studies_of(tmp_path, *np.linspace(1.0, 2.0, count))
    png, pdf = save_figure(draw_comparison(compared), tmp_path / "out", "comparison")
    assert png.stat().st_size > 10_000 < pdf.stat().st_size * 10
    assert pyplot.get_fignums() == []
