"""Matched filters: for tones by block sums, for any call by convolution, and times of arrival.

Outputs are in units of the noise. A time of arrival is the start of a call in a steered beam, to a
fraction of a lag.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from jaxtyping import Complex, Float, Int

from pipistrelle.acoustics.call import (
    Call,
    ToneBurst,
    bands_of,
    bins_of,
    carrier_of,
    lag_step,
    replica,
    window_lags,
)
from pipistrelle.jit import Whole, kernel, no_alloc


@no_alloc
def steering_phases(
    u: float, place: Float[np.ndarray, " e"], phases: Complex[np.ndarray, " e"]
) -> None:
    """Write the phasors that steer a line array's beam; `u`: phase between neighbours [rad].

    `place`: positions of the elements, in spacings; empty if equally spaced.
    """
    turn, phase = complex(math.cos(u), -math.sin(u)), 1.0 + 0.0j
    for e in range(phases.size):
        phases[e] = phase
        phase *= turn
    for e in range(place.size):
        phases[e] = complex(math.cos(u * place[e]), -math.sin(u * place[e]))


@no_alloc
def steer(
    matched: Complex[np.ndarray, "l f c e"],
    low: Whole,
    lags: Whole,
    f: Whole,
    p: Whole,
    phases: Complex[np.ndarray, " e"],
    beam: Complex[np.ndarray, " r"],
) -> None:
    """Write a beam's output, the phased sum of its elements', for `lags` lags from `low`."""
    for k in range(lags):
        beam[k] = 0.0
    for e in range(matched.shape[3]):
        for k in range(lags):
            beam[k] += matched[low + k, f, p, e] * phases[e]


@kernel
def _best_fraction(z0: complex, z1: complex, pulse: Whole) -> tuple[float, float]:
    """Return the most likely start of a call between two lags, as a fraction, and its score.

    A call that starts the fraction q into block 0 weighs the blocks 1 - q, 1, ..., 1, q; its
    likelihood grows with abs((1 - q) z0 + q z1)^2 / (pulse - 2 q + 2 q^2), whose stationary points
    are the roots of a quadratic.
    """
    a = z0.real * z0.real + z0.imag * z0.imag
    h = z0.real * z1.real + z0.imag * z1.imag
    b = z1.real * z1.real + z1.imag * z1.imag
    beta, gamma = 2.0 * (h - a), a + b - 2.0 * h
    A, B, C = -2.0 * (beta + gamma), 2.0 * gamma * pulse - 4.0 * a, beta * pulse + 2.0 * a
    best, fit = 0.0, a / pulse
    if b / pulse > fit:
        best, fit = 1.0, b / pulse
    discriminant = B * B - 4.0 * A * C
    if discriminant >= 0.0:
        root = -0.5 * (B + math.copysign(math.sqrt(discriminant), B))
        for k in range(2):
            numerator, divisor = (root, A) if k == 0 else (C, root)
            if divisor != 0.0 and 0.0 < numerator / divisor < 1.0:
                q = numerator / divisor
                score = (a + q * (beta + gamma * q)) / (pulse - 2.0 * q + 2.0 * q * q)
                if score > fit:
                    best, fit = q, score
    return best, fit


@kernel
def reach_of(pulse: Whole) -> Whole:
    """Return the largest distance between a snapshot's lag and the start of its call, in lags."""
    return max(pulse // 7, 1)


@no_alloc
def arrival_lag(
    matched: Complex[np.ndarray, "l f c e"],
    b: Whole,
    f: Whole,
    p: Whole,
    phases: Complex[np.ndarray, " e"],
    pulse: Whole,
    beam: Complex[np.ndarray, " r"],
) -> float:
    """Return the start of the call in a beam, near lag b, as a fractional lag.

    ``beam``: work array for the lags within reach and one to either side.
    """
    reach, last = reach_of(pulse), matched.shape[0] - 1
    low, high = max(b - reach, 0), min(b + reach, last)
    first = max(low - 1, 0)
    steer(matched, first, min(high + 1, last) - first + 1, f, p, phases, beam)
    centre, largest = b, -1.0
    for near in range(low, high + 1):
        z = abs(beam[near - first])
        if z > largest:
            centre, largest = near, z
    best, fit = float(centre), -1.0
    for left in range(max(centre - 1, 0), min(centre, last - 1) + 1):
        q, score = _best_fraction(beam[left - first], beam[left + 1 - first], pulse)
        if score > fit:
            best, fit = left + q, score
    return best


class Workspace:
    """Named work arrays that frames reuse, as allocation costs more than the arithmetic."""

    def __init__(self) -> None:
        self._flat: dict[str, np.ndarray] = {}

    def array(
        self, name: str, shape: tuple[int, ...], kind: np.dtype | type = np.complex128
    ) -> Complex[np.ndarray, "..."]:
        """Return a named work array in a given shape; its content is undefined."""
        size = math.prod(shape)
        if name not in self._flat or self._flat[name].size < size:
            self._flat[name] = np.empty(size + size // 4, kind)
        return self._flat[name][:size].reshape(shape)


def filter_blocks(
    blocks: Complex[np.ndarray, "b f c e"],
    *,
    pulse: int,
    block: int,
    noise_std: float,
    out: Complex[np.ndarray, "l f c e"] | None = None,
) -> Complex[np.ndarray, "l f c e"]:
    """Apply the matched filter of a tone to block sums: a boxcar of the call's length.

    `pulse`: blocks per call; `block`: samples per block; `noise_std`: of one complex sample; `out`:
    written and returned instead of a new array. Lag i is a call that starts with block i; noise has
    unit variance.
    """
    lags = max(blocks.shape[0] - pulse + 1, 0)
    matched = np.empty((lags, *blocks.shape[1:]), dtype=np.complex128) if out is None else out
    scale = 1.0 / (noise_std * math.sqrt(pulse * block))
    columns = 2 * math.prod(blocks.shape[1:])
    _boxcar(
        blocks.reshape(-1).view(np.float64).reshape(-1, columns),
        pulse,
        scale,
        matched.reshape(-1).view(np.float64).reshape(-1, columns),
    )
    return matched


GROUP = 8
"""Channels that are transformed together, so that caches hold them."""


class BandFilters:
    """Matched filters for several calls, each in its band, of samples or of spectra.

    Sample rate `rate` [Hz]; lags are `step` samples long, and a call `cut` lags at most. The output
    of a call turns with its carrier, of a tone with the tone, from lag to lag.
    """

    def __init__(self, calls: Sequence[Call], rate: float) -> None:
        self.calls, self.rate, self.step = calls, rate, lag_step(calls, rate)
        self.interval, self._bands = self.step / rate, bands_of(calls, rate)
        self.pulse = round(calls[0].duration * rate / self.step)
        """Lags in a call."""
        longest = max(replica(call, rate).size for call in calls)
        self.length = max(longest, self.pulse * self.step)
        self.cut = -(-self.length // self.step)
        """Lags at each end at which a call is only partly in the record."""
        self._weights = lru_cache(maxsize=None)(self._weights_of)

    def __call__(
        self,
        samples: Float[np.ndarray, "t m"],
        channel: Int[np.ndarray, "f e"],
        gain: float | Float[np.ndarray, "c f e"] = 1.0,
        mean: float | Float[np.ndarray, " m"] = 0.0,
        room: Workspace | None = None,
    ) -> Complex[np.ndarray, "l f c e"]:
        """Correlate real samples, less their mean, with each call, as if silence surrounded them.

        Output `cut` + i is of a call that starts at sample i * `step`. Real noise with a standard
        deviation of a half has unit variance in the outputs, times their `gain`. If there are fewer
        samples than a call, the output is empty.
        """
        from scipy.fft import rfft

        whole, each = (len(samples) - self.length) // self.step + 1, channel.ravel()
        more, lags = self.cut * self.step, window_lags(max(whole, 0) + 3 * self.cut)
        kind, count = np.result_type(samples, "c8"), whole + 2 * self.cut if whole > 0 else 0
        shape = len(self.calls), each.size, count
        outputs = np.empty(shape, kind) if room is None else room.array("matched", shape, kind)
        bins = [bins_of(band, lags, self.interval) for band in self._bands]
        gain = np.broadcast_to(gain, (len(self.calls), *channel.shape)).reshape(*shape[:2], 1)
        gain, mean = gain.astype(samples.dtype), np.broadcast_to(mean, samples.shape[1:])
        mean = mean[each, np.newaxis].astype(samples.dtype)
        silent = np.zeros((GROUP, lags * self.step), samples.dtype)
        for now in (slice(first, first + GROUP) for first in range(0, each.size, GROUP)):
            heard = silent[: each[now].size, more : more + len(samples)]
            np.subtract(samples.T[each[now]], mean[now], out=heard)
            heard = rfft(silent[: len(heard)], axis=1)
            found = self._filtered([(heard, one[0], 2.0 / self.rate) for one in bins], lags, 1.0)
            np.multiply(found[..., :count], gain[:, now], out=outputs[:, now])
        return outputs.reshape(len(self.calls), *channel.shape, count).transpose(3, 1, 0, 2)

    def outputs(
        self,
        envelopes: Sequence[Complex[np.ndarray, "m s"]],
        lags: int,
        noise_std: float,
        noise: Sequence[Complex[np.ndarray, "m b"]] = (),
    ) -> Complex[np.ndarray, "c m l"]:
        """Return the outputs for the envelopes in each band, and for noise by band and bin.

        `lags`: in the window of the envelopes.
        """
        from scipy.fft import fft

        length = lags * self.interval
        spectra = [(fft(one, axis=1), 0, length / one.shape[1]) for one in envelopes]
        return self._filtered(spectra, lags, noise_std, noise)

    def _filtered(
        self,
        spectra: Sequence[tuple[Complex[np.ndarray, "m s"], int, float]],
        lags: int,
        noise_std: float,
        noise: Sequence[Complex[np.ndarray, "m b"]] = (),
    ) -> Complex[np.ndarray, "c m l"]:
        """Return the outputs for spectra of each call, with the bin of its carrier and a factor."""
        from scipy.fft import ifft

        shape = len(spectra), len(spectra[0][0]), lags
        filtered = np.zeros(shape, np.result_type(*(heard.dtype for heard, *_ in spectra)))
        for c, (heard, middle, factor) in enumerate(spectra):
            low, weights = self._weights(c, lags)
            weights = (weights / noise_std).astype(filtered.dtype)
            ends = np.clip([0, -low - lags, -low, lags - low, weights.size], 0, weights.size)
            for first, stop in pairwise(np.unique(ends).tolist()):  # a tone's band folds
                source, target = (middle + low + first) % heard.shape[1], (low + first) % lags
                part = heard[:, source : source + stop - first] * factor
                if noise:
                    part += noise[c][:, first:stop]
                part *= weights[first:stop]
                filtered[c, :, target : target + stop - first] += part
        outputs = ifft(filtered, axis=2, norm="forward", overwrite_x=True)
        for c, call in enumerate(self.calls):
            if isinstance(call, ToneBurst):
                off = call.frequency - carrier_of(self._bands[c], self.interval)
                turns = off * self.interval * np.arange(lags)
                outputs[c] *= np.exp(-2j * np.pi * turns).astype(outputs.dtype)
        return outputs

    def _weights_of(self, c: int, lags: int) -> tuple[int, Complex[np.ndarray, " b"]]:
        """Return a call's lowest bin, from its carrier, and the filter's factor in each bin."""
        call, count = self.calls[c], lags * self.step
        middle, low, high = bins_of(self._bands[c], lags, self.interval)
        bins = np.arange(middle + low, middle + high + 1)
        sent = np.fft.fft(replica(call, self.rate), count)[bins].conj()
        if isinstance(call, ToneBurst):
            away = np.abs(bins / count * self.rate - call.frequency) * self.interval
            sent *= np.cos(0.5 * np.pi * np.clip(2.0 * away - 1.0, 0.0, 1.0)) ** 2
        energy = np.sum(sent.real**2 + sent.imag**2)
        return low, sent * self.rate / math.sqrt(energy * count)


@kernel
def _boxcar(
    rows: Float[np.ndarray, "b i"], width: Whole, scale: float, sums: Float[np.ndarray, "l i"]
) -> None:
    """Write the scaled sum of every `width` consecutive rows."""
    columns = rows.shape[1]
    total = np.zeros(columns)
    for b in range(min(width - 1, rows.shape[0])):
        for i in range(columns):
            total[i] += scale * rows[b, i]
    for b in range(width - 1, rows.shape[0]):
        new, old, done = rows[b], rows[b - width + 1], sums[b - width + 1]
        for i in range(columns):
            done[i] = total[i] + scale * new[i]
            total[i] = done[i] - scale * old[i]
