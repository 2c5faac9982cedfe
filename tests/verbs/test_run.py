"""`pipistrelle run` and `pipistrelle config`: output, result folders, settings."""

import json
import re
import tomllib
from dataclasses import replace
from math import degrees, inf
from pathlib import Path

import numba
import numpy as np
import polars as pl
import pytest

import pipistrelle
from pipistrelle import files, jit
from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import Config
from pipistrelle.estimation.catalogue import PAPERS
from pipistrelle.estimation.fastslam.filter import FastSlam
from pipistrelle.evaluation.bound import IN_ONE_WORLD
from pipistrelle.evaluation.scores import SCORES
from pipistrelle.experiments.studies.plan import Plan
from pipistrelle.scripting import missions
from pipistrelle.settings import from_text
from pipistrelle.verbs.console import answer
from reference.command_line import COMPILING, SHORT, contents, summary, table, track
from reference.results import loop, mission_folder, study_folder
from report.drawing import draw_only

SAVED = {"--save-log": ("log.toml", "truth.csv"), "--save-sound": ("recording.wav",)}


def test_a_run_prints_its_stages_scores_and_folder(obey):
    status, printed, said = obey("run", *SHORT, "-o", "one")
    assert status == 0
    assert printed.splitlines()[-1] == "one"
    stages = ["listening", "active ekf", "fused ekf", "passive ekf"]
    lines = [line for line in said.splitlines() if line != COMPILING]
    assert [line[:17].strip() for line in lines] == stages
    assert all(re.fullmatch(r".{17} +8 frames, \d+ frames/s", line) for line in lines)
    runs = summary("one")["runs"]
    assert [run["strategy"] for run in runs] == ["active", "fused", "passive"]
    rows = {title: [cell.strip() for cell in cells] for title, cells in table(printed).items()}
    assert rows["position RMSE [m]"] == [f"{run['position_rmse_m']:.3f}" for run in runs]
    assert rows["measurements per frame"] == [f"{r['measurements_per_frame']:.2f}" for r in runs]
    counts = [f"{run['landmarks_full']} / {run['landmarks_total']}" for run in runs]
    assert rows["landmarks, placed / heard"] == counts
    assert "fully placed, particles' mean" not in rows
    assert "position_floor_m" in summary("one")["runs"][0], "kept, and no row of one world"
    titles = [title for title in rows if title.startswith(("position", "heading"))]
    assert titles == [
        "position RMSE [m]", "heading RMSE [rad]", "position RMSE, aligned [m]",
        "position bound over worlds [m]", "heading bound over worlds [rad]",
    ]  # fmt: skip
    assert IN_ONE_WORLD in printed
    assert f"\n\nListening, ekf: {runs[1]['landmarks_full']} landmark" in printed
    assert {"mission.png", "mission.pdf", "config.toml"} <= {p.name for p in Path("one").iterdir()}


def test_the_closing_sentence_is_on_listening_or_on_the_most_accurate_estimate():
    active = {"landmarks_full": 20, "position_rmse_aligned_m": 0.018, "map_rmse_shared_m": 0.041}
    fused = {"landmarks_full": 38, "position_rmse_aligned_m": 0.013, "map_rmse_shared_m": 0.008}
    far = {"landmarks_full": 1, "position_rmse_aligned_m": inf, "diverged": True}
    one = [("active", "ekf", active), ("fused", "ekf", fused)]
    listening = (
        "Listening, ekf: 38 landmarks instead of 20; aligned path error 13 mm instead of 18 mm; "
        "aligned error of the landmarks that all strategies placed 8 mm instead of 41 mm."
    )
    assert answer(one) == listening
    assert answer([("active", "iekf", active), ("fused", "iekf", far), *one]) == listening
    assert answer([*one, ("fused", "smoother", active)]) == listening, "without active sensing"
    assert answer([("all rows", "my:Own", far)]) == "my:Own: 1 landmark; diverged."
    two = [("active", "iekf", far), one[0]]
    assert answer(two).startswith("active ekf: 20 landmarks; aligned path error 18 mm; aligned er")
    untrue = {"landmarks_full": 7, "position_rmse_aligned_m": None, "final_std_m": 0.25}
    assert "of the final position 250 mm." in answer([("all rows", "smoother", untrue)])


@pytest.mark.parametrize(("words", "said"), [((), 1), (("--quiet",), 0)])
def test_compilation_is_announced(obey, undrawn, monkeypatch, words, said):
    run_mission = missions.run_mission

    def compiling(*given, **named):
        numba.njit(lambda x: x + 1)(1.0)
        return run_mission(*given, **named)

    monkeypatch.setattr(jit._CLOCK, "said", False)  # as in a new process
    monkeypatch.setattr(missions, "run_mission", compiling)
    assert obey("run", *SHORT, *words)[2].count(COMPILING) == said


def test_an_estimate_far_from_its_bound_is_reported_once(obey, undrawn, monkeypatch):
    words = ("run", *SHORT, "--strategy", "fused", "--filter", "ekf,iekf", "--quiet", "-o")
    assert "times the bound" not in obey(*words, "one")[2]
    monkeypatch.setattr(missions, "MAX_TIMES_BOUND", 0.0)
    said = obey(*words, "two")[2].splitlines()
    runs = summary("two")["runs"]
    assert [run["filter"] for run in runs] == ["ekf", "iekf"]
    for line, run in zip(said, runs, strict=True):
        times = run["position_rmse_m"] / run["position_bound_m"]
        assert line.startswith(f"pipistrelle: warning: fused {run['filter']}: its position error")
        assert f"is {times:.1f} times the bound" in line


@pytest.mark.parametrize(("rounding", "said"), [(missions.ROUNDING, 0), (0.0, 1)])
def test_run_keeps_results_and_names_no_ratio_if_the_bound_is_zero(
    obey, undrawn, monkeypatch, rounding, said
):
    monkeypatch.setattr(missions, "ROUNDING", rounding)
    still = ("--scenario.speed", "0", "--motion.speed-std", "0", "--filter.range-std", "1e-6")
    words = ("--duration", "1", "--seed", "728518", "--filter", "iekf", "--quiet", "-o", "one")
    status, _, warned = obey("run", *still, *words)
    assert status == 0
    assert {run["position_bound_m"] for run in summary("one")["runs"]} == {0.0}
    assert warned.count("is above the bound, 0 m") == warned.count("warning") == said


def test_failing_warning_loses_no_results(obey, undrawn, monkeypatch):
    def failing(trials):
        raise ZeroDivisionError

    monkeypatch.setattr(missions, "_far_off", failing)
    with pytest.raises(ZeroDivisionError):
        obey("run", *SHORT, "--strategy", "fused", "--quiet", "-o", "one", "--save-log", "log")
    assert summary("one")["runs"]
    assert Path("log/log.toml").exists()


def test_loading_kernels_is_not_announced(obey, undrawn):
    obey("run", *SHORT)
    assert COMPILING not in obey("run", *SHORT)[2]


def test_two_filters_are_printed_within_100_columns(obey, undrawn, monkeypatch):
    run_mission, seen = missions.run_mission, []

    def seeing(*words, **named):
        seen.append(run_mission(*words, **named))
        return seen[-1]

    monkeypatch.setattr(missions, "run_mission", seeing)
    status, printed, said = obey("run", *SHORT, "--filter", "both", "--particles", "7", "-o", "one")
    assert status == 0
    names = [(s, f) for s in ("active", "fused", "passive") for f in PAPERS]
    lines = [line for line in said.splitlines() if line != COMPILING]
    assert [line[:17].strip() for line in lines] == ["listening", *map(" ".join, names)]
    assert [(run["strategy"], run["filter"]) for run in summary("one")["runs"]] == names
    strategies, filters = (line.split() for line in printed.splitlines()[:2])
    assert list(zip(strategies, filters, strict=True)) == names
    assert max(map(len, printed.splitlines())) <= 100
    rows = table(printed)
    assert all(len(cells) == 6 for cells in rows.values())
    tracks = [result.track for result in seen[-1].trials]
    assert [len(track.cloud) for track in tracks[1::2]] == [7, 7, 7]
    mean = ["-" if track.full is None else f"{track.full:.1f}" for track in tracks]
    assert [cell.strip() for cell in rows["fully placed, particles' mean"]] == mean
    assert mean[::2] == ["-", "-", "-"] != mean[1::2]
    assert tomllib.loads(Path("one/config.toml").read_text())["fastslam"]["particles"] == 7


def test_the_closing_table_keeps_its_columns_however_large_its_numbers(obey, monkeypatch, undrawn):
    run_mission = missions.run_mission

    def wild(*words, **named):
        mission = run_mission(*words, **named)
        first, *others = mission.trials
        scores = replace(first.scores, position_rmse_m=-1.234e300, nees_max=float("inf"))
        return replace(mission, trials=(replace(first, scores=scores), *others))

    monkeypatch.setattr(missions, "run_mission", wild)
    rows = table(obey("run", *SHORT, "-o", "one")[1])
    assert rows["position RMSE [m]"][0] == " -1.23e+300"
    assert rows["NEES, largest"][0].strip() == "inf"
    assert {len(cells) for cells in rows.values()} == {3}


def test_a_quiet_run_prints_only_its_folder(obey, undrawn):
    assert obey("run", *SHORT, "-o", "one", "--strategy", "active", "--quiet") == (0, "one\n", "")
    assert len(summary("one")["runs"]) == 1


def test_the_settings_of_a_run_are_a_file_that_repeats_it(obey, undrawn):
    words = ("--strategy", "fused", "--quiet")
    obey("run", *SHORT, "--seed", "5", "--rays.exponent", "3", *words, "-o", "one")
    obey("run", "--config", "one/config.toml", *words, "-o", "two")
    assert summary("one")["config_hash"] == summary("two")["config_hash"]
    np.testing.assert_array_equal(track("one", "fused_ekf"), track("two", "fused_ekf"))


@pytest.mark.parametrize("trouble", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize(
    "place", ["scripting.missions.run_mission", "figures.mission.draw_mission"]
)
def test_earlier_results_survive_a_failed_mission(obey, undrawn, monkeypatch, trouble, place):
    def interrupted(*_, **__):
        raise trouble

    words = ("run", *SHORT, "--strategy", "active", "--quiet", "-o", "one")
    obey(*words, "--save-log", "log")
    results, log = contents("one"), contents("log")
    monkeypatch.setattr(f"pipistrelle.{place}", interrupted)
    again = (*words, "--seed", "9", "--overwrite", "--save-log", "log")
    assert obey(*again)[0] == (130 if trouble is KeyboardInterrupt else 2)
    assert contents("one") == results
    assert contents("log") == log


def test_an_estimate_that_is_not_finite_is_a_failed_trial(obey, monkeypatch, undrawn):
    run_mission = missions.run_mission

    def lost(*words, **named):
        mission = run_mission(*words, **named)
        done = mission.trials[0]
        pose = replace(done.track.pose, mean=np.full_like(done.track.pose.mean, np.nan))
        failed = replace(done, track=replace(done.track, pose=pose))
        return replace(mission, trials=(failed, *mission.trials[1:]))

    monkeypatch.setattr(missions, "run_mission", lost)
    status, printed, said = obey("run", *SHORT, "-o", "one")
    assert (status, printed.splitlines()[-1]) == (1, "one")
    assert "warning: active ekf failed" in said


def test_a_failing_estimator_loses_only_its_estimate(obey, undrawn, monkeypatch):
    def failing(*_):
        raise RuntimeError("\n  No solution\nwas found.\n\nfor more information.")

    monkeypatch.setattr(FastSlam, "update", failing)
    words = ("--filter", "both", "--strategy", "active", "--quiet", "-o")
    for verb in (("run", *SHORT, "--save-log", "log"), ("slam", "log")):
        status, printed, said = obey(*verb, *words, verb[0])
        assert (status, printed) == (1, f"{verb[0]}\n")
        why = "active fastslam failed: RuntimeError: No solution (test_run.py, line "
        assert said.startswith(f"pipistrelle: warning: {why}")
        assert said.count("\n") == 1
        ekf, lost = summary(verb[0])["runs"]
        assert (ekf["filter"], ekf["diverged"], lost["diverged"]) == ("ekf", False, True)
        assert np.isfinite(track(verb[0], "active_ekf")).all()
    assert obey("view", "run", "--quiet")[0] == 0
    with pytest.warns(UserWarning, match="active fastslam failed: RuntimeError: No solution"):
        done = pipistrelle.slam("log", filters="both", strategies="active")
    assert done.summary["filter"].to_list() == ["ekf", "fastslam"]


def test_measurements_do_not_depend_on_the_filter(obey, undrawn):
    boat = '[{name="boat",frequency=25000.0,course="circle"}]'
    words = ("--duration", "4", "--landmarks", "8", "--particles", "20", "--strategy", "fused")
    words += ("--listening.excess-paths", "true", "--callers", boat, "--quiet")
    for name in ("ekf", "both"):
        own = [word for word in words if name == "both" or word not in ("--particles", "20")]
        obey("run", *own, "--filter", name, "--save-log", f"log_{name}", "-o", name)
    logs = [contents(f"log_{name}") for name in ("ekf", "both")]
    assert logs[0]["measurements.csv"] == logs[1]["measurements.csv"]
    one, two = (pl.read_parquet(f"{name}/measurements.parquet") for name in ("ekf", "both"))
    assert one.equals(two)
    boats = one.filter(landmark=9)
    assert boats.height >= 4, "it is heard itself"
    told = {"listening__excess_paths": True, "callers": from_text(boat)}
    told |= {"duration": 4, "landmarks": 8, "fastslam__particles": 20}
    other = pipistrelle.run(strategies="fused", filters=["fastslam", "ekf"], **told)
    assert other.measurements.equals(one)


@pytest.mark.parametrize("method", ["known", "marginal"])
def test_order_of_filters_changes_no_table_and_no_log(obey, undrawn, method):
    words = ("--duration", "3", "--landmarks", "12", "--beamwidth", "90", "--quiet")
    words += ("--association.method", method)
    for name, filters in (("one", "ekf,iekf"), ("two", "iekf,ekf")):
        obey("run", *words, "--filter", filters, "--save-log", f"log_{name}", "-o", name)
    logs = [contents(f"log_{name}") for name in ("one", "two")]
    assert logs[0] == logs[1]
    by = ("strategy", "filter")
    for kind in ("steps", "landmarks", "measurements"):
        one, two = (pl.read_parquet(f"{name}/{kind}.parquet") for name in ("one", "two"))
        assert one.sort(by, maintain_order=True).equals(two.sort(by, maintain_order=True))
    assert one["true_landmark"].null_count() < one.height
    for name in ("bearing", "range"):
        unit = "rad" if name == "bearing" else "m"
        there = one[f"{name}_{unit}"].is_not_null()
        noise = one[f"{name}_std_{unit}"]
        assert (noise.is_not_null() == there).all()
        assert (noise.drop_nulls() > 0).all()
    if method == "known":
        assert {*one["filter"]} - {None} == {"ekf", "iekf"}
        assert one["assigned"].null_count() == one.height
        assert one["true_landmark"].equals(one["landmark"])
    else:
        assert (one["assigned"].drop_nulls() > 0).all()
        assert one["landmark"].unique().to_list() == [-1]


def test_measurements_of_a_log_have_assigned_and_recorded_labels(obey, undrawn):
    obey("run", *SHORT, "--strategy", "fused", "--beamwidth", "90", "--save-log", "log", "-o", "1")
    obey("slam", "log", "--association.method", "nearest", "--filter", "ekf", "-o", "2")
    rows = pl.read_parquet("2/measurements.parquet")
    assert rows["filter"].null_count() == rows.height
    found = rows.drop_nulls("assigned").group_by("assigned").agg(pl.col("true_landmark").mode())
    assert found.height > 0
    assert {*rows["true_landmark"]} <= {*range(1, 12)}


def test_a_saved_log_is_the_files_that_the_readme_promises(short_log):
    tables = ("landmarks.csv", "measurements.csv", "odometry.csv", "truth.csv")
    names = {path.name for path in short_log.iterdir()}
    assert names == {"README.md", "SHA256SUMS", "log.toml", *tables}
    page = Path(__file__).parents[2] / "README.md"
    assert "log.toml and four CSV files" in page.read_text(encoding="utf-8")


def test_a_link_to_itself_is_refused_in_place_of_any_folder(refused, undrawn):
    Path("loop").symlink_to("loop")
    mission_folder(Path("one"), {("fused", "ekf"): loop()})
    for flag in ("--save-log", "--save-world", "--save-sound", "-o"):
        assert "loop: cannot be used as a folder" in refused("run", *SHORT, flag, "loop")
    for name in ("loop/a", "a" * 250):
        assert f"{name}.html: cannot be written" in refused("view", "one", "-o", f"{name}.html")
    assert "loop: found no such folder" in refused("compare", "loop", "one")
    assert "loop: found no such folder" in refused("compare", "one", "loop")


@pytest.mark.parametrize("flag", SAVED)
def test_logs_and_recordings_are_saved_over_ours_and_over_nothing_of_the_users(
    obey, refused, undrawn, flag
):
    line = ("run", *SHORT, "--receiver.elements", "2", flag, "log", "--quiet")
    words = (*line, "--overwrite", "-o")
    assert "is that of --output" in refused("run", flag, "new", "-o", "./new")
    Path("log").mkdir()
    for path in (saved := [Path("log", name) for name in (*SAVED[flag], "README.md")]):
        path.write_text("mine")
        assert "log: is not empty and holds no " in refused(*words, "one")
        path.unlink()
    assert obey(*words, "two")[0] == 0
    assert "log: is not empty; name a new folder" in refused(*line, "-o", "three")
    assert obey(*words, "three")[0] == 0
    for path in saved:
        ours = path.read_bytes()
        path.write_text("mine")
        assert f"{path.name}: was changed since Pipistrelle wrote it" in refused(*words, "four")
        assert path.read_text() == "mine"
        path.write_bytes(ours)
    assert not Path("four").exists()


@pytest.mark.parametrize("room", range(6))
def test_a_log_for_which_there_is_no_room_leaves_nothing(refused, undrawn, monkeypatch, room):
    write, left = files.write_down, [room]

    def full(path, data):
        left[0] -= path.resolve().parent.name == "log"
        if left[0] < 0:
            write(path, data[:7])
            raise OSError(28, "No space left on device", str(path))
        write(path, data)

    monkeypatch.setattr(files, "write_down", full)
    said = refused("run", *SHORT, "--save-log", "log", "-o", "one", "--quiet")
    assert "could not be written (No space left on device)" in said
    assert not Path("log").exists()
    assert summary("one")["runs"], "the results were written before"


@pytest.mark.parametrize("estimator", ["ekf", pytest.param("fastslam", marks=pytest.mark.slow)])
def test_a_film_is_a_gif_by_default(obey, estimator):
    words = ("--strategy", "passive", "--filter", estimator, "--quiet", "--animate")
    assert obey("run", "--duration", "1", "--landmarks", "5", *words, "-o", "one")[0] == 0
    assert Path("one/mission.gif").read_bytes().startswith(b"GIF8")


@pytest.fixture
def settings(obey):
    """Resolve settings as every verb does."""

    def settings(*words):
        status, printed, said = obey("config", "show", *words)
        assert (status, said) == (0, "")
        return Config.model_validate(tomllib.loads(printed))

    return settings


def test_settings_as_shown_are_a_file_of_the_same_settings(settings, obey):
    config = settings("--rays.exponent", "3", "--scenario.start", "1", "-2", "0.5", "--seed", "9")
    assert config.rays.exponent == 3.0
    assert config.scenario.start == (1.0, -2.0, 0.5)
    Path("mission.toml").write_text(obey("config", "show", "--rays.exponent", "3")[1])
    assert settings("--config", "mission.toml") == settings("--rays.exponent", "3")


def test_short_options_set_their_settings(settings):
    config = settings(
        *("--beamwidth", "60", "--landmarks", "3", "--duration", "10"),
        *("--scenario.step", "0.25", "--air.speed-of-sound", "340", "--particles", "30"),
    )
    width = beamwidth(
        config.emitter.radius, frequency=config.emitter.frequency, speed_of_sound=340.0
    )
    assert degrees(width) == pytest.approx(60, rel=1e-12)
    assert config.scenario.landmarks == 3
    assert config.scenario.steps == 40
    assert config.fastslam.particles == 30


def test_the_schema_describes_every_setting(obey):
    schema = json.loads(obey("config", "schema")[1])
    sections = schema["$defs"].values()
    listed = 1  # those of a caller, of which there may be several
    assert len(sections) == sum(type(v) is dict for v in Config().model_dump().values()) + listed
    assert all("description" in field for s in sections for field in s["properties"].values())


TITLE = "echoes of a new kind"


def test_a_score_added_to_the_table_is_in_result_compare_and_report(obey, undrawn, monkeypatch):
    name, shown = "measurements_per_frame", SCORES["heading_rmse_rad"].shown
    monkeypatch.setitem(SCORES, name, replace(SCORES[name], title=TITLE, shown=shown))
    draw_only(monkeypatch)
    for folder, seed in (("one", 7), ("two", 8)):
        plan = Plan(
            name=folder, iterations=4, strategies=("active", "fused"), filters=("ekf",),
            config=Config(seed=seed), grid={},
        )  # fmt: skip
        study_folder(Path(folder), plan, lambda case, world: 2.0 + world + case.number)
    for words in (("run", *SHORT, "--strategy", "fused"), ("compare", "one", "two")):
        _, printed, _ = obey(*words)
        assert TITLE in printed
    assert obey("report", "one", "--quiet")[0] == 0
    page = Path("one/report/index.html").read_text(encoding="utf-8")
    assert page.count(f">{TITLE}<") > 1, "among the effects and among the cases"
    assert TITLE.capitalize() in page, "over what is varied"


def assert_both_tracks(folder, name):
    """The path by all that was heard, and as it was believed at its time, are there and scored."""
    smoothed, online = track(folder, name), track(folder, f"{name}_online")
    np.testing.assert_array_equal(smoothed[:, 0], online[:, 0])
    np.testing.assert_allclose(smoothed[-1], online[-1], rtol=0, atol=0.05)
    assert np.abs(smoothed[1:, 1:3] - online[1:, 1:3]).max() > 1e-4
    assert f"track_{name}_online.tum" in (Path(folder) / "SHA256SUMS").read_text()
    assert "_online.tum" in (Path(folder) / "README.md").read_text()
    (run,) = summary(folder)["runs"]
    assert set(run["online"]) == {
        "position_rmse_m", "heading_rmse_rad", "position_rmse_aligned_m", "nees_mean", "nees_max",
    }  # fmt: skip
    assert run["online"]["position_rmse_m"] != run["position_rmse_m"]


def test_a_run_and_its_log_give_both_tracks_of_the_smoother(obey, undrawn):
    words = ("--filter", "smoother", "--strategy", "fused", "--quiet")
    assert obey("run", *SHORT, *words, "--save-log", "log", "-o", "one") == (0, "one\n", "")
    assert_both_tracks("one", "fused_smoother")
    words = ("--filter", "smoother", "--filter.gate", "1.0", "--quiet")
    assert obey("slam", "log", *words, "-o", "two") == (0, "two\n", "")
    assert_both_tracks("two", "fused_smoother")
    for name in ("fused_smoother", "fused_smoother_online"):
        ran, replayed = track("one", name), track("two", name)
        np.testing.assert_allclose(replayed, ran, rtol=0, atol=1e-6)


def test_a_filter_that_revises_nothing_has_one_track(short_run):
    assert not list(short_run.glob("*_online.tum"))
    assert "online" not in summary(short_run)["runs"][0]


def test_calibrated_parameters_are_in_the_table_and_the_summary(obey, undrawn):
    words = ("--filter", "smoother", "--strategy", "active", "--scenario.steps", "80")
    asked = ("--filter.calibrate", "speed_scale", "sensor_place")
    status, printed, _ = obey("run", *words, *asked, "-o", "out")
    assert status == 0
    (run,) = summary("out")["runs"]
    numbers = ("speed_scale", "sensor_place_x", "sensor_place_y")
    assert [*run["calibration"]] == [one for name in numbers for one in (name, f"{name}_std")]
    assert run["calibration"]["speed_scale"] == pytest.approx(1.0, abs=0.3)
    rows = {line[:32].strip(): line[32:].split() for line in printed.splitlines()}
    assert rows["speed scale"] == [f"{run['calibration']['speed_scale']:.5g}"]
    assert rows["sensor place x, 1 sigma"] == [f"{run['calibration']['sensor_place_x_std']:.2g}"]


def test_a_study_has_columns_of_calibrated_parameters(obey):
    Path("plan.toml").write_text(
        'format = 1\nname = "own"\niterations = 1\nfilters = ["smoother", "ekf"]\n'
        'strategies = ["active"]\n[config]\nscenario.steps = 40\n'
        '[own.smoother]\nfilter.calibrate = ["turn_bias"]\n'
    )
    status, *_ = obey("study", "plan.toml", "--workers", "1", "-o", "out")
    assert status == 0
    trials = pl.read_parquet("out/trials/*.parquet").sort("case")
    assert trials["turn_bias_std"].is_null().to_list() == [False, True]
    assert 0.0 < trials["turn_bias_std"][0] <= 0.02
