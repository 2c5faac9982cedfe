"""Log odds of landmarks: what is heard, and what should have been."""

import numpy as np
import pytest

from pipistrelle.estimation.data_association.existence import (
    BINS,
    GONE,
    LEVEL_STD,
    MOST,
    PATIENCE,
    SECTORS,
    asked_of,
    judged,
    log_ratio,
    merged,
    nobody,
    probabilities,
    stated,
    with_new,
)

NONE = (*(np.empty(0, np.int64),) * 2, *(np.empty(0),) * 2)
AHEAD = np.array([0.0, 0.0, 0.0, 4.0, 0.0])
THERE = (AHEAD, np.array([3]), np.array([-2]), np.array([False]))
SEEN, UNSEEN = np.ones(1), np.full(1, 0.05)
RISE = log_ratio(0.0)


def row(label=1, level=40.0, surety=1.0):
    """Return one row of the vehicle's own call."""
    return np.array([label]), np.zeros(1, np.int64), np.array([level]), np.array([surety])


def heard_so_often(times, surety=1.0):
    known = with_new(nobody(1), [1], 0, 1)
    for scan in range(times):
        known = judged(known, row(surety=surety), THERE, SEEN, scan)
    return known


def test_the_ratio_is_of_the_likelihoods_of_a_miss_with_and_without_landmark():
    for m in (0.0, 0.3, 1.0):
        exists, absent = 0.1 + 0.9 * m, 1.0 - 0.1 * (1.0 - m)
        assert log_ratio(m) == pytest.approx(np.log(absent / exists))


@pytest.mark.parametrize(("surety", "scans"), [(1.0, 3), (0.5, 6)])
def test_odds_rise_with_certain_detections_until_confirmation(surety, scans):
    for times in range(1, scans + 1):
        known = heard_so_often(times, surety)
        assert known.odds[0] == pytest.approx(min(RISE * (surety * times - 1.0), MOST))
        assert bool(known.confirmed[0]) is (times == scans)
        assert known.count[0] == times


def test_odds_fall_with_misses_that_calls_could_detect_until_deletion():
    known = missed = heard_so_often(3)
    assert judged(known, NONE, THERE, SEEN, 3).odds[0] == known.odds[0]
    for scan in range(1, 6):
        missed = judged(missed, NONE, THERE, UNSEEN, 2 + scan)
        assert missed.odds[0] == pytest.approx(known.odds[0] - scan * log_ratio(UNSEEN[0]))
    assert missed.odds[0] < GONE


def learned(source, place, hits=9.0):
    """Return detection probabilities where 10 scans asked each call in each bin."""
    asked = np.full((source.shape[1], BINS), 10.0)
    return probabilities(np.full(asked.shape, hits), asked, source, place)


def test_detection_probabilities_are_learned_by_level_and_bearing():
    source = np.array([[60.0], [60.0], [20.0], [np.nan]])  # two-way at 4 m: 24 dB less
    mean = np.array([0.0, 0.0, 0.0, 4.0, 0.0, -4.0, 0.1, 4.0, 0.0, 4.0, 0.0])
    there = mean, np.array([3, 5, 7, 9]), np.array([-2]), np.array([False])
    p, bins = learned(source, there)
    np.testing.assert_allclose(p[:, 0], [9.0 / 11.0, 9.0 / 11.0, 0.0, 0.0])
    level = int((60.0 - 40.0 * np.log10(4.0)) / LEVEL_STD)
    assert bins[:, 0].tolist() == [SECTORS * level, SECTORS * level + SECTORS - 1, -1, -1]


def test_detection_probabilities_without_levels_are_learned_by_range():
    mean = np.array([0.0, 0.0, 0.0, 1.5, 0.0, 4.1, 0.0, 90.0, 0.0, 150.0, 0.0])
    there = mean, np.array([3, 5, 7, 9]), np.array([-2]), np.array([False])
    p, bins = learned(np.full((4, 1), np.nan), there)
    assert (p > 0.0).all()
    assert bins[:, 0].tolist() == [SECTORS, 4 * SECTORS, 12 * SECTORS, 14 * SECTORS]


@pytest.mark.parametrize(("moves", "detectable"), [(False, True), (True, False)])
def test_a_caller_that_has_moved_too_far_away_detects_no_landmark(moves, detectable):
    mean = np.array([0.0, 0.0, 0.0, 4.0, 0.0, 4.0, 100.0])
    there = mean, np.array([3]), np.array([-2, 5]), np.array([False, moves])
    p, _ = learned(np.array([[np.nan, 50.0]]), there)  # 12 dB less, and 40 via the landmark
    assert bool(p[0, 1] > 0.0) is detectable


def test_an_unconfirmed_landmark_is_deleted_after_a_long_silence():
    known, nowhere = heard_so_often(1), (AHEAD, np.array([-1]), *THERE[2:])
    for scan in range(1, PATIENCE + 2):
        known = judged(known, NONE, nowhere, SEEN, scan)
    assert known.odds[0] < GONE


def test_judging_does_not_change_its_inputs():
    known = heard_so_often(2)
    before = [column.copy() for column in known]
    judged(known, row(), THERE, SEEN, 2)
    for one, other in zip(known, before, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_stated_landmark_keeps_its_odds_in_silence():
    known = stated(with_new(nobody(1), [1], 0, 1), np.array([1]))
    for scan in range(2 * PATIENCE):
        known = judged(known, row() if scan < 2 else NONE, THERE, UNSEEN, scan)
    assert (known.odds[0], known.confirmed[0], known.count[0]) == (np.inf, True, 2)


def test_stated_landmarks_are_distinct_and_replace_their_duplicates():
    known = stated(with_new(nobody(1), [1, 2, 5, 6], 0, 1), np.array([5, 6]))
    known = known._replace(count=np.array([4, 7, 0, 0]), heard=np.ones(4, np.int64))
    old, apart, asked = asked_of(tuple(known), np.arange(3, 11, 2), 1)
    assert (known.label[old].tolist(), old[asked].tolist()) == ([5, 6, 1, 2], [0])
    assert np.argwhere(np.triu(apart, 1)).tolist() == [[0, 1]]
    after = merged(known, [(5, 1)])
    assert (after.label.tolist(), after.count.tolist()) == ([5, 2, 6], [4, 7, 0])
    assert np.isinf(after.odds).tolist() == [True, False, True]
