"""Callers with clocks of their own: when each call is heard, and what is measured of it."""

from dataclasses import replace

import numpy as np
import pytest

from pipistrelle.config import Config, InputError, ListeningConfig, ScenarioConfig
from pipistrelle.detection.scans import OWN
from pipistrelle.experiments.hearing.listening import frames_of, listen
from pipistrelle.experiments.hearing.scenario import calls_heard, with_times, world_of
from pipistrelle.experiments.runs.heard_world import drive_of, scans_of
from pipistrelle.geometry import path_at, wrap
from pipistrelle.settings import from_flags, resolve

RADIUS = 0.0088
SETUP = {"steps": 80, "landmarks": 25}


def config_of(*callers, timing=True, **more):
    given = {"callers": [*callers], "scenario": SETUP, "listening": {"excess_paths": timing}}
    return resolve(from_flags(given | more))


def heard_calls(config, world=None):
    """Return the world, and what was heard between the vehicle's calls and what with them."""
    world = world or world_of(config)
    (heard,) = listen(world, config, [RADIUS])
    return world, [h for h in heard if h.between], [h for h in heard if not h.between]


def direct_times(world, config):
    return [time for time, _ in calls_heard(world, config.scenario, config.air.sound_speed)]


def test_a_call_is_heard_when_its_sound_has_come_straight_to_where_the_vehicle_is_then():
    config = config_of({"period": 0.37, "offset": 0.1, "distance": 15.0})
    world = world_of(config)
    beacon, times = world.callers[1], np.array(direct_times(world, config))
    assert np.diff(beacon.calls) == pytest.approx(0.37)
    called = beacon.calls[beacon.calls > 0.46][: times.size]
    way = np.hypot(*(path_at(times, world.time, world.path)[:, :2] - beacon.place).T)
    assert times - way / config.air.sound_speed == pytest.approx(called, abs=2e-6)
    assert times.min() >= 0.5
    assert times.max() <= 10.0


def test_a_jitter_moves_calls_by_so_much_and_nothing_else_of_the_world():
    even = world_of(config_of({"period": 0.1, "distance": 15.0}))
    world = world_of(config_of({"period": 0.1, "distance": 15.0, "jitter": 0.004}))
    assert np.array_equal(even.callers[1].place, world.callers[1].place)
    assert np.array_equal(even.landmarks, world.landmarks)
    off = world.callers[1].calls - even.callers[1].calls
    assert 0.003 < off[1:].std() < 0.005  # the first cannot be before the start


TWICE_A_FRAME = {"period": 0.23, "offset": 0.1}
IN_SOME_FRAMES = {"period": 1.2, "offset": 0.45}


@pytest.mark.parametrize(
    ("taper", "clock", "steps", "least"),
    [
        (0.0, TWICE_A_FRAME, 80, 36),
        (0.0, IN_SOME_FRAMES, 80, 7),
        (0.2, TWICE_A_FRAME, 24, 11),
        pytest.param(0.2, TWICE_A_FRAME, 80, 36, marks=pytest.mark.slow),
        pytest.param(0.2, IN_SOME_FRAMES, 80, 7, marks=pytest.mark.slow),
    ],
)
def test_excess_paths_and_bearings_are_of_the_moment_of_reception(taper, clock, steps, least):
    setup = {"emitter": {"taper": taper}, "scenario": SETUP | {"steps": steps}}
    config = config_of({"distance": 9.0} | clock, **setup)
    world, between, _ = heard_calls(config)
    label, caller = len(world.landmarks) + 1, np.asarray(world.callers[1].place)
    assert least <= len(between) <= len(direct_times(world, config))
    off, turned, straight = [], [], 0
    for heard in between:
        assert (heard.rows.caller != OWN).all()
        (pose,) = path_at(np.array([heard.rows.time]), world.time, world.path)
        places = np.vstack((world.landmarks, caller))[heard.rows.landmark - 1]
        away, back = places - pose[:2], caller - places
        ways = np.hypot(*away.T) + np.hypot(*back.T) - np.hypot(*(caller - pose[:2]))
        timed = np.isfinite(heard.rows.excess_path) & (heard.rows.landmark != label)
        off += (heard.rows.excess_path - ways)[timed].tolist()
        turned += wrap(heard.rows.bearing - np.arctan2(*away.T[::-1]) + pose[2]).tolist()
        straight += label in heard.rows.landmark
    assert len(off) > 8 * least
    assert straight > 0.9 * len(between)
    assert np.sqrt(np.mean(np.square(off))) < 0.08
    assert np.median(np.abs(off)) < 0.03
    assert np.sqrt(np.mean(np.square(turned))) < 0.03


def test_a_clock_in_step_changes_nothing_for_a_vehicle_at_rest():
    config = config_of({"distance": 9.0})
    world = world_of(config)
    still = replace(world, path=np.tile(world.path[0], (81, 1)))
    beacon = world.callers[1]
    own = replace(beacon, calls=0.5 * np.arange(1, 21))
    plain, clocked = (
        list(frames_of(replace(still, callers=(world.callers[0], c)), [RADIUS], config, unaimed))
        for c in (beacon, own)
    )
    for one, other in zip(plain[:-1], clocked, strict=False):  # the last is heard after the end
        (one,), (other,) = one.aimed, other.aimed
        for name in ("caller", "landmark", "level_db", "bearing", "frequency"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        assert one.delay == pytest.approx(other.delay, abs=1e-6)


def unaimed(arrivals, **_):
    """Give a call no beam."""
    return arrivals


def test_echoes_after_the_next_call_belong_to_their_call():
    _, between, _ = heard_calls(config_of({"distance": 9.0, "offset": 0.44}))
    late = [
        heard.rows.time % 0.5 + (np.nan_to_num(heard.rows.excess_path) / 343.0).max()
        for heard in between
    ]
    whole = [len(heard.rows.landmark) for heard in between]
    _, early, _ = heard_calls(config_of({"distance": 9.0, "offset": 0.2}))
    assert np.mean(np.array(late) > 0.5) > 0.5
    assert np.mean(whole) > 0.85 * np.mean([len(heard.rows.landmark) for heard in early])


def test_arrivals_during_the_vehicles_call_are_lost():
    config = config_of({"distance": 9.0})
    world = world_of(config)
    still = replace(world, path=np.tile(world.path[0], (81, 1)))
    straight = np.hypot(*(world.callers[1].place - world.path[0, :2])) / config.air.sound_speed
    for after, heard_once in ((0.4975, False), (0.49, True)):
        own = replace(world.callers[1], calls=np.array([1.0 + after - straight]))
        alone = replace(still, callers=(world.callers[0], own))
        (frame, *_) = [f for f in frames_of(alone, [RADIUS], config, unaimed) if f.calls]
        direct = frame.aimed[0].landmark[frame.aimed[0].caller == 1] == len(world.landmarks) + 1
        assert direct.any() == heard_once


def test_own_echoes_do_not_depend_on_other_callers_clocks():
    counts = []
    for clock in ({}, {"offset": 0.25}, {"period": 0.21}):
        _, _, frames = heard_calls(config_of({"distance": 15.0} | clock, timing=False))
        counts.append(sum(np.isfinite(frame.rows.range).sum() for frame in frames))
    assert max(counts) - min(counts) < 0.1 * max(counts)


def test_active_sensing_has_a_scan_a_frame_and_listening_one_more_for_every_call():
    config = config_of({"distance": 15.0, "offset": 0.25})
    _, between, frames = heard_calls(config)
    heard = [*between, *frames]
    assert len(scans_of(frames, "active", config)) == len(frames) == 20
    assert len(scans_of(heard, "active", config)) == 20
    assert len(scans_of(heard, "fused", config)) == 20 + len(between)


def test_additional_times_of_a_world_are_on_its_paths():
    config = config_of({"course": "circle", "radius": 9.0, "speed": 1.0})
    world = world_of(config)
    times = [1.03, 2.125, 7.77]
    more = with_times(world, times)
    assert np.array_equal(more.path[np.isin(more.time, world.time)], world.path)
    for time in (1.03, 7.77):
        k, i = np.searchsorted(world.time, time), np.searchsorted(more.time, time)
        share = (time - world.time[k - 1]) / 0.125
        for path, way in ((more.path, world.path), (more.callers[1].place, world.callers[1].place)):
            assert path[i] == pytest.approx((1.0 - share) * way[k - 1] + share * way[k], abs=1e-12)
    assert len(more.time) == len(world.time) + 2


@pytest.mark.parametrize(
    ("clock", "said"),
    [
        ({"period": 0.01}, r"callers\.1\.period"),
        ({"jitter": 0.06}, r"callers\.1\.jitter: found 0\.06 s, expected at most a tenth"),
        ({"times": [1.0, 2.0], "period": 1.0}, "found times and period"),
        ({"times": [2.0, 1.0]}, "found time 1 after 2"),
        ({"offset": -0.1}, r"callers\.1\.offset"),
        ({"period": float("nan")}, r"callers\.1\.period"),
    ],
)
def test_a_clock_that_none_can_have_is_refused(clock, said):
    with pytest.raises(InputError, match=said):
        world_of(config_of(clock))


def test_a_vehicle_with_a_clock_calls_but_cannot_be_the_listener():
    mate = {"course": "mission", "frequency": 30e3, "offset": 0.2}
    world = world_of(config_of(mate))
    assert world.callers[1].heading is not None
    with pytest.raises(InputError, match=r"scenario\.vehicle: found 2, which has a clock"):
        world_of(config_of(mate, scenario=SETUP | {"vehicle": 2}))


def test_a_caller_without_calls_is_never_detected():
    config = config_of({"distance": 15.0, "times": []})
    world, between, frames = heard_calls(config)
    assert not between
    assert not any((frame.rows.caller != OWN).any() for frame in frames)
    assert drive_of(world, config).time.size == 81


def test_callers_have_no_clock_without_a_list_of_times():
    world = world_of(Config(scenario=ScenarioConfig(**SETUP), listening=ListeningConfig()))
    assert [caller.calls for caller in world.callers] == [None, None]
