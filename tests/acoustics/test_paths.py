"""Callers, fixed and moving, what each brings to the vehicle, and the points that reflect it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from pipistrelle.acoustics.arrivals import Arrivals, arrivals_of_emission, arrivals_of_emissions
from pipistrelle.acoustics.paths import (
    Caller,
    callers_at,
    callers_of,
    check_caller,
    moves,
    reflecting_points,
)
from pipistrelle.acoustics.propagation import absorption_db_per_m
from pipistrelle.config import BeaconConfig, Config, EmitterConfig, InputError

law = settings(deadline=None, max_examples=40)
law_of_points = settings(deadline=None, max_examples=300)
SEEDS = st.integers(0, 2**32 - 1)
COLUMNS = [name for name in Arrivals.__slots__ if name != "departure"]
CONFIG = Config()
C = CONFIG.air.sound_speed
TONES = (30e3, 25e3, 20e3)


def crowd(seed, others=3, moving=0, emissions=4):
    """Return poses, velocities, landmarks and callers; the last of the others move."""
    rng = np.random.default_rng(seed)
    vehicle, _ = callers_of(CONFIG, np.zeros(2))
    callers = [vehicle]
    for j in range(others):
        shape = (emissions, 2) if j >= others - moving else (2,)
        velocity = rng.uniform(-3.0, 3.0, shape) if j >= others - moving else None
        place = rng.uniform(-15.0, 15.0, shape)
        named = {"name": f"caller {j}", "frequency": TONES[j], "level_db": 40.0 + j}
        callers.append(Caller(**named, place=place, velocity=velocity))
    poses = rng.uniform(-9.0, 9.0, (emissions, 3))
    return poses, rng.uniform(-1.0, 1.0, (emissions, 2)), rng.uniform(-20, 20, (5, 2)), callers


def bits(arrivals):
    return [getattr(arrivals, name).tobytes() for name in COLUMNS]


@given(seed=SEEDS)
@law
def test_each_caller_arrives_directly_and_via_all_landmarks_and_callers(seed):
    poses, velocities, landmarks, callers = crowd(seed)
    heard = arrivals_of_emission(poses[0], velocities[0], landmarks, callers, CONFIG)
    points = np.vstack((landmarks, [caller.place for caller in callers[1:]]))
    others = heard.caller > 0
    assert heard.caller[others].tolist() == [1] * 8 + [2] * 8 + [3] * 8
    assert heard.landmark[others].tolist() == [*range(1, 9)] * 3
    home = np.hypot(*(points - poses[0, :2]).T)
    for j in (1, 2, 3):
        out = np.hypot(*(points - callers[j].place).T)
        assert out[4 + j] == 0.0  # its direct call
        np.testing.assert_allclose(heard.delay[heard.caller == j], (out + home) / C, rtol=1e-14)
    assert set(heard.landmark[~others].tolist()) <= set(range(1, 9))


@given(seed=SEEDS, moving=st.integers(0, 3))
@law
def test_the_order_of_the_other_callers_changes_labels_and_nothing_else(seed, moving):
    poses, velocities, landmarks, callers = crowd(seed, moving=moving)
    order = np.random.default_rng(seed).permutation(3)
    turned = [callers[0], *(callers[1 + j] for j in order)]
    one, count = arrivals_of_emissions(poses, velocities, landmarks, callers, CONFIG)
    two, same = arrivals_of_emissions(poses, velocities, landmarks, turned, CONFIG)
    assert count.tolist() == same.tolist()
    old_label = np.concatenate(([0, 1, 2, 3, 4, 5], 6 + order))[two.landmark]
    old_caller = np.concatenate(([0], 1 + order))[two.caller]
    rows = np.lexsort((old_label, old_caller, np.repeat(np.arange(4), count)))
    assert old_label[rows].tolist() == one.landmark.tolist()
    for name in ("delay", "level_db", "bearing", "frequency"):
        assert getattr(two, name)[rows].tobytes() == getattr(one, name).tobytes()


@given(seed=SEEDS)
@law
def test_a_caller_at_rest_equals_a_constant_path_to_the_bit(seed):
    poses, velocities, landmarks, callers = crowd(seed)
    time, steps = 0.5 * np.arange(5), np.arange(1, 5)
    tied = [replace(c, place=np.tile(c.place, (5, 1))) for c in callers[1:]]
    moved = callers_at([callers[0], *tied], time, steps)
    assert all(not caller.velocity.any() for caller in moved[1:])
    one, _ = arrivals_of_emissions(poses, velocities, landmarks, callers, CONFIG)
    two, _ = arrivals_of_emissions(poses, velocities, landmarks, moved, CONFIG)
    assert bits(one) == bits(two)


@given(seed=SEEDS)
@law
def test_emissions_of_moving_callers_are_bit_identical_in_a_batch_and_single(seed):
    poses, velocities, landmarks, callers = crowd(seed, moving=2)
    heard, count = arrivals_of_emissions(poses, velocities, landmarks, callers, CONFIG)
    end = np.cumsum(count)
    for k in range(len(poses)):
        now = [
            c if c.velocity is None else replace(c, place=c.place[k], velocity=c.velocity[k])
            for c in callers
        ]
        alone = arrivals_of_emission(poses[k], velocities[k], landmarks, now, CONFIG)
        for name in COLUMNS:
            among = getattr(heard, name)[end[k] - count[k] : end[k]]
            assert among.tobytes() == getattr(alone, name).tobytes()


def arrives(left, sender, receiver):
    """Return when sound reaches a receiver, the way at time 0 being that of both clocks at 0.

    Both move on straight lines (place, velocity).
    """
    start, way = sender[0] + left * sender[1], np.hypot(*(receiver[0] - sender[0]))

    def late(t):
        return C * (t - left) - np.hypot(*(receiver[0] + t * receiver[1] - start)) + way

    return brentq(late, left - 0.1, left + 0.1, xtol=1e-16, rtol=1e-15)


@given(seed=SEEDS)
@law
def test_the_shift_of_a_tone_is_the_derivative_of_the_time_of_arrival(seed):
    # Everyone moves on a straight line through the frozen points: the crests' times of arrival,
    # solved from the lengths of the ways alone, know nothing of Doppler's formula.
    poses, velocities, landmarks, callers = crowd(seed, moving=2, emissions=1)
    heard = arrivals_of_emission(poses[0], velocities[0], landmarks, callers, CONFIG)
    lines = [(poses[0, :2], velocities[0])]
    lines += [(c.place.reshape(2), np.zeros(2) if c.velocity is None else c.velocity.reshape(2))
              for c in callers[1:]]  # fmt: skip
    targets = [(place, np.zeros(2)) for place in landmarks] + lines[1:]
    step = 1e-5
    for caller, label, frequency in zip(heard.caller, heard.landmark, heard.frequency, strict=True):
        ends = []
        for left in (-step, step):
            if caller == 0 or label != len(landmarks) + caller:  # an echo
                left = arrives(left, lines[caller], targets[label - 1])
            ends.append(arrives(left, targets[label - 1], lines[0]))
        shift = 2.0 * step / (ends[1] - ends[0])
        assert frequency == pytest.approx(callers[caller].frequency * shift, rel=1e-8)


def test_a_path_gives_places_and_the_velocities_of_the_steps_that_end_there():
    vehicle, beacon = callers_of(CONFIG, np.ones(2))
    time, path = np.array([0.0, 0.5, 1.5, 2.0]), np.array([[0.0, 0], [1, 0], [1, 2], [0, 2]])
    boat = Caller(name="boat", frequency=25e3, level_db=40.0, place=path)
    first, second, third = callers_at((vehicle, beacon, boat), time, np.array([1, 2]))
    assert (first, second) == (vehicle, beacon)
    assert third.place.tolist() == [[1, 0], [1, 2]]
    assert third.velocity.tolist() == [[2, 0], [0, 2]]
    own = replace(boat, velocity=path + 5.0)
    given_ = callers_at((vehicle, own), time, np.array([3]))[1]
    assert given_.velocity.tolist() == [[5.0, 7.0]]


def test_invalid_lists_and_paths_of_callers_are_refused():
    vehicle, beacon = callers_of(CONFIG, np.ones(2))
    time, steps = np.arange(4.0), np.array([1])
    for callers in ((), (beacon,), (beacon, vehicle), (vehicle, vehicle)):
        with pytest.raises(InputError, match=r"^callers: found .*expected the vehicle first"):
            callers_at(callers, time, steps)
    short = replace(beacon, name="boat", place=np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"^caller boat: found .*\(3, 2\).*expected \(4, 2\)"):
        callers_at((vehicle, short), time, steps)
    lame = replace(beacon, place=np.zeros((4, 2)), velocity=np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"velocities of shape \(3, 2\)"):
        callers_at((vehicle, lame), time, steps)


@pytest.mark.parametrize(
    ("part", "value", "said"),
    [
        ("frequency", np.nan, "frequency: found nan, expected one finite number [Hz]"),
        ("frequency", None, "frequency: found nan, expected one finite number [Hz]"),
        ("level_db", np.inf, "level_db: found inf, expected one finite number [dB]"),
        ("level_db", "loud", "level_db: found 'loud', expected one finite number [dB]"),
        ("level_db", [1.0, 2.0], "level_db: found an array of shape (2,), expected one finite"),
        ("place", np.ones(3), "place: found an array of shape (3,), expected finite x and y [m]"),
        ("place", np.ones((4, 3)), "place: found an array of shape (4, 3), expected finite x"),
        ("place", 3.0, "place: found an array of shape (), expected finite x and y [m], or a row"),
        ("place", np.ones((1, 4, 2)), "place: found an array of shape (1, 4, 2), expected"),
        ("place", [[1.0, 2.0], [3.0]], "place: found [[1.0, 2.0], [3.0]], expected finite x"),
        ("place", (3.0, np.nan), "place: found nan, expected finite x and y [m]"),
        ("place", [[1.0, 2.0]] * 3 + [[np.inf, 0.0]], "place: found inf, expected finite x"),
        ("velocity", np.ones(3), "velocity: found an array of shape (3,), expected finite x"),
        ("velocity", np.full((4, 2), np.nan), "velocity: found nan, expected finite x and y [m/s]"),
    ],
)
def test_a_non_numeric_caller_is_refused_by_every_function(part, value, said):
    vehicle, beacon = callers_of(CONFIG, np.ones(2))
    odd = replace(beacon, name="boat", place=np.zeros((4, 2)), velocity=np.zeros((4, 2)))
    odd = replace(odd, **{part: value})
    for refuses in (
        check_caller,
        moves,
        lambda caller: callers_at((vehicle, caller), np.arange(4.0), np.array([1])),
    ):
        with pytest.raises(InputError, match="^" + re.escape(f"caller boat: {said}")):
            refuses(odd)


def test_a_vehicle_with_a_velocity_and_a_velocity_without_a_path_are_refused():
    vehicle, beacon = callers_of(CONFIG, np.ones(2))
    time, steps = np.arange(2.0), np.array([1])
    driven = replace(vehicle, velocity=np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"^caller vehicle: found a velocity, expected none; leav"):
        callers_at((driven, beacon), time, steps)
    adrift = replace(beacon, velocity=np.ones(2))
    with pytest.raises(InputError, match=r"^caller beacon: found a path of shape \(2,\) and veloc"):
        callers_at((vehicle, adrift), time, steps)


def test_places_and_paths_may_be_plain_numbers():
    vehicle, beacon = callers_of(CONFIG, np.ones(2))
    time, steps = np.arange(3.0), np.array([1, 2])
    plain = [[0.0, 5.0], [1.0, 5.0], [3.0, 5.0]]
    post, boat = replace(beacon, place=(3.0, 9.0)), replace(beacon, name="boat", place=plain)
    assert [moves(caller) for caller in (post, boat)] == [False, True]
    assert callers_at((vehicle, post, boat), time, steps)[2].velocity.tolist() == [[1, 0], [2, 0]]
    _, _, landmarks, _ = crowd(3)
    one, two = (
        arrivals_of_emission(np.zeros(3), np.zeros(2), landmarks, [vehicle, caller], CONFIG)
        for caller in (post, replace(post, place=np.array(post.place)))
    )
    assert bits(one) == bits(two)


def test_callers_at_one_point_are_refused_by_their_names():
    _, _, landmarks, callers = crowd(3)
    callers[3] = replace(callers[3], name="boat", place=callers[1].place)
    with pytest.raises(InputError, match=r"boat to caller 0: 0\.0 m.*expected vehicle, caller 0"):
        arrivals_of_emission(np.zeros(3), np.zeros(2), landmarks, callers, CONFIG)


def test_a_vehicle_without_other_callers_receives_only_echoes_ahead():
    vehicle, _ = callers_of(CONFIG, np.zeros(2))
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]])
    landmarks = np.array([[5.0, 0.0]])
    heard, count = arrivals_of_emissions(poses, np.zeros((2, 2)), landmarks, [vehicle], CONFIG)
    assert (count.tolist(), heard.landmark.tolist()) == ([1, 0], [1])


@given(seed=SEEDS, moving=st.integers(0, 3))
@law
def test_callers_frequencies_and_levels_override_the_settings(seed, moving):
    poses, velocities, landmarks, callers = crowd(seed, moving=moving)
    other = Config(
        emitter=EmitterConfig(frequency=50e3, level_db=90.0),
        beacon=BeaconConfig(frequency=45e3, level_db=10.0),
    )
    one, two = (
        arrivals_of_emissions(poses, velocities, landmarks, callers, config)[0]
        for config in (CONFIG, other)
    )
    assert bits(one) == bits(two)


@given(seed=SEEDS)
@law
def test_each_callers_level_falls_by_spreading_and_absorption_at_its_tone(seed):
    poses, velocities, landmarks, callers = crowd(seed)
    heard = arrivals_of_emission(poses[0], velocities[0], landmarks, callers, CONFIG)
    air = {"temperature_c": 20.0, "relative_humidity": 0.5, "pressure_kpa": 101.325}
    for j, caller in enumerate(callers[1:], start=1):
        away = np.hypot(*(caller.place - poses[0, :2]))
        lost = 20.0 * np.log10(away) + away * absorption_db_per_m(TONES[j - 1], **air)
        (direct,) = heard.level_db[(heard.caller == j) & (heard.landmark == 5 + j)]
        assert direct == pytest.approx(39.0 + j - lost, abs=1e-9)
    own = heard.caller == 0
    points = np.vstack((landmarks, [caller.place for caller in callers[1:]]))
    away = np.hypot(*(points[heard.landmark[own] - 1] - poses[0, :2]).T)
    lost = 40.0 * np.log10(away) + 2.0 * away * absorption_db_per_m(35e3, **air)
    np.testing.assert_allclose(heard.level_db[own], callers[0].level_db - lost, atol=1e-9)


# Reflecting points: Alhazen's problem against its laws


def around_a_body(seed):
    """Source, receiver, centre and radius: from nearly touching it to 20 m away."""
    rng = np.random.default_rng(seed)
    radius, centre = 10.0 ** rng.uniform(-3.0, 0.5), rng.uniform(-9.0, 9.0, 2)
    distance, angle = radius + 10.0 ** rng.uniform(-6.0, 1.3, 2), rng.uniform(-np.pi, np.pi, 2)
    ends = centre + (distance * np.array([np.cos(angle), np.sin(angle)])).T
    return *ends, centre, radius


def reflected(source, receiver, centre, radius):
    at = source[None, None], receiver[None, None], centre[None, None]
    return reflecting_points(*at, np.array([radius]))[0, 0]


@given(seed=SEEDS)
@law_of_points
def test_angles_of_incidence_and_reflection_are_equal_on_the_lit_side(seed):
    source, receiver, centre, radius = around_a_body(seed)
    point = reflected(source, receiver, centre, radius)
    normal = (point - centre) / radius
    across = np.array([-normal[1], normal[0]])
    angles = [np.arctan2(way @ across, way @ normal) for way in (source - point, receiver - point)]
    if np.hypot(*normal) < 1.0 - 1e-12:  # in the shadow: on the straight line, straight ahead
        whole = np.hypot(*(source - receiver))
        parts = np.hypot(*(source - point)) + np.hypot(*(receiver - point))
        assert parts == pytest.approx(whole, rel=1e-12)
        assert abs((point - centre) @ (source - receiver)) < 1e-9 * whole
    else:
        assert np.hypot(*normal) == pytest.approx(1.0, rel=0, abs=1e-10)
        # an angle is as sharp as the end is far: 1e-12 m of the point, no more
        near = min(np.hypot(*(end - point)) for end in (source, receiver))
        assert angles[0] + angles[1] == pytest.approx(0.0, abs=1e-10 + 1e-12 / near)
        assert abs(angles[0]) < 0.5 * np.pi + 1e-6


@given(seed=SEEDS)
@law_of_points
def test_reflection_points_are_symmetric_in_source_and_receiver(seed):
    source, receiver, centre, radius = around_a_body(seed)
    there = reflected(source, receiver, centre, radius)
    back = reflected(receiver, source, centre, radius)
    np.testing.assert_allclose(there, back, rtol=0, atol=1e-12)


@given(seed=SEEDS)
@law_of_points
def test_an_own_echo_reflects_at_the_nearest_surface_point(seed):
    _, receiver, centre, radius = around_a_body(seed)
    offset = centre - receiver
    point = reflected(receiver, receiver, centre, radius) - receiver
    reach = np.hypot(*offset)
    np.testing.assert_allclose(point, offset * (reach - radius) / reach, rtol=0, atol=1e-14 * 20)


def test_a_body_of_zero_radius_reflects_at_its_centre_to_the_bit():
    centre = np.random.default_rng(7).uniform(-9.0, 9.0, (1, 5, 2))
    source, receiver = centre[:, 3:4], np.ones((4, 1, 2))
    found = reflecting_points(source, receiver, centre, np.zeros(5))
    assert found.tobytes() == np.broadcast_to(centre, (4, 5, 2)).tobytes()


def test_reflection_points_are_bit_identical_single_and_in_a_batch():
    rng = np.random.default_rng(7)
    centre, radius = rng.uniform(-9.0, 9.0, (1, 200, 2)), rng.uniform(0.05, 0.6, 200)
    source, receiver = np.full((1, 1, 2), 12.0), rng.uniform(-13.0, -10.0, (5, 1, 2))
    together = reflecting_points(source, receiver, centre, radius)
    for k in range(5):
        for t in range(200):
            here = source, receiver[k : k + 1], centre[:, t : t + 1]
            alone = reflecting_points(*here, radius[t : t + 1])
            assert alone.tobytes() == together[k, t].tobytes()
