"""`pipistrelle slam`: the log of a run gives the run's track, and decides what a log decides."""

import re
import shutil
import tomllib
import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import pipistrelle
from pipistrelle.config import Config, InputError
from pipistrelle.detection.logs.folder import read_log
from pipistrelle.detection.scans import COLUMNS
from pipistrelle.estimation.catalogue import CATALOGUE, PAPERS
from pipistrelle.experiments.runs import replay
from pipistrelle.settings import from_text
from reference.bags import (
    LABELLED,
    ODOMETRY,
    RANGE,
    RANGES,
    TRANSFORMS,
    header,
    labelled,
    odometry,
    static,
    write_bag,
)
from reference.command_line import SHORT, summary, table, track
from reference.gallery import CHORUS, TIMED
from reference.odometry import as_motions, poses_file

DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize("estimator", PAPERS)
@pytest.mark.parametrize("strategy", ["all", "active", "passive"])
def test_a_run_and_its_log_give_one_track(obey, strategy, estimator, undrawn):
    words = ("--seed", "9", "--filter", estimator)
    gate, choice = ("--filter.gate", "0.99"), ("--strategy", strategy)
    obey("run", *SHORT, *words, *gate, *choice, "--save-log", "log", "-o", "one")
    times = np.unique(np.loadtxt("log/measurements.csv", delimiter=",", skiprows=1, usecols=0))
    assert (len(times) < 8) == (strategy == "active"), "a frame without measurements leaves no row"
    assert obey("slam", "log", *words, "--quiet", "-o", "two") == (0, "two\n", "")
    heard = "fused" if strategy == "all" else strategy
    ran, replayed = track("one", f"{heard}_{estimator}"), track("two", f"fused_{estimator}")
    assert len(ran) == 33
    np.testing.assert_allclose(replayed, ran, rtol=0, atol=1e-9)
    (run,) = [run for run in summary("one")["runs"] if run["strategy"] == heard]
    (again,) = summary("two")["runs"]
    for score in ("position_rmse_m", "heading_rmse_rad", "nees_mean", "gated", "landmarks_full"):
        assert again[score] == pytest.approx(run[score], rel=1e-9)


@pytest.mark.parametrize("noise", ["constant", "measured"])
def test_a_log_keeps_excess_paths_and_their_callers_bit_for_bit(obey, noise, undrawn):
    told = ("--filter.noise", noise, "--filter.gate", "0.99")
    words = ("--callers", CHORUS, "--listening.excess-paths", "true", "--strategy", "fused")
    obey("run", *SHORT, *words, *told, "--save-log", "log", "-o", "one")
    settings = {"filter__noise": noise, "filter__gate": 0.99, "rays__precise_bearings": "paper"}
    timing = {"callers": from_text(CHORUS), "listening__excess_paths": True}
    ran = pipistrelle.run(
        strategies="fused", settings="paper", duration=4, landmarks=10, **settings, **timing
    )  # the same again: its scans are in no file
    solved = pipistrelle.slam("log", filters="ekf", **settings)
    (one,), (two,) = ran.mission.trials, solved.mission.trials
    assert [scan.time for scan in one.scans if scan.landmark.size] == [s.time for s in two.scans]
    rows = 0
    for scan, again in zip((s for s in one.scans if s.landmark.size), two.scans, strict=True):
        assert scan.callers.tolist() == again.callers.tolist() == [-1, 11, 12, 13]
        for name in set(COLUMNS) - {"level_db"}:
            np.testing.assert_array_equal(getattr(scan, name), getattr(again, name))
        rows += np.sum(np.isnan(scan.bearing))
    assert rows > 0, "some landmark is lit up by two"
    np.testing.assert_allclose(two.track.pose.mean, one.track.pose.mean, rtol=0, atol=1e-9)
    assert ran.measurements.equals(solved.measurements)
    assert {*solved.measurements["caller"].drop_nulls()} == {"beacon", "caller2", "boat"}


def test_slam_uses_excess_paths_of_a_log_by_default(obey, timed, undrawn):
    for more, timing in (((), True), (("--listening.excess-paths", "false"), False)):
        obey("slam", "log", *more, "--quiet", "-o", "two", "--overwrite")
        heard = pl.read_parquet("two/measurements.parquet")
        assert (heard["excess_path_m"].null_count() < heard.height) == timing
        config = tomllib.loads(Path("two/config.toml").read_text())
        assert config["listening"]["excess_paths"] is timing
    obey("slam", str(DATA / "unicycle_log"), "--quiet", "-o", "two", "--overwrite")
    assert tomllib.loads(Path("two/config.toml").read_text())["listening"]["excess_paths"] is False


def test_a_caller_that_moves_is_followed_in_a_log_without_an_excess_path(obey, undrawn):
    ahead = "[{waypoints = [[5, -6], [5, -5]]}]"
    words = ("--callers", ahead, "--listening.excess-paths", "true", "--strategy", "active")
    asked = ("--filter", "smoother", "--filter.gate", "0.99", "--save-log", "log", "-o", "one")
    obey("run", *SHORT, *words, *asked)
    assert obey("slam", "log", "--filter.gate", "0.99", "--quiet", "-o", "two")[2] == ""
    assert tomllib.loads(Path("two/config.toml").read_text())["listening"]["excess_paths"] is True
    ran, solved = track("one", "active_smoother"), track("two", "fused_smoother")
    np.testing.assert_allclose(solved, ran, rtol=0, atol=1e-9)
    assert Path("two/caller_beacon_fused_smoother.tum").is_file()


def told_by_poses(log, folder):
    """Write a log's drive as poses of a recorder, with what each step's noise comes to."""
    recorded = read_log(log)
    motions = as_motions(replay.log_motion(recorded), recorded.controls, recorded.dt)
    shutil.copytree(log, folder)
    text = poses_file((40.0, -7.0, 2.5), motions, recorded.time)
    (folder / "odometry.csv").write_text(text)
    gone = "motion|step|wheelbase|(velocity|angular_rate|speed|steering)_std"
    kept = re.sub(rf"(?m)^({gone}) = .*\n", "", (log / "log.toml").read_text())
    told = 'motion = "poses"\nforward_std = 9\nsideways_std = 9\nturn_std = 9\n'
    (folder / "log.toml").write_text(told + kept)
    return folder


@pytest.mark.parametrize("estimator", CATALOGUE)
@pytest.mark.parametrize("name", ["unicycle_log", "bicycle_log"])
def test_a_log_with_pose_odometry_gives_the_same_track_and_map(obey, name, estimator, undrawn):
    poses = told_by_poses(DATA / name, Path("poses"))
    words = ("--filter", estimator, "--quiet")
    for log, folder in ((DATA / name, "one"), (poses, "two")):
        assert obey("slam", log, *words, "-o", folder) == (0, f"{folder}\n", "")
    one, two = (track(folder, f"fused_{estimator}") for folder in ("one", "two"))
    np.testing.assert_allclose(two, one, rtol=0, atol=1e-8)
    maps = [np.loadtxt(f"{folder}/map_fused_{estimator}.csv", delimiter=",", skiprows=1,
                       usecols=range(6)) for folder in ("one", "two")]  # fmt: skip
    np.testing.assert_allclose(maps[1], maps[0], rtol=0, atol=1e-7)


def test_a_log_of_poses_is_mapped_and_scored(obey):
    status, printed, said = obey("slam", DATA / "poses_log", "-o", "two", "--quiet")
    assert (status, printed, said) == (0, "two\n", "")
    (run,) = summary("two")["runs"]
    assert run["position_rmse_m"] < 0.03
    assert run["landmarks_full"] == 3, "the bearings of one never cross at half a radian"


def test_a_restarted_odometry_frame_is_questioned(obey, undrawn):
    log = shutil.copytree(DATA / "poses_log", "log")
    header, *rows = [line.split(",") for line in Path("log/odometry.csv").read_text().splitlines()]
    for row in rows[20:]:
        row[1] = f"{float(row[1]) + 30:.5f}"
    Path("log/odometry.csv").write_text("\n".join(map(",".join, [header, *rows])))
    _, _, said = obey("slam", log, "-o", "two", "--quiet")
    assert (
        "warning: log: the odometry moves by 29.9 m and turns by 0.167 rad in the 0.2 s from 1.8 s "
        "on; did its frame change?\n"
    ) in said


@pytest.fixture
def log(short_log):
    """The log of a run, to be changed."""
    return shutil.copytree(short_log, Path("log"))


@pytest.fixture
def timed(timed_log):
    """The log of a run with excess paths, to be changed."""
    return shutil.copytree(timed_log, Path("log"))


def test_slam_hides_ranges_by_strategy_and_beam(obey, log, undrawn):
    status, printed, said = obey("slam", log, "--strategy", "all", "--beamwidth", "40", "-o", "two")
    assert (status, printed.splitlines()[-1]) == (0, "two")
    stages = [line[:17].strip() for line in said.splitlines() if "frames/s" in line]
    assert stages == ["active smoother", "fused smoother", "passive smoother"]
    active, fused, passive = (run["measurements_per_frame"] for run in summary("two")["runs"])
    assert active < fused == passive
    assert "position RMSE, aligned [m]" in printed


def test_the_gate_is_given_or_of_the_log_or_of_the_filter(obey, log, undrawn):
    def gate(*words):
        assert obey("slam", log, "--quiet", "--overwrite", "-o", "two", *words)[0] == 0
        return tomllib.loads(Path("two/config.toml").read_text())["filter"]["gate"]

    text = re.sub(r"gate = .*\n", "", (log / "log.toml").read_text())
    (log / "log.toml").write_text(text)
    assert gate() == "auto"
    (log / "log.toml").write_text("gate = 0.95\n" + text)
    assert gate() == 0.95
    Path("mission.toml").write_text("filter.gate = 0.9\n")
    assert gate("--config", "mission.toml") == 0.9
    assert gate("--config", "mission.toml", "--gate", "0.8") == 0.8


def test_slam_takes_the_settings_of_fastslam_from_flags_and_files_and_keeps_them(
    obey, log, undrawn
):
    Path("mission.toml").write_text("fastslam.mixture = 'exact'\nfastslam.particles = 5\n")
    words = ("--filter", "both", "--config", "mission.toml", "--particles", "9")
    status, printed, said = obey("slam", log, *words, "--fastslam.resample-below", "0.5", "-o", "2")
    assert (status, printed.splitlines()[-1]) == (0, "2")
    stages = [line[:17].strip() for line in said.splitlines() if "frames/s" in line]
    assert stages == ["fused ekf", "fused fastslam"]
    kept = tomllib.loads(Path("2/config.toml").read_text())
    assert list(kept) == ["seed", "listening", "association", "filter", "prior", "rays", "fastslam"]
    swarm = {"particles": 9, "resample_below": 0.5, "mixture": "exact", "weights": "marginal"}
    assert kept["fastslam"] == swarm | {
        "resampled_rays": "kept",
        "weighed_by": "all",
        "estimate": "mixture",
    }
    words = ("--filter", "both", "--config", "2/config.toml", "--quiet")
    obey("slam", log, *words, "-o", "again")
    np.testing.assert_array_equal(track("2", "fused_fastslam"), track("again", "fused_fastslam"))


def test_slam_fits_the_rays_to_the_bearings_unless_asked_otherwise(obey, log, undrawn):
    def spacing(*words):
        shutil.rmtree("two", ignore_errors=True)
        assert obey("slam", log, "--quiet", "-o", "two", *words)[0] == 0
        return tomllib.loads(Path("two/config.toml").read_text())["rays"]["precise_bearings"]

    assert spacing() == "auto"
    assert spacing("--rays.precise-bearings", "paper") == "paper"
    assert spacing("--rays.likelihood", "printed") == "paper"
    printed = "--rays.likelihood", "printed", "--rays.precise-bearings", "auto"
    status, _, said = obey("slam", log, *printed)
    assert (status, "needs likelihood" in said) == (2, True)


def test_slam_overrules_settings_that_the_log_decides(obey, log, undrawn):
    own = Config().filter.range_std
    Path("mission.toml").write_text("[filter]\nrange_std = 0.7\n")
    _, _, said = obey("slam", log, "--config", "mission.toml", "-o", "two", "--quiet")
    where = "mission.toml: filter.range_std"
    assert said == f"pipistrelle: warning: {where}: the log decides this, and says {own}\n"
    settled = tomllib.loads(Path("two/config.toml").read_text())
    assert settled["filter"]["range_std"] == own


def test_a_log_is_refused_that_may_need_more_memory_than_there_is_for_its_rays(
    refused, log, monkeypatch
):
    labels = np.loadtxt(log / "measurements.csv", delimiter=",", skiprows=1, usecols=1)
    there = len(set(labels.tolist()))
    bytes_of = [24.0 * (3 + 2 * there * members) ** 2 for members in (1, 4)]
    monkeypatch.setattr("pipistrelle.experiments.machine.installed", lambda: np.mean(bytes_of))
    said = refused("slam", log, "--filter", "ekf", "-o", "two")
    assert said.startswith(f"ekf: {there} landmarks of 4 members each (rays.range_ratio) may need")
    assert not Path("two").exists()


def scaled(lines, column, factor):
    """Return the lines of a table with one column in another unit."""
    header, *rows = [line.split(",") for line in lines]
    for row in rows:
        if row[column]:
            row[column] = repr(float(row[column]) * factor)
    return list(map(",".join, [header, *rows]))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda rows: [*rows, "99.0,3,0.1,4.0"], "log: rows left out: 1 outside odometry"),
        (lambda rows: [*rows, "4.0,-1,0.1,4.0", "4.0,-1,0.2,"], "log: rows left out: 2 clutter"),
        (lambda rows: scaled(rows, 2, 180.0 / np.pi),
         r"log: \d+ of \d+ bearings are beyond a turn; are they in radians\?"),
        (lambda rows: scaled(rows, 3, 1000.0),
         r"log: (\d+) of \1 ranges are not .* \(0.5 to 20 m\); are ranges in metres\?"),
    ],
)  # fmt: skip
def test_doubtful_rows_of_a_log_are_named_in_a_line(obey, log, undrawn, change, told):
    path = log / "measurements.csv"
    path.write_text("\n".join([*change(path.read_text().splitlines()), ""]))
    _, _, said = obey("slam", log, "-o", "two", "--quiet")
    assert re.match(f"pipistrelle: warning: {told}\n", said)
    if "left out" in told:
        number, *reason = told.rsplit(": ")[-1].split()
        assert summary("two")["runs"][0]["ignored_rows"] == {"_".join(reason): int(number)}


def test_measurements_that_do_not_fit_are_asked_about(obey, log, undrawn):
    status, _, said = obey("slam", log, "--filter", "ekf", "-o", "two", "--quiet", "--gate", "0.01")
    assert status == 0
    gated = summary("two")["runs"][0]["gated"]
    assert re.fullmatch(
        rf"pipistrelle: warning: log: {gated} of \d+ measurements do not fit what was expected "
        r"\(fused ekf\); are bearings in radians and counter-clockwise, ranges in metres, "
        r"all labels right, and stated noise large enough\?\n",
        said,
    )


def test_of_poses_the_unit_of_headings_is_asked_about_too(obey, undrawn):
    said = obey("slam", DATA / "poses_log", "-o", "two", "--quiet", "--gate", "0.01")[2]
    assert "are bearings and headings in radians" in said


def test_a_gate_with_too_many_rejections_is_reported_with_advice(obey, log, undrawn):
    rows = [row.split(",") for row in (log / "measurements.csv").read_text().splitlines()]
    last = max(i for i, row in enumerate(rows) if row[3])
    rows[last][2] = repr(float(rows[last][2]) + 1.5)
    (log / "measurements.csv").write_text("\n".join(map(",".join, [*rows, []])))
    words = ("slam", log, "--filter", "ekf", "--quiet", "-o", "two", "--overwrite")
    said = obey(*words, "--gate", "0.999")[2]
    share = 100.0 / (len(rows) - 1)
    assert f"the gate rejects {share:.1f}% of the measurements (fused ekf), expected 0.1%" in said
    assert 'filter.robust = "huber"' in said
    said = obey(*words, "--gate", "1")[2]
    assert re.search(r"its innovations are [\d.]+ times what it expects \(NIS [\d.]+, 1 ", said)
    assert said.count("\n") == 1, "it rejects nothing, and believes too much"
    assert obey(*words, "--gate", "0.99")[2] == "", "more is expected of a narrower gate"


def test_a_truth_of_another_clock_is_refused(refused, log):
    lines = [line.split(",") for line in (log / "truth.csv").read_text().splitlines()]
    rows = [[repr(1e6 * float(time)), *rest] for time, *rest in lines[1:]]
    (log / "truth.csv").write_text("\n".join(map(",".join, [lines[0], *rows])))
    said = refused("slam", log, "-o", "two")
    assert said.endswith("expected seconds; multiply them by 1e-06")


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1.0 / 343.0, r"(\d+) of \1 excess paths are below 0.2 m; are excess paths in metres\?\n"),
        (1000.0, r"excess paths are more than twice the far end of range_bounds \(0.5 to 20 m\)"),
    ],
)
def test_excess_paths_in_seconds_or_millimetres_are_asked_about(obey, timed, factor, said, undrawn):
    path = timed / "measurements.csv"
    lines = path.read_text().splitlines()
    assert "metres" not in obey("slam", "log", "-o", "two", "--quiet")[2]
    column = lines[0].split(",").index("excess_path")
    path.write_text("\n".join([*scaled(lines, column, factor), ""]))
    assert re.search(said, obey("slam", "log", "-o", "three", "--quiet")[2])


def test_a_caller_that_no_row_measures_is_named_unless_its_place_is(obey, timed, undrawn):
    path = timed / "log.toml"
    wrong = path.read_text().replace("landmark = 12", "landmark = 99")
    for place, said in (
        ("", "no row measures landmark 99, the caller 'caller2'"),
        ("\nplace = [3, 4]", ""),
    ):
        path.write_text(wrong.replace("landmark = 99", f"landmark = 99{place}"))
        told = obey("slam", "log", "-o", f"two{len(place)}", "--quiet")[2]
        assert (said in told) if said else "no row measures" not in told


def test_a_caller_that_no_row_measures_is_not_missed_where_there_is_no_excess_path(obey, undrawn):
    obey("run", *SHORT, *TIMED[:-1], "active", "--save-log", "log", "-o", "one")
    assert 'name = "boat"' in Path("log/log.toml").read_text()
    assert obey("slam", "log", "-o", "two", "--quiet")[2] == ""


@pytest.mark.parametrize("name", ["truth.csv", "landmarks.csv"])
@pytest.mark.parametrize("target", ["nowhere.csv", "itself"])
def test_a_truth_that_is_a_link_to_no_file_is_refused(refused, log, name, target):
    (log / name).unlink()
    (log / name).symlink_to(name if target == "itself" else target)
    assert refused("slam", log, "-o", "two").startswith(f"log/{name}: found ")
    assert not Path("two").exists()


def test_a_log_without_truth_is_mapped_and_not_scored(obey, log):
    (log / "truth.csv").unlink()
    (log / "landmarks.csv").unlink()
    status, printed, _ = obey("slam", log, "--filter", "ekf", "-o", "two")
    assert status == 0
    assert "RMSE" not in printed
    rows = table(printed)
    track = pl.read_parquet("two/steps.parquet")
    last = track.row(-1, named=True)
    spread = np.hypot(last["x_std_m"], last["y_std_m"])
    told = {"rejected by the gate [%]": "0.00", "final position, 1 sigma [m]": f"{spread:.3f}"}
    recorded, truth = replay.load(log)
    told["driven, by the odometry [m]"] = f"{np.abs(recorded.controls[:, 0]) @ recorded.dt:.1f}"
    (run,) = summary("two")["runs"]
    told["innovations, NIS"] = f"{run['nis_mean']:.2f}"
    assert {title: rows[title][0].strip() for title in told} == told
    assert (truth.path, truth.landmarks) == (None, None)


@pytest.mark.parametrize(("share", "warned"), [(1.0, False), (0.05, True)])
def test_innovations_larger_than_predicted_are_reported(obey, log, undrawn, share, warned):
    path = log / "log.toml"
    stds = re.compile(r"(?m)^((?:range|bearing|speed|steering)_std = )(\S+)$")
    path.write_text(stds.sub(lambda row: f"{row[1]}{share * float(row[2])}", path.read_text()))
    _, _, said = obey("slam", log, "--filter", "ekf", "--gate", "1", "-o", "two", "--quiet")
    (run,) = summary("two")["runs"]
    assert (run["nis_mean"] > 2.0) == warned
    assert (f"(NIS {run['nis_mean']:.3g}, 1 where it believes rightly)" in said) == warned


def test_a_log_with_partial_truth_is_scored_on_that_part(obey, log, undrawn):
    rows = (log / "truth.csv").read_text().splitlines()
    (log / "truth.csv").write_text("\n".join(rows[:20]))
    status, _, said = obey("slam", log, "-o", "two")
    assert (status, "the truth covers 18 of 32 steps" in said) == (0, True)
    (run,) = summary("two")["runs"]
    assert 0 < run["position_rmse_m"] < 5
    assert run["diverged"] is False


def test_several_filters_side_by_side_have_each_the_gate_that_suits_it(obey, log, undrawn):
    settings = (log / "log.toml").read_text()
    (log / "log.toml").write_text(re.sub(r"gate = .*\n", "", settings))
    words = ("--filter.robust", "huber", "--filter", "iekf,smoother")
    assert obey("slam", log, *words, "-o", "both")[0] == 0
    assert [run["filter"] for run in summary("both")["runs"]] == ["iekf", "smoother"]
    for name, gate in (("iekf", "0.999"), ("smoother", "1")):
        obey("slam", log, "--filter.robust", "huber", "--filter", name, "--gate", gate, "-o", name)
        np.testing.assert_array_equal(track("both", f"fused_{name}"), track(name, f"fused_{name}"))
    assert replay.rerun(Path("both")).difference == ""


def bagged(path, **more):
    """Write a bag of a drive past three posts, with its truth on a topic."""
    posts, told = np.array([[2.0, 1.0], [3.0, -1.5], [5.0, 0.5]]), []
    for time in (0.1 * np.arange(40)).round(3).tolist():
        told.append(("/odom", ODOMETRY, time, odometry(time, time, 0.0, 0.0, 1.0)))
        told.append(("/true", ODOMETRY, time, odometry(time, 7.0, 1.0 + time, np.pi / 2.0)))
        seen = [
            (i, np.arctan2(y, x - time), np.hypot(y, x - time)) for i, (x, y) in enumerate(posts)
        ]
        told.append(("/seen", LABELLED, time, labelled(time, seen)))
    return write_bag(Path(path), told, **more)


def test_slam_solves_a_bag_scores_it_by_a_topic_and_does_it_again(obey, undrawn):
    bagged("walk.mcap")
    status, printed, said = obey("slam", "walk.mcap", "--truth", "/true", "-o", "one")
    assert (status, printed.splitlines()[-1]) == (0, "one")
    assert "pipistrelle: walk.mcap: /odom is the odometry" in said
    assert "warning" not in said
    (run,) = summary("one")["runs"]
    assert run["position_rmse_m"] < 0.02
    kept = tomllib.loads(Path("one/config.toml").read_text())
    assert kept["bag"]["truth"] == "/true"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = pipistrelle.slam("walk.mcap", bag={"truth": "/true"})
    assert done.summary["position_rmse_m"].item() == pytest.approx(run["position_rmse_m"])
    assert pipistrelle.load("one").figure() is None  # drawn by nobody here, but done again
    Path("walk.mcap").write_bytes(b"")
    with pytest.raises(InputError, match=r"walk.mcap was changed"):
        pipistrelle.load("one").figure()


def test_topics_of_a_bag_are_listed_with_their_roles(obey, refused):
    bagged("walk", late=0.5)
    status, printed, _ = obey("slam", "walk", "--topics", "--truth", "/true")
    assert status == 0
    rows = {line.split()[0]: line.split()[1:] for line in printed.splitlines()[1:]}
    assert rows["/odom"] == ["nav_msgs/msg/Odometry", "40", "0.500", "4.400", "10", "odometry"]
    assert rows["/true"][-1] == "truth"
    assert rows["/seen"][-1] == "echoes"
    assert refused("slam", "walk", "-o", "one").endswith("if there is one, --truth TOPIC")
    assert "--bag.odometry or --truth names it" in obey("slam", "walk", "--topics")[1]


def test_options_of_bags_are_rejected_for_a_log_folder(log, refused):
    assert refused("slam", log, "--truth", "/true").startswith("--truth: means nothing to a log")
    assert "no ROS bag" in refused("slam", log, "--topics")


def test_a_bag_without_labels_is_solved_by_an_association(obey, undrawn):
    told = []
    for time in (0.1 * np.arange(40)).round(3).tolist():
        told.append(("/odom", ODOMETRY, time, odometry(time, time, 0.0, 0.0, 1.0)))
        ways = np.array([[2.0, 1.0], [3.0, -1.5], [9.0, 0.5]]) - [time, 0.0]
        far = np.hypot(*ways.T)
        beams = [{"x": x, "y": y} for x, y in ways / far[:, None]]
        beams = {"header": header(time, "base_link"), "beam_unit_vec": beams, "ranges": far}
        told.append(("/beams", RANGES, time, beams))
    write_bag(Path("walk.db3"), told)
    status, _, said = obey("slam", "walk.db3", "-o", "one")
    assert (status, "rows without labels" in said) == (2, True)
    words = ("--association.method", "marginal", "--quiet", "-o", "one")
    assert obey("slam", "walk.db3", *words, "--bag.bearing-std", "0.02")[0] == 0
    assert len(Path("one/map_fused_smoother.csv").read_text().splitlines()) == 4


def sonars(path, width=0.3):
    """Write a bag of a drive between posts, by two sonars of a cone that wide to either side."""
    rng, posts = np.random.default_rng(3), np.array([[1.5, 2], [3, -2], [5, 1.8], [6.5, -1.5]])
    mounts, told = {"left": (0.1, 0.6), "right": (-0.1, -0.6)}, []
    for name, (aside, turned) in mounts.items():
        tie = static("base_link", name, 0.1, aside, turned)
        told.append(("/tf_static", TRANSFORMS, 0.0, tie))
    for i in range(160):
        time, x = 0.1 * i, 0.04 * i
        told.append(("/odom", ODOMETRY, time, odometry(time, x, 0.0, 0.0)))
        for name, (aside, turned) in mounts.items():
            away = posts - [x + 0.1, aside]
            far = np.hypot(*away.T) + rng.normal(0.0, 0.02, len(posts))
            seen = np.abs(np.arctan2(away[:, 1], away[:, 0]) - turned) < width / 2.0
            about = {"field_of_view": width, "min_range": 0.1, "max_range": 5.0}
            about |= {"header": header(time, name), "range": np.min(far[seen], initial=5.0)}
            told.append(("/" + name, RANGE, time, about))
    write_bag(path, told)
    return posts


@pytest.mark.parametrize(
    "width", [0.3, *(pytest.param(w, marks=pytest.mark.slow) for w in (0.15, 0.52))]
)
def test_a_bag_of_two_sonars_maps_landmarks_however_wide_their_cones_are(obey, undrawn, width):
    posts = sonars(Path("walk.mcap"), width)
    words = ("slam", "walk.mcap", "--association.method", "marginal", "-o")
    _, _, said = obey(*words, "one")
    (run,) = summary("one")["runs"]
    found = pl.read_csv("one/map_fused_smoother.csv").select("x", "y").to_numpy()
    assert len(found) >= 3
    far = np.linalg.norm(found[:, None] - posts, axis=2).min(axis=1)
    assert np.median(far) < 0.6
    assert "unsure_bearing" not in run["ignored_rows"]
    assert "sensing are left out" not in said
    _, _, said = obey(*words, "two", "--association.max-angle-std", "0.04")
    (run,) = summary("two")["runs"]
    rows = run["ignored_rows"]["unsure_bearing"]
    assert rows + run["ignored_rows"]["nothing_heard"] == 320
    assert f"none of the {rows} rows of fused sensing is of a landmark" in said
    assert f"{rows} rows of fused sensing are left out" in said
    assert "--association.max-angle-std 0." in said
    assert "nothing in it is heard" not in said


def test_discarded_rows_are_counted_by_the_limits_of_each_filter(obey, undrawn):
    sonars(Path("walk.mcap"))
    words = ["slam", "walk.mcap", "--association.method", "marginal", "--filter", "ekf,smoother"]
    Path("own.toml").write_text("[own.ekf.association]\nmax_angle_std = 0.04\n")
    assert obey(*words, "--config", "own.toml", "-o", "out")[0] == 0
    ekf, smoother = summary("out")["runs"]
    assert ekf["ignored_rows"]["unsure_bearing"] > 10
    assert "unsure_bearing" not in smoother["ignored_rows"]


def test_log_without_labels_is_scored_by_the_positions_of_its_landmarks(obey, undrawn):
    words = ("--duration", "8", "--landmarks", "12", "--seed", "3", "--quiet")
    obey("run", *words, "--strategy", "active", "--save-log", "log", "-o", "one")
    rows = pl.read_csv("log/measurements.csv")
    rows.with_columns(landmark=pl.lit(None, pl.Int64)).write_csv("log/measurements.csv")
    told = ("--association.method", "marginal", "--strategy", "active")
    _, printed, _ = obey("slam", "log", *told, "-o", "two")
    (run,) = summary("two")["runs"]
    there = table(printed)
    assert float(there["map RMSE [m]"][0]) == pytest.approx(run["map_rmse_m"], abs=1e-3)
    assert {"GOSPA of the map [m]", "landmarks missed", "landmarks false"} <= there.keys()
    found = pl.read_parquet("two/landmarks.parquet").filter(status="full")
    error = found["error_m"].drop_nulls()
    assert len(error) > 3
    assert error.max() < 2.0
    assert np.sqrt((error**2).mean()) == pytest.approx(run["map_rmse_m"])
    shown = pipistrelle.slam("log", association__method="marginal", strategies="active").summary
    assert shown["map_rmse_m"].to_list() == [run["map_rmse_m"]]
    assert shown["gospa_m"].to_list() == [run["gospa_m"]]


def test_log_that_is_solved_whole_is_headed_all_rows(obey, undrawn):
    log = DATA / "unicycle_log"
    _, printed, _ = obey("slam", log, "--filter", "ekf", "-o", "one")
    assert printed.splitlines()[0].strip() == "all rows"
    assert Path("one/track_fused_ekf.tum").exists(), "files keep the strategy's name"
    _, printed, _ = obey("slam", log, "--filter", "ekf", "--strategy", "all", "-o", "two")
    assert printed.splitlines()[0].split() == ["active", "fused", "passive"]
