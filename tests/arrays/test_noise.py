import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, kstest

from pipistrelle.arrays.noise import complex_noise, stream_key

law = settings(deadline=None, max_examples=60)
KEYS = st.integers(0, 2**64 - 1)
ALARM = 1e-6  # of each statistical check: none of a hundred fails by chance


def sigmas(alarm=ALARM):
    """Two-sided bound, in standard deviations, that chance passes with the alarm's probability."""
    return math.sqrt(2.0) * 3.4589 if alarm == 1e-6 else 5.0


def drawn(count, purpose="proof", std=1.0):
    return complex_noise((count,), std, stream_key(7, 0, purpose))


def moments_off(noise):
    """By how many of their standard errors the first four moments miss those of CN(0, 1)."""
    re, im, n = noise.real, noise.imag, noise.size
    power = np.abs(noise) ** 2
    return {
        "mean re": re.mean() / math.sqrt(0.5 / n),
        "mean im": im.mean() / math.sqrt(0.5 / n),
        "power": (power.mean() - 1.0) / math.sqrt(1.0 / n),
        "power of re": (np.mean(re**2) - 0.5) / math.sqrt(0.5 / n),
        "skew re": np.mean(re**3) / math.sqrt(15.0 / 8.0 / n),
        "re im": np.mean(re * im) / math.sqrt(0.25 / n),
        "fourth": (np.mean(power**2) - 2.0) / math.sqrt(20.0 / n),
        "circular": np.mean(noise**2).real / math.sqrt(1.0 / n),
    }
