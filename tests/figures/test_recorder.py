"""The recorded frames, the excess paths shown at each, and their ellipses."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import no_landmarks, some_of
from pipistrelle.estimation.observations.excess_path import excess_path_of
from pipistrelle.figures.maps import drawn_excess_paths
from pipistrelle.figures.recorder import (
    RECENT_FRAMES,
    Snapshot,
    callers_at,
    callers_marked,
    excess_paths_at,
    pruned,
    resolved,
)
from reference.missions import map_with

CALLERS = {1: np.array([8.0, 1.0]), 2: np.array([-3.0, 6.0]), 3: np.array([-3.0, 6.5])}
SPOT = np.array([4.0, 7.0])
LABELS = np.array([UNLABELLED, 91, 92, 93])


def frame_of(members, heard, ranged=()):
    """A frame: members of each landmark, who was heard whose call threw back, and ranges."""
    rows = [(90 + number, place) for number, place in CALLERS.items()]
    rows += [(label, SPOT + k) for label, count in members.items() for k in range(count)]
    label, mean = zip(*rows, strict=True)
    weight = [1.0 / members.get(one, 1) for one in label]
    landmark, caller = (np.array(column, dtype=int) for column in zip(*heard, strict=True))
    excess_path = [excess_path_of(np.zeros(2), SPOT, CALLERS[one]) for one in caller.tolist()]
    distance = np.where(np.isin(landmark, ranged), 8.0, np.nan)
    scan = make_scan(
        0.0, landmark, np.zeros(len(heard)),
        range=distance, excess_path=np.array(excess_path), caller=caller,
    )  # fmt: skip
    return Snapshot(
        scan=replace(scan, callers=LABELS),
        pose=np.zeros(3),
        covariance=np.zeros((3, 3)),
        landmarks=map_with(label, mean, weight=weight),
    )


def test_a_recorder_keeps_every_frame_of_every_estimate(watched):
    done, snapshots = watched
    assert list(snapshots) == [(trial.strategy, trial.filter) for trial in done.trials]
    for trial in done.trials:
        frames = snapshots[trial.strategy, trial.filter]
        assert len(frames) == 40
        assert all(frame.scan is scan for frame, scan in zip(frames, trial.scans, strict=True))
        np.testing.assert_array_equal([frame.pose for frame in frames], trial.track.pose.mean[4::4])
        if trial.filter == "fastslam":
            np.testing.assert_array_equal(frames[-1].cloud, trial.track.cloud)
        else:
            assert frames[0].cloud is None


def test_members_without_a_successor_of_their_landmark_are_pruned():
    def rows(labels, x):
        return map_with(labels, np.column_stack([x, np.zeros(len(x))]))

    before = rows([1, 1, 1, 2, 2], [0.7, 2.1, 6.4, 0.0, 5.0])
    after = rows([1, 1, 2, 3], [2.3, 6.0, 4.0, 0.7])
    assert pruned(before, after).tolist() == [True, False, False, True, False]
    assert pruned(before, no_landmarks()).all()
    assert len(pruned(no_landmarks(), after)) == 0


def test_callers_are_believed_where_their_landmark_is_once_it_is_placed():
    rows = map_with(
        [91, 92, 92], [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], np.tile(np.eye(2), (3, 1, 1))
    )
    known = callers_at(replace(frame_of({}, [(5, 1)]), landmarks=rows))
    np.testing.assert_array_equal(known.mean[1], [1.0, 2.0])
    np.testing.assert_array_equal(known.covariance[1], np.eye(2))
    assert np.isnan(known.mean[[0, 2, 3]]).all(), "the vehicle, a ray, and one never heard"


def test_an_excess_path_ellipse_passes_through_its_landmark():
    (ellipse,), (way,) = drawn_excess_paths(frame_of({5: 1}, [(5, 1)]), 5)
    caller = CALLERS[1]
    length = np.hypot(*(ellipse - caller).T) + np.hypot(*ellipse.T)
    expected = np.hypot(*(SPOT - caller)) + np.hypot(*SPOT)
    np.testing.assert_allclose(length, expected)
    assert np.hypot(*(ellipse - SPOT).T).min() < 0.3
    np.testing.assert_array_equal(way, [caller, SPOT, [0.0, 0.0]])


def test_of_three_excess_paths_two_are_drawn_that_cross_most_squarely():
    frame = frame_of({5: 1}, [(5, 2), (5, 3), (5, 1)])
    rows = excess_paths_at(frame)[5]
    assert len(rows) == 2
    assert 1 in frame.scan.caller[rows], "two and three stand beside each other"
    assert len(drawn_excess_paths(frame, 5)[0]) == 2
    assert len(drawn_excess_paths(frame_of({5: 1}, [(5, 2), (5, 3)]), 5)[0]) == 2


def test_an_excess_path_of_a_caller_that_is_not_placed_makes_no_ellipse():
    frame = frame_of({5: 1}, [(5, 1), (5, 2)])
    some = frame.landmarks.landmark != 92
    rows = {name: getattr(frame.landmarks, name)[some] for name in ("landmark", "mean", "weight")}
    blind = replace(
        frame, landmarks=map_with(rows["landmark"], rows["mean"], weight=rows["weight"])
    )
    assert frame.scan.caller[excess_paths_at(blind)[5]].tolist() == [1]
    unknown = replace(frame, scan=replace(frame.scan, callers=LABELS[:2]))
    assert frame.scan.caller[excess_paths_at(unknown)[5]].tolist() == [1], (
        "a number beyond the labels"
    )
    assert excess_paths_at(replace(frame, pose=np.full(3, np.nan))) == {}
    assert drawn_excess_paths(frame, 77) == ([], []), "a landmark that nobody knows"


def test_new_landmarks_precede_rays_and_rays_precede_older_landmarks():
    heard = [(5, 1), (6, 1), (7, 1)]
    frames = [
        frame_of({5: 4, 6: 3, 7: 4}, heard),
        frame_of({5: 1, 6: 3, 7: 4}, heard),
        frame_of({5: 1, 6: 3, 7: 2}, heard),
        frame_of({5: 1, 6: 1, 7: 1}, [(5, 1), (7, 1)]),
        frame_of({5: 1, 6: 1, 7: 1}, [(5, 1), (7, 1)]),
        frame_of({5: 1, 6: 1, 7: 1}, [(5, 1)]),
    ]
    assert resolved(frames) == [6, 5, 7, 7, 7, 5]


def test_a_landmark_is_shown_for_a_while_after_excess_paths_have_placed_it():
    frames = [frame_of({5: 4}, [(5, 1)])] + [frame_of({5: 1}, [(5, 1)])] * (RECENT_FRAMES + 9)
    shown = [label == 5 for label in resolved(frames)]
    assert shown == [True] * (RECENT_FRAMES + 2) + [False] * 8


def test_a_landmark_that_a_range_has_placed_is_none_that_excess_paths_resolve():
    frames = [frame_of({5: 1}, [(5, 1)], ranged) for ranged in ((5,), ())]
    assert resolved(frames) == [UNLABELLED, UNLABELLED]
    assert resolved(frames[1:]) == [5], "else it is"


def test_between_equals_the_shown_or_doubly_measured_landmark_wins():
    one, both = [(5, 1), (6, 1)], [(5, 1), (6, 1), (6, 2)]
    assert resolved([frame_of({5: 2, 6: 2}, both), frame_of({5: 2, 6: 2}, one)]) == [6, 6]
    assert resolved([frame_of({5: 2, 6: 2}, one), frame_of({5: 2, 6: 2}, both)]) == [5, 5]


def test_a_mission_without_timing_has_no_ellipse_and_its_one_beacon_no_mark(watched):
    for frames in watched[1].values():
        assert not callers_marked([frame.scan for frame in frames])
    silent = make_scan(0.0, np.array([5]), np.zeros(1))
    assert not callers_marked([replace(silent, callers=LABELS[:2])])
    assert callers_marked([replace(silent, callers=LABELS)]), "several"


@pytest.mark.parametrize("strategy", ["active", "fused"])
def test_ellipses_of_a_mission_pass_near_their_landmark(timed, strategy):
    _, snapshots = timed
    frames = snapshots[strategy, "ekf"]
    chosen = resolved(frames)
    assert (set(chosen) == {UNLABELLED}) == (strategy == "active"), "active takes no excess paths"
    counts = []
    for frame, label in zip(frames, chosen, strict=True):
        outlines, ways = drawn_excess_paths(frame, label)
        counts.append(len(outlines))
        for outline, way in zip(outlines, ways, strict=True):
            near = np.hypot(*(outline - way[1]).T).min()
            assert near < 0.2 * np.hypot(*np.diff(way, axis=0).T).sum()
            believed = callers_at(frame).mean
            assert (believed == way[0]).all(axis=1).any()
    assert set(counts) == ({0} if strategy == "active" else {1, 2})


def test_a_tracked_caller_has_its_estimated_position():
    frame = frame_of({5: 1}, [(5, 1)])
    boat = map_with([91], [[2.0, -1.0]], [0.04 * np.eye(2)])
    still = replace(frame, landmarks=some_of(frame.landmarks, frame.landmarks.landmark != 91))
    assert np.isnan(callers_at(still).mean[1]).all()
    followed = replace(still, moving=boat)
    np.testing.assert_array_equal(callers_at(followed).mean[1], [2.0, -1.0])
    (ellipse,), _ = drawn_excess_paths(followed, 5)
    length = np.hypot(*(ellipse - [2.0, -1.0]).T) + np.hypot(*ellipse.T)
    np.testing.assert_allclose(length, length[0], rtol=1e-9)
