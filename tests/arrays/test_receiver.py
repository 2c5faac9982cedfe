"""Recordings: block sums against samples, noise, sampling, and real samples of block sums."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipistrelle.acoustics.arrivals import arrivals_of_emission
from pipistrelle.acoustics.paths import VEHICLE, Caller, callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks, real_samples
from pipistrelle.arrays.sampling import blocks_to_hear, sampling
from pipistrelle.config import Config, InputError, ReceiverConfig
from reference.echoes import BEACON, CALLERS, CONFIG, SAMPLES, SETTLED, SQUARE, sounds
from reference.samples import record_samples

law = settings(deadline=None, max_examples=40)
SIGMAS = 4.9  # chance: one in a million


def one(delay, bearing=0.3, shift=1.0, source=BEACON, level_db=0.0):
    """Return a single arrival, its frequency shifted by a factor."""
    return sounds(delay, bearing, level_db + 10.0 * np.log10(SAMPLES), source, shift)


def block_sums(samples, settled=SETTLED):
    """Return the dense record's sums over blocks, per tone: the definition."""
    n = settled.pulse * settled.block + np.arange(samples.shape[0])
    turned = [
        samples * np.exp(-2j * np.pi * tone * n / settled.rate)[:, None, None]
        for tone in settled.tones
    ]
    blocks = samples.shape[0] // settled.block
    shape = (blocks, settled.block, *samples.shape[1:])
    return np.stack([each.reshape(shape).sum(axis=1) for each in turned], axis=2)


def both(arrivals, blocks, layout=SQUARE, settled=SETTLED):
    dense = block_sums(record_samples(blocks, arrivals, layout, settled, None), settled)
    fast = np.zeros_like(dense)
    add_echo_blocks(fast, arrivals, layout, settled)
    return fast, dense


@given(
    delay=st.floats(0.0, 12e-3),
    bearing=st.floats(-np.pi, np.pi),
    shift=st.floats(0.7, 1.4),
    source=st.sampled_from([VEHICLE, BEACON]),
)
@example(delay=0.0, bearing=0.0, shift=1.0, source=VEHICLE)  # over before the first block
@example(delay=2.8e-3, bearing=0.0, shift=1.0, source=VEHICLE)  # whole blocks
@example(delay=2.8e-3 + 5e-6, bearing=0.0, shift=1.0, source=BEACON)  # a sample off
@example(delay=8.4e-3 - 5e-6, bearing=0.0, shift=1.0, source=BEACON)  # one sample, at the end
@example(delay=2.8e-3, bearing=np.pi / 2, shift=0.7, source=BEACON)  # long, along two faces
@law
def test_block_sums_of_an_arrival_match_its_samples(delay, bearing, shift, source):
    fast, dense = both(one(delay, bearing, shift, source), 28)
    assert np.abs(fast - dense).max() <= 1e-10 * SETTLED.block  # a whole block of amplitude 1


@pytest.mark.parametrize("seed", range(4))
def test_block_sums_of_a_whole_world_match_its_samples(seed):
    rng = np.random.default_rng(seed)
    pose = np.array([*rng.uniform(-9.0, 9.0, 2), rng.uniform(-np.pi, np.pi)])
    landmarks, beacon = rng.uniform(-18.0, 18.0, (50, 2)), rng.uniform(-10.0, 10.0, 2)
    callers, velocity = callers_of(CONFIG, beacon), rng.uniform(-1.0, 1.0, 2)
    emission = arrivals_of_emission(pose, velocity, landmarks, callers, CONFIG)
    fast, dense = both(emission, blocks_to_hear(emission, SETTLED))
    assert np.abs(fast - dense).max() <= 1e-10 * np.abs(dense).max()


@pytest.mark.parametrize("source", [VEHICLE, BEACON])
@pytest.mark.parametrize("shift", [0.8, 1.0, 1.25])
def test_a_call_received_at_a_higher_frequency_is_shorter(shift, source):
    heard = one(4e-3, bearing=0.0, shift=shift, source=source)
    samples = record_samples(28, heard, SQUARE, SETTLED, None)
    count = np.count_nonzero(samples[:, 0, 0])
    called = CONFIG.emitter.call_duration * SETTLED.tones[source] / heard.frequency[0]  # T f / f'
    assert count == pytest.approx(called * SETTLED.rate, abs=1.0)


def test_without_the_doppler_shift_the_sums_would_differ():
    fast, _ = both(one(9e-3, shift=1.0), 40)
    _, dense = both(one(9e-3, shift=1.0 + 2 * 0.75 / 343.0), 40)
    assert np.abs(fast - dense).max() > 0.1 * SETTLED.block


@given(bearing=st.floats(-np.pi, np.pi))
@law
def test_a_face_receives_only_arrivals_within_90_degrees_of_its_normal(bearing):
    fast, _ = both(one(5e-3, bearing), 28)
    hears = np.abs(fast).max(axis=(0, 2, 3)) > 0.0
    assert hears.tolist() == (np.cos(bearing - SQUARE.normal) >= 0.0).tolist()
    assert hears.sum() in (2, 3)  # 3 where it comes from straight before a face


def test_nothing_is_heard_while_the_vehicle_calls():
    early, late = one(1e-3), one(2.8e-3)
    first, second = both(early, 28)[0], both(late, 28)[0]
    assert not first[5:].any()  # 1 ms of the call is left after the blanking
    np.testing.assert_allclose(np.abs(first[:5, 0, 1]), 40.0, rtol=1e-12)
    np.testing.assert_allclose(np.abs(second[:14, 0, 1]), 40.0, rtol=1e-12)


@given(delay=st.floats(2.8e-3, 0.3), shift=st.floats(0.995, 1.005))
@law
def test_the_recording_ends_with_the_last_arrival(delay, shift):
    heard = one(delay, shift=shift)
    blocks = blocks_to_hear(heard, SETTLED)
    longer = np.zeros((blocks + 5, 4, 2, 10), dtype=complex)
    add_echo_blocks(longer, heard, SQUARE, SETTLED)
    assert not longer[blocks:].any()
    assert longer[blocks - 3 :].any() or blocks == 2 * SETTLED.pulse


def test_an_empty_or_near_world_is_heard_for_two_calls():
    nothing = one(0.0)
    assert blocks_to_hear(nothing, SETTLED) == 28


def test_levels_are_amplitudes_in_decibels_and_arrivals_add():
    loud, soft = both(one(5e-3, level_db=20.0), 28)[0], both(one(5e-3), 28)[0]
    np.testing.assert_allclose(loud, 10.0 * soft, rtol=1e-12)
    signal = loud.copy()
    add_echo_blocks(signal, one(5e-3), SQUARE, SETTLED)
    np.testing.assert_allclose(signal, 11.0 * soft, rtol=1e-12)


def test_block_noise_has_forty_times_the_variance_of_a_sample_in_each_tone():
    config = Config(receiver=ReceiverConfig(noise_level_db=6.0))
    settled = sampling(config, callers_of(config, np.zeros(2)))
    noise = noise_blocks(5000, SQUARE, settled, key=3)
    variance = np.mean(np.abs(noise) ** 2, axis=(0, 3)) / (40.0 * 10.0**0.6)
    assert np.abs(variance - 1.0).max() < SIGMAS / np.sqrt(5000 * 10)
    samples = record_samples(2000, one(0.0), SQUARE, settled, np.random.default_rng(3))
    sums = block_sums(samples, settled)
    variance = np.mean(np.abs(sums) ** 2, axis=(0, 3)) / (40.0 * 10.0**0.6)
    assert np.abs(variance - 1.0).max() < SIGMAS / np.sqrt(2000 * 10)


def test_sampled_and_drawn_noise_have_independent_block_sums():
    face = square_of_four(CONFIG.receiver)
    sampled = block_sums(record_samples(1500, one(0.0), face, SETTLED, np.random.default_rng(5)))
    for noise in (sampled, noise_blocks(1500, face, SETTLED, key=5)):
        flat = noise.reshape(1500, -1) / np.sqrt(40.0)
        for lag in (0, 1, 2):
            product = flat[lag:].T @ flat[: 1500 - lag].conj() / np.sqrt(1500)
            if lag == 0:
                np.fill_diagonal(product, 0.0)
            assert np.abs(product).max() < np.sqrt(np.log(product.size / 1e-6))


def test_only_tones_on_whole_bins_are_uncorrelated():
    # 32 kHz is no whole bin of a block: its sums would carry part of 30 kHz's noise.
    samples = record_samples(1500, one(0.0), SQUARE, SETTLED, np.random.default_rng(5))
    n = np.arange(samples.shape[0])
    parts = [
        (samples[:, 0, 0] * np.exp(-2j * np.pi * f * n / 200e3)).reshape(-1, 40).sum(axis=1)
        for f in (30e3, 35e3, 32e3)
    ]
    whole = abs(np.mean(parts[0] * parts[1].conj())) / 40.0
    broken = abs(np.mean(parts[0] * parts[2].conj() * np.exp(-2j * np.pi * 2e3 * n[::40] / 200e3)))
    assert whole < SIGMAS / np.sqrt(1500)
    assert broken / 40.0 > 3 * SIGMAS / np.sqrt(1500)


@given(short=st.integers(1, 30), more=st.integers(0, 30))
@law
def test_a_blocks_noise_does_not_depend_on_how_many_are_drawn(short, more):
    one_, two = (noise_blocks(n, SQUARE, SETTLED, key=9) for n in (short, short + more))
    assert one_.tobytes() == two[:short].tobytes()


@pytest.mark.parametrize(
    ("settings", "blocks"),
    [
        ({}, (40, 14)),
        ({"receiver": {"sample_rate": 250e3}}, (50, 14)),
        ({"emitter": {"frequency": 36e3}}, (40, 14)),
        ({"emitter": {"call_duration": 2.9e-3}}, (58, 10)),
        ({"emitter": {"call_duration": 1e-3}, "receiver": {"sample_rate": 125e3}}, (25, 5)),
        ({"receiver": {"sample_rate": 192e3}}, (49, 11)),
        ({"receiver": {"sample_rate": 1e6}, "beacon": {"frequency": 31234.5}}, (200, 14)),
    ],
)
def test_blocks_hold_a_whole_call_whatever_tone_and_rate(settings, blocks):
    config = Config.model_validate(settings)
    settled = sampling(config, callers_of(config, np.zeros(2)))
    assert (settled.block, settled.pulse) == blocks
    assert not settled.banded
    assert settled.pulse * settled.interval >= config.emitter.call_duration - 1e-12
    arrival = one(3.217e-3)
    fast, dense = both(arrival, 20, square_of_four(config.receiver), settled)
    assert np.abs(fast - dense).max() <= 1e-10 * settled.block


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"receiver": {"sample_rate": 2e6 + 1}},
         "receiver.sample_rate: found 2e.06 Hz, expected a multiple of 5000 Hz, or 8000 to 1e.06"),
        ({"receiver": {"sample_rate": 44.1e3}}, "emitter: found a tone of .* of 44100 Hz"),
        ({"emitter": {"call": "sweep", "band": (90e3, 120e3)}}, "emitter: found a sweep of"),
        ({"emitter": {"call": "sweep", "band": (31e3, 29e3)}}, "beacon: found a call that is"),
        ({"beacon": {"frequency": 35.1e3}}, "beacon: found a call that is 77% the vehicle's"),
    ],
)  # fmt: skip
def test_calls_that_samples_cannot_represent_or_separate_are_refused(settings, message):
    config = Config.model_validate(settings)
    with pytest.raises(InputError, match=f"^{message}"):
        sampling(config, callers_of(config, np.zeros(2)))


THREE = (*CALLERS, Caller(name="whistle", frequency=25e3, level_db=40.0, place=np.ones(2)))


@pytest.mark.parametrize("seed", range(3))
def test_block_sums_of_two_fixed_and_one_moving_caller_match_their_samples(seed):
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-18.0, 18.0, (20, 2))
    callers = [
        CALLERS[VEHICLE],
        *(replace(caller, place=rng.uniform(-10.0, 10.0, 2)) for caller in THREE[1:]),
    ]
    callers[2] = replace(callers[2], velocity=rng.uniform(-3.0, 3.0, 2))
    pose = np.array([*rng.uniform(-9.0, 9.0, 2), rng.uniform(-np.pi, np.pi)])
    settled = sampling(CONFIG, callers)
    emission = arrivals_of_emission(pose, np.array([0.5, 0.5]), landmarks, callers, CONFIG)
    fast, dense = both(emission, blocks_to_hear(emission, settled), settled=settled)
    assert fast.shape[2] == 3
    assert np.abs(fast - dense).max() <= 1e-10 * np.abs(dense).max()
    # Callers in another order: the same sums, tone by tone, but for the order of additions.
    turned = [callers[0], callers[2], callers[1]]
    again = sampling(CONFIG, turned)
    other = arrivals_of_emission(pose, np.array([0.5, 0.5]), landmarks, turned, CONFIG)
    sums = np.zeros_like(fast)
    add_echo_blocks(sums, other, SQUARE, again)
    assert np.abs(sums[:, :, [0, 2, 1]] - fast).max() <= 1e-12 * np.abs(fast).max()


@pytest.mark.parametrize(
    ("frequency", "message"),
    [
        (35e3, "whistle.frequency: found 35000 Hz, the vehicle's own; expected another"),
        (30e3, "whistle.frequency: found 30000 Hz, the beacon's own; expected another"),
        (235e3, "whistle.frequency: found 235000 Hz, the vehicle's own 35000 Hz once it is"),
        (430e3, "whistle.frequency: found 430000 Hz, the beacon's own 30000 Hz once it is"),
        (np.nan, "caller whistle: frequency: found nan, expected one finite number"),
    ],
)
def test_an_inseparable_third_tone_is_refused_with_the_callers_name(frequency, message):
    with pytest.raises(InputError, match=f"^{message}"):
        sampling(CONFIG, (*CALLERS, replace(THREE[2], frequency=frequency)))


def test_tones_that_differ_by_the_sampling_rate_share_a_bin():
    n = np.arange(SETTLED.block)
    low, high = (np.exp(2j * np.pi * tone * n / SETTLED.rate) for tone in (35e3, 235e3))
    assert np.abs(low - high).max() < 1e-12
    settled = sampling(CONFIG, (*CALLERS, replace(THREE[2], frequency=240e3)))
    assert settled.tones.tolist() == [35e3, 30e3, 240e3]  # above the rate, but a bin of its own


def test_eight_callers_are_heard_and_a_ninth_is_refused():
    chorus = [replace(THREE[2], frequency=5e3 * k) for k in (1, 2, 3, 4, 5, 8, 9)]
    assert sampling(CONFIG, [*CALLERS, *chorus[:6]]).tones.size == 8
    with pytest.raises(InputError, match="callers: found 9, expected 1 to 8"):
        sampling(CONFIG, [*CALLERS, *chorus])


# Real samples

LENGTH = 20_000


def recorded(level_db=30.0):
    sums = noise_blocks(300, SQUARE, SETTLED, key=5)
    arrivals = one(0.0123, 0.3, 35_070.0 / 35e3, VEHICLE, level_db)
    add_echo_blocks(sums, arrivals, SQUARE, SETTLED)
    rng = np.random.default_rng(3)
    return sums, real_samples(sums, arrivals, SQUARE, SETTLED, LENGTH, rng, leak=50.0)


def fourier(samples, tone, first=560):
    """Twice the transform of each block, by its definition."""
    blocks = samples[first : first + (len(samples) - first) // 40 * 40].astype(float)
    wave = np.exp(-2j * np.pi * tone * np.arange(40) / 200e3)
    return 2.0 * np.einsum("bnm,n->bm", blocks.reshape(-1, 40, samples.shape[1]), wave)


def test_twice_the_transform_of_each_block_is_its_block_sum():
    sums, samples = recorded()
    for c, tone in enumerate(SETTLED.tones):
        found = fourier(samples, tone)[:300].reshape(300, 4, 10)
        np.testing.assert_allclose(found, sums[:, :, c], atol=1e-3 * abs(sums).max() / 100)


def test_noise_is_white_at_all_frequencies_and_after_the_last_block():
    _, samples = recorded(level_db=-300.0)
    noise = 40 * SETTLED.noise_std**2  # of a sum
    for tone in (10e3, 30e3, 35e3, 60e3):
        for part in (slice(0, 300), slice(300, None)):
            power = np.abs(fourier(samples, tone)[part]) ** 2
            assert abs(power.mean() / noise - 1.0) < 5.0 / np.sqrt(power.size)


def test_a_microphone_receives_only_the_call_while_it_lasts():
    _, samples = recorded()
    wave = 50.0 * np.cos(2.0 * np.pi * 35e3 * np.arange(560) / 200e3)
    rest = samples[:560] - wave[:, None]
    assert abs(rest.std() / (0.5 * SETTLED.noise_std) - 1.0) < 5.0 / np.sqrt(2 * rest.size)
