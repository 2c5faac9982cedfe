"""A mistake in the columns of a log is named, and none is where there is none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config
from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.scans import make_scan
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.geometry import range_and_bearing, wrap
from pipistrelle.scripting.misreadings import misreading, wide_sight
from reference.missions import map_with
from reference.spoilt_logs import DEGREES, SPOILED, noisy_log


@pytest.mark.parametrize("labels", [True, False])
@pytest.mark.parametrize("mistake", SPOILED)
def test_a_mistake_in_the_columns_is_named_and_no_other(mistake, labels):
    words, fits = misreading(noisy_log(spoil=mistake, labels=labels))
    assert mistake in words
    assert not fits


@pytest.mark.parametrize("labels", [True, False])
def test_angular_rates_in_degrees_are_named(labels):
    log = noisy_log(labels=labels)
    words, _ = misreading(replace(log, controls=log.controls * [1.0, DEGREES]))
    assert words.startswith("the odometry seems to turn in degrees")


@pytest.mark.parametrize(
    "conditions",
    [
        {},
        {"labels": False},
        {"labels": False, "clutter": 5},
        {"turn_rate": 0.0},
        {"turn_rate": 0.0, "labels": False},
        {"turn_rate": 0.0, "speed": 0.0},
        {"turn_rate": 0.0, "speed": 0.0, "labels": False},
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_no_mistake_is_named_in_a_sound_log(conditions, seed):
    assert misreading(noisy_log(**conditions, seed=seed)) == ("", True)


@pytest.mark.parametrize("labels", [True, False])
def test_rows_of_nothing_are_explained_by_no_mistake(labels):
    log = noisy_log(labels=labels)
    rng = np.random.default_rng(3)
    bearings = rng.uniform(-1.5, 1.5, log.bearings.size)
    ends = np.cumsum([scan.landmark.size for scan in log.scans])[:-1]
    angles, ranges = np.split(bearings, ends), rng.uniform(0.5, 8.0, bearings.size)
    scans = [
        make_scan(scan.time, scan.landmark, angle, range=distance)
        for scan, angle, distance in zip(log.scans, angles, np.split(ranges, ends), strict=True)
    ]
    words, fits = misreading(replace(log, scans=tuple(scans), bearings=bearings))
    assert (words, fits) == ("", False)


def test_a_straight_drive_says_nothing_of_the_sense_of_bearings():
    words, fits = misreading(noisy_log(turn_rate=0.0, spoil="clockwise:"))
    assert (words, fits) == ("", True)


def test_a_few_scans_name_nothing():
    assert misreading(noisy_log(spoil="clockwise:", steps=50))[0] == ""


def test_bearings_are_kept_as_recorded_before_they_are_wrapped(tmp_path):
    write_log(tmp_path, noisy_log(spoil="in degrees:"))
    file = tmp_path / "measurements.csv"
    header, first, *rows = file.read_text().splitlines()
    time, label, _, *rest = first.split(",")
    file.write_text("\n".join([header, ",".join([time, label, "7.5", *rest]), *rows, ""]))
    log = read_log(tmp_path)
    assert log.recorded_bearings()[0] == 7.5
    assert log.scans[0].bearing[0] == wrap(7.5)


def sight_of(field_of_view, max_range):
    """Questions of a stated sight; the map is right, and rows are heard within 1.57 rad and 8 m."""
    log = noisy_log(labels=True, steps=1200, turn_rate=0.1)
    pose, poses = np.zeros(3), [np.zeros(3)]
    motion = Motion(model="unicycle", control_std=(0.05, 0.05))
    for control in log.controls:
        pose = motion_step(motion, pose, control, 0.1)
        poses.append(pose)
    rng = np.random.default_rng(2)
    places = rng.uniform(-12.0, 12.0, (40, 2)) + np.array([0.0, 5.0])
    scans, labels = [], []
    for k in range(5, 1200, 5):
        r, b = range_and_bearing(poses[k], places)
        heard = np.flatnonzero((np.abs(b) < 0.5 * np.pi) & (r < 8.0) & (rng.random(40) < 0.85))
        scans.append(make_scan(k * 0.1, np.full(heard.size, -1), b[heard], range=r[heard]))
        labels.append(heard)
    landmarks = map_with(np.arange(40), places)
    track = SimpleNamespace(
        pose=Gaussian(mean=np.array(poses), covariance=np.zeros((1201, 3, 3))),
        time=log.time,
        landmarks=landmarks,
        labels=tuple(labels),
    )
    association = AssociationConfig(
        method="marginal", field_of_view=field_of_view, max_range=max_range
    )
    trial = SimpleNamespace(track=track, heard=scans)
    return wide_sight(trial, log, Config(association=association))


@pytest.mark.parametrize(
    ("sight", "asked"),
    [
        ((np.pi, 8.0), []),
        ((3.0, 7.5), []),
        ((np.pi, None), []),
        ((2.0 * np.pi, 8.0), ["field_of_view"]),
        ((np.pi, 16.0), ["max_range"]),
        ((2.0 * np.pi, 16.0), ["field_of_view", "max_range"]),
    ],
)
def test_a_sight_is_questioned_that_is_stated_wider_than_the_rows_of_a_log(sight, asked):
    questions = sight_of(*sight)
    assert [found.split()[0] for found, _ in questions] == [f"association.{name}" for name in asked]
    fits = {"field_of_view": 2.0 * 0.5 * np.pi, "max_range": 8.0}
    for name, (_, question) in zip(asked, questions, strict=True):
        value = float(question.split("does ")[1].split()[0])
        assert value == pytest.approx(fits[name], rel=0.03)
