"""Block sums and full-rate samples: one contract, and the errors of echoes."""

from functools import cache

import numpy as np
import pytest

from pipistrelle.acoustics.arrivals import arrivals_of_emission
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.arrays.layout import Layout
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks
from pipistrelle.arrays.sampling import blocks_to_hear
from pipistrelle.config import BLOCK, Config, DetectionConfig
from pipistrelle.detection.snapshots import detect, detector
from reference.echoes import CONFIG, LAGS, SETTLED, SQUARE, filtered, sounds
from reference.samples import filter_samples, record_samples

FACE = Layout(normal=np.zeros(1), position=SQUARE.position)
BLOCKS = 44
ANGLE = np.radians(20.0)
CHANCE, SIGMAS = 1e-6, 4.9


def matched_samples(samples):
    return filter_samples(samples, calls=SETTLED.calls, rate=SETTLED.rate, noise_std=1.0)


def block_sums(samples):
    n = np.arange(samples.shape[0])[:, None, None]  # the blanking is whole periods of both tones
    turned = [samples * np.exp(-2j * np.pi * tone * n / SETTLED.rate) for tone in SETTLED.tones]
    shape = (-1, SETTLED.block, *samples.shape[1:])
    return np.stack([each.reshape(shape).sum(axis=1) for each in turned], axis=2)


@cache
def heard(snr_db, count, false_alarm=1e-6):
    """Return errors (count, angle and delay) of echoes whose delays fill a block."""
    settings = Config(detection=DetectionConfig(false_alarm=false_alarm))
    finder = detector(settings, FACE, SETTLED.tones)
    rng = np.random.default_rng(stream_key(7, count, f"engines {snr_db} 0"))
    table = np.full((count, 2), np.nan)
    for i in range(count):
        delay = (2 * SETTLED.pulse + rng.uniform()) * BLOCK
        sums = noise_blocks(BLOCKS, FACE, SETTLED, int(rng.integers(2**63)))
        add_echo_blocks(sums, sounds(delay, ANGLE, snr_db, 0), FACE, SETTLED)
        found = detect(filtered(sums), finder, **LAGS)
        near = np.flatnonzero(
            (found.caller == 0) & (np.abs(found.delay - delay) < CONFIG.emitter.call_duration / 2)
        )
        if near.size:
            best = near[found.power[near].argmax()]
            table[i] = found.angle[best] - ANGLE, found.delay[best] - delay
    return table


def range_rms(table):
    return np.sqrt(np.nanmean(table[:, 1] ** 2)) * CONFIG.air.sound_speed / 2.0


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


@pytest.mark.parametrize("drawn", [False, True])
def test_noise_of_the_matched_filters_is_a_triangle_in_the_lag_and_nothing_across(drawn):
    blocks, width = 2500, SETTLED.pulse
    if drawn:
        matched = filtered(noise_blocks(blocks, FACE, SETTLED, key=11))
    else:
        nothing, rng = sounds(0.0, ANGLE, -400.0, 0), np.random.default_rng(11)
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


@pytest.mark.parametrize(
    ("snr_db", "centimetres"),
    [(0.0, 11.0), (6.0, 2.0), (10.0, 1.0)],  # 10, 16 and 20 dB in the beam of ten elements
)
def test_the_block_sums_range_error_over_delays_across_a_block(snr_db, centimetres):
    # At 10 dB hardly an echo passes one test in a million: there the test is opened.
    table = heard(snr_db, 4000, 1e-6 if snr_db > 3.0 else 0.09)
    assert np.isfinite(table[:, 0]).mean() > 0.9
    assert 100.0 * range_rms(table) < centimetres
    assert 100.0 * range_rms(table) > 0.5 * centimetres  # nor is the bound idle


def test_range_is_unbiased_but_for_half_a_sample():
    # A call is heard from the first sample after its arrival on: 2.5 us late on average.
    late = heard(10.0, 4000)[:, 1]
    expected = pytest.approx(0.5 / SETTLED.rate, abs=SIGMAS * late.std() / np.sqrt(late.size))
    assert late.mean() == expected
