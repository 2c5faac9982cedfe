"""Block sums and full-rate samples: one contract, and what the finer grid would gain."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import ks_2samp

from pipistrelle.acoustics.arrivals import arrivals_of_emission
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.arrays.layout import Layout
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks, record_samples
from pipistrelle.arrays.sampling import blocks_to_hear
from pipistrelle.config import BLOCK, Config, DetectionConfig
from pipistrelle.detection.matched import filter_samples
from pipistrelle.detection.snapshots import detect, detector
from reference.echoes import CONFIG, SAMPLES, SETTLED, SQUARE, START, filtered, sounds

FACE = Layout(normal=np.zeros(1), position=SQUARE.position)
FINDER = detector(CONFIG, FACE, SETTLED.tones)
CALL = CONFIG.emitter.pulse
BLOCKS = 44
ANGLE = np.radians(20.0)
CHANCE, SIGMAS = 1e-6, 4.9
FULL, COMMON, FAST = range(3)  # the dense engine, its outputs on the blocks' grid, the block engine


def echo(delay, tone, snr_db, shift=1.0):
    """Return one echo, its SNR that of one element after the matched filter."""
    return sounds(delay, ANGLE, snr_db, tone, shift)


def matched_samples(samples):
    return filter_samples(samples, calls=SETTLED.calls, rate=SETTLED.rate, noise_std=1.0)


def block_sums(samples):
    n = np.arange(samples.shape[0])[:, None, None]  # the blanking is whole periods of both tones
    turned = [samples * np.exp(-2j * np.pi * tone * n / SETTLED.rate) for tone in SETTLED.tones]
    shape = (-1, SETTLED.block, *samples.shape[1:])
    return np.stack([each.reshape(shape).sum(axis=1) for each in turned], axis=2)


def errors(matched, engine, tone, delay, finder):
    """Return the angle's and delay's error of the echo's detection, if there is one."""
    interval, pulse = (1.0 / SETTLED.rate, SAMPLES) if engine == FULL else (BLOCK, SETTLED.pulse)
    found = detect(matched, finder, start=START, interval=interval, pulse=pulse)
    near = np.flatnonzero((found.caller == tone) & (np.abs(found.delay - delay) < CALL / 2))
    if near.size == 0:
        return np.nan, np.nan
    best = near[found.power[near].argmax()]
    return found.angle[best] - ANGLE, found.delay[best] - delay


@cache
def heard(snr_db, count, tone=0, shift=1.0, false_alarm=1e-6, engines=(FULL, COMMON, FAST)):
    """Return errors (engines, count, angle and delay) of echoes whose delays fill a block."""
    finder = detector(
        Config(detection=DetectionConfig(false_alarm=false_alarm)), FACE, SETTLED.tones
    )
    rng = np.random.default_rng(stream_key(7, count, f"engines {snr_db} {tone}"))
    table = np.full((3, count, 2), np.nan)
    for i in range(count):
        delay = (2 * SETTLED.pulse + rng.uniform()) * BLOCK
        arrival = echo(delay, tone, snr_db, shift)
        if FULL in engines:
            full = matched_samples(record_samples(BLOCKS, arrival, FACE, SETTLED, rng))
            common = np.ascontiguousarray(full[:: SETTLED.block])
            table[FULL, i] = errors(full, FULL, tone, delay, finder)
            table[COMMON, i] = errors(common, COMMON, tone, delay, finder)
        sums = noise_blocks(BLOCKS, FACE, SETTLED, int(rng.integers(2**63)))
        add_echo_blocks(sums, arrival, FACE, SETTLED)
        table[FAST, i] = errors(filtered(sums), FAST, tone, delay, finder)
    return table


def found(table):
    return ~np.isnan(table[..., 0])


def range_rms(table):
    return np.sqrt(np.nanmean(table[..., 1] ** 2, axis=-1)) * CONFIG.air.sound_speed / 2.0


@pytest.mark.parametrize("noisy", [False, True])
def test_matched_filters_of_both_engines_agree_at_their_common_lags(noisy):
    rng = np.random.default_rng(7)
    landmarks = rng.uniform(-6.0, 6.0, (20, 2))
    emission = arrivals_of_emission(
        np.zeros(3),
        np.array([0.75, 0.0]),
        landmarks,
        callers_of(CONFIG, np.array([0.0, 5.0])),
        CONFIG,
    )
    blocks = blocks_to_hear(emission, SETTLED)
    samples = record_samples(blocks, emission, SQUARE, SETTLED, rng if noisy else None)
    dense = matched_samples(samples)[:: SETTLED.block]
    sums = block_sums(samples)
    np.testing.assert_allclose(filtered(sums), dense, atol=1e-10 * np.abs(dense).max())
    if not noisy:
        direct = np.zeros_like(sums)
        add_echo_blocks(direct, emission, SQUARE, SETTLED)
        np.testing.assert_allclose(filtered(direct), dense, atol=1e-10 * np.abs(dense).max())


@pytest.mark.parametrize("engine", [COMMON, FAST])
def test_noise_of_the_matched_filters_is_a_triangle_in_the_lag_and_nothing_across(engine):
    blocks, width = 2500, SETTLED.pulse
    if engine == FAST:
        matched = filtered(noise_blocks(blocks, FACE, SETTLED, key=11))
    else:
        nothing, rng = echo(0.0, 0, -400.0), np.random.default_rng(11)
        samples = record_samples(blocks, nothing, FACE, SETTLED, rng)
        matched = matched_samples(samples)[:: SETTLED.block]
    outputs = matched.reshape(matched.shape[0], -1)
    triangle = np.clip(1.0 - np.abs(np.arange(-width, width + 1)) / width, 0.0, None)
    error = np.sqrt(np.sum(triangle**2) / blocks)  # of one correlation
    for lag in range(width + 3):
        cross = outputs[lag:].T @ outputs[: len(outputs) - lag].conj() / (len(outputs) - lag)
        own, expected = np.diagonal(cross), max(1.0 - lag / width, 0.0)
        assert abs(own.mean() - expected) < SIGMAS * error / np.sqrt(own.size)
        np.fill_diagonal(cross, 0.0)
        assert np.abs(cross).max() < error * np.sqrt(np.log(cross.size / CHANCE))


def agree(one, two):
    """Whether two engines' detections follow one law: probability, bearing and range error."""
    n, (p, q) = len(one), (found(one).mean(), found(two).mean())
    spread = np.sqrt((p * (1.0 - p) + q * (1.0 - q)) / n)
    if abs(p - q) > SIGMAS * spread:
        return False
    laws = [
        ks_2samp(one[found(one), k], two[found(two), k], method="asymp").pvalue for k in range(2)
    ]
    return min(laws) > CHANCE


@pytest.mark.parametrize("delay", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("tone", [0, 1])
def test_without_noise_both_engines_find_an_echo_in_the_same_place(tone, delay):
    arrival = echo((2 * SETTLED.pulse + delay) * BLOCK, tone, 10.0)
    samples = record_samples(BLOCKS, arrival, FACE, SETTLED, None)
    sums = np.zeros((BLOCKS - SETTLED.pulse, 1, 2, 10), dtype=complex)
    add_echo_blocks(sums, arrival, FACE, SETTLED)
    dense = np.ascontiguousarray(matched_samples(samples)[:: SETTLED.block])
    common, fast = (
        errors(matched, engine, tone, arrival.delay[0], FINDER)
        for matched, engine in ((dense, COMMON), (filtered(sums), FAST))
    )
    assert np.isfinite(common).all()
    np.testing.assert_allclose(fast, common, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("tone", [0, 1])
@pytest.mark.parametrize("snr_db", [2.0, 3.5, 5.0, 8.0, 13.0])
def test_the_block_engine_detects_as_the_dense_one_does_whatever_the_echo(snr_db, tone):
    shift = 1.0 - (2 - tone) * 0.75 / 343.0  # from a vehicle that leaves: both ways, or one
    table = heard(snr_db, 4000, tone, shift)
    assert agree(table[FAST], table[COMMON])
    assert snr_db != 3.5 or not agree(table[FAST], table[FULL]), "the finer grid is another law"


@pytest.mark.slow
def test_the_full_grid_gains_at_most_a_tenth_in_detection_probability():
    gain = {}
    for snr_db in (2.0, 3.5, 5.0, 8.0):
        full, common, _ = found(heard(snr_db, 4000)).mean(axis=1)
        gain[snr_db] = full - common
    assert max(gain, key=gain.get) == 3.5
    assert gain[3.5] == pytest.approx(0.08, abs=0.02)
    assert 0.0 <= gain[8.0] < 0.005


@pytest.mark.slow
def test_the_full_grid_would_refine_a_clear_echos_range_by_a_fifth():
    full, common, _ = range_rms(heard(10.0, 1200))
    assert full / common == pytest.approx(0.8, abs=0.1)  # an rms of 1200 is good to 4 %


@pytest.mark.parametrize(
    ("snr_db", "centimetres"),
    [(0.0, 11.0), (6.0, 2.0), (10.0, 1.0)],  # 10, 16 and 20 dB in the beam of ten elements
)
def test_the_block_engines_range_error_over_delays_across_a_block(snr_db, centimetres):
    # At 10 dB hardly an echo passes one test in a million: there the test is opened.
    table = heard(snr_db, 4000, false_alarm=1e-6 if snr_db > 3.0 else 0.09, engines=(FAST,))[FAST]
    assert found(table).mean() > 0.9
    assert 100.0 * range_rms(table) < centimetres
    assert 100.0 * range_rms(table) > 0.5 * centimetres  # nor is the bound idle


def test_range_is_unbiased_but_for_half_a_sample():
    # A call is heard from the first sample after its arrival on: 2.5 us late on average.
    late = heard(10.0, 4000, engines=(FAST,))[FAST, :, 1]
    assert late.mean() == pytest.approx(
        0.5 / SETTLED.rate, abs=SIGMAS * late.std() / np.sqrt(late.size)
    )
