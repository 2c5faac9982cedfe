"""The stage as a whole: missions without labels against those with, and what is hard for it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config, InputError
from pipistrelle.detection.scans import UNLABELLED, make_scan
from pipistrelle.estimation.beliefs import Gaussian, JointGaussian, placed
from pipistrelle.estimation.catalogue import entry
from pipistrelle.estimation.data_association.existence import LASTING, PATIENCE
from pipistrelle.estimation.data_association.rows import CallerPlace, CallerState, Memory
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.motion import Motion
from pipistrelle.estimation.session import Session
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.figures.mission import _ties
from reference.missions import map_with

MOTION = Motion(model="unicycle", control_std=(0.02, 0.01))
STDS = {"bearing_std": 0.01, "range_std": 0.02}
PLACES = np.array([[4.0, 1.0], [6.0, -3.0], [2.0, 5.0], [9.0, 0.5]])
BEST = {
    "emitter": {"level_db": 49.7},
    "beacon": {"level_db": 42.8},
    "listening": {"excess_paths": True},
    "filter": {"noise": "measured", "robust": "huber"},
    "rays": {"exponent": 8.0, "prune_threshold": 1e-9, "precise_bearings": "auto"},
}


def session_of(name="iekf", method="marginal", known=None, **assumed):
    """Return a session of a vehicle at rest at the origin that is told no labels."""
    config = Config.model_validate(
        {"association": {"method": method}, "filter": {"noise": "measured", **assumed}}
    )
    start = Gaussian(mean=np.zeros(3), covariance=1e-8 * np.eye(3))
    slam = entry(name).build(config, MOTION)
    rng, association = np.random.default_rng(7), association_of(config)
    return Session(slam, start, rng, known=known, association=association)


def arc(k):
    """Return the pose after k + 1 steps of half a second at 0.5 m/s and 0.1 rad/s."""
    angle = 0.05 * (k + 1)
    return 5.0 * np.sin(angle), 5.0 * (1.0 - np.cos(angle)), angle


def scan_of(places, pose=(0.0, 0.0, 0.0), rng=None, time=0.0, level=40.0, **stds):
    """Return what is heard of places, without labels."""
    off = np.atleast_2d(places) - np.array(pose[:2])
    noise = rng.standard_normal((2, len(off))) if rng else np.zeros((2, len(off)))
    bearing = np.arctan2(off[:, 1], off[:, 0]) - pose[2] + 0.01 * noise[0]
    far = np.hypot(off[:, 0], off[:, 1]) + 0.02 * noise[1]
    bearing = (bearing + np.pi) % (2.0 * np.pi) - np.pi
    labels = np.full(len(off), UNLABELLED)
    return make_scan(time, labels, bearing, range=far, level_db=level, **STDS | stds)


@pytest.mark.parametrize("method", ["nearest", "marginal"])
@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother", "fastslam"])
def test_separate_landmarks_keep_their_labels_while_the_vehicle_drives(name, method):
    session, rng = session_of(name, method), np.random.default_rng(3)
    for k in range(12):
        session.move(np.array([[0.5, 0.1]]), np.array([0.5]))
        session.hear(scan_of(PLACES, arc(k), rng, time=float(k)))
    labels = np.array(session.labels)
    assert np.all((labels == [1, 2, 3, 4]) | (labels == UNLABELLED))
    assert np.mean(labels == UNLABELLED) < 0.05
    found = session.landmarks()
    error = np.hypot(*(found.mean[np.argsort(found.landmark)] - PLACES).T)
    assert error.max() < 0.2
    assert {*session.belief.labels()} == {1, 2, 3, 4}


@pytest.mark.parametrize("name", ["ekf", "iekf", "smoother"])
def test_ranges_without_bearings_are_matched_with_the_map_and_begin_nothing(name):
    session, rng, right = session_of(name), np.random.default_rng(4), []
    for k in range(40):
        session.move(np.array([[0.5, 0.1]]), np.array([0.5]))
        order = np.arange(4) if k < 6 else rng.permutation(4)
        heard, nothing = scan_of(PLACES[order], arc(k), rng, time=float(k)), np.full(5, np.nan)
        if k >= 6:  # the last row is of nothing
            far, right = np.append(heard.range, 25.0), [*right, *(order + 1), UNLABELLED]
            heard = make_scan(k, np.full(5, UNLABELLED), nothing, range=far, range_std=0.02)
        session.hear(heard)
    found = np.concatenate(session.labels[6:])
    assert np.all((found == right) | (found == UNLABELLED))
    assert np.mean(found == right) > 0.9
    assert {*session.belief.labels()} == {1, 2, 3, 4}
    assert np.hypot(*(session.belief.pose().mean[:2] - arc(39)[:2])) < 0.05


def test_a_landmark_measured_once_is_not_mapped_and_is_forgotten():
    session = session_of()
    session.hear(scan_of(np.vstack([PLACES, [[-5.0, -5.0]]])))
    assert session.landmarks().landmark.size == 0, "nothing is sure yet"
    for _ in range(PATIENCE + 2):
        session.hear(scan_of(PLACES))
    assert sorted(session.landmarks().landmark.tolist()) == [1, 2, 3, 4]
    assert 5 not in session.belief.labels()
    assert session.labels[0].tolist() == [1, 2, 3, 4, UNLABELLED], "its row is taken back"


@pytest.mark.parametrize(
    ("std", "scans"), [(0.01, 3), (0.032, 3), (0.045, 4), (0.051, None), (0.07, 4)]
)
def test_less_precise_bearings_need_more_scans_to_make_a_landmark(std, scans):
    session = session_of(bearing_std=0.07)  # what is only assumed is beyond no limit
    counts = []
    for _ in range(6):
        session.hear(scan_of(PLACES, bearing_std=std))
        counts.append(session.landmarks().landmark.size)
    assert counts == [0 if scans is None or k < scans else 4 for k in range(1, 7)]


def test_a_vanished_landmark_is_removed_and_a_new_landmark_added():
    session, there = session_of(), np.vstack([PLACES, [[3.5, -1.0]]])
    for _ in range(8):
        session.hear(scan_of(there))
    for _ in range(40):
        session.hear(scan_of(PLACES))
    assert sorted(session.landmarks().landmark.tolist()) == [1, 2, 3, 4]
    for _ in range(4):
        session.hear(scan_of(np.vstack([PLACES, [[-3.0, -4.0]]])))
    assert len(session.landmarks().landmark) == 5


@pytest.mark.parametrize("name", ["iekf", "smoother", "fastslam"])
def test_known_landmarks_stay_and_no_other_has_their_labels(name):
    session = session_of(name, known=map_with([1, 7], PLACES[:2], [1e-6 * np.eye(2)] * 2))
    for _ in range(4):
        session.hear(scan_of(PLACES))
    assert session.labels[-1].tolist() == [1, 7, 8, 9]
    for _ in range(2 * PATIENCE):
        session.hear(scan_of(PLACES[1:2]))
    assert {1, 7} <= {*session.landmarks().landmark.tolist()}
    for _ in range(100):
        session.hear(scan_of(PLACES[:2]))
    assert {1, 7, 8} == {*session.landmarks().landmark.tolist()}, "9 is ahead as 1 is, 8 aside"


@pytest.mark.parametrize("name", ["iekf", "smoother", "fastslam"])
def test_stated_labels_are_kept_and_name_landmarks_mapped_before(name):
    session = session_of(name)
    for given in ([-1] * 4, [-1] * 4, [40, -1, -1, 41], [-1] * 4, [-1, -1, 42, 40]):
        used = replace(scan_of(PLACES), landmark=np.array(given))
        session.hear(used)
    assert [labels.tolist() for labels in session.labels[:4]] == [[40, 2, 3, 41]] * 4
    assert session.labels[-1].tolist() == [-1, -1, 42, 40], "most stated rows misfit"
    assert 1 not in session.belief.labels()


def test_a_second_row_of_a_stated_rows_landmark_is_unlabelled():
    session = session_of()
    for given in ([-1] * 4, [7, -1, -1, -1], [-1] * 4):
        session.hear(replace(scan_of(PLACES), landmark=np.array(given)))
    near = np.vstack([PLACES[:2], PLACES[:1] + 0.01])
    session.hear(replace(scan_of(near), landmark=np.array([7, -1, -1])))
    assert session.labels[-1].tolist() == [7, 2, -1]


def test_a_stated_label_of_an_unstated_landmark_is_refused():
    session = session_of()
    session.hear(scan_of(PLACES))
    with pytest.raises(InputError, match=r"found the label 2, .* add a number to yours"):
        session.hear(replace(scan_of(PLACES), landmark=np.array([-1, 2, -1, -1])))


@pytest.mark.parametrize("name", ["iekf", "smoother", "fastslam"])
def test_an_often_measured_landmark_keeps_its_label_through_a_silence(name):
    session, there = session_of(name), np.vstack([PLACES, [[3.5, -1.0]]])
    for _ in range(LASTING):
        session.hear(scan_of(there))
    for _ in range(100):
        session.hear(scan_of(PLACES))
    assert sorted(session.landmarks().landmark.tolist()) == [1, 2, 3, 4]
    assert 5 in session.belief.labels(), "what it told of the way stays"
    for _ in range(4):
        session.hear(scan_of(there))
    assert session.labels[-1].tolist() == [1, 2, 3, 4, 5]
    assert sorted(session.landmarks().landmark.tolist()) == [1, 2, 3, 4, 5]


def test_two_landmarks_within_a_call_are_separated_once_both_are_measured():
    near = np.vstack([PLACES, PLACES[0] + [0.0, 1.2]])
    session, rng = session_of(), np.random.default_rng(0)
    for _ in range(10):
        session.hear(scan_of(near, rng=rng))
    assert len(session.landmarks().landmark) == 5
    assert len({tuple(label.tolist()) for label in session.labels[3:]}) == 1


@pytest.mark.parametrize("both", [True, False])
def test_two_very_close_landmarks_stay_two_despite_missed_detections(both):
    near = np.vstack([PLACES, PLACES[0] + [0.0, 0.3]])
    session, rng = session_of(), np.random.default_rng(5)
    for k in range(24):
        silent = [] if both else [(0, 4)[rng.integers(2)]]
        session.move(np.array([[0.5, 0.1]]), np.array([0.5]))
        session.hear(scan_of(np.delete(near, silent, axis=0), arc(k), rng, time=float(k)))
    found = session.landmarks().mean
    assert len(found) == 5
    off = np.hypot(*(found[:, np.newaxis] - near).transpose(2, 0, 1))
    assert off.min(axis=0).max() < 0.05


@pytest.mark.parametrize("name", ["iekf", "smoother"])
def test_a_vehicle_that_starts_without_landmarks_maps_later_landmarks(name):
    session, rng, nothing = session_of(name), np.random.default_rng(1), np.empty((0, 2))
    for k in range(60):
        session.move(np.array([[0.5, 0.1]]), np.array([0.5]))
        there = PLACES if k >= 40 else nothing  # 20 s of silence
        session.hear(scan_of(there, arc(k), rng, time=0.5 * k))
    assert [label.tolist() for label in session.labels[40:]] == [[1, 2, 3, 4]] * 20
    off = session.landmarks().mean - PLACES
    assert np.abs(off).max() < 0.05
    assert np.sqrt(np.trace(session.belief.pose().covariance[:2, :2])) > 0.1, "it was silent"


def test_bearings_around_pi_belong_to_one_landmark():
    session = session_of()
    for y in (-0.05, 0.05, -0.05, 0.05):
        session.hear(scan_of(np.array([[-5.0, y]])))
    assert [label.tolist() for label in session.labels] == [[1]] * 4


def test_a_retracted_landmark_leaves_no_trace_in_the_belief():
    ghost, beliefs = np.array([[-6.0, 2.0]]), []
    for haunted in (False, True):
        session = session_of()
        for k in range(PATIENCE + 6):
            places = np.vstack([PLACES, ghost + 0.02 * k]) if haunted and k in (2, 3) else PLACES
            session.move(np.array([[0.2, 0.0]]), np.array([0.1]))
            session.hear(scan_of(places, (0.02 * (k + 1), 0.0, 0.0), time=float(k)))
        beliefs.append(session.belief)
    np.testing.assert_allclose(beliefs[1].mean, beliefs[0].mean, atol=1e-12)
    np.testing.assert_allclose(beliefs[1].covariance, beliefs[0].covariance, atol=1e-14)


def test_a_scan_without_rows_is_accepted():
    session = session_of()
    none = replace(
        scan_of(PLACES[:1]), landmark=np.empty(0, np.int64), caller=np.empty(0, np.int64)
    )
    session.hear(replace(none, numbers=np.empty((8, 0))))
    session.hear(scan_of(PLACES))
    assert session.labels[0].size == 0


@pytest.mark.parametrize(
    ("name", "steps", "missed"),
    [
        ("ekf", 200, 13),
        pytest.param("ekf", 480, 8, marks=pytest.mark.slow),
        pytest.param("fastslam", 480, 16, marks=pytest.mark.slow),
    ],
)
def test_a_filter_with_constant_noise_finds_its_caller_by_measured_noise(name, steps, missed):
    """Of 20 rows of a frame 0.15 rad and 0.4 m say little, and an association has no use for it."""
    settings = BEST | {"scenario": {"steps": steps}, "seed": 7}
    noise = {"filter": {"noise": "constant", "robust": "huber"}}
    config = Config.model_validate(settings | noise | {"association": {"method": "marginal"}})
    (trial,) = run_mission(config, ["fused"], [name]).trials
    assert len({label for scan in trial.scans for label in scan.callers.tolist()}) == 2
    assert trial.scores.associated_right > 0.95
    assert trial.scores.landmarks_missed <= missed, "FastSLAM uses no excess paths"
    given = np.concatenate([scan.bearing_std[~np.isnan(scan.range)] for scan in trial.scans])
    assert np.mean(given == config.filter.bearing_std) > 0.9, "the filter is told the paper's"


def test_associate_changes_nothing_that_it_is_given():
    session = session_of()
    stage = association_of(Config(association=AssociationConfig(method="nearest")))
    session.hear(scan_of(PLACES))
    memory = stage.start()
    scan = scan_of(PLACES)
    numbers = scan.numbers.copy()
    first = stage.associate(memory, session.belief, scan)[1]
    again = stage.associate(memory, session.belief, scan)[1]
    assert first.label.tolist() == again.label.tolist()
    np.testing.assert_array_equal(scan.numbers, numbers)
    assert (memory.scan, memory.labels, memory.known.label.size) == (0, 0, 0)


def test_a_found_caller_is_measured_by_its_range_and_bearing():
    joint = JointGaussian(landmark=np.empty(0, int), mean=np.zeros(3), covariance=0.01 * np.eye(3))
    stage = association_of(Config(association=AssociationConfig(method="marginal")))
    place = CallerPlace(6.0, 8.0, std=0.07)
    memory = Memory(labels=1, callers={1: CallerState(label=1, place=place)})
    heard = make_scan(0.0, np.full(1, UNLABELLED), np.full(1, 0.9), caller=np.ones(1, int), **STDS)
    scan = replace(heard, direct=np.array([-1, 0]))
    _, assignment = stage.associate(memory, SimpleNamespace(joint=lambda: joint), scan)
    told = assignment.scan
    assert assignment.label.tolist() == [1]
    assert told.range[0] == pytest.approx(10.0)
    assert told.range_std[0] == pytest.approx(10.0 * 0.07)
    assert (told.bearing[0], told.bearing_std[0]) == (0.9, STDS["bearing_std"])


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["active", "fused", "passive"])
def test_missions_without_labels_are_about_as_good_as_with_them(strategy):
    raw, aligned, right = [], [], []
    for seed in range(900, 908):
        known, found = (
            run_mission(
                Config.model_validate(BEST | {"seed": seed, "association": {"method": method}}),
                [strategy], ["iekf"],
            ).trials[0].scores
            for method in ("known", "marginal")
        )  # fmt: skip
        raw.append((found.position_rmse_m, known.position_rmse_m))
        aligned.append((found.position_rmse_aligned_m, known.position_rmse_aligned_m))
        right.append(found.associated_right)
    assert np.mean(right) > 0.96
    found, known = np.median(np.array(aligned), axis=0)
    assert found < 1.6 * known
    found, known = np.median(np.array(raw), axis=0)
    assert found < 1.5 * known


def test_a_mission_without_labels_finds_its_caller_and_names_most_rows_rightly():
    config = Config.model_validate(
        BEST | {"scenario": {"steps": 480}, "seed": 7, "association": {"method": "marginal"}}
    )
    mission = run_mission(config, ["fused"], ["iekf"])
    (trial,) = mission.trials
    assert trial.scores.associated_right > 0.95
    assert trial.scores.position_rmse_aligned_m < 0.1
    assert trial.scores.landmarks_missed <= 4
    named = {label for scan in trial.scans for label in scan.callers.tolist()} - {UNLABELLED}
    assert len(named) == 1, "the caller has one name"
    sure = placed(trial.track.landmarks)
    assert {*trial.track.landmarks.landmark[sure].tolist()} & named
    lines = _ties(trial, mission.drive.truth.landmarks)
    assert len(lines) > 20
    assert np.median([np.hypot(*(a - b)) for a, b in lines]) < 1.0, "each to its own landmark"


MOVER = {"course": "circle", "radius": 15.0, "speed": 0.75}


@pytest.mark.parametrize("name", ["iekf", "smoother"])
def test_a_caller_that_moves_is_found_and_followed_without_labels(name):
    config = Config.model_validate(
        BEST
        | {"scenario": {"steps": 240}, "seed": 6304, "association": {"method": "marginal"}}
        | {"callers": [{"distance": 12.0}, MOVER | {"name": "boat", "frequency": 25e3}]}
    )
    mission = run_mission(config, ["fused"], [name])
    (trial,) = mission.trials
    assert trial.scores.associated_right > 0.95
    assert trial.scores.position_rmse_aligned_m < 0.1
    assert {*trial.track.callers} == {*mission.drive.moving}, "by the name of the truth"
    assert trial.scores.caller_rmse_aligned_m < 0.5
    named = [{*scan.callers.tolist()} - {UNLABELLED} for scan in trial.scans]
    moving = {label for scan in trial.scans for label in scan.moving.tolist()}
    assert len(set().union(*named)) == 2
    assert len(moving) == 1
    assert not moving & {*trial.track.landmarks.landmark.tolist()}, "it is no landmark"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6302, 6306])
def test_a_caller_that_turns_at_once_does_not_lose_the_world(seed):
    """Both walks bounce off the edge of the field."""
    settings = {
        "seed": seed,
        "callers": [{"course": "walk"}],
        "association": {"method": "marginal"},
    }
    (trial,) = run_mission(Config.model_validate(BEST | settings), ["fused"], ["iekf"]).trials
    assert trial.scores.position_rmse_aligned_m < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7001, 7002, 7003])
def test_no_world_of_four_hundred_landmarks_is_lost(seed):
    crowded = {"seed": seed, "scenario": {"landmarks": 400, "spacing": 1.5, "radius": 40.0}}
    known, found = (
        run_mission(
            Config.model_validate(BEST | crowded | {"association": {"method": method}}),
            ["fused"], ["iekf"],
        ).trials[0].scores
        for method in ("known", "marginal")
    )  # fmt: skip
    assert found.position_rmse_aligned_m < 3.0 * known.position_rmse_aligned_m
    assert found.associated_right > 0.94


@pytest.mark.parametrize("method", ["nearest", "marginal"])
def test_a_scan_of_two_thousand_rows_begins_as_many_landmarks(method):
    rng = np.random.default_rng(4)
    places = rng.permutation(2000)[:, None] * np.array([0.0, 0.5]) + np.array([5.0, -500.0])
    session = session_of("iekf", method)
    session.hear(scan_of(places))
    assert np.unique(session.labels[-1]).size == 2000
