"""A caller is found by excess paths alone: in worlds that are made, with the truth beside them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from pipistrelle.estimation.data_association import caller_search
from pipistrelle.estimation.data_association.caller_search import fitted, place_caller
from pipistrelle.estimation.data_association.pairs import Rows
from pipistrelle.estimation.data_association.rows import Tracks, followed, in_window
from pipistrelle.estimation.observations.excess_path import excess_path_slopes

CALLER = np.array([9.0, -7.0])
TURN = 0.02
MODEL = (1e-3, TURN, 1.0, 0.2, 0.075)


def way(time, velocity, acceleration=(0.0, 0.0)):
    """Return where the caller is that moves, and is at its place after 5.5 s."""
    t = time - 5.5
    return CALLER + t * np.array(velocity) + 0.5 * t * t * np.array(acceleration)


def heard(seed, *, scans=12, landmarks=20, turn_std=0.0, clutter=0, caller=lambda time: CALLER):
    """Return the tracks of a drive along an arc by odometry, and the poses by this odometry."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-10.0, 10.0, (landmarks, 2))
    tracks, poses, lost, here, before = Tracks(), [], 0.0, 0.0, np.zeros(3)
    for k in range(scans):
        angle = 0.05 * k
        pose = np.array([8.0 * math.sin(angle), 8.0 * (1.0 - math.cos(angle)), angle])
        here = here + np.exp(1j * lost) * complex(*(pose - before)[:2])
        before, lost = pose, lost + (rng.normal(0.0, turn_std) if k else 0.0)
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
        believed = np.array([here.real, here.imag, angle + lost])
        direct = towards + rng.normal(0.0, 0.04)
        tracks = followed(tracks, 0.5 * k, believed, np.array([direct, 0.04]), rows, MODEL)
        poses.append(believed)
    return tracks, np.array(poses)


def placed(tracks, *, moves=False, sure=math.inf):
    """Return where a caller is placed, of tracks of an even number of scans."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(caller_search, "SURE", sure)
        return place_caller(tracks, moves, MODEL)


def errors(drives, *, moves=False, **drive):
    """Return errors of the logarithm of a caller's range from the first pose, and their stds."""
    found = []
    for seed in range(drives):
        tracks, poses = heard(seed, turn_std=TURN, clutter=3, **drive)
        place, caller = placed(tracks, moves=moves), drive.get("caller", lambda time: CALLER)
        there, here = place.at(0.0) if moves else place[:2], poses[0, :2]
        ranges = [np.hypot(*(np.array(one) - here)) for one in (there, caller(0.0))]
        found.append((math.log(ranges[0] / ranges[1]), place.std))
    return np.array(found).T


@pytest.mark.parametrize("drives", [6, pytest.param(24, marks=pytest.mark.slow)])
def test_a_range_has_its_stated_std_despite_lost_headings_and_clutter(drives):
    error, std = errors(drives)
    assert (std < 0.15).all()
    assert np.square(error / std).sum() < chi2.ppf(0.9999, drives)
    assert np.square(error / std).sum() > chi2.ppf(0.0001, drives)


def test_stds_are_too_small_where_lost_headings_are_not_expected(monkeypatch):
    monkeypatch.setitem(globals(), "MODEL", (1e-3, 1e-3, *MODEL[2:]))
    error, std = errors(6)
    assert np.square(error / std).sum() > chi2.ppf(0.9999, 6)


def test_only_a_sure_caller_is_placed_at_every_second_scan():
    place = placed(heard(3)[0])
    assert placed(heard(3)[0], sure=1.01 * place.std) == place
    assert placed(heard(3)[0], sure=0.99 * place.std) is None
    assert placed(heard(3, scans=11)[0]) is None
    spreads = [placed(heard(3, scans=scans)[0]).std for scans in (4, 8, 12)]
    assert spreads == sorted(spreads, reverse=True)


def test_the_fit_ends_where_its_cost_is_least():
    seen = in_window(heard(3)[0], 12)
    seen = seen[0], seen[1] * np.array([1.0, 1.0, 0.0]), *seen[2:]
    unknown, points = np.zeros(6 + 3 * len(seen[1])), np.full((len(seen[3]), 2), np.nan)
    off, model = CALLER - seen[1][0, :2], (*MODEL[:2], 0.0, 0.0, MODEL[4])
    unknown[:2] = math.log(np.hypot(*off)), math.atan2(off[1], off[0])
    for _ in range(4):
        least, std = fitted(unknown, points, seen, model, 1.0)
    for step in (3.0 * std, -3.0 * std):
        moved, lands = unknown.copy(), points.copy()
        moved[0] += step
        assert fitted(moved, lands, seen, model, 1.0)[0] == pytest.approx(least, abs=0.1)
        assert moved[0] == pytest.approx(unknown[0], abs=0.1 * std)


WAYS = {
    "straight": ((0.6, 0.5), (0.0, 0.0)),
    "off": ((0.9, -0.7), (0.0, 0.0)),
    "on an arc": ((0.7, 0.5), (-0.1, 0.14)),
}


@pytest.mark.parametrize("drives", [4, pytest.param(16, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", WAYS)
def test_a_moving_caller_has_its_stated_std_and_its_velocity(how, drives):
    error, std = errors(drives, moves=True, caller=lambda time: way(time, *WAYS[how]))
    assert (std < 0.2).all()
    assert np.square(error / std).sum() < chi2.ppf(0.9999, drives)
    place = placed(heard(1, caller=lambda time: way(time, *WAYS[how]))[0], moves=True)
    velocity, acceleration = (np.array(one) for one in WAYS[how])
    assert np.hypot(*(np.array(place.motion[:2]) - (velocity - 5.5 * acceleration))) < 0.2
    assert np.hypot(*(np.array(place.at(5.5)) - CALLER)) < 1.0


def test_a_stationary_caller_fitted_as_moving_is_at_rest():
    place = placed(heard(3)[0], moves=True)
    assert np.hypot(*place.motion[:2]) < 0.2
    assert place.since == 0.0


def test_a_vehicle_at_rest_finds_no_caller():
    rng, tracks = np.random.default_rng(0), Tracks()
    bearing, way = rng.uniform(-3.0, 3.0, 15), rng.uniform(2.0, 20.0, 15)
    for k in range(12):
        rows = Rows(
            bearing + rng.normal(0.0, 0.01, 15), np.full(15, 0.01),
            way + rng.normal(0.0, 0.03, 15), np.full(15, 0.03), np.ones(15),
        )  # fmt: skip
        tracks = followed(tracks, 0.5 * k, np.zeros(3), np.array([0.5, 0.04]), rows, MODEL)
    for moves in (False, True):
        assert placed(tracks, moves=moves).std > 0.25


def test_tracks_follow_all_landmarks_without_breaks():
    _, _, _, table = in_window(heard(5)[0], 12)
    assert np.count_nonzero(~np.isnan(table[..., 0]).any(axis=1)) >= 15, (
        "of 20 landmarks, two may be too near each other to tell"
    )


def test_without_tracks_or_a_direct_call_no_caller_is_found():
    assert place_caller(Tracks(), False, MODEL) is None
    tracks, _ = heard(1)
    assert placed(replace(tracks, direct=np.full_like(tracks.direct, np.nan))) is None
    assert placed(replace(tracks, rows=tuple(rows[:0] for rows in tracks.rows))) is None
