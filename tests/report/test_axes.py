"""Variables as axes, and the rest as panels or lines."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.report.axes import MOST_PANELS, axis_of, axis_of_words, beside, facets_of
from pipistrelle.report.study import read_study
from pipistrelle.report.variables import setting_variable
from report.invented import BEAMWIDTH, invent
from report.planted import write_planted

PAIR = 'strategies = ["active", "passive"]\nfilters = ["ekf"]\n'


def test_a_geometric_series_has_a_logarithmic_axis_and_other_numbers_do_not():
    particles = axis_of(setting_variable("fastslam.particles", [100, 300, 1000]))
    assert particles.log
    assert [text for _, text in particles.ticks] == ["100", "300", "1000"]
    level = axis_of(setting_variable("beacon.level_db", [36.8, 42.8, 48.8]))
    assert not level.log
    assert level.limits[0] < 36.8 < 48.8 < level.limits[1]
    assert level.named[1] == (42.8, "beacon.level_db = 42.8")


def test_beams_have_a_logarithmic_axis_in_degrees():
    (beam,) = invent(2).variables
    axis = axis_of(beam)
    assert (axis.log, axis.label, axis.words) == (True, "half-power beamwidth [°]", False)
    assert [text for _, text in axis.ticks][::11] == ["11", "180"]


def test_words_are_upright_or_slanted_and_long_words_are_shortened_in_the_middle():
    axis = axis_of(setting_variable("rays.weights", ["instantaneous", "aggregated"]))
    assert (axis.words, axis.log, axis.slanted) == (True, False, False)
    assert [text for _, text in axis.ticks] == ["instantaneous", "aggregated"]
    few = axis_of_words([f"measurement number {k}" for k in range(6)])
    assert (len(few.ticks[0][1]), few.slanted) == (8, False)
    many = axis_of_words([f"measurement number {k}" for k in range(8)])
    assert ({len(text) for _, text in many.ticks}, many.slanted) == ({12}, True)
    assert len({text for _, text in many.ticks}) == 8, "their ends tell them apart"
    assert many.named[3] == (3.0, "measurement number 3")


def test_ticks_that_would_run_into_each_other_are_left_out_and_read_out_still():
    axis = axis_of(setting_variable("rays.prune", [k * 1.25e-5 for k in range(1, 21)]))
    assert 2 <= len(axis.ticks) < 20
    assert axis.ticks[0][0] == 1.25e-5
    assert len(axis.named) == 20


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
    grid = '"rays.power" = [1, 3]\n"beacon.level_db" = [36.8, 42.8, 48.8]'
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
