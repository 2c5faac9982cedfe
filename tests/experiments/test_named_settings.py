"""Settings by name: what lies beneath what, for whom, and what of it is kept."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import pipistrelle
from pipistrelle.__main__ import main
from pipistrelle.config import STRATEGIES, Config, InputError, ScenarioConfig
from pipistrelle.estimation.catalogue import CATALOGUE
from pipistrelle.experiments.named_settings import NAMES, PLANS, check_own, over_named, own_config
from pipistrelle.experiments.results.writing import tum_text
from pipistrelle.experiments.runs.trial import run_mission
from pipistrelle.experiments.studies.plan import cases_of, find_plan, plan_of, plan_text, read_plan
from pipistrelle.settings import from_flags, known_settings, resolve

WORLD = ("--duration", "4", "--landmarks", "10")
FUSED = (*WORLD, "--strategy", "fused", "--quiet")
FORMER = {
    "active": (2.905291916251, -6.754288810688, 0.198830414320, 0.980033910812),
    "fused": (2.882434481952, -6.709559874700, 0.205861011616, 0.978581240315),
    "passive": (2.880735668695, -6.719009715725, 0.204785518346, 0.978806871388),
}
"""x, y, qz and qw at the end of the world above, as `run` had them before settings had names."""


@pytest.fixture(autouse=True)
def undrawn_in_a_folder_of_its_own(tmp_path, monkeypatch, undrawn):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["pipistrelle"])


def by_name(name):
    """Settings of a name, and those of each estimator."""
    layer, estimators = over_named({}, default=name)
    check_own(layer)
    config = resolve(layer)
    return config, estimators, {one: own_config(config, one) for one in CATALOGUE}


def ran(folder, *words):
    """Run a short mission; what its folder holds but for times and pictures."""
    assert main(["run", *FUSED, *words, "-o", folder]) == 0
    kept = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    return {n: content for n, content in kept.items() if n.endswith((".tum", ".csv", ".toml"))}


def settings_kept(folder):
    return tomllib.loads(Path(folder, "config.toml").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_each_named_file_holds_settings_for_estimators_that_there_are(name):
    config, estimators, _ = by_name(name)
    assert config.settings == name
    assert {*estimators} <= {*CATALOGUE}
    assert estimators


@pytest.mark.parametrize("name", ["paper", "physics"])
def test_the_settings_of_the_paper_are_the_defaults(name):
    """And say so: where `slam` has other defaults, they hold."""
    config, _, each = by_name(name)
    assert config == Config(settings=name)
    assert {*each.values()} == {config}


def test_the_best_settings_equal_the_timing_studys():
    plan = read_plan(find_plan("timing"))
    radius = plan.grid["emitter.radius"][0]
    measured = {case.filter: case.config for case in cases_of(plan)
                if case.config.emitter.radius == radius}  # fmt: skip
    _, _, each = by_name("best")
    assert {*measured} == {*each} == {*CATALOGUE}
    for name, config in each.items():
        same = {"seed": plan.config.seed, "settings": None, "emitter": measured[name].emitter}
        assert config.model_copy(update=same) == measured[name]


def test_run_without_a_word_takes_the_best_settings_and_their_estimator():
    plain = ran("one")
    assert plain == ran("two", "--settings", "best")
    assert "track_fused_smoother.tum" in plain
    assert settings_kept("one")["settings"] == "best"
    assert settings_kept("one")["filter"]["noise"] == "measured"
    assert "own" not in settings_kept("one"), "one estimator has all settings as its own"


def test_the_paper_settings_keep_the_former_default_mission_to_the_bit():
    main(["run", *WORLD, "--settings", "paper", "--quiet", "-o", "one"])
    default = Config(scenario=ScenarioConfig(steps=32, landmarks=10))
    for trial in run_mission(default, STRATEGIES, ["ekf"]).trials:
        kept = Path(f"one/track_{trial.strategy}_ekf.tum").read_text()
        assert kept == tum_text(trial.track.time, trial.track.pose.mean)
        end = np.array(kept.split("\n")[-2].split(), dtype=float)
        np.testing.assert_allclose(end[[1, 2, 6, 7]], FORMER[trial.strategy], rtol=0, atol=1e-9)


def test_flags_override_the_environment_over_files_over_named_settings(monkeypatch):
    text = "rays.exponent = 3.0\nrays.prune_threshold = 1e-4\nfilter.robust = 'none'\n"
    Path("mine.toml").write_text(text)
    words = ("--settings", "mine.toml", "--settings", "best", "--filter", "iekf")
    monkeypatch.setenv("PIPISTRELLE_RAYS__PRUNE_THRESHOLD", "1e-3")
    ran("one", *words, "--filter.noise", "constant")
    kept = settings_kept("one")
    assert kept["rays"]["precise_bearings"] == "auto", "named, of the estimator alone"
    assert kept["listening"]["excess_paths"] is True, "named, of all"
    assert kept["filter"]["robust"] == "none", "the file, over the estimator's own"
    assert kept["rays"]["exponent"] == 3.0
    assert kept["rays"]["prune_threshold"] == 1e-3
    assert kept["filter"]["noise"] == "constant", "the flag, over the estimator's own"


def test_a_name_may_come_from_file_environment_or_flag(monkeypatch):
    Path("mine.toml").write_text("settings = 'paper'\n")
    for folder, words, name in (
        ("one", (), "best"),
        ("two", ("--settings", "mine.toml"), "paper"),
        ("three", ("--settings", "mine.toml", "--settings", "physics"), "physics"),
    ):
        ran(folder, *words)
        assert settings_kept(folder)["settings"] == name
    monkeypatch.setenv("PIPISTRELLE_SETTINGS", "physics")
    ran("four", "--settings", "mine.toml")
    ran("five", "--settings", "paper")
    assert [settings_kept(one)["settings"] for one in ("four", "five")] == ["physics", "paper"]


def test_estimators_in_one_run_keep_their_separate_settings(capsys):
    both = ran("both", "--filter", "ekf,iekf")
    for name in ("ekf", "iekf"):
        alone = ran(name, "--filter", name)
        assert both[f"track_fused_{name}.tum"] == alone[f"track_fused_{name}.tum"]
    assert both["track_fused_iekf.tum"] != both["track_fused_ekf.tum"]
    assert {*settings_kept("both")["own"]} == {"ekf", "iekf"}
    again = ran("again", "--settings", "both/config.toml", "--filter", "ekf,iekf")
    assert again == both
    assert main(["view", "both", "--quiet"]) == 0
    assert "warning" not in capsys.readouterr().err, "done again, to the same tracks"


def test_a_file_may_contain_settings_of_one_estimator():
    Path("mine.toml").write_text("rays.exponent = 4.0\n[own.ekf]\nrays.exponent = 5.0\n")
    for name, power in (("ekf", 5.0), ("iekf", 4.0)):
        ran(name, "--settings", "mine.toml", "--filter", name)
        assert settings_kept(name)["rays"]["exponent"] == power
    ran("flag", "--settings", "mine.toml", "--filter", "ekf", "--rays.exponent", "6")
    assert settings_kept("flag")["rays"]["exponent"] == 6.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "odd.toml: found no setting, expected settings"),
        ("# only a remark\n", "odd.toml: found no setting, expected settings"),
        ("rays.exponent = nan", "odd.toml: rays.exponent: found nan, expected a finite number"),
        ("own = 3", "odd.toml: own: found 3, expected a table for each estimator"),
        ("own.iekf = 3", "odd.toml: own.iekf: found 3, expected a table of settings"),
        ("own.iekf.rays.powr = 3", "own.iekf.rays.powr: no such setting; did you mean"),
        ("own.iekf.rays.exponent = nan", "own.iekf.rays.exponent: found nan, expected a finite"),
        ("own.ikef.rays.exponent = 3", "own.ikef.rays.exponent: found 'ikef', expected one of"),
        ("own.iekf.air.pressure_kpa = 3", "own.iekf.air.pressure_kpa: changes what is heard"),
        ("own.iekf.own.ekf.rays.merge = 3", "own.iekf.own.ekf.rays.merge: changes what is heard"),
        ("settings = 'bset'", "odd.toml: settings: found 'bset', expected best, paper, physics;"),
        ("settings = nan", "odd.toml: settings: found nan, expected best"),
        ("settings = ['best']", "odd.toml: settings: found ['best'], expected best"),
        ("filters = ['ekf']", "odd.toml: filters: no such setting"),
    ],
)
def test_an_odd_file_is_refused_by_its_key(text, said, capsys):
    Path("odd.toml").write_text(text)
    assert main(["run", *FUSED, "--settings", "odd.toml"]) == 2
    assert said in capsys.readouterr().err
    assert not Path("runs").exists()


@pytest.mark.parametrize("verb", ["run", "slam log", "study timing", "config show"])
@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("bset", "--settings: found 'bset', expected best, paper, physics or the path of a TOML"),
        ("bset", "did you mean best?"),
        ("none.toml", "none.toml: found no such file"),
        (".", "--settings: found '.', a folder, expected a TOML file of settings"),
    ],
)
def test_an_unknown_name_is_refused_in_every_verb_and_the_names_are_listed(
    verb, word, said, capsys
):
    assert main([*verb.split(), "--settings", word]) == 2
    assert said in capsys.readouterr().err


def test_config_show_prints_the_settings_of_run_with_their_name(capsys):
    assert main(["config", "show"]) == 0
    Path("mine.toml").write_text(capsys.readouterr().out)
    assert settings_kept_in("mine.toml")["settings"] == "best"
    assert ran("one") == ran("two", "--settings", "mine.toml")
    capsys.readouterr()
    assert main(["config", "show", "--settings", "paper"]) == 0
    shown = tomllib.loads(capsys.readouterr().out)
    assert shown == Config(settings="paper").model_dump(mode="json", exclude_none=True)


def settings_kept_in(file):
    return tomllib.loads(Path(file).read_text())


def test_named_settings_override_the_defaults_of_slam():
    assert main(["run", *FUSED, "--filter.gate", "auto", "--save-log", "log", "-o", "one"]) == 0
    for folder, words in (("two", ()), ("best", ("--settings", "best")),
                          ("paper", ("--settings", "paper"))):  # fmt: skip
        assert main(["slam", "log", *words, "--quiet", "-o", folder]) == 0
    filters = {name: settings_kept(name)["filter"] for name in ("two", "best", "paper")}
    assert "settings" not in settings_kept("two")
    assert [filters[name]["robust"] for name in filters] == ["none", "huber", "none"]
    assert [filters[name]["noise"] for name in filters] == ["measured", "measured", "constant"]
    assert settings_kept("paper")["settings"] == "paper"
    assert Path("best/track_fused_smoother.tum").exists()
    assert Path("paper/track_fused_ekf.tum").exists()
    solved = pipistrelle.slam("log", settings="paper")
    assert solved.summary["filter"].to_list() == ["ekf"]


def test_python_gives_the_results_of_the_command_line():
    asked = {"duration": 4.0, "landmarks": 10, "strategies": "fused"}
    ran("one")
    ran("paper", "--settings", "paper")
    for folder, run in (
        ("one", pipistrelle.run(**asked)),
        ("one", pipistrelle.run("best", **asked)),
        ("one", pipistrelle.run(settings="best", **asked)),
        ("paper", pipistrelle.run("paper", **asked)),
        ("paper", pipistrelle.run(Config(), **asked)),
    ):
        assert run.tracks.equals(pipistrelle.load(folder).tracks)
    with pytest.raises(InputError, match="settings: found 'bset', expected best, paper, physics"):
        pipistrelle.run(settings="bset")
    with pytest.raises(InputError, match=r"config: found 'bset', expected best, .* mean best"):
        pipistrelle.run("bset")


PLAN = {"format": 1, "name": "mine", "iterations": 1, "settings": "best"}


def test_a_plan_overrides_the_settings_that_it_names():
    grid = {"filter.robust": ["none", "huber"]}
    own = {"iekf": {"rays.precise_bearings": "paper"}}
    plan = plan_of(PLAN | {"filters": ["ekf", "iekf"], "config": {"rays.exponent": 4.0},
                           "grid": grid, "own": own})  # fmt: skip
    cases = {(case.filter, case.values["filter.robust"]): case.config for case in cases_of(plan)}
    config = cases["iekf", "none"]
    assert config.settings == "best"
    assert (config.filter.noise, cases["ekf", "none"].filter.noise) == ("measured", "constant")
    assert config.rays.exponent == 4.0, "the plan's, over the name's"
    assert config.rays.precise_bearings == "paper", "the plan's for the estimator, over the name's"
    assert config.filter.robust == "none", "the grid's, over the name's for the estimator"
    over = plan_of(PLAN | {"filters": ["iekf"]}, over=from_flags({"filter": {"noise": "constant"}}))
    assert cases_of(over)[0].config.filter.noise == "constant"
    assert plan_of(PLAN).filters == ("smoother",)
    assert plan_of(PLAN | {"settings": "paper"}, over=from_flags({"settings": "best"})) == plan_of(
        PLAN
    )


def test_a_plan_is_written_with_the_name_and_reads_back_the_same(tmp_path):
    filters = ["ekf", "iekf", "fastslam"]
    plan = plan_of(PLAN | {"filters": filters, "grid": {"rays.exponent": [2.0]}})
    path = tmp_path / "plan.toml"
    path.write_text(plan_text(plan))
    assert tomllib.loads(path.read_text())["settings"] == "best"
    assert read_plan(path) == plan


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"settings": "bset"}, "plan: settings: found 'bset', expected best, paper, physics"),
        ({"settings": 3}, "plan: settings: found 3"),
        ({"grid": {"settings": ["best", "paper"]}}, "grid.settings: holds for a whole plan"),
        ({"own": 3}, "plan, key 'own': found 3"),
    ],
)
def test_a_plan_that_names_nothing_is_refused(change, said):
    with pytest.raises(InputError) as refused:
        plan_of(PLAN | change)
    assert said in str(refused.value)


def test_a_study_is_run_with_settings_by_name_from_python_and_the_command_line(tmp_path):
    plan = {"format": 1, "name": "mine", "iterations": 1, "strategies": ["fused"],
            "filters": ["iekf"], "config": {"scenario": {"steps": 8, "landmarks": 5}}}  # fmt: skip
    done = pipistrelle.study(plan, settings="best", output="one")
    assert done.plan.own["iekf"]["filter.noise"] == "measured"
    assert settings_kept_in("one/plan.toml")["settings"] == "best"
    words = ("--settings", "best", "--workers", "1", "--quiet", "-o", "two")
    assert main(["study", "one/plan.toml", *words]) == 0
    assert read_plan(Path("two/plan.toml")) == done.plan


def test_the_plans_that_ship_are_listed_in_the_help(capsys):
    assert {"association", "paper", "timing"} <= {*PLANS}
    assert {"iterations", "grid"} <= {*tomllib.loads(find_plan(PLANS[0]).read_text())}
    assert main(["study", "--help"]) == 0
    assert ", ".join(PLANS) in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_settings_of_one_estimator_are_known_settings():
    assert {("settings",), ("own",)} <= {*known_settings()}
    assert json.loads(Config(settings="best").model_dump_json(exclude_none=True))["settings"]
