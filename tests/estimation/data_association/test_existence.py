"""Log odds of landmarks: what is heard, and what should have been."""

import numpy as np
import pytest

from pipistrelle.estimation.data_association.existence import (
    CONFIRMED,
    GONE,
    HEARD,
    HIDDEN,
    MISSED,
    PATIENCE,
    judged,
    nobody,
    with_new,
)

NONE = (*(np.empty(0, np.int64),) * 2, *(np.empty(0),) * 4)
AHEAD = np.array([0.0, 0.0, 0.0, 4.0, 0.0])
THERE = (AHEAD, np.array([3]), np.array([-2]), np.array([False]))


def row(label=1, way=4.0, level=40.0, bearing=0.0, surety=1.0):
    """Return one row of the vehicle's own call."""
    numbers = (np.array([number]) for number in (way, level, bearing, surety))
    return np.array([label]), np.zeros(1, np.int64), *numbers


def heard_so_often(times, surety=1.0):
    known = with_new(nobody(1), [1], 0, 1)
    for scan in range(times):
        known = judged(known, row(surety=surety), THERE, np.array([False]), scan)
    return known


def test_odds_rise_with_each_scan_and_confirm_at_the_third():
    for times, confirmed in ((1, False), (2, False), (3, True)):
        known = heard_so_often(times)
        assert known.odds[0] == min(HEARD * (times - 1), 8.0)
        assert bool(known.confirmed[0]) is confirmed
        assert known.count[0] == times
    assert HEARD * 2 >= CONFIRMED


def test_less_certain_detections_take_more_scans_to_confirm():
    for times, confirmed in ((3, False), (4, False), (5, True)):
        known = heard_so_often(times, surety=0.5)
        assert known.odds[0] == pytest.approx(0.5 * HEARD * times - HEARD)
        assert bool(known.confirmed[0]) is confirmed


def test_a_landmark_missed_repeatedly_is_deleted():
    known = heard_so_often(3)
    missed = judged(known, NONE, THERE, np.array([False]), 3)
    assert missed.odds[0] == pytest.approx(known.odds[0] - MISSED)
    scan = 4
    while missed.odds[0] >= GONE:
        missed, scan = judged(missed, NONE, THERE, np.array([False]), scan), scan + 1
    assert scan < 12


@pytest.mark.parametrize(
    ("why", "rows", "there"),
    [
        ("too far to be loud", NONE, (np.array([0, 0, 0, 20.0, 0]), *THERE[1:])),
        ("the call went elsewhere", NONE, (np.array([0, 0, 0, 0.0, 4.0]), *THERE[1:])),
        ("it is not on the map", NONE, (AHEAD, np.array([-1]), *THERE[2:])),
    ],
)  # fmt: skip
def test_a_landmark_that_cannot_be_detected_keeps_its_odds(why, rows, there):
    known = heard_so_often(3)
    after = judged(known, rows, there, np.array([False]), 3)
    assert after.odds[0] == known.odds[0], why


@pytest.mark.parametrize(
    ("why", "rows", "near"),
    [
        ("a row may have been its own", NONE, True),
        ("something as loud came with it", row(label=-1, way=4.2), False),
    ],
)
def test_silence_counts_less_where_a_landmark_may_be_hidden_until_it_is_none(why, rows, near):
    known = heard_so_often(3)
    after = judged(known, rows, THERE, np.array([near]), 3)
    assert after.odds[0] == pytest.approx(known.odds[0] - HIDDEN * MISSED), why
    for scan in range(4, 24):
        after = judged(after, rows, THERE, np.array([near]), scan)
    assert bool(after.confirmed[0])
    assert after.odds[0] > GONE
    for scan in range(24, 54):
        after = judged(after, rows, THERE, np.array([near]), scan)
    assert after.odds[0] < GONE


def test_a_silent_caller_changes_no_odds_despite_a_near_row():
    mean = np.array([0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 6.0])
    there = mean, np.array([3]), np.array([-2, 5]), np.zeros(2, bool)
    way = 4.0 + np.hypot(4.0, 6.0) - 6.0
    heard = np.array([1]), np.array([1]), *(np.array([n]) for n in (way, 40.0, 0.0, 1.0))
    known = with_new(nobody(2), [1], 0, 2)
    for scan in range(3):
        known = judged(known, heard, there, np.array([False]), scan)
    after = judged(known, NONE, there, np.array([True]), 3)
    assert after.odds[0] == known.odds[0]


@pytest.mark.parametrize(("moves", "missed"), [(False, True), (True, False)])
def test_a_landmark_is_not_missed_when_its_only_caller_has_moved_too_far_away(moves, missed):
    mean = np.array([0.0, 0.0, 0.0, 4.0, 0.0, 4.0, 2.0])
    there = mean, np.array([3]), np.array([-2, 5]), np.array([False, moves])
    way = 4.0 + 2.0 - np.hypot(4.0, 2.0)
    heard = np.array([1]), np.array([1]), *(np.array([n]) for n in (way, 40.0, 0.0, 1.0))
    known = with_new(nobody(2), [1], 0, 2)
    for scan in range(3):
        known = judged(known, heard, there, np.array([False]), scan)
    mean[5:] = 4.0, 60.0  # 20 log10(30) = 30 dB fainter: below what is expected to be heard
    called = np.array([-1]), np.array([1]), *(np.array([n]) for n in (0.0, 40.0, 1.5, 1.0))
    after = judged(known, called, there, np.array([False]), 3)
    assert bool(after.odds[0] < known.odds[0]) is missed


LIDAR = (5.0, 2.0)
UNSEEN = row(label=-1, way=4.9, level=np.nan)


def seen_so_often(times, sight=LIDAR):
    """Return a landmark that a sensor without levels saw."""
    known = with_new(nobody(1), [1], 0, 1)
    for scan in range(times):
        known = judged(known, row(level=np.nan), THERE, np.array([False]), scan, sight)
    return known


def test_a_sensor_without_levels_counts_misses_within_its_range():
    known = seen_so_often(3)
    for rows in (NONE, UNSEEN):
        missed = judged(known, rows, THERE, np.array([False]), 3, LIDAR)
        assert missed.odds[0] == pytest.approx(known.odds[0] - MISSED)


@pytest.mark.parametrize(
    ("why", "rows", "where", "sight", "near"),
    [
        ("its sight is not known", NONE, (4.0, 0.0), (0.0, 7.0), False),
        ("it is too far", NONE, (4.6, 0.0), LIDAR, False),
        ("it is aside of the field of view", NONE, (2.2, 3.3), LIDAR, False),
        ("it is behind", NONE, (-4.0, 0.1), LIDAR, False),
        ("a row may have been its own", UNSEEN, (4.0, 0.0), LIDAR, True),
        ("something stands before it", row(-1, 2.0, np.nan, 0.03), (4.0, 0.0), LIDAR, False),
        ("others have levels", row(-1, 4.9, 30.0), (4.0, 0.0), LIDAR, False),
    ],
)
def test_a_landmark_out_of_a_sensors_range_keeps_its_odds(why, rows, where, sight, near):
    known = seen_so_often(3)
    there = (np.array([0.0, 0.0, 0.0, *where]), *THERE[1:])
    after = judged(known, rows, there, np.array([near]), 3, sight)
    assert after.odds[0] == known.odds[0], why


def test_an_unconfirmed_landmark_is_deleted_after_a_long_silence():
    known = heard_so_often(1)
    nowhere = (AHEAD, np.array([-1]), *THERE[2:])
    for scan in range(1, PATIENCE + 2):
        known = judged(known, NONE, nowhere, np.array([False]), scan)
    assert known.odds[0] < GONE


def test_judging_does_not_change_its_inputs():
    known = heard_so_often(2)
    before = [column.copy() for column in known]
    judged(known, row(), THERE, np.array([False]), 2)
    for one, other in zip(known, before, strict=True):
        np.testing.assert_array_equal(one, other)
