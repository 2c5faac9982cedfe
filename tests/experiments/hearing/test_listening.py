"""What a path hears: beams, engines, the truth's one place, and what the beacon's own call does."""

from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import arrivals_at, arrivals_of_emission, through_piston
from pipistrelle.acoustics.emitter import Bodies
from pipistrelle.acoustics.paths import VEHICLE, Caller, callers_of
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import blocks_to_hear, sampling
from pipistrelle.config import (
    BLOCK,
    AirConfig,
    BeaconConfig,
    Config,
    DetectionConfig,
    EmitterConfig,
    InputError,
    MatchingConfig,
    MotionConfig,
    ReceiverConfig,
    ScenarioConfig,
)
from pipistrelle.detection.front_end import find_calls
from pipistrelle.detection.matched import filter_blocks
from pipistrelle.detection.scans import COLUMNS, OWN, UNLABELLED
from pipistrelle.detection.snapshots import Detections, detect, detector
from pipistrelle.experiments.hearing.listening import listen
from pipistrelle.experiments.hearing.oracle import faintest_level_db, label_detections
from pipistrelle.experiments.hearing.scenario import draw_scenario, standing_landmarks
from pipistrelle.geometry import range_and_bearing, wrap

CONFIG = Config()
CALLERS = callers_of(CONFIG, np.zeros(2))
LAYOUT, SETTLED = square_of_four(CONFIG.receiver), sampling(CONFIG, CALLERS)
FINDER = detector(CONFIG, LAYOUT, SETTLED.tones)
FAINTEST = faintest_level_db(
    FINDER.threshold,
    elements=10,
    samples=SETTLED.pulse * SETTLED.block,
    noise_std=SETTLED.noise_std,
    margin_db=CONFIG.matching.margin_db,
)
RADII = (2.5, 3.1, 3.8, 4.7, 5.8, 7.1, 8.8, 10.8, 13.3, 16.4, 20.3, 25.0)  # [mm]
BEACON = 51


def short(steps, **changes):
    config = Config(**({"scenario": ScenarioConfig(steps=steps)} | changes))
    return draw_scenario(config, np.random.default_rng(7)), config


def bits(beam):
    return [
        [heard.clutter, *(np.asarray(getattr(heard.rows, name)).tobytes() for name in COLUMNS)]
        for heard in beam
    ]


def test_a_beam_gives_the_same_bits_single_and_among_twelve():
    world, config = short(40)
    radii = [1e-3 * radius for radius in RADII]
    twelve = listen(world, config, radii)
    turned = listen(world, config, radii[::-1])
    assert [bits(beam) for beam in twelve] == [bits(beam) for beam in turned[::-1]]
    for k in (0, 6, 11):
        assert bits(listen(world, config, radii[k : k + 1])[0]) == bits(twelve[k])
    assert len({str(bits(beam)) for beam in twelve}) > 8  # and beams do differ


def test_the_settings_own_radius_is_not_used():
    world, config = short(8)
    other = config.model_copy(update={"emitter": EmitterConfig(radius=0.02)})
    assert bits(listen(world, config, [0.0088])[0]) == bits(listen(world, other, [0.0088])[0])


@pytest.mark.parametrize("steps", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_the_band_recorder_separates_beams_and_draws_noise_per_world(steps):
    world, config = short(steps, emitter=EmitterConfig(taper=0.2))
    wide, narrow = listen(world, config, [0.0025, 0.025])
    assert bits(listen(world, config, [0.025])[0]) == bits(narrow)
    assert bits(listen(world, config, [0.025], iteration=1)[0]) != bits(narrow)
    assert bits(wide) != bits(narrow)


def test_a_narrower_beam_ranges_fewer_landmarks():
    world, config = short(200)
    count = [
        sum(np.count_nonzero(~np.isnan(heard.rows.range)) for heard in beam)
        for beam in listen(world, config, [0.0025, 0.0088, 0.025])
    ]
    assert count[0] > 1.5 * count[1] > 1.5 * 1.5 * count[2] > 0


def test_the_truth_is_used_only_to_label_detections():
    world, config = short(40)
    as_is = listen(world, config, [0.0088])[0]

    def off_by_a_little(found, arrivals, *args, **settings):
        moved = replace(
            arrivals, delay=arrivals.delay + 1e-9, bearing=wrap(arrivals.bearing + 1e-7)
        )
        return label_detections(found, moved, *args, **settings)

    assert bits(listen(world, config, [0.0088], oracle=off_by_a_little)[0]) == bits(as_is)

    def to_none(found, *_, **__):
        return np.full(found.face.size, UNLABELLED)

    deaf = listen(world, config, [0.0088], oracle=to_none)[0]
    assert all(heard.rows.landmark.size == 0 for heard in deaf)
    assert sum(heard.clutter for heard in deaf) > sum(heard.clutter for heard in as_is)


def test_unlabelled_rows_leave_the_labelled_rows_unchanged():
    world, config = short(40)
    (labelled,) = listen(world, config, [0.0088])
    (both,) = listen(world, config, [0.0088], labels=False)
    assert [heard.unlabelled for heard in labelled] == [None] * len(labelled)
    assert bits([replace(heard, unlabelled=None) for heard in both]) == bits(labelled)
    for one, other in zip(labelled, both, strict=True):
        rows = other.unlabelled
        assert set(rows.landmark.tolist()) <= {UNLABELLED}
        assert rows.callers.size == 0
        # What the oracle names is among what is heard: to the bit where one face heard it alone.
        heard = set(zip(rows.caller.tolist(), rows.bearing.tolist(), strict=True))
        named = list(zip(one.rows.caller.tolist(), one.rows.bearing.tolist(), strict=True))
        assert sum(row in heard for row in named) > 0.6 * len(named)
        assert rows.landmark.size >= one.rows.landmark.size


def test_unlabelled_rows_mark_the_direct_call_and_share_excess_paths():
    world, config = short(40)
    (heard,) = listen(world, config, [0.0088], labels=False)
    beacon, marked, same, paths = world.callers[1], 0, 0, 0
    for frame in heard:
        rows, named = frame.unlabelled, frame.rows
        assert rows.direct[0] == -1, "the vehicle hears no direct call of its own"
        if rows.direct[1] >= 0:
            marked += 1
            x, y, heading = world.path[np.searchsorted(world.time, rows.time)]
            east, north = np.asarray(beacon.place) - (x, y)
            bearing = wrap(np.arctan2(north, east) - heading)
            assert abs(wrap(rows.bearing[rows.direct[1]] - bearing)) < 0.1
        known = set(np.round(named.excess_path[~np.isnan(named.excess_path)], 9).tolist())
        found = set(np.round(rows.excess_path[~np.isnan(rows.excess_path)], 9).tolist())
        same, paths = same + len(known & found), paths + len(known)
    assert marked == len(heard)
    assert same > 0.6 * paths > 30


def found_by_two_faces(late, off=0.0):
    """Return a finder of one call that two faces hear, the second so much later [s] and off."""
    angle = np.radians([20.0, -70.0]) + np.array([0.0, off])
    return lambda matched, finder, **timing: Detections(
        face=np.array([0, 1]), caller=np.zeros(2, dtype=np.int64), angle=angle,
        bearing=angle + np.array([0.0, 0.5 * np.pi]), delay=np.array([0.02, 0.02 + late]),
        power=np.array([9.0, 8.0]),
    )  # fmt: skip


@pytest.mark.parametrize(("pulse", "share"), [(2.8e-3, 0.25), (2.0e-3, 0.25), (2.8e-3, 0.1)])
def test_without_labels_two_faces_hear_one_echo_within_the_gates_share_of_a_call(pulse, share):
    gates = MatchingConfig(delay_gate=share)
    world, config = short(4, matching=gates, emitter=EmitterConfig(call_duration=pulse))
    for late, echoes in ((0.99 * share * pulse, 1), (1.01 * share * pulse, 2)):
        ((heard,),) = listen(world, config, [0.0088], labels=False, find=found_by_two_faces(late))
        assert heard.unlabelled.landmark.size == echoes


@pytest.mark.parametrize("gate", [0.02, 0.1, 0.3])
def test_without_labels_two_faces_hear_one_echo_within_the_gate_of_its_bearing(gate):
    world, config = short(4, matching=MatchingConfig(bearing_gate=gate))
    for off, echoes in ((0.99 * gate, 1), (1.01 * gate, 2)):
        finder = found_by_two_faces(0.0, off)
        ((heard,),) = listen(world, config, [0.0088], labels=False, find=finder)
        assert heard.unlabelled.landmark.size == echoes


@pytest.mark.parametrize("averaging", ["plain", "weighted"])
def test_faces_are_averaged_as_the_settings_ask(averaging):
    world, config = short(4, detection=DetectionConfig(averaging=averaging))

    def one_landmark(found, *_, **__):
        return np.full(found.face.size, 7)

    hears = {"oracle": one_landmark, "find": found_by_two_faces(0.0, off=0.04)}
    ((heard,),) = listen(world, config, [0.0088], **hears)
    # At 20 and at -67.7 degrees off the faces' normals: inverse variances go with cos^2.
    weight = np.cos([np.radians(20.0), np.radians(-70.0) + 0.04]) ** 2
    share = 0.5 if averaging == "plain" else weight[1] / weight.sum()
    assert heard.rows.bearing == pytest.approx([np.radians(20.0) + share * 0.04], abs=1e-5)


@pytest.mark.parametrize(("margin_db", "noise_db", "blocks"), [(0.0, 0.0, 14), (6.0, 4.0, 10)])
def test_the_oracle_receives_gates_call_duration_and_faintest_level(margin_db, noise_db, blocks):
    gates = MatchingConfig(margin_db=margin_db, delay_gate=0.2)
    settings = {
        "matching": gates,
        "receiver": ReceiverConfig(noise_level_db=noise_db),
        "emitter": EmitterConfig(call_duration=blocks * BLOCK),
    }
    (world, config), told = short(4, **settings), []

    def listening(found, arrivals, layout, gates, *, pulse, faintest_db):
        told.append((gates, pulse, faintest_db))
        return np.full(found.face.size, UNLABELLED)

    listen(world, config, [0.0088], oracle=listening)
    # A call at 10 elements that reaches the threshold on average, less the margin.
    per_sample = (FINDER.threshold - 10.0) / 10.0 / (40.0 * blocks)
    expected = 10.0 * np.log10(per_sample) + noise_db - margin_db
    assert told == [(gates, blocks * BLOCK, pytest.approx(expected, abs=1e-9))]


def test_the_callers_tones_and_levels_override_the_settings():
    world, config = short(8)
    vehicle, beacon = world.callers
    callers = (
        replace(vehicle, frequency=45e3, level_db=55.0),
        replace(beacon, frequency=20e3, level_db=48.0),
    )
    settled = {
        "emitter": EmitterConfig(frequency=45e3, level_db=55.0),
        "beacon": BeaconConfig(frequency=20e3, level_db=48.0),
    }
    other = replace(world, callers=callers)
    radii = [0.0088, 0.025]
    one, two = (listen(other, c, radii) for c in (config, config.model_copy(update=settled)))
    assert [bits(beam) for beam in one] == [bits(beam) for beam in two]
    assert [bits(beam) for beam in one] != [bits(beam) for beam in listen(world, config, radii)]


def noise_heard(config, iteration=0):
    """Return the matched filter's output at each frame and beam of a world in which all is mute."""
    world = draw_scenario(config, np.random.default_rng(7))
    mute, heard = tuple(replace(caller, level_db=-300.0) for caller in world.callers), []

    def kept(matched, finder, cut=0, **timing):
        matched = np.ascontiguousarray(matched[cut : len(matched) - cut])
        apart = matched[:: timing["pulse"]]  # calls that do not overlap
        heard.append(apart.ravel()[:4000].copy())
        return find_calls(matched, finder, **timing)

    listen(replace(world, callers=mute), config, [0.0025, 0.025], iteration=iteration, find=kept)
    return heard


@pytest.mark.parametrize("taper", [0.0, 0.2])
def test_every_frame_world_and_seed_has_independent_noise_for_all_beams(taper):
    alone = ScenarioConfig(steps=8, landmarks=0)
    config = Config(emitter=EmitterConfig(taper=taper), scenario=alone)
    drawn = [
        noise_heard(config),
        noise_heard(config, iteration=1),
        noise_heard(config.model_copy(update={"seed": 8})),
    ]
    own = [wide for wide, _, later, _ in drawn for wide in (wide, later)]
    for wide, narrow in ((d[2 * i], d[2 * i + 1]) for d in drawn for i in (0, 1)):
        np.testing.assert_allclose(wide, narrow, atol=1e-9)
    for i, one in enumerate(own):
        for other in own[:i]:
            size = min(one.size, other.size)
            assert abs(np.vdot(one[:size], other[:size])) < 4.9 * np.sqrt(size)


def errors_of(config, worlds):
    """Return the bearing errors of both tones and the range errors of whole missions."""
    own, other, late = [], [], []
    for seed in range(worlds):
        world = draw_scenario(config, np.random.default_rng(seed))
        (beam,) = listen(world, config, [0.0088], iteration=seed)
        _, places = standing_landmarks(world)
        for heard in beam:
            rows = heard.rows
            pose = world.path[np.searchsorted(world.time, rows.time)]
            distance, bearing = range_and_bearing(pose, places[rows.landmark - 1])
            off = wrap(rows.bearing - bearing)
            own.append(off[rows.caller == OWN])
            other.append(off[rows.caller != OWN])
            late.append(rows.range - distance)
    columns = (np.concatenate(column) for column in (own, other, late))
    return [column[~np.isnan(column)] for column in columns]


def test_errors_of_detections_are_a_few_hundredths_of_a_radian_and_centimetres():
    own, other, late = errors_of(CONFIG, 1)
    rms = [np.sqrt(np.mean(error**2)) for error in (own, other, late)]
    assert 0.005 < rms[0] < 0.03
    assert 0.01 < rms[1] < 0.05
    assert 0.005 < rms[2] < 0.04
    assert all(abs(np.mean(error)) < 0.2 * np.std(error) for error in (own, other))


def test_ranges_bearings_and_beams_use_the_configured_speed_of_sound():
    config = Config(air=AirConfig(speed_of_sound=390.0), scenario=ScenarioConfig(steps=200))
    own, other, late = errors_of(config, 1)
    assert late.size > 20
    rms = [np.sqrt(np.mean(error**2)) for error in (own, other, late)]
    assert (rms[0] < 0.03, rms[1] < 0.05, rms[2] < 0.04) == (True, True, True), rms

    def piston(arrivals, radius, **_):
        return through_piston(arrivals, radius=radius, frequency=35e3, speed_of_sound=390.0)

    world = draw_scenario(config, np.random.default_rng(7))
    settled, said = (listen(world, config, [0.02], **own) for own in ({}, {"beam": piston}))
    assert bits(settled[0]) == bits(said[0])


def test_the_off_axis_loss_follows_the_settings():
    config = Config(scenario=ScenarioConfig(steps=80))
    mild = config.model_copy(update={"emitter": EmitterConfig(directivity_law="power")})
    world = draw_scenario(config, np.random.default_rng(7))

    def forgiving(arrivals, **piston):
        return through_piston(arrivals, **piston, off_axis="power")

    settled, said = listen(world, mild, [0.02]), listen(world, config, [0.02], beam=forgiving)
    assert bits(settled[0]) == bits(said[0])
    assert bits(settled[0]) != bits(listen(world, config, [0.02])[0])


def frames(seed, every):
    """Yield the arrivals of a mission's emissions and the blocks of their noise."""
    world = draw_scenario(CONFIG, np.random.default_rng(seed))
    for k in range(4 * every, len(world.path), 4 * every):
        velocity = (world.path[k, :2] - world.path[k - 1, :2]) / CONFIG.scenario.step
        emission = arrivals_of_emission(
            world.path[k], velocity, world.landmarks, world.callers, CONFIG
        )
        heard = through_piston(emission, radius=0.0088, frequency=35e3, speed_of_sound=343.0)
        key = stream_key(seed, 0, "what the call hides", k)
        yield heard, noise_blocks(blocks_to_hear(emission, SETTLED), LAYOUT, SETTLED, key)


def detected(blocks, finder=FINDER):
    matched = filter_blocks(blocks, pulse=SETTLED.pulse, block=SETTLED.block, noise_std=1.0)
    return detect(matched, finder, start=SETTLED.pulse * BLOCK, interval=BLOCK, pulse=SETTLED.pulse)


def landmarks(blocks, arrivals, tone, finder=FINDER):
    """Return the landmarks that a tone shows in a recording, the beacon apart."""
    found = detected(blocks, finder)
    label = label_detections(
        found, arrivals, LAYOUT, CONFIG.matching, pulse=2.8e-3, faintest_db=FAINTEST
    )
    return set(label[(found.caller == tone) & (label != UNLABELLED)].tolist()) - {BEACON}


def with_echoes(blocks, arrivals, rows):
    heard = blocks.copy()
    add_echo_blocks(heard, arrivals_at(arrivals, rows), LAYOUT, SETTLED)
    return heard


def census(worlds, every):
    """Count per frame what the beacon's direct call and the guard against leakage do."""
    count, deaf = Counter(), FINDER._replace(leakage=0.0)
    for seed in range(worlds):
        for arrivals, noise in frames(seed, every):
            call = (arrivals.caller != VEHICLE) & (arrivals.landmark == BEACON)
            alone = with_echoes(noise, arrivals, call)
            count["frames"] += 1
            for name, blocks, finder in (
                ("false in noise", noise, FINDER),
                ("false beside the call", alone, FINDER),
                ("false without the guard", alone, deaf),
            ):
                count[name] += 0 in detected(blocks, finder).caller
            quiet = with_echoes(noise, arrivals, ~call)
            full = with_echoes(quiet, arrivals, call)
            for tone, name in enumerate(("active", "passive")):
                without, with_ = (landmarks(b, arrivals, tone) for b in (quiet, full))
                count[f"{name} without the call"] += len(without)
                count[f"{name} hidden"] += len(without - with_)
            # Each source in its own tone alone: a world without leakage.
            clean = noise.copy()
            for tone in range(2):
                part = with_echoes(np.zeros_like(noise), arrivals, arrivals.caller == tone)
                clean[:, :, tone] += part[:, :, tone]
            guarded, open_ = (landmarks(clean, arrivals, 0, f) for f in (FINDER, deaf))
            count["active without leakage"] += len(open_)
            count["active given up"] += len(open_ - guarded)
    return {name: number / count["frames"] for name, number in count.items()}


def test_the_beacons_own_call_makes_hardly_a_false_detection_and_hides_few_echoes():
    rate = census(worlds=2, every=6)
    assert rate["false beside the call"] < 0.06 < 0.1 < rate["false without the guard"]
    assert rate["active hidden"] < 0.03 * rate["active without the call"]
    assert 0.0 < rate["passive hidden"] < 0.06 * rate["passive without the call"]
    assert rate["active given up"] < 0.03 * rate["active without leakage"]


@pytest.mark.parametrize(("elements", "spacing"), [(8, 0.0049), (16, 0.0049), (10, 0.0030)])
def test_a_layout_of_ones_own_hears_as_the_settings_own_of_that_size_do(elements, spacing):
    world, config = short(40)
    place = (np.arange(elements) - 0.5 * (elements - 1)) * spacing
    given = listen(world, config, (0.0088,), layout=replace(LAYOUT, position=place))
    receiver = ReceiverConfig(elements=elements, spacing=spacing)
    settled = listen(world, config.model_copy(update={"receiver": receiver}), (0.0088,))
    assert bits(given[0]) == bits(settled[0])
    assert sum(heard.rows.landmark.size for heard in given[0]) > 100


def test_beam_and_finder_of_ones_own_are_used():
    world, config = short(40)

    def deaf(arrivals, **piston):
        own = arrivals.caller == VEHICLE
        return replace(arrivals, level_db=np.where(own, -300.0, arrivals.level_db))

    def first_face(matched, detector, **timing):
        found = detect(matched, detector, **timing)
        return Detections(**{
            field.name: getattr(found, field.name)[found.face == 0]
            for field in fields(found) if field.name != "direct"
        })  # fmt: skip

    (silent,) = listen(world, config, (0.0088,), beam=deaf)
    assert all(np.isnan(heard.rows.range).all() for heard in silent)
    (ahead,) = listen(world, config, (0.0088,), find=first_face)
    bearings = np.concatenate([heard.rows.bearing for heard in ahead])
    assert np.max(np.abs(bearings)) <= np.radians(75.0) + 1e-9
    assert sum(heard.rows.landmark.size for heard in ahead) > 20


@pytest.mark.slow
def test_over_whole_missions_the_call_costs_a_fortieth_of_the_passive_echoes_at_most():
    # Of 2.9 active landmarks a frame it hides 0.01 to 0.02 and the guard gives up 0.04; of 21
    # passive ones it hides 0.4 to 0.5. Where it leaks just under the guard, its leak lifts the
    # noise over the threshold: in one frame in a hundred, against one in two hundred by noise.
    rate = census(worlds=6, every=1)
    assert rate["false in noise"] < 0.01
    assert rate["false beside the call"] < 0.03
    assert rate["false without the guard"] > 0.1
    assert rate["active hidden"] < 0.01 * rate["active without the call"]
    assert rate["passive hidden"] < 0.025 * rate["passive without the call"]
    assert rate["active given up"] < 0.02 * rate["active without leakage"]


def test_a_mission_hears_the_doppler_shift_of_the_speed_that_it_drives_at():
    straight = ScenarioConfig(steps=24, steering=0.0, speed=0.6, landmarks=9)
    still = MotionConfig(speed_std=0.0, steering_std=0.0)
    world, config = short(24, motion=still, scenario=straight)
    heard = []

    def watched(arrivals, **piston):
        heard.append(arrivals)
        return through_piston(arrivals, **piston)

    listen(world, config, [0.0088], beam=watched)
    (arrivals,) = heard  # of all six frames
    own, c = arrivals.caller == VEHICLE, config.air.sound_speed
    closing = straight.speed * np.cos(arrivals.bearing)
    shifted = np.where(own, 35e3 * (c + closing) / (c - closing), 30e3 * (c + closing) / c)
    np.testing.assert_allclose(arrivals.frequency, shifted, rtol=1e-12)
    assert np.ptp(closing) > 0.5  # a speed divided by four would show


def chorus(world, moving):
    """Return a world with a third caller, that stands or rounds the centre."""
    turn = 0.05 * world.time if moving else np.zeros(1)
    path = 12.0 * np.column_stack((np.cos(turn), np.sin(turn)))
    whistle = Caller(
        name="whistle", frequency=25e3, level_db=42.8, place=path if moving else path[0]
    )
    return replace(world, callers=(*world.callers, whistle))


@pytest.mark.parametrize(
    ("taper", "moving"),
    [
        (0.0, True),
        (0.2, False),
        pytest.param(0.0, False, marks=pytest.mark.slow),
        pytest.param(0.2, True, marks=pytest.mark.slow),
    ],
)
def test_a_third_caller_is_heard_where_it_is_by_either_engine(taper, moving):
    alone = ScenarioConfig(steps=8, landmarks=0)  # nothing sounds into its direct call
    world, config = short(8, emitter=EmitterConfig(taper=taper), scenario=alone)
    three = chorus(world, moving)
    (beam,) = listen(three, config, [0.0088])
    for heard in beam:
        rows = heard.rows
        k = np.searchsorted(world.time, rows.time)
        place = three.callers[2].place[k] if moving else three.callers[2].place
        _, bearing = range_and_bearing(world.path[k], place[None])
        (found,) = rows.bearing[(rows.landmark == 2) & (rows.caller == 2)]
        assert abs(wrap(found - bearing[0])) < 0.02


def test_a_fixed_third_caller_equals_a_constant_path_to_the_bit():
    world, config = short(16)
    three = chorus(world, moving=False)
    tied = replace(three.callers[2], place=np.tile(three.callers[2].place, (17, 1)))
    constant = replace(three, callers=(*world.callers, tied))
    radii = [0.0025, 0.025]
    one, two = listen(three, config, radii), listen(constant, config, radii)
    assert [bits(beam) for beam in one] == [bits(beam) for beam in two]


def test_a_path_that_does_not_fit_the_scenario_is_refused():
    world, config = short(8)
    boat = Caller(name="boat", frequency=25e3, level_db=42.8, place=np.zeros((8, 2)))
    with pytest.raises(InputError, match=r"caller boat: .*expected \(9, 2\)"):
        listen(replace(world, callers=(*world.callers, boat)), config, [0.0088])


def test_echoes_of_a_trunk_are_labelled_and_measured_from_its_surface():
    world, config = short(40)
    trunk = np.arange(50) < 25
    bodies = Bodies(
        radius=np.where(trunk, 0.3, np.nan), shape=np.where(trunk, "cylinder", "sphere")
    )
    (heard,) = listen(replace(world, bodies=bodies), config, (0.0025,))
    labels = np.concatenate([frame.rows.landmark for frame in heard])
    ranges = np.concatenate([frame.rows.range for frame in heard])
    step = np.repeat(range(4, 41, 4), [frame.rows.landmark.size for frame in heard])
    own = np.isfinite(ranges) & (labels > 0) & (labels < BEACON)
    offset = world.landmarks[labels[own] - 1] - world.path[step[own], :2]
    nearer, sized = np.hypot(*offset.T) - ranges[own], trunk[labels[own] - 1]
    assert min(sized.sum(), (~sized).sum()) > 10
    assert nearer[sized].mean() == pytest.approx(0.3, abs=0.02)
    assert nearer[~sized].mean() == pytest.approx(0.0, abs=0.02)
