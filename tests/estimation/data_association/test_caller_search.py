"""A caller is found by excess paths alone: in worlds that are made, with the truth beside them."""

import math

import numpy as np
import pytest

from pipistrelle.estimation.data_association.caller_search import (
    find_caller,
    find_moving_caller,
    misfit,
    searched,
)
from pipistrelle.estimation.data_association.pairs import Rows
from pipistrelle.estimation.data_association.rows import (
    CallerPlace,
    CallerState,
    Tracks,
    followed,
    in_window,
)
from pipistrelle.estimation.measurement import excess_path_slopes

CALLER = np.array([9.0, -7.0])


def way(time, velocity, acceleration=(0.0, 0.0)):
    """Return where the caller is that moves, and is at its place after 5.5 s."""
    t = time - 5.5
    return CALLER + t * np.array(velocity) + 0.5 * t * t * np.array(acceleration)


def heard(seed, *, scans=12, landmarks=20, turn_std=0.0, clutter=0, caller=lambda time: CALLER):
    """Return the tracks of a drive along an arc, and the poses it was believed to have."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-10.0, 10.0, (landmarks, 2))
    tracks, poses, lost = Tracks(), [], 0.0
    for k in range(scans):
        angle = 0.05 * k
        pose = np.array([8.0 * math.sin(angle), 8.0 * (1.0 - math.cos(angle)), angle])
        lost += rng.normal(0.0, turn_std)
        off, there = places - pose[:2], caller(0.5 * k)
        bearing = np.arctan2(off[:, 1], off[:, 0]) - pose[2]
        way = np.array([excess_path_slopes(*pose[:2], *p, *there)[0] for p in places])
        bearing = np.append(bearing, rng.uniform(-math.pi, math.pi, clutter))
        way = np.append(way, rng.uniform(1.0, 25.0, clutter))
        size = bearing.size
        rows = Rows(
            bearing + rng.normal(0.0, 0.01, size), np.full(size, 0.01),
            way + rng.normal(0.0, 0.03, size), np.full(size, 0.03), np.ones(size),
        )  # fmt: skip
        towards = math.atan2(*(there - pose[:2])[::-1]) - pose[2]
        believed = pose + np.array([0.0, 0.0, lost])
        direct = towards + rng.normal(0.0, 0.04)
        tracks = followed(tracks, 0.5 * k, believed, direct, rows)
        poses.append(believed)
    return tracks, np.array(poses)


@pytest.mark.parametrize("drives", [5, pytest.param(16, marks=pytest.mark.slow)])
def test_the_caller_is_found_though_headings_are_lost_and_clutter_is_heard(drives):
    sure = 0
    for seed in range(drives):
        tracks, poses = heard(seed, turn_std=0.01, clutter=3)
        found = find_caller(tracks)
        if found is None or not found.sure:
            continue
        sure += 1
        far = math.hypot(found.place.x - poses[-1, 0], found.place.y - poses[-1, 1])
        assert far == pytest.approx(np.hypot(*(CALLER - poses[-1, :2])), rel=0.4), seed
    assert sure >= 10 / 16 * drives


def test_without_errors_the_misfit_is_least_where_the_caller_is():
    tracks, _ = heard(3)
    table, poses, direct = in_window(tracks, 14, 4)
    places = np.tile(CALLER, (len(poses), 1))
    here = misfit(places, poses, table, direct)
    for step in ([2.0, 0.0], [-2.0, 0.0], [0.0, 2.0], [0.0, -2.0], [5.0, -4.0]):
        assert misfit(places + step, poses, table, direct) > here + 10.0


def found_first(factor, *, scans=20, **drive):
    """Return a caller that was found at so many times its range, and what it was heard of since."""
    tracks, poses = heard(3, scans=scans, **drive)
    x, y = poses[0, :2] + factor * (CALLER - poses[0, :2])
    return CallerState(label=1, place=CallerPlace(x, y), told=True, tracks=tracks)


def test_where_a_second_search_disagrees_the_mean_of_both_is_taken():
    first = found_first(1.5)
    second = find_caller(first.tracks).place
    caller, place = searched(first, moves=False)
    assert caller is first
    assert place.agreed
    assert place[:2] == pytest.approx(np.add(first.place[:2], second[:2]) / 2.0)
    error = [np.hypot(*(one[:2] - CALLER)) for one in (first.place, place)]
    assert error[1] < 0.6 * error[0]


def test_the_second_search_replaces_a_widely_different_first():
    first = found_first(2.5)
    _, place = searched(first, moves=False)
    assert place[:2] == pytest.approx(find_caller(first.tracks).place[:2])


def test_a_second_search_that_agrees_keeps_the_position_and_ends_tracking():
    first = found_first(1.02)
    caller, place = searched(first, moves=False)
    assert place is None
    assert caller.place == first.place._replace(agreed=True)
    assert not len(caller.tracks.poses)


def test_an_unsuccessful_second_search_ends_after_30_scans():
    for scans, given_up in ((20, False), (28, False), (30, True)):
        first = found_first(1.5, scans=scans, landmarks=3)
        caller, place = searched(first, moves=False)
        assert place is None, scans
        assert caller.place.agreed == given_up, scans


def test_a_late_or_moving_caller_is_searched_for_once():
    for scans, moves, once in ((8, False, False), (18, False, False), (20, False, True)):
        unknown = CallerState(label=1, tracks=heard(3, scans=scans)[0])
        assert searched(unknown, moves)[1].agreed == once, scans
    unknown = CallerState(label=1, tracks=heard(3, scans=12)[0])
    assert searched(unknown, moves=True)[1].agreed
    unknown = CallerState(label=1, tracks=heard(3, scans=9)[0])
    assert searched(unknown, moves=False) == (unknown, None)


WAYS = {
    "straight": ((0.6, 0.5), (0.0, 0.0)),
    "off": ((0.9, -0.7), (0.0, 0.0)),
    "on an arc": ((0.7, 0.5), (-0.1, 0.14)),
}


@pytest.mark.parametrize("drives", [3, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", WAYS)
def test_a_caller_that_moves_is_found_with_its_velocity(how, drives):
    sure = 0
    for seed in range(drives):
        tracks, poses = heard(seed, turn_std=0.01, clutter=3, caller=lambda t: way(t, *WAYS[how]))
        found = find_moving_caller(tracks)
        if found is None or not found.sure:
            continue
        sure += 1
        here, velocity = poses[-1, :2], np.array(WAYS[how][0])
        far = math.hypot(*(np.array(found.place.at(5.5)) - here))
        assert far == pytest.approx(np.hypot(*(CALLER - here)), rel=0.25), seed
        assert np.hypot(*(np.array(found.place.motion[:2]) - velocity)) < 0.6, seed
        before = way(found.place.since, *WAYS[how])
        assert np.hypot(*(np.array(found.place.at(found.place.since)) - before)) < 4.0, seed
    assert sure >= 4 / 6 * drives


def test_only_a_fixed_caller_fits_a_position_and_is_found_at_rest():
    tracks, _ = heard(3, caller=lambda t: way(t, (0.9, 0.7)))
    assert find_caller(tracks).misfit > 2.0 * find_moving_caller(tracks).misfit
    still = find_moving_caller(heard(3)[0])
    assert still.sure
    assert np.hypot(*still.place.motion[:2]) < 0.3


def test_a_vehicle_at_rest_finds_no_caller():
    rng, tracks = np.random.default_rng(0), Tracks()
    bearing, way = rng.uniform(-3.0, 3.0, 15), rng.uniform(2.0, 20.0, 15)
    for k in range(12):
        rows = Rows(
            bearing + rng.normal(0.0, 0.01, 15), np.full(15, 0.01),
            way + rng.normal(0.0, 0.03, 15), np.full(15, 0.03), np.ones(15),
        )  # fmt: skip
        tracks = followed(tracks, 0.5 * k, np.zeros(3), 0.5, rows)
    for found in (find_caller(tracks), find_moving_caller(tracks)):
        assert found is None or not found.sure


def test_tracks_follow_all_landmarks_without_breaks():
    tracks, _ = heard(5)
    table, _, _ = in_window(tracks, 14, 12)
    assert len(table) >= 15, "of 20 landmarks, two may be too near each other to tell"


def test_too_few_tracks_or_no_direct_call_find_no_caller():
    assert find_caller(Tracks()) is None is find_moving_caller(Tracks())
    tracks, _ = heard(1, landmarks=5)
    assert find_caller(tracks) is None
