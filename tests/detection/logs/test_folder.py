"""The log format, rule by rule: what is read, what is dropped, what is refused and how."""

import os
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipistrelle.config import InputError
from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.logs.recording import Log
from pipistrelle.detection.logs.vehicle import vehicle_of
from pipistrelle.detection.scans import Scan, with_columns
from reference.missions import scan_with
from reference.refused import FORM, refusal_of

DATA = Path(__file__).parents[2] / "data"
UNICYCLE = """\
format = 1
motion = "unicycle"
initial_pose = [1.0, -2.0, 0.5]
initial_pose_std = [0.05, 0.06, 0.04]
velocity_std = 0.1
angular_rate_std = 0.15
range_std = 0.2
bearing_std = 0.06
range_bounds = [0.5, 20.0]
"""
BICYCLE = UNICYCLE.replace("unicycle", "bicycle").replace("velocity", "speed")
BICYCLE = BICYCLE.replace("angular_rate", "steering") + "wheelbase = 0.3\n"
ODOMETRY = "time,velocity,angular_rate\n0.0,1.0,0.1\n0.1,2.0,0.2\n0.3,3.0,0.3\n0.4,9.0,9.0\n"
NAN, STATED = np.nan, ",bearing_std,range_std"
MEASUREMENTS = "time,landmark,bearing,range\n0.1,7,0.5,4.0\n0.1,3,-0.5,\n0.25,7,0.4,3.5\n"


@pytest.fixture
def folder(tmp_path):
    return recorded(tmp_path / "drive")


def recorded(folder, settings=UNICYCLE, odometry=ODOMETRY, measurements=MEASUREMENTS):
    folder.mkdir(exist_ok=True)
    (folder / "log.toml").write_text(settings)
    (folder / "odometry.csv").write_text(odometry)
    (folder / "measurements.csv").write_text(measurements)
    return folder


def measured(*rows, stated=""):
    return "\n".join(["time,landmark,bearing,range" + stated, *rows, ""])


def same(first, second):
    """Whether two records agree bit for bit, NaN with NaN."""
    if type(first) is not type(second):
        return False
    if isinstance(first, Log | Scan):
        return all(same(getattr(first, f.name), getattr(second, f.name)) for f in fields(first))
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and np.array_equal(
            first, second, equal_nan=first.dtype.kind == "f"
        )
    return first == second


def refused(folder, *parts):
    return refusal_of(lambda: read_log(folder), *parts, form=rf"^[^\n]*{FORM}$")


# What is read


def test_a_row_holds_until_the_next_and_the_last_only_ends_the_log(folder):
    log = read_log(folder)
    assert log.time.tolist() == [0.0, 0.1, 0.3, 0.4]
    assert log.controls.tolist() == [[1.0, 0.1], [2.0, 0.2], [3.0, 0.3]]
    assert log.dt.tolist() == [0.1, 0.3 - 0.1, 0.4 - 0.3]


def test_settings_come_from_the_file_and_the_name_from_the_folder(folder):
    log = read_log(folder)
    assert (log.name, log.motion, log.control_std) == ("drive", "unicycle", (0.1, 0.15))
    assert (log.initial_pose, log.initial_pose_std) == ((1.0, -2.0, 0.5), (0.05, 0.06, 0.04))
    assert (log.range_std, log.bearing_std, log.range_bounds) == (0.2, 0.06, (0.5, 20.0))
    assert (log.gate, log.noise_at_rest, log.ignored_rows) == (None, True, {})


def test_a_bicycle_log_has_a_wheelbase_speed_and_steering(tmp_path):
    header = ODOMETRY.replace("velocity,angular_rate", "speed,steering")
    log = read_log(recorded(tmp_path, BICYCLE, header))
    assert (log.motion, log.wheelbase, log.control_std) == ("bicycle", 0.3, (0.1, 0.15))
    assert log.controls[0].tolist() == [1.0, 0.1]


def test_optional_settings_are_read_and_may_be_whole_numbers(tmp_path):
    more = "gate = 0.99\nnoise_at_rest = false\nsensor_pose = [3.8, 0.5, 0.1]\n"
    more += "[association]\ndetection = 1\nclutter = 0.01\n"
    settings = UNICYCLE.replace("range_std = 0.2", "range_std = 2") + more
    log = read_log(recorded(tmp_path, settings))
    assert (log.gate, log.noise_at_rest, log.range_std) == (0.99, False, 2.0)
    assert log.sensor_pose == (3.8, 0.5, 0.1)
    assert log.association == {"detection_rate": 1.0, "clutter_rate": 0.01}


def test_rows_of_one_time_are_one_scan_and_an_empty_range_is_passive(folder):
    first, second = read_log(folder).scans
    assert first.landmark.tolist() == [7, 3]
    assert first.bearing.tolist() == [0.5, -0.5]
    assert first.range[0] == 4.0
    assert np.isnan(first.range[1])
    assert (first.time, second.time) == (0.1, 0.25)
    assert first.landmark.dtype.kind == "i"


def test_scans_keep_their_times_inside_steps(tmp_path):
    after = np.nextafter(0.1, 1.0).item()
    times = [0.0, 1e-300, 0.1, after, 0.3, 0.4]
    rows = measured(*(f"{time!r},{k},0,1" for k, time in enumerate(times)))
    assert [scan.time for scan in read_log(recorded(tmp_path, measurements=rows)).scans] == times


def test_bearings_are_wrapped_below_pi(tmp_path):
    rows = [f"0.1,1,{np.pi!r},1", f"0.1,2,{-np.pi!r},1", "0.1,3,4.0,1", "0.1,4,-9.0,1"]
    bearing = read_log(recorded(tmp_path, measurements=measured(*rows))).scans[0].bearing
    assert bearing[:2].tolist() == [-np.pi, -np.pi]
    np.testing.assert_allclose(bearing[2:], [4.0 - 2 * np.pi, -9.0 + 2 * np.pi], rtol=1e-15)


# How sure a measurement is


@pytest.mark.parametrize(
    ("stated", "rows", "bearing_std", "range_std"),
    [
        ("", ["0.1,7,0.5,4", "0.1,3,0.2,"], [NAN, NAN], [NAN, NAN]),
        (",bearing_std", ["0.1,7,0.5,4,0.01", "0.1,3,0.2,,"], [0.01, NAN], [NAN, NAN]),
        (",range_std", ["0.1,7,0.5,4,", "0.1,3,0.2,4,0.3"], [NAN, NAN], [NAN, 0.3]),
        (STATED, ["0.1,7,0.5,4,0.01,0.3", "0.1,3,0.2,4,,"], [0.01, NAN], [0.3, NAN]),
        (STATED, ["0.1,7,0.5,4,1,2", "0.1,3,0.2,5,3,4"], [1, 3], [2, 4]),
    ],
)
def test_rows_may_state_their_standard_deviations(tmp_path, stated, rows, bearing_std, range_std):
    (scan,) = read_log(recorded(tmp_path, measurements=measured(*rows, stated=stated))).scans
    np.testing.assert_array_equal(scan.bearing_std, bearing_std)
    np.testing.assert_array_equal(scan.range_std, range_std)
    assert scan.landmark.tolist() == [7, 3]


def test_stated_deviations_stay_with_their_rows_when_others_are_dropped(tmp_path):
    rows = [
        "0.1,-1,0,1,0.1,",
        "0.1,7,0,,0.2,0.3",
        "0.1,-1,0,1,0.1,",
        "0.3,8,0,1,0.3,",
        "0.3,-1,0,1,0.4,",
        "9,8,0,1,0.5,",
    ]
    log = read_log(recorded(tmp_path, measurements=measured(*rows, stated=STATED)))
    assert [scan.bearing_std.tolist() for scan in log.scans] == [[0.2], [0.3]]
    assert np.isnan(log.scans[0].range).all()
    assert log.ignored_rows == {"clutter": 3, "outside_odometry": 1}


# Merged steps


def merged(tmp_path, step, odometry=ODOMETRY, measurements=MEASUREMENTS):
    return read_log(recorded(tmp_path, UNICYCLE + f"step = {step}\n", odometry, measurements))


def test_merged_controls_are_time_weighted_means_and_the_last_step_may_be_short(tmp_path):
    log = merged(tmp_path, 0.25)
    np.testing.assert_allclose(log.time, [0.0, 0.25, 0.4], rtol=1e-15)
    by_hand = [(0.1 * 1 + 0.15 * 2) / 0.25, (0.05 * 2 + 0.1 * 3) / 0.15]
    np.testing.assert_allclose(log.controls[:, 0], by_hand, rtol=1e-14)
    np.testing.assert_allclose(log.controls[:, 1], np.array(by_hand) / 10, rtol=1e-14)


def test_merging_steps_keeps_the_distance_driven(tmp_path):
    log = merged(tmp_path, 0.07)
    driven = log.dt @ log.controls
    np.testing.assert_allclose(driven, [0.1 * 1 + 0.2 * 2 + 0.1 * 3, 0.08], rtol=1e-14)


def test_merged_steps_start_at_the_first_row_and_fill_the_log(tmp_path):
    rows = "".join(f"{100 + i / 50!r},1,0\n" for i in range(151))
    log = merged(tmp_path, 0.3, "time,velocity,angular_rate\n" + rows, measured("101,1,0,1"))
    assert len(log.dt) == 10
    np.testing.assert_allclose(log.dt, 0.3, rtol=1e-12)
    assert log.time[-1] == 103.0


def test_a_merged_step_of_rows_at_rest_is_exactly_zero(tmp_path):
    rows = "".join(f"{1e9 + 0.017 * i:.3f},{0.0 if i < 40 else 0.3},0\n" for i in range(80))
    measurements = measured("1000000000.5,1,0,1")
    log = merged(tmp_path, 0.1, "time,velocity,angular_rate\n" + rows, measurements)
    assert np.all(log.controls[:6] == 0.0)
    assert np.all(log.controls[7:, 0] > 0.0)


@pytest.mark.parametrize("start", [0.0, 100.0, 1248444187.156])
@pytest.mark.parametrize("step", [0.1, 0.3, 0.7])
def test_a_measurement_at_the_end_of_a_merged_step_belongs_to_it(tmp_path, start, step):
    times = [round(start + k * step, 3) for k in range(1, 15)]
    rows = "".join(f"{start + i * 0.05:.3f},1,0\n" for i in range(300))
    ends = [f"{t},{k},0,1" for k, t in enumerate(times, 1)]
    log = merged(tmp_path, step, "time,velocity,angular_rate\n" + rows, measured(*ends))
    used = [np.flatnonzero(log.time == scan.time).item() for scan in log.scans]
    assert used == list(range(1, 15))


def test_times_and_the_ends_of_merged_steps_are_compared_to_a_microsecond(tmp_path):
    odometry = "time,velocity,angular_rate\n0,1,0\n0.30000000000000004,1,0\n"
    rows = measured("0.1000001,1,0,1", "0.100002,2,0,1", "0.2,3,0,1")
    log = merged(tmp_path, 0.1, odometry, rows)
    assert len(log.dt) == 3
    assert [scan.time for scan in log.scans] == [log.time[1], 0.100002, log.time[2]]


# What is dropped, with a count


def test_measurements_outside_the_odometry_are_dropped_and_counted(tmp_path):
    odometry = "time,velocity,angular_rate\n0,1,0\n1,1,0\n"
    rows = ["-0.1,1,0,1", "-0.1,2,0,1", "0,1,0,1", "1,1,0,1", "1.01,1,0,1"]
    log = read_log(recorded(tmp_path, odometry=odometry, measurements=measured(*rows)))
    assert log.ignored_rows == {"outside_odometry": 3}
    assert [scan.time for scan in log.scans] == [0.0, 1.0]


@pytest.mark.parametrize(
    ("late", "used"), [(0.05, [0.04, 0.05, 0.15]), (-0.05, [0.09, 0.15, 0.25])]
)
def test_a_sensors_clock_offset_is_corrected_to_the_odometrys_clock(tmp_path, late, used):
    settings = UNICYCLE.replace("range_std", f"time_offset = {late}\nrange_std", 1)
    times = (0.04 + max(late, 0.0), 0.1, 0.2)
    rows = measured(*(f"{time},{label},0,1" for label, time in enumerate(times)))
    log = read_log(recorded(tmp_path, settings, measurements=rows))
    assert [scan.time for scan in log.scans] == pytest.approx(used)
    write_log(tmp_path / "again", log)
    again = read_log(tmp_path / "again")
    assert [scan.time for scan in again.scans] == [scan.time for scan in log.scans]


def test_of_odometry_rows_with_one_time_the_last_wins_and_the_others_are_counted(tmp_path):
    odometry = "time,velocity,angular_rate\n0,1,0\n0,2,0\n1,3,0\n1,4,0\n1,5,0\n2,0,0\n"
    log = read_log(recorded(tmp_path, odometry=odometry))
    assert log.controls[:, 0].tolist() == [2.0, 5.0]
    assert log.ignored_rows == {"same_time_odometry": 3}


# What is refused


@pytest.mark.parametrize("name", ["log.toml", "odometry.csv", "measurements.csv"])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    refused(folder, name, "no such file")


def test_an_empty_settings_file_lacks_its_format(folder):
    (folder / "log.toml").write_text("")
    refused(folder, "log.toml", "no keys 'format', 'motion', ")


def test_a_file_that_is_no_text_is_named(folder):
    (folder / "odometry.csv").write_bytes(b"\xff\xfe\x00t")
    refused(folder, "odometry.csv", "UTF-8")
    (folder / "odometry.csv").unlink()
    (folder / "odometry.csv").mkdir()
    refused(folder, "odometry.csv", "found a folder, expected a file")


@pytest.mark.parametrize("name", ["log.toml", "odometry.csv", "measurements.csv"])
def test_a_pipe_or_a_device_in_a_files_place_is_refused_unread(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    refused(folder, name, "a pipe or a device")
    (folder / name).unlink()
    (folder / name).symlink_to("/dev/zero")
    refused(folder, name, "a pipe or a device")


def test_a_broken_link_is_distinguished_from_a_missing_file(folder):
    (folder / "odometry.csv").unlink()
    refused(folder, "odometry.csv", "found no such file")
    (folder / "odometry.csv").symlink_to("nowhere.csv")
    refused(folder, "odometry.csv", "found a link to no file")


def test_measurements_without_a_usable_row_are_refused(tmp_path):
    rows = measured("0.1,-1,0.5,4.0", "9.0,7,0.5,4.0", "9.5,3,0.5,")
    folder = recorded(tmp_path, measurements=rows)
    left_out = "left out: 1 clutter, 2 outside odometry), expected some of landmarks"
    refused(folder, "measurements.csv", left_out, "0.0 s and 0.4 s", "use the odometry's clock")


ROWS = {
    "no clutter": ("landmark -2,", "from 0 to 9007199254740991, or -1 for", "0.1,-2,0.5,1"),
    "large label": ("landmark 9007199254740992,", "to 9007", "0.1,9007199254740992,0.5,1"),
    "no range": ("range 0.0", "above 0 m", "0.1,7,0.5,0"),
    "swapped": ("range -2.0", "exchange bearing and range", "0.1,7,4.0,-2"),
    "nan range": ("range 'NaN'", "leave it empty", "0.1,7,0.5,NaN"),
    "empty": ("bearing ''", "a finite number", "0.1,7,,"),
    "twice": ("time 0.06, landmark 1 again", "line 2", "0.06,1,0.5,1"),
    "outside but wrong": ("range -2.0", "above 0 m", "99,7,0.5,-2"),
    "beside no range": ("range_std -1.0", "from 1e-06 m", "0.1,7,0.5,,0.1,-1"),
    "small": ("bearing_std 1e-155", "from 1e-06 rad, up to 10000 rad", "0.1,7,0.5,1,1e-155,1"),
}


def test_measurements_without_labels_are_refused_with_both_remedies(tmp_path):
    rows = "time,bearing,range\n0.1,0.5,1\n"
    folder = recorded(tmp_path, measurements=rows)
    refused(folder, "line 1", "the same number in all rows", "for --association.method to decide")


@pytest.mark.parametrize("label", ["", "-1"])
def test_a_log_without_any_label_keeps_all_its_rows(tmp_path, label):
    rows = measured(f"0.1,{label},0.5,4.0", f"0.1,{label},-0.5,2.0", f"0.25,{label},0.4,3.5")
    log = read_log(recorded(tmp_path / "bare", measurements=rows))
    assert [scan.landmark.tolist() for scan in log.scans] == [[-1, -1], [-1]]
    assert log.ignored_rows == {}


def test_rows_without_label_are_kept_in_a_log_with_labels(tmp_path):
    rows = ("0.1,7,0.5,4,,,", "0.1,-1,0.2,3,,,", "0.1,,0.4,,0,,boat", "0.1,52,0.3,,,,mate")
    log = read_log(timed(tmp_path / "some", *rows, "0.25,7,0.1,2,,,"))
    first, second = log.scans
    assert (first.landmark.tolist(), first.direct.tolist()) == ([7, -1, 52], [-1, 1, 2])
    assert (second.landmark.tolist(), log.ignored_rows) == ([7], {"clutter": 1})
    write_log(tmp_path / "again" / "some", log)
    assert same(read_log(tmp_path / "again" / "some"), replace(log, ignored_rows={}))


@pytest.mark.parametrize("case", ROWS)
def test_a_bad_measurement_is_refused_by_its_line(tmp_path, case):
    *parts, row = ROWS[case]
    stated = STATED if row.count(",") > 3 else ""
    rows = measured("0.06,1,0,1" + stated.count(",") * ",", row, stated=stated)
    refused(recorded(tmp_path, measurements=rows), "measurements.csv, line 3", *parts)


def test_a_landmark_twice_at_one_time_is_found_among_others(tmp_path):
    rows = ["0.1,1,0,1", "0.1,2,0,1", "0.1,3,0,1", "0.1,2,0.3,", "0.2,2,0,1"]
    refused(recorded(tmp_path, measurements=measured(*rows)), "line 5", "landmark 2", "line 3")
    rows = ["0.1,9,0,1", "0.1,9,0,1", "0.1,1,0,1", "0.1,1,0,1"]
    refused(recorded(tmp_path, measurements=measured(*rows)), "line 3", "landmark 9", "line 2")


def test_a_row_of_odometry_that_holds_for_days_is_refused_by_its_line(tmp_path):
    parts = ("line 6", "200000.0 after 0.4", "100000 s apart", "`step` in log.toml")
    refused(recorded(tmp_path, odometry=ODOMETRY + "2e5,1,0\n"), "odometry.csv", *parts)


def test_one_row_of_odometry_is_no_log(tmp_path):
    odometry = "time,velocity,angular_rate\n0,1,0\n"
    refused(recorded(tmp_path, odometry=odometry), "odometry.csv", "two times", "ends the log")


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("range_std = 0.2", "", ("no key 'range_std'", "add 'range_std'")),
        ("velocity_std", "velocity_sdt", ("unknown key 'velocity_sdt'", "mean 'velocity_std'?")),
        ("range_std = 0.2", "range_std = 0.2\ncolour = 3", ("unknown key 'colour'", "remove it")),
        ("format = 1", "format = 2", ("key 'format': found 2", "expected 1")),
        ('"unicycle"', '"tricycle"', ("'tricycle'", "'unicycle', 'bicycle', 'ackermann' or")),
        ("range_std = 0.2", "range_std = -0.2", ("'range_std': found -0.2", "equal to 0.000001")),
        ("range_std = 0.2", 'range_std = "0.2"', ("'range_std': found '0.2'", "valid number")),
        ("-2.0, 0.5]", "-2.0]", ("key 'initial_pose': found 2 values, expected 3",)),
        ("-2.0, 0.5]", 'inf, "x"]', ("'initial_pose[1]': found inf", "finite")),
        ("[0.05, 0.06", "[-0.05, 0.06", ("'initial_pose_std[0]': found -0.05",)),
        ("[0.5, 20.0]", "[20.0, 0.5]", ("'range_bounds': found [20.0, 0.5]", "below a far one")),
        ("range_std = 0.2", "range_std = 0.2\nstep = 0", ("'step': found 0", "greater than 0")),
        ("range_std = 0.2",
         "range_std = 0.2\ntime_offset = 4e7",
         ("'time_offset': found 40000000.0", "3600")),
        ("range_std = 0.2", "range_std = 0.2\ngate = 1.5", ("'gate': found 1.5", "equal to 1")),
        ("[0.5, 20.0]",
         "[0.5, 20.0]\n[association]\nrange = 7.0",
         ("unknown key 'association.range'", "clutter")),
        ("range_std = 0.2", "range_std = ", ("TOML", "line 7")),
        ("range_std = 0.2",
         "range_std = 1e-155",
         ("'range_std': found 1e-155", "equal to 0.000001")),
        ("range_std = 0.2", "range_std = " + "[" * 5000, ("more than 8 levels", "mend the file")),
        ("range_std = 0.2", "range_std = " + "2" * 5000, ("integer of many digits", "64 bits")),
    ],
)  # fmt: skip
def test_a_bad_setting_is_refused_by_its_key(tmp_path, old, new, parts):
    assert old in UNICYCLE
    folder = recorded(tmp_path, UNICYCLE.replace(old, new, 1))
    refused(folder, "log.toml", *parts)


def test_the_settings_of_the_other_vehicle_are_refused(tmp_path):
    refused(recorded(tmp_path, UNICYCLE + "wheelbase = 0.2\n"), "unknown key 'wheelbase'")
    settings = UNICYCLE.replace('"unicycle"', '"bicycle"')
    message = refused(recorded(tmp_path, settings), "unknown key 'velocity_std'", "speed_std")
    assert "angular" not in message


CAR = BICYCLE.replace("bicycle", "ackermann") + "speed_offset = -0.1\n"
STEERED = "time,speed,steering\n0.0,1.0,0.1\n0.1,2.0,{}\n0.3,3.0,0.3\n0.4,9.0,0.9\n"


def test_a_car_that_measures_its_speed_outside_itself_is_refused(tmp_path):
    settings = CAR.replace("-0.1\n", "0.16\n")
    refused(recorded(tmp_path, settings, STEERED.format(0)), "speed_offset", "half the wheelbase")


@pytest.mark.parametrize("steering", [1.2, -30.0])
def test_a_car_that_steers_across_is_asked_for_radians(tmp_path, steering):
    folder = recorded(tmp_path, CAR, STEERED.format(steering))
    refused(folder, "odometry.csv, line 3", f"steering {steering}", "radians")


def test_steps_without_number_are_refused_before_they_fill_the_memory(tmp_path):
    settings = UNICYCLE + "step = 0.1\n"
    odometry = ODOMETRY + "1700000000.0,1,0\n"
    refused(recorded(tmp_path, settings, odometry), "odometry.csv", "1.7e+09 s", "steps")


# What is written


def test_the_logs_on_the_pages_of_the_documentation_are_sound(tmp_path):
    docs = Path(__file__).parents[3] / "docs"
    page = "".join((docs / name).read_text() for name in ("your_log.md", "log_format.md"))
    files = re.findall(r"^`([a-z]+\.[a-z]+)`\n\n```[a-z]+\n(.+?)^```", page, re.M | re.S)
    assert [name for name, _ in files] == ["log.toml", "odometry.csv", "measurements.csv"]
    for name, text in files:
        (tmp_path / name).write_text(text)
    log = read_log(tmp_path)
    assert len(log.dt) == 3
    assert [scan.landmark.tolist() for scan in log.scans] == [[7, 3], [7]]
    (text,) = re.findall(r"^```text\n(time,[^\n]+range_std\n.+?)^```", page, re.M | re.S)
    first, second = read_log(recorded(tmp_path, measurements=text)).scans
    assert first.landmark.tolist() == [7, 3]
    np.testing.assert_array_equal(first.bearing_std, [0.004, 0.02])
    np.testing.assert_array_equal([*first.range_std, *second.range_std], [0.01, NAN, 0.2])
    assert np.isnan(second.bearing_std).all()
    (text,) = re.findall(r"^```text\n(time,[^\n]+caller\n.+?)^```", page, re.M | re.S)
    (callers,) = re.findall(r"^```toml\n(\[\[callers\]\]\n.+?)^```", page, re.M | re.S)
    (scan,) = read_log(recorded(tmp_path, UNICYCLE + callers, measurements=text)).scans
    assert scan.landmark.tolist() == [7, 3, 20, 7]
    np.testing.assert_array_equal(scan.excess_path, [NAN, 6.21, NAN, 4.08])
    assert scan.callers.tolist() == [-1, 20]


def written_log(kind, folder):
    """Return a log of each kind of content."""
    if kind in ("unicycle_log", "bicycle_log"):
        return read_log(DATA / kind)
    if kind == "every setting":
        log = replace(read_log(recorded(folder)), gate=0.97, noise_at_rest=False)
        log = replace(log, initial_pose=(0.1, 1e-7, 3.0), sensor_pose=(0.1, 0.2, -3.0))
        log = replace(log, landmarks={7: (1.0, -2.0), 12: (0.0, 3.0)}, landmark_std=0.1)
        return replace(log, association={"detection_rate": 0.5})
    if kind == "a car":
        log = read_log(recorded(folder, CAR, STEERED.format(-1.0)))
        assert (log.motion, log.wheelbase, log.speed_offset) == ("ackermann", 0.3, -0.1)
        assert log.controls[1].tolist() == [2.0, -1.0]
        return log
    rows = ("0.1,7,0.5,4.0,3.25,0.01,mate", "0.1,7,,,6.5,,boat", "0.25,8,0.1,2.0,,,")
    settings = UNICYCLE + "excess_path_std = 0.05\n" + CALLERS + "\n[[callers]]\nname = 'c'\n"
    log = read_log(timed(folder, *rows, settings=settings + "landmark = 9\nmoves = true\n"))
    assert (log.excess_path_std, log.callers[2].moves) == (0.05, True)
    return log


@pytest.mark.parametrize(
    "kind",
    ["unicycle_log", "bicycle_log", "every setting", "a car", "callers"],
)
def test_a_log_survives_being_written(tmp_path, kind):
    log = written_log(kind, tmp_path / "drive")
    write_log(tmp_path / "again" / log.name, log)
    assert same(read_log(tmp_path / "again" / log.name), log)


@pytest.mark.parametrize("step", ["", "step = 0.1"])
@pytest.mark.parametrize(
    ("start", "unit", "factor"),
    [
        (1_700_000_000_000_000_000, 100_000_000, "1e-09"),  # as ROS stamps
        (0, 100_000_000, "1e-09"),
        (1_700_000_000_000_000, 100_000, "1e-06"),
        (0, 20_000, "1e-06"),
        (4_500_000_000_000_000, 1, "1e-06"),
        (1_700_000_000_000, 100, "0.001"),
        (0, 125, "0.001"),
        (0, 500, "0.001"),
    ],
)
def test_a_clock_that_counts_no_seconds_is_refused_with_the_factor_that_fits(
    tmp_path, start, unit, factor, step
):
    folder = recorded(tmp_path / "drive")
    write = (folder / "odometry.csv").write_text
    write("time,velocity,angular_rate\n" + "".join(f"{start + k * unit},1,0\n" for k in range(9)))
    (folder / "measurements.csv").write_text(f"time,landmark,bearing,range\n{start + unit},7,1,2\n")
    with (folder / "log.toml").open("a") as settings:
        settings.write(f"\n{step}\n")
    with pytest.raises(InputError, match=rf"odometry\.csv: .*expected seconds; multiply.*{factor}"):
        read_log(folder)


@pytest.mark.parametrize(
    ("stated", "header"),
    [
        ({}, ""),
        ({"bearing_std": [NAN, NAN]}, ""),
        ({"bearing_std": [0.01, NAN]}, ",bearing_std"),
        ({"range_std": [NAN, 0.3]}, ",range_std"),
        ({"bearing_std": [0.1, 0.2], "range_std": [NAN, 0.3]}, ",bearing_std,range_std"),
    ],
)
def test_only_columns_with_a_value_are_written(tmp_path, stated, header):
    log = read_log(DATA / "unicycle_log")
    first, *others = log.scans
    said = {name: np.resize(values, first.landmark.size) for name, values in stated.items()}
    log = replace(log, scans=(with_columns(first, **said), *others))
    write_log(tmp_path / log.name, log)
    lines = (tmp_path / log.name / "measurements.csv").read_text().splitlines()
    assert lines[0] == "time,landmark,bearing,range" + header
    assert f"measurements.csv: {lines[0]}\n" in (tmp_path / log.name / "README.md").read_text()
    assert same(read_log(tmp_path / log.name), log)


CALLERS = """
[[callers]]
name = "boat"
landmark = 51

[[callers]]
name = "mate"
landmark = 52
place = [1, 2.5]
place_std = [0.1, 0.2]
"""
TIMED = ",excess_path,excess_path_std,caller"


def timed(folder, *rows, settings=UNICYCLE + CALLERS, stated=TIMED):
    return recorded(folder, settings, measurements=measured(*rows, stated=stated))


def test_rows_may_state_an_excess_path_and_its_caller(tmp_path):
    rows = (
        "0.1,7,0.5,4.0,3.25,0.01,mate",
        "0.1,7,,,6.5,,boat",
        "0.1,51,0.2,,,,boat",
        "0.1,8,0.1,2.0,,,",
        "0.2,9,0.1,,0,0.3,boat",
    )
    log = read_log(timed(tmp_path, *rows))
    first, second = log.scans
    assert first.landmark.tolist() == [7, 51, 8, 7]
    assert first.caller.tolist() == [2, 1, 0, 1]
    np.testing.assert_array_equal(first.bearing, [0.5, 0.2, 0.1, NAN])
    np.testing.assert_array_equal(first.excess_path, [3.25, NAN, NAN, 6.5])
    np.testing.assert_array_equal(first.excess_path_std, [0.01, NAN, NAN, NAN])
    assert second.excess_path.tolist() == [0.0]
    assert first.callers.tolist() == second.callers.tolist() == [-1, 51, 52]
    assert [(c.name, c.landmark, c.moves) for c in log.callers] == [
        ("boat", 51, False),
        ("mate", 52, False),
    ]
    assert [(c.place, c.place_std) for c in log.callers] == [(None, None), ((1, 2.5), (0.1, 0.2))]


def test_a_log_without_callers_has_no_caller_columns(folder):
    log = read_log(folder)
    assert log.callers == ()
    assert log.excess_path_std is None
    assert all(scan.callers.size == 0 and not scan.caller.any() for scan in log.scans)


TIMED_WRONG = {
    "nobody's": ("0.1,7,0.5,4.0,3.5,,", "line 2", "an excess path without a caller"),
    "unknown": ("0.1,7,0.5,4.0,3.5,,bat", "line 2", "caller 'bat'", "expected boat or mate"),
    "the vehicle": ("0.1,7,0.5,4.0,3.5,,vehicle", "caller 'vehicle'"),
    "a number": ("0.1,7,0.5,4.0,3.5,,1", "caller '1'"),
    "nothing": ("0.1,7,,,,,boat", "bearing ''", "a further excess path"),
    "over itself": (
        "0.1,52,0.5,,3,,mate",
        "line 2",
        "an excess path of a call over the caller itself",
    ),
    "twice": ("0.1,7,0.5,,3,,boat\n0.1,7,,,4,,boat", "line 3", "landmark 7 again", "line 2"),
    "twice unheard": ("0.1,7,0.5,,,,\n0.1,7,0.4,,,,", "line 3", "landmark 7 again"),
}


@pytest.mark.parametrize("case", TIMED_WRONG)
def test_a_bad_excess_path_is_refused_by_its_line(tmp_path, case):
    row, *parts = TIMED_WRONG[case]
    refused(timed(tmp_path, row), "measurements.csv", *parts)


def test_a_landmark_may_be_heard_twice_at_one_time_by_the_calls_of_two(tmp_path):
    rows = ("0.1,7,0.5,4.0,,,", "0.1,7,0.4,,3,,boat", "0.1,7,0.6,,,,mate")
    (scan,) = read_log(timed(tmp_path, *rows)).scans
    assert scan.landmark.tolist() == [7, 7, 7]


def test_a_caller_of_a_log_without_callers_is_refused_with_where_to_name_it(tmp_path):
    folder = timed(tmp_path, "0.1,7,0.5,4.0,3.5,,boat", settings=UNICYCLE)
    refused(folder, "line 2", "caller 'boat'", "[[callers]] of log.toml")


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('name = "boat"', "", ("no key 'callers.1.name'",)),
        ("landmark = 52", "", ("no key 'callers.2.landmark'",)),
        ("landmark = 52", "landmark = 51", ("callers", "a landmark of its own")),
        ('name = "mate"', 'name = "boat"', ("callers", "a name of its own")),
        ('name = "mate"', 'name = "Boat"', ("callers", "a name of its own")),
        ('name = "mate"', 'name = "vehicle"', ("callers", 'not "vehicle"')),
        ('name = "mate"', f'name = "{41 * "m"}"', ("'callers.2.name'", "40 at most")),
        ('name = "mate"', 'name = "a,b"', ("'callers.2.name'", "letters, digits, _ and -")),
        ("landmark = 52", "landmark = -1", ("'callers.2.landmark'", "found -1")),
        ("landmark = 52", "landmark = 1.5", ("'callers.2.landmark'", "found 1.5")),
        ("place = [1, 2.5]", "plaice = [1, 2.5]", ("'callers.2.plaice'", "mean 'place'")),
        ("place = [1, 2.5]", "place = [1]", ("'callers.2.place'",)),
        ("place = [1, 2.5]", "place = [1, nan]", ("'callers.2.place[1]'",)),
        ("place = [1, 2.5]", "", ("'callers.2.place_std'", "a place beside it")),
        ("place_std = [0.1, 0.2]", "place_std = [-1, 0]", ("'callers.2.place_std[0]'",)),
        ("place_std = [0.1, 0.2]", "moves = 1", ("'callers.2.moves'",)),
        ("place = [1, 2.5]", "moves = true\nplace = [1, 2.5]", ("place of a caller that moves",)),
        (CALLERS, "[landmarks]\npost = [1, 2]", ("'landmarks.post'", "a valid integer")),
        (CALLERS, "[landmarks]\n7 = [1]", ("'landmarks.7'", "found 1 values, expected 2")),
        (CALLERS, "[landmarks]\n7 = [1, nan]", ("'landmarks.7[1]'",)),
        (CALLERS, "callers = 3", ("'callers'", "found 3")),
        (CALLERS, "callers = [3]", ("callers",)),
        (CALLERS, "[callers]\nname = 'boat'\nlandmark = 3", ("'callers'",)),
        (CALLERS, "".join(f"[[callers]]\nname='b{i}'\nlandmark={i}\n" for i in range(8)),
         ("callers", "8", "7")),
    ],
)  # fmt: skip
def test_a_bad_caller_or_landmark_of_a_log_is_refused_by_its_key(tmp_path, old, new, parts):
    settings = (UNICYCLE + CALLERS).replace(old, new)
    assert settings != UNICYCLE + CALLERS
    refused(timed(tmp_path, "0.1,7,0.5,4.0,3.5,,boat", settings=settings), "log.toml", *parts)


NUMBER = st.floats(-1e4, 1e4)
ANGLE = st.floats(-np.pi, np.pi, exclude_max=True)
LABEL = st.integers(0, 2**53 - 1)
RANGE = st.floats(1e-9, 1e6) | st.just(np.nan)
RANGE_STD, BEARING_STD = (st.floats(1e-6, most) | st.just(np.nan) for most in (1e6, 1e4))
ROW = st.tuples(ANGLE, RANGE, RANGE_STD, BEARING_STD)


@st.composite
def drives(draw):
    steps = draw(st.integers(1, 6))
    start = draw(st.floats(-1e9, 1e9))
    time = start + np.cumsum(
        [0.0, *draw(st.lists(st.floats(1e-3, 10), min_size=steps, max_size=steps))]
    )
    controls = np.array(draw(st.lists(st.tuples(NUMBER, NUMBER), min_size=steps, max_size=steps)))
    scans = []
    for k in sorted(draw(st.sets(st.integers(0, steps), min_size=1))):
        parts = 1 if k == 0 else draw(st.integers(1, 3))
        for at in np.linspace(time[k], time[max(k - 1, 0)], parts, endpoint=False)[::-1].tolist():
            rows = draw(st.dictionaries(LABEL, ROW, min_size=1))
            bearing, distance, *stds = np.array(list(rows.values())).T
            said = dict(zip(("range_std", "bearing_std"), stds, strict=True))
            scans.append(scan_with(list(rows), bearing, distance, time=at, **said))
    return replace(
        read_log(DATA / "unicycle_log"),
        time=time,
        controls=controls,
        dt=np.diff(time),
        scans=tuple(scans),
        bearings=np.concatenate([scan.bearing for scan in scans]),
    )


@given(log=drives())
@settings(max_examples=20, deadline=None)
def test_any_log_survives_being_written(tmp_path_factory, log):
    folder = tmp_path_factory.mktemp("logs") / log.name
    write_log(folder, log)
    assert same(replace(read_log(folder), doubts=()), log)  # a drawn drive may be silent for long


def test_all_keys_that_log_toml_lacks_are_named_at_once():
    some = {"format": 1, "initial_pose": [0, 0, 0], "initial_pose_std": [0, 0, 0]}
    unicycle = {"motion": "unicycle", "range_std": 0.1, "bearing_std": 0.1, "angular_rate_std": 0.1}
    with pytest.raises(InputError, match="no keys 'range_bounds', 'velocity_std'") as refused:
        vehicle_of(some | unicycle, "log")
    assert str(refused.value).endswith("add 'range_bounds', 'velocity_std'")
    with pytest.raises(InputError, match="no keys 'motion', 'range_std'") as refused:
        vehicle_of(some, "log")
    assert "velocity_std" not in str(refused.value), "which keys a motion has is not known"
