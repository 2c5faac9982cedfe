"""The paper's sentences: for each a study in which it holds, and one in which it does not."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.evaluation.comparison import pooled_std
from pipistrelle.report import sentences as paper
from pipistrelle.report.claims import _judged
from pipistrelle.report.sentences import SEEN, SENTENCES, TABLE_II, cell_of, lap_fit, larger
from pipistrelle.report.study import COMMON, HEADING, LANDMARKS, NEES, POSITION, select
from pipistrelle.report.variables import BEAMWIDTHS, beam_name, setting_variable
from report import invented
from report.invented import (
    BEAMWIDTH,
    FILTERS,
    add,
    changed,
    diverging,
    invent,
    losing,
    nees,
    only,
    spread,
)

NARROW = BEAMWIDTH < 41.0
OCTAVE = np.log2(BEAMWIDTH / 180.0)
YARDSTICKS = ("by_means", "by_bands", "by_intervals")


@pytest.fixture(scope="module")
def study():
    return invent(115)


@pytest.fixture(scope="module")
def small():
    return invent(8)


def row(study, number):
    return _judged(SENTENCES[number - 1], select(study, "world"))


def made(study, *makers, rule="none"):
    return [one for make in makers for one in make(select(study, rule))]


EKF, FAST = ("ekf",), ("fastslam",)
PRINTED = np.interp(BEAMWIDTH, [11.4, 33.2, 180.0], [1.58, 1.58, 1.25])
HOLDS = {
    1: [losing("ekf", 8)],
    2: [losing("fastslam", 15)],
    5: [nees("ekf", "passive", 3.0)],
    6: [nees("ekf", "fused", (2.0 + 0.25 * OCTAVE)[:, np.newaxis])],
    7: [nees("fastslam", "fused", 3.0)],
    9: [spread(POSITION, "passive", 9.0), spread(POSITION, "fused", 3.0)],
    10: [spread(POSITION, strategy, 3.0, FAST) for strategy in invented.STRATEGIES],
    12: [add(POSITION, "fused", np.where(NARROW, -0.02, 0.03), EKF)],
    13: [add(POSITION, "fused", -0.05, FAST)],
    14: [add(COMMON, "fused", 0.03)],
    15: [add(COMMON, "fused", -0.02 * (OCTAVE + 4.0))],
    17: [spread(SEEN, "fused", PRINTED), spread(SEEN, "passive", 1.67)],
    19: [add(LANDMARKS, "passive", 20.0, EKF)],
    20: [spread(LANDMARKS, "passive", 9.0, FAST)],
    21: [add(SEEN, "active", 0.4)],
    23: [spread(score, "fused", 1.0 - 0.4 * OCTAVE) for score in (LANDMARKS, SEEN)],
    24: [add(HEADING, strategy, 0.02, FAST) for strategy in invented.STRATEGIES],
    26: [add(COMMON, "fused", 0.05 * (OCTAVE + 4.0), EKF)],
}
"""By sentence, a change of the invented study that makes it hold; it holds the others."""
FAILS = [
    (1, losing("ekf", 60)),
    (2, losing("fastslam", 60)),
    (3, nees("fastslam", "active", 0.01)),
    (4, nees("ekf", "active", step=-1)),
    (5, nees("ekf", "active", 9.0)),
    (6, nees("ekf", "fused", (1.0 - OCTAVE)[:, np.newaxis])),
    (7, nees("fastslam", "active", 9.0)),
    (8, add(POSITION, "passive", -9.0, EKF)),
    (9, spread(POSITION, "passive", 0.1, EKF)),
    (10, add(POSITION, "fused", 9.0, EKF)),
    (10, spread(POSITION, "active", 9.0, EKF)),
    (11, add(POSITION, "fused", -2.0 * OCTAVE, EKF)),
    (12, add(POSITION, "fused", 2.0 * NARROW, EKF)),
    (12, add(POSITION, "fused", -2.0 * ~NARROW, EKF)),
    (12, add(POSITION, "fused", -2.0 * NARROW, EKF)),
    (13, add(POSITION, "fused", -2.0, FAST)),
    (13, add(POSITION, "fused", 2.0, FAST)),
    (14, add(COMMON, "fused", -2.0, EKF)),
    (15, add(COMMON, "passive", -2.0, EKF)),
    (16, add(LANDMARKS, "fused", 9.0, EKF)),
    (17, spread(SEEN, "passive", 3.0, EKF)),
    (18, add(LANDMARKS, "active", -9.0 * OCTAVE, EKF)),
    (19, add(LANDMARKS, "passive", -20.0, EKF)),
    (20, spread(LANDMARKS, "active", 9.0, EKF)),
    (21, add(SEEN, "active", 25.0, EKF)),
    (22, add(LANDMARKS, "fused", -9.0 * OCTAVE, EKF)),
    (23, spread(SEEN, "fused", 3.0 + 0.5 * OCTAVE)),
    (24, add(HEADING, "fused", 2.0, EKF)),
    (25, add(HEADING, "fused", 2.0, EKF)),
    (26, add(COMMON, "fused", -0.2 * OCTAVE, EKF)),
]
"""A sentence and a change that contradicts it by every yardstick."""


def test_there_are_26_sentences_and_each_of_the_eight_claims_has_some():
    assert [sentence.number for sentence in SENTENCES] == list(range(1, 27))
    claims = {sentence.claim for sentence in SENTENCES} - {None}
    assert claims == set(paper.CLAIMS) == set(range(1, 9))
    assert {number for number, _ in FAILS} == set(range(1, 27))


@pytest.mark.parametrize("number", range(1, 27))
def test_where_the_paper_is_right_a_sentence_holds_by_every_yardstick(study, number):
    right = row(invented.with_all(study, HOLDS.get(number, [])), number)
    counts = number in (1, 2)  # a count of 115 worlds is known too badly
    assert [right[name] for name in YARDSTICKS] == [True, True, None if counts else True]
    assert right["refuted"] == 0


@pytest.mark.parametrize(("number", "plant"), FAILS)
def test_a_large_change_refutes_a_sentence_by_every_yardstick(study, number, plant):
    wrong = row(plant(study), number)
    assert [wrong[name] for name in YARDSTICKS] == [False, False, False]
    assert wrong["refuted"]


def test_a_difference_within_the_bands_fails_by_means_but_not_by_bands(study):
    within = row(add(POSITION, "fused", -0.12, FAST)(study), 13)
    assert (within["by_means"], within["by_bands"]) == (False, True)


@pytest.mark.parametrize(("count", "holds"), [(8, True), (11, True), (40, False), (0, False)])
def test_lost_worlds_are_compared_by_the_binomial_error_of_both(study, count, holds):
    assert row(losing("ekf", count)(study), 1)["by_means"] is holds


def test_sentences_make_a_comparison_for_every_case_the_paper_speaks_of(study):
    beams, narrow = len(BEAMWIDTH), int(NARROW.sum())
    for number, counts in {
        4: [12],
        8: [4 * beams],
        10: [2 * beams + 1] * 2,
        12: [narrow, beams - narrow, beams],
        14: [2 * beams] * 2,
        16: [2 * len(TABLE_II)],
        21: [2 * beams, 2 * np.sum(BEAMWIDTH < 64.0), 2 * np.sum(BEAMWIDTH > 64.0)],
    }.items():
        parts = Counter(finding["part"] for finding in row(study, number)["findings"])
        assert [parts[i] for i in sorted(parts)] == counts


def test_fitted_numbers_are_marked(study):
    table, seen = (
        [one["label"] for one in row(study, number)["findings"] if one["fitted"]]
        for number in (16, 21)
    )
    assert [label for label in table if "full" in label] == ["EKF, passive (0°): full − 26.6"]
    assert len(table) == 5
    assert seen == [f"{title} passive − {title} active, 180°" for title in ("EKF", "FastSLAM 2.0")]


def test_a_comparison_has_the_papers_error_over_the_worlds_of_the_filter(study):
    """107 worlds with EKF-SLAM, 100 with FastSLAM 2.0, and in Table II the paper's own σ."""
    gains = [((name, "active"), (name, "fused")) for name in FILTERS]
    other = (("fastslam", "active"), ("ekf", "active"))
    for pair, worlds in ((gains[0], 107), (gains[1], 100), (other, 100)):
        for one in made(study, larger(HEADING, pair)):
            assert one.papers_error == pytest.approx(np.std(one.sample, ddof=1) / np.sqrt(worlds))
            assert one.unit == "rad"
    counts = {one["label"]: one for one in row(study, 16)["findings"]}
    printed = counts["EKF, 180°: full − 37.7"]
    assert printed["papers_error"] == pytest.approx(2.9 / np.sqrt(107))
    assert row(study, 1)["findings"][0]["papers_error"] == pytest.approx(np.sqrt(8 * 107 / 115))
    assert {one["unit"] for one in row(study, 15)["findings"]} == {"m", "m per doubling"}


def test_differences_are_paired_and_named(small):
    pair = ("ekf", "active"), ("ekf", "fused")
    found = made(small, larger(POSITION, pair, sigmas=1.0, below=41.0))
    beams = (11, 14, 18, 22, 27, 33)
    assert [one.label for one in found] == [f"EKF active − EKF fused, {beam}°" for beam in beams]
    scores = [small.trials[way].scores[POSITION][:, 2] for way in pair]
    np.testing.assert_array_equal(found[2].sample, scores[0] - scores[1])
    assert found[2].least == pytest.approx(pooled_std(*scores), rel=1e-12)
    assert found[2].band == pytest.approx(sum(np.std(one, ddof=1) for one in scores))
    blind = ("fastslam", "passive"), ("ekf", "passive")
    (single,) = made(small, larger(NEES, blind))
    assert single.label == "FastSLAM 2.0 passive − EKF passive"
    assert made(small, larger(NEES, (("ekf", "deaf"), pair[0]))) == []


def test_a_statistic_of_means_and_deviations_is_jackknifed():
    worlds = np.random.default_rng(3).normal([1.0, 5.0], [2.0, 0.5], (400, 2))
    ratio = paper.jackknifed(worlds, lambda mean, std: std[:, 0] / mean[:, 1])
    assert ratio.mean() == pytest.approx(worlds[:, 0].std() / worlds[:, 1].mean(), rel=0.01)
    halves = np.std([paper.jackknifed(half, lambda _, std: std[:, 0]).mean()
                     for half in np.split(worlds, 20)], ddof=1)  # fmt: skip
    error = paper.jackknifed(worlds, lambda _, std: std[:, 0]).std(ddof=1) / 20.0
    assert error == pytest.approx(halves / np.sqrt(20.0), rel=0.5)


def test_a_trend_is_the_slope_over_octaves(small):
    passive = small.trials["ekf", "passive"].scores[POSITION]
    gap, ways = 0.25 * np.log2(BEAMWIDTH / 5.0), (("ekf", "fused"), ("ekf", "passive"))
    make = paper.trend(POSITION, "", ways, curve=lambda mean, _: np.abs(mean[:, 0] - mean[:, 1]))
    for sign in (1.0, -1.0):
        leaving = changed(small, ("ekf", "fused"), POSITION, lambda _, s=sign: passive + s * gap)
        (one,) = made(leaving, make)
        assert one.sample == pytest.approx(np.full(8, 0.25), rel=1e-9)
        assert one.unit == "m per doubling"


def test_straight_drives_and_less_than_two_laps_have_no_lap_fit(small):
    assert lap_fit(invented.turning(small, steering=0.0)) is None
    assert lap_fit(invented.turning(small, step=0.125 * 2 * 62.06 / 187.6)) is None
    assert lap_fit(invented.turning(small, step=0.125 * 2 * 62.06 / 187.4)) is not None


def test_rise_and_swing_are_read_off_a_curve(small):
    rise, swing = lap_fit(small)
    tau = paper.frame_time(small, invented.FRAMES) / paper.lap_time(small)
    turn = 2 * np.pi * tau
    curve = 3.0 + 0.7 * tau + 2.5 * (1 - np.cos(turn)) / 2 - 0.4 * np.sin(turn)
    assert (curve @ rise, curve @ swing) == pytest.approx((0.7, 2.5), rel=1e-9)
    assert (3.0 + 5.0 * tau) @ swing == pytest.approx(0.0, abs=1e-9)
    assert np.ones(invented.FRAMES) @ rise == pytest.approx(0.0, abs=1e-9)


def test_noise_swings_as_often_down_as_up(small):
    """White noise of unit variance: the swing's variance is the weights' sum of squares."""
    _, swing = lap_fit(small)
    found = np.random.default_rng(6).normal(size=(4000, invented.FRAMES)) @ swing
    error = np.sqrt(swing @ swing)
    assert abs(found.mean()) < 4.0 * error / np.sqrt(4000)
    assert found.std() == pytest.approx(error, rel=4.0 / np.sqrt(2 * 4000))


def test_the_departure_is_computed_from_the_mean_over_worlds():
    """Half the worlds at 1 and half at 5 make an ANEES of 3: no departure, to order 1/n."""
    nees = np.repeat([1.0, 5.0], 200)[:, None, None] * np.ones((400, 1, 6))
    values = paper.departure(nees, np.full((1, 6), 3.0))
    assert abs(values.mean()) < 1 / 400
    single = np.square(np.log(nees / 3.0)).mean()
    assert single > 0.5, "the control: averaging over worlds last would see one"


def test_curves_are_of_the_worlds_that_count_and_have_all_numbers(small):
    trials = small.trials["ekf", "fused"]
    spoilt = diverging(trials, 3, 5)
    spoilt.nees[2, 4, 100] = np.nan
    spoilt = {("ekf", "fused"): spoilt}
    study = replace(small, trials=small.trials | spoilt)
    for rule, fused, active in (("world", [2, 3], [3]), ("case", [2, 3], []), ("none", [2], [])):
        for strategy, left_out in (("fused", fused), ("active", active)):
            whole = study.trials["ekf", strategy].nees
            (found,) = paper.curves(select(study, rule), [("ekf", strategy)])
            np.testing.assert_array_equal(found, np.delete(whole, left_out, axis=0))
    assert paper.curves(select(small, "none"), [("ekf", "unheard")]) is None


def test_the_beams_of_the_papers_radii_have_the_papers_names_and_thresholds():
    assert [beam_name(width) for width in BEAMWIDTH] == [f"{width:.0f}°" for width in BEAMWIDTHS]
    assert [beam_name(width) for width in (12.5, 20.0, 90.0)] == ["12°", "20°", "90°"]
    assert beam_name(BEAMWIDTH[BEAMWIDTH < paper.CROSSING][-1]) == "33°"
    assert beam_name(BEAMWIDTH[BEAMWIDTH < paper.NARROW][-1]) == "51°"


def test_every_row_of_table_ii_has_its_case_if_the_study_has_it(small):
    found = [cell_of(small, row) for row in TABLE_II]
    assert [cell[2] for cell in found] == [11, 5, 0, 0] * 2
    assert [cell[1] for cell in found] == ["fused", "fused", "fused", "passive"] * 2
    assert [paper.row_name(row) for row in TABLE_II[:4]] == ["180°", "33°", "11°", "passive (0°)"]
    fused = only(small, [("ekf", "fused")])
    assert [cell_of(fused, row) is None for row in TABLE_II] == [False] * 3 + [True] * 5
    for row in TABLE_II:
        assert row.total[0] > row.full[0]
        assert np.all(np.array([*row.full, *row.total]) > 0)


def test_a_study_holds_the_papers_cases_with_all_of_them_and_no_other_variable(small):
    assert paper.papers_cases(small)
    assert paper.papers_cases(invented.with_third(small, "toy:Slam")), "another filter beside them"
    for way in small.trials:
        assert not paper.papers_cases(
            only(small, [other for other in small.trials if other != way])
        )
    assert not paper.papers_cases(invented.narrowed(small, range(1, 12))), "eleven of its beams"
    level = setting_variable("beacon.level_db", [36.8, 48.8])
    assert not paper.papers_cases(replace(small, variables=(*small.variables, level)))
    assert not paper.papers_cases(replace(small, variables=()))
