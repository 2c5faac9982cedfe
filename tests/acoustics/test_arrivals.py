import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.special import jn_zeros

from pipistrelle.acoustics.arrivals import (
    Arrivals,
    arrivals_at,
    arrivals_of_emission,
    arrivals_of_emissions,
    through_piston,
)
from pipistrelle.acoustics.emitter import Bodies, piston_directivity
from pipistrelle.acoustics.paths import VEHICLE, callers_of
from pipistrelle.config import (
    AirConfig,
    BeaconConfig,
    Config,
    EmitterConfig,
    InputError,
    TargetConfig,
)
from pipistrelle.geometry import range_and_bearing, wrap

law = settings(deadline=None, max_examples=60)
STILL = np.zeros(2)
ORIGIN = np.zeros(3)
SEEDS = st.integers(0, 2**32 - 1)
LAWS = st.sampled_from(["paper", "bistatic"])
BEACON = 1
PISTON = {"radius": 0.0088, "frequency": 35e3, "speed_of_sound": 343.0}


def as_by_hand(spreading):
    """Every setting that the numbers below stand on, whatever the defaults are."""
    return Config(
        air=AirConfig(
            speed_of_sound=343.0,
            temperature_c=20.0,
            relative_humidity=0.5,
            pressure_kpa=101.325,
            spreading=spreading,
        ),
        target=TargetConfig(shape="cylinder", radius=0.025),
        emitter=EmitterConfig(frequency=35e3, level_db=53.0),
        beacon=BeaconConfig(frequency=30e3, level_db=50.0),
    )


COLUMNS = [name for name in Arrivals.__slots__ if name != "departure"]
CONFIG = as_by_hand("paper")


def sounds_of_emission(pose, velocity, landmarks, beacon, config):
    """Return what one emission of the paper's two callers brings."""
    return arrivals_of_emission(pose, velocity, landmarks, callers_of(config, beacon), config)


def sounds_of_emissions(poses, velocities, landmarks, beacon, config):
    """Return what several emissions of the paper's two callers bring."""
    return arrivals_of_emissions(poses, velocities, landmarks, callers_of(config, beacon), config)


def world(seed):
    """Pose, velocity, landmarks and beacon of some world; no two points coincide."""
    rng = np.random.default_rng(seed)
    pose = np.array([*rng.uniform(-9.0, 9.0, 2), rng.uniform(-np.pi, np.pi)])
    landmarks = rng.uniform(-25.0, 25.0, (rng.integers(0, 12), 2))
    return pose, rng.uniform(-1.0, 1.0, 2), landmarks, rng.uniform(-15.0, 15.0, 2)


def rows(arrivals, chosen):
    return {name: getattr(arrivals, name)[chosen] for name in COLUMNS}


@given(seed=SEEDS)
@law
@pytest.mark.shapes
def test_active_echoes_come_first_then_passive_ones_then_the_beacons_call(seed):
    pose, velocity, landmarks, beacon = world(seed)
    heard = sounds_of_emission(pose, velocity, landmarks, beacon, CONFIG)
    n, active = len(landmarks), int(np.sum(heard.caller == VEHICLE))
    assert heard.caller.tolist() == [VEHICLE] * active + [BEACON] * (n + 1)
    assert np.all(np.diff(heard.landmark[:active]) > 0)
    assert heard.landmark[active:].tolist() == list(range(1, n + 2))
    assert heard.caller.dtype == np.int8
    assert all(np.isfinite(column).all() for column in rows(heard, slice(None)).values())


@given(seed=SEEDS)
@law
def test_delays_and_bearings_match_the_straight_paths(seed):
    pose, velocity, landmarks, beacon = world(seed)
    heard = sounds_of_emission(pose, velocity, landmarks, beacon, CONFIG)
    points = np.vstack([landmarks, beacon])
    for delay, bearing, whose, landmark in zip(
        heard.delay, heard.bearing, heard.caller, heard.landmark, strict=True
    ):
        point = points[landmark - 1]
        caller = pose[:2] if whose == VEHICLE else beacon
        path = math.dist(caller, point) + math.dist(point, pose[:2])
        seen = math.atan2(*(point - pose[:2])[::-1]) - pose[2]
        assert delay == pytest.approx(path / 343.0, rel=1e-14)
        assert abs(float(wrap(bearing - seen))) < 1e-14
        assert -np.pi <= bearing < np.pi


@given(seed=SEEDS)
@law
def test_the_baffle_hides_points_behind_the_vehicle_from_its_call_only(seed):
    pose, velocity, landmarks, beacon = world(seed)
    heard = sounds_of_emission(pose, velocity, landmarks, beacon, CONFIG)
    _, bearing = range_and_bearing(pose, np.vstack([landmarks, beacon]))
    ahead = 1 + np.flatnonzero(np.abs(bearing) <= np.pi / 2)
    assert heard.landmark[heard.caller == VEHICLE].tolist() == ahead.tolist()


def test_levels_of_one_world_match_a_calculation_by_hand():
    # Vehicle (0, 0) facing +x; landmark (5, 0); beacon (5, 12): legs 12, 5 and 13 m, a right
    # angle at the landmark. Source levels 53 and 50 dB; absorption 1.133 and 0.937 dB/m; turned by
    # a right angle a 2.5 cm cylinder throws -1.386 dB re backscatter at 30 kHz.
    #   active, landmark    53 - 40 log 5  - 1.133 x 10          = 53 - 27.959 - 11.330 =  13.711
    #   active, beacon      53 - 40 log 13 - 1.133 x 26          = 53 - 44.558 - 29.458 = -21.016
    #   passive, a mirror   50 - 20 log 17 - 0.937 x 17 - 1.386  = 50 - 24.609 - 17.315 =   8.076
    #   passive, bistatic   50 - 20 log 60 - 0.937 x 17 - 1.386  = 50 - 35.563 - 17.315 =  -2.878
    #   the beacon's call   50 - 20 log 13 - 0.937 x 13          = 50 - 22.279 - 12.181 =  15.540
    landmarks, beacon = np.array([[5.0, 0.0]]), np.array([5.0, 12.0])
    for spreading, echo in (("paper", 8.076), ("bistatic", -2.878)):
        heard = sounds_of_emission(ORIGIN, STILL, landmarks, beacon, as_by_hand(spreading))
        # The last digit of the absorption is worth 0.0005 x 26 m.
        expected = [13.711, -21.016, echo, 15.540]
        np.testing.assert_allclose(heard.level_db, expected, atol=0.015)


def test_a_landmark_between_beacon_and_vehicle_scatters_forward():
    # Straight on, a cylinder throws 10 log(4kr / pi) re backscatter.
    landmarks, beacon = np.array([[5.0, 0.0]]), np.array([15.0, 0.0])
    heard = sounds_of_emission(ORIGIN, STILL, landmarks, beacon, as_by_hand("paper"))
    echo, call = heard.level_db[-2:]
    gain = 10 * math.log10(4 / math.pi * 2 * math.pi * 30e3 / 343.0 * 0.025)
    assert echo - call == pytest.approx(gain, abs=1e-9)  # a mirror adds no spreading


@given(seed=SEEDS, spreading=LAWS)
@law
def test_passive_echoes_are_the_same_with_beacon_and_vehicle_exchanged(seed, spreading):
    pose, _, landmarks, beacon = world(seed)
    n, config = len(landmarks), as_by_hand(spreading)
    there = sounds_of_emission(pose, STILL, landmarks, beacon, config)
    back = sounds_of_emission(np.append(beacon, 0.3), STILL, landmarks, pose[:2], config)
    for name in ("delay", "level_db"):
        np.testing.assert_allclose(
            getattr(there, name)[-n - 1 :], getattr(back, name)[-n - 1 :], rtol=1e-12, atol=1e-11
        )


@given(seed=SEEDS, turn=st.floats(-3.0, 3.0))
@law
def test_a_world_turned_and_moved_as_a_whole_sounds_the_same(seed, turn):
    pose, velocity, landmarks, beacon = world(seed)
    c, s = math.cos(turn), math.sin(turn)
    about, shift = np.array([[c, s], [-s, c]]), np.array([3.0, -8.0])
    moved = np.append(pose[:2] @ about + shift, pose[2] + turn)
    one = sounds_of_emission(pose, velocity, landmarks, beacon, CONFIG)
    two = sounds_of_emission(
        moved, velocity @ about, landmarks @ about + shift, beacon @ about + shift, CONFIG
    )
    # Apart from the forward lobe's interference fringes, which magnify rounding by kr.
    for name in ("delay", "level_db", "frequency"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=1e-9, atol=1e-9)
    assert np.abs(wrap(one.bearing - two.bearing)).max() < 1e-12


@given(seed=SEEDS)
@law
def test_landmarks_in_another_order_sound_the_same_under_other_labels(seed):
    pose, velocity, landmarks, beacon = world(seed)
    order = np.random.default_rng(seed).permutation(len(landmarks))
    one = sounds_of_emission(pose, velocity, landmarks, beacon, CONFIG)
    two = sounds_of_emission(pose, velocity, landmarks[order], beacon, CONFIG)
    old_label = np.append(order, len(landmarks))[two.landmark - 1] + 1
    by_label = np.lexsort((old_label, two.caller))
    for name in ("delay", "level_db", "bearing", "frequency", "caller"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name)[by_label], rtol=1e-12)


def test_motion_changes_only_the_frequencies():
    pose, velocity, landmarks, beacon = world(5)
    moving = sounds_of_emission(pose, velocity, landmarks, beacon, CONFIG)
    still = sounds_of_emission(pose, STILL, landmarks, beacon, CONFIG)
    assert set(still.frequency.tolist()) == {30e3, 35e3}
    assert np.all(moving.frequency != still.frequency)
    for name in ("delay", "level_db", "bearing", "caller", "landmark"):
        np.testing.assert_array_equal(getattr(moving, name), getattr(still, name))


@given(seed=SEEDS, spreading=LAWS, pace=st.floats(0.5, 2.0))
@law
def test_arrivals_scale_with_the_speed_of_sound_if_motion_and_targets_do(seed, spreading, pace):
    pose, velocity, landmarks, beacon = world(seed)
    config = as_by_hand(spreading)
    quick = config.model_copy(
        update={
            "air": config.air.model_copy(update={"speed_of_sound": 343.0 * pace}),
            "target": TargetConfig(radius=0.025 * pace),  # as many wavelengths
        }
    )
    one = sounds_of_emission(pose, velocity, landmarks, beacon, config)
    two = sounds_of_emission(pose, velocity * pace, landmarks, beacon, quick)
    np.testing.assert_allclose(two.delay * pace, one.delay, rtol=1e-12)
    np.testing.assert_allclose(two.level_db, one.level_db, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(two.frequency, one.frequency, rtol=1e-12)


@pytest.mark.parametrize(
    ("landmarks", "beacon", "found"),
    [
        ([[1.0, 1.0], [0.0, 0.0]], [5.0, 0.0], "vehicle to landmark 2: 0.0 m"),
        ([[1.0, 1.0], [2.0, 0.0]], [0.0, 0.0], "vehicle to beacon: 0.0 m"),
        ([[5.0, 0.0], [2.0, 0.0]], [5.0, 0.0], "beacon to landmark 1: 0.0 m"),
        ([[np.nan, 0.0], [2.0, 0.0]], [5.0, 0.0], "vehicle to landmark 1: nan m"),
        ([[1.0, 0.0], [2.0, np.inf]], [5.0, 0.0], "vehicle to landmark 2: inf m"),
    ],
)
def test_points_that_coincide_or_are_not_finite_are_refused(landmarks, beacon, found):
    with pytest.raises(InputError, match=rf"world .*{found}.* move them apart"):
        sounds_of_emission(ORIGIN, STILL, np.array(landmarks), np.array(beacon), CONFIG)


def test_a_heading_or_a_velocity_that_is_not_finite_is_refused():
    landmarks, beacon = np.array([[1.0, 1.0]]), np.array([5.0, 0.0])
    with pytest.raises(InputError, match="no finite heading"):
        sounds_of_emission(np.array([0.0, 0.0, np.nan]), STILL, landmarks, beacon, CONFIG)
    with pytest.raises(InputError, match="velocity"):
        sounds_of_emission(ORIGIN, np.array([0.0, np.nan]), landmarks, beacon, CONFIG)


@given(seed=SEEDS)
@law
@pytest.mark.shapes
def test_a_piston_changes_only_the_levels_of_active_echoes(seed):
    heard = sounds_of_emission(*world(seed), CONFIG)
    before = {name: column.copy() for name, column in rows(heard, slice(None)).items()}
    beamed = through_piston(heard, **PISTON)
    own = heard.caller == VEHICLE
    gain = 20 * np.log10(piston_directivity(heard.bearing[own], **PISTON))
    np.testing.assert_allclose((beamed.level_db - heard.level_db)[own], gain, atol=1e-11)
    np.testing.assert_array_equal(beamed.level_db[~own], heard.level_db[~own])
    for name, column in before.items():
        np.testing.assert_array_equal(getattr(heard, name), column)  # left as it was
        if name != "level_db":
            np.testing.assert_array_equal(getattr(beamed, name), column)


def test_off_axis_loss_as_power_is_half_the_loss_as_pressure():
    heard = sounds_of_emission(*world(5), CONFIG)
    whole, half = (
        through_piston(heard, **PISTON, off_axis=way).level_db - heard.level_db
        for way in ("pressure", "power")
    )
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-11)
    assert whole.min() < -3.0


def test_a_null_of_the_piston_is_deep_but_finite():
    radius = 0.025
    null = math.asin(jn_zeros(1, 1)[0] / (2 * math.pi * 35e3 / 343.0 * radius))
    heard = sounds_of_emission(*world(5), CONFIG)
    own = np.flatnonzero(heard.caller == VEHICLE)
    bearing = heard.bearing.copy()
    bearing[own[:2]] = null, math.pi  # a null to rounding, and behind the baffle to the last bit
    heard = replace(heard, bearing=bearing)
    gain = through_piston(heard, **{**PISTON, "radius": radius}).level_db - heard.level_db
    assert -240.0 - 1e-9 <= gain[own[0]] < -200.0
    assert gain[own[1]] == pytest.approx(-240.0, abs=1e-9)


def test_an_impossible_emission_of_a_batch_is_named():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.5]])
    with pytest.raises(InputError, match=r"pose \[1\. +1\. +0\.5\]: found vehicle to landmark 1"):
        sounds_of_emissions(poses, 0 * poses[:, :2], poses[1:, :2], np.array([5.0, 0.0]), CONFIG)


# Bodies of their own


def through(bodies, config, pose=ORIGIN):
    landmarks = np.array([[5.0, 0.5], [6.0, -2.0], [3.0, 4.0]])
    callers = callers_of(config, np.array([0.0, 9.0]))
    heard, _ = arrivals_of_emissions(pose[None], STILL[None], landmarks, callers, config, bodies)
    return heard


@pytest.mark.parametrize("shape", ["cylinder", "sphere"])
def test_bodies_without_a_stated_size_are_default_points_to_the_bit(shape):
    config = Config(target=TargetConfig(shape=shape, radius=0.04))
    usual = Bodies(radius=np.full(3, np.nan), shape=np.full(3, shape))
    for name in ("delay", "bearing", "frequency", "landmark"):
        found, expected = (getattr(through(b, config), name) for b in (usual, None))
        assert found.tobytes() == expected.tobytes()
    found, expected = (through(b, config).level_db for b in (usual, None))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_an_own_echo_of_a_body_is_delayed_to_its_surface():
    trunks = Bodies(radius=np.array([0.3, 0.15, np.nan]), shape=np.full(3, "cylinder"))
    centre, surface = through(None, CONFIG), through(trunks, CONFIG)
    own = surface.caller == VEHICLE
    nearer = 343.0 / 2.0 * (centre.delay - surface.delay)[own]
    np.testing.assert_allclose(nearer, [0.3, 0.15, 0.0, 0.0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(surface.bearing[own], centre.bearing[own], rtol=0, atol=1e-15)
    assert surface.landmark[own].tolist() == [1, 2, 3, 4]


def test_only_the_larger_body_is_louder_by_shape_and_nearer_surface():
    usual, reach = through(None, CONFIG), math.hypot(5.0, 0.5)
    nearer = 40.0 * math.log10(reach / (reach - 0.25)) + 0.5 * 1.1329
    for shape, gain in (("cylinder", 10.0), ("sphere", 20.0)):
        target = TargetConfig(shape=shape, radius=0.025)
        like = CONFIG.model_copy(update={"target": target})
        large = Bodies(radius=np.array([0.25, np.nan, np.nan]), shape=np.full(3, shape))
        more = through(large, like).level_db - through(None, like).level_db
        own, other = usual.caller == VEHICLE, usual.landmark != 1
        np.testing.assert_allclose(more[own & ~other], gain + nearer, atol=1e-4)
        np.testing.assert_allclose(more[other], 0.0, atol=1e-12)
        passive = more[~own & ~other]
        assert passive.shape == (1,)
        assert passive[0] > 0.5 * gain


def test_spheres_among_cylinders_scatter_as_spheres():
    cylinders = Config()
    spheres = Config(target=TargetConfig(shape="sphere"))
    mixed = Bodies(radius=np.full(3, np.nan), shape=np.array(["sphere", "cylinder", "sphere"]))
    levels = through(mixed, cylinders).level_db
    label = through(None, cylinders).landmark
    alone = [through(None, config).level_db for config in (cylinders, spheres)]
    of_sphere = np.isin(label, [1, 3])
    np.testing.assert_allclose(levels, np.where(of_sphere, alone[1], alone[0]), atol=1e-12)
    assert np.abs(alone[1] - alone[0])[of_sphere].max() > 0.1


def orchard(seed, count):
    """Emissions among trunks, heard by a vehicle and a boat on the move; nobody within a trunk."""
    rng = np.random.default_rng(seed)
    poses, boat = rng.uniform(-9.0, 9.0, (count, 3)), rng.uniform(-9.0, 9.0, (count, 2))
    places, radius = rng.uniform(-12.0, 12.0, (30, 2)), rng.uniform(0.05, 0.6, 30)
    ends = np.vstack((poses[:, :2], boat))
    free = np.hypot(*(places[:, None] - ends).T).min(axis=0) > radius + 1e-3
    vehicle, beacon = callers_of(CONFIG, STILL)
    speeds = rng.uniform(-1.0, 1.0, (2, count, 2))
    callers = (vehicle, replace(beacon, place=boat, velocity=speeds[1]))
    bodies = Bodies(
        radius=radius[free],
        shape=np.where(rng.uniform(size=free.sum()) < 0.5, "sphere", "cylinder"),
    )
    return poses, speeds[0], places[free], callers, CONFIG, bodies


def least_way(source, receiver, centre, radius):
    """Length of the least way by a disc, and its last point, by a search along the circle."""
    line = source - receiver
    along = np.clip((centre - receiver) @ line / (line @ line), 0.0, 1.0)
    if np.hypot(*(receiver + along * line - centre)) < radius:
        return np.hypot(*line), source

    def point(angle):
        return centre + radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)

    def length(angle):
        return sum(np.hypot(*(point(angle) - end).T) for end in (source, receiver))

    around = np.linspace(-np.pi, np.pi, 721)
    start = around[np.argmin(length(around))]
    found = minimize_scalar(
        length, bounds=(start - 0.01, start + 0.01), method="bounded", options={"xatol": 1e-12}
    )
    return found.fun, point(found.x)


@pytest.mark.parametrize("seed", range(3))
def test_echoes_of_bodies_come_by_the_least_way_over_their_surface(seed):
    poses, velocities, places, callers, config, bodies = orchard(seed, 4)
    heard, count = arrivals_of_emissions(poses, velocities, places, callers, config, bodies)
    emission, checked = np.repeat(np.arange(4), count), 0
    for a in np.flatnonzero((heard.caller == BEACON) & (heard.landmark <= len(places))):
        k, i = emission[a], heard.landmark[a] - 1
        receiver, boat = poses[k, :2], callers[BEACON].place[k]
        path, last = least_way(boat, receiver, places[i], bodies.radius[i])
        assert 343.0 * heard.delay[a] == pytest.approx(path, rel=0, abs=1e-9)
        bearing = np.arctan2(*(last - receiver)[::-1]) - poses[k, 2]
        assert wrap(bearing - heard.bearing[a]) == pytest.approx(0.0, abs=1e-5)
        boat_later = boat + 1e-4 * callers[BEACON].velocity[k]
        later = receiver + 1e-4 * velocities[k]
        longer = least_way(boat_later, later, places[i], bodies.radius[i])[0] - path
        shift = heard.frequency[a] / 30e3 - 1.0
        assert shift == pytest.approx(-longer / 1e-4 / 343.0, abs=3e-5)
        checked += 1
    assert checked > 40


@pytest.mark.parametrize("seed", range(3))
def test_emissions_among_bodies_are_bit_identical_in_a_batch_and_single(seed):
    poses, velocities, places, callers, config, bodies = orchard(seed, 6)
    heard, count = arrivals_of_emissions(poses, velocities, places, callers, config, bodies)
    rows, (vehicle, boat) = np.repeat(np.arange(6), count), callers
    for k in range(6):
        now = replace(boat, place=boat.place[[k]], velocity=boat.velocity[[k]])
        at = poses[[k]], velocities[[k]], places, (vehicle, now), config
        alone, _ = arrivals_of_emissions(*at, bodies)
        among = arrivals_at(heard, rows == k)
        for name in COLUMNS:
            assert getattr(among, name).tobytes() == getattr(alone, name).tobytes()


def test_arrivals_are_continuous_where_a_body_hides_the_beacon():
    sideways, still = np.linspace(-0.6, 0.6, 2401), np.zeros((2401, 2))
    poses = np.column_stack((0.0 * sideways, sideways, 0.0 * sideways))
    config = as_by_hand("bistatic").model_copy(update={"target": TargetConfig(radius=0.3)})
    callers, place = callers_of(config, np.array([-9.0, 0.0])), np.array([[-4.0, 0.0]])
    trunk = Bodies(radius=np.array([0.3]), shape=np.array(["cylinder"]))
    heard, _ = arrivals_of_emissions(poses, still, place, callers, config, trunk)
    centre, _ = arrivals_of_emissions(poses, still, place, callers, config)
    passive, direct = ((heard.caller == BEACON) & (heard.landmark == label) for label in (1, 2))
    late = heard.delay[passive] - heard.delay[direct]
    aside = wrap(heard.bearing[passive] - heard.bearing[direct])
    louder = (heard.level_db - centre.level_db)[passive]
    hidden = np.abs(sideways) * 5.0 / np.hypot(9.0, sideways) < 0.3
    np.testing.assert_allclose(late[hidden], 0.0, atol=1e-16)
    np.testing.assert_allclose(aside[hidden], 0.0, atol=1e-14)
    assert late[~hidden].min() > 0.0
    for column, most in ((343.0 * late, 1e-4), (aside, 3e-4), (louder, 1e-3)):
        assert np.abs(np.diff(column)).max() < most


@pytest.mark.parametrize(
    ("landmark", "beacon", "found"),
    [
        ([0.2, 0.0], [5.0, 0.0], r"vehicle to landmark 2: 0\.2 m, within its radius of 0\.3 m"),
        ([0.3, 0.0], [5.0, 0.0], r"vehicle to landmark 2: 0\.3 m, within its radius of 0\.3 m"),
        ([5.0, 0.25], [5.0, 0.0], r"beacon to landmark 2: 0\.25 m, within its radius of 0\.3 m"),
    ],
)
def test_a_vehicle_or_beacon_within_a_body_is_refused(landmark, beacon, found):
    landmarks, callers = np.array([[3.0, 3.0], landmark]), callers_of(CONFIG, np.array(beacon))
    sized = Bodies(radius=np.array([np.nan, 0.3]), shape=np.full(2, "cylinder"))
    world = ORIGIN[None], STILL[None], landmarks, callers, CONFIG
    with pytest.raises(InputError, match=rf"world .*{found}.* move them apart"):
        arrivals_of_emissions(*world, sized)
    points = replace(sized, radius=np.full(2, np.nan))
    assert arrivals_of_emissions(*world, points)[1].tolist() == [6 if beacon[0] == 5.0 else 5]
