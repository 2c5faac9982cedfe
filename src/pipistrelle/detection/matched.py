"""Matched filters: for tones by block sums, for any call by convolution, and times of arrival.

Outputs are in units of the noise. A time of arrival is the start of a call in a steered beam, to a
fraction of a lag.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst, band_of, lag_step, replica
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

    def array(self, name: str, shape: tuple[int, ...]) -> Complex[np.ndarray, "..."]:
        """Return a named work array in a given shape; its content is undefined."""
        size = math.prod(shape)
        if name not in self._flat or self._flat[name].size < size:
            self._flat[name] = np.empty(size + size // 4, dtype=np.complex128)
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


def filter_samples(
    samples: Complex[np.ndarray, "t f e"],
    *,
    calls: Sequence[Call],
    rate: float,
    noise_std: float,
) -> Complex[np.ndarray, "l f c e"]:
    """Apply the matched filter of each call to samples, by fast convolution.

    `samples` may be real, as in a recording; `calls` are equally long; `rate` [Hz]; `noise_std`: of
    one complex sample. Lag i is a call that starts with sample i; noise has unit variance. The
    precision is that of the samples.
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


class BandFilters:
    """Matched filters of real samples for several calls: tones by sums, other calls in their band.

    Sample rate `rate` [Hz]; lags are `step` samples long, and the longest call has `length`
    samples. The output of a tone keeps the phase of the recording's start, like block sums.
    """

    def __init__(self, calls: Sequence[Call], rate: float) -> None:
        self.calls, self.rate, self.step = calls, rate, lag_step(calls, rate)
        self.pulse = round(calls[0].duration * rate / self.step)
        """Lags in a call."""
        longest = max(replica(call, rate).size for call in calls)
        self.length = max(longest, self.pulse * self.step)
        self._replicas = lru_cache(maxsize=2)(self._in_bands)

    def __call__(
        self, samples: Float[np.ndarray, "t f e"], noise_std: float = 1.0
    ) -> Complex[np.ndarray, "l f c e"]:
        """Correlate samples with each call; output i is of a call that starts at sample i * `step`.

        `noise_std`: of one complex sample, so that real ones have half of it. Noise has unit
        variance. If there are fewer samples than a call, the output is empty.
        """
        from scipy.fft import next_fast_len, rfft

        lags = max((len(samples) - self.length) // self.step + 1, 0)
        whole = np.result_type(samples, np.complex64)
        outputs = np.empty((lags, len(samples[0]), len(self.calls), samples.shape[2]), whole)
        if not lags:
            return outputs
        count, heard = self.step * next_fast_len(-(-len(samples) // self.step)), None
        replicas = self._replicas(count)
        for c, call in enumerate(self.calls):
            if isinstance(call, ToneBurst):
                outputs[:, :, c] = self._summed(samples, call.frequency)[:lags] / noise_std
            else:
                heard = rfft(samples, count, axis=0) if heard is None else heard
                filtered = self._filtered(heard, count, *replicas[c])
                outputs[:, :, c] = filtered[:lags] / whole.type(noise_std)
        return outputs

    def around(
        self, samples: Float[np.ndarray, "t f e"], noise_std: float = 1.0
    ) -> Complex[np.ndarray, "l f c e"]:
        """Return matched-filter outputs also at lags where a call overlaps the samples only partly.

        These lags precede and follow the others, as many at each end as a call is long, as if
        silence surrounded the samples.
        """
        more = self.step * -(-self.length // self.step)
        silence = np.zeros((more, *samples.shape[1:]), samples.dtype)
        return self(np.concatenate((silence, samples, silence)), noise_std)

    def _summed(
        self, samples: Float[np.ndarray, "t f e"], tone: float
    ) -> Complex[np.ndarray, "l f e"]:
        """Return the matched-filter outputs of samples for a tone [Hz], at unit noise."""
        blocks = len(samples) // self.step
        some = samples[: blocks * self.step].reshape(blocks, self.step, -1)
        wave = 2.0 * np.exp(-2j * np.pi * tone / self.rate * np.arange(self.step))
        turn = np.exp(-2j * np.pi * tone * self.step / self.rate * np.arange(blocks))
        sums = np.einsum("bnm,n->bm", some, wave.astype(np.complex64), optimize=True)
        summed = (sums * turn[:, np.newaxis]).reshape(blocks, 1, 1, -1)
        each = {"pulse": self.pulse, "block": self.step, "noise_std": 1.0}
        return filter_blocks(summed, **each).reshape(-1, *samples.shape[1:])

    def _filtered(
        self,
        heard: Complex[np.ndarray, "k f e"],
        count: int,
        bins: Int[np.ndarray, " b"],
        sent: Complex[np.ndarray, " b"],
    ) -> Complex[np.ndarray, "l f e"]:
        """Return the matched-filter outputs of a call in its band, from the samples' spectrum."""
        from scipy.fft import ifft

        fewer = np.zeros((count // self.step, *heard.shape[1:]), heard.dtype)
        fewer[bins % len(fewer)] = heard[bins] * sent.astype(heard.dtype)[:, None, None]
        return ifft(fewer, axis=0, overwrite_x=True)

    def _in_bands(
        self, count: int
    ) -> list[tuple[Int[np.ndarray, " b"], Complex[np.ndarray, " b"]]]:
        """Return each call's frequency bins in a transform of `count` samples, and its weights."""
        found = []
        for call in self.calls:
            band, length = band_of(call, self.rate), count / self.rate
            bins = np.arange(math.ceil(band.low * length), math.floor(band.high * length) + 1)
            own = np.fft.fft(replica(call, self.rate), count)[bins].conj()
            own *= 2.0 / self.step / math.sqrt(np.sum(np.abs(own) ** 2) / count)
            found.append((bins, own))
        return found


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
