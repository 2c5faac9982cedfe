"""Recorded logs on trial: the truth beside them, and what each strategy may hear."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.config import AssociationConfig, Config, FilterConfig, InputError, ListeningConfig
from pipistrelle.detection.logs.folder import read_log, write_log
from pipistrelle.detection.logs.readers import Reader
from pipistrelle.detection.logs.recording import Log, LogCaller
from pipistrelle.detection.scans import COLUMNS, make_scan, with_columns
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.estimation.observations.excess_path import excess_path_of
from pipistrelle.experiments.drives import NO_TRUTH, Truth
from pipistrelle.experiments.results.writing import run_entry, tables_of
from pipistrelle.experiments.runs.replay import as_heard_by, drive_of, load, log_motion, replay
from pipistrelle.experiments.runs.truth_files import read_truth, write_truth
from pipistrelle.geometry import range_and_bearing
from pipistrelle.scripting.arguments import with_log
from pipistrelle.settings import from_flags
from reference.missions import scan_with
from reference.refused import refusal_of

DATA = Path(__file__).parents[2] / "data"
MADE_UP = DATA / "mrclam_made_up"
NAN = np.nan


@pytest.fixture
def folder(tmp_path):
    return Path(shutil.copytree(DATA / "unicycle_log", tmp_path / "drive"))


@pytest.fixture
def made_up(tmp_path):
    return Path(shutil.copytree(MADE_UP, tmp_path / "set"))


# The truth


def test_truth_is_linear_between_its_rows_and_unknown_outside_them(folder):
    rows = "time,x,y,heading\n0.0,0,0,0\n1.0,2,-4,1\n1.0,2,-4,3\n2.0,2,0,-3\n"
    (folder / "truth.csv").write_text(rows)
    truth = read_truth(folder, np.array([0.0, 0.25, 1.0, 1.5, 2.0, 2.1]))
    wrapped = 2 * np.pi - 3
    by_hand = [[0, 0, 0], [0.5, -1, 0.75], [2, -4, 3], [2, -2, (3 + wrapped) / 2], [2, 0, wrapped]]
    np.testing.assert_allclose(truth.path[:5], by_hand, atol=1e-15)
    assert np.isnan(truth.path[5]).all()


def test_true_headings_are_interpolated_in_the_shorter_direction(folder):
    rows = "time,x,y,heading\n0.0,0,0,0\n1.0,0,0,2\n1.0,0,0,3.5\n2.0,0,0,3\n"
    (folder / "truth.csv").write_text(rows)
    heading = read_truth(folder, np.array([0.0, 0.5, 1.0, 1.5])).path[:, 2]
    there = 3.5 - 2 * np.pi
    np.testing.assert_allclose(heading, [0.0, there / 2, there, there - 0.25], atol=1e-15)


def test_truth_at_its_rows_times_is_exact(folder):
    rows = np.loadtxt(folder / "truth.csv", delimiter=",", skiprows=1)
    truth = read_truth(folder, rows[:, 0])
    np.testing.assert_array_equal(truth.path[:, :2], rows[:, 1:3])


def test_truth_is_optional_file_by_file(folder):
    log, truth = load(folder)
    assert truth.path.shape == (len(log.time), 3)
    assert truth.landmarks[0].tolist() == [3, 4, 8]
    (folder / "truth.csv").unlink()
    assert load(folder)[1].path is None
    (folder / "landmarks.csv").unlink()
    for place in (folder, DATA / "bicycle_log"):
        log, truth = load(place)
        assert (truth.path, truth.landmarks) == (None, None)
        assert truth.time is log.time


def test_a_measured_landmark_need_not_be_among_the_true_ones(folder):
    log, truth = load(folder)
    measured = set(np.concatenate([scan.landmark for scan in log.scans]).tolist())
    assert measured - set(truth.landmarks[0].tolist()) == {12}


def test_truth_survives_being_written(tmp_path):
    log, truth = load(DATA / "unicycle_log")
    partial = truth.path.copy()
    partial[-3:] = np.nan
    truth = replace(truth, path=partial)
    write_log(tmp_path, log)
    write_truth(tmp_path, truth)
    again = read_truth(tmp_path, log.time)
    np.testing.assert_array_equal(again.path, truth.path)
    np.testing.assert_array_equal(again.landmarks[0], truth.landmarks[0])
    np.testing.assert_array_equal(again.landmarks[1], truth.landmarks[1])


def test_unknown_truth_is_not_written(tmp_path):
    write_truth(tmp_path, NO_TRUTH)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "text", "parts"),
    [
        ("truth.csv", "", ("truth.csv", "no rows")),
        ("truth.csv", "time,x,y\n0,0,0\n", ("line 1", "'time,x,y,heading'")),
        ("truth.csv", "time,x,y,heading\n0,0,0,0\n-1,0,0,0\n", ("line 3", "backwards")),
        ("truth.csv", "time,x,y,heading\n0,0,inf,0\n", ("line 2", "y 'inf'")),
        ("truth.csv", "time,x,y,heading\n9,0,0,0\n", ("truth.csv", "0.0 and 4.0", "clock")),
        ("landmarks.csv", "landmark,x,y\n3,0,0\n4,1,1\n3,0,0\n", ("line 4", "landmark 3 again")),
        ("landmarks.csv", "landmark,x,y\n3,0,\n", ("line 2", "y ''")),
        ("landmarks.csv", "landmark,x,y\n3.2,0,1\n", ("line 2", "landmark 3.2")),
    ],
)
def test_a_wrong_truth_is_refused(folder, name, text, parts):
    (folder / name).write_text(text)
    refusal_of(lambda: load(folder), *parts)


# Whose log


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    refusal_of(lambda: load(tmp_path / "gone"), "gone", "no such folder")
    refusal_of(lambda: load(tmp_path), "log.toml", "no such file")


def test_an_unreadable_recording_is_refused_with_its_kind(tmp_path):
    (tmp_path / "tape").mkdir()
    for name in ("walk.WAV", "tape/walk.flac", "walk.txt"):
        (tmp_path / name).touch()
    for name in ("walk.WAV", "tape"):
        parts = "an audio recording", "a log folder or a MRC", "pipistrelle hear", "docs/sound.md"
        refusal_of(lambda name=name: load(tmp_path / name), *parts)
    refusal_of(lambda: load(tmp_path / "walk.txt"), "a file", "name its folder")


def test_a_log_in_the_folder_of_a_recording_is_read(folder):
    (folder / "walk.wav").touch()
    assert load(folder)[0].scans


def test_a_robot_is_named_for_a_mrclam_set_and_only_there(folder):
    refusal_of(lambda: load(MADE_UP), "--robot", "found no robot", "(1)")
    refusal_of(lambda: load(MADE_UP, 4), "--robot", "found robot 4", "(1)")
    refusal_of(lambda: load(folder, 1), "robot 1", "--robot")


def test_a_robot_is_found_by_the_text_of_its_number():
    assert load(MADE_UP, "1")[0].name == load(MADE_UP, 1)[0].name
    refusal_of(lambda: load(MADE_UP, "one"), "--robot", "found robot one", "(1)")


# A format from elsewhere


def test_a_users_reader_reads_the_log_and_its_truth_files(folder):
    log, truth = load(folder)
    (folder / "log.toml").rename(folder / "other.toml")
    tape = Reader(
        name="tape",
        title="a tape",
        recognises=lambda folder: (folder / "other.toml").exists(),
        read=lambda _: replace(log, name="from a tape"),
    )
    again, beside = load(folder, readers=[tape])
    assert again.name == "from a tape"
    np.testing.assert_array_equal(beside.path, truth.path)


def test_a_users_truth_may_set_the_initial_pose_of_the_log(folder):
    tape = Reader(
        name="tape",
        title="a tape",
        recognises=lambda folder: True,
        read=lambda _, robot, at: replace(read_log(folder), initial_pose=at, name=f"{robot}"),
        robots=lambda folder: ["7"],
    )

    def with_truth(read, folder, robot):
        return read(folder, robot, at=(1.0, 2.0, 3.0)), NO_TRUTH

    known = {"readers": [tape], "truths": {"tape": with_truth}}
    log, truth = load(folder, 7, **known)
    assert (log.initial_pose, log.name) == ((1.0, 2.0, 3.0), "7")
    assert truth is NO_TRUTH
    refusal_of(lambda: load(folder, **known), "found no robot", "(7)")
    refusal_of(
        lambda: load(folder / "gone", **known),
        "a tape or a log folder or a MRCLAM set or a ROS bag;",
    )


def test_a_robot_goes_by_its_name_where_its_format_has_names(folder):
    herd = Reader(
        name="herd",
        title="walks of a herd",
        recognises=lambda folder: True,
        read=lambda _, robot: replace(read_log(folder), name=robot),
        robots=lambda folder: ["ant", "bee"],
    )
    log, truth = load(folder, "bee", readers=[herd])
    assert log.name == "bee"
    assert truth.path is not None
    refusal_of(lambda: load(folder, "cat", readers=[herd]), "found robot cat", "(ant, bee)")
    refusal_of(lambda: load(folder, 1, readers=[herd]), "found robot 1", "(ant, bee)")


# MRCLAM


def test_a_mrclam_track_starts_at_the_true_pose_and_ends_where_the_truth_ends():
    log, truth = load(MADE_UP, 1)
    assert log.time[0] == 1248440000.123
    assert log.time[-1] == 1248440005.5
    assert log.initial_pose == (1.0, -1.0, 3.0)
    assert np.isfinite(truth.path).all()
    assert truth.path[-1, 2] > np.pi
    assert truth.landmarks[0].tolist() == list(range(6, 21))
    np.testing.assert_array_equal(truth.time, log.time)


def test_a_mrclam_track_starts_no_earlier_than_the_truth(made_up):
    path = made_up / "Robot1_Groundtruth.dat"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:4], *lines[154:]]))
    log, truth = load(made_up, 1)
    assert log.time[0] == float(lines[154].split()[0]) == 1248440002.0
    np.testing.assert_allclose(log.initial_pose[:2], np.fromstring(lines[154], sep=" ")[1:3])
    assert np.isfinite(truth.path).all()


@pytest.mark.parametrize("name", ["Robot1_Groundtruth.dat", "Landmark_Groundtruth.dat"])
def test_a_mrclam_set_is_whole(made_up, name):
    (made_up / name).unlink()
    refusal_of(lambda: load(made_up, 1), name, "no such file")


@pytest.mark.parametrize("robot", range(1, 6))
def test_set_6_starts_at_the_truth_and_ends_with_the_shorter(real, robot):
    log, truth = load(real, robot)
    rows = np.loadtxt(real / f"Robot{robot}_Groundtruth.dat")
    odometry = np.loadtxt(real / f"Robot{robot}_Odometry.dat")[:, 0]
    start = [np.interp(odometry[0], rows[:, 0], column) for column in rows[:, 1:3].T]
    np.testing.assert_allclose(log.initial_pose[:2], start, rtol=1e-12)
    assert log.time[-1] == min(rows[-1, 0], odometry[-1])
    assert np.isfinite(truth.path).all()
    assert np.abs(np.diff(truth.path[:, 2])).max() < 0.5


# What a strategy hears

SCAN = scan_with(
    [1, 2, 3, 4, 5], [0.0, 0.25, -0.25, 0.26, -2.0], [1.0, np.nan, 3.0, 4.0, 5.0], time=2.0
)


@pytest.mark.parametrize(
    ("strategy", "beamwidth", "landmark", "distance"),
    [
        ("fused", None, [1, 2, 3, 4, 5], [1, np.nan, 3, 4, 5]),
        ("fused", 0.5, [1, 2, 3, 4, 5], [1, np.nan, 3, np.nan, np.nan]),
        ("active", None, [1, 3, 4, 5], [1, 3, 4, 5]),
        ("active", 0.5, [1, 3], [1, 3]),
        ("passive", None, [1, 2, 3, 4, 5], [np.nan] * 5),
        ("passive", 0.5, [1, 2, 3, 4, 5], [np.nan] * 5),
    ],
)
def test_a_strategy_hears_its_part(strategy, beamwidth, landmark, distance):
    (heard,) = as_heard_by([SCAN], strategy, beamwidth)
    assert heard.time == 2.0
    assert heard.landmark.tolist() == landmark
    np.testing.assert_array_equal(heard.range, np.array(distance, dtype=float))
    np.testing.assert_array_equal(heard.bearing, SCAN.bearing[np.isin(SCAN.landmark, landmark)])


def test_hiding_ranges_leaves_all_other_columns_unchanged():
    said = {name: np.arange(1, 6) + 10 * i for i, name in enumerate(COLUMNS)}
    scan = with_columns(SCAN, **said | {"bearing": SCAN.bearing, "range": SCAN.range})
    (heard,) = as_heard_by([scan], "fused", 0.5)
    for name in set(COLUMNS) - {"range"}:
        np.testing.assert_array_equal(getattr(heard, name), getattr(scan, name))


TIMED = make_scan(
    2.0,
    np.array([1, 2, 3, 1]),
    np.array([0.1, 0.2, 0.3, np.nan]),
    range=np.array([4.0, np.nan, 5.0, np.nan]),
    caller=np.array([1, 1, 0, 2]),
    excess_path=np.array([3.0, 4.0, np.nan, 7.0]),
    excess_path_std=0.1,
)


@pytest.mark.parametrize(
    ("strategy", "landmark", "excess_path"),
    [
        ("fused", [1, 2, 3, 1], [3.0, 4.0, np.nan, 7.0]),
        ("passive", [1, 2, 3, 1], [3.0, 4.0, np.nan, 7.0]),
        ("active", [1, 3], [np.nan, np.nan]),
    ],
)
def test_excess_paths_are_kept_by_strategies_that_listen_to_others(strategy, landmark, excess_path):
    (heard,) = as_heard_by([TIMED], strategy)
    assert heard.landmark.tolist() == landmark
    np.testing.assert_array_equal(heard.excess_path, excess_path)


def test_excess_paths_are_dropped_without_timing():
    callers = (LogCaller(name="boat", landmark=9), LogCaller(name="mate", landmark=8))
    log = replace(looks((0.1, 0.1, 0.1)), callers=callers)
    (look,) = log.scans
    timed = replace(TIMED, time=look.time, callers=np.array([-1, 9, 8]))
    log = replace(log, scans=(timed,))
    for timing, rows in ((True, 4), (False, 3)):
        config = Config(listening=ListeningConfig(excess_paths=timing))
        (trial,) = replay(log, NO_TRUTH, ["fused"], ["ekf"], None, config).trials
        (scan,) = trial.scans
        assert scan.landmark.size == rows
        assert np.isnan(scan.excess_path).all() != timing


def test_rows_of_a_caller_that_moves_are_left_out():
    log = replace(looks((0.1, 0.1, 0.1)), callers=(LogCaller(name="b", landmark=7, moves=True),))
    assert replayed(log, "measured").track.landmarks.landmark.size == 0
    still = replace(log, callers=(LogCaller(name="b", landmark=7),))
    assert replayed(still, "measured").track.landmarks.landmark.tolist() == [7]


def test_hiding_changes_no_scan_and_keeps_empty_ones():
    before = SCAN.range.copy()
    heard = as_heard_by([SCAN, SCAN], "active", 1e-9)
    np.testing.assert_array_equal(SCAN.range, before)
    assert [scan.landmark.tolist() for scan in heard] == [[1], [1]]
    behind = with_columns(SCAN, bearing=3.0)
    assert [scan.landmark.size for scan in as_heard_by([behind], "active", 1.0)] == [0]


def test_fused_is_the_union_of_active_and_passive():
    scans = read_log(DATA / "unicycle_log").scans
    for fused, active, passive in zip(
        *(as_heard_by(scans, strategy, 1.0) for strategy in ("fused", "active", "passive")),
        strict=True,
    ):
        assert fused.landmark.tolist() == passive.landmark.tolist()
        known = np.isfinite(fused.range)
        assert fused.landmark[known].tolist() == active.landmark.tolist()
        assert fused.range[known].tolist() == active.range.tolist()


# What a filter takes


def test_the_filters_take_the_logs_motion_and_start():
    log = read_log(DATA / "bicycle_log")
    motion, start = log_motion(log), drive_of(log, NO_TRUTH).start
    assert (motion.model, motion.control_std, motion.wheelbase) == ("bicycle", (0.1, 0.03), 0.2)
    assert motion.noise_at_rest
    assert start.mean.tolist() == [0.0, -1.0, 0.0]
    assert start.covariance.tolist() == np.diag([0.05**2, 0.05**2, 0.0436**2]).tolist()
    assert not log_motion(load(MADE_UP, 1)[0]).noise_at_rest


# How sure a measurement is


def looks(*rows):
    """A log of a vehicle that stands at a place it is sure of, and looks at a post once a second.

    Rows (bearing, bearing_std, range_std) of a post 2 m away.
    """
    time = np.arange(len(rows) + 1.0)
    scans = [
        scan_with([7], [bearing], [2.0], time=at, bearing_std=bearing_std, range_std=range_std)
        for at, (bearing, bearing_std, range_std) in zip(time[1:], rows, strict=True)
    ]
    return replace(
        log_of(time, np.zeros((len(rows), 2)), scans), control_std=(0.1, 0.15),
        initial_pose_std=(0.0, 0.0, 0.0), noise_at_rest=False, range_std=0.2, bearing_std=0.1,
    )  # fmt: skip


def log_of(time, controls, scans):
    """Return the log of a unicycle that starts, surely, at the origin."""
    return Log(
        name="log", time=time, controls=controls, dt=np.diff(time), scans=tuple(scans),
        motion="unicycle", control_std=(0.01, 0.01), initial_pose=(0.0, 0.0, 0.0),
        initial_pose_std=(0.001, 0.001, 0.001), range_std=0.01, bearing_std=0.01,
        range_bounds=(0.5, 20.0), ignored_rows={},
    )  # fmt: skip


def replayed(log, noise, estimator="ekf"):
    """Replay a log as `pipistrelle slam` does, which takes the constants from it."""
    constants = {"range_std": log.range_std, "bearing_std": log.bearing_std}
    config = Config(filter=FilterConfig(noise=noise, **constants))
    (trial,) = replay(log, NO_TRUTH, ["fused"], [estimator], None, config).trials
    return trial


def bearing_of_post(trial):
    """Return where the map has the post [rad]."""
    ((x, y),) = trial.track.landmarks.mean
    return np.arctan2(y, x)


@pytest.mark.parametrize("estimator", ["ekf", "iekf"])
def test_a_row_stated_ten_times_more_precise_pulls_the_estimate_a_hundred_times_as_much(estimator):
    said = replayed(looks((0.0, NAN, NAN), (0.02, 0.01, NAN)), "measured", estimator)
    assert bearing_of_post(said) == pytest.approx(0.02 * 100 / 101, rel=1e-3)
    unsaid = replayed(looks((0.0, NAN, NAN), (0.02, NAN, NAN)), "measured", estimator)
    assert bearing_of_post(unsaid) == pytest.approx(0.02 / 2, rel=1e-3)


def test_constant_noise_ignores_the_rows_deviations():
    rows = [(0.0, 0.3, NAN), (0.02, 0.01, 0.02), (0.01, NAN, 0.5)]
    said = replayed(looks(*rows), "constant")
    unsaid = replayed(looks(*((bearing, NAN, NAN) for bearing, *_ in rows)), "constant")
    assert {scan.bearing_std.item() for scan in said.scans} == {0.1}
    assert {scan.range_std.item() for scan in said.scans} == {0.2}
    one, other = said.track, unsaid.track
    assert one.pose.mean.tobytes() == other.pose.mean.tobytes()
    assert one.landmarks.mean.tobytes() == other.landmarks.mean.tobytes()
    assert one.landmarks.covariance.tobytes() == other.landmarks.covariance.tobytes()


def test_constant_noise_is_of_a_landmark_however_many_calls_it_was_heard_by():
    rows = np.zeros(3, int), np.array([0.3, 0.31, 0.29])
    scan = make_scan(1.0, *rows, caller=np.array([0, 1, 2]))
    log = replace(looks((0.0, NAN, NAN)), scans=(scan,))
    for noise in ("constant", "measured"):
        assert replayed(log, noise).scans[0].bearing_std.tolist() == [0.1]


def test_fields_that_are_empty_are_filled_with_the_logs_own_constants(folder):
    lines = (folder / "measurements.csv").read_text().splitlines()
    stated = [f"{line},0.01," if k % 2 else f"{line},,0.5" for k, line in enumerate(lines[1:])]
    header = f"{lines[0]},bearing_std,range_std"
    (folder / "measurements.csv").write_text("\n".join([header, *stated]))
    log, _ = load(folder)
    scans = replayed(log, "measured").scans
    told = np.concatenate([np.stack((scan.bearing_std, scan.range_std)) for scan in scans], axis=1)
    pairs = {(0.01, log.range_std), (log.bearing_std, 0.5)}
    assert set(map(tuple, told.T.tolist())) == pairs


def test_the_rows_deviations_are_kept_by_every_strategy():
    log = looks((0.3, 0.01, 0.02), (0.0, NAN, 0.03))
    for strategy in ("active", "fused", "passive"):
        first, second = as_heard_by(log.scans, strategy, 2.0)
        assert (first.bearing_std.item(), first.range_std.item()) == (0.01, 0.02)
        np.testing.assert_array_equal([*second.bearing_std, *second.range_std], [NAN, 0.03])


@pytest.mark.parametrize("estimator", ["ekf", "iekf", "smoother"])
def test_the_stated_position_of_a_caller_initialises_its_echoes(estimator):
    posts, boat = np.array([[3.0, 4.0], [-2.0, 6.0], [5.0, -1.0]]), np.array([8.0, 5.0])
    _, bearing = range_and_bearing(np.zeros(3), posts)
    e = np.array([excess_path_of(np.zeros(2), post, boat) for post in posts])
    made = scan_with([1, 2, 3], bearing, time=1.0, caller=1, excess_path=e, excess_path_std=0.02)
    scan = replace(made, callers=np.array([-1, 9]))
    caller = LogCaller(name="boat", landmark=9, place=(8.0, 5.0))
    told = FilterConfig(bearing_std=0.01, excess_path_std=0.02)
    config = Config(listening=ListeningConfig(excess_paths=True), filter=told)
    for known in (True, False):
        callers = (caller if known else caller.model_copy(update={"place": None}),)
        log = replace(looks((0.0, 0.1, 0.1)), callers=callers, scans=(scan,))
        (trial,) = replay(log, NO_TRUTH, ["fused"], [estimator], None, config).trials
        rows = trial.track.landmarks
        assert (9 in rows.landmark) == known
        for label, post in zip((1, 2, 3), posts, strict=True):
            mine = rows.mean[rows.landmark == label]
            assert (len(mine) == 1) == known, "a ray, else"
            if known:
                np.testing.assert_allclose(mine[0], post, rtol=0, atol=0.05)


def test_a_log_without_labels_is_refused_with_the_option_that_solves_it():
    log = read_log(DATA / "unicycle_log")
    bare = replace(log, scans=tuple(with_columns(scan, landmark=-1) for scan in log.scans))
    with pytest.raises(InputError, match=r"rows without labels.*--association.method marginal"):
        replay(bare, NO_TRUTH, ["fused"], ["ekf"], None, Config())
    config = Config(association=AssociationConfig(method="nearest"))
    (trial,) = replay(bare, NO_TRUTH, ["fused"], ["ekf"], None, config).trials
    assert sum((label > 0).sum() for label in trial.track.labels) > 0
    assert trial.scores.associated_right is None, "nobody knows"
    assert trial.mapped is None


@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_log_without_labels_is_scored_by_the_positions_of_its_landmarks(shift):
    log, truth = load(DATA / "unicycle_log")
    bare = replace(log, scans=tuple(with_columns(scan, landmark=-1) for scan in log.scans))
    config = Config(association=AssociationConfig(method="nearest"))
    labels, places = truth.landmarks
    truth = replace(truth, path=truth.path + np.array([shift, 0.0, 0.0]))
    truth = replace(truth, landmarks=(labels + 100, places + np.array([shift, 0.0])))
    mission = replay(bare, truth, ["fused"], ["ekf"], None, config)
    (trial,) = mission.trials
    full = tables_of(mission.trials, truth)["landmarks"].filter(status="full")
    scores, near = trial.scores, full["error_m"].drop_nulls()
    assert len(near), "by their positions, whatever their numbers are"
    assert abs(near - shift).max() < 2.0, "the whole map may be shifted"
    assert np.sqrt((near**2).mean()) == pytest.approx(scores.map_rmse_m)
    assert scores.landmarks_missed == len(labels) - len(near)
    assert scores.landmarks_false + scores.landmarks_twice == len(full) - len(near)
    assert scores.gospa_missed >= scores.landmarks_missed
    assert run_entry(trial, {})["landmarks_missed"] == scores.landmarks_missed


def test_rows_of_simultaneous_scans_are_scored_by_their_labels():
    log = looks(*[(0.0, 0.01, 0.1)] * 6)
    beside = [scan_with([8], [1.0], [3.0], time=scan.time, bearing_std=0.01) for scan in log.scans]
    pairs = [scan for both in zip(log.scans, beside, strict=True) for scan in both]
    config = Config(association=AssociationConfig(method="nearest"))
    (trial,) = replay(
        replace(log, scans=tuple(pairs)), NO_TRUTH, ["fused"], ["ekf"], None, config
    ).trials
    assert len({*np.concatenate(trial.track.labels).tolist()}) == 2
    assert trial.scores.associated_right == 1.0
    assert {*trial.mapped.landmark.tolist()} == {7, 8}


def test_a_landmark_is_mapped_from_the_pose_of_an_offset_sensor():
    # The sensor is 1 m ahead and 2 m to the left and looks to the left: 3 m ahead of it is (1, 5).
    log = replace(a_log(), sensor_pose=(1.0, 2.0, np.pi / 2))
    log = replace(log, scans=(scan_with([7], [0.0], [3.0], time=0.0),))
    for name in ("ekf", "iekf", "fastslam", "smoother"):
        (trial,) = replay(log, NO_TRUTH, ["active"], [name], None, Config()).trials
        np.testing.assert_allclose(trial.track.landmarks.mean, [[1.0, 5.0]], atol=0.1)
        np.testing.assert_allclose(trial.track.pose.mean[0], 0.0, atol=0.05)


@pytest.mark.parametrize("asked", ["speed_scale", "turn_bias"])
def test_odometry_calibration_with_an_offset_sensor_is_refused(asked):
    config = Config(filter=FilterConfig(calibrate=(asked,)))
    log = replace(a_log(), sensor_pose=(1.0, 0.0, 0.0))
    with pytest.raises(InputError, match=rf"filter\.calibrate: found '{asked}'.*sensor_pose"):
        replay(log, NO_TRUTH, ["active"], ["smoother"], None, config)


def test_a_logs_sensor_settings_are_defaults():
    log = replace(a_log(), association={"clutter_rate": 0.01, "detection_rate": 0.7})
    settled, _ = with_log({}, log, Path("log"))
    found = settled.association
    assert (found.clutter_rate, found.detection_rate) == (0.01, 0.7)
    asked, _ = with_log(from_flags({"association": {"clutter_rate": 0.5}}), log, Path("log"))
    assert asked.association.clutter_rate == 0.5


def a_log():
    """A vehicle that stands."""
    scan = scan_with([7], [0.0], [3.0], time=0.0)
    return log_of(np.array([0.0, 1.0]), np.zeros((1, 2)), [scan])


def test_a_caller_with_a_stated_position_is_mapped_once_without_labels():
    place = np.array([4.0, 5.0])
    log = heard_without_labels(place)
    config = Config(
        association=AssociationConfig(method="marginal"),
        listening=ListeningConfig(excess_paths=True),
    )
    mission = replay(log, Truth(time=log.time), ["fused"], ["iekf"], None, config)
    (trial,) = mission.trials
    (used,) = {scan.callers[1] for scan in trial.scans}
    landmarks = trial.track.landmarks
    near = np.hypot(*(landmarks.mean - place).T) < 1.0
    assert used == 900
    assert landmarks.landmark[near].tolist() == [900]
    assert np.unique(landmarks.landmark).size == 1 + 8


def heard_without_labels(place):
    """A log of eight landmarks and a caller that stands at a place which the log states."""
    rng, motion = np.random.default_rng(4), Motion(model="unicycle", control_std=(0.02, 0.02))
    angles = 0.25 * np.pi * np.arange(8)
    landmarks = np.column_stack((7.0 * np.cos(angles), 3.0 + 7.0 * np.sin(angles)))
    pose, scans, direct = np.zeros(3), [], np.array([-1, 16])
    for k in range(1, 101):
        pose = motion_step(motion, pose, np.array([0.6, 0.2]) + 0.02 * rng.normal(size=2), 0.2)
        r, b = range_and_bearing(pose, landmarks)
        (far,), (to,) = range_and_bearing(pose, place[np.newaxis])
        over = r + np.hypot(*(landmarks - place).T) - far
        bearing = np.concatenate([b, b, [to]]) + 0.01 * rng.normal(size=17)
        nothing = np.full(8, np.nan)
        scan = make_scan(
            0.2 * k, np.full(17, -1), bearing, caller=np.repeat([0, 1], [8, 9]),
            range=np.concatenate([r + 0.02 * rng.normal(size=8), nothing, [np.nan]]),
            excess_path=np.concatenate([nothing, over + 0.02 * rng.normal(size=8), [np.nan]]),
        )  # fmt: skip
        scans.append(replace(scan, direct=direct))
    caller = LogCaller(name="mate", landmark=900, place=tuple(place))
    return replace(
        log_of(0.2 * np.arange(101), np.tile([0.6, 0.2], (100, 1)), scans),
        control_std=(0.02, 0.02), range_std=0.02, excess_path_std=0.02, range_bounds=(0.3, 20.0),
        callers=(caller,),
    )  # fmt: skip
