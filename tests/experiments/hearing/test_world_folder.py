"""Worlds as folders: what is written is read back to the bit, and what is wrong has a line."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.acoustics.emitter import Bodies
from pipistrelle.acoustics.paths import Caller
from pipistrelle.config import (
    CallerConfig,
    Config,
    InputError,
    MotionConfig,
    ScenarioConfig,
    caller_names,
)
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN, Scenario, World, world_of
from pipistrelle.experiments.hearing.trajectories import Commands, Poses
from pipistrelle.experiments.hearing.world_folder import (
    laid_over,
    named_world,
    read_world,
    with_world,
    world_files,
)
from pipistrelle.experiments.runs.validate import checked_scenario
from pipistrelle.files import WORLD, OwnFiles
from pipistrelle.settings import from_flags, resolve

LANDMARKS = "landmark,x,y\n1,2.5,0\n2,-1,4\n"


def folder_with(tmp_path, **files):
    """Write a world's folder; a name's last _ stands for its dot."""
    folder = tmp_path / "own [1]"
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / ".".join(name.rsplit("_", 1))).write_text(text)
    return folder


def heard(config, world):
    return world_of(config, 0, world)


@pytest.mark.parametrize("model", ["bicycle", "unicycle"])
def test_a_world_that_was_drawn_is_read_back_to_the_bit(tmp_path, model):
    config = Config(
        scenario=ScenarioConfig(steps=80, landmarks=12, course="eight"),
        motion=MotionConfig(model=model),
    )
    drawn = world_of(config, 5)
    OwnFiles(tmp_path / "w", WORLD).replace(world_files(drawn, config))
    layer = from_flags({"scenario": {"world": str(tmp_path / "w")}, "seed": 99})
    world = named_world(layer)
    again_config = resolve(with_world(world, layer))
    again = heard(again_config, world)
    for name in ("time", "path", "controls", "landmarks"):
        assert getattr(again, name).tobytes() == getattr(drawn, name).tobytes()
    assert [caller.name for caller in again.callers] == ["vehicle", "beacon"]
    np.testing.assert_array_equal(again.callers[1].place, drawn.callers[1].place)
    assert again_config.scenario.steps == 80
    assert again_config.motion == config.motion


def test_a_second_vehicles_world_is_read_back_as_a_single_vehicles(tmp_path):
    pair = (CallerConfig(name="mate", course="mission"),)
    config = Config(callers=pair, scenario=ScenarioConfig(steps=80, landmarks=12, vehicle=2))
    drawn = world_of(config, 5)
    OwnFiles(tmp_path / "w", WORLD).replace(world_files(drawn, config))
    layer = from_flags({"scenario": {"world": str(tmp_path / "w")}})
    world = named_world(layer)
    again_config = resolve(with_world(world, layer))
    again = heard(again_config, world)
    assert again_config.scenario.vehicle == 1
    for one, other in zip(again.callers, drawn.callers, strict=True):
        assert (one.frequency, one.level_db) == (other.frequency, other.level_db)
    np.testing.assert_array_equal(again.callers[1].heading, drawn.callers[1].heading)
    np.testing.assert_array_equal(again.path, drawn.path)
    np.testing.assert_array_equal(again.callers[1].place, drawn.callers[1].place)


def test_bodies_and_routes_are_read_back(tmp_path):
    time = np.arange(9) * 0.125
    boat = np.column_stack((time, -time))
    drawn = Scenario(
        time=time,
        path=np.column_stack((time, time, 0.0 * time)),
        controls=np.ones((8, 2)),
        landmarks=np.array([[1.0, 5.0], [2.0, 5.0]]),
        callers=(
            Caller(name="vehicle", frequency=35e3, level_db=49.7),
            Caller(name="boat", frequency=25e3, level_db=40.0, place=boat),
        ),
        bodies=Bodies(radius=np.array([0.1, 0.3]), shape=np.array(["sphere", "cylinder"])),
    )
    OwnFiles(tmp_path / "w", WORLD).replace(world_files(drawn, Config()))
    again = heard(Config(scenario=ScenarioConfig(steps=8)), read_world(tmp_path / "w"))
    np.testing.assert_array_equal(again.bodies.radius, [0.1, 0.3])
    assert again.bodies.shape.tolist() == ["sphere", "cylinder"]
    np.testing.assert_array_equal(again.callers[1].place, boat)
    assert again.callers[1].level_db == 40.0


def test_a_worlds_missing_parts_are_drawn_as_without_it(tmp_path):
    config = Config(scenario=ScenarioConfig(steps=40, landmarks=8))
    drawn = world_of(config)
    world = read_world(folder_with(tmp_path, landmarks_csv=LANDMARKS))
    own = heard(config, world)
    assert own.path.tobytes() == drawn.path.tobytes()
    np.testing.assert_array_equal(own.callers[1].place, drawn.callers[1].place)
    assert own.landmarks.tolist() == [[2.5, 0.0], [-1.0, 4.0]]


def test_the_order_of_landmarks_in_the_file_does_not_matter(tmp_path):
    folder = folder_with(tmp_path, landmarks_csv="landmark,x,y\n2,-1,4\n1,2.5,0\n")
    assert read_world(folder).landmarks.tolist() == [[2.5, 0.0], [-1.0, 4.0]]


def test_bodies_go_with_the_numbers_of_their_landmarks(tmp_path):
    rows = "landmark,x,y,radius,shape\n2,0,2,0.2,sphere\n1,0,1,0.1,cylinder\n"
    bodies = read_world(folder_with(tmp_path, landmarks_csv=rows)).bodies
    assert bodies.radius.tolist() == [0.1, 0.2]
    assert bodies.shape.tolist() == ["cylinder", "sphere"]


def test_only_bodies_with_a_stated_radius_have_and_keep_a_size(tmp_path):
    rows = "landmark,x,y,radius,shape\n1,0,1,0.2,\n2,0,2,,sphere\n3,0,3,,\n"
    folder = folder_with(
        tmp_path, landmarks_csv=rows, world_toml="format = 1\n[config.target]\nradius = 0.07\n"
    )
    world = read_world(folder)
    np.testing.assert_array_equal(world.bodies.radius, [0.2, np.nan, np.nan])
    assert world.bodies.shape.tolist() == ["cylinder", "sphere", "cylinder"]
    drawn = world_of(Config(scenario=ScenarioConfig(steps=8)), 0, world)
    written = world_files(drawn, Config())["landmarks.csv"].splitlines()
    assert written[1:] == ["1,0.0,1.0,0.2,cylinder", "2,0.0,2.0,,sphere", "3,0.0,3.0,,cylinder"]


def test_the_beacon_is_drawn_clear_of_bodies_with_a_size(tmp_path):
    config, angles = Config(scenario=ScenarioConfig(steps=8)), np.arange(0.2, 6.1, 0.03)
    ring = config.scenario.beacon_distance * np.column_stack((np.cos(angles), np.sin(angles)))
    rows = [f"{i},{x},{y},0.3" for i, (x, y) in enumerate(ring.tolist(), 1)]
    text = "\n".join(["landmark,x,y,radius", *rows, ""])
    world = read_world(folder_with(tmp_path, landmarks_csv=text))
    points = replace(world, bodies=None)
    apart, before = (
        np.hypot(*(one.landmarks - one.callers[1].place).T).min()
        for one in (heard(config, world), heard(config, points))
    )
    assert before < 0.3
    assert apart >= config.scenario.clearance


def test_columns_determine_the_kind_of_a_path(tmp_path):
    def course(text):
        return read_world(folder_with(tmp_path, path_csv=text)).course

    assert isinstance(course("x,y\n0,0\n1,0\n"), np.ndarray)
    commands = course("time,speed,steering\n5,1,0.1\n6,0,0\n")
    assert isinstance(commands, Commands)
    assert commands.time.tolist() == [0.0, 1.0]
    poses = course("time,x,y,heading\n0,0,0,0\n1,1,0,0\n")
    assert isinstance(poses, Poses)
    assert poses.commands is None
    both = course("time,x,y,heading,speed,steering\n0,0,0,0,1,0\n1,1,0,0,0,0\n")
    assert both.commands.rows.tolist() == [[1.0, 0.0], [0.0, 0.0]]


def test_steps_follow_from_the_path_unless_given(tmp_path):
    world = read_world(folder_with(tmp_path, path_csv="x,y\n0,0\n7.5,0\n"))
    assert resolve(with_world(world, {})).scenario.steps == 80
    fast = from_flags({"scenario": {"speed": 1.5}})
    assert resolve(with_world(world, fast)).scenario.steps == 40
    given = from_flags({"scenario": {"steps": 10}})
    assert resolve(with_world(world, given)).scenario.steps == 10


def test_a_worlds_settings_are_beneath_all_others_and_over_a_plans_in_its_grid(tmp_path):
    folder = folder_with(tmp_path, world_toml="format = 1\n[config]\nair.temperature_c = 5.0\n")
    world, warm = read_world(folder), from_flags({"air": {"temperature_c": 30.0}})
    assert resolve(with_world(world, {})).air.temperature_c == 5.0
    assert resolve(with_world(world, warm)).air.temperature_c == 30.0
    assert resolve(laid_over(world, warm, {})).air.temperature_c == 5.0
    assert resolve(laid_over(world, {}, warm)).air.temperature_c == 30.0


def test_in_a_grid_the_drive_ends_with_the_worlds_path(tmp_path):
    world = read_world(folder_with(tmp_path, path_csv="time,speed,steering\n0,1,0\n2,0,0\n"))
    for asked, had in ((1500, 16), (8, 8)):
        layer = from_flags({"scenario": {"steps": asked}})
        assert resolve(laid_over(world, layer, {})).scenario.steps == had


def test_in_a_grid_the_plans_callers_call_in_a_world_that_lists_none(tmp_path):
    world = read_world(folder_with(tmp_path, landmarks_csv=LANDMARKS))
    layer = from_flags({"callers": [{"name": "boat", "place": [9.0, 9.0]}]})
    assert [*caller_names(resolve(laid_over(world, layer, {})).callers)] == ["boat"]


def test_callers_without_names_get_distinct_names(tmp_path):
    one = "[[callers]]\nfrequency = 30e3\nlevel_db = 40.0\nplace = [1.0, 2.0]\n"
    named = [
        [*caller_names(read_world(folder).callers)]
        for text in (one, one + one)
        for folder in [folder_with(tmp_path, world_toml="format = 1\n" + text)]
    ]
    assert named == [["beacon"], ["beacon", "caller2"]]


def test_a_worlds_callers_may_state_the_settings_keys(tmp_path):
    told = "[[callers]]\n[[callers]]\nfrequency = 25e3\ncourse = 'circle'\nradius = 6.0\n"
    config = Config(scenario=ScenarioConfig(steps=8, landmarks=5))
    world = heard(config, read_world(folder_with(tmp_path, world_toml="format = 1\n" + told)))
    _, beacon, circling = world.callers
    assert (beacon.frequency, beacon.level_db) == (30e3, 42.8)
    assert np.hypot(*beacon.place) == pytest.approx(15.0)
    np.testing.assert_allclose(np.hypot(*circling.place.T), 6.0)


def test_callers_in_the_settings_override_the_worlds_except_in_a_grid(tmp_path):
    told = "format = 1\n[[callers]]\nname = 'mate'\nplace = [1.0, 2.0]\n"
    world = read_world(folder_with(tmp_path, world_toml=told))
    layer = from_flags({"callers": [{"name": "boat", "place": [9.0, 9.0]}]})
    layer |= from_flags({"scenario": {"steps": 8, "landmarks": 5}})
    names = [
        heard(resolve(over), world).callers[1].name
        for over in (
            with_world(world, layer),
            laid_over(world, layer, {}),
            laid_over(world, {}, layer),
        )
    ]
    assert names == ["boat", "mate", "boat"]


def test_a_caller_of_any_name_is_written_without_harm_to_the_worlds_files(tmp_path):
    callers = [{"name": name, "course": "circle"} for name in ("path", "landmarks")]
    callers[1]["frequency"] = 25e3
    scenario = from_flags({"scenario": {"steps": 8, "landmarks": 5}, "callers": callers})
    config = resolve(scenario)
    drawn = world_of(config, 2)
    OwnFiles(tmp_path / "w", WORLD).replace(world_files(drawn, config))
    again = heard(Config(scenario=config.scenario), read_world(tmp_path / "w"))
    assert [caller.name for caller in again.callers] == ["vehicle", "path", "landmarks"]
    assert again.path.tobytes() == drawn.path.tobytes()
    for one, other in zip(again.callers[1:], drawn.callers[1:], strict=True):
        np.testing.assert_array_equal(one.place, other.place)


def test_a_world_may_have_no_callers_except_the_vehicle(tmp_path):
    world = read_world(folder_with(tmp_path, world_toml="format = 1\ncallers = []\n"))
    config = Config(scenario=ScenarioConfig(steps=8, landmarks=5))
    scenario = heard(config, world)
    assert [caller.name for caller in scenario.callers] == ["vehicle"]
    assert len(checked_scenario(config, world=world).callers) == 1


def test_a_landmark_table_with_only_a_header_has_no_landmarks(tmp_path):
    bare = world_of(Config(scenario=ScenarioConfig(steps=8, landmarks=0)), 0, ALL_DRAWN)
    OwnFiles(tmp_path / "bare", WORLD).replace(world_files(bare, Config()))
    assert len(read_world(tmp_path / "bare").landmarks) == 0


@pytest.mark.parametrize("name", ["landmark.csv", "Landmarks.csv", "paths.csv", "World.toml"])
def test_a_misspelt_file_is_refused(tmp_path, name):
    right = {"l": "landmarks.csv", "p": "path.csv", "w": "world.toml"}[name[0].lower()]
    kept = {"landmarks_csv": LANDMARKS, "path_csv": "x,y\n0,0\n9,0\n", "world_toml": "format = 1"}
    folder = folder_with(tmp_path, **kept)
    read_world(folder)
    (folder / right).rename(folder / name)
    with pytest.raises(InputError) as refused:
        read_world(folder)
    assert str(refused.value) == f"{folder}: found {name!r}, expected {right!r}; rename it"


def test_a_route_file_may_have_a_name_like_a_path(tmp_path):
    told = '[[callers]]\nname = "boat"\nfrequency = 30e3\nlevel_db = 40\nroute = "path2.csv"\n'
    files = {"world_toml": f"format = 1\n{told}", "path2_csv": "time,x,y\n0,1,2\n9,1,3\n"}
    assert read_world(folder_with(tmp_path, **files)).callers is not None


def test_a_broken_link_is_refused(tmp_path):
    folder = folder_with(tmp_path, path_csv="x,y\n0,0\n9,0\n")
    (folder / "landmarks.csv").symlink_to("gone")
    with pytest.raises(InputError, match=r"landmarks\.csv: found a link to no file"):
        read_world(folder)


WRONG = {
    "no header": ({"landmarks_csv": "1,2,3\n"}, "landmarks.csv, line 1: found '1,2,3'"),
    "a label too high": (
        {"landmarks_csv": "landmark,x,y\n1,0,0\n3,1,1\n"},
        "landmarks.csv, line 3: found landmark 3, expected the numbers 1 to 2",
    ),
    "clutter": (
        {"landmarks_csv": "landmark,x,y\n-1,0,0\n"},
        "landmarks.csv, line 2: found landmark -1",
    ),
    "a label twice": (
        {"landmarks_csv": "landmark,x,y\n1,0,0\n1,1,1\n"},
        "line 3: found landmark 1 again",
    ),
    "a place twice": (
        {"landmarks_csv": "landmark,x,y\n1,0,0\n2,0,0\n"},
        "line 3: found x 0.0, y 0.0 again",
    ),
    "no shape": (
        {"landmarks_csv": "landmark,x,y,shape\n1,0,0,cube\n"},
        "line 2: found shape 'cube', expected cylinder or sphere",
    ),
    "unknown columns": ({"path_csv": "a,b\n0,0\n"}, "path.csv, line 1: found 'a,b', expected"),
    "another model's": (
        {"path_csv": "time,velocity,angular_rate\n0,0,0\n"},
        "or set motion.model: it is 'bicycle'",
    ),
    "one way-point": ({"path_csv": "x,y\n0,0\n"}, "path.csv: found one way-point"),
    "the same way-point": (
        {"path_csv": "x,y\n0,0\n0,0\n"},
        "path.csv, line 3: found the way-point before it again",
    ),
    "one row": ({"path_csv": "time,speed,steering\n0,0,0\n"}, "path.csv: found one row"),
    "a time twice": (
        {"path_csv": "time,speed,steering\n0,0,0\n0,1,0\n"},
        "line 3: found time 0.0 again",
    ),
    "an empty file": ({"path_csv": ""}, "path.csv, line 1: found ''"),
    "no format": ({"world_toml": ""}, "world.toml: found no key 'format'"),
    "another format": ({"world_toml": "format = 2"}, "world.toml, key 'format': found 2"),
    "an unknown key": ({"world_toml": "format = 1\nname = 'a'"}, "found the unknown key 'name'"),
    "an unknown setting": (
        {"world_toml": "format = 1\n[config]\nair.temprature_c = 3.0"},
        "config.air.temprature_c: no such setting; did you mean config.air.temperature_c?",
    ),
    "a wrong setting": (
        {"world_toml": "format = 1\n[config]\nair.temperature_c = 99.0"},
        "config.air.temperature_c: found 99.0, expected less than 60",
    ),
    "a world of its own": (
        {"world_toml": "format = 1\n[config]\nscenario.world = 'b'"},
        "config.scenario.world: a world has no other world",
    ),
    "callers among the settings": (
        {"world_toml": "format = 1\n[config]\ncallers = []\n"},
        "world.toml: config.callers: a world's callers are [[callers]]; take out config.",
    ),
    "no list of callers": (
        {"world_toml": "format = 1\n[callers]\nfrequency = 3e4\n"},
        "world.toml: callers: found {'frequency': 30000.0}, expected a list of tables",
    ),
    "a caller everywhere": (
        {
            "world_toml": "format = 1\n[[callers]]\nfrequency = 3e4\nlevel_db = 40.0\n"
            "place = [0.0, 1.0]\nroute = [[0, 1, 2], [1, 1, 2]]"
        },
        "world.toml: callers.1: found place, which a route has not; leave one of them out",
    ),
    "a route elsewhere": (
        {
            "world_toml": "format = 1\n[[callers]]\nfrequency = 3e4\nlevel_db = 40.0\n"
            "route = '../a.csv'"
        },
        "world.toml: callers.1.route: found '../a.csv'",
    ),
    "no route": (
        {
            "world_toml": "format = 1\n[[callers]]\nfrequency = 3e4\nlevel_db = 40.0\n"
            "route = 'a.csv'"
        },
        "a.csv: found no such file",
    ),
    "text for a number": (
        {
            "world_toml": "format = 1\n[[callers]]\nfrequency = '3e4'\nlevel_db = 40.0\n"
            "place = [0.0, 1.0]"
        },
        "world.toml: callers.1.frequency: found '3e4', expected a valid number",
    ),
    "the vehicle's name": (
        {
            "world_toml": "format = 1\n[[callers]]\nname = 'vehicle'\nfrequency = 3e4\n"
            "level_db = 40.0\nplace = [0.0, 1.0]"
        },
        "world.toml: callers: found the name 'vehicle' again",
    ),
    "no TOML": ({"world_toml": "format = "}, "world.toml: found"),
}


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_refused_with_their_location(tmp_path, case):
    files, said = WRONG[case]
    with pytest.raises(InputError) as refused:
        read_world(folder_with(tmp_path, **files))
    assert said in str(refused.value)
    assert "own [1]" in str(refused.value)


def test_a_folder_without_a_world_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for name, found in (("nowhere", "no such folder"), ("file", "a file"), ("", "none of its")):
        with pytest.raises(InputError, match=found):
            read_world(tmp_path / name)


def test_settings_that_contradict_the_world_are_refused(tmp_path):
    world = read_world(folder_with(tmp_path, landmarks_csv=LANDMARKS))
    more = from_flags({"scenario": {"landmarks": 7}})
    for settle in (lambda: with_world(world, more), lambda: laid_over(world, {}, more)):
        with pytest.raises(InputError, match=r"--scenario\.landmarks: found 7, but .* has 2"):
            settle()
    assert resolve(with_world(world, from_flags({"scenario": {"landmarks": 2}})))
    assert World(name="any").settings == {}
