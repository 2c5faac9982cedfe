"""A study's plan: what it stands for, what it refuses, how two differ."""

import math
import tomllib
from collections import Counter
from importlib.resources import files

import pytest

from pipistrelle.acoustics.emitter import beamwidth, piston_radius
from pipistrelle.config import Config, EmitterConfig, InputError, RayConfig
from pipistrelle.estimation.catalogue import SECTIONS
from pipistrelle.experiments.studies.plan import (
    Plan,
    cases_of,
    changed_settings,
    common,
    find_plan,
    plan_settings,
    plan_text,
    read_plan,
)
from pipistrelle.experiments.studies.study import open_store
from pipistrelle.settings import from_flags
from reference.studies import SMALL, plan_of

BARE = "format = 1\niterations = 2\n"
BEAMS = "[grid]\nbeamwidth = [33, 11]\n"
BEAMWIDTHS = BARE + '[grid]\nbeamwidth = [180, 90, 33.2, 11]\n"rays.exponent" = [1.0, 2.0]\n'


@pytest.fixture
def refused(tmp_path):
    """Read a text that is no plan; return what is said of it after the path."""

    def refused(text, **given):
        with pytest.raises(InputError) as error:
            plan_of(tmp_path, text, **given)
        return str(error.value).replace(f"{tmp_path / 'small.toml'}", "PLAN")

    return refused


def test_the_papers_plan_is_fifty_cases_in_115_worlds():
    plan = read_plan(find_plan("paper"))
    cases = cases_of(plan)
    assert plan.iterations * len(cases) == 5750
    assert Counter((case.strategy, case.filter) for case in cases) == {
        **dict.fromkeys([(s, f) for s in ("active", "fused") for f in ("ekf", "fastslam")], 12),
        **dict.fromkeys([("passive", f) for f in ("ekf", "fastslam")], 1),
    }
    assert [case.number for case in cases] == list(range(50))


def named(plan):
    """Return the settings that a plan of the package names, its seed aside, by section."""
    text = files("pipistrelle.experiments.studies").joinpath(f"{plan}.toml").read_text()
    config = tomllib.loads(text)["config"]
    assert "seed" in config
    return {name: list(table) for name, table in config.items() if name != "seed"}


def test_packaged_plans_name_only_fitted_settings_and_readings():
    rays = ["prune_threshold", "exponent"]
    fitted = {"emitter": ["level_db"], "beacon": ["level_db"], "rays": rays}
    assert named("physics") == fitted
    readings = {"detection": ["snapshots", "peak_db"], "emitter": ["directivity_law", "level_db"]}
    readings["scenario"] = ["inner_radius", "spacing"]
    assert named("paper") == fitted | readings | {"rays": ["range_update", *fitted["rays"]]}


def test_the_plans_of_the_package_have_the_same_cases_and_counts():
    paper, physics = (read_plan(find_plan(name)) for name in ("paper", "physics"))
    assert paper.grid == physics.grid
    assert (paper.strategies, paper.filters) == (physics.strategies, physics.filters)
    assert paper.iterations == physics.iterations == 115


def test_the_papers_radii_are_logarithmically_spaced():
    radii = read_plan(find_plan("paper")).grid["emitter.radius"]
    spaced = [2.5e-3 * 10 ** (i / 11) for i in range(12)]
    assert list(radii) == [round(radius, 4) for radius in spaced]


def test_a_plan_is_read_and_written_where_its_estimators_are_not_installed(tmp_path):
    plan = plan_of(tmp_path, BARE + 'filters = ["ekf", "not.installed:Here"]\n')
    assert plan.filters == ("ekf", "not.installed:Here")
    assert plan_of(tmp_path, plan_text(plan)) == plan


def test_a_plan_without_strategies_filters_and_name_has_them_all_and_is_named_after_its_file(
    tmp_path,
):
    plan = plan_of(tmp_path, BARE)
    assert (plan.name, plan.strategies) == ("small", ("active", "fused", "passive"))
    assert plan.filters == ("ekf", "fastslam")
    assert plan.config == Config()
    assert [case.config for case in cases_of(plan)] == [Config()] * 6


def test_the_cases_are_the_product_of_grid_strategies_and_filters(tmp_path):
    text = BARE + (
        'strategies = ["fused", "active"]\n'
        'grid = {"rays.exponent" = [1, 3], "air.spreading" = ["paper", "bistatic"]}\n'
    )
    cases = cases_of(plan_of(tmp_path, text))
    assert len(cases) == 2 * 2 * 2 * 2
    for case in cases:
        assert case.config.rays.exponent == case.values["rays.exponent"]
        assert case.config.air.spreading == case.values["air.spreading"]
    assert len({(c.strategy, c.filter, *c.values.values()) for c in cases}) == 16


def test_cases_are_numbered_by_the_grid_then_the_strategies_then_the_filters(tmp_path):
    text = BARE + 'strategies = ["fused", "active"]\ngrid = {"rays.exponent" = [3, 1]}\n'
    cases = cases_of(plan_of(tmp_path, text))
    assert [(case.values["rays.exponent"], case.strategy, case.filter) for case in cases] == [
        (power, strategy, name)
        for power in (3.0, 1.0)
        for strategy in ("fused", "active")
        for name in ("ekf", "fastslam")
    ]
    assert [case.number for case in cases] == list(range(8))


def test_one_passive_case_serves_all_radii_with_the_narrowest_beam(tmp_path):
    text = SMALL.replace("[0.0025, 0.025]", "[0.025, 0.0025]") + '"rays.merge" = [1.0, 2.0, 3.0]\n'
    passive = [case for case in cases_of(plan_of(tmp_path, text)) if case.strategy == "passive"]
    assert len(passive) == 3 * 2
    assert {case.values["emitter.radius"] for case in passive} == {None}
    assert {case.config.emitter.radius for case in passive} == {0.025}


def test_a_grid_may_be_written_as_tables(tmp_path):
    quoted = plan_of(tmp_path, SMALL)
    nested = SMALL.replace('[grid]\n"emitter.radius"', "[grid.emitter]\nradius")
    assert plan_of(tmp_path, nested) == quoted


def test_settings_may_vary_that_are_no_numbers(tmp_path):
    text = BARE + 'grid = {"rays.range_bounds" = [[0.5, 20], [0.5, 10.0]]}\n'
    plan = plan_of(tmp_path, text)
    assert plan.grid["rays.range_bounds"] == ([0.5, 20.0], [0.5, 10.0])
    assert {case.config.rays.range_bounds for case in cases_of(plan)} == {(0.5, 20.0), (0.5, 10.0)}


def test_a_plan_as_written_reads_as_the_same_plan(tmp_path):
    plan = plan_of(tmp_path, SMALL, over=from_flags({"rays": {"exponent": 3.0}}))
    written = plan_text(plan)
    assert plan_of(tmp_path, written) == plan
    unsaid = {"settings", "own", "callers"}
    assert set(tomllib.loads(written)["config"]) == set(Config.model_fields) - unsaid


def test_a_plan_made_of_both_a_setting_and_its_values_can_be_read_again(tmp_path):
    ways = {"strategies": ("active",), "filters": ("ekf",)}
    config, grid = Config(seed=3, rays=RayConfig(exponent=5.0)), {"rays.exponent": (1.0, 2.0)}
    plan = Plan(name="small", iterations=1, config=config, grid=grid, **ways)
    there = plan_of(tmp_path, plan_text(plan))
    assert cases_of(there) == cases_of(plan)
    assert changed_settings(there, plan) == []


def test_given_settings_override_the_plans(tmp_path):
    plan = plan_of(tmp_path, SMALL, over=from_flags({"scenario": {"steps": 8}}), iterations=9)
    assert (plan.config.scenario.steps, plan.config.scenario.landmarks) == (8, 12)
    assert plan.iterations == 9


WIDE = "expected degrees above 0 and up to 180, the widest beam of a back-baffled piston"
KNOWN_FILTERS = "expected 'ekf', 'fastslam', 'iekf', 'smoother' or module:Class"
REFUSED = [
    ('filters = ["ukf"]\n[config]\nsonar = 1\n[own.ekf]\nx = 1\n[grid]\nradius = [1]\n',
     f"key 'filters[0]': found 'ukf', {KNOWN_FILTERS}; correct the value\nconfig.sonar: no such "
     "setting\nown.ekf.x: no such setting\ngrid.radius: no such setting; did you mean"),
    ("[config.rays]\nexponent = 0\n[grid]\nbeacon.level_db = ['loud']\n",
     "config.rays.exponent: found 0, expected greater than 0\ngrid.beacon.level_db: found 'loud'"),
    ('filters = ["ekf", "a.b:"]', f"key 'filters[1]': found 'a.b:', {KNOWN_FILTERS}"),
    ('filters = ["a:B", "c:B"]', "filters: a:B and c:B would write the same files"),
    ('filters = ["a:B", "a:B"]', "filters: found 'a:B' twice"),
    ("iteration = 3", "found the unknown key 'iteration', expected one of format, "),
    ('name = "../up"', "key 'name': found '../up', expected letters, digits"),
    ('strategies = ["loud"]', "key 'strategies[0]': found 'loud', expected 'active',"),
    ("strategies = []", "key 'strategies': found [], expected "),
    ('filters = ["ekf", "ekf"]', "filters: found 'ekf' twice"),
    ("config = 3", "key 'config': found 3, expected a table"),
    ("grid = [1]", "key 'grid': found [1], expected a table"),
    ("[config.rays]\npowr = 1\n", "config.rays.powr: no such setting; did you mean config.rays.ex"),
    ("[config]\nrays = 3\n", "config.rays: found 3, expected a section of settings"),
    ('[grid]\n"emitter.radius" = [0.01, -1.0]\n',
     "grid.emitter.radius: found -1.0, expected greater than 0"),
    ('[grid]\n"emitter.radius" = [nan]\n',
     "grid.emitter.radius: found nan, expected a finite number"),
    ('[grid]\n"emitter.radius" = ["wide"]\n',
     "grid.emitter.radius: found 'wide', expected a valid number"),
    ('[grid]\n"rays.exponent" = 2.0\n', "grid.rays.exponent: found 2.0, expected a list"),
    ('[grid]\n"rays.exponent" = []\n', "grid.rays.exponent: found [], expected a list"),
    ('[grid]\n"rays.exponent" = [2, 2.0]\n',
     "grid.rays.exponent: found 2.0 twice, expected each value once"),
    ("[grid]\nseed = [1, 2]\n", "grid.seed: every iteration is another world"),
    ("own = 3", "key 'own': found 3, expected a table"),
    ("[own]\nekf = 3\n", "own.ekf: found 3, expected a table"),
    ("[own.iekf]\nfilter.gate = 0.9\n", "own.iekf: no filter of this plan; expected one of ekf"),
    ("[own.ekf]\nemitter.radius = 0.01\n",
     "own.ekf.emitter.radius: changes what is heard; expected one of the "
     "sections listening, association, filter, rays, fastslam"),
    ("[own.ekf]\nseed = 1\n", "own.ekf.seed: changes what is heard"),
    ('[own.ekf]\nrays.exponent = 2.0\n[grid]\n"rays.exponent" = [1.0, 2.0]\n',
     "own.ekf.rays.exponent: the plan varies this setting; take it out"),
    ("[own.ekf]\nfilter.gat = 0.9\n",
     "own.ekf.filter.gat: no such setting; did you mean filter.gate?"),
    ("[own.ekf]\nfilter = 3\n", "own.ekf.filter: found 3, expected a section of settings"),
    ("[own.ekf]\nfilter.gate = 2.0\n",
     'own.ekf.filter.gate: found 2.0, expected above 0 and up to 1, or "auto"'),
    ("[own.ekf]\nfilter.initial_pose_std = [0.1, 0.1]\n",
     "own.ekf.filter.initial_pose_std: found [0.1, 0.1], expected 3 values"),
    ("[own.ekf]\nrays.range_bounds = [9.0, 3.0]\n",
     "own.ekf.rays.range_bounds: range_bounds must rise, found [9.0, 3.0]"),
    ("[grid]\ncallers = 3", "grid.callers: found 3, expected a list of values"),
    ("[grid]\ncallers = [3]", "grid.callers: found 3, expected a list of tables"),
    ("[grid]\ncallers = [{}]", "grid.callers: found {}, expected a list of tables"),
    ("[grid]\ncallers = [[{x = 1}]]", "grid.callers.1.x: no such key of a caller"),
    ("[grid]\ncallers = [[{}], [{}]]", "grid.callers: found [{}] twice"),
    ("[config.callers]\nx = 1", "config.callers: found {'x': 1}, expected a list of"),
    ("[[config.callers]]\nspeed = 1", "config.callers.1: found speed, which a caller"),
    ("[config]\ncallers = [{}]\n[grid]\ncallers = [[]]",
     "config.callers: the plan varies this setting"),
    ('[grid]\n"rays.range_bounds" = [[0.5, 20.0], [20.0, 30.0], [9.0, 3.0]]',
     "grid.rays.range_bounds: range_bounds must rise, found [9.0, 3.0]"),
    ('[config.rays]\nexponent = 3.0\n[grid]\n"rays.exponent" = [1.0, 2.0]',
     "config.rays.exponent: the plan varies this setting; take it out of [grid] in PLAN"),
    ("[grid]\nbeamwith = [33]", "grid.beamwith: no such setting; did you mean beamwidth?"),
    *(
        (f"[grid]\nbeamwidth = [33, {value}]",
         f"grid.beamwidth: found {found}, {WIDE}; correct the value")
        for value, found in (
            ("0", "0"), ("-3", "-3"), ("181", "181"), ("nan", "nan"), ("inf", "inf"),
            ("true", "True"), ('"wide"', "'wide'"), ("[33]", "[33]"),
        )
    ),
    ("[grid]\nbeamwidth = 33",
     "grid.beamwidth: found 33, expected a list of degrees; write it as [180, 33"),
    ("[grid]\nbeamwidth = []", "grid.beamwidth: found [], expected a list of degrees"),
    ("[grid]\nbeamwidth = [33, 33.0]",
     "grid.beamwidth: found 33.0 twice, expected each value once"),
    ("[grid]\nbeamwidth = [33, 1e-12]",
     "grid.beamwidth: radius of 1e-12: found 288889356953.0, expected less than or equal to"),
    (BEAMS + '"emitter.radius" = [0.01]',
     "grid.beamwidth: is emitter.radius in other words; vary one of them"),
    (BEAMS + "[grid.emitter]\nradius = [0.01]",
     "grid.beamwidth: is emitter.radius in other words"),
    (BEAMS + '"emitter.frequency" = [3e4, 4e4]',
     "grid.beamwidth: a beamwidth is no one radius where emitter.frequency varies too; vary "
     "emitter.radius"),
    (BEAMS + "[grid.air]\ntemperature_c = [0, 20]",
     "grid.beamwidth: a beamwidth is no one radius where air"),
    ('strategies = ["passive"]\n' + BEAMS,
     "grid.beamwidth: the beam is that of the vehicle's call, which"),
    (BEAMS + "[config]\nemitter.radius = 0.01",
     "config.emitter.radius: the plan varies this setting as beamwidth; take it out of"),
]  # fmt: skip
"""Text of a plan after its format and number of worlds, and the lines after the plan's name."""
INCOMPLETE = [
    ("format = 1", "found no key 'iterations', expected the keys format, name, "),
    ("iterations = 3", "found no key 'format', expected the keys format, "),
    ("iterations = = 3", "found Invalid value (at line 1, column 14), expected TOML"),
    ("format = 2\niterations = 3\n", "key 'format': found 2, expected 1"),
    ("format = 1\niterations = 0\n", "key 'iterations': found 0, expected greater than"),
    ("format = 1\niterations = 2.0\n", "key 'iterations': found 2.0, expected a valid integer"),
    ("format = 1\niterations = true\n", "key 'iterations': found True, expected"),
]


@pytest.mark.parametrize(
    ("text", "said"), [*((BARE + text, said) for text, said in REFUSED), *INCOMPLETE]
)
def test_mistakes_are_named_in_lines_with_file_key_and_expectation(refused, text, said):
    for found, words in zip(refused(text).split("\n"), said.split("\n"), strict=True):
        assert found.startswith((f"PLAN: {words}", f"PLAN, {words}"))


def test_more_cases_than_the_tables_can_number_are_refused(refused):
    values = str([1.0 + i / 1000 for i in range(100)])
    text = BARE + f'[grid]\n"rays.exponent" = {values}\n"air.pressure_kpa" = {values}\n'
    assert refused(text) == "PLAN: grid: found 60000 cases, expected at most 32767"


def test_a_default_of_a_varied_setting_has_no_effect(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(BARE + '[grid]\n"rays.exponent" = [1.0, 3.0]\n[config.rays]\nexponent = 2.0\n')
    assert read_plan(path).grid == {"rays.exponent": (1.0, 3.0)}


@pytest.mark.parametrize("text", [SMALL, BARE + BEAMS])
def test_a_flag_replaces_the_values_of_a_grid(tmp_path, text):
    over = from_flags({"emitter": {"radius": 0.01}})
    with pytest.warns(UserWarning, match=r"--emitter.radius replaces its values in \[grid\] of"):
        plan = plan_of(tmp_path, text, over=over)
    assert "emitter.radius" not in plan.grid
    assert plan.config.emitter.radius == 0.01


def test_a_bad_value_of_a_flag_is_named(refused):
    said = refused(SMALL, over=from_flags({"rays": {"exponent": -1}}))
    assert said.startswith("--rays.exponent: found -1, expected")


def test_a_plan_that_is_not_there_is_refused():
    plans = "association, beyond, callers, pair, paper, physics, sweeps, timing"
    said = rf"^none\.toml: found no such file; expected {plans} or the path"
    with pytest.raises(InputError, match=said):
        find_plan("none.toml")


def test_all_that_differs_is_named_but_for_the_number_of_worlds(tmp_path):
    there = plan_of(tmp_path, SMALL)
    assert changed_settings(there, plan_of(tmp_path, SMALL, iterations=30)) == []
    text = SMALL.replace("landmarks = 12", "landmarks = 13").replace("0.025]", "0.02]")
    text = text.replace("[config", 'filters = ["ekf"]\n[config') + '"rays.exponent" = [1.0]\n'
    assert changed_settings(there, plan_of(tmp_path, text)) == [
        'filters: ["ekf", "fastslam"] there, ["ekf"] asked for',
        "config.scenario.landmarks: 12 there, 13 asked for",
        "grid.emitter.radius: [0.0025, 0.025] there, [0.0025, 0.02] asked for",
        "grid.rays.exponent: nothing there, [1.0] asked for",
    ]


def test_how_many_worlds_the_file_names_is_remembered_and_is_no_setting(tmp_path):
    few = read_plan(find_plan("paper"), iterations=5)
    assert (few.iterations, few.planned) == (5, 115)
    assert plan_text(few).splitlines()[2:4] == ["iterations = 5", "planned = 115"]
    more = plan_of(tmp_path, SMALL, iterations=30)
    assert (more.iterations, more.planned) == (30, 30)
    few = plan_of(tmp_path, SMALL, iterations=1)
    assert plan_of(tmp_path, plan_text(few)) == few
    assert changed_settings(few, more) == []
    assert "planned" not in plan_settings(few)
    with pytest.raises(InputError, match=r"small\.toml, key 'planned': found 'many', expected a"):
        plan_of(tmp_path, 'planned = "many"\n' + SMALL)


def test_settings_that_are_not_varied_follow_the_plan(tmp_path):
    text = SMALL + '"emitter.level_db" = [40.0]\n'
    for case in cases_of(plan_of(tmp_path, text)):
        expected = EmitterConfig(radius=case.config.emitter.radius, level_db=40.0)
        assert case.config.emitter == expected
        assert case.config.scenario.steps == 40


# Settings that are one filter's own

OWN = BARE + (
    'filters = ["ekf", "iekf", "a.b:Mine"]\n'
    "[config]\nfilter.gate = 0.99\n"
    '[grid]\n"rays.exponent" = [1.0, 3.0]\n'
    '[own.iekf]\nfilter.noise = "measured"\nrays.precise_bearings = "auto"\n'
    '[own."a.b:Mine"]\nfilter.gate = 0.5\nfilter.initial_pose_std = [0.1, 0.1, 0.2]\n'
)


def test_settings_of_one_filter_apply_only_to_its_cases(tmp_path):
    plan = plan_of(tmp_path, OWN)
    assert plan.own["iekf"] == {"filter.noise": "measured", "rays.precise_bearings": "auto"}
    for case in cases_of(plan):
        shared = common(plan, {"rays.exponent": case.values["rays.exponent"]})
        assert shared.filter.gate == 0.99
        assert case.config.rays.exponent == shared.rays.exponent == case.values["rays.exponent"]
        told, rays = case.config.filter, case.config.rays
        if case.filter == "ekf":
            assert case.config == shared
        elif case.filter == "iekf":
            assert (told.noise, told.gate, rays.precise_bearings) == ("measured", 0.99, "auto")
        else:
            assert (told.noise, told.gate, rays.precise_bearings) == ("constant", 0.5, "paper")
            assert told.initial_pose_std == (0.1, 0.1, 0.2)


def test_a_plan_with_settings_per_filter_is_read_back(tmp_path):
    plan = plan_of(tmp_path, OWN)
    assert plan_of(tmp_path, plan_text(plan)) == plan
    assert changed_settings(plan, plan_of(tmp_path, plan_text(plan))) == []


def test_a_plan_without_settings_per_filter_has_no_table_of_them(tmp_path):
    plan = plan_of(tmp_path, SMALL)
    assert plan.own == {}
    keys = ["format", "name", "iterations", "strategies", "filters", "config", "grid"]
    assert list(tomllib.loads(plan_text(plan))) == keys


def test_settings_that_contradict_a_grid_value_are_refused(refused):
    text = '[own.ekf]\nrays.precise_bearings = "auto"\n'
    text += '[grid]\n"rays.likelihood" = ["normal", "printed"]\n'
    said = refused(BARE + text)
    assert said.startswith("PLAN: ")
    assert 'bearings "auto" needs likelihood "normal", found "printed"' in said


def test_changed_settings_of_one_filter_are_listed(tmp_path):
    there = plan_of(tmp_path, OWN)
    asked = plan_of(tmp_path, OWN.replace('filter.noise = "measured"', "filter.gate = 0.9"))
    assert changed_settings(there, asked) == [
        'own.iekf.filter.noise: "measured" there, nothing asked for',
        "own.iekf.filter.gate: nothing there, 0.9 asked for",
    ]


def test_an_empty_table_of_one_filter_has_no_effect(tmp_path):
    bare, empty = plan_of(tmp_path, BARE), plan_of(tmp_path, BARE + "[own.ekf]\n")
    assert changed_settings(bare, empty) == []
    assert plan_text(bare) == plan_text(empty)


def test_the_plan_beyond_asks_the_question_of_four_filters_in_the_worlds_of_physics():
    beyond, physics = (read_plan(find_plan(name)) for name in ("beyond", "physics"))
    assert beyond.filters == ("ekf", "fastslam", "iekf", "smoother")
    assert len(cases_of(beyond)) == 100
    assert beyond.grid == physics.grid
    assert (beyond.strategies, beyond.iterations) == (physics.strategies, physics.iterations)
    assert set(beyond.own) == {"fastslam", "iekf", "smoother"}
    heard = [p.config.model_dump(exclude=set(SECTIONS)) for p in (beyond, physics)]
    assert heard[0] == heard[1]


CALLERS = """
[grid]
callers = [
  [],
  [{}],
  [{}, {frequency = 25e3, course = "circle"}],
  [{}, {name = "boat", frequency = 25e3, route = "boat.csv"}],
]
"""


def test_a_grid_may_list_callers_and_the_plan_holds_their_routes(tmp_path):
    (tmp_path / "boat.csv").write_text("time,x,y\n0,1,2\n9,3,4\n")
    plan = plan_of(tmp_path, BARE + CALLERS)
    cases = cases_of(plan)
    assert Counter(len(case.config.callers) for case in cases) == {0: 6, 1: 6, 2: 12}
    assert cases[-1].config.callers[1].route == ((0.0, 1.0, 2.0), (9.0, 3.0, 4.0))
    (tmp_path / "boat.csv").unlink()
    again = plan_of(tmp_path, plan_text(plan))
    assert again == plan
    assert changed_settings(plan, again) == []


def test_a_missing_route_of_a_caller_is_refused(refused):
    assert "boat.csv: found no such file" in refused(BARE + "[[config.callers]]\nroute='boat.csv'")


@pytest.mark.parametrize(
    ("name", "of", "sections"),
    [("timing", "beyond", ()), ("sweeps", "association", ("config.emitter", "config.beacon"))],
)
def test_a_plan_has_the_worlds_of_another_with_timing(name, of, sections):
    plan, other = (plan_settings(read_plan(find_plan(word))) for word in (name, of))
    differ = {key for key in plan.keys() | other.keys() if plan.get(key) != other.get(key)}
    there = {key.rpartition(".")[0] for key in differ if not key.startswith("grid.")}
    assert there == {"", "config.listening", *sections}
    assert plan["config.listening.excess_paths"] is True


@pytest.mark.parametrize("name", ["callers", "pair"])
def test_plans_with_callers_use_the_papers_worlds_with_timing(name):
    plan, physics = (read_plan(find_plan(word)) for word in (name, "physics"))
    assert plan.config.listening.excess_paths
    for part in ("seed", "emitter", "beacon", "motion", "air", "target", "detection"):
        assert getattr(plan.config, part) == getattr(physics.config, part)
    assert plan.config.scenario == physics.config.scenario


def test_a_pair_is_two_vehicles_of_one_world():
    plan = read_plan(find_plan("pair"))
    assert plan.grid["scenario.vehicle"] == (1, 2)
    (mate,) = plan.config.callers
    assert mate.way == "mission"


# Beamwidths in a grid


def width_of(case, tone=35e3):
    return math.degrees(beamwidth(case.config.emitter.radius, frequency=tone, speed_of_sound=343.0))


def test_a_beamwidth_is_converted_to_its_radius(tmp_path):
    plan = plan_of(tmp_path, BEAMWIDTHS)
    assert list(plan.grid) == ["emitter.radius", "rays.exponent"], "in the place of the beamwidths"
    cases = [case for case in cases_of(plan) if case.strategy == "active"]
    widths = [width_of(case) for case in cases[::4]]
    assert widths[0] == 180.0
    assert widths[1:] == pytest.approx([90.0, 33.2, 11.0], rel=1e-9)


def test_a_radius_is_rounded_to_12_digits(tmp_path):
    radius = plan_of(tmp_path, BEAMWIDTHS).grid["emitter.radius"][2]
    exact = float(piston_radius(math.radians(33.2), frequency=35e3, speed_of_sound=343.0))
    assert radius == pytest.approx(exact, rel=2e-12)
    assert radius == float(f"{radius:.12g}")


def test_radii_use_the_plans_tone_and_speed_of_sound(tmp_path):
    told = plan_of(tmp_path, BEAMWIDTHS, over=from_flags({"emitter": {"frequency": 20e3}}))
    widths = [width_of(case, tone=20e3) for case in cases_of(told) if case.strategy == "active"]
    assert sorted(set(widths)) == pytest.approx([11.0, 33.2, 90.0, 180.0], rel=1e-9)
    cold = plan_of(tmp_path, BEAMWIDTHS + "[config]\nair.temperature_c = -10.0\n")
    assert cold.grid["emitter.radius"][0] < plan_of(tmp_path, BEAMWIDTHS).grid["emitter.radius"][0]


def test_a_study_of_beamwidths_goes_on_by_either_way_of_writing_it(tmp_path):
    plan, folder = plan_of(tmp_path, BEAMWIDTHS), tmp_path / "study"
    open_store(folder, plan)
    kept = plan_of(tmp_path, (folder / "plan.toml").read_text())
    assert kept == plan
    assert changed_settings(kept, plan_of(tmp_path, BEAMWIDTHS)) == []
    assert plan_text(kept) == plan_text(plan)
    open_store(folder, plan_of(tmp_path, BEAMWIDTHS, iterations=9))
    with pytest.raises(InputError, match=r"grid\.emitter\.radius: .* there, "):
        open_store(folder, plan_of(tmp_path, BEAMWIDTHS.replace("33.2", "33")))


def test_temperatures_may_vary_if_the_speed_of_sound_is_set(tmp_path):
    text = BEAMS + '"air.temperature_c" = [0.0, 20.0]\n[config]\nair.speed_of_sound = 343.0\n'
    assert len(plan_of(tmp_path, BARE + text).grid["emitter.radius"]) == 2
