"""Bearings that wait: where they cross, and that nothing they do ends a mission."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from pipistrelle.estimation.beliefs import Gaussian, placed
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.observations.bearing import MIN_CROSSING_SINE
from pipistrelle.estimation.smoother.elimination import Places, Rows
from pipistrelle.estimation.smoother.filter import Smoother, range_by_crossing
from pipistrelle.estimation.smoother.preintegration import OF_SENSOR
from pipistrelle.experiments.drives import Drive
from pipistrelle.experiments.runs.trial import run_filter
from reference.missions import ray_config, scan_with

UNICYCLE = Motion(model="unicycle", control_std=(0.05, 0.02), noise_at_rest=False)
EXACT = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
SURE = Gaussian(mean=np.zeros(3), covariance=1e-6 * np.eye(3))
AHEAD, STILL = (1.0, 0.0), (0.0, 0.0)


class Bearing(NamedTuple):
    """A bearing that waits: the number of the node it was heard from, itself, its deviation."""

    node: int
    bearing: float
    std: float


def crossing(poses, heard):
    """The place where the last of these bearings crosses an earlier one, or None."""
    rows = len(heard)
    ends, numbers = np.zeros((rows, 4), np.int64), np.full((rows, 8), np.nan)
    ends[:, 2], ends[:, 3] = [one.node for one in heard], np.arange(rows) - 1
    numbers[:, 0], numbers[:, 3] = np.array(heard)[:, 1:].T
    none, known = np.zeros(0, np.int64), np.zeros(len(OF_SENSOR), np.int64)
    way = np.zeros((len(poses), 3)), np.zeros(len(poses))
    places = Places(none, none, np.zeros((0, 2)), known, *way)
    away = range_by_crossing(Rows(ends, numbers), rows - 1, (poses, np.zeros(1)), places)
    x, y, heading = poses[heard[-1].node]
    angle = heading + heard[-1].bearing
    return (
        None
        if np.isnan(away)
        else np.array([x, y]) + away * np.array([np.cos(angle), np.sin(angle)])
    )


def seen_from(x, place, std=0.01, heading=0.0):
    """What is heard of a place from (x, 0), looking along a heading."""
    return Bearing(int(x), float(np.arctan2(place[1], place[0] - x) - heading), std)


def poses(count):
    """On the x axis, a metre apart."""
    return np.column_stack([np.arange(count), np.zeros((count, 2))]).astype(float)


# Where they cross


@pytest.mark.parametrize("place", [(3.0, 4.0), (-1.0, 2.0), (4.0, -3.0)])
def test_bearings_cross_where_the_landmark_is(place):
    heard = tuple(seen_from(x, place) for x in range(5))
    np.testing.assert_allclose(crossing(poses(5), heard), place, rtol=0, atol=1e-12)


def test_the_earlier_bearing_that_crosses_most_squarely_counts():
    """The one from the first pose crosses most squarely; the others are wrong."""
    place = (4.0, 4.0)
    heard = [seen_from(x, place) for x in range(5)]
    for x in (1, 2, 3):
        heard[x] = heard[x]._replace(bearing=heard[x].bearing + 0.02)
    np.testing.assert_allclose(crossing(poses(5), tuple(heard)), place, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("more", "there"), [(1e-6, True), (-1e-6, False)])
def test_bearings_cross_clearly_from_the_least_parallax_on(more, there):
    heard = Bearing(0, 0.7, 1e-4), Bearing(1, 0.7 + np.arcsin(MIN_CROSSING_SINE) + more, 1e-4)
    assert (crossing(poses(2), heard) is not None) == there


@pytest.mark.parametrize(
    ("earlier", "last", "there"),
    [(0.0999, 1e-4, True), (0.1001, 1e-4, False), (1e-4, 0.141, True), (1e-4, 0.142, False)],
)
def test_bearings_cross_where_the_range_is_known_to_a_fifth(earlier, last, there):
    """From (0, 0) and (2, 0) to (2, 2): 2 m and sqrt(8) m away, at an angle of 45 degrees."""
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    heard = Bearing(0, np.pi / 4, earlier), Bearing(1, np.pi / 2, last)
    assert (crossing(poses, heard) is not None) == there


@pytest.mark.parametrize(
    "heard",
    [
        pytest.param((Bearing(0, 0.7, 0.01),), id="one alone"),
        pytest.param((Bearing(0, 0.7, 0.01), Bearing(0, 0.7, 0.01)), id="the same twice"),
        pytest.param((Bearing(0, 0.0, 0.01), Bearing(1, 0.0, 0.01)), id="straight ahead"),
        pytest.param((Bearing(0, 0.0, 0.01), Bearing(1, np.pi, 0.01)), id="between them"),
        pytest.param((Bearing(0, 0.7, 0.01), Bearing(1, 0.7, 0.01)), id="parallel"),
        pytest.param((Bearing(0, 1.2, 0.01), Bearing(1, 0.3, 0.01)), id="behind both"),
        pytest.param((Bearing(0, 0.3, 0.01), Bearing(1, -1.2, 0.01)), id="behind one"),
        pytest.param((Bearing(0, 0.7, 0.3), Bearing(1, 1.4, 0.3)), id="anywhere"),
    ],
)
def test_bearings_that_do_not_cross_clearly_ahead_give_no_position(heard):
    assert crossing(poses(2), heard) is None


# Whatever is heard


def lived(controls, scans, *, motion=UNICYCLE, start=SURE, **changes):
    """Drive and hear, one scan after each second; all that is told is finite. Returns the map."""
    time = np.arange(len(controls) + 1.0)
    heard = [replace(scan, time=float(time[1 + k])) for k, scan in enumerate(scans)]
    drive = Drive(motion=motion, start=start, time=time, controls=np.array(controls, float))
    slam = Smoother(motion=motion, rays=ray_config(), **changes)
    track = run_filter(slam, drive, heard, None)
    for told in (track.pose, track.online, track.landmarks):
        assert np.isfinite(told.mean).all()
        assert np.isfinite(told.covariance).all()
        assert (np.linalg.eigvalsh(told.covariance) > -1e-10).all()
    return track, track.landmarks


def assert_waits(rows, label):
    """The landmark is partial: a ray of two rows or more."""
    assert np.sum(rows.landmark == label) >= 2
    assert not placed(rows)[rows.landmark == label].any()
    assert rows.weight[rows.landmark == label].sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("controls", "bearings"),
    [
        pytest.param([AHEAD] * 6, [0.0] * 6, id="straight ahead on a straight drive"),
        pytest.param([AHEAD] * 6, [np.pi] * 6, id="straight behind"),
        pytest.param([AHEAD] * 2, [1.2, 0.3], id="crossing behind"),
        pytest.param([STILL] * 4, [0.4] * 4, id="the same from a vehicle that stands"),
        pytest.param([STILL] * 2, [0.4, 1.5], id="apart from a vehicle that stands"),
        pytest.param([(0.0, 0.5)] * 4, [0.4, -0.1, -0.6, -1.1], id="turning in place"),
    ],
)
@pytest.mark.parametrize("start", [SURE, EXACT], ids=["sure start", "exact start"])
def test_a_landmark_that_is_never_placed_waits(controls, bearings, start):
    scans = [scan_with([4], [bearing], bearing_std=0.01) for bearing in bearings]
    _, rows = lived(controls, scans, start=start)
    assert_waits(rows, 4)


def test_waiting_bearings_do_not_change_the_path():
    scans = [scan_with([4, 9], [0.0, 1.0 + 0.01 * k], bearing_std=0.01) for k in range(4)]
    track, rows = lived([AHEAD] * 4, scans)
    reckoned, _ = lived([AHEAD] * 4, [])
    assert_waits(rows, 4)
    assert_waits(rows, 9)
    np.testing.assert_allclose(track.pose.mean, reckoned.pose.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(track.pose.covariance, reckoned.pose.covariance, rtol=0, atol=1e-10)


def test_a_landmark_enters_with_all_the_bearings_that_waited():
    """Ten looks from two places, as sure as the mean of five of either."""
    place, std = np.array([1.0, 2.0]), 0.01
    here, there = (seen_from(x, place, std).bearing for x in (0, 2))
    scans = [scan_with([4], [here], bearing_std=std)] * 5
    scans += [scan_with([4], [there], bearing_std=std)] * 5
    still = replace(UNICYCLE, control_std=(1e-6, 1e-6))
    drive = [STILL] * 5 + [(2.0, 0.0)] + [STILL] * 4
    _, rows = lived(drive, scans, motion=still, start=EXACT)
    np.testing.assert_allclose(rows.mean, [place], rtol=0, atol=1e-5)
    lines = [np.array([-place[1], place[0] - x]) for x in (0.0, 2.0)]
    information = sum(5 * np.outer(d, d) / (d @ d) ** 2 / std**2 for d in lines)
    np.testing.assert_allclose(rows.covariance[0], np.linalg.inv(information), rtol=0, atol=1e-9)


def test_a_range_places_a_landmark_that_waited():
    scans = [scan_with([4], [0.0], bearing_std=0.01) for _ in range(3)]
    _, rows = lived([AHEAD] * 4, [*scans, scan_with([4], [0.0], [3.0], bearing_std=0.01)])
    assert rows.landmark.tolist() == [4]
    np.testing.assert_allclose(rows.mean, [[7.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("robust", ["none", "huber"])
def test_a_vehicle_at_rest_with_an_exact_start_maps_from_there(robust):
    scans = [scan_with([4, 5], [0.3, -0.5], [2.0, np.nan])] * 5
    track, rows = lived([STILL] * 5, scans, start=EXACT, robust=robust)
    np.testing.assert_allclose(track.pose.mean, np.zeros((6, 3)), rtol=0, atol=1e-6)
    assert np.abs(track.pose.covariance).max() < 1e-10
    assert_waits(rows, 5)


@pytest.mark.parametrize(
    ("bearing_std", "range_std"), [(1e-6, 10.0), (1e-6, 1e-6), (1.0, 1e-6), (1e-9, 100.0)]
)
@pytest.mark.parametrize("gate", [1.0, 0.999])
def test_very_unequal_noise_ends_no_mission(bearing_std, range_std, gate):
    rng, places = np.random.default_rng(2), np.array([[4.0, 3.0], [2.0, -5.0], [9.0, 1.0]])
    scans = []
    for x in range(1, 9):
        dx, dy = (places - [x, 0.0]).T
        bearing = np.arctan2(dy, dx) + bearing_std * rng.normal(size=3)
        distance = np.maximum(np.hypot(dx, dy) + range_std * rng.normal(size=3), 0.1)
        distance[x % 3] = np.nan
        known = {"bearing_std": bearing_std, "range_std": range_std}
        scans.append(scan_with([1, 2, 3], bearing, distance, **known))
    _, rows = lived([AHEAD] * 8, scans, gate=gate)
    assert set(rows.landmark.tolist()) == {1, 2, 3}


def test_the_largest_labels_are_distinguished():
    labels = [2**53 - 1, 2**53 - 2, 2**32, 0]
    scans = [scan_with(labels, [0.3, -0.3, 1.0, -1.0], [3.0, 4.0, 5.0, 6.0])]
    _, rows = lived([AHEAD], scans)
    assert rows.landmark.tolist() == labels
    np.testing.assert_allclose(np.hypot(*(rows.mean - [1.0, 0.0]).T), [3.0, 4.0, 5.0, 6.0])


def test_a_drive_without_noise_follows_its_odometry():
    silent = Motion(model="unicycle", control_std=(0.0, 0.0))
    scans = [scan_with([4], [0.3 + 0.2 * k], [np.nan]) for k in range(6)]
    track, _ = lived([AHEAD] * 6, scans, motion=silent, start=EXACT)
    np.testing.assert_allclose(track.pose.mean[:, 0], np.arange(7.0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(track.pose.mean[:, 1:], 0.0, rtol=0, atol=1e-6)
