"""The watch over a drive without labels: alarms, their causes, and the pose found again."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config
from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import Gaussian, JointGaussian
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.data_association.existence import (
    BINS,
    CHANCE,
    LASTING,
    PERSISTENCE,
    WINDOW,
    nobody,
    with_new,
)
from pipistrelle.estimation.data_association.pairs import OWN_CALL, Rows
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.data_association.watch import (
    BOUND,
    POSE,
    failed,
    observed,
    of_calls,
    placed_again,
    ratios,
    reported,
)
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.session import Session

CHANCES = (25.0, 0.06, 1.2, 0.8, 0.02)
PLACES = 3 + 2 * np.arange(12), np.full((12, 1), np.nan)
CALLER = 9.0 - 4.0j


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def known_of(past, born):
    """Return records of landmarks with a past of detections by one call."""
    size = len(past)
    known = with_new(nobody(1), list(range(1, 1 + size)), 0, 1)
    recent = np.zeros((size, 1, WINDOW))
    recent[:, 0, WINDOW - np.shape(past)[1] :] = past
    return known._replace(past=recent, born=np.array(born), confirmed=np.ones(size, np.bool_))


def test_scan_records_log_probability_of_misses_as_far_as_strays_may_be_of_them():
    """Of five landmarks one is detected, two are missed, one is near a row, one unconfirmed."""
    places = np.array([[3.0, 0.0], [3.0, 1.0], [3.0, -1.0], [2.0, 2.0], [5.0, 0.0]])
    mean, known = np.append(np.zeros(3), places), known_of(np.zeros((5, 1)), [0] * 5)
    known.count[[0, 1, 2, 4]] = LASTING, LASTING, LASTING, LASTING
    before, p = of_calls(1)[:4], 0.8
    before[0][:], before[1][:] = 8.0, 9.0
    for strays, share in ((0, 0.0), (1, 1.0 / 1.6), (4, 1.0)):
        bearing, way = np.append([0.0, 0.785], np.full(strays, 2.0)), np.full(2 + strays, 9.0)
        way[:2] = 3.0, 2.83
        label = np.array([1, *[UNLABELLED] * (1 + strays)])
        std, number = np.full(way.size, 0.01), np.zeros(way.size, np.int64)
        sure = np.arange(way.size) >= 2
        heard = label, number, sure, std > 0.0, bearing, std, way, std, np.ones(way.size)
        at = np.array([3, 5, 7, 9, -1])
        place = mean, at, np.full(1, OWN_CALL), np.zeros(1, np.bool_)
        scan = 1e-6 * np.eye(13), place, np.ones(1, np.bool_), heard, CHANCES, 90
        *after, past, missed, _ = observed(tuple(known), before, *scan)
        miss = share * math.log(1.0 - p)
        assert past[:, 0, -1] == pytest.approx([1.0, miss, miss, 0.0, 0.0])
        assert missed == pytest.approx([1.0, *[(1.0 - p) ** (1.0 / PERSISTENCE)] * 3, 1.0])
        assert [(after[k] - before[k]).sum() for k in range(2)] == [1, 3]
        assert [*after[2], *after[3]] == pytest.approx([1.0, 3 * p])


def test_ratio_counts_each_landmark_once_and_by_scans_after_its_first():
    """Two scans: missed twice, missed then detected, detected then missed, first in the latter."""
    miss, q, detected, now = math.log(0.2), CHANCE, math.log(CHANCE / (1.0 - CHANCE)), 90
    past = [[miss, miss], [miss, 1.0], [1.0, miss], [0.0, miss]]
    known = known_of(past, [3, 3, 3, now - 1])
    found = ratios(known.past, known.born, known.confirmed, now)[0, -2:]
    missed = [math.log((1 - q + q * m) / (q + (1 - q) * m)) for m in (0.04, 0.2)]
    assert found == pytest.approx([missed[0] + 2 * detected, 3 * missed[1] + detected])


def drawn_past(rng, share, scans):
    """Return the past of 15 landmarks of probability 0.9, each still detected with a share."""
    heard = (rng.random((15, scans)) < 0.9) & (rng.random((15, 1)) < share)
    return np.where(heard, 1.0, math.log(0.1))


def test_alarm_follows_only_a_loss_of_detections(rng):
    """One landmark in ten is hidden: no alarm in a thousand drives; else one in three scans."""
    judged, known = np.ones(1, np.int64), known_of(np.zeros((15, WINDOW)), [0] * 15)

    def failure(past):
        ratio = ratios(past[:, np.newaxis], known.born, known.confirmed, 90)
        return failed(of_calls(1), ratio, judged)

    for _ in range(1000):
        assert not failure(drawn_past(rng, 0.9, WINDOW))[0]
    for _ in range(50):
        past = np.hstack([drawn_past(rng, 1.0, WINDOW - 3), drawn_past(rng, 0.0, 3)])
        calls, since, pose = failure(past)
        assert (calls, pose) == ([0], True)
        assert WINDOW - 4 <= since <= WINDOW - 2


@pytest.mark.parametrize(
    ("ratio", "least", "expected"),
    [
        ((-4.0, BOUND), (1, 1), ([1], False)),
        ((BOUND, BOUND), (1, 1), ([0, 1], True)),
        ((0.0, BOUND), (1, 1), ([1], True)),
        ((-4.0, BOUND - 1.0), (1, 1), ([], False)),
        ((-4.0, BOUND), (WINDOW + 1, 1), ([1], False)),
        ((-4.0, BOUND), (1, 2), ([], False)),
    ],
)
def test_cause_is_caller_if_other_calls_fit(ratio, least, expected):
    """A call that is not in this scan is a witness, too."""
    table = np.full((2, WINDOW), -9.0)
    table[:, -1] = ratio
    calls, _, pose = failed(of_calls(2), table, np.array(least))
    assert (calls, pose) == expected


@pytest.mark.parametrize(("lost", "expected"), [(0, ([], False)), (2, ([0], True))])
def test_lost_vehicle_searches_pose_at_any_doubt(lost, expected):
    table = np.array([[5.0], [-1.0]]) * np.ones(WINDOW)
    calls, _, pose = failed(of_calls(2)._replace(lost=lost), table, np.ones(2, np.int64))
    assert (calls, pose) == expected


def scan_from(rng, pose, landmarks, caller):
    """Return echoes of some landmarks, exact to a hundredth, and clutter; rows, direct bearing."""
    at, heading = complex(*pose[:2]), pose[2]
    far = landmarks[:7] - at
    way = abs(far) if caller is None else abs(far) + abs(landmarks[:7] - caller) - abs(caller - at)
    bearing = np.angle(far * np.exp(-1j * heading)) + 0.01 * rng.standard_normal(7)
    way = np.append(way + 0.01 * rng.standard_normal(7), rng.uniform(1.0, 9.0, 3))
    bearing = np.append(bearing, rng.uniform(-1.5, 1.5, 3))
    std = np.full(10, 0.01)
    towards = 0.0 if caller is None else np.angle((caller - at) * np.exp(-1j * heading))
    return Rows(bearing, std, way, std, np.ones(10)), np.array([towards, 0.01])


def joint_of(pose, landmarks):
    """Return a surely known map, its landmarks numbered from 1, and pose."""
    mean = np.concatenate([pose, np.stack([landmarks.real, landmarks.imag]).T.ravel()])
    labels = np.arange(1, landmarks.size + 1)
    return JointGaussian(landmark=labels, mean=mean, covariance=1e-4 * np.eye(mean.size))


def detecting(bins):
    """Return a watch whose call detects 9 of 11 old landmarks in the first bins, else none."""
    watch = of_calls(1)
    watch.hits[:, :bins], watch.asked[:] = 9, 10
    return watch


@pytest.mark.parametrize("caller", [None, CALLER])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.7), (1.5, -1.0, 0.0), (-3.0, 2.0, 2.5)])
def test_pose_is_found_again_on_map(rng, caller, off):
    landmarks = rng.uniform(-9.0, 9.0, 12) + 1j * rng.uniform(-9.0, 9.0, 12)
    pose = np.array([0.5, -0.4, 0.3])
    joint = joint_of(pose - off, np.append(landmarks, CALLER))
    at = OWN_CALL if caller is None else joint.mean.size - 2
    heard = (0, *scan_from(rng, pose, landmarks, caller), at)
    found = placed_again(of_calls(1), joint, *PLACES, [heard], CHANCES)
    assert found is not None
    assert found.mean[:3] == pytest.approx(pose, abs=0.15)
    assert np.array_equal(found.mean[3:], joint.mean[3:])


def test_pose_is_not_found_in_clutter(rng):
    landmarks = rng.uniform(-9.0, 9.0, 12) + 1j * rng.uniform(-9.0, 9.0, 12)
    joint, std = joint_of(np.zeros(3), landmarks), np.full(6, 0.01)
    for _ in range(20):
        rows = Rows(rng.uniform(-1.5, 1.5, 6), std, rng.uniform(1.0, 9.0, 6), std, np.ones(6))
        heard = [(0, rows, np.zeros(2), OWN_CALL)]
        assert placed_again(detecting(BINS), joint, *PLACES, heard, CHANCES) is None


@pytest.mark.parametrize("silent", [0.0, 60.0])
def test_pose_is_where_fewer_landmarks_are_missed(rng, silent):
    """Two places have the same landmarks, one has four more; calls reach 16 m."""
    near = rng.uniform(2.0, 9.0, (2, 4)) * np.exp(1j * rng.uniform(-1.0, 1.0, (2, 4)))
    landmarks, std = np.concatenate([near[0], near[0] + 60.0, near[1] + silent]), np.full(4, 0.01)
    rows = Rows(np.angle(near[0]), std, abs(near[0]), std, np.ones(4))
    joint = joint_of(np.array([30.0, 30.0, 1.0]), landmarks)
    heard = (0, rows, np.zeros(2), OWN_CALL)
    found = placed_again(detecting(BINS // 3), joint, *PLACES, [heard], CHANCES)
    assert found is not None
    assert found.mean[:3] == pytest.approx([60.0 - silent, 0.0, 0.0], abs=0.15)


def drive(rng, scans, event, turn=0.0, callers=()):
    """Return a session after a drive on a circle, and the true pose.

    At a scan the vehicle turns unreported, and callers exchange their names.
    """
    landmarks = 9.0 * np.sqrt(rng.uniform(0.1, 1.0, 14)) * np.exp(2j * np.pi * rng.random(14))
    config = Config.model_validate(
        {"association": {"method": "marginal"}, "filter": {"gate": 0.999}}
    )
    motion = Motion(model="unicycle", control_std=(0.02, 0.02))
    start = Gaussian(mean=np.array([4.0, 0.0, np.pi / 2]), covariance=1e-6 * np.eye(3))
    session = Session(
        entry("iekf").build(config, motion), start, rng, association=association_of(config)
    )
    at, heading = 4.0 + 0.0j, np.pi / 2
    for scan in range(scans):
        heading += 0.0625 + turn * (scan == event)
        at += 0.25 * np.exp(1j * (heading - 0.03125))
        session.move(np.array([[0.5, 0.125]]), np.array([0.5]))
        seen = landmarks[abs(landmarks - at) < 9.0]
        points, number, way = [seen], [np.zeros(seen.size, np.int64)], [abs(seen - at)]
        for n, place in enumerate(callers if scan < event else callers[::-1], start=1):
            points.append(np.append(place, seen))
            number.append(np.full(seen.size + 1, n))
            way.append(abs(points[-1] - at) + abs(points[-1] - place) - abs(place - at))
        bearing = np.angle((np.concatenate(points) - at) * np.exp(-1j * heading))
        bearing, number = bearing + 0.01 * rng.standard_normal(bearing.size), np.concatenate(number)
        measured = np.concatenate(way) + 0.02 * rng.standard_normal(bearing.size)
        direct = np.array([-1, *(np.flatnonzero(number == n + 1)[0] for n in range(len(callers)))])
        measured[direct[1:]], own = np.nan, number == 0
        columns = {"range": np.where(own, measured, np.nan), "caller": number}
        columns["excess_path"] = np.where(own, np.nan, measured)
        stds = {"bearing_std": 0.01, "range_std": 0.02, "excess_path_std": 0.02}
        heard = make_scan(0.5 * scan, np.full(number.size, -1), bearing, **columns, **stds)
        session.hear(replace(heard, direct=direct) if callers else heard)
    return session, np.array([at.real, at.imag, heading])


def check_pose(session, truth):
    off = session.belief.pose().mean - truth
    assert np.hypot(*off[:2]) < 0.1
    assert abs(math.remainder(off[2], math.tau)) < 0.03


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_unreported_turn_leaves_map_unchanged(rng, turn):
    session, truth = drive(rng, 60, 40, turn=turn)
    check_pose(session, truth)
    assert len(session.landmarks().landmark) <= 14
    alarms = [(20.0, POSE, True)] if turn else []
    assert session.report()["alarms"] == alarms


def test_callers_that_exchange_names_are_set_aside_and_found_again(rng):
    session, truth = drive(rng, 110, 60, callers=(9.0 - 4.0j, -6.0 + 8.0j))
    check_pose(session, truth)
    assert [*map(tuple, session.report()["alarms"])] == [(30.0, 1, True), (30.0, 2, True)]
    assert len(session.landmarks().landmark) <= 14 + 2, "former positions are left out"
    assert session.report()["trusted_until_s"] is None


def test_memories_keep_their_alarms():
    first = of_calls(1)._replace(alarms=np.array([[3.0, POSE, 0.0]]), lost=2)
    of_calls(2, first).alarms[0, 2] = 1.0
    assert reported(first)["trusted_until_s"] == 3.0
