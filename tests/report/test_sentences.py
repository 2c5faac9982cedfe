"""The paper's sentences: which change of a study refutes each, and by which yardstick."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.report.page import answered, summary
from pipistrelle.report.sentences import (
    SENTENCES,
    Comparison,
    Most,
    Sentence,
    _judged,
    _statistic,
    judge_sentences,
)
from pipistrelle.report.study import COMMON, HEADING, POSITION, select
from report.invented import BEAMWIDTH, changed, invent, only

NARROW = BEAMWIDTH < 41.0
OCTAVE = np.log2(BEAMWIDTH / 180.0)
YARDSTICKS = ("by_means", "by_bands", "by_intervals")


@pytest.fixture(scope="module")
def study():
    return invent(115)


def rows(study):
    return {row["sentence"]: row for row in judge_sentences(select(study, "world"))}


@pytest.fixture(scope="module")
def right(study):
    """Rows of the study in which the paper is right."""
    return rows(study)


def row(study, number):
    return _judged(SENTENCES[number - 1], select(study, "world"))


def spread(study, way, score, factor):
    """Multiply the deviations of a score from its mean over the worlds."""
    return changed(study, way, score, lambda s: s.mean(axis=0) + factor * (s - s.mean(axis=0)))


def losing(study, name, count):
    """Let a filter diverge in so many worlds."""
    way = (name, "active")
    diverged = study.trials[way].diverged | (np.arange(len(study.worlds)) < count)[:, np.newaxis]
    trials = replace(study.trials[way], diverged=diverged)
    return replace(study, trials=study.trials | {way: trials})


def with_nees(study, way, factor):
    trials = study.trials[way]
    return replace(study, trials=study.trials | {way: replace(trials, nees=trials.nees * factor)})


def test_there_are_26_sentences_and_each_of_the_eight_claims_has_some():
    assert [sentence.number for sentence in SENTENCES] == list(range(1, 27))
    assert {sentence.claim for sentence in SENTENCES} == set(range(1, 9))


@pytest.mark.parametrize(
    ("number", "way", "score", "change"),
    [
        (8, ("ekf", "passive"), POSITION, lambda error: error - 9.0),
        (10, ("ekf", "fused"), POSITION, lambda error: error + 9.0),
        (11, ("ekf", "fused"), POSITION, lambda error: error - 2.0 * OCTAVE),
        (12, ("ekf", "fused"), POSITION, lambda error: error + 2.0 * NARROW),
        (12, ("ekf", "fused"), POSITION, lambda error: error - 2.0 * ~NARROW),
        (13, ("fastslam", "fused"), POSITION, lambda error: error - 2.0),
        (14, ("ekf", "fused"), COMMON, lambda error: error - 2.0),
        (15, ("ekf", "passive"), COMMON, lambda error: error - 2.0),
        (16, ("ekf", "fused"), "landmarks_full", lambda count: count + 9.0),
        (18, ("ekf", "active"), "landmarks_full", lambda count: count - 9.0 * OCTAVE),
        (19, ("ekf", "passive"), "landmarks_full", lambda count: count - 20.0),
        (21, ("ekf", "active"), "landmarks_total", lambda count: count + 25.0),
        (22, ("ekf", "fused"), "landmarks_full", lambda count: count - 9.0 * OCTAVE),
        (24, ("ekf", "fused"), HEADING, lambda error: error + 2.0),
        (25, ("ekf", "fused"), HEADING, lambda error: error + 2.0),
    ],
)
def test_a_large_change_of_the_means_refutes_a_sentence_by_every_yardstick(
    study, number, way, score, change
):
    refuted = row(changed(study, way, score, change), number)
    assert [refuted[name] for name in YARDSTICKS] == [False, False, False]
    assert refuted["refuted"]


@pytest.mark.parametrize("number", [8, 11, 16, 18, 21, 22, 25])
def test_where_the_paper_is_right_a_sentence_holds_by_every_yardstick(right, number):
    assert [right[number][name] for name in YARDSTICKS] == [True, True, True]


def test_a_difference_within_the_bands_fails_by_means_but_not_by_bands(study):
    worse = changed(study, ("fastslam", "fused"), POSITION, lambda error: error - 0.12)
    within = row(worse, 13)
    assert (within["by_means"], within["by_bands"]) == (False, True)


@pytest.mark.parametrize(
    ("number", "way", "score", "factor"),
    [
        (9, ("ekf", "passive"), POSITION, 9.0),
        (17, ("ekf", "passive"), "landmarks_total", 1.5),
        (20, ("ekf", "active"), "landmarks_full", 9.0),
    ],
)
def test_sentences_on_sigma_are_judged_by_the_spread_over_worlds(
    study, right, number, way, score, factor
):
    after, same = (row(spread(study, way, score, by), number) for by in (factor, 1.0))
    assert right[number]["means"] != after["means"]
    assert right[number]["means"] == same["means"]


def test_the_spread_of_landmarks_grows_to_narrow_beams_where_a_study_has_it_so(study):
    for score in ("landmarks_full", "landmarks_total"):
        for name in ("ekf", "fastslam"):
            study = spread(study, (name, "fused"), score, 1.0 - 0.4 * OCTAVE)
    growing = row(study, 23)
    assert [growing[name] for name in YARDSTICKS] == [True, True, True]


@pytest.mark.parametrize(("count", "holds"), [(8, True), (11, True), (40, False), (0, False)])
def test_lost_worlds_are_compared_by_the_binomial_error_of_both(study, count, holds):
    assert row(losing(study, "ekf", count), 1)["by_means"] is holds


@pytest.mark.parametrize(
    ("number", "way", "factor"),
    [(3, ("ekf", "active"), 99.0), (5, ("ekf", "active"), 9.0), (7, ("fastslam", "active"), 9.0)],
)
def test_consistency_is_judged_by_the_nees(study, number, way, factor):
    assert row(with_nees(study, way, factor), number)["by_means"] is False
    assert row(with_nees(study, ("fastslam", "fused"), 3.0), 7)["by_means"] is True


def test_nees_that_grows_to_narrow_beams_refutes_the_sentence_on_fused_sensing(study):
    growing = (1.0 - OCTAVE)[np.newaxis, :, np.newaxis]
    refuted = row(with_nees(study, ("ekf", "fused"), growing), 6)
    assert (refuted["by_means"], refuted["by_intervals"]) == (False, False)


def test_a_statistic_of_means_and_deviations_is_jackknifed():
    worlds = np.random.default_rng(3).normal([1.0, 5.0], [2.0, 0.5], (400, 2))
    ratio = _statistic(worlds, lambda mean, std: std[:, 0] / mean[:, 1])
    assert ratio.mean() == pytest.approx(worlds[:, 0].std() / worlds[:, 1].mean(), rel=0.01)
    halves = np.std([_statistic(half, lambda _, std: std[:, 0]).mean()
                     for half in np.split(worlds, 20)], ddof=1)  # fmt: skip
    error = _statistic(worlds, lambda _, std: std[:, 0]).std(ddof=1) / 20.0
    assert error == pytest.approx(halves / np.sqrt(20.0), rel=0.5)


def test_most_needs_more_than_half_and_a_part_without_cases_leaves_a_sentence_undecided(study):
    def beams(_):
        return [Comparison(f"{i}", np.array([sign, sign + 0.1])) for i, sign in enumerate(signs)]

    signs = (1.0, 1.0, -1.0)
    selection = select(study, "world")
    for part, verdict in ((Most(beams), True), (beams, False), (lambda _: [], None)):
        judged = _judged(Sentence(1, 1, "V", "", (part,)), selection)
        assert judged["by_means"] is verdict


def test_a_study_without_one_filter_leaves_its_sentences_without_comparisons(study):
    ekf = rows(only(study, [way for way in study.trials if way[0] == "ekf"]))
    assert ekf[13]["comparisons"] == 0
    assert ekf[13]["by_means"] is None
    assert ekf[25]["by_means"] is True


@pytest.mark.parametrize("worlds", [1, 2, 3])
def test_a_study_that_has_hardly_begun_can_be_judged(worlds):
    assert len(rows(invent(worlds))) == 26


def test_the_summary_of_the_papers_study_has_the_sentences(study):
    few = invent(3)
    assert len(summary(answered(few))["sentences"]) == 26
    lonely = only(few, [way for way in few.trials if way[0] == "ekf"])
    assert summary(answered(lonely))["sentences"] == []
