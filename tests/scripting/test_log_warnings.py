"""Warnings on recorded logs, and the mistakes that explain rows that do not fit."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipistrelle.config import Config
from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.scans import make_scan
from pipistrelle.experiments.drives import NO_TRUTH
from pipistrelle.geometry import wrap
from pipistrelle.scripting.log_warnings import fit_warnings, log_warnings, misreading
from reference.missions import map_with, scan_with
from reference.spoilt_logs import DEGREES, SPOILED, noisy_log

LOG = noisy_log(steps=5)


def log_of(**columns):
    """A log of one scan of ten rows, from half a metre to 20 m."""
    return replace(LOG, scans=(scan_with(np.arange(10), np.zeros(10), **columns),))


def warnings_of(log, *trials):
    """The warnings about a log of 10 rows, unless another is given, and its estimates."""
    return fit_warnings(log or log_of(distance=np.ones(10)), trials, Path("log"), Config())


def trial_of(scan, gated, labels=(), **more):
    track = SimpleNamespace(
        pose=SimpleNamespace(mean=np.zeros((2, 3))),
        labels=labels,
        landmarks=map_with([1, 1]),
        report={},
        corrections=(0.0, 0.0),
    )
    scores = SimpleNamespace(gated=gated, nis_mean=None)
    return SimpleNamespace(
        scans=[scan], scores=scores, filter="ekf", strategy="active", track=track,
        **{"heard": [scan], "left_out": {}} | more,
    )  # fmt: skip


@pytest.mark.parametrize(("gated", "asked"), [(1, False), (2, True)])
def test_units_are_questioned_by_the_share_of_gated_measurements(gated, asked):
    heard = scan_with(np.arange(5), np.zeros(5), np.ones(5))
    lines = warnings_of(None, trial_of(heard, gated))
    assert any(f"{gated} of 5 measurements do not fit" in line for line in lines) == asked
    assert len(lines) == 1, "else it is said that the gate rejects more than its share"


@pytest.mark.parametrize(("mapped", "asked"), [(5, False), (4, True)])
def test_units_are_asked_about_where_few_rows_of_an_association_are_on_the_map(
    monkeypatch, mapped, asked
):
    unexplained = lambda log: ("", False)  # noqa: E731
    monkeypatch.setattr("pipistrelle.scripting.log_warnings.misreading", unexplained)
    labels = (np.where(np.arange(10) < mapped, 1, -1),)
    log = log_of(distance=np.ones(10))
    lines = warnings_of(log, trial_of(log.scans[0], 0, labels))
    assert [line.split(" (")[0] for line in lines] == [
        "log: 4 of 10 rows are of landmarks of the map at the end"
    ] * asked


@pytest.mark.parametrize(
    ("call", "repaired", "words"),
    [
        (-1, True, ["where the odometry leads", "found again", "skid", "less precise"]),
        (-1, False, ["where the odometry leads", "not to be trusted", "skid"]),
        (0, False, ["other calls' paths do", "not to be trusted", "range setting"]),
        (1, True, ["by 'mate'", "searched for again", "its name given to another"]),
    ],
)
def test_warning_names_time_and_cause_of_an_alarm(call, repaired, words):
    mate = SimpleNamespace(name="mate", moves=False)
    log = replace(log_of(distance=np.ones(10)), callers=(mate,))
    trial = trial_of(log.scans[0], 0, (np.ones(10, int),))
    trial.track.report = {"alarms": [(4.5, call, repaired), (7.0, call, repaired)]}
    (line,) = warnings_of(log, trial)
    assert "from 4.5, 7 s on" in line
    assert all(word in line for word in words)


def test_few_rows_on_the_map_are_no_question_in_a_log_of_few_scans():
    log = log_of(distance=np.ones(10))
    assert warnings_of(log, trial_of(log.scans[0], 0, (np.full(10, -1),))) == []


def test_few_rows_on_the_map_are_no_question_where_the_columns_of_a_log_are_right():
    log = noisy_log(labels=False)
    trial = trial_of(log.scans[0], 0, tuple(np.full(scan.landmark.size, -1) for scan in log.scans))
    assert warnings_of(log, trial) == []
    spoilt = noisy_log(labels=False, spoil="clockwise:")
    (line,) = warnings_of(spoilt, trial)
    assert "0 of " in line
    assert "bearings seem to be clockwise: negated" in line


@pytest.mark.parametrize("name", ["initial_pose", "sensor_pose"])
@pytest.mark.parametrize(("heading", "asked"), [(45.0, True), (-7.0, True), (6.2, False)])
def test_a_heading_beyond_a_turn_is_asked_about(name, heading, asked):
    lines = log_warnings(replace(LOG, **{name: (1.0, 2.0, heading)}), NO_TRUTH, Path("log"))
    words = f"log: the heading of {name}, {heading:g} rad, is beyond a turn; is it in degrees?"
    assert [line.startswith(words) for line in lines] == [True] * asked


@pytest.mark.parametrize(("short", "asked"), [(8, False), (9, True)])
def test_short_excess_paths_are_asked_about_where_nearly_all_are(short, asked):
    excess_path = np.where(np.arange(10) < short, 0.19, 3.0)
    lines = warnings_of(log_of(excess_path=excess_path, excess_path_std=0.1, caller=1))
    words = f"{short} of 10 excess paths are below 0.2 m"
    assert [words in line for line in lines] == [True] * asked


NOTHING = scan_with(np.arange(0), np.zeros(0), np.zeros(0))


@pytest.mark.parametrize("rows", [0, 5])
def test_missing_measurements_are_reported_only_for_empty_scans(rows):
    heard = scan_with(np.arange(rows), np.zeros(rows), np.ones(rows))
    trial = trial_of(NOTHING, 0, heard=[heard])
    (line,) = warnings_of(None, trial)
    assert ("nothing in it is heard by active sensing" in line) == (not rows)
    assert ("none of the 5 rows of active sensing is of a landmark" in line) == (rows == 5)


@pytest.mark.parametrize(
    ("left_out", "parts"),
    [
        ({"bearing_std": [0.0866] * 3}, ("3 rows of active", "0.087 rad, is above", "-std 0.09 ")),
        ({"bearing_std": [0.06, 0.3]}, ("0.06 to 0.3 rad", "--association.max-angle-std 0.3 ")),
        ({"bearing_std": [0.06, 1.4]}, ("0.06 to 1.4 rad", "angle-std 0.06 takes 1 of them")),
        ({"bearing_std": [1.4]}, ("1 rows", "association.max_angle_std, 0.05 rad")),
        ({"way_std": [0.4, 12.1]}, ("of their ranges, 0.4 to 12 m", "on.max-range-std 20 ")),
    ],
)
def test_discarded_rows_are_reported_with_a_sufficient_limit(left_out, parts):
    trial = trial_of(NOTHING, 0, left_out={k: np.array(v) for k, v in left_out.items()})
    *_, line = warnings_of(None, trial, trial)
    for part in parts:
        assert part in line
    ((_, stds),) = left_out.items()
    assert ("takes" in line) == (min(stds) < 0.45)


def test_the_share_of_measurements_that_do_not_fit_is_of_bearings_and_excess_paths():
    rows = {"excess_path": np.full(5, 2.0), "excess_path_std": 0.1, "caller": 1}
    heard = scan_with(np.arange(5), np.zeros(5), **rows)
    said = [warnings_of(None, trial_of(heard, gated)) for gated in (2, 8)]
    assert "the gate rejects 20.0% of the measurements" in said[0][0]
    assert "8 of 10 measurements do not fit" in said[1][0]


@pytest.mark.parametrize("labels", [True, pytest.param(False, marks=pytest.mark.slow)])
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
@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
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


def test_a_straight_drive_does_not_decide_the_sense_of_bearings():
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
