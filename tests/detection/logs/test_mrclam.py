"""MRCLAM sets: a made-up one by hand-counted facts, the real one where it is at hand."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.config import InputError
from pipistrelle.detection.logs.folder import LANDMARKS, read_mrclam
from reference.refused import refusal_of

MADE_UP = Path(__file__).parents[2] / "data" / "mrclam_made_up"


@pytest.fixture
def folder(tmp_path):
    return Path(shutil.copytree(MADE_UP, tmp_path / "set"))


def edited(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return 1 + text[: text.index(old)].count("\n")


def refused(folder, *parts):
    refusal_of(lambda: read_mrclam(folder, 1), *parts)


def test_an_mrclam_log_has_the_settings_of_its_robots():
    log = read_mrclam(MADE_UP, 1)
    assert (log.name, log.motion) == ("mrclam_made_up_robot1", "unicycle")
    assert (log.control_std, log.range_std, log.bearing_std) == ((0.10, 0.15), 0.2, 0.06)
    assert log.noise_at_rest is False
    assert log.initial_pose == (0.0, 0.0, 0.0)


def test_odometry_is_merged_into_tenths_of_a_second():
    log = read_mrclam(MADE_UP, 1)
    assert log.time[0] == 1248440000.123
    np.testing.assert_allclose(log.dt[:-1], 0.1, atol=1e-6)
    assert 0.0 < log.dt[-1] <= 0.1
    assert np.all(log.controls[:8] == 0.0)
    np.testing.assert_allclose(log.controls[10:], [[0.12, 0.4]] * (len(log.dt) - 10), rtol=1e-12)


def test_barcodes_become_subjects_and_columns_their_places():
    scan = read_mrclam(MADE_UP, 1).scans[0]
    rows = np.loadtxt(MADE_UP / "Robot1_Measurement.dat")
    rows = rows[rows[:, 0] == rows[rows[:, 0] > 1248440000.123, 0][0]]
    subject = {barcode: s for s, barcode in np.loadtxt(MADE_UP / "Barcodes.dat")}
    assert scan.landmark.tolist() == [subject[barcode] for barcode in rows[:, 1]]
    assert scan.range.tolist() == rows[:, 2].tolist()
    assert scan.bearing.tolist() == rows[:, 3].tolist()


def test_robots_unknown_barcodes_and_stray_rows_are_dropped_and_counted():
    log = read_mrclam(MADE_UP, 1)
    assert log.ignored_rows == {
        "unknown_barcode": 1,
        "robot_seen": 3,
        "same_time_odometry": 1,
        "outside_odometry": 3,
    }
    kept = sum(len(scan.landmark) for scan in log.scans)
    assert kept + 1 + 3 + 3 == len(np.loadtxt(MADE_UP / "Robot1_Measurement.dat"))
    assert set(np.concatenate([scan.landmark for scan in log.scans])) <= set(LANDMARKS)


def test_a_span_cuts_the_log_at_both_ends():
    whole = read_mrclam(MADE_UP, 1)
    start, end = 1248440001.51, 1248440004.321
    log = read_mrclam(MADE_UP, 1, span=(start, end))
    assert (log.time[0], log.time[-1]) == (start, end)
    assert log.controls[0].tolist() == pytest.approx([0.12, 0.4], rel=1e-12)
    lost = sum(len(s.landmark) for s in whole.scans) - sum(len(s.landmark) for s in log.scans)
    assert log.ignored_rows["outside_odometry"] == 3 + lost > 3


def test_a_span_without_odometry_is_refused():
    message = r"Robot1_Odometry.dat: found times .* between 5.0 and 6.0"
    with pytest.raises(InputError, match=message):
        read_mrclam(MADE_UP, 1, span=(5.0, 6.0))


@pytest.mark.parametrize("name", ["Barcodes.dat", "Robot1_Odometry.dat", "Robot1_Measurement.dat"])
def test_a_missing_or_empty_file_is_named(folder, name):
    (folder / name).write_text("# nothing\n")
    refused(folder, name, "no rows")
    (folder / name).unlink()
    refused(folder, name, "no such file")


def test_a_bad_row_is_refused_by_its_line(folder):
    path = folder / "Robot1_Measurement.dat"
    lines = path.read_text().splitlines()
    time, barcode, *_ = lines[9].split()
    for row, parts in (
        (f"{time} {barcode} 1.0", ("3 fields",)),
        (f"{time} {barcode} nan 0.1", ("range 'nan'",)),
        (f"{time} 1.5 1.0 0.1", ("barcode 1.5", "an integer")),
        (f"5.0 {barcode} 1.0 0.1", ("time 5.0 after", "backwards")),
    ):
        path.write_text("\n".join([*lines[:9], row, *lines[10:]]))
        refused(folder, "Robot1_Measurement.dat, line 10", *parts)


def test_a_landmark_twice_at_one_time_is_refused(folder):
    path = folder / "Robot1_Measurement.dat"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:70], lines[69], *lines[70:]]))
    refused(folder, "Robot1_Measurement.dat, line 71", "landmark", "again", "line 70")


def test_one_barcode_on_two_subjects_is_refused(folder):
    line = edited(folder / "Barcodes.dat", "  3 \t  59", "  3 \t  86")
    refused(folder, f"Barcodes.dat, line {line}", "barcode 86 again", f"line {line - 1}")


def test_more_than_a_twentieth_of_unknown_barcodes_is_refused(folder):
    path = folder / "Robot1_Measurement.dat"
    lines = path.read_text().splitlines()
    rows = [k for k, line in enumerate(lines) if line[0] != "#" and line.split()[1] != "99"]
    total = len(rows) + 1
    allowed = total // 20
    for extra in (allowed - 1, allowed):
        strange = [
            line if k not in rows[:extra] else line.replace(line.split()[1], "98", 1)
            for k, line in enumerate(lines)
        ]
        path.write_text("\n".join(strange))
        if extra < allowed:
            assert read_mrclam(folder, 1).ignored_rows["unknown_barcode"] == allowed
    refused(folder, "line 5", "barcode 98", f"{allowed + 1} unknown barcodes in {total} rows", "5%")


@pytest.mark.parametrize("robot", range(1, 6))
def test_every_row_of_set_6_is_read_or_counted_as_ignored(real, robot):
    log = read_mrclam(real, robot)
    rows = np.loadtxt(real / f"Robot{robot}_Measurement.dat")
    subject = {barcode: s for s, barcode in np.loadtxt(real / "Barcodes.dat")}
    landmarks = sum(subject.get(barcode, 0) >= 6 for barcode in rows[:, 1])
    assert sum(len(scan.landmark) for scan in log.scans) == landmarks
    unread = sum(n for why, n in log.ignored_rows.items() if why != "same_time_odometry")
    assert unread == len(rows) - landmarks
    times = np.loadtxt(real / f"Robot{robot}_Odometry.dat")[:, 0]
    assert (log.time[0], log.time[-1]) == (times[0], times[-1])
    assert len(log.dt) == int(np.ceil((times[-1] - times[0]) / 0.1))
    assert log.ignored_rows.get("same_time_odometry", 0) == np.sum(np.diff(times) == 0)


def test_set_6_odometry_is_driven_in_full(real):
    log = read_mrclam(real, 4)
    rows = np.loadtxt(real / "Robot4_Odometry.dat")
    driven = np.diff(rows[:, 0]) @ rows[:-1, 1:]
    np.testing.assert_allclose(log.dt @ log.controls, driven, rtol=1e-9)
