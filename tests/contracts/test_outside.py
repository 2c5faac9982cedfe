"""Estimators that are not in the package: from an installed wheel, or a file in the folder."""

import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipistrelle.__main__ import main
from pipistrelle.config import Config, FilterConfig, InputError, RayConfig, ScenarioConfig
from pipistrelle.estimation.catalogue import CATALOGUE, PAPERS, entry, title_of
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.experiments.studies.plan import find_plan, plan_text, read_plan
from pipistrelle.experiments.studies.study import load_study, run_study
from reference.command_line import summary
from reference.missions import BICYCLE
from reference.studies import SMALL, assert_same, plan_of, results
from report.drawing import draw_only

RECKONING, SHIFTED = "toy_estimators:DeadReckoning", "toy_estimators:Shifted"
SHORT = ("--settings", "paper", "--duration", "10", "--seed", "7", "--quiet")
ONLINE = [
    "online_position_rmse_m",
    "online_heading_rmse_rad",
    "online_nees_mean",
    "online_nees_max",
]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder of installed packages with the toys in it, from a wheel built here."""
    source, site = tmp_path_factory.mktemp("wheel") / "source", tmp_path_factory.mktemp("site")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(__file__).with_name("toy_wheel"), source, ignore=ignored)
    build = (sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", "dist")
    subprocess.run(build, cwd=source, check=True, capture_output=True)
    (wheel,) = (source / "dist").glob("*.whl")
    install = (sys.executable, "-m", "pip", "install", "--no-index", "--no-deps", "--target")
    subprocess.run([*install, str(site), str(wheel)], check=True, capture_output=True)
    return site


@pytest.fixture
def toys(site, monkeypatch, tmp_path, undrawn):
    """The toys installed; the current folder is another."""
    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path)


def test_an_installed_estimator_runs_a_mission_and_solves_its_log(toys):
    assert main(["run", *SHORT, "--filter", RECKONING, "-o", "one", "--save-log", "log"]) == 0
    assert main(["slam", "log", "--seed", "7", "--quiet", "--filter", RECKONING, "-o", "two"]) == 0
    assert [(r["strategy"], r["filter"]) for r in summary("one")["runs"]] == [
        (strategy, RECKONING) for strategy in ("active", "fused", "passive")
    ]
    assert "online" not in summary("one")["runs"][0]
    files = Counter(path.name for path in Path("one").glob("*_*.*"))
    assert files == Counter(
        f"{kind}_{strategy}_DeadReckoning.{ending}"
        for kind, ending in (("track", "tum"), ("map", "csv"))
        for strategy in ("active", "fused", "passive")
    )
    assert set(pl.read_parquet("one/steps.parquet")["filter"]) == {RECKONING}
    assert "_online" not in Path("one/README.md").read_text()
    tracks = [np.loadtxt(f"{name}/track_fused_DeadReckoning.tum") for name in ("one", "two")]
    np.testing.assert_allclose(*tracks, rtol=0, atol=1e-9)


def test_a_revised_path_is_scored_and_written_next_to_the_online_path(toys):
    words = ("run", *SHORT, "--strategy", "fused")
    for name in (RECKONING, SHIFTED):
        assert main([*words, "--filter", name, "-o", name[15:]]) == 0
    (plain,), (revised,) = summary("DeadReckoning")["runs"], summary("Shifted")["runs"]
    scores = ("position_rmse_m", "heading_rmse_rad", "position_rmse_aligned_m")
    assert revised["online"] == {name: plain[name] for name in (*scores, "nees_mean", "nees_max")}
    assert revised["position_rmse_m"] > plain["position_rmse_m"]
    final, online, reckoned = (
        np.loadtxt(f"{name}.tum")
        for name in (
            "Shifted/track_fused_Shifted",
            "Shifted/track_fused_Shifted_online",
            "DeadReckoning/track_fused_DeadReckoning",
        )
    )
    np.testing.assert_array_equal(online, reckoned)
    np.testing.assert_allclose(final - online, [[0, 1, 0, 0, 0, 0, 0, 0]] * 81, atol=1e-9)
    assert "track_S_F_online.tum" in Path("Shifted/README.md").read_text()
    drawn = pl.read_parquet("Shifted/steps.parquet")["x_m"]
    np.testing.assert_allclose(drawn, final[:, 1], atol=1e-9)
    assert main([*words, "--filter", "ekf", "-o", "Shifted", "--overwrite"]) == 0
    assert not list(Path("Shifted").glob("*_online.tum"))


def test_an_outside_estimator_in_a_study_leaves_the_papers_results_unchanged(toys, tmp_path):
    small = SMALL.replace("iterations = 3", "iterations = 2").replace("0.0025, 0.025", "0.0088")
    plans = [
        plan_of(tmp_path, f"filters = {json.dumps(names)}\n{small}")
        for names in (PAPERS, (*PAPERS, SHIFTED))
    ]
    for plan, folder in zip(plans, (tmp_path / "two", tmp_path / "three"), strict=True):
        standing = run_study(plan, folder)
        assert (standing.done, set(standing.failed.values())) == (2, {0})
    two, three = (load_study(tmp_path / name).trials.collect() for name in ("two", "three"))
    assert [name for name in three.columns if name not in two.columns] == ONLINE
    ours, theirs = three.filter(pl.col("filter") != SHIFTED), three.filter(filter=SHIFTED)
    kept = [name for name in two.columns if name not in ("case", "wall_s", "cpu_s")]
    assert ours.select(kept).equals(two.select(kept))
    assert ours.select(ONLINE).null_count().row(0) == (len(ours),) * 4
    assert theirs.select(ONLINE).null_count().row(0) == (0,) * 4
    better = theirs["online_position_rmse_m"] < theirs["position_rmse_m"]
    assert better.all()
    assert theirs["diverged"].to_list() == [worst > 123.0 for worst in theirs["nees_max"]]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_study_from_the_command_line_in_this_process_or_in_others(toys, workers):
    small = SMALL.replace("iterations = 3", "iterations = 2").replace("0.0025, 0.025", "0.0088")
    Path("small.toml").write_text(f'filters = ["{RECKONING}"]\n{small}')
    words = ("study", "small.toml", "--workers", str(workers), "-o", "study", "--quiet")
    assert main(words) == 0
    trials = load_study(Path("study")).trials.collect()
    assert trials["status"].to_list() == ["done"] * 6
    assert set(trials["filter"]) == {RECKONING}
    assert not set(ONLINE) & set(trials.columns)
    assert read_plan(Path("study/plan.toml")).filters == (RECKONING,)


def test_a_study_with_an_outside_estimator_has_a_report(toys, tmp_path, monkeypatch):
    draw_only(monkeypatch)
    small = SMALL.replace("iterations = 3", "iterations = 2")
    run_study(
        plan_of(tmp_path, f'filters = ["ekf", "fastslam", "{SHIFTED}"]\n{small}'), tmp_path / "s"
    )
    assert main(["report", str(tmp_path / "s"), "--quiet"]) == 0
    assert "Shifted" in (tmp_path / "s" / "report" / "index.html").read_text()


def test_the_title_is_the_class_name_until_the_class_is_imported(toys, monkeypatch):
    monkeypatch.delitem(sys.modules, "toy_estimators", raising=False)
    before = [*sys.path]
    assert title_of(SHIFTED) == "Shifted"
    assert title_of("nowhere:Shifted") == "Shifted"
    assert ("toy_estimators" in sys.modules, sys.path) == (False, before)
    assert entry(SHIFTED).title == title_of(SHIFTED) == "shifted reckoning"
    assert entry(RECKONING).title == title_of(RECKONING) == "DeadReckoning"
    assert entry(SHIFTED).nees_limit == 123.0


# In the current folder

RECKONS = """\
from toy_estimators import *

class Mine(DeadReckoning):
    title = "mine"
"""


def test_workers_import_an_estimator_from_the_studys_start_folder(toys, written, tmp_path):
    name = f"{written(RECKONS)}:Mine"
    small = SMALL.replace("iterations = 3", "iterations = 2").replace("0.0025, 0.025", "0.0088")
    plan = plan_of(tmp_path, f'filters = ["ekf", "{name}"]\nstrategies = ["active"]\n{small}')
    for workers in (1, 2):
        standing = run_study(plan, tmp_path / f"by_{workers}", workers=workers)
        assert (standing.done, standing.failed) == (2, {"active": 0})
    assert_same(*(results(tmp_path / f"by_{workers}") for workers in (1, 2)))


def test_the_current_folder_takes_precedence_over_an_installed_estimator(toys, written):
    Path("toy_estimators.py").write_text("class DeadReckoning: pass\n")
    sys.modules.pop("toy_estimators", None)
    with pytest.raises(InputError, match="lacks init, predict, update"):
        entry(RECKONING)
    sys.modules.pop("toy_estimators")


def test_the_current_folder_comes_first_in_the_search_path(toys, written):
    name = written("class DeadReckoning: pass\n")
    sys.path[:] = [*sys.path, str(Path.cwd())]
    other = Path("installed")
    other.mkdir()
    (other / f"{name}.py").write_text("raise OSError('of another folder')\n")
    sys.path.insert(0, str(other.absolute()))
    with pytest.raises(InputError, match="lacks init, predict, update"):
        entry(f"{name}:DeadReckoning")
    assert (sys.path[0], sys.path.count(sys.path[0])) == (str(Path.cwd()), 1)


PARTS = """
    def init(self, pose): return Reckoned(at=pose)
    def predict(self, belief, controls, dt, rng): return belief, belief.pose()
    def update(self, belief, scan, rng): return belief
"""
GREEDY = f"""
from dataclasses import dataclass
from typing import Any

@dataclass
class Mine:
    config: Any
    gate: float
    rays: Any
    motion: Any
    own: int = 3
{PARTS}
"""


def test_the_fields_of_an_estimator_receive_settings_by_name(written):
    config = Config(filter=FilterConfig(gate=0.9), rays=RayConfig(exponent=5.0, range_ratio=2.0))
    slam = entry(f"{written(GREEDY)}:Mine").build(config, BICYCLE)
    assert (slam.gate, slam.rays, slam.config, slam.own) == (0.9, config.rays, config, 3)
    assert slam.motion is BICYCLE


BELIEF = """
from dataclasses import dataclass
class Mine(DeadReckoning):
    def init(self, pose): return Odd(at=pose)
@dataclass(frozen=True)
class Odd(Kept):
"""
ODD = {
    "an error": ("raise OSError('no licence')", "importing NAME fails: OSError: no licence"),
    "no Python": ("class Mine(", "importing NAME fails: SyntaxError: "),
    "an exit": ("raise SystemExit(3)", "importing NAME fails: SystemExit: 3"),
    "lacking": ("import not_there_at_all", "importing NAME fails: ModuleNotFoundError: No module"),
    "no class": ("", "found no class Mine in NAME"),
    "a thing": ("Mine = 3", "found Mine, which is no class, in NAME"),
    "no update": (
        "class Mine:\n    def init(self): ...\n    def predict(self): ...",
        "lacks update; an estimator has init, predict, update",
    ),
    "no record": (f"class Mine:{PARTS}", "cannot be built: it is no dataclass"),
    "a field": (
        f"from dataclasses import dataclass\n@dataclass\nclass Mine:\n    sonar: int{PARTS}",
        "cannot be built: found no value for sonar, expected fields among motion, rays, gate, con",
    ),
    "a refusal": (
        f"class Mine:{PARTS}\n    @classmethod\n    def from_config(cls, config, motion): 1 / 0",
        "cannot be built: ZeroDivisionError: division by zero",
    ),
    "a title": (f"class Mine:{PARTS}\n    title = 3", "title: found 3, expected text"),
    "a title of two lines": (
        f"class Mine:{PARTS}\n    title = 'a\\nb'",
        r"title: found 'a\nb', expected text in one line that can be printed",
    ),
    "a title that turns": (
        f"class Mine:{PARTS}\n    title = '\\u202eb'",
        r"title: found '\u202eb', expected text in one line that can be printed",
    ),
    "a limit": (f"class Mine:{PARTS}\n    nees_limit = 0", "nees_limit: found 0, expected a"),
    "a start": (
        f"from dataclasses import dataclass\n@dataclass\nclass Mine:{PARTS}",
        r"init fails: NameError: name 'Reckoned' is not defined (NAME.py, line 4)",
    ),
    "a belief": (
        f"from dataclasses import dataclass\n@dataclass\nclass Mine:{PARTS}\nReckoned = dict",
        "init returns a belief that lacks pose, landmarks, gated",
    ),
    "a field for a method": (
        f"from toy_estimators import *\n{BELIEF}    path: tuple = ()\n    cloud: tuple = ()\n",
        "init returns a belief whose path, cloud cannot be called; of a belief pose, landmarks, ",
    ),
    "a map for a method": (
        f"from toy_estimators import *\n{BELIEF}    landmarks = None\n",
        "init returns a belief whose landmarks cannot be called; of a belief pose, landmarks, path",
    ),
}


@pytest.mark.parametrize("case", ODD)
def test_a_missing_or_broken_estimator_is_refused_in_a_line(toys, written, case, capsys):
    text, said = ODD[case]
    name = written(text)
    assert main(["run", *SHORT, "--filter", f"{name}:Mine", "-o", "one"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"pipistrelle: error: filter {name}:Mine: {said.replace('NAME', name)}")
    assert error.count("\n") == 1
    assert not Path("one").exists()


def test_a_missing_module_is_refused_with_the_places_searched(written, capsys):
    for name in ("nowhere_at_all", "nowhere_at_all.deeper"):
        assert main(["run", *SHORT, "--filter", f"{name}:Mine", "-o", "one"]) == 2
        error = capsys.readouterr().err
        assert f"found no module nowhere_at_all, neither installed nor in {Path.cwd()}" in error


def test_a_study_refuses_a_missing_class_before_making_its_folder(written, tmp_path):
    plan = plan_of(tmp_path, f'filters = ["ekf", "{written("")}:Mine"]\n{SMALL}')
    with pytest.raises(InputError, match="found no class Mine"):
        run_study(plan, tmp_path / "study")
    assert not (tmp_path / "study").exists()


def test_two_classes_of_the_same_name_in_one_run_are_refused(toys, written):
    names = (RECKONING, f"{written('from toy_estimators import *')}:DeadReckoning")
    with pytest.raises(InputError, match="would write the same files"):
        run_mission(Config(scenario=ScenarioConfig(steps=8)), ("fused",), names)


def test_particles_are_refused_for_an_estimator_without_them(toys, capsys):
    assert main(["run", *SHORT, "--filter", RECKONING, "--particles", "9"]) == 2
    said = f"--particles: found 9, but --filter is {RECKONING}, which has none; add --filter fas"
    assert said in capsys.readouterr().err


FAILING = {
    "raises": ("update", "1 / 0", "ZeroDivisionError: division by zero"),
    "forgets": ("update", "None", "Mine.update: found NoneType returned, expected the belief"),
    "shortens": (
        "predict",
        "(belief, Gaussian(mean=np.zeros((9, 3)), covariance=np.zeros((9, 3, 3))))",
        "predict: found arrays of (9, 3)",
    ),
    "is lost": (
        "predict",
        "(belief, Gaussian(mean=np.full((4, 3), np.nan), covariance=np.zeros((4, 3, 3))))",
        "its path is not finite",
    ),
}


@pytest.mark.parametrize("way", FAILING)
def test_an_estimator_that_fails_midway_is_a_failed_trial_of_a_run(toys, written, way, capsys):
    method, answer, said = FAILING[way]
    name = written(
        "from toy_estimators import *\nfrom toy_estimators import DeadReckoning, Gaussian, np\n"
        f"class Mine(DeadReckoning):\n    def {method}(self, belief, *given): return {answer}\n"
    )
    words = ["--filter", f"{name}:Mine", "--strategy", "active", "-o", "one"]
    words += ["--animate"] if way == "raises" else []  # there is no frame to show
    assert main(["run", *SHORT, *words]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-1] == "one"
    (warning,) = [line for line in printed.err.splitlines() if "warning" in line]
    assert warning.startswith(f"pipistrelle: warning: active {name}:Mine failed: ")
    assert said in warning
    (run,) = summary("one")["runs"]
    assert (run["diverged"], run["position_rmse_m"]) == (True, None)


def test_an_estimator_that_fails_midway_is_a_failed_trial_of_a_study(toys, written, tmp_path):
    name = written(
        "from toy_estimators import *\n"
        "class Mine(Shifted):\n    def update(self, belief, scan, rng): return 1 / 0\n"
    )
    plan = plan_of(tmp_path, f'filters = ["ekf", "{name}:Mine"]\nstrategies = ["active"]\n{SMALL}')
    standing = run_study(plan, tmp_path / "study")
    assert standing.failed == {"active": 6}
    assert standing.first_error == "ZeroDivisionError: division by zero"
    trials = load_study(tmp_path / "study").trials.collect()
    assert trials.filter(status="failed")["error"].str.contains("Traceback").all()
    assert set(ONLINE) < set(trials.columns)


def test_a_path_without_all_poses_is_reported(toys, written, capsys):
    name = written(
        "from dataclasses import dataclass\nfrom toy_estimators import *\n"
        "@dataclass(frozen=True)\nclass Short(Kept):\n    def path(self): return self.at\n"
        "class Mine(Shifted):\n    def init(self, pose): return Short(at=pose)\n"
    )
    words = ("--filter", f"{name}:Mine", "--strategy", "active", "-o", "one")
    assert main(["run", *SHORT, *words]) == 1
    said = "path: found arrays of (3,) and (3, 3), expected (81, 3) and (81, 3, 3): the start and"
    assert said in capsys.readouterr().err


# A third estimator in the catalogue


def test_a_third_estimator_changes_nothing_of_the_papers(monkeypatch):
    plan = plan_text(read_plan(find_plan("paper")))
    third = entry("pipistrelle.estimation.ekf.filter:EkfSlam")
    monkeypatch.setitem(CATALOGUE, "third", third)
    assert plan_text(read_plan(find_plan("paper"))) == plan
    assert read_plan(find_plan("paper")).filters == PAPERS == ("ekf", "fastslam")
    from pipistrelle.scripting.arguments import named_filters

    assert named_filters("both") == PAPERS
    assert named_filters("third") == ("third",)
