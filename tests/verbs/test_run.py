import json
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from math import degrees
from pathlib import Path

import numpy as np
import pytest

from pipistrelle.__main__ import main
from pipistrelle.acoustics.emitter import beamwidth
from pipistrelle.config import Config
from pipistrelle.experiments.runs import replay, trial
from pipistrelle.settings import known_settings
from pipistrelle.verbs.options import FILTERS

SHORT = ("--duration", "4", "--landmarks", "10")
"""A world of eight frames."""
COMPILING = "Compiling kernels (once) ..."
"""Said on a slow machine, or the first time."""


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pipistrelle"])


@pytest.fixture
def obey(capsys):
    """Run a command line; return its status, what it printed and what it said."""

    def obey(*words):
        status = main([str(word) for word in words])
        printed, said = capsys.readouterr()
        return status, printed, said

    return obey


@pytest.fixture
def refused(obey):
    """Run a command line that must be refused; return what is said."""

    def refused(*words):
        status, printed, said = obey(*words)
        assert (status, printed) == (2, "")
        lines = [line for line in said.splitlines() if line != COMPILING]
        assert lines
        assert all(line.startswith("pipistrelle: error: ") for line in lines)
        return "\n".join(line.removeprefix("pipistrelle: error: ") for line in lines)

    return refused


@pytest.fixture
def settings(obey):
    """Resolve settings as every verb does."""

    def settings(*words):
        status, printed, said = obey("config", "show", *words)
        assert (status, said) == (0, "")
        return Config.model_validate(tomllib.loads(printed))

    return settings


def summary(folder):
    return json.loads((Path(folder) / "summary.json").read_text())


def track(folder, name):
    return np.loadtxt(Path(folder) / f"track_{name}.tum")


def table(printed):
    """Rows of the closing table: title and cells, eleven characters each."""
    lines = printed.splitlines()[:-1]
    return {line[:30].strip(): re.findall(r".{11}", line[30:]) for line in lines[2:]}


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


# Help


def test_help_and_version_load_neither_numpy_nor_pydantic():
    code = (
        "import sys; from pipistrelle.__main__ import main; main(sys.argv[1:]); "
        "print({'numpy', 'pydantic', 'numba', 'matplotlib'} & set(sys.modules))"
    )
    for word in ("--help", "--version"):
        printed = subprocess.run(
            [sys.executable, "-c", code, word], capture_output=True, text=True, check=True
        ).stdout
        assert printed.splitlines()[-1] == "set()"


def test_help_names_the_verbs(obey):
    status, printed, _ = obey("--help")
    assert status == 0
    verbs = ["config", "doctor", "report", "run", "slam", "study"]
    assert re.findall(r"^│ (\w+) ", printed, re.M) == verbs
    assert obey()[1] == printed


@pytest.mark.parametrize("verb", [("run",), ("config", "show")])
def test_every_setting_is_in_the_help_with_its_default(obey, verb):
    status, printed, _ = obey(*verb, "--help")
    assert status == 0
    flags = {"--" + ".".join(key).replace("_", "-") for key in known_settings()}
    assert flags <= set(re.findall(r"--[a-z0-9.-]+", printed))
    assert printed.count("[default:") >= len(flags)


def test_the_help_of_slam_leaves_out_what_a_log_decides(obey):
    found = set(re.findall(r"--[a-z]+\.[a-z-]+", obey("slam", "--help")[1]))
    rays = ("ratio", "density", "prune", "power", "weights", "partial")
    swarm = ("particles", "resample-below", "mixture")
    assert found == {f"--rays.{name}" for name in rays} | {f"--fastslam.{name}" for name in swarm}


def test_the_defaults_that_the_help_names_are_those_of_the_settings(obey):
    words = " ".join(re.sub("[│╭╮╰╯─]", " ", obey("run", "--help")[1]).split())
    told = dict(re.findall(r"--([a-z]+) [A-Z]+ (?:(?! --).)*?\[default: ([^]]+)\]", words))
    config = Config()
    width = beamwidth(
        config.emitter.radius,
        frequency=config.emitter.frequency,
        speed_of_sound=config.air.speed_of_sound,
    )
    assert told["beamwidth"] == f"{degrees(width):.1f}"
    assert told["landmarks"] == str(config.scenario.landmarks)
    assert told["duration"] == f"{config.scenario.steps * config.scenario.step:g}"
    assert told["engine"] == config.receiver.engine
    assert told["particles"] == str(config.fastslam.particles)


@pytest.mark.parametrize("verb", ["run", "slam"])
def test_the_help_names_the_filters_there_are(obey, verb):
    assert tuple(trial.LIMITS) == FILTERS
    words = " ".join(re.sub("[│╭╮╰╯─]", " ", obey(verb, "--help")[1]).split())
    assert "[choices: ekf, fastslam, both] [default: ekf]" in words
    assert "sets fastslam.particles" in words


# Settings


def test_settings_as_shown_are_a_file_of_the_same_settings(settings, obey):
    config = settings("--rays.power", "3", "--scenario.start", "1", "-2", "0.5", "--seed", "9")
    assert config.rays.power == 3.0
    assert config.scenario.start == (1.0, -2.0, 0.5)
    Path("mission.toml").write_text(obey("config", "show", "--rays.power", "3")[1])
    assert settings("--config", "mission.toml") == settings("--rays.power", "3")


def test_the_short_names_of_a_mission_set_what_they_say(settings):
    config = settings(
        *("--beamwidth", "60", "--landmarks", "3", "--duration", "10", "--engine", "dense"),
        *("--scenario.step", "0.25", "--air.speed-of-sound", "340", "--particles", "30"),
    )
    width = beamwidth(
        config.emitter.radius, frequency=config.emitter.frequency, speed_of_sound=340.0
    )
    assert degrees(width) == pytest.approx(60, rel=1e-12)
    assert config.scenario.landmarks == 3
    assert config.scenario.steps == 40
    assert config.receiver.engine == "dense"
    assert config.fastslam.particles == 30


def test_flags_go_over_the_environment_over_the_file(settings, monkeypatch):
    Path("mission.toml").write_text("seed = 2\n[rays]\npower = 2\nratio = 0.2\n")
    monkeypatch.setenv("PIPISTRELLE_SEED", "3")
    monkeypatch.setenv("PIPISTRELLE_RAYS__POWER", "3")
    monkeypatch.setenv("PIPISTRELLE_DATA", "/nowhere")
    config = settings("--config", "mission.toml", "--seed", "4")
    assert (config.seed, config.rays.power, config.rays.ratio) == (4, 3.0, 0.2)


def test_the_schema_says_what_every_setting_means(obey):
    schema = json.loads(obey("config", "schema")[1])
    sections = schema["$defs"].values()
    assert len(sections) == sum(type(v) is dict for v in Config().model_dump().values())
    assert all("description" in field for s in sections for field in s["properties"].values())


# Mistakes


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("rn", 'Unknown command "rn". Did you mean "run"?'),
        ("run --bemwidth 3", "Unknown option: --bemwidth. Did you mean --beamwidth?"),
        ("run --rays.powr 3", "Unknown option: --rays.powr. Did you mean --rays.power?"),
        ("run --rays.power x", '--rays.power: unable to convert "x" into float'),
        ("run --rays.power nan", "--rays.power: found nan, expected a finite number"),
        ("run --rays.power", "--rays.power requires an argument"),
        ("run --landmarks 2.5", "--landmarks: found '2.5', expected a whole number"),
        ("run --scenario.steps 9.5", "--scenario.steps: found '9.5', expected a whole number"),
        ("run --landmarks -1", "--landmarks: found -1, expected greater than or equal to 0"),
        ("run --seed -1", "--seed: found -1, expected greater than or equal to 0"),
        ("run --filter ukf", 'Invalid value "ukf" for --filter. Choose from: "ekf", "fastslam",'),
        ("run --filter fastslam --particles 0", "--particles: found 0, expected greater than or"),
        ("run --filter fastslam --particles 9.5", "--particles: found '9.5', expected a whole"),
        ("run --particles 9", "--particles: found 9, but --filter is ekf, which has none; add --f"),
        (
            "run --filter both --particles 3 --fastslam.particles 3",
            "--particles and --fastslam.particles are one setting; give one of them",
        ),
        ("run --strategy loud", 'Invalid value "loud" for --strategy'),
        ("run --duration 0.4", "--duration: found 0.4, expected at least one frame (0.5 s)"),
        ("run --duration nan", "--duration: found nan, expected at least one frame"),
        ("run --duration inf", "--duration: found inf, expected at least one frame"),
        ("run --duration 1e308", "--duration: found 1e+308, expected at least one frame"),
        ("run --duration 1e30", "--duration 1e+30: found 8000000000000000"),
        ("run --duration 1e12", "8,000,000,000,000 steps may need"),
        ("run --scenario.steps 200000000", "200,000,000 steps may need"),
        ("run --beamwidth 190", "found 190.0 degrees, expected above 0 and up to 180"),
        ("run --beamwidth nan", "found nan degrees, expected above 0 and up to 180"),
        (
            "run --landmarks 3 --scenario.landmarks 3",
            "--landmarks and --scenario.landmarks are one setting; give one of them",
        ),
        ("run --config none.toml", "none.toml: No such file or directory"),
        ("run --config .", ".: Is a directory"),
        ("run --landmarks 9999", "scenario.landmarks: found 9999"),
        ("run --animate=avi", 'Invalid value "avi" for --animate'),
        ("run --animate avi", "--animate: found 'avi', expected gif or mp4"),
        ("slam none --animate avi", "--animate: found 'avi', expected gif or mp4"),
        ("run --animate gif extra", "run: found 'extra', but run takes no arguments"),
        ("run extra", "run: found 'extra', but run takes no arguments"),
        ("slam one two", "slam: found 'two', but slam takes one argument"),
        ("config show extra", "config show: found 'extra', but config show takes no arguments"),
        ("run --scenario.start 0 0", "--scenario.start: found 2 values, expected 3"),
        ("slam", "LOG requires an argument"),
        ("slam --animate none", "none: found no such folder"),
        ("slam none -x", "Unknown option: -x."),
        ("slam none -xo", "Unknown option: -x"),
        ("slam none", "none: found no such folder"),
        ("slam . --emitter.level-db 3", "--emitter.level-db: means nothing to a recorded log"),
        ("slam . --filter.range-std 3", "--filter.range-std: the log decides this"),
        ("slam . --gate 2", "--gate: found 2.0, expected less than or equal to 1"),
        ("slam . --gate 0.9 --filter.gate 0.9", "--gate and --filter.gate are one setting"),
        ("slam . --particles 9", "--particles: found 9, but --filter is ekf, which has none; add"),
        ("slam . --filter both --particles 0", "--particles: found 0, expected greater than or"),
        (
            "slam . --filter both --particles 3 --fastslam.particles 3",
            "--particles and --fastslam.particles are one setting; give one of them",
        ),
        ("slam . --beamwidth 0", "--beamwidth: found 0, expected above 0 and up to 360"),
        ("slam . --beamwidth nan", "--beamwidth: found nan, expected above 0"),
        ("slam . --robot one", "--robot: found 'one', expected a whole number"),
    ],
)
def test_a_mistake_is_said_in_a_line_and_nothing_is_made(refused, words, said):
    assert said in refused(*words.split())
    assert [path.name for path in Path().iterdir() if path.name != "runs"] == []
    assert not any(Path().glob("runs/*"))


def test_a_mistake_in_a_file_or_the_environment_is_said_with_its_place(refused, monkeypatch):
    Path("mission.toml").write_text("[rays]\npowr = 3\n")
    found = refused("run", "--config", "mission.toml")
    assert found == "mission.toml: rays.powr: no such setting; did you mean rays.power?"
    Path("mission.toml").write_text("[rays]\npower 3\n")
    assert "mission.toml: not TOML: " in refused("run", "--config", "mission.toml")
    monkeypatch.setenv("PIPISTRELLE_RAYS__POWER", "0")
    assert refused("run") == "PIPISTRELLE_RAYS__POWER: found 0, expected greater than 0"


def test_a_film_that_needs_what_is_missing_is_refused_before_anything_is_made(refused, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert "found no ffmpeg" in refused("run", "--animate", "mp4")
    assert not Path("runs").exists()


def test_a_bug_keeps_its_traceback(obey, monkeypatch):
    def broken(*_, **__):
        raise ValueError("ours")

    monkeypatch.setattr(trial, "run_mission", broken)
    with pytest.raises(ValueError, match="ours"):
        obey("run", "-o", "one")


def test_an_interrupted_run_says_so_and_leaves_no_empty_folder(obey, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(trial, "run_mission", interrupted)
    assert obey("run") == (130, "", "pipistrelle: interrupted\n")
    assert list(Path("runs").iterdir()) == []


def test_a_reader_that_leaves_early_sees_no_traceback():
    command = [sys.executable, "-m", "pipistrelle", "config", "show"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


# Missions


def test_a_run_tells_its_stages_its_scores_and_last_its_folder(obey):
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
    assert rows["landmarks, fully placed / all"] == counts
    assert "fully placed, particles' mean" not in rows
    assert {"mission.png", "mission.pdf", "config.toml"} <= {p.name for p in Path("one").iterdir()}


def test_both_filters_are_told_compared_and_drawn_in_100_columns(obey, monkeypatch):
    run_mission, seen = trial.run_mission, []

    def seeing(*words, **named):
        seen.append(run_mission(*words, **named))
        return seen[-1]

    monkeypatch.setattr(trial, "run_mission", seeing)
    status, printed, said = obey("run", *SHORT, "--filter", "both", "--particles", "7", "-o", "one")
    assert status == 0
    names = [(s, f) for s in ("active", "fused", "passive") for f in FILTERS]
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


def test_the_closing_table_keeps_its_columns_however_large_its_numbers(obey, monkeypatch):
    run_mission = trial.run_mission

    def wild(*words, **named):
        mission = run_mission(*words, **named)
        first, *others = mission.trials
        scores = replace(first.scores, position_rmse_m=-1.234e300, nees_max=float("inf"))
        return replace(mission, trials=(replace(first, scores=scores), *others))

    monkeypatch.setattr(trial, "run_mission", wild)
    rows = table(obey("run", *SHORT, "-o", "one")[1])
    assert rows["position RMSE [m]"][0] == " -1.23e+300"
    assert rows["NEES, largest"][0].strip() == "inf"
    assert {len(cells) for cells in rows.values()} == {3}


def test_a_quiet_run_prints_its_folder_alone(obey):
    assert obey("run", *SHORT, "-o", "one", "--strategy", "active", "--quiet") == (0, "one\n", "")
    assert len(summary("one")["runs"]) == 1


def test_the_settings_of_a_run_are_a_file_that_repeats_it(obey):
    words = ("--strategy", "fused", "--quiet")
    obey("run", *SHORT, "--seed", "5", "--rays.power", "3", *words, "-o", "one")
    obey("run", "--config", "one/config.toml", *words, "-o", "two")
    assert summary("one")["config_hash"] == summary("two")["config_hash"]
    np.testing.assert_array_equal(track("one", "fused_ekf"), track("two", "fused_ekf"))


def test_results_are_replaced_only_when_asked(obey, refused):
    words = ("run", *SHORT, "--strategy", "active", "--quiet", "-o", "one")
    obey(*words)
    assert "one: is not empty" in refused(*words)
    assert obey(*words, "--overwrite")[0] == 0


@pytest.mark.parametrize("trouble", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize(
    "place", ["experiments.runs.trial.run_mission", "figures.mission.draw_mission"]
)
def test_earlier_results_and_logs_outlive_a_mission_that_comes_to_nothing(
    obey, monkeypatch, trouble, place
):
    def interrupted(*_, **__):
        raise trouble

    words = ("run", *SHORT, "--strategy", "active", "--quiet", "-o", "one")
    obey(*words, "--save-log", "log")
    results, log = contents("one"), contents("log")
    monkeypatch.setattr(f"pipistrelle.{place}", interrupted)
    again = (*words, "--seed", "9", "--overwrite")
    if place.startswith("experiments"):
        again += ("--save-log", "log")
    assert obey(*again)[0] == (130 if trouble is KeyboardInterrupt else 2)
    assert contents("one") == results
    assert contents("log") == log


def test_an_estimate_that_is_not_finite_is_a_failed_trial(obey, monkeypatch):
    run_mission = trial.run_mission

    def lost(*words, **named):
        mission = run_mission(*words, **named)
        done = mission.trials[0]
        pose = replace(done.track.pose, mean=np.full_like(done.track.pose.mean, np.nan))
        failed = replace(done, track=replace(done.track, pose=pose))
        return replace(mission, trials=(failed, *mission.trials[1:]))

    monkeypatch.setattr(trial, "run_mission", lost)
    status, printed, said = obey("run", *SHORT, "-o", "one")
    assert (status, printed.splitlines()[-1]) == (1, "one")
    assert "warning: active ekf failed" in said


def test_a_saved_log_is_the_six_files_that_the_readme_promises(obey):
    obey("run", *SHORT, "--save-log", "log", "-o", "one")
    tables = ("landmarks.csv", "measurements.csv", "odometry.csv", "truth.csv")
    assert {path.name for path in Path("log").iterdir()} == {"README.md", "log.toml", *tables}
    page = Path(__file__).parents[2] / "README.md"
    assert "six text files" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("estimator", FILTERS)
@pytest.mark.parametrize("strategy", ["all", "active", "passive"])
def test_a_run_and_its_log_give_one_track(obey, strategy, estimator):
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


def test_a_log_is_saved_to_a_folder_of_its_own(obey, refused):
    Path("log").mkdir()
    Path("log/notes.txt").write_text("mine")
    assert "log is not empty" in refused("run", *SHORT, "--save-log", "log")
    assert "is the result folder" in refused("run", "--save-log", "new", "-o", "./new")


@pytest.fixture
def log(obey):
    obey("run", *SHORT, "--save-log", "log", "--quiet", "-o", "one")
    return Path("log")


def test_slam_hides_ranges_by_strategy_and_beam(obey, log):
    status, printed, said = obey("slam", log, "--strategy", "all", "--beamwidth", "40", "-o", "two")
    assert (status, printed.splitlines()[-1]) == (0, "two")
    stages = [line[:17].strip() for line in said.splitlines() if "frames/s" in line]
    assert stages == ["active ekf", "fused ekf", "passive ekf"]
    active, fused, passive = (run["measurements_per_frame"] for run in summary("two")["runs"])
    assert active < fused == passive
    assert "position RMSE, aligned [m]" in printed


def test_the_gate_of_a_log_is_the_one_asked_for_else_its_own_else_nearly_all(obey, log):
    def gate(*words):
        assert obey("slam", log, "--quiet", "--overwrite", "-o", "two", *words)[0] == 0
        return tomllib.loads(Path("two/config.toml").read_text())["filter"]["gate"]

    text = re.sub(r"gate = .*\n", "", (log / "log.toml").read_text())
    (log / "log.toml").write_text(text)
    assert gate() == 0.999
    (log / "log.toml").write_text("gate = 0.95\n" + text)
    assert gate() == 0.95
    Path("mission.toml").write_text("filter.gate = 0.9\n")
    assert gate("--config", "mission.toml") == 0.9
    assert gate("--config", "mission.toml", "--gate", "0.8") == 0.8


def test_slam_takes_the_settings_of_fastslam_from_flags_and_files_and_keeps_them(obey, log):
    Path("mission.toml").write_text("fastslam.mixture = 'exact'\nfastslam.particles = 5\n")
    words = ("--filter", "both", "--config", "mission.toml", "--particles", "9")
    status, printed, said = obey("slam", log, *words, "--fastslam.resample-below", "0.5", "-o", "2")
    assert (status, printed.splitlines()[-1]) == (0, "2")
    stages = [line[:17].strip() for line in said.splitlines() if "frames/s" in line]
    assert stages == ["fused ekf", "fused fastslam"]
    kept = tomllib.loads(Path("2/config.toml").read_text())
    assert list(kept) == ["seed", "filter", "rays", "fastslam"]
    assert kept["fastslam"] == {"particles": 9, "resample_below": 0.5, "mixture": "exact"}
    words = ("--filter", "both", "--config", "2/config.toml", "--quiet")
    obey("slam", log, *words, "-o", "again")
    np.testing.assert_array_equal(track("2", "fused_fastslam"), track("again", "fused_fastslam"))


def test_slam_takes_from_the_log_what_the_log_decides_and_says_so(obey, log):
    own = Config().filter.range_std
    Path("mission.toml").write_text("[filter]\nrange_std = 0.7\n")
    _, _, said = obey("slam", log, "--config", "mission.toml", "-o", "two", "--quiet")
    where = "mission.toml: filter.range_std"
    assert said == f"pipistrelle: warning: {where}: the log decides this, and says {own}\n"
    settled = tomllib.loads(Path("two/config.toml").read_text())
    assert settled["filter"]["range_std"] == own


def test_rows_that_are_left_out_are_named_in_a_line(obey, log):
    with (log / "measurements.csv").open("a") as file:
        file.write("99.0,3,0.1,4.0\n")
    _, _, said = obey("slam", log, "-o", "two", "--quiet")
    assert said == "pipistrelle: warning: log: rows left out: 1 outside odometry\n"
    assert summary("two")["runs"][0]["ignored_rows"] == {"outside_odometry": 1}


def test_a_log_without_truth_is_mapped_and_not_scored(obey, log):
    (log / "truth.csv").unlink()
    (log / "landmarks.csv").unlink()
    status, printed, _ = obey("slam", log, "-o", "two")
    assert status == 0
    assert "RMSE" not in printed
    assert "landmarks, fully placed / all" in printed
    assert replay.load(log)[1] is None


def test_a_log_whose_truth_ends_early_is_scored_where_it_is_known(obey, log):
    rows = (log / "truth.csv").read_text().splitlines()
    (log / "truth.csv").write_text("\n".join(rows[:20]))
    status, _, _ = obey("slam", log, "-o", "two")
    assert status == 0
    (run,) = summary("two")["runs"]
    assert 0 < run["position_rmse_m"] < 5
    assert run["diverged"] is False


@pytest.mark.parametrize("estimator", FILTERS)
def test_a_film_is_drawn_as_gif_unless_said_otherwise(obey, estimator):
    words = ("--strategy", "passive", "--filter", estimator, "--quiet", "--animate")
    assert obey("run", "--duration", "1", "--landmarks", "5", *words, "-o", "one")[0] == 0
    assert Path("one/mission.gif").read_bytes().startswith(b"GIF8")


# Doctor


def test_the_doctor_names_versions_and_folders_and_what_to_mend(obey, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("PIPISTRELLE_DATA", "nowhere")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "kernels")
    status, printed, said = obey("doctor")
    found = dict(re.findall(r"^(\S+(?: \S+)?) {2,}(.+)$", printed, re.M))
    assert (status, said) == (0, "")
    assert found["python"].startswith(sys.version.split()[0])
    assert found["numpy"] == np.__version__
    assert found["kernel cache"] == "kernels"
    assert found["ffmpeg"].startswith("not found")
    assert found["PIPISTRELLE_DATA"].startswith("nowhere: holds no folder mrclam")
    assert int(found["cores"]) >= 1


def test_the_doctor_names_a_missing_library_with_its_fix(obey, monkeypatch):
    monkeypatch.setattr("pipistrelle.verbs.doctor.requires", lambda _: ["nosuchthing>=2; x"])
    monkeypatch.delenv("PIPISTRELLE_DATA", raising=False)
    printed = obey("doctor")[1]
    assert "nosuchthing       not found; python -m pip install 'nosuchthing>=2; x'" in printed
    assert "PIPISTRELLE_DATA  not set" in printed


def test_memory_that_ends_is_said_in_a_line(refused, tmp_path, monkeypatch):
    def full(*_, **__):
        raise MemoryError("unable to allocate")

    monkeypatch.setattr("pipistrelle.experiments.runs.trial.run_mission", full)
    assert "not enough memory" in refused("run", "-o", tmp_path / "results")
    assert not (tmp_path / "results").exists()


def test_a_full_disk_behind_the_output_is_said_in_a_line():
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "pipistrelle", "config", "show"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("pipistrelle: error: the output could not be written")
    assert "Traceback" not in done.stderr


def test_a_truth_that_covers_part_of_the_path_is_said_in_a_line(obey, tmp_path):
    log = tmp_path / "log"
    shutil.copytree(Path(__file__).parents[1] / "data" / "unicycle_log", log)
    rows = (log / "truth.csv").read_text().splitlines()
    (log / "truth.csv").write_text("\n".join(rows[:12]))
    status, _, said = obey("slam", log, "-o", tmp_path / "results")
    assert status == 0
    assert "the truth covers 5 of 20 steps" in said
