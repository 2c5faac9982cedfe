"""Poses as odometry: ways from row to row, how they merge, and how surely they are told."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.config import InputError
from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.logs.poses import (
    jumps,
    motions_between,
    poses_along,
    relative_motions,
    turns_in_degrees,
)
from pipistrelle.detection.logs.recording import assemble
from pipistrelle.estimation.motion import Motion, motion_jacobians, motion_noise, motion_step
from pipistrelle.experiments.runs.replay import log_motion
from pipistrelle.geometry import wrap
from pipistrelle.text_tables import Table
from reference.odometry import ANYONE, COVARIANCE, as_motions, poses_file, wandering
from reference.refused import FORM, refusal_of

DATA = Path(__file__).parents[2] / "data"
SETTINGS = """\
format = 1
motion = "poses"
initial_pose = [1.0, -2.0, 0.5]
initial_pose_std = [0.05, 0.06, 0.04]
forward_std = 0.02
sideways_std = 0.01
turn_std = 0.03
range_std = 0.2
bearing_std = 0.06
range_bounds = [0.5, 20.0]
"""
HEADER = "time,x,y,heading"
ODOMETRY = f"{HEADER}\n0.0,5,1,0\n0.1,5.5,1,0.1\n0.3,5.5,1,0.1\n0.4,5.5,1.2,3.0\n"
MEASUREMENTS = "time,landmark,bearing,range\n0.1,7,0.5,4.0\n0.25,7,0.4,3.5\n"
STATED = f"{HEADER},{','.join(COVARIANCE)}\n"
UNICYCLE = Motion(model="unicycle", control_std=(0.1, 0.15))

lengths, angles = st.floats(-3, 3), st.floats(-3.1, 3.1)
gaps = st.floats(0.01, 2.0)


def recorded(folder, odometry=ODOMETRY, settings=SETTINGS, measurements=MEASUREMENTS):
    folder.mkdir(exist_ok=True)
    (folder / "log.toml").write_text(settings)
    (folder / "odometry.csv").write_text(odometry)
    (folder / "measurements.csv").write_text(measurements)
    return folder


def table(time, poses, covariance=None):
    """Return rows of poses as they are read."""
    column = {"time": np.array(time, float)}
    column |= dict(zip(("x", "y", "heading"), np.array(poses, float).T, strict=True))
    if covariance is not None:
        column |= dict(zip(COVARIANCE, np.array(covariance, float).T, strict=True))
    line = np.arange(2, 2 + len(column["time"]))
    return Table(path=Path("odometry.csv"), line=line, column=column)


def refused(call, *parts):
    refusal_of(call, *parts, form=FORM)


def ends(motions, start=(0.0, 0.0, 0.0)):
    """Where motions lead from a pose on, step by step."""
    poses = [np.array(start, float)]
    for way in motions:
        poses.append(motion_step(ANYONE, poses[-1], way, 1.0))
    return np.array(poses)


@st.composite
def drives(draw, *, least=1):
    """Times, and poses of a vehicle that goes any way."""
    ways = draw(st.lists(st.tuples(gaps, lengths, lengths, angles), min_size=least, max_size=8))
    dt, *motions = np.array(ways).T
    start = draw(st.tuples(lengths, lengths, angles))
    return np.append(0.0, np.cumsum(dt)), ends(np.transpose(motions), start)


# Ways


def test_controls_are_motions_relative_to_the_previous_pose(tmp_path):
    log = read_log(recorded(tmp_path / "drive"))
    c, s = np.cos(0.1), np.sin(0.1)
    by_hand = [[0.5, 0.0, 0.1], [0.0, 0.0, 0.0], [0.2 * s, 0.2 * c, 2.9]]
    np.testing.assert_allclose(log.controls, by_hand, rtol=0, atol=1e-15)
    assert log.time.tolist() == [0.0, 0.1, 0.3, 0.4]
    assert (log.motion, log.control_std, log.noise_at_rest) == ("poses", (0.02, 0.01, 0.03), True)
    assert log_motion(log) == Motion(model="poses", control_std=(0.02, 0.01, 0.03))


def test_turns_are_wrapped_to_the_shorter_direction():
    headings = np.array([3.0, -3.0, -3.0 + 2.0 * np.pi, 3.1, -3.1])
    poses = np.column_stack([np.zeros((5, 2)), headings])
    turns = motions_between(table(range(5), poses), np.arange(5.0))[:, 2]
    across = 2.0 * np.pi - 6.0
    np.testing.assert_allclose(turns, [across, 0.0, -across + 0.1, across - 0.2], atol=1e-15)


@given(drives(), st.tuples(lengths, lengths, angles))
def test_motions_do_not_depend_on_the_recorders_frame(drive, frame):
    time, poses = drive
    c, s = np.cos(frame[2]), np.sin(frame[2])
    shifted = np.column_stack(
        [poses[:, :2] @ np.array([[c, s], [-s, c]]) + frame[:2], wrap(poses[:, 2] + frame[2])]
    )
    for at in (time, np.linspace(0.0, time[-1], 7)):
        change = motions_between(table(time, shifted), at) - motions_between(table(time, poses), at)
        np.testing.assert_allclose(wrap(change), 0.0, atol=1e-12 * 50)


@given(drives(), st.floats(0.02, 3.0))
def test_steps_of_any_length_lead_to_the_last_row(drive, step):
    time, poses = drive
    edges = np.append(np.arange(0.0, time[-1] - 1e-9, step), time[-1])
    there = ends(motions_between(table(time, poses), edges), poses[0])
    np.testing.assert_allclose(there[-1, :2], poses[-1, :2], atol=1e-10)
    assert abs(wrap(there[-1, 2] - poses[-1, 2])) < 1e-10


@given(st.floats(-2, 2), st.floats(-1.5, 1.5), st.integers(1, 12))
def test_between_rows_it_goes_on_at_constant_velocity(speed, rate, parts):
    """So a unicycle that is told by one row a second is on its arc at all other times."""
    fine = np.linspace(0.0, 1.0, parts + 1)
    arc = [
        motion_step(UNICYCLE, np.array([2.0, 1.0, -3.0]), np.array([speed, rate]), t) for t in fine
    ]
    motions = motions_between(table([0.0, 1.0], [arc[0], arc[-1]]), fine)
    np.testing.assert_allclose(motions, relative_motions(np.array(arc)), rtol=0, atol=1e-13)


def test_poses_at_rest_give_zero_steps_to_the_bit_after_merging(tmp_path):
    """Times of a recorder, in steps that its rows do not divide."""
    stamps = [f"{1e9 + 0.017 * i:.3f}" for i in range(80)]
    poses = [(3.7, -0.123456789, 2.5) if i < 42 else (3.7, 0.01 * i, 2.5) for i in range(80)]
    rows = [f"{t},{x!r},{y!r},{h!r}" for t, (x, y, h) in zip(stamps, poses, strict=True)]
    text = "\n".join([HEADER, *rows])
    measured = "time,landmark,bearing,range\n1000000000.5,1,0,1\n"
    log = read_log(recorded(tmp_path, text, SETTINGS + "step = 0.1\n", measured))
    assert (log.controls[:6] == 0.0).all()
    assert (np.abs(log.controls[7:]).sum(axis=1) > 0.0).all()


@pytest.mark.parametrize("rounding", [1e-16, -1e-16, 4e-7, -4e-7])
def test_a_step_that_ends_with_a_row_but_for_rounding_ends_with_the_row(rounding):
    poses = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 1.0]]
    motions = motions_between(table([0.0, 0.3, 0.6], poses), np.array([0.0, 0.3 + rounding, 0.6]))
    np.testing.assert_allclose(motions, relative_motions(np.array(poses)), rtol=0, atol=0)


def test_gaps_between_rows_may_be_of_any_length(tmp_path):
    """Ten seconds without a row are one way, however long a step is."""
    text = f"{HEADER}\n0,0,0,0\n0.05,0.1,0,0\n10.05,4.1,0,0\n10.06,4.2,0,0\n"
    log = read_log(recorded(tmp_path, text))
    np.testing.assert_allclose(log.controls[:, 0], [0.1, 4.0, 0.1], atol=1e-14)
    log = read_log(recorded(tmp_path, text, SETTINGS + "step = 2.5\n"))
    np.testing.assert_allclose(log.controls[1:3, 0], [1.0, 1.0], atol=1e-12)
    assert sum(log.controls[:, 0]) == pytest.approx(4.2)


def test_the_last_of_simultaneous_rows_counts_and_no_motion_is_lost(tmp_path):
    text = f"{HEADER}\n0,9,9,0\n0,0,0,0\n1,1,0,0\n1,1.5,0,0\n2,2,0,0\n"
    log = read_log(recorded(tmp_path, text))
    np.testing.assert_allclose(log.controls[:, 0], [1.5, 0.5])
    assert log.ignored_rows == {"same_time_odometry": 2}


def test_a_log_of_poses_may_be_cut_to_a_span():
    time, poses = np.arange(5.0), np.column_stack([np.arange(5.0), np.zeros((5, 2))])
    one = {"landmark": np.array([3]), "bearing": np.zeros(1), "range": np.ones(1)}
    heard = Table(path=Path("m.csv"), line=np.array([2]), column={"time": np.array([2.0])} | one)
    log = assemble(
        table(time, poses), heard, span=(0.5, 3.25), name="cut", motion="poses",
        control_std=(0.1, 0.1, 0.1), initial_pose=(0, 0, 0), initial_pose_std=(0, 0, 0),
        range_std=0.1, bearing_std=0.1, range_bounds=(0.5, 9.0),
    )  # fmt: skip
    assert log.time.tolist() == [0.5, 1.0, 2.0, 3.0, 3.25]
    np.testing.assert_allclose(log.controls[:, 0], [0.5, 1.0, 1.0, 0.25], atol=1e-15)


# How surely a way is told


def composed(motions, covariances):
    """Covariance of what ways add up to, one after another, by the slow reference's Jacobians."""
    pose, P = np.zeros(3), np.zeros((3, 3))
    for way, Q in zip(motions, covariances, strict=True):
        F, U = motion_jacobians(ANYONE, pose, way, 1.0)
        pose, P = motion_step(ANYONE, pose, way, 1.0), F @ P @ F.T + U @ Q @ U.T
    return P


def stated_of(motions):
    """Covariances (k, 3, 3) that motions say."""
    return np.array([motion_noise(ANYONE, way) for way in motions])


def drive_of(seed=0, count=12):
    """A drive of which every row says how surely it was told."""
    rng = np.random.default_rng(seed)
    motions = wandering(rng, count, stated=True, silent=0.0)
    return motions, ends(motions[:, :3], (3.0, -1.0, 2.0))


def rows_of(motions):
    """The six columns of a file: the first row follows none."""
    return np.vstack([np.full(6, np.nan), motions[:, 3:]])


def test_a_rows_covariance_is_of_the_motion_that_ends_there(tmp_path):
    rows = ["0,0,0,0,,,,,,", "1,1,0,0,4,0.5,-0.3,2,0.1,1", "2,2,0,0,,,,,,"]
    log = read_log(recorded(tmp_path, STATED + "\n".join(rows)))
    assert log.controls[0].tolist() == [1, 0, 0, 4, 0.5, -0.3, 2, 0.1, 1]
    assert np.isnan(log.controls[1, 3:]).all()
    np.testing.assert_array_equal(
        motion_noise(log_motion(log), log.controls[1]).diagonal(), np.square([0.02, 0.01, 0.03])
    )


@pytest.mark.parametrize(
    "rows", [["0,0,0,0,,,,,,", "1,1,0,0,,,,,,"], ["0,0,0,0,4,0,0,4,0,4", "1,1,0,0,,,,,,"]]
)
def test_covariance_columns_without_a_value_are_dropped(tmp_path, rows):
    assert read_log(recorded(tmp_path, STATED + "\n".join(rows))).controls.shape == (1, 3)


def test_covariances_of_unmerged_rows_equal_the_file_to_the_bit():
    motions, poses = drive_of()
    time = np.arange(float(len(poses)))
    read = motions_between(table(time, poses, rows_of(motions)), time)
    np.testing.assert_array_equal(read[:, 3:], motions[:, 3:])


@pytest.mark.parametrize("many", [2, 3, 12])
def test_covariances_of_merged_rows_are_composed_along_the_motions(many):
    motions, poses = drive_of()
    time = np.arange(float(len(poses)))
    merged = motions_between(table(time, poses, rows_of(motions)), time[::many])
    for step, way in enumerate(merged):
        part = motions[many * step : many * step + many]
        by_hand = composed(part[:, :3], stated_of(part))
        np.testing.assert_allclose(motion_noise(ANYONE, way), by_hand, rtol=1e-9, atol=1e-12)


def test_covariances_add_up_as_the_finite_differences_of_the_steps_end():
    motions, _ = drive_of(count=4)
    end = ends(motions[:, :3])[-1]
    total = np.zeros((3, 3))
    for row, Q in enumerate(stated_of(motions)):
        slopes = []
        for unit in 1e-6 * np.eye(3):
            shaken = motions[:, :3].copy()
            shaken[row] += unit
            slopes.append((ends(shaken)[-1] - end) / 1e-6)
        total += np.transpose(slopes) @ Q @ slopes
    time = np.arange(5.0)
    file = table(time, ends(motions[:, :3], (1.0, 2.0, -2.0)), rows_of(motions))
    (way,) = motions_between(file, time[[0, -1]])
    np.testing.assert_allclose(motion_noise(ANYONE, way), total, rtol=1e-4, atol=1e-6)


def test_a_row_that_is_cut_gives_each_part_its_share():
    Q = [4.0, 0.5, -0.3, 2.0, 0.1, 1.0]
    still = table([0.0, 1.0], np.zeros((2, 3)), [[np.nan] * 6, Q])
    parts = motions_between(still, np.array([0.0, 0.25, 1.0]))
    np.testing.assert_allclose(parts[:, 3:], [np.multiply(0.25, Q), np.multiply(0.75, Q)])


def test_covariances_of_simultaneous_rows_add_up():
    Q = np.array([4.0, 0.5, -0.3, 2.0, 0.1, 1.0])
    poses, nothing = [[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]], np.full(6, np.nan)
    file = table([0.0, 0.0, 1.0, 1.0], poses, [nothing, 5.0 * Q, Q, 2.0 * Q])
    (way,) = motions_between(file, np.array([0.0, 1.0]))
    np.testing.assert_allclose(way[3:], 3.0 * Q)


def test_a_step_with_a_part_without_covariance_takes_the_settings_noise():
    Q = np.array([4.0, 0.5, -0.3, 2.0, 0.1, 1.0])
    file = table(range(5), np.zeros((5, 3)), [[np.nan] * 6, Q, [np.nan] * 6, Q, Q])
    merged = motions_between(file, np.array([0.0, 2.0, 4.0]))
    assert np.isnan(merged[0, 3:]).all()
    np.testing.assert_allclose(merged[1, 3:], 2.0 * Q)


@pytest.mark.parametrize(("model", "wheelbase"), [("unicycle", 1.0), ("bicycle", 0.2)])
def test_a_covariance_of_rank_two_may_be_rounded_and_has_no_eigenvalue_below_zero(model, wheelbase):
    motion = Motion(model=model, control_std=(0.1, 0.15), wheelbase=wheelbase)
    controls = np.random.default_rng(1).uniform(0.2, 0.8, (20, 2))
    told = as_motions(motion, controls, np.full(20, 0.1))
    rounded = np.array([[float(f"{number:.8g}") for number in row] for row in told[:, 3:]])
    time, poses = np.arange(21.0), ends(told[:, :3])
    read = motions_between(table(time, poses, np.vstack([rounded[:1], rounded])), time)
    np.testing.assert_allclose(read[:, 3:], told[:, 3:], rtol=1e-6, atol=1e-10)
    assert np.linalg.eigvalsh(stated_of(np.hstack([told[:, :3], rounded]))).min() < -1e-16
    assert np.linalg.eigvalsh(stated_of(read)).min() >= -1e-18


# What is refused

COVARIANCES = {
    "part": ("1,0,0,4,,,2,0,1", "no motion_xy, motion_xh", "all of a covariance, or none"),
    "hardly negative": ("1,0,0,4,0,0,-1e-9,0,1", "the covariance 4, 0, 0, -1e-09, 0, 1"),
    "negative": ("1,0,0,4,0,0,-2,0,1", "the covariance 4, 0, 0, -2, 0, 1", "0 or more"),
    "correlated": ("1,0,0,1,2,0,1,0,1", "the covariance 1, 2, 0, 1, 0, 1", "between -1 and 1"),
    "correlated with none": ("1,0,0,1,0,0.1,1,0,0", "the covariance 1, 0, 0.1, 1, 0, 0", "digits"),
}


@pytest.mark.parametrize(
    ("row", "parts"), [(r, p) for r, *p in COVARIANCES.values()], ids=COVARIANCES
)
def test_an_invalid_covariance_is_refused_by_its_line(tmp_path, row, parts):
    text = f"{STATED}0,0,0,0,,,,,,\n\n1,0,0,0,,,,,,\n2,{row}\n3,0,0,0,1,0,0,1,0,1\n"
    refused(lambda: read_log(recorded(tmp_path, text)), "odometry.csv, line 5", *parts)


@pytest.mark.parametrize(
    ("row", "parts"),
    [
        ("0.5,2e6,1,3", ("line 6", "x, y [2000000.0, 1.0] after", "at most 1e+06 m between")),
        ("0.5,5,1,-179.0", ("line 6", "heading -179.0 after 3.0", "write radians")),
        ("0.5,5,1,9.5", ("line 6", "heading 9.5 after 3.0", "at most a turn between two rows")),
    ],
)
def test_a_bad_row_of_poses_is_refused_by_its_line(tmp_path, row, parts):
    refused(lambda: read_log(recorded(tmp_path, ODOMETRY + row + "\n")), "odometry.csv", *parts)


def test_unwrapped_headings_and_headings_in_0_to_2_pi_are_accepted(tmp_path):
    for headings in ([0.0, 3.0, 6.0, 9.0], [0.1, 6.27, 0.05, 6.28319]):
        rows = [f"{0.1 * k},0,0,{heading}" for k, heading in enumerate(headings)]
        log = read_log(recorded(tmp_path, "\n".join([HEADER, *rows])))
        np.testing.assert_allclose(log.controls[:, 2], wrap(np.diff(headings)), atol=1e-14)


def test_covariances_may_not_follow_the_columns_of_controls(tmp_path):
    settings = SETTINGS.replace("poses", "unicycle").replace("sideways_std = 0.01\n", "")
    settings = settings.replace("forward", "velocity").replace("turn_std", "angular_rate_std")
    text = STATED.replace("x,y,heading", "velocity,angular_rate") + "0,0,0,,,,,,\n"
    folder = recorded(tmp_path, text, settings)
    with pytest.raises(InputError, match=r"expected the header 'time,velocity,angular_rate'; name"):
        read_log(folder)


@pytest.mark.parametrize("key", ["forward_std", "sideways_std", "turn_std"])
def test_missing_or_negative_noise_of_poses_is_refused_by_key(tmp_path, key):
    settings = re.sub(rf"{key} = .*\n", "", SETTINGS)
    refused(lambda: read_log(recorded(tmp_path, settings=settings)), f"no key {key!r}", "turn_std")
    settings = re.sub(rf"{key} = .*\n", f"{key} = -1\n", SETTINGS)
    refused(lambda: read_log(recorded(tmp_path, settings=settings)), f"key {key!r}: found -1")


def test_keys_of_vehicles_are_refused_for_poses(tmp_path):
    settings = SETTINGS + "velocity_std = 0.1\n"
    refused(lambda: read_log(recorded(tmp_path, settings=settings)), "unknown key 'velocity_std'")
    settings = SETTINGS.replace('"poses"', '["poses"]')
    refused(
        lambda: read_log(recorded(tmp_path, settings=settings)), "key 'motion': found ['poses']"
    )


def test_one_pose_is_no_drive(tmp_path):
    folder = recorded(tmp_path, f"{HEADER}\n0,0,0,0\n0,1,0,0\n")
    refused(lambda: read_log(folder), "odometry.csv", "two times or more")


# A frame that is begun anew


def test_only_motions_far_beyond_the_usual_are_jumps():
    motions, dt = wandering(np.random.default_rng(1), 200, stated=True), np.full(200, 0.1)
    assert jumps(motions, dt).size == 0
    assert jumps(np.zeros((5, 3)), np.ones(5)).size == 0
    motions[70, 1] = -30.0
    motions[90, 2] = 3.1
    assert jumps(motions, dt).tolist() == [70, 90]
    dt[70] = 60.0
    assert 70 not in jumps(motions, dt), "a long way in a long time"


def test_a_small_motion_of_a_nearly_resting_vehicle_is_no_jump():
    motions = np.zeros((100, 3))
    motions[:, 0] = 1e-5
    motions[50] = [0.4, 0.0, 0.4]
    assert jumps(motions, np.ones(100)).size == 0


# What is written


def same_ways(log, other, atol=1e-12):
    """The logs agree but for the rounding of ways, and to the bit where they stand."""
    np.testing.assert_array_equal(other.time, log.time)
    assert other.controls.shape == log.controls.shape
    np.testing.assert_allclose(wrap(other.controls[:, :3] - log.controls[:, :3]), 0.0, atol=atol)
    np.testing.assert_array_equal(other.controls[:, 3:], log.controls[:, 3:])
    still = ~log.controls[:, :3].any(axis=1)
    assert (other.controls[still, :3] == 0.0).all()
    rest = {name: getattr(log, name) for name in ("motion", "control_std", "initial_pose", "gate")}
    assert {name: getattr(other, name) for name in rest} == rest
    assert len(other.scans) == len(log.scans)


@pytest.mark.parametrize("stated", [True, False])
def test_a_log_of_poses_survives_being_written(tmp_path, stated):
    motions = wandering(np.random.default_rng(3), 60, stated=stated)
    time = 1.7e9 + np.cumsum(np.append(0.0, np.random.default_rng(3).uniform(0.01, 0.3, 60)))
    text = poses_file((40.0, -7.0, 3.0), motions, time)
    measured = f"time,landmark,bearing,range\n{time[5].item()!r},7,0.5,4.0\n"
    log = read_log(recorded(tmp_path / "drive", text, measurements=measured))
    np.testing.assert_allclose(log.controls, motions, atol=1e-13)
    write_log(tmp_path / "again" / "drive", log)
    again = read_log(tmp_path / "again" / "drive")
    same_ways(log, again)
    header = (tmp_path / "again" / "drive" / "odometry.csv").read_text().splitlines()[0]
    assert header == HEADER + stated * ("," + ",".join(COVARIANCE))
    readme = (tmp_path / "again" / "drive" / "README.md").read_text()
    assert f"odometry.csv: {header}\n  the motions from row to row count" in readme


def test_the_log_of_poses_of_the_data_survives_being_written(tmp_path):
    log = read_log(DATA / "poses_log")
    write_log(tmp_path / log.name, log)
    same_ways(log, read_log(tmp_path / log.name))


@given(st.lists(st.tuples(lengths, lengths, angles), min_size=1, max_size=20))
def test_motions_between_composed_poses_are_recovered(ways):
    motions = np.array(ways)
    change = relative_motions(poses_along(motions)) - motions
    np.testing.assert_allclose(change[:, :2], 0.0, atol=1e-13)
    np.testing.assert_allclose(wrap(change[:, 2]), 0.0, atol=1e-13)
    assert (np.abs(poses_along(motions)[:, 2]) <= np.pi).all()


@pytest.mark.parametrize("ahead", [0.1, -0.1])
def test_headings_in_degrees_are_doubted_and_turns_in_radians_are_not(ahead):
    heading = np.linspace(0.3, 9.0, 99)
    x, y = np.cumsum(ahead * np.array([np.cos(heading), np.sin(heading)]), axis=1)
    for unit, doubted in ((1.0, False), (180.0 / np.pi, True)):
        column = {"x": x, "y": y, "heading": unit * heading}
        assert turns_in_degrees(Table(path="", line=np.arange(99), column=column)) == doubted


def test_the_poses_on_the_pages_of_the_documentation_are_sound(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "log_format.md").read_text()
    plain, told = re.findall(r"^```text\n(time,x,y,heading.*?)^```", page, re.M | re.S)
    log = read_log(recorded(tmp_path, plain))
    assert log.controls.shape == (3, 3)
    assert log.controls[2].tolist() == [0.0, 0.0, 0.0]
    assert read_log(recorded(tmp_path, told)).controls.shape == (3, 9)
    (keys,) = re.findall(r"^```toml\n(motion = \"poses\".*?)^```", page, re.M | re.S)
    rest = re.sub(r"(?m)^(motion|forward_std|sideways_std|turn_std).*\n", "", SETTINGS)
    log = read_log(recorded(tmp_path, plain, rest + keys))
    assert log.motion == "poses"


def test_every_setting_of_poses_survives_being_written(tmp_path):
    log = read_log(recorded(tmp_path / "drive"))
    log = replace(log, gate=0.9, noise_at_rest=False)
    write_log(tmp_path / "again" / "drive", log)
    again = read_log(tmp_path / "again" / "drive")
    assert (again.gate, again.noise_at_rest, again.control_std) == (0.9, False, (0.02, 0.01, 0.03))
