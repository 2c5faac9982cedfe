"""Charts hold the study's numbers, and say which."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.evaluation.consistency import anees_bounds
from pipistrelle.figures.chart import csv_rows
from pipistrelle.report.charts import (
    MOST_PANELS,
    answers,
    beside,
    effect_charts,
    facets_of,
    gain_charts,
    level_charts,
    study_charts,
)
from pipistrelle.report.effects import effects_of, measures_of
from pipistrelle.report.sentences import TABLE_II
from pipistrelle.report.study import COMMON, RULES, lap_time, read_study, select
from pipistrelle.report.variables import axis_of, axis_of_words, with_article
from report.invented import BEAMWIDTH, diverging, invent, narrowed, only
from report.planted import LEVELS as GRID
from report.planted import by_level, write_planted

NAMES = [
    "gain", "anees_ekf", "anees_fastslam", "position_rmse", "heading_rmse",
    "map_rmse", "position_rmse_aligned", "map_rmse_aligned", "landmarks", "table_ii",
]  # fmt: skip
PAIR = 'strategies = ["active", "passive"]\nfilters = ["ekf"]\n'


@pytest.fixture(scope="module")
def study():
    study = invent(20)
    way = "ekf", "active"
    study.trials[way] = diverging(study.trials[way], 4, 2)
    return study


@pytest.fixture(scope="module")
def charts(study):
    return {chart.name: chart for chart in study_charts(select(study, "world"))}


def line_of(panel, name):
    (found,) = [s for s in panel.series if s.name == name and s.style != "marks"]
    return found


def series_of(chart, title, name):
    (panel,) = [panel for panel in chart.panels if panel.title == title]
    return line_of(panel, name)


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


def test_single_worlds_above_the_band_are_shown(study, charts):
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


def test_raw_errors_of_the_path_have_their_bound_as_a_dashed_line(charts, study):
    keep = np.arange(20) != 4
    bounds = {"position_rmse": "position_bound_m", "heading_rmse": "heading_bound_rad"}
    for chart in ("position_rmse", "heading_rmse", "position_rmse_aligned", "map_rmse"):
        dashed = [s.name for panel in charts[chart].panels for s in panel.series if s.dashed]
        assert bool(dashed) is ("dashed: the bound" in charts[chart].caption) is (chart in bounds)
    for (chart, score), scale in zip(bounds.items(), (1.0, 180.0 / np.pi), strict=True):
        for way in ("active", "fused", "passive"):
            line = series_of(charts[chart], "EKF", f"{way}, bound")
            least = scale * study.trials["ekf", way].scores[score][keep].mean(axis=0)
            assert (line.dashed, line.role) == (True, way)
            np.testing.assert_allclose(line.y, np.broadcast_to(least, 12), rtol=1e-12)


def test_table_ii_is_charted_with_our_counts(charts):
    panel = charts["table_ii"].panels[1]
    assert panel.title == "fully initialised, FastSLAM 2.0"
    assert series_of(charts["table_ii"], panel.title, "the paper").y.tolist() == [
        row.full[0] for row in TABLE_II if row.filter == "fastslam"
    ]
    assert [text for _, text in panel.x.ticks] == ["180°", "33°", "11°", "passive"]


def test_charts_without_data_are_not_drawn(study):
    ekf = only(study, [("ekf", "active"), ("ekf", "fused")])
    charts = {chart.name: chart for chart in study_charts(select(ekf, "world"))}
    assert "anees_fastslam" not in charts
    assert [panel.title for panel in charts["position_rmse"].panels] == ["EKF"]
    assert [panel.title for panel in charts["anees_ekf"].panels] == ["active", "fused"]
    fused = select(only(study, [("ekf", "fused")]), "none")
    assert "gain" not in [chart.name for chart in study_charts(fused)]


@pytest.mark.parametrize("rule", RULES)
def test_charts_can_be_had_where_no_world_counts_or_one(rule):
    lonely = invent(1)
    assert [chart.name for chart in study_charts(select(lonely, rule))] == NAMES
    for way, trials in lonely.trials.items():
        lonely.trials[way] = diverging(trials, 0)
    charts = study_charts(select(lonely, rule))
    assert ("anees_ekf" in [chart.name for chart in charts]) == (rule == "none")


def test_the_csv_has_the_numbers_of_the_figure(charts):
    rows = csv_rows(charts["heading_rmse"], exclusion="world")
    assert rows[0][:6] == [
        "exclusion", "panel", "series", "kind", "beamwidth_deg", "heading_rmse_deg",
    ]  # fmt: skip
    line = series_of(charts["heading_rmse"], "EKF", "fused")
    mine = [row for row in rows if row[1:4] == ["EKF", "fused", "dots"]]
    np.testing.assert_allclose([float(row[5]) for row in mine], line.y, rtol=1e-8)
    np.testing.assert_allclose([float(row[7]) for row in mine], line.high, rtol=1e-8)


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


def test_a_line_over_a_number_is_its_mean_within_one_deviation_and_the_bound_is_dashed(tmp_path):
    study, charts = charts_of(tmp_path, ways=BOTH, effect=by_level(0.3))
    assert list(charts) == DRAWN
    (panel,) = charts["position_rmse"].panels
    assert (panel.title, panel.x.label) == ("EKF", "beacon.level_db [dB]")
    for way in ("fused", "passive"):
        table = study.trials["ekf", way].scores["position_rmse_m"]
        line = line_of(panel, way)
        assert line.x.tolist() == [36.8, 42.8, 48.8]
        np.testing.assert_allclose(line.y, table.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(line.high - line.y, table.std(axis=0, ddof=1), rtol=1e-9)
        bound = line_of(panel, f"{way}, bound")
        least = study.trials["ekf", way].scores["position_bound_m"].mean(axis=0)
        np.testing.assert_allclose(bound.y, least, rtol=1e-12)
        assert bound.dashed


def test_over_words_means_are_shifted_points_with_bars_and_the_bound_is_a_dash(tmp_path):
    study, charts = charts_of(tmp_path, WORDS, ways=BOTH)
    (panel,) = charts["position_rmse"].panels
    fused, passive = (line_of(panel, way) for way in ("fused", "passive"))
    assert fused.style == passive.style == "points"
    assert (passive.x < fused.x).all()
    bound = line_of(panel, "fused, bound")
    assert (bound.style, bound.x.tolist()) == ("levels", fused.x.tolist())
    table = study.trials["ekf", "fused"].scores["position_rmse_m"]
    np.testing.assert_allclose(fused.y, table.mean(axis=0), rtol=1e-12)
    header, *rows = csv_rows(charts["position_rmse"])
    assert header[3:5] == ["rays.weights", "position_rmse_m"]
    mine = [row for row in rows if row[1:3] == ["fused", "points"]]
    assert [row[3] for row in mine] == ["instantaneous", "aggregated"]


def test_each_of_two_variables_has_charts_with_every_combination(tmp_path):
    grid = '"rays.exponent" = [1, 3]\n"beacon.level_db" = [36.8, 48.8]'
    study, charts = charts_of(tmp_path, grid, effect=by_level(0.3))
    for name, variable in (("rays_exponent", 0), ("beacon_level_db", 1)):
        chart = charts[f"position_rmse_by_{name}"]
        assert chart.title == f"Position RMSE, over {with_article(study.variables[variable])}"
        shown = np.array([line_of(panel, "fused").y for panel in chart.panels])
        table = study.trials["ekf", "fused"].scores["position_rmse_m"].mean(axis=0).reshape(2, 2)
        np.testing.assert_allclose(shown, table.T if variable == 0 else table, rtol=1e-12)


def test_many_combinations_are_lines_and_the_caption_names_the_strongest(tmp_path):
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
    line = line_of(panel, "fused")
    logs = np.log(study.trials["ekf", "fused"].scores["nees_mean"])
    np.testing.assert_allclose(line.y, np.exp(logs.mean(axis=0)), rtol=1e-12)
    np.testing.assert_allclose(line.high / line.y, np.exp(logs.std(axis=0, ddof=1)), rtol=1e-9)
    assert panel.y.log


def test_without_a_variable_the_filters_are_along_the_axis():
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


def test_the_first_figures_of_any_study_show_the_scores_of_the_answer(tmp_path):
    write_planted(tmp_path / "s", GRID, ways='filters = ["ekf"]\n', worlds=3)
    names = [c.name for c in study_charts(select(read_study(tmp_path / "s"), "none"))]
    assert names == [
        "effect_beacon_level_db_ekf", *DRAWN, "gain", "anees_ekf",
    ]  # fmt: skip
    assert [name for name in names if not answers(name)] == ["map_rmse_aligned", "anees_ekf"]


@pytest.fixture
def selection(tmp_path):
    write_planted(tmp_path / "s", ways=BOTH, effect=by_level(0.3))
    return select(read_study(tmp_path / "s"), "none")


def test_each_measure_has_a_panel_and_each_strategy_its_points(selection):
    (chart,) = effect_charts(selection)
    assert (chart.name, chart.title) == (
        "effect_beacon_level_db_ekf", "What the beacon level changes, EKF",
    )  # fmt: skip
    assert [panel.title for panel in chart.panels] == [
        measure.title for measure in measures_of(selection.study)
    ]
    for panel in chart.panels:
        assert [series.name for series in panel.series] == ["fused", "passive"]
        fused, passive = panel.series
        assert np.all(passive.x < fused.x)
        assert fused.x == pytest.approx([36.8, 42.8, 48.8], abs=0.3)


def test_points_are_the_effects_with_their_intervals_full_where_shown(selection):
    (chart,) = effect_charts(selection)
    effects = effects_of(selection)
    for measure, panel in zip(measures_of(selection.study), chart.panels, strict=True):
        for series in panel.series:
            mine = [
                e for e in effects
                if e.measure == measure and e.pairing.strategy == series.name
                and e.pairing.factor == "beacon.level_db"
            ]  # fmt: skip
            factor = 180.0 / np.pi if measure.unit == "rad" else 1.0
            mean = np.array([0.0, *(e.finding.mean for e in mine)])
            edges = np.array([e.finding.family for e in mine])
            if measure.ratio:
                mean, edges, factor = np.exp(mean), np.exp(edges), 1.0
            np.testing.assert_allclose(series.y, factor * mean, rtol=1e-12)
            known = np.isfinite(edges).all(axis=1)
            np.testing.assert_allclose(series.low[1:][known], factor * edges[known, 0], rtol=1e-12)
            assert series.filled[1:].tolist() == [e.finding.holds is not None for e in mine]
            assert np.isnan(series.low[0])
    assert chart.panels[0].series[0].filled.all(), "the planted effect"
    (nees,) = (panel for panel in chart.panels if panel.title == "NEES, mean")
    assert nees.rules == (1.0,), "a ratio of one is no change"


def test_points_rise_along_the_axis_with_none_at_the_truth(tmp_path):
    grid = '"assumed.wheelbase" = [0.18, 0.2, 0.22]'

    def effect(case):
        return {
            "position_rmse_m": {0.18: 0.3, 0.2: 0.0, 0.22: 0.6}[case.values["assumed.wheelbase"]]
        }

    write_planted(tmp_path / "s", grid, effect=effect)
    (chart,) = effect_charts(select(read_study(tmp_path / "s"), "none"))
    (fused,) = chart.panels[0].series
    assert fused.x == pytest.approx([0.18, 0.2, 0.22], abs=1e-3)
    assert fused.y == pytest.approx([0.3, 0.0, 0.6], abs=0.03)
    assert np.isnan(fused.low).tolist() == [False, True, False]
    assert fused.filled.all()
    assert chart.caption.startswith("Difference to 0.2 in the same world")


def test_without_variables_strategies_and_filters_have_the_charts():
    study = replace(narrowed(invent(6), [5]), variables=())
    names = [chart.name for chart in effect_charts(select(study, "none"))]
    assert names == [
        "effect_strategy_ekf", "effect_strategy_fastslam",
        "effect_filter_active", "effect_filter_fused", "effect_filter_passive",
    ]  # fmt: skip
    chart = effect_charts(select(study, "none"))[0]
    assert chart.title == "What the strategy changes, EKF"
    assert [text for _, text in chart.panels[0].x.ticks] == ["active", "fused", "passive"]


def test_the_gain_is_charted_along_each_variable_a_line_for_each_combination_of_the_rest(tmp_path):
    grid = '"rays.exponent" = [1, 3]\n"beacon.level_db" = [36.8, 48.8]'
    write_planted(tmp_path / "s", grid, ways='filters = ["ekf"]\n')
    study = read_study(tmp_path / "s")
    selection = select(study, "none")
    by_power, by_level = gain_charts(selection)
    assert (by_power.name, by_level.name) == ("gain_by_rays_exponent", "gain_by_beacon_level_db")
    assert "a line for each value of the beacon level, that of beacon.level_db = 36.8" in (
        by_power.caption
    )
    active, fused = (study.trials["ekf", w].scores["position_rmse_m"] for w in ("active", "fused"))
    mean = (active - fused).mean(axis=0)
    overall, *each = by_power.panels[0].series
    for series, means in zip(each, (mean[::2], mean[1::2]), strict=True):
        np.testing.assert_allclose(series.y, means, rtol=1e-9)
    assert all(series.low is None for series in each), "bars of so many would hide each other"
    assert overall.y == pytest.approx([(mean[0] + mean[1]) / 2.0, (mean[2] + mean[3]) / 2.0])
    assert np.all((overall.low < overall.y) & (overall.y < overall.high))


def test_effects_of_a_single_world_and_of_none_have_no_intervals(tmp_path):
    write_planted(tmp_path / "s", worlds=1)
    study = read_study(tmp_path / "s")
    for failed in (False, True):
        study.trials["ekf", "fused"].failed[:] = failed
        (chart,) = effect_charts(select(study, "none"))
        assert all(np.isnan(series.low).all() for p in chart.panels for series in p.series)


def test_strategies_are_shifted_around_their_position():
    axis = axis_of_words(["a", "b"])
    at = np.array([0.0, 1.0])
    three = [beside(axis, at, way) for way in ("active", "passive", "fused")]
    assert three[0][0] < three[1][0] == 0.0 < three[2][0]
    assert beside(axis, at, "fused", ["fused"]).tolist() == at.tolist()
    pair = [beside(axis, at, way, ["fused", "passive"]) for way in ("passive", "fused")]
    assert pair[0][0] == pytest.approx(-pair[1][0])


def facets(tmp_path, grid, ways=PAIR):
    write_planted(tmp_path / "s", grid, worlds=1, ways=ways)
    study = read_study(tmp_path / "s")
    return study, [facets_of(study, v, axis_of(v)) for v in study.variables]


def test_few_combinations_of_the_rest_have_a_panel_each(tmp_path):
    grid = '"rays.exponent" = [1, 3]\n"beacon.level_db" = [36.8, 42.8, 48.8]'
    _, (power, level) = facets(tmp_path, grid)
    assert [title for title, _ in power[0]] == [
        f"beacon.level_db = {word}" for word in ("36.8", "42.8", "48.8")
    ]
    (_, first), (_, second) = level[0]
    assert [line.name for line in first] == ["active", "passive"]
    assert second[0].cells.tolist() == [3, 4, 5]
    assert (power[1], level[1]) == (False, False)


def test_many_become_lines_of_a_panel_per_filter_and_strategy_each_case_once(tmp_path):
    levels = ", ".join(str(30.0 + k) for k in range(MOST_PANELS + 1))
    grid = f'beamwidth = [180, 11]\n"beacon.level_db" = [{levels}]'
    _, (beam, level) = facets(tmp_path, grid)
    assert (beam[1], level[1]) == (True, False)
    assert [title for title, _ in beam[0]] == ["EKF, active", "EKF, passive"]
    assert [len(lines) for _, lines in beam[0]] == [MOST_PANELS + 1] * 2
    _, lines = beam[0][0]
    assert lines[0].name == "beacon.level_db = 30"
    strengths = [line.strength for line in lines]
    assert strengths[0] == 1.0
    assert (np.diff(strengths) < 0.0).all()
    assert [title for title, _ in level[0]] == ["11°", "180°"]


def test_passive_sensing_is_one_line_where_the_rest_is_the_beam(tmp_path):
    widths = ", ".join(str(20 * k) for k in range(1, MOST_PANELS + 2))
    grid = f'beamwidth = [{widths}]\n"beacon.level_db" = [36.8, 48.8]'
    _, (_, level) = facets(tmp_path, grid)
    assert [(title, len(lines)) for title, lines in level[0]] == [
        ("EKF, active", MOST_PANELS + 1), ("EKF, passive", 1),
    ]  # fmt: skip


def test_without_variables_the_filters_are_the_axis_with_shifted_strategies():
    study = replace(invent(2), variables=(), beamwidth=BEAMWIDTH[:1])
    ((_, lines),), _ = facets_of(study, None, axis_of_words(["EKF", "FastSLAM 2.0"]))
    assert [(line.way, line.x.tolist()) for line in lines][:3] == [
        (("ekf", "active"), [0.0]), (("fastslam", "active"), [1.0]), (("ekf", "fused"), [0.0]),
    ]  # fmt: skip
