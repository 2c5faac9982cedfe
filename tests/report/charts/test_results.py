"""Charts hold the study's numbers, and say which."""

import numpy as np
import pytest

from pipistrelle.evaluation.consistency import anees_bounds
from pipistrelle.figures.chart import csv_rows
from pipistrelle.report.charts.results import study_charts
from pipistrelle.report.claims.contrasts import lap_time, select
from pipistrelle.report.claims.published import TABLE_II
from pipistrelle.report.studied import COMMON, RULES
from report.invented import BEAMWIDTH, invent, only

NAMES = [
    "gain", "anees_ekf", "anees_fastslam", "position_rmse", "heading_rmse",
    "map_rmse", "position_rmse_aligned", "map_rmse_aligned", "landmarks", "table_ii",
]  # fmt: skip


@pytest.fixture(scope="module")
def study():
    study = invent(20)
    study.trials["ekf", "active"].diverged[4, 2] = True
    return study


@pytest.fixture(scope="module")
def charts(study):
    return {chart.name: chart for chart in study_charts(select(study, "world"))}


def series_of(chart, panel, name):
    (found,) = [
        s
        for p in chart.panels
        if p.title == panel
        for s in p.series
        if s.name == name and s.style != "marks"
    ]
    return found


def test_every_figure_of_the_papers_results_is_there(charts):
    assert list(charts) == NAMES


@pytest.mark.parametrize(
    ("chart", "score", "scale"),
    [
        ("position_rmse", "position_rmse_m", 1.0),
        ("heading_rmse", "heading_rmse_rad", 180.0 / np.pi),
        ("map_rmse", COMMON, 1.0),
        ("landmarks", "landmarks_full", 1.0),
    ],
)
def test_a_line_is_the_mean_and_its_band_one_deviation(study, charts, chart, score, scale):
    keep = np.arange(20) != 4
    for way in ("active", "fused", "passive"):
        line = series_of(charts[chart], "EKF", way)
        sample = scale * study.trials["ekf", way].scores[score][keep]
        np.testing.assert_allclose(line.y, np.broadcast_to(sample.mean(axis=0), 12), rtol=1e-12)
        spread = np.broadcast_to(sample.std(axis=0, ddof=1), 12)
        np.testing.assert_allclose(line.high - line.y, spread, rtol=1e-9)
        np.testing.assert_allclose(line.y - line.low, spread, rtol=1e-9)


def test_single_worlds_are_those_above_the_band(study, charts):
    (marks,) = [
        s for s in charts["position_rmse"].panels[0].series if s.name == "active, worlds above σ"
    ]
    line = series_of(charts["position_rmse"], "EKF", "active")
    sample = np.delete(study.trials["ekf", "active"].scores["position_rmse_m"], 4, axis=0)
    expected = [
        v for column, top in zip(sample.T, line.high, strict=True) for v in column[column > top]
    ]
    assert marks.y.tolist() == expected
    near = np.abs(np.log(marks.x[:, None] / BEAMWIDTH)).min(axis=1)
    assert (near < 0.02).all()


def test_anees_is_the_mean_over_the_worlds_that_count_within_its_bounds(study, charts):
    active, _, passive = charts["anees_ekf"].panels
    ideal, *lines = active.series
    assert [s.name for s in lines][::11] == ["180°", "11°"]
    nees = np.delete(study.trials["ekf", "active"].nees, 4, axis=0)
    np.testing.assert_allclose(active.series[-1].y, nees[:, 0].mean(axis=0), rtol=1e-12)
    low, high = anees_bounds(19)
    np.testing.assert_allclose(ideal.low, low, rtol=1e-12)
    np.testing.assert_allclose(ideal.high, high, rtol=1e-12)
    assert set(ideal.y) == {3.0}
    assert active.posts == pytest.approx([lap_time(study) * k for k in (1, 2, 3)])
    assert lines[-1].strength > lines[0].strength
    assert active.y == passive.y


def test_gains_are_paired_and_full_where_significant(study, charts):
    (series,) = charts["gain"].panels[0].series
    scores = [study.trials["ekf", way].scores["position_rmse_m"] for way in ("active", "fused")]
    difference = np.delete(scores[0] - scores[1], 4, axis=0)
    np.testing.assert_allclose(series.y, difference.mean(axis=0), rtol=1e-9)
    excludes = (series.low > 0) | (series.high < 0)
    assert (~series.filled | excludes).all(), "Holm rejects only what the interval alone excludes"


@pytest.mark.parametrize(
    ("chart", "score", "scale"),
    [
        ("position_rmse", "position_bound_m", 1.0),
        ("heading_rmse", "heading_bound_rad", 180.0 / np.pi),
    ],
)
def test_beside_a_raw_error_of_the_path_stands_the_bound_dashed(charts, study, chart, score, scale):
    keep = np.arange(20) != 4
    assert "dashed: the bound" in charts[chart].caption
    for way in ("active", "fused", "passive"):
        line = series_of(charts[chart], "EKF", f"{way}, bound")
        least = scale * study.trials["ekf", way].scores[score][keep].mean(axis=0)
        assert line.dashed
        assert line.role == way
        np.testing.assert_allclose(line.y, np.broadcast_to(least, 12), rtol=1e-12)


def test_errors_that_have_no_bound_stand_alone(charts):
    for name in ("position_rmse_aligned", "map_rmse", "map_rmse_aligned"):
        names = [series.name for panel in charts[name].panels for series in panel.series]
        assert not [one for one in names if one.endswith("bound")]
        assert "bound" not in charts[name].caption


def test_table_ii_stands_beside_ours(charts):
    panel = charts["table_ii"].panels[1]
    assert panel.title == "fully initialised, FastSLAM 2.0"
    assert series_of(charts["table_ii"], panel.title, "the paper").y.tolist() == [
        row.full[0] for row in TABLE_II if row.filter == "fastslam"
    ]
    assert [text for _, text in panel.x.ticks] == ["180°", "33°", "11°", "passive"]


def test_what_a_study_has_not_is_not_drawn(study):
    ekf = only(study, [("ekf", "active"), ("ekf", "fused")])
    charts = {chart.name: chart for chart in study_charts(select(ekf, "world"))}
    assert "anees_fastslam" not in charts
    assert [panel.title for panel in charts["position_rmse"].panels] == ["EKF"]
    assert [panel.title for panel in charts["anees_ekf"].panels] == ["active", "fused"]


@pytest.mark.parametrize("rule", RULES)
def test_charts_can_be_had_where_no_world_counts_or_one(rule):
    lonely = invent(1)
    assert [chart.name for chart in study_charts(select(lonely, rule))] == NAMES
    for trials in lonely.trials.values():
        trials.diverged[:] = True
    charts = study_charts(select(lonely, rule))
    assert ("anees_ekf" in [chart.name for chart in charts]) == (rule == "none")


def test_numbers_of_the_csv_are_those_of_the_figure(charts):
    rows = csv_rows(charts["heading_rmse"], exclusion="world")
    assert rows[0][:6] == [
        "exclusion", "panel", "series", "kind", "beamwidth_deg", "heading_rmse_deg",
    ]  # fmt: skip
    line = series_of(charts["heading_rmse"], "EKF", "fused")
    mine = [row for row in rows if row[1:4] == ["EKF", "fused", "dots"]]
    np.testing.assert_allclose([float(row[5]) for row in mine], line.y, rtol=1e-8)
    np.testing.assert_allclose([float(row[7]) for row in mine], line.high, rtol=1e-8)
