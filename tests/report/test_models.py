from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, ScenarioConfig
from pipistrelle.experiments.hearing.scenario import draw_scenario, world_of
from pipistrelle.report.models import model_charts
from report.invented import BEAMWIDTH, invent


@pytest.fixture(scope="module")
def charts():
    return {chart.name: chart for chart in model_charts(invent(2))}


def test_a_beam_has_half_its_power_at_half_its_width(charts):
    series = charts["piston"].panels[0].series
    dots = {s.name: s for s in series if s.style == "marks"}
    assert len(dots) == len(BEAMWIDTH)
    for name, width in (("33°", BEAMWIDTH[5]), ("11°", BEAMWIDTH[0])):
        dot = dots[name]
        assert np.hypot(dot.x, dot.y) ** 2 == pytest.approx(0.5, rel=1e-9)
        assert np.degrees(np.arctan2(dot.x, dot.y)) == pytest.approx(width / 2, rel=1e-9)
    assert "radius: 8.8 mm" in dots["33°"].tips[0]


def test_the_narrower_beam_is_the_stronger_line(charts):
    lines = [s for s in charts["piston"].panels[0].series if s.listed]
    assert [line.name for line in lines][:1] == ["180°"]
    assert np.all(np.diff([line.strength for line in lines]) > 0)


def test_the_map_is_the_world_that_the_study_heard(charts):
    study = invent(2)
    rng = np.random.default_rng(stream_key(study.config.seed, 0, "scenario"))
    world = draw_scenario(study.config, rng)
    series = {s.name: s for s in charts["example_map"].panels[0].series}
    np.testing.assert_array_equal(series["landmark"].x, world.landmarks[:, 0])
    np.testing.assert_array_equal(series["true path"].y, world.path[:, 1])
    assert (series["beacon"].x[0], series["beacon"].y[0]) == tuple(world.callers[1].place)
    assert len(series["landmark"].tips) == 50


def test_a_world_that_cannot_be_drawn_is_left_out():
    crowded = replace(invent(2), example=None)
    assert [chart.name for chart in model_charts(crowded)] == ["piston"]


def test_a_world_without_a_disc_is_shown_whole_and_without_its_circle():
    setup = ScenarioConfig(course="corridor", field="rooms", extent=40.0)
    config = Config(scenario=setup)
    study = replace(invent(2), configs=(config,) * len(BEAMWIDTH), example=world_of(config))
    chart = {chart.name: chart for chart in model_charts(study)}["example_map"]
    (panel,) = chart.panels
    assert "circle" not in chart.caption
    assert "edge" not in [series.name for series in panel.series]
    for series in panel.series:
        for values, axis in ((series.x, panel.x), (series.y, panel.y)):
            assert axis.limits[0] < np.min(values) <= np.max(values) < axis.limits[1]
