"""Matched filters against their definitions, sum by sum."""

import numpy as np
import pytest

from pipistrelle.acoustics.call import ToneBurst
from pipistrelle.detection.matched import filter_blocks
from reference.samples import filter_samples


def drawn(*shape):
    parts = np.random.default_rng(7).standard_normal((*shape, 2))
    return parts[..., 0] + 1j * parts[..., 1]


@pytest.mark.parametrize("pulse", [1, 2, 14])
def test_blocks_are_summed_over_the_call_in_units_of_the_noise(pulse):
    blocks = drawn(40, 4, 2, 3)
    matched = filter_blocks(blocks, pulse=pulse, block=40, noise_std=0.5)
    summed = [blocks[i : i + pulse].sum(axis=0) for i in range(40 - pulse + 1)]
    np.testing.assert_allclose(matched, np.array(summed) / (0.5 * np.sqrt(pulse * 40)), atol=1e-13)


def test_samples_are_correlated_with_the_call_of_each_tone():
    samples, tones, length = drawn(300, 2, 3), np.array([35e3, 50e3]), 40
    calls = [ToneBurst(tone, length / 200e3) for tone in tones]
    matched = filter_samples(samples, calls=calls, rate=200e3, noise_std=2.0)
    assert matched.shape == (261, 2, 2, 3)
    call = np.exp(2j * np.pi * tones[:, None] * np.arange(length) / 200e3)
    for lag in (0, 100, 260):
        heard = np.einsum("pn,nfe->fpe", call.conj(), samples[lag : lag + length])
        np.testing.assert_allclose(matched[lag], heard / (2.0 * np.sqrt(length)), atol=1e-12)


def test_real_samples_are_heard_as_complex_ones():
    settled = {"calls": [ToneBurst(35e3, 2e-4)], "rate": 200e3, "noise_std": 1.0}
    samples = drawn(300, 2, 3).real
    expected = filter_samples(samples.astype(complex), **settled)
    np.testing.assert_allclose(filter_samples(samples, **settled), expected, atol=1e-12)
    single = filter_samples(samples.astype(np.float32), **settled)
    np.testing.assert_allclose(single, expected, atol=1e-4)


def test_record_of_a_single_call_has_one_lag_and_a_shorter_one_none():
    settled = {"pulse": 14, "block": 40, "noise_std": 1.0}
    assert filter_blocks(drawn(14, 4, 2, 10), **settled).shape[0] == 1
    assert filter_blocks(drawn(13, 4, 2, 10), **settled).shape[0] == 0


def test_the_output_array_is_filled_and_returned():
    out = np.empty((7, 4, 2, 3), dtype=complex)
    blocks = drawn(20, 4, 2, 3)
    settled = {"pulse": 14, "block": 40, "noise_std": 1.0}
    assert filter_blocks(blocks, **settled, out=out) is out
    np.testing.assert_array_equal(out, filter_blocks(blocks, **settled))
