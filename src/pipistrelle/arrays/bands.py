r"""Bands: which frequencies a call has, and how much of it is another's.

A real recording is matched in each call's band, the middle of its spectrum that holds nearly all of
its energy. Outputs of the matched filter follow it so closely that nothing between them is lost:
twice as many in a second as the widest band has Hz, at least. Of the spectrum S in the band,

.. math:: f_c = \frac{\int f |S|^2}{\int |S|^2}, \qquad
          \beta^2 = (2\pi)^2 \frac{\int (f - f_c)^2 |S|^2}{\int |S|^2} ,

the Cramer-Rao bound of a delay is :math:`1 / (2 p \beta^2)`, with p the power of the output in
units of its noise.

Source: Van Trees, Detection, Estimation, and Modulation Theory III (1971), Sec. 10.2.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.call import Call, Sweep, ToneBurst

ENERGY = 0.995
"""Share of a call's energy that its band holds."""
MAX_CROSS_TALK = 0.06
"""Largest share of a call's power that the matched filter of another may answer."""
PADDING = 8
"""How much finer than its length asks for a call's spectrum is looked at."""


class Band(NamedTuple):
    """The frequencies of a call."""

    low: float
    high: float
    centre: float
    """`low`, `high` and `centre`, the mean over the energy [Hz]."""
    spread: float
    """Root mean square angular frequency about the centre [rad/s]."""
    energy: float
    """Sum of the squares of its samples, in units of its amplitude's."""


def replica(call: Call, rate: float, scale: float = 1.0) -> Complex[np.ndarray, " n"]:
    """Return a call's samples, as it is received a times as high (`scale`)."""
    time = np.arange(math.ceil(call.duration * rate - 1e-6)) / rate
    return call.waveform(time, scale * call.frequency)


def band_of(call: Call, rate: float) -> Band:
    """Return the band of a call that is sampled at a rate [Hz].

    >>> band = band_of(Sweep(60e3, 35e3, 2.8e-3, taper=0.2), 200e3)
    >>> round(band.low / 1e3), round(band.high / 1e3), round(band.centre / 1e3, 1)
    (35, 60, 47.5)
    """
    sent = replica(call, rate)
    power = np.abs(np.fft.fft(sent, PADDING * sent.size)) ** 2
    bins = np.arange(power.size)
    share = np.cumsum(power) / power.sum()
    edges = np.searchsorted(share, (0.5 * (1.0 - ENERGY), 0.5 * (1.0 + ENERGY)))
    low, high = edges.tolist()
    inside, step = slice(low, high + 1), rate / power.size
    weight = power[inside] / power[inside].sum()
    centre = float(np.sum(weight * bins[inside]))
    spread = 2.0 * np.pi * step * math.sqrt(np.sum(weight * (bins[inside] - centre) ** 2))
    energy = float(np.sum(np.abs(sent) ** 2))
    return Band(low * step, high * step, centre * step, spread, energy)


def extent_of(call: Call, rate: float) -> tuple[float, float]:
    """Return the frequencies between which a call lies: of a tone its own, else those of its band.

    A sweep's are those at which it begins and ends, where its samples would alias.
    """
    if isinstance(call, ToneBurst):
        return call.frequency, call.frequency
    band = band_of(call, rate)
    ends = (call.start, call.end) if isinstance(call, Sweep) else (call.frequency,)
    return min(band.low, *ends), max(band.high, *ends)


def cross_talk(calls: Sequence[Call], rate: float) -> Float[np.ndarray, "c c"]:
    """Return how much of a call's power the matched filter of another answers, at the worst lag.

    `rate` [Hz]. Row i is of the filter of call i.
    """
    sent = [replica(call, rate) for call in calls]
    count = 2 * max(one.size for one in sent)
    spectra = [np.fft.fft(one / np.linalg.norm(one), count) for one in sent]
    answers = [[np.abs(np.fft.ifft(b * a.conj())).max() ** 2 for b in spectra] for a in spectra]
    return np.array(answers)


def lag_step(calls: Sequence[Call], rate: float) -> int:
    """Return the samples from one output of the matched filters to the next, at a rate [Hz].

    >>> lag_step([ToneBurst(35e3, 2.8e-3)], 200e3)
    6
    """
    widest = max(band.high - band.low for band in (band_of(call, rate) for call in calls))
    return max(math.floor(rate / (2.0 * widest)), 1)
