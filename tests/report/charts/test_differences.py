"""Charts of paired differences: the effects as they are judged, from none at the first value on."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.report.charts.differences import effect_charts, gain_charts
from pipistrelle.report.claims.contrasts import select
from pipistrelle.report.effects.comparing import effects_of
from pipistrelle.report.effects.measures import measures_of
from pipistrelle.report.reading import read_study
from report.invented import invent, narrowed
from report.planted import by_level, write_planted

BOTH = 'strategies = ["fused", "passive"]\nfilters = ["ekf"]\n'


@pytest.fixture
def selection(tmp_path):
    write_planted(tmp_path / "s", ways=BOTH, effect=by_level(0.3))
    return select(read_study(tmp_path / "s"), "none")


def test_each_measure_has_a_panel_and_each_strategy_its_points(selection):
    (chart,) = effect_charts(selection)
    assert (chart.name, chart.title) == (
        "effect_beacon_level_db_ekf", "What beacon.level_db changes, EKF",
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
                if e.measure == measure and e.contrast.strategy == series.name
                and e.contrast.factor == "beacon.level_db"
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
    grid = '"rays.power" = [1, 3]\n"beacon.level_db" = [36.8, 48.8]'
    write_planted(tmp_path / "s", grid, ways='filters = ["ekf"]\n')
    study = read_study(tmp_path / "s")
    selection = select(study, "none")
    by_power, by_level = gain_charts(selection)
    assert (by_power.name, by_level.name) == ("gain_by_rays_power", "gain_by_beacon_level_db")
    assert "a line for each value of beacon.level_db, that of beacon.level_db = 36.8" in (
        by_power.caption
    )
    mean = [finding.mean for finding in selection.gains["ekf", "position_rmse_m"]]
    overall, *each = by_power.panels[0].series
    assert [series.y.tolist() for series in each] == [[mean[0], mean[2]], [mean[1], mean[3]]]
    assert all(series.low is None for series in each), "bars of so many would hide each other"
    assert overall.y == pytest.approx([(mean[0] + mean[1]) / 2.0, (mean[2] + mean[3]) / 2.0])
    assert np.all((overall.low < overall.y) & (overall.y < overall.high))
    active, fused = (study.trials["ekf", w].scores["position_rmse_m"] for w in ("active", "fused"))
    np.testing.assert_allclose(mean, (active - fused).mean(axis=0), rtol=1e-9)


def test_charts_can_be_had_of_a_single_world_and_of_none(tmp_path):
    write_planted(tmp_path / "s", worlds=1)
    study = read_study(tmp_path / "s")
    for failed in (False, True):
        study.trials["ekf", "fused"].failed[:] = failed
        (chart,) = effect_charts(select(study, "none"))
        assert all(np.isnan(series.low).all() for p in chart.panels for series in p.series)
