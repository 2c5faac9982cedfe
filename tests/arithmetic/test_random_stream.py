import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, chi2_contingency, gamma, kstest

from pipistrelle.arithmetic.random_stream import complex_noise, stream_key

law = settings(deadline=None, max_examples=60)
KEYS = st.integers(0, 2**64 - 1)
CHANCE = 1e-6  # with which a single check fails on good noise
SIGMAS = 4.9  # the same, of a normal


def drawn(count, purpose="proof", std=1.0):
    return complex_noise((count,), std, stream_key(7, 0, purpose))


def moments_off(noise):
    """Return by how many standard errors the moments miss those of unit complex noise."""
    re, power, n = noise.real, np.abs(noise) ** 2, noise.size
    return {
        "mean": abs(noise.mean()) * math.sqrt(n),
        "power": (power.mean() - 1.0) * math.sqrt(n),
        "power of the real part": (np.mean(re**2) - 0.5) * math.sqrt(n / 0.5),
        "third moment": np.mean(re**3) * math.sqrt(n / (15.0 / 8.0)),
        "fourth moment": (np.mean(power**2) - 2.0) * math.sqrt(n / 20.0),
        "real with imaginary": np.mean(noise**2).imag * math.sqrt(n),
        "real against imaginary": np.mean(noise**2).real * math.sqrt(n),
        "neighbours": abs(np.mean(noise[1:] * noise[:-1].conj())) * math.sqrt(n),
        "neighbours' powers": np.mean((power[1:] - 1.0) * (power[:-1] - 1.0)) * math.sqrt(n),
    }


def flaws(noise):
    """Name everything that tells the samples from independent unit complex normals."""
    laws = {
        "power's law": kstest(np.abs(noise) ** 2, "expon"),
        "phase's law": kstest(np.angle(noise) / (2.0 * np.pi) + 0.5, "uniform"),
        "real part's law": kstest(noise.real * math.sqrt(2.0), "norm"),
    }
    off = [name for name, sigmas in moments_off(noise).items() if abs(sigmas) > SIGMAS]
    return off + [name for name, test in laws.items() if test.pvalue < CHANCE]


def tail_is_exponential(power, tails):
    """Whether as many powers lie beyond each tail's quantile as its probability says."""
    seen = np.array([np.count_nonzero(power > -math.log(tail)) for tail in tails])
    low, high = binom.interval(1.0 - CHANCE, power.size, tails)
    return bool(np.all(seen >= low) and np.all(seen <= high))


def test_noise_is_indistinguishable_from_independent_complex_normals():
    assert flaws(drawn(2**18)) == []


@pytest.mark.parametrize(
    ("flaw", "spoilt"),
    [
        pytest.param("power", lambda z: 1.0075 * z, marks=pytest.mark.slow),
        pytest.param(
            "power of the real part",
            lambda z: 1.015 * z.real + 0.985j * z.imag,
            marks=pytest.mark.slow,
        ),
        pytest.param("real with imaginary", lambda z: z + 0.015j * z.real, marks=pytest.mark.slow),
        ("mean", lambda z: z + 0.015),
        pytest.param(
            "neighbours",
            lambda z: (z[:-1] + 0.015 * z[1:]) / math.hypot(1.0, 0.015),
            marks=pytest.mark.slow,
        ),
        ("phase's law", lambda z: np.abs(z) * np.exp(1j * np.round(10.0 * np.angle(z)) / 10.0)),
    ],
)
def test_the_same_tests_find_a_small_flaw(flaw, spoilt):
    assert flaw in flaws(spoilt(drawn(2**18)))


def test_the_tail_is_exponential_to_one_in_a_hundred_thousand():
    power = np.abs(drawn(2**22)) ** 2
    assert tail_is_exponential(power, [1e-1, 1e-3, 1e-5])
    assert not tail_is_exponential(np.where(power > 11.0, 1.0, power), [1e-5])


@pytest.mark.slow
def test_the_tail_is_exponential_to_one_in_ten_million():
    seen, count, tails = np.zeros(2, dtype=int), 2**23, np.array([1e-6, 1e-7])
    for part in range(32):
        power = np.abs(drawn(count, f"tail {part}")) ** 2
        seen += np.count_nonzero(power[:, None] > -np.log(tails), axis=0)
    low, high = binom.interval(1.0 - CHANCE, 32 * count, tails)
    assert np.all(seen >= low)
    assert np.all(seen <= high)


def test_the_energy_of_ten_samples_is_gamma_distributed():
    energy = np.sum(np.abs(drawn(10 * 2**16).reshape(-1, 10)) ** 2, axis=1)
    assert kstest(energy, gamma(10).cdf).pvalue > CHANCE
    assert kstest(energy, gamma(10.15).cdf).pvalue < CHANCE


def test_successive_samples_are_independent():
    noise = drawn(2**19)
    octant = np.floor((np.angle(noise) / np.pi + 1.0) * 4.0).clip(0, 7).astype(int)
    octile = np.floor(8.0 * np.exp(-(np.abs(noise) ** 2))).clip(0, 7).astype(int)
    for first, second in itertools.product((octant, octile), repeat=2):
        for lag in (1, 2, 10, 512):
            table = np.bincount(8 * first[:-lag] + second[lag:], minlength=64).reshape(8, 8)
            assert chi2_contingency(table).pvalue > CHANCE


@pytest.mark.parametrize("lag", [1, 2, 3, 10, 20, 80, 512, 1024])
def test_samples_at_a_lag_are_uncorrelated(lag):
    noise = drawn(2**19)
    correlation = np.mean(noise[lag:] * noise[:-lag].conj())
    assert abs(correlation) * math.sqrt(noise.size) < SIGMAS


def test_streams_of_neighbouring_keys_are_uncorrelated():
    count, key = 2**16, stream_key(7, 0, "noise", 3)
    keys = [key, key + 1, key - 1, key ^ (1 << 63), key ^ (1 << 32)]
    keys += [stream_key(7, 0, "noise", 4), stream_key(7, 1, "noise", 3), stream_key(8, 0, "noise")]
    streams = np.array([complex_noise((count,), 1.0, k) for k in keys])
    excess = np.abs(streams) ** 2 - 1.0
    for lag in (0, 1, 7):
        for one in (streams, excess):
            product = one[:, lag:] @ one[:, : count - lag].conj().T
            np.fill_diagonal(product, 0.0)  # each with itself: the other tests'
            assert np.abs(product).max() < SIGMAS * math.sqrt(count)


@pytest.mark.parametrize("key", [0, 123, 2**63, 2**64 - 1])
def test_each_sample_is_box_and_mullers_of_a_splitmix_hash_to_single_precision(key):
    count = 2**18
    x = np.uint64(key) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    power = -np.log(((x >> np.uint64(32)) + 0.5) / 2.0**32)
    phase = ((x & np.uint64(0xFFFFFFFF)) / 2.0**30 - 0.5) * np.pi / 2.0
    found = complex_noise((count,), 1.0, key)
    # The logarithm's series is cut where it is worth 3e-8, ten roundings of 6e-8 follow.
    assert (np.abs(np.abs(found) ** 2 - power) / (1.0 + power)).max() < 7e-7
    assert np.abs(np.angle(found * np.exp(-1j * phase))).max() < 7e-7


@given(key=KEYS, short=st.integers(0, 1500), more=st.integers(0, 1500))
@law
def test_a_sample_does_not_depend_on_how_many_are_drawn(key, short, more):
    one, two = complex_noise((short,), 1.0, key), complex_noise((short + more,), 1.0, key)
    assert one.tobytes() == two[:short].tobytes()


@given(key=KEYS, shape=st.tuples(*[st.integers(1, 12)] * 3))
@law
def test_samples_are_numbered_in_c_order(key, shape):
    flat = complex_noise((math.prod(shape),), 1.0, key)
    assert complex_noise(shape, 1.0, key).tobytes() == flat.tobytes()


def test_noise_scales_with_its_standard_deviation():
    one, five = drawn(1000), drawn(1000, std=5.0)
    np.testing.assert_allclose(five, 5.0 * one, rtol=1e-6)  # single precision
    assert not drawn(1000, std=0.0).any()


def test_keys_of_a_whole_study_are_distinct():
    keys = {
        stream_key(seed, iteration, purpose, frame)
        for seed, iteration, purpose, frame in itertools.product(
            (0, 1, 7, 2**63 - 1), range(20), ("scenario", "noise", "ekf"), range(100)
        )
    }
    assert len(keys) == 4 * 20 * 3 * 100
    assert all(0 <= key < 2**64 for key in keys)


def test_a_key_depends_on_the_order_of_its_arguments():
    assert stream_key(1, 2, "noise", 3) != stream_key(2, 1, "noise", 3)
    assert stream_key(1, 2, "noise", 3) != stream_key(1, 3, "noise", 2)
    assert stream_key(1, 2, "noise", 0) != stream_key(1, 2, "noise", 2**32)


def test_keys_use_all_their_bits_evenly():
    keys = np.array(
        [stream_key(7, i, "noise", j) for i in range(50) for j in range(50)], dtype=np.uint64
    )
    bits = (keys[:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    assert np.abs(bits.mean(axis=0) - 0.5).max() * 2.0 * math.sqrt(keys.size) < SIGMAS
