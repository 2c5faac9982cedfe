"""A mistake in the columns of a log is named, and none is where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.scans import make_scan
from pipistrelle.geometry import wrap
from pipistrelle.scripting.misreadings import misreading
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
