import math
import os
import tomllib
from contextlib import suppress
from functools import reduce
from itertools import product
from operator import getitem
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from pipistrelle.config import AirConfig, Config, InputError, RayConfig, ScenarioConfig, Section
from pipistrelle.experiments.studies.plan import cases_of, plan_text, read_plan
from pipistrelle.settings import (
    CALLERS,
    OWN,
    RENAMED,
    SETTINGS,
    from_environment,
    from_file,
    from_flags,
    from_keywords,
    from_table,
    from_text,
    known_settings,
    resolve,
    to_toml,
)

TABLES = "expected a list of tables, one for each caller, as [{frequency = 30e3}]"


def written(folder: Path, text: str) -> Path:
    path = folder / "mission.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(folder: Path, text: str) -> str:
    """Return the message about a file, without the path."""
    path = written(folder, text)
    with pytest.raises(InputError) as refused:
        resolve(from_file(path))
    lines = str(refused.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines)
    return "\n".join(line.removeprefix(f"{path}: ") for line in lines)


def test_every_setting_of_the_configuration_is_known_and_documented():
    leaves = {
        (section, leaf)
        for section, values in Config().model_dump().items()
        if isinstance(values, dict)
        for leaf in values
    }
    assert set(known_settings()) == leaves | {("seed",), SETTINGS, OWN, CALLERS}
    silent = [".".join(key) for key, field in known_settings().items() if not field.description]
    assert silent == []


@pytest.mark.parametrize(
    ("file", "environment", "flags", "ratio"),
    [
        ("", {}, {}, RayConfig().merge),
        ("rays.merge = 0.2", {}, {}, 0.2),
        ("rays.merge = 0.2", {"PIPISTRELLE_RAYS__MERGE": "0.3"}, {}, 0.3),
        ("rays.merge = 0.2", {"PIPISTRELLE_RAYS__MERGE": "0.3"}, {"rays": {"merge": 0.4}}, 0.4),
        ("rays.merge = 0.2", {}, {"rays": {"merge": 0.4}}, 0.4),
        ("", {"PIPISTRELLE_RAYS__MERGE": "0.3"}, {"rays": {"merge": 0.4}}, 0.4),
    ],
)
def test_flags_override_environment_file_and_defaults(tmp_path, file, environment, flags, ratio):
    layer = from_file(written(tmp_path, file)) | from_environment(environment) | from_flags(flags)
    assert resolve(layer).rays.merge == ratio


def test_an_old_name_of_a_setting_is_read_and_announced():
    for old, new in RENAMED.items():
        with pytest.warns(FutureWarning, match=f"{old} is now called {new};"):
            assert from_table({old: 1}, "") == {tuple(new.split(".")): (1, old)}
    with pytest.raises(InputError, match="are one setting"), pytest.warns():
        from_table({"rays": {"exponent": 1, "power": 2}}, "")


def test_layers_keep_settings_that_they_do_not_name(tmp_path):
    file = from_file(written(tmp_path, "[rays]\nrelative_std = 0.4\nweights = 'aggregated'\n"))
    environment = from_environment({"PIPISTRELLE_RAYS__EXPONENT": "3"})
    flags = from_flags({"air": {"relative_humidity": 0.3}, "seed": 9})
    assert resolve(file | environment | flags) == Config(
        seed=9,
        air=AirConfig(relative_humidity=0.3),
        rays=RayConfig(relative_std=0.4, weights="aggregated", exponent=3.0),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rays.powr = 3", "rays.powr: no such setting; did you mean rays.exponent?"),
        ("power = 3", "power: no such setting; did you mean rays.exponent?"),
        ("[rays.powr]\nx = 3", "rays.powr.x: no such setting; did you mean rays.exponent?"),
        ("qqq = 3", "qqq: no such setting; see `pipistrelle config show`"),
        ("[qqq]", "qqq: no such setting; see `pipistrelle config show`"),
        ("rays = 3", "rays: found 3, expected a section of settings"),
        ("rays.exponent = -3", "rays.exponent: found -3, expected greater than 0"),
        ("rays.exponent = nan", "rays.exponent: found nan, expected a finite number"),
        ("rays.exponent = inf", "rays.exponent: found inf, expected a finite number"),
        ("rays.exponent = '3'", "rays.exponent: found '3', expected a valid number"),
        ("rays.exponent = true", "rays.exponent: found True, expected a valid number"),
        ("rays.exponent.x = 3", "rays.exponent: found {'x': 3}, expected a valid number"),
        ("scenario.steps = 3.0", "scenario.steps: found 3.0, expected a valid integer"),
        ("target.shape = 'cube'", "target.shape: found 'cube', expected 'cylinder' or 'sphere'"),
        ("detection.leakage_db = 12345",
         "detection.leakage_db: found 12345, expected less than or equal to 300"),
        ("rays.range_bounds = [1]", "rays.range_bounds: found [1], expected 2 values"),
        ("rays.range_bounds = [1, 2, 3]", "rays.range_bounds: found [1, 2, 3], expected 2 values"),
        ("rays.range_bounds = [1, -2]",
         "rays.range_bounds: found [1, -2], expected greater than 0 as value 2"),
        ("callers = 3", f"callers: found 3, {TABLES}"),
        ("[callers]\nfrequency = 3e4", f"callers: found {{'frequency': 30000.0}}, {TABLES}"),
        ("callers = [3]", "callers.1: found 3, expected a table that says who calls"),
        ("[[callers]]\nfreqency = 1",
         "callers.1.freqency: no such key of a caller; did you mean frequency?"),
        ("[[callers]]\n[[callers]]\nfrequency = -1",
         "callers.2.frequency: found -1, expected greater than 0"),
        ("[[callers]]\nlevel_db = 'loud'",
         "callers.1.level_db: found 'loud', expected a valid number"),
        ("[[callers]]\nname = 'a b'",
         "callers.1.name: found 'a b', expected up to 40 letters, digits, _ and -"),
        ("[[callers]]\nname = 'Vehicle'",
         "callers: found the name 'Vehicle' again, expected another; choose one"),
        ("callers = [{}, {name = 'beacon'}]",
         "callers: found the name 'beacon' again, expected another; choose one"),
        ("[[callers]]\nplace = [1]", "callers.1.place: found [1], expected x and y"),
        ("[[callers]]\nplace = [1, nan]", "callers.1.place: found [1, nan], expected x and y"),
        ("[[callers]]\nplace = [1, 2]\ndistance = 3",
         "callers.1: found a place and a distance, expected one of them; leave one out"),
        ("[[callers]]\nwaypoints = [[1, 2]]",
         "callers.1.waypoints: found [[1, 2]], expected a list of points [x, y], two at least"),
        ("[[callers]]\ncourse = 'line'",
         "callers.1.course: found 'line', expected 'circle', 'walk' or 'mission'"),
        (
            "[[callers]]\nspeed = 1.0",
            "callers.1: found speed, which a caller that stands has not; add way-points or "
            'course = "circle", or leave it out',
        ),
        ("[[callers]]\ncourse = 'circle'\ndistance = 3",
         'callers.1: found distance, which course = "circle" has not; leave one of them out'),
        ("[[callers]]\ncourse = 'walk'\nroute = 'a.csv'",
         "callers.1: found course, which a route has not; leave one of them out"),
        ("[[callers]]\ncourse = 'circle'\nspeed = 0",
         "callers.1: found speed 0, expected another; give a place to one that stands"),
        ("[[callers]]\nroute = [[0, 1, 2], [0, 1, 2]]",
         "callers.1: found time 0 after 0 in row 2 of the route, expected times that rise"),
        ("[[callers]]\nroute = [[0, 1, 2]]",
         "callers.1.route: found [[0, 1, 2]], expected a CSV file of time,x,y, or two such rows"),
        ("[[callers]]\n" * 8, "callers: found 8 callers, expected at most 7 besides the vehicle"),
        ("rays.exponent = 2\nrays.range_bounds = [3, 2]",
         "rays.range_bounds: range_bounds must rise, found [3.0, 2.0]"),
    ],
)  # fmt: skip
def test_an_invalid_file_is_reported_by_key_value_and_expectation(tmp_path, text, message):
    assert refusal(tmp_path, text) == message


def test_all_invalid_values_are_reported_together(tmp_path):
    assert len(refusal(tmp_path, "rays.exponent = 0\nair.pressure_kpa = 'high'").splitlines()) == 2


def test_a_file_with_invalid_toml_is_reported_by_line(tmp_path):
    assert "(at line 2," in refusal(tmp_path, "seed = 3\nrays.exponent 3\n")
    path = tmp_path / "mission.toml"
    path.write_bytes(b"seed = 3 # \xff")
    with pytest.raises(InputError, match="byte 11, which is no UTF-8"):
        from_file(path)


def test_a_path_without_utf8_is_reported_by_its_setting():
    layer = from_flags({"scenario": {"world": os.fsdecode(b"w\xff")}, "seed": 3})
    with pytest.raises(InputError, match=r"--scenario.world: found .*, expected UTF-8 text; "):
        resolve(layer)
    callers = [{"name": "boat", "route": os.fsdecode(b"boat\xff.csv")}]
    with pytest.raises(InputError, match=r"--callers: found .*, expected UTF-8 text; "):
        resolve(from_flags({"callers": callers}))


@pytest.mark.parametrize(("text", "value"), [("2", 2.0), (".5", 0.5), ("1e-3", 1e-3), (" 4 ", 4.0)])
def test_the_environment_accepts_usual_spellings_of_numbers(text, value):
    assert resolve(from_environment({"PIPISTRELLE_RAYS__EXPONENT": text})).rays.exponent == value


def test_text_and_lists_in_the_environment_are_spelled_as_in_files():
    config = resolve(
        from_environment(
            {
                "PIPISTRELLE_RAYS__WEIGHTS": "aggregated",
                "PIPISTRELLE_RAYS__MERGE": "0.5",
                "PIPISTRELLE_RAYS__RANGE_BOUNDS": "[1, 15.5]",
                "PIPISTRELLE_SEED": "11",
                "PIPISTRELLE_DATA": "/somewhere",
                "HOME": "/root",
            }
        )
    )
    assert config.rays == RayConfig(weights="aggregated", merge=0.5, range_bounds=(1, 15.5))
    assert config.seed == 11


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("PIPISTRELLE_RAYS__EXPONENT", "x", "found 'x', expected a valid number"),
        ("PIPISTRELLE_RAYS__EXPONENT", "nan", "found nan, expected a finite number"),
        ("PIPISTRELLE_SEED", "", "found '', expected a valid integer"),
        ("PIPISTRELLE_SEED", "3\nrays = 4", r"found '3\nrays = 4', expected a valid integer"),
        ("PIPISTRELLE_RAYS", "3", "found 3, expected a section of settings"),
        ("PIPISTRELLE_RAYS__MERG", "3", "no such setting; did you mean PIPISTRELLE_RAYS__MERGE?"),
    ],
)
def test_an_invalid_environment_is_reported_by_its_variable(name, text, message):
    with pytest.raises(InputError) as refused:
        resolve(from_environment({name: text}))
    assert str(refused.value) == f"{name}: {message}"


CALLING = (
    "{}, {name = 'boat', frequency = 25e3, level_db = 40, course = 'circle', centre = [1, 2]}",
    "{place = [3, 4]}, {frequency = 25e3, waypoints = [[1, 2], [3, 4.5]], speed = -0.5}",
    "{course = 'walk', memory = 3.0, speed_std = 0.2, distance = 4}",
    "{route = [[0, 1, 2], [1.5, 3, 4]]}",
    "",
)


@pytest.mark.parametrize("text", CALLING)
def test_callers_are_equal_from_every_source_and_after_writing(tmp_path, text):
    config = resolve(from_file(written(tmp_path, f"callers = [{text}]")))
    assert config.callers is not None
    assert len(config.callers) == text.count("{")
    assert resolve(from_environment({"PIPISTRELLE_CALLERS": f"[{text}]"})) == config
    assert resolve(from_flags({"callers": from_text(f"[{text}]")})) == config
    assert resolve(from_keywords({"callers": config.callers})) == config
    assert resolve(from_file(written(tmp_path, to_toml(config)))) == config
    assert resolve(from_flags(config.model_dump(mode="json"))) == config


def test_settings_without_callers_are_written_without_callers():
    values = Config().model_dump(mode="json", exclude_none=True)
    assert "callers" not in values
    assert resolve(from_flags(values)) == Config()


def test_a_route_is_relative_to_its_file_of_settings(tmp_path):
    layer = from_file(written(tmp_path, "[[callers]]\nroute = 'boat.csv'\n"))
    assert layer[CALLERS].value == [{"route": (tmp_path / "boat.csv").as_posix()}]


def test_an_invalid_flag_is_reported_by_its_name():
    with pytest.raises(InputError) as refused:
        resolve(from_flags({"air": {"relative_humidity": 3.0}}))
    found = "--air.relative-humidity: found 3.0, expected less than or equal to 1"
    assert str(refused.value) == found


able = st.floats(min_value=1e-9, max_value=1e9)


@given(
    seed=st.integers(0, 2**63 - 1),
    bounds=st.tuples(able, able).filter(lambda pair: pair[0] < pair[1]),
    start=st.tuples(able, able.map(float.__neg__), able),
)
def test_settings_written_as_toml_are_read_back_exactly(tmp_path_factory, seed, bounds, start):
    config = Config(
        seed=seed,
        scenario=ScenarioConfig(start=start),
        rays=RayConfig(range_bounds=bounds, weights="aggregated"),
    )
    path = written(tmp_path_factory.getbasetemp(), to_toml(config))
    assert resolve(from_file(path)) == config


def test_written_settings_contain_each_setting_once_with_its_meaning():
    text = to_toml(Config())
    values = tomllib.loads(text)
    named = sum(len(value) if isinstance(value, dict) else 1 for value in values.values())
    others = [key[-1] for key, field in known_settings().items() if field.default is None]
    assert len(known_settings()) == named + len(others)
    assert {"world", "speed_of_sound", "wheelbase"} <= set(others)
    assert all(f"# {name} =" in text for name in others)  # derived from others by default
    assert all(" # " in line for line in text.splitlines() if " = " in line)


def test_the_speed_of_sound_follows_the_temperature_by_default():
    assert Config().air.sound_speed == 343.0
    for temperature in (-40.0, 5.0, 35.0):
        air = AirConfig(temperature_c=temperature)
        ideal_gas = math.sqrt(1.4 * 8.314462 * (temperature + 273.15) / 28.9652e-3)
        assert air.sound_speed == pytest.approx(ideal_gas, rel=1e-3)
        assert AirConfig(temperature_c=temperature, speed_of_sound=340.0).sound_speed == 340.0


def test_the_default_speed_of_sound_follows_a_grid_of_temperatures(tmp_path):
    (tmp_path / "air.toml").write_text(
        "format = 1\niterations = 1\nfilters = ['ekf']\nstrategies = ['fused']\n"
        "[grid]\n'air.temperature_c' = [5.0, 20.0]\n"
    )
    plan = read_plan(tmp_path / "air.toml")
    (tmp_path / "plan.toml").write_text(plan_text(plan))
    for each in (plan, read_plan(tmp_path / "plan.toml")):
        speeds = [case.config.air.sound_speed for case in cases_of(each)]
        assert speeds == [pytest.approx(334.1, abs=0.05), 343.0]


def numbers_of(section, path=()):
    """Yield the path of names to every setting that can be a float."""
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section):
            yield from numbers_of(value, (*path, name))
        elif "float" in str(field.annotation):
            yield (*path, name)


@pytest.mark.filterwarnings("error")
def test_an_integer_for_a_float_setting_becomes_a_float():
    tried = set()
    for path, whole in product(numbers_of(Config()), [1, [1, 2], [2, 1], [1, 2, 3]]):
        table = reduce(lambda inner, name: {name: inner}, reversed(path), whole)
        with suppress(ValidationError):  # no value of this setting
            config = Config.model_validate(table)
            value = reduce(getattr, path, config)
            kinds = {type(one) for one in (value if isinstance(whole, list) else [value])}
            assert kinds == {float}, path
            assert reduce(getitem, path, config.model_dump(mode="json")) == whole, path
            tried.add(path)
    assert ("filter", "gate") in tried
    assert len(tried) > 50
