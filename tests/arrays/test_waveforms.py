"""Real samples of microphones hold the block sums that were heard."""

import numpy as np

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.paths import callers_of
from pipistrelle.arrays.layout import square_of_four
from pipistrelle.arrays.receiver import add_echo_blocks, noise_blocks, real_samples
from pipistrelle.arrays.sampling import sampling
from pipistrelle.config import Config

CONFIG = Config()
LAYOUT = square_of_four(CONFIG.receiver)
SETTLED = sampling(CONFIG, callers_of(CONFIG, np.zeros(2)))
LENGTH = 20_000


def heard(level_db=30.0):
    sums = noise_blocks(300, LAYOUT, SETTLED, key=5)
    arrivals = Arrivals(
        delay=np.array([0.0123]),
        level_db=np.array([level_db]),
        bearing=np.array([0.3]),
        frequency=np.array([35_070.0]),
        caller=np.zeros(1, dtype=np.int8),
        landmark=np.ones(1, dtype=np.int64),
    )
    add_echo_blocks(sums, arrivals, LAYOUT, SETTLED)
    rng = np.random.default_rng(3)
    return sums, real_samples(sums, arrivals, LAYOUT, SETTLED, LENGTH, rng, leak=50.0)


def fourier(samples, tone, first=560):
    """Twice the transform of each block, by its definition."""
    blocks = samples[first : first + (len(samples) - first) // 40 * 40].astype(float)
    wave = np.exp(-2j * np.pi * tone * np.arange(40) / 200e3)
    return 2.0 * np.einsum("bnm,n->bm", blocks.reshape(-1, 40, samples.shape[1]), wave)


def test_twice_the_transform_of_each_block_is_its_block_sum():
    sums, samples = heard()
    for c, tone in enumerate(SETTLED.tones):
        found = fourier(samples, tone)[:300].reshape(300, 4, 10)
        np.testing.assert_allclose(found, sums[:, :, c], atol=1e-3 * abs(sums).max() / 100)


def test_noise_is_white_at_all_frequencies_and_after_the_last_block():
    _, samples = heard(level_db=-300.0)
    noise = 40 * SETTLED.noise_std**2  # of a sum
    for tone in (10e3, 30e3, 35e3, 60e3):
        for part in (slice(0, 300), slice(300, None)):
            power = np.abs(fourier(samples, tone)[part]) ** 2
            assert abs(power.mean() / noise - 1.0) < 5.0 / np.sqrt(power.size)


def test_a_microphone_receives_only_the_call_while_it_lasts():
    _, samples = heard()
    wave = 50.0 * np.cos(2.0 * np.pi * 35e3 * np.arange(560) / 200e3)
    rest = samples[:560] - wave[:, None]
    assert abs(rest.std() / (0.5 * SETTLED.noise_std) - 1.0) < 5.0 / np.sqrt(2 * rest.size)
