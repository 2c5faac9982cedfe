import time

import numpy as np
import pytest
from scipy.stats import kstest

from pipistrelle.config import Config, InputError, MotionConfig, ScenarioConfig
from pipistrelle.experiments.hearing.scenario import Scenario, draw_scenario, standing_landmarks
from pipistrelle.experiments.hearing.trajectories import true_motion

SEEDS = range(12)


def world(seed, **settings):
    return draw_scenario(Config(scenario=ScenarioConfig(**settings)), np.random.default_rng(seed))


def beacon_of(drawn):
    """Return where the second of the paper's two callers stands."""
    _, beacon = drawn.callers
    return beacon.place


def test_landmarks_and_fixed_callers_are_to_be_mapped():
    config = Config(scenario=ScenarioConfig(landmarks=9, steps=20))
    drawn = draw_scenario(config, np.random.default_rng(3))
    labels, _ = standing_landmarks(drawn)
    assert labels.tolist() == [*range(1, 11)]


def nearest(points, others):
    """Return how near any of some points comes to any of others."""
    offset = points[:, None] - others[None]
    return np.hypot(offset[..., 0], offset[..., 1]).min()


@pytest.mark.parametrize("seed", SEEDS)
def test_landmarks_and_beacon_keep_their_distances(seed):
    drawn = world(seed)
    assert drawn.landmarks.shape == (50, 2)
    assert np.hypot(*drawn.landmarks.T).max() <= 25.0
    apart = np.hypot(*(drawn.landmarks[:, None] - drawn.landmarks).transpose(2, 0, 1))
    assert apart[np.triu_indices(50, 1)].min() >= 3.0
    assert nearest(drawn.path[:, :2], drawn.landmarks) >= 0.5
    assert nearest(drawn.path[:, :2], beacon_of(drawn)[None]) >= 0.5
    assert nearest(beacon_of(drawn)[None], drawn.landmarks) >= 0.5
    assert np.hypot(*beacon_of(drawn)) == pytest.approx(15.0, abs=1e-12)


def test_the_noise_free_path_circles_the_maps_centre_three_times():
    still = Config(motion=MotionConfig(speed_std=0.0, steering_std=0.0))
    path = draw_scenario(still, np.random.default_rng(7)).path
    columns = np.column_stack((path[:, :2], np.ones(len(path))))
    x, y, rest = np.linalg.lstsq(columns, np.sum(path[:, :2] ** 2, axis=1))[0]
    centre = np.array([x, y]) / 2.0
    assert np.hypot(*(path[:, :2] - centre).T) == pytest.approx(7.408, abs=1e-3)
    assert np.sqrt(rest + centre @ centre) == pytest.approx(7.408, abs=1e-3)
    # The wheel leads the heading by the steering angle: 0.027 x 7.408 m less half a step's turn.
    assert np.hypot(*centre) == pytest.approx(7.408 * 0.027 - 0.75 * 0.125 / 2.0, abs=1e-2)
    turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    assert (turned[-1] - turned[0]) / (2.0 * np.pi) == pytest.approx(3.02, abs=0.01)


@pytest.mark.parametrize("wheelbase", [0.2, 0.5])
def test_a_longer_wheelbase_turns_the_vehicle_less_and_its_filters_know(wheelbase):
    motion = MotionConfig(wheelbase=wheelbase, speed_std=0.0, steering_std=0.0)
    config = Config(motion=motion, scenario=ScenarioConfig(steps=80, landmarks=0))
    path = draw_scenario(config, np.random.default_rng(7)).path
    turned = 0.75 * 0.125 * np.sin(0.027) / wheelbase
    np.testing.assert_allclose(np.diff(path[:, 2]), turned, rtol=1e-9)
    assert true_motion(motion).wheelbase == wheelbase


def test_controls_are_nominal_and_the_path_is_not():
    drawn = world(7)
    assert np.all(drawn.controls == [0.75, 0.027])
    assert drawn.time.tolist() == (0.125 * np.arange(1501)).tolist()
    assert drawn.path[0].tolist() == [0.0, -7.408, 0.0]
    step = np.hypot(*np.diff(drawn.path[:, :2], axis=0).T) / 0.125  # |speed|: its noise is small
    turn = np.diff(np.unwrap(drawn.path[:, 2])) / 0.125
    steering = np.arcsin(0.2 * turn / step)
    sampling = 4.9 / np.sqrt(2 * 1500)
    assert step.mean() == pytest.approx(0.75, abs=4.9 * 0.1 / np.sqrt(1500))
    assert step.std() == pytest.approx(0.1, rel=sampling)
    assert steering.mean() == pytest.approx(0.027, abs=4.9 * 0.03 / np.sqrt(1500))
    assert steering.std() == pytest.approx(0.03, rel=sampling)


def test_the_same_seed_draws_the_same_world_and_another_another():
    one, two, other = world(7), world(7), world(8)
    for name in set(Scenario.__slots__) - {"callers", "bodies"}:
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
    assert beacon_of(one).tobytes() == beacon_of(two).tobytes()
    assert one.landmarks.tobytes() != other.landmarks.tobytes()
    assert beacon_of(one).tobytes() != beacon_of(other).tobytes()


def test_more_landmarks_change_neither_path_nor_beacon():
    few, many = world(7, landmarks=5), world(7, landmarks=50)
    assert few.path.tobytes() == many.path.tobytes()
    assert beacon_of(few).tobytes() == beacon_of(many).tobytes()
    assert few.landmarks.tobytes() == many.landmarks[:5].tobytes()


def test_landmarks_fill_the_disc_evenly_and_the_beacon_its_circle():
    # Without distances to keep, each landmark is uniform over the disc.
    free = {"landmarks": 40, "spacing": 0.0, "clearance": 0.0, "steps": 1}
    worlds = [world(seed, **free) for seed in range(100)]
    x, y = np.concatenate([w.landmarks for w in worlds]).T
    assert kstest((np.hypot(x, y) / 25.0) ** 2, "uniform").pvalue > 1e-6
    assert kstest(np.arctan2(y, x) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-6
    assert kstest(np.hypot(x, y) / 25.0, "uniform").pvalue < 1e-6  # as a sloppy draw would be
    beacon = np.array([beacon_of(w) for w in worlds])
    assert kstest(np.arctan2(*beacon.T) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-6


def test_spacing_only_evens_out_the_landmarks():
    # In rings of equal area the counts of 100 worlds vary less than independent draws would.
    worlds = [world(seed, steps=4) for seed in range(100)]
    ring = [np.histogram(np.hypot(*w.landmarks.T), 25.0 * np.sqrt(np.linspace(0, 1, 6)))[0]
            for w in worlds]  # fmt: skip
    share = np.mean(ring, axis=0) / 50.0
    assert np.all(np.abs(share[:-1] - 0.2) < 0.02)
    assert 0.2 < share[-1] < 0.25  # the rim has neighbours on one side alone


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"landmarks": 400}, "scenario.landmarks"),  # more than discs of 3 m can fill
        ({"landmarks": 200}, "scenario.landmarks"),  # jammed: less than that, but not by chance
        ({"landmarks": 2, "spacing": 60.0}, "scenario.landmarks"),
        ({"landmarks": 10**12}, "scenario.landmarks"),
        ({"landmarks": 1, "radius": 5.0, "clearance": 30.0, "beacon_distance": 90.0},
         "scenario.landmarks"),  # no place clear of the path
        ({"beacon_distance": 7.4, "clearance": 30.0}, "scenario.beacon_distance"),
    ],
)  # fmt: skip
def test_an_impossible_world_ends_in_a_clear_error_soon(settings, key):
    began = time.process_time()
    with pytest.raises(InputError, match=f"^{key}: found .*expected") as error:
        world(7, **settings)
    assert time.process_time() - began < 5.0
    assert str(settings.get("landmarks", "m")) in str(error.value)


def test_worlds_with_few_and_many_landmarks_are_drawn():
    assert world(7, landmarks=130).landmarks.shape == (130, 2)
    assert world(7, landmarks=0).landmarks.shape == (0, 2)
    assert world(7, landmarks=1, radius=1.0, spacing=60.0).landmarks.shape == (1, 2)
