"""What an association decided, by the truth: GOSPA by brute force, names by most rows."""

from itertools import permutations

import numpy as np
import pytest

from pipistrelle.detection.scans import UNLABELLED, make_scan, rows_of
from pipistrelle.evaluation.accuracy import alignment, moved
from pipistrelle.evaluation.association import (
    STAY,
    associated,
    causes_of,
    gospa,
    map_counts,
    matched,
    nearest_motion,
    out_of_place,
    renamed,
)
from reference.missions import map_with


def best_of_all(points, true, cutoff):
    """Return GOSPA by trying every set of pairs."""
    if len(points) > len(true):
        points, true = true, points
    best = np.inf
    for order in permutations(range(len(true)), len(points)):
        off = np.array([np.hypot(*(p - true[j])) for p, j in zip(points, order, strict=True)])
        near = off < cutoff
        unpaired = len(points) + len(true) - 2 * near.sum()
        best = min(best, np.sum(off[near] ** 2) + 0.5 * cutoff**2 * unpaired)
    return np.sqrt(best)


@pytest.mark.parametrize("seed", range(30))
def test_gospa_is_the_least_over_all_sets_of_pairs(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 5.0, (rng.integers(0, 5), 2))
    true = rng.uniform(0.0, 5.0, (rng.integers(0, 5), 2))
    distance, error, missed, false = gospa(points, true)
    assert distance == pytest.approx(best_of_all(points, true, 2.0))
    assert distance**2 == pytest.approx(error**2 + 2.0 * (missed + false))
    assert missed - false == len(true) - len(points)


def test_a_caller_that_moves_is_missed_on_no_map():
    labels, causes = [np.array([1, 2])] * 3, [np.array([7, 52])] * 3
    assert associated(labels, causes).heard == {7, 52}
    assert associated(labels, causes, [52]).heard == {7}


def test_gospa_is_a_metric():
    rng = np.random.default_rng(1)
    for _ in range(50):
        a, b, c = (rng.uniform(0.0, 4.0, (rng.integers(0, 5), 2)) for _ in range(3))
        assert gospa(a, b)[0] == pytest.approx(gospa(b, a)[0])
        assert gospa(a, a)[0] == 0.0
        assert gospa(a, c)[0] <= gospa(a, b)[0] + gospa(b, c)[0] + 1e-9


def map_of(labels):
    """Return a map of placed landmarks, each a metre further."""
    places = np.arange(2.0 * len(labels)).reshape(-1, 2)
    return map_with(labels, places, np.tile(np.eye(2), (len(labels), 1, 1)))


LABELS = [np.array([1, 2, 3]), np.array([1, 2, UNLABELLED]), np.array([1, 4, 5])]
CAUSES = [np.array([7, 9, UNLABELLED]), np.array([7, 7, 8]), np.array([7, 9, 8])]


def test_a_label_is_the_landmark_that_caused_most_of_its_rows():
    found = associated(LABELS, CAUSES)
    assert found.names == {1: 7, 2: 9, 3: UNLABELLED, 4: 9, 5: 8}
    assert found.rows == {1: 3, 2: 2, 3: 1, 4: 1, 5: 1}
    assert found.right == pytest.approx(6 / 8)
    assert found.heard == {7}, "three scans or more"


def test_missed_false_and_doubled_landmarks_are_counted():
    found = associated(LABELS * 2, CAUSES * 2)
    assert map_counts(map_of([2, 3, 4]), found) == (2, 1, 1)


def test_the_label_with_most_rows_gets_the_landmarks_name():
    named = renamed(map_of([4, 2, 3, 1]), associated(LABELS, CAUSES))
    assert named.landmark[1] == 9
    assert named.landmark[3] == 7
    assert (named.landmark[[0, 2]] < UNLABELLED).all()
    assert len({*named.landmark.tolist()}) == 4


def test_causes_are_found_again_after_rows_were_removed():
    frame = make_scan(0.0, np.full(3, -1), np.array([0.1, 0.1, 0.4]), caller=np.array([0, 1, 1]))
    taken = rows_of(frame, np.array([2, 1]))
    assert causes_of(taken, frame, np.array([7, 8, 9])).tolist() == [9, 8]


def test_an_empty_association_has_no_score():
    found = associated([np.empty(0, np.int64)], [np.empty(0, np.int64)])
    assert found.right is None
    assert found.names == {}


TRUE = np.array([7, 8, 9]), np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def test_a_landmark_far_from_all_true_landmarks_is_false():
    places = np.array([[0.1, 0.0], [6.0, 0.0], [50.0, 50.0]])
    landmarks = map_with([1, 2, 3], places, np.tile(np.eye(2), (3, 1, 1)))
    rows = [np.array([1, 2, 3])] * 3
    found = associated(rows, [np.array([7, 8, 44])] * 3)
    away = out_of_place(landmarks, found, *TRUE)
    assert away == {2}, "where 44 truly is nobody knows"
    assert map_counts(landmarks, found, away) == (1, 1, 0)


def test_matching_by_position_gives_a_doubled_landmark_to_the_nearer_of_two():
    places = np.array([[1.5, 0.0], [0.1, 0.0], [10.0, 1.0], [np.nan, 0.0], [5.0, 5.0]])
    landmarks = map_with([3, 1, 2, 4, 5], places, np.tile(np.eye(2), (5, 1, 1)))
    found = matched(landmarks, *TRUE)
    assert found.names == {3: 7, 1: 7, 2: 8, 4: UNLABELLED, 5: UNLABELLED}
    assert renamed(landmarks, found).landmark.tolist() == [-5, 7, 8, -6, -7]
    assert map_counts(landmarks, found) == (1, 2, 1)


def test_map_that_is_turned_as_a_whole_has_no_false_landmark():
    turn = np.array([3.0, -4.0, 0.5])
    back = alignment(moved(TRUE[1], turn), TRUE[1])
    landmarks = map_with([1, 2, 3], moved(TRUE[1], turn), np.tile(np.eye(2), (3, 1, 1)))
    assert matched(landmarks, *TRUE).names != {1: 7, 2: 8, 3: 9}
    motion = nearest_motion(landmarks.mean, TRUE[1], [STAY, back])
    assert matched(landmarks, *TRUE, motion).names == {1: 7, 2: 8, 3: 9}


@pytest.mark.parametrize(
    ("labels", "share"),
    [([1, 1, 2, 2], 1.0), ([1, 1, 2, 1], 0.75), ([1, 1, -1, -1], 0.5), ([-1, -1, -1, -1], 0.0)],
)
def test_rows_of_landmarks_without_a_label_lower_the_share_that_is_found(labels, share):
    causes = [np.array([7, 7, 9, 9])]
    assert associated([np.array(labels)], causes).found == share
    clutter = associated([np.array([*labels, -1, 3])], [np.array([*causes[0], -1, -1])])
    assert clutter.found == share, "clutter is of no landmark"
    assert associated([np.array([3])], [np.array([-1])]).found is None
