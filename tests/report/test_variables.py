"""What varies: in which order, under which names, on which axis."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.report.variables import (
    amount,
    axis_of,
    axis_of_words,
    beam_name,
    beam_variable,
    geometric,
    interval,
    listed,
    number_word,
    places,
    setting_variable,
    three_digits,
    two_sided,
    width_name,
    word_of,
    written,
)
from report.invented import invent


def test_numbers_rise_and_are_their_positions():
    level = setting_variable("beacon.level_db", [48.8, 36.8, 42.8])
    assert level.given == (36.8, 42.8, 48.8)
    assert places(level).tolist() == [36.8, 42.8, 48.8]
    assert level.label == "beacon.level_db [dB]"
    assert level.meaning.startswith("Source level at 1 m of the beacon")


@pytest.mark.parametrize(
    ("setting", "values", "words"),
    [
        ("rays.weights", ["instantaneous", "aggregated"], ("instantaneous", "aggregated")),
        ("rays.range_bounds", [[2.0, 40.0], [0.5, 20.0]], ("[2, 40]", "[0.5, 20]")),
        ("made.up", [True, False], ("true", "false")),
        ("made.up", [3, "auto"], ("3", "auto")),
    ],
)
def test_words_keep_their_order_and_are_counted_along_the_axis(setting, values, words):
    variable = setting_variable(setting, values)
    assert (variable.words, variable.numbers) == (words, None)
    assert places(variable).tolist() == [0.0, 1.0]
    assert variable.label == setting, "words have no unit"
    assert [word_of(variable, value) for value in values] == list(words)


def test_a_unit_is_read_from_the_setting_and_a_range_is_none():
    assert setting_variable("scenario.speed", [1, 2]).label == "scenario.speed [m/s]"
    assert setting_variable("air.relative_humidity", [0.1, 0.2]).label == "air.relative_humidity"
    assert setting_variable("scenario.steps", [100, 200]).label == "scenario.steps"
    assert (
        setting_variable("filter.range_std", [0.1, 0.2]).meaning
        == "Standard deviation of a range [m]."
    )


@given(st.lists(st.floats(1e-12, 1e12), min_size=2, max_size=9, unique=True))
def test_values_are_written_so_that_they_differ(values):
    words = written(values)
    assert len(set(words)) == len(values)
    assert [float(word) for word in words] == pytest.approx(values, rel=1e-5)


def test_beams_are_named_in_distinct_degrees_narrowest_first():
    beams = beam_variable("emitter.radius", [0.0025, 0.007, 0.025], [180.0, 42.5, 11.575])
    assert beams.words == ("11°", "42.5°", "180°")
    assert beams.given == (0.025, 0.007, 0.0025)
    close = beam_variable("emitter.radius", [0.025, 0.0249], [11.35, 11.55])
    assert close.words == ("11.35°", "11.55°")


@given(st.floats(1e-6, 1e6), st.floats(1.3, 10.0), st.integers(3, 8))
def test_a_geometric_series_is_recognised_and_an_arithmetic_series_is_not(first, ratio, count):
    assert geometric(first * ratio ** np.arange(count))
    assert not geometric(first * (1.0 + (ratio - 1.0) * np.arange(count)))


@pytest.mark.parametrize("numbers", [[-1.0, 0.1, 1.0], [0.0, 1.0, 10.0], [1.0, 100.0]])
def test_numbers_without_logarithms_and_pairs_are_no_geometric_row(numbers):
    assert not geometric(numbers)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([1.0, 2.5], "1; 2.5"),
        ([1.0, 1.0000001], "1.0; 1.0000001"),
        ([True, "paper", [0.5, 20.0]], "true; paper; [0.5, 20]"),
        ([[], [{}], [{"course": "walk"}], [{}, {"frequency": 25e3}]], "nobody; beacon; walk; 2"),
        (
            [[{}], [{}, {"frequency": 25e3}], [{}, {"frequency": 25e3, "course": "circle"}]],
            "beacon; beacon, caller2; beacon, caller2 (circle)",
        ),
    ],
)
def test_words_are_as_short_as_they_can_be(values, words):
    assert "; ".join(written(values)) == words


def test_numbers_are_written_for_readers():
    assert [width_name(width) for width in (11.5, 11.575, 42.123)] == ["11.5°", "11°", "42.1°"]
    assert [beam_name(width) for width in (11.575, 12.5)] == ["11°", "12°"]
    digits = [three_digits(value) for value in (0.12345, 43.71, -1234.5, np.inf)]
    assert digits == ["0.123", "43.7", "−1234", "∞"]
    assert (amount(0.34, "m"), amount(0.02, "rad")) == ("0.34 m", "1.15°")
    assert (amount(3.0, "landmarks"), interval((0.21, 0.47), "m")) == ("3", "[0.21, 0.47]")
    assert [number_word(count) for count in (0, 8, 30)] == ["none", "eight", "30"]
    assert listed(["EKF"]) == "EKF"
    assert listed(["active", "fused", "passive"]) == "active, fused and passive"


def test_a_variable_is_two_sided_around_an_inner_reference():
    sound = setting_variable("assumed.speed_of_sound", [337.0, 343.0, 349.0])
    sides = [two_sided(replace(sound, base=base)) for base in range(3)]
    assert sides == [False, True, False]


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
    axis = axis_of(setting_variable("rays.prune_threshold", [k * 1.25e-5 for k in range(1, 21)]))
    assert 2 <= len(axis.ticks) < 20
    assert axis.ticks[0][0] == 1.25e-5
    assert len(axis.named) == 20
