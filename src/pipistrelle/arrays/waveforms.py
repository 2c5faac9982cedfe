r"""Block sums -> the real samples of microphones that hold just these sums.

A microphone's samples are real. Of the call of frequency f a real sound holds half at f and half at
-f, so its sums over a block are half those of the analytic signal, and real white noise of variance
:math:`\sigma^2 / 4` has, at f, the density of complex noise of variance :math:`\sigma^2`:

.. math:: S_b = 2 \sum_{n=bB}^{(b+1)B-1} x[n] e^{-2\pi i f_p n / f_s} .

The waveforms of the arrivals and white noise are written first, and then in each block what lies at
the tones is replaced by what the front end heard there, which are whole bins of a block's transform
(`pipistrelle.arrays.receiver`). So what is heard of the samples is what was heard of the sums, to
rounding, noise and all. Where every sample was recorded as a real one (`Sampling.real`), these are
what was heard.
"""

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.arrays.receiver import record_samples
from pipistrelle.arrays.sampling import Sampling


def real_samples(
    sums: Complex[np.ndarray, "b f c e"] | Float[np.ndarray, "t f e"],
    arrivals: Arrivals,
    layout: Layout | Scattered,
    sampling: Sampling,
    length: int,
    rng: np.random.Generator,
    leak: float = 0.0,
) -> Float[np.ndarray, "t m"]:
    """Return what the microphones record from one call of the vehicle to the next.

    Parameters
    ----------
    sums : (blocks, faces, callers, elements) complex, or (samples, faces, elements) real
        As the front end heard them; the first follows the vehicle's call.
    arrivals : Arrivals
        That made them, beside the noise.
    layout : Layout or Scattered
    sampling : Sampling
    length : int
        Samples from the start of the vehicle's call to that of the next. What would come later is
        left out; where the sums end earlier, noise follows.
    rng : Generator
        Source of the noise at other frequencies, and where there are no sums.
    leak : float
        Amplitude of the vehicle's own call in each microphone, while it lasts.

    Returns
    -------
    (length, faces * elements) float32
        Face by face.
    """
    faces, elements = layout.shape
    samples = rng.standard_normal((length, faces * elements), dtype=np.float32)
    samples *= np.float32(0.5 * sampling.noise_std)
    first = min(sampling.pulse * sampling.block, length)
    time = np.arange(first) / sampling.rate
    own = leak * sampling.calls[0].waveform(time, sampling.calls[0].frequency).real
    samples[:first] += own.astype(np.float32)[:, np.newaxis]
    if sampling.real:
        heard = sums.reshape(len(sums), -1)[: length - first]
        samples[first : first + len(heard)] = heard
        return samples
    blocks = min(len(sums), (length - first) // sampling.block)
    heard = samples[first : first + blocks * sampling.block]
    sound = record_samples(blocks, arrivals, layout, sampling, None, single=True)
    heard += sound.real.reshape(heard.shape)
    _replace_tones(heard.reshape(blocks, sampling.block, -1), sums[:blocks], sampling)
    return samples


def _replace_tones(
    samples: Float[np.ndarray, "b n m"], sums: Complex[np.ndarray, "b f c e"], sampling: Sampling
) -> None:
    """Give blocks of samples the sums at each tone that are wanted, in place."""
    turns = np.outer(sampling.tones, np.arange(sampling.block)) / sampling.rate
    wave = np.exp(-2j * np.pi * turns)
    wanted = np.moveaxis(sums, 2, 1).reshape(len(sums), len(wave), samples.shape[2])
    missing = 0.5 * wanted - (wave.real @ samples + 1j * (wave.imag @ samples))
    missing *= 2.0 / sampling.block
    samples += (wave.real.T @ missing.real + wave.imag.T @ missing.imag).astype(np.float32)
