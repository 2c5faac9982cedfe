"""Levels over any variable: the study's numbers, the bound beside them, every combination."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.figures.chart import csv_rows
from pipistrelle.report.charts.levels import level_charts
from pipistrelle.report.charts.results import answers, study_charts
from pipistrelle.report.claims.contrasts import select
from pipistrelle.report.reading import read_study
from report.invented import invent, narrowed, only
from report.planted import LEVELS as GRID
from report.planted import by_level, write_planted

BOTH = 'strategies = ["fused", "passive"]\nfilters = ["ekf"]\n'
WORDS = '"rays.weights" = ["instantaneous", "aggregated"]'
MANY = f'beamwidth = {[20 * k for k in range(1, 9)]}\n"beacon.level_db" = [36.8, 48.8]'

DRAWN = [
    "position_rmse", "heading_rmse", "map_rmse", "position_rmse_aligned", "map_rmse_aligned",
    "nees", "landmarks",
]  # fmt: skip
"""Of the scores that are charted, those of which a planted study has numbers."""


def charts_of(tmp_path, *args, **given):
    write_planted(tmp_path / "s", *args, **given)
    study = read_study(tmp_path / "s")
    return study, {chart.name: chart for chart in level_charts(select(study, "none"))}


def series_of(panel, name):
    (found,) = [s for s in panel.series if s.name == name and s.style != "marks"]
    return found


def test_a_line_over_a_number_is_its_mean_within_one_deviation_and_the_bound_is_dashed(tmp_path):
    study, charts = charts_of(tmp_path, ways=BOTH, effect=by_level(0.3))
    assert list(charts) == DRAWN
    (panel,) = charts["position_rmse"].panels
    assert (panel.title, panel.x.label) == ("EKF", "beacon.level_db [dB]")
    for way in ("fused", "passive"):
        table = study.trials["ekf", way].scores["position_rmse_m"]
        line = series_of(panel, way)
        assert line.x.tolist() == [36.8, 42.8, 48.8]
        np.testing.assert_allclose(line.y, table.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(line.high - line.y, table.std(axis=0, ddof=1), rtol=1e-9)
        bound = series_of(panel, f"{way}, bound")
        least = study.trials["ekf", way].scores["position_bound_m"].mean(axis=0)
        np.testing.assert_allclose(bound.y, least, rtol=1e-12)
        assert bound.dashed


def test_over_words_means_stand_apart_with_bars_and_the_bound_is_a_dash_beside_each(tmp_path):
    study, charts = charts_of(tmp_path, WORDS, ways=BOTH)
    (panel,) = charts["position_rmse"].panels
    fused, passive = (series_of(panel, way) for way in ("fused", "passive"))
    assert fused.style == passive.style == "points"
    assert (passive.x < fused.x).all()
    bound = series_of(panel, "fused, bound")
    assert (bound.style, bound.x.tolist()) == ("levels", fused.x.tolist())
    table = study.trials["ekf", "fused"].scores["position_rmse_m"]
    np.testing.assert_allclose(fused.y, table.mean(axis=0), rtol=1e-12)


def test_the_csv_over_words_has_the_words(tmp_path):
    _, charts = charts_of(tmp_path, WORDS)
    header, *rows = csv_rows(charts["position_rmse"])
    assert header[3:5] == ["rays.weights", "position_rmse_m"]
    assert {row[3] for row in rows} == {"instantaneous", "aggregated"}
    mine = [row for row in rows if row[1:3] == ["fused", "points"]]
    assert [row[3] for row in mine] == ["instantaneous", "aggregated"]


def test_each_of_two_variables_has_charts_of_its_own_that_hold_every_combination(tmp_path):
    grid = '"rays.power" = [1, 3]\n"beacon.level_db" = [36.8, 48.8]'
    study, charts = charts_of(tmp_path, grid, effect=by_level(0.3))
    for name, variable in (("rays_power", 0), ("beacon_level_db", 1)):
        chart = charts[f"position_rmse_by_{name}"]
        assert chart.title == f"Position RMSE, over {study.variables[variable].name}"
        shown = np.array([series_of(panel, "fused").y for panel in chart.panels])
        table = study.trials["ekf", "fused"].scores["position_rmse_m"].mean(axis=0).reshape(2, 2)
        np.testing.assert_allclose(shown, table.T if variable == 0 else table, rtol=1e-12)


def test_many_combinations_are_lines_and_the_caption_says_which_is_the_strongest(tmp_path):
    study, charts = charts_of(tmp_path, MANY, effect=by_level(0.3), worlds=3)
    chart = charts["position_rmse_by_beacon_level_db"]
    (panel,) = chart.panels
    assert chart.caption == (
        "Mean over worlds; a line for each value of the beamwidth, that of 20° the strongest; "
        "dashed: the bound"
    )
    lines = [s for s in panel.series if not s.dashed]
    assert [line.name for line in lines] == [f"{20 * k}°" for k in range(1, 9)]
    assert all(line.low is None for line in lines)
    table = study.trials["ekf", "fused"].scores["position_rmse_m"].mean(axis=0).reshape(8, 2)
    np.testing.assert_allclose([line.y for line in lines], table, rtol=1e-12)


def test_nees_is_a_geometric_mean_on_a_logarithmic_axis(tmp_path):
    study, charts = charts_of(tmp_path)
    (panel,) = charts["nees"].panels
    line = series_of(panel, "fused")
    logs = np.log(study.trials["ekf", "fused"].scores["nees_mean"])
    np.testing.assert_allclose(line.y, np.exp(logs.mean(axis=0)), rtol=1e-12)
    np.testing.assert_allclose(line.high / line.y, np.exp(logs.std(axis=0, ddof=1)), rtol=1e-9)
    assert panel.y.log


def test_without_a_variable_the_filters_stand_along_the_axis():
    study = replace(narrowed(invent(6), [5]), variables=())
    charts = {chart.name: chart for chart in level_charts(select(study, "none"))}
    (panel,) = charts["position_rmse"].panels
    assert [text for _, text in panel.x.ticks] == ["EKF", "FastSLAM 2.0"]
    found = {(round(float(s.x[0])), s.name): float(s.y[0]) for s in panel.series if s.name in (
        "active", "fused", "passive",
    )}  # fmt: skip
    for (name, way), trials in study.trials.items():
        at = ["ekf", "fastslam"].index(name)
        assert found[at, way] == pytest.approx(trials.scores["position_rmse_m"].mean())


def test_figures_of_any_study_speak_first_of_what_the_answer_does(tmp_path):
    write_planted(tmp_path / "s", GRID, ways='filters = ["ekf"]\n', worlds=3)
    names = [c.name for c in study_charts(select(read_study(tmp_path / "s"), "none"))]
    assert names == [
        "effect_beacon_level_db_ekf", *DRAWN, "gain", "anees_ekf",
    ]  # fmt: skip
    assert [name for name in names if not answers(name)] == ["map_rmse_aligned", "anees_ekf"]


def test_a_study_of_one_strategy_has_no_gain_to_chart():
    fused = only(invent(3), [("ekf", "fused")])
    assert "gain" not in [chart.name for chart in study_charts(select(fused, "none"))]
