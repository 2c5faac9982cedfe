"""Others who call: where they are, and that one more changes nothing else."""

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import arrivals_of_emissions, through_piston, through_pistons
from pipistrelle.acoustics.emitter import piston_directivity
from pipistrelle.acoustics.paths import callers_at, moves
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import (
    CallerConfig,
    Config,
    InputError,
    ListeningConfig,
    MotionConfig,
    ScenarioConfig,
)
from pipistrelle.experiments.hearing import caller_paths
from pipistrelle.experiments.hearing.caller_paths import WALK_MEMORY, WALK_STD, with_routes
from pipistrelle.experiments.hearing.landmark_fields import MAX_DRAWS, landmarks_in, nearest
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.scenario import (
    caller_labels,
    moving_callers,
    standing_landmarks,
    world_of,
)
from pipistrelle.experiments.hearing.trajectories import course_of, driven, true_motion
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.geometry import wrap
from pipistrelle.settings import from_flags, resolve

SEEDS = range(6)
MATE = {"frequency": 25e3}
BEACON, LAST = (-14.111586629921728, -5.085579886916962), (-0.7128813181024322, -2.8077788365621412)
"""Of the paper's third world, as it was drawn before there were lists: beacon, last landmark."""


def config_of(*callers, **scenario):
    """Return settings of callers, in a small world."""
    setup = {"steps": 160, "landmarks": 20} | scenario
    return resolve(from_flags({"callers": [*callers], "scenario": setup}))


def paper(**scenario):
    return Config(scenario=ScenarioConfig(**({"steps": 160, "landmarks": 20} | scenario)))


def world_as_ever(config, iteration):
    """Draw the paper's world by itself: path, then beacon, then landmarks."""
    setup, motion = config.scenario, true_motion(config.motion)
    rng = np.random.default_rng(stream_key(config.seed, iteration, "scenario"))
    path, _ = driven(course_of(setup, motion), setup, motion, rng)
    for _ in range(MAX_DRAWS):
        direction = rng.uniform(-np.pi, np.pi)
        beacon = setup.beacon_distance * np.array([np.cos(direction), np.sin(direction)])
        if nearest(path[:, :2], beacon) >= setup.clearance:
            break
    return path, beacon, landmarks_in(setup, path[:, :2], beacon[None], rng)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("distance", [15.0, 7.4])
def test_the_papers_beacon_is_the_list_of_one_to_the_bit(seed, distance):
    config = paper(beacon_distance=distance)
    ever = world_as_ever(config, seed)
    listed = config_of({}, beacon_distance=distance)
    for drawn in (world_of(config, seed), world_of(listed, seed)):
        found = (drawn.path, drawn.callers[1].place, drawn.landmarks)
        assert [part.tobytes() for part in found] == [part.tobytes() for part in ever]
        told = [(c.name, c.frequency, c.level_db) for c in drawn.callers]
        assert told == [("vehicle", 35e3, 49.7), ("beacon", 30e3, 42.8)]


def test_the_papers_world_is_unchanged():
    drawn = world_of(Config(), 3)
    assert drawn.callers[1].place.tolist() == pytest.approx(BEACON, abs=1e-9)
    assert drawn.landmarks[-1].tolist() == pytest.approx(LAST, abs=1e-9)


MORE = {
    "a place": {"place": [3.0, 4.0]},
    "a distance": {"distance": 6.0},
    "a circle": {"course": "circle", "radius": 4.0},
    "a walk": {"course": "walk"},
    "a line": {"waypoints": [[9.0, 9.0], [-9.0, 9.0]]},
    "a route": {"route": [[0.0, 9.0, 9.0], [5.0, 1.0, 9.0]]},
}


@pytest.mark.parametrize("way", MORE)
@pytest.mark.parametrize("seed", SEEDS)
def test_another_caller_changes_no_path_landmark_or_earlier_caller(seed, way):
    one = world_of(config_of({}), seed)
    two = world_of(config_of({}, MATE), seed)
    three = world_of(config_of({}, MATE, {"frequency": 20e3} | MORE[way]), seed)
    for drawn in (two, three):
        assert drawn.path.tobytes() == one.path.tobytes()
        assert drawn.landmarks.tobytes() == one.landmarks.tobytes()
        assert drawn.callers[1].place.tobytes() == one.callers[1].place.tobytes()
    assert three.callers[2].place.tobytes() == two.callers[2].place.tobytes()


@pytest.mark.parametrize("way", MORE)
def test_path_and_landmarks_do_not_depend_on_where_the_first_caller_is(way):
    ever, drawn = world_of(paper(), 2), world_of(config_of(MORE[way]), 2)
    assert drawn.path.tobytes() == ever.path.tobytes()
    assert drawn.landmarks.tobytes() == ever.landmarks.tobytes()
    assert drawn.callers[1].place.tobytes() != ever.callers[1].place.tobytes()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_caller_at_another_distance_has_the_beacons_direction(seed):
    near, ever = (
        world_of(c, seed).callers[1].place for c in (config_of({"distance": 5.0}), paper())
    )
    assert np.hypot(*near) == pytest.approx(5.0)
    np.testing.assert_allclose(near * 3.0, ever)


@pytest.mark.parametrize("seed", SEEDS)
def test_drawn_callers_keep_clear_of_landmarks_callers_and_path(seed):
    tones = ({"frequency": 5e3 * k, "distance": 8.0} for k in range(1, 6))
    drawn = world_of(config_of({"distance": 8.0}, *tones, clearance=1.5), seed)
    places = np.array([caller.place for caller in drawn.callers[1:]])
    np.testing.assert_allclose(np.hypot(*places.T), 8.0)
    assert min(nearest(drawn.path[:, :2], place) for place in places) >= 1.5
    assert min(nearest(drawn.landmarks, place) for place in places) >= 1.5
    assert min(nearest(places[:i], place) for i, place in enumerate(places)) >= 1.5


def test_a_moving_caller_is_no_landmark_and_is_labelled_by_list_position():
    drawn = world_of(
        config_of({}, MATE | {"course": "circle"}, {"frequency": 2e4, "place": [1, 2]})
    )
    assert caller_labels(drawn).tolist() == [-1, 21, 22, 23]
    assert [*moving_callers(drawn)] == [22]
    labels, places = standing_landmarks(drawn)
    assert labels[-2:].tolist() == [21, 23]
    assert places[-1].tolist() == [1.0, 2.0]


def test_a_circle_is_gone_round_at_its_speed_and_the_other_way_round_below_zero():
    for speed in (0.75, -1.5):
        told = {"course": "circle", "radius": 6.0, "speed": speed, "centre": [2.0, -1.0]}
        place = world_of(config_of(told)).callers[1].place - [2.0, -1.0]
        np.testing.assert_allclose(np.hypot(*place.T), 6.0)
        turned = np.diff(np.unwrap(np.arctan2(place[:, 1], place[:, 0])))
        np.testing.assert_allclose(turned, speed / 6.0 * 0.125, rtol=1e-9)


def test_a_circle_takes_unset_values_from_the_scenario():
    place = (
        world_of(config_of({"course": "circle"}, beacon_distance=9.0, speed=0.5)).callers[1].place
    )
    np.testing.assert_allclose(np.hypot(*place.T), 9.0)
    chord = 2.0 * 9.0 * np.sin(0.5 * 0.125 / 9.0 / 2.0)
    np.testing.assert_allclose(np.hypot(*np.diff(place, axis=0).T), chord)


def test_a_line_is_gone_along_and_back_to_where_it_began():
    told = {"waypoints": [[0.0, 12.0], [3.0, 12.0], [3.0, 16.0]], "speed": 1.0}
    place = world_of(config_of(told)).callers[1].place
    at = dict(zip((0.125 * np.arange(161)).tolist(), place.tolist(), strict=True))
    assert at[0.0] == [0.0, 12.0]
    assert at[3.0] == [3.0, 12.0]
    assert at[5.0] == [3.0, 14.0]
    np.testing.assert_allclose([at[9.5], at[12.0]], [[1.5, 14.0], [0.0, 12.0]], atol=1e-12)
    still = world_of(config_of(told | {"speed": -1.0})).callers[1].place
    np.testing.assert_allclose(still[:96], place[96:0:-1], atol=1e-12)


def test_a_caller_rests_before_and_after_its_route():
    told = {"route": [[1.0, 0.0, 9.0], [2.0, 2.0, 13.0]]}
    place = world_of(config_of(told)).callers[1].place
    assert place[[0, 12, 160]].tolist() == [[0.0, 9.0], [1.0, 11.0], [2.0, 13.0]]


def test_a_walk_has_its_stated_spread_and_memory_on_the_disc():
    std, memory, dt = 0.4, 2.0, 0.125
    told = {"course": "walk", "speed_std": std, "memory": memory, "place": [0.0, 0.0]}
    config = config_of(told, steps=40_000, radius=1e4, landmarks=0, start=(9e3, 0.0, 0.0))
    velocity = np.diff(world_of(config).callers[1].place, axis=0).T / dt
    independent = velocity.size * dt / (2.0 * memory)
    assert velocity.std() == pytest.approx(std, rel=5.0 / np.sqrt(2.0 * independent))
    for lag in (1, 8, 24):
        kept = np.mean(velocity[:, lag:] * velocity[:, :-lag]) / np.mean(velocity**2)
        assert kept == pytest.approx(np.exp(-lag * dt / memory), abs=5.0 / np.sqrt(independent))
    for seed in SEEDS:
        place = world_of(config_of(told | {"speed_std": 3.0}, radius=14.0), seed).callers[1].place
        assert np.hypot(*place.T).max() <= 14.0
    assert (WALK_STD, WALK_MEMORY) == (0.5, 10.0)  # as docs and settings say


def test_a_walk_from_beyond_the_disc_goes_no_further_away_and_jumps_nowhere():
    far = {"course": "walk", "place": [40.0, 0.0]}
    for seed in SEEDS:
        place = world_of(config_of(far, radius=14.0), seed).callers[1].place
        assert place[0].tolist() == [40.0, 0.0]
        assert np.hypot(*place.T).max() <= 40.0
        assert np.hypot(*np.diff(place, axis=0).T).max() < 8.0 * WALK_STD * 0.125


def test_the_first_caller_keeps_clear_of_landmarks_unless_it_is_the_papers_beacon():
    """The beacon was drawn before the landmarks: it is they that keep clear."""
    angle = np.linspace(0.0, np.pi, 100)
    half = caller_paths.Surroundings(
        config=Config(),
        time=np.arange(3.0),
        path=np.zeros((3, 2)),
        landmarks=15.0 * np.column_stack((np.cos(angle), np.sin(angle))),
    )
    for told, clear in ((CallerConfig(distance=15.0), True), (CallerConfig(), False)):
        beside = [
            caller_paths.callers_among(half, [told], np.random.default_rng(1), first)[0].place[1]
            < 0.0
            for first in map(np.random.default_rng, range(20))
        ]
        assert all(beside) == clear


@pytest.mark.parametrize("seed", SEEDS)
def test_drawn_moving_callers_keep_clear_of_the_vehicle(seed):
    for told in ({"course": "circle", "radius": 7.4}, {"course": "walk", "distance": 7.4}):
        drawn = world_of(config_of(told, clearance=2.0), seed)
        assert np.hypot(*(drawn.callers[1].place - drawn.path[:, :2]).T).min() >= 2.0


def test_velocities_are_of_the_steps_that_end_at_the_call():
    drawn = world_of(config_of({"course": "circle", "radius": 5.0}))
    _, boat = callers_at(drawn.callers, drawn.time, np.array([4, 8]))
    place = drawn.callers[1].place
    np.testing.assert_allclose(boat.velocity, (place[[4, 8]] - place[[3, 7]]) / 0.125)
    assert moves(boat)


REFUSED = {
    "no tone": (({}, {}), "callers.2.frequency: found none, expected a tone of its own"),
    "no room": (
        ({"distance": 7.4},),
        "callers.1.distance: found 7.4 m, but no direction there is 5 m clear of path",
    ),
    "always beside the vehicle": (
        ({"course": "circle", "radius": 1e-3, "centre": [0.0, -7.408]},),
        "callers.1: found a circle on which it comes nearer than 5 m to the vehicle",
    ),
    "faster than sound": (
        ({"course": "circle", "speed": -343.0},),
        "callers.1.speed: found -343 m/s, expected less than 343 m/s",
    ),
    "meets a caller that stands": (
        ({"place": [9.0, 9.0]}, MATE | {"route": [[0.0, 5.0, 5.0], [4.0, 9.0, 9.0]]}),
        "callers.2.route: at 4 s caller2 is where beacon is, x 9 m, y 9 m; expected callers apart",
    ),
    "walks faster than sound": (
        ({}, MATE | {"course": "walk", "speed_std": 70.0}),
        "callers.2.speed_std: found 70 m/s, expected less than 68.6 m/s",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_caller_that_cannot_be_is_refused_by_its_key(case):
    callers, said = REFUSED[case]
    with pytest.raises(InputError) as refused:
        world_of(config_of(*callers, clearance=5.0, landmarks=0, steps=600))
    assert str(refused.value).startswith(said)


def test_a_route_file_with_mistakes_is_refused_by_line(tmp_path):
    path = tmp_path / "boat.csv"
    path.write_text("time,x,y\n0,1,2\n5,3,4\n")
    told = CallerConfig(route=str(path))
    drawn = world_of(Config(callers=(told,), scenario=ScenarioConfig(steps=40, landmarks=3)))
    assert drawn.callers[1].place[-1].tolist() == [3.0, 4.0]
    for text, said in (
        ("time,x,y\n0,1,2\n0,3,4\n", "line 3: found time 0.0 again"),
        ("time,x,y\n0,nan,1\n", "line 2: found x 'nan'"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=r"boat\.csv") as refused:
            with_routes(from_flags({"callers": [{"route": str(path)}]}))
        assert said in str(refused.value)
    path.write_text("time,x,y\n0,1,2\n")
    with pytest.raises(InputError, match=r"route: found .*two such rows"):
        resolve(with_routes(from_flags({"callers": [{"route": str(path)}]})))


@pytest.mark.parametrize("name", ["a\0b", 5000 * "x"])
def test_a_route_of_a_name_that_no_file_can_have_is_refused(name):
    with pytest.raises(InputError, match=r"callers\.1\.route: '.*expected a readable text file"):
        with_routes(from_flags({"callers": [{"route": name}]}))


# Missions of others

ANOTHER = CallerConfig(name="mate", course="mission")
PAIR = Config(
    callers=(ANOTHER,), scenario=ScenarioConfig(steps=200, landmarks=20, radius=15.0, clearance=0.6)
)


def seen_by(vehicle, config=PAIR):
    setup = config.scenario.model_copy(update={"vehicle": vehicle})
    return world_of(config.model_copy(update={"scenario": setup}))


def heard_at(world, radius, k=4):
    """What arrives after the first call, all pistons of one radius."""
    callers = callers_at(world.callers, world.time, np.array([k]))
    speed = (world.path[k] - world.path[k - 1])[None, :2] / PAIR.scenario.step
    poses = world.path[k][None]
    heard, _ = arrivals_of_emissions(poses, speed, world.landmarks, callers, PAIR)
    c = PAIR.air.sound_speed
    return through_pistons(heard, callers, through_piston, radius=radius, speed_of_sound=c)


def test_a_mission_is_driven_as_the_vehicle_drives_clear_of_all():
    world = seen_by(1)
    alone = world_of(PAIR.model_copy(update={"callers": None}))
    assert world.path.tobytes() == alone.path.tobytes(), "who else drives changes nothing"
    assert world.landmarks.tobytes() == alone.landmarks.tobytes()
    mate = world.callers[1]
    path, controls = mate.mission
    np.testing.assert_array_equal(mate.place, path[:, :2])
    np.testing.assert_array_equal(controls, world.controls)
    start = np.hypot(*path[0, :2]), np.hypot(*world.path[0, :2])
    assert start[0] == pytest.approx(start[1]), "the same course, turned about the centre"
    assert np.hypot(*(path - world.path)[:, :2].T).min() > 0.6
    gaps = np.hypot(*(path[:, None, :2] - world.landmarks).transpose(2, 0, 1))
    assert gaps.min() > 0.6
    speed = np.hypot(*np.diff(path[:, :2], axis=0).T) / PAIR.scenario.step
    assert speed.mean() == pytest.approx(0.75, rel=0.05)
    assert speed.std() == pytest.approx(PAIR.motion.speed_std, rel=0.3), "with noise of its own"


def test_two_vehicles_are_in_one_world_each_the_others_caller():
    first, second = seen_by(1), seen_by(2)
    assert first.landmarks.tobytes() == second.landmarks.tobytes()
    np.testing.assert_array_equal(second.path, first.callers[1].mission[0])
    np.testing.assert_array_equal(second.callers[1].place, first.path[:, :2])
    np.testing.assert_array_equal(second.callers[1].mission[0], first.path)
    for view, turn in ((first, 1), (second, -1)):  # whose call it is, whoever hears it
        assert [c.frequency for c in view.callers] == [35e3, 30e3][::turn]
        assert [c.level_db for c in view.callers] == [PAIR.emitter.level_db] * 2
    drive = drive_of(second, PAIR)
    np.testing.assert_array_equal(drive.truth.path, second.path)
    np.testing.assert_array_equal(drive.truth.callers[21], first.path[:, :2])


@pytest.mark.parametrize("hearing", [1, 2])
def test_a_vehicles_call_is_the_same_to_itself_and_to_the_other(hearing):
    """What left towards a landmark, by its echo at home and by that which the other hears."""
    seen = {vehicle: seen_by(vehicle) for vehicle in (1, 2)}
    sent = {v: heard_at(world, radius=0.0088) for v, world in seen.items()}
    plain = {v: heard_at(world, radius=1e-6) for v, world in seen.items()}
    home = 3 - hearing
    lost = {}  # to the beam, by who hears it and the landmark
    for v, caller in ((home, 0), (hearing, 1)):
        own = (sent[v].caller == caller) & (sent[v].landmark <= 20)
        gone = sent[v].level_db[own] - plain[v].level_db[own]
        lost[v] = dict(zip(sent[v].landmark[own].tolist(), gone.tolist(), strict=True))
    assert lost[hearing].keys() == lost[home].keys(), "nothing leaves behind the baffle"
    assert 3 < len(lost[home]) < 17
    for landmark, level in lost[home].items():
        assert lost[hearing][landmark] == pytest.approx(level, abs=1e-9)
    assert min(lost[home].values()) < -10.0 < max(lost[home].values())


def test_of_a_vehicle_that_points_away_no_echo_is_taken_for_its_direct_call():
    config = PAIR.model_copy(update={"listening": ListeningConfig(excess_paths=True)})
    frames, excess_paths = {True: 0, False: 0}, {True: 0, False: 0}
    for number in range(3):
        world = world_of(config, number)
        (heard,) = listen(world, config, (0.0088,), iteration=number)
        mate = world.callers[1]
        for k, scan in enumerate(scans_of(heard, "passive", config), start=1):
            k *= PAIR.scenario.steps_per_frame
            x, y = world.path[k, :2] - mate.place[k]
            away = bool(abs(wrap(np.arctan2(y, x) - mate.heading[k])) > np.pi / 2)
            frames[away] += 1
            excess_paths[away] += int(np.isfinite(scan.excess_path).sum())
    assert min(frames.values()) > 20
    assert excess_paths[True] == 0
    assert excess_paths[False] > 100


def test_a_direct_call_comes_through_the_piston_that_sends_it():
    world = seen_by(1)
    heard, plain = heard_at(world, radius=0.0088), heard_at(world, radius=1e-6)
    mate, k = world.callers[1], 4
    x, y = world.path[k, :2] - mate.place[k]
    off = wrap(np.arctan2(y, x) - mate.heading[k])
    direct = heard.landmark == 21
    assert direct[heard.caller == 1].any() == (abs(off) < np.pi / 2)
    assert np.any(heard.caller == 1)
    gain = 20 * np.log10(
        piston_directivity(off, frequency=30e3, radius=0.0088, speed_of_sound=PAIR.air.sound_speed)
    )
    gained = (heard.level_db - plain.level_db)[direct & (heard.caller == 1)]
    np.testing.assert_allclose(gained, gain, atol=1e-6)


def test_a_route_with_headings_is_a_vehicle_and_half_of_them_are_refused(tmp_path):
    rows = [(0.0, 20.0, 0.0, 3.0), (10.0, 20.0, 1.0, -3.0)]
    whole, half = tmp_path / "whole.csv", tmp_path / "half.csv"
    head = "time,x,y,heading\n"
    whole.write_text(head + "".join(f"{t},{x},{y},{h}\n" for t, x, y, h in rows))
    half.write_text(head + "0,20,0,3\n10,20,1,\n")
    world = world_of(resolve(with_routes(from_flags({"callers": [{"route": str(whole)}]}))))
    heading = world.callers[1].heading
    assert heading[[0, -1]].tolist() == [3.0, -3.0]
    assert np.abs(heading).min() == 3.0, "turned the short way, through half a turn"
    with pytest.raises(InputError, match=r"half\.csv, line 3: found no heading"):
        with_routes(from_flags({"callers": [{"route": str(half)}]}))
    mixed = [{"route": [(0, 1, 2), (1, 2, 3, 0.5)]}]
    with pytest.raises(InputError, match="headings in some rows"):
        resolve(from_flags({"callers": mixed}))


def test_each_of_two_vehicles_has_independent_noise():
    levels = []
    for vehicle in (1, 2):
        setup = PAIR.scenario.model_copy(update={"vehicle": vehicle, "steps": 40})
        config = PAIR.model_copy(update={"scenario": setup})
        (heard,) = listen(world_of(PAIR.model_copy(update={"scenario": PAIR.scenario})), config,
                          (0.0025,))  # fmt: skip
        levels.append(np.concatenate([one.rows.level_db for one in heard]))
    assert not np.array_equal(*levels)


def test_a_vehicle_that_has_no_mission_is_refused_by_its_number():
    with pytest.raises(InputError, match=r"scenario\.vehicle: found 3, but 2 in this world"):
        seen_by(3)
    with pytest.raises(InputError, match=r"scenario\.vehicle: found 2, but 1 in this world"):
        seen_by(2, PAIR.model_copy(update={"callers": None}))


def test_a_mission_that_finds_no_way_is_refused_with_its_key(monkeypatch):
    monkeypatch.setattr(caller_paths, "MAX_DRAWS", 3)
    wild = PAIR.model_copy(update={"motion": MotionConfig(speed_std=1.0)})
    crowd = ScenarioConfig(steps=1500, landmarks=60, radius=12.0, clearance=0.6, spacing=0.7)
    wild = wild.model_copy(update={"scenario": crowd})
    with pytest.raises(InputError, match=r"callers\.1: found no mission 0\.6 m clear"):
        world_of(wild)
