"""The sample-by-sample engine: every sample with white noise, and filters by convolution."""

import math

import numpy as np

from pipistrelle.arrays import receiver


def record_samples(blocks, arrivals, layout, sampling, rng):
    """Return every sample that the microphones record in a frame; without `rng` free of noise.

    Real samples have white noise of a quarter of the complex variance, which has the same density
    at each frequency.
    """
    signal = receiver.record_samples(blocks, arrivals, layout, sampling)
    if rng is None:
        return signal
    if sampling.banded:
        return signal + rng.normal(scale=0.5 * sampling.noise_std, size=signal.shape)
    noise = rng.standard_normal((*signal.shape, 2)).view(complex)[..., 0]
    return signal + noise * (sampling.noise_std / math.sqrt(2.0))


def filter_samples(samples, *, calls, rate, noise_std):
    """Apply the matched filter of each call to samples, by fast convolution.

    Lag i is a call that starts with sample i; noise has unit variance.
    """
    from scipy.signal import oaconvolve

    time = np.arange(round(calls[0].duration * rate)) / rate
    sent = np.stack([call.waveform(time, call.frequency) for call in calls], axis=1)
    replica = sent[::-1].conj() / (noise_std * np.linalg.norm(sent, axis=0))
    return oaconvolve(
        samples[:, :, None, :],
        replica.astype(np.result_type(samples, np.complex64))[:, None, :, None],
        mode="valid",
        axes=0,
    )


def around(filters, samples):
    """Return the outputs of `BandFilters` for samples of faces."""
    channel = np.arange(samples[0].size).reshape(samples[0].shape)
    return filters(samples.reshape(len(samples), -1), channel)


def in_bands(filters, samples):
    """Return its outputs at lags at which whole calls are recorded."""
    return around(filters, samples)[filters.cut : -filters.cut]
