r"""Recording of arrivals by microphones: as sums over blocks for tones, in bands for other calls.

An arrival of delay tau, amplitude A and received frequency f' is at element e of a face

.. math:: x_e(t) = A e^{2\pi i f'(t - \tau)} e^{2\pi i f' y_e \sin\theta / c},
          \qquad \tau \le t < \tau + T f / f'

with theta the angle off the face's normal and y the element's position on the face: a plane wave
whose envelope reaches all elements of a face at once (they differ by at most 4.5 % of the call).
Samples are complex (the analytic signal) and so is the noise, of variance sigma^2 per sample.

**Blocks.** For tones, the recording is the sums over 0.2 ms blocks for each tone,

.. math:: S_{b} = \sum_{n=40b}^{40b+39} x[n] e^{-2\pi i f_p n / f_s} ,

which are closed-form geometric sums for the arrivals, and for white noise exactly independent
normals of variance 40 sigma^2, as all tones are whole bins of a 40-sample transform. A call is a
whole number of blocks, so the matched filter and later stages need only these sums. Of other tones,
rates and durations a block is about a fourteenth of a call, and the noise of two tones, which has a
few percent in common, is drawn independently.

**Bands.** A call of bandwidth B, of any waveform s, needs 1.25 B complex samples per second. With
w the envelope of s about a carrier :math:`f_0`, limited to the band, an arrival with the Doppler
scale a is

.. math:: A\, w(a (t - \tau))\, e^{2\pi i f_0 (a (t - \tau) - t)} ,

and a single table of w is enough for all delays and speeds; tables of each call in each band give
the leakage. Noise of variance :math:`\sigma^2` per sample has the variance :math:`\sigma^2 D / f_s`
in each bin of a window of duration D, and only the bins of the bands are drawn.

With microphones in any positions (`Scattered`), each has its own envelope:

.. math:: x_m(t) = g_m A e^{2\pi i f'(t - \tau_m)}, \qquad \tau_m \le t < \tau_m + T f / f',
          \qquad \tau_m = \tau - p_m \cdot u / c

**Real samples from block sums.** Of the call of frequency f a real signal has half at f and half at
-f, so its block sums are half the analytic signal's, and real white noise of variance
:math:`\sigma^2 / 4` has, at f, the density of complex noise of variance :math:`\sigma^2`:

.. math:: S_b = 2 \sum_{n=bB}^{(b+1)B-1} x[n] e^{-2\pi i f_p n / f_s} .

The waveforms of the arrivals and white noise are written first, and then the components at the
tones in each block are replaced by the given sums. So the sums of the samples are the given ones up
to rounding, including noise; with `Sampling.banded`, the components in the bands.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import FINER, Band, Call, bands_of, bins_of, carrier_of, lag_step
from pipistrelle.arithmetic.random_stream import complex_noise, stream_from
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.arrays.sampling import Sampling, block_shape
from pipistrelle.jit import Whole, kernel, no_alloc


def noise_blocks(
    blocks: int,
    layout: Layout | Scattered,
    sampling: Sampling,
    key: int,
    out: Complex[np.ndarray, "b f c e"] | None = None,
) -> Complex[np.ndarray, "b f c e"]:
    """Draw the microphones' noise as sums over blocks of samples, independent for each tone.

    `key`: of the random stream; a block's noise does not depend on their number; `out`: written and
    returned instead of a new array.
    """
    std = math.sqrt(sampling.block) * sampling.noise_std
    return complex_noise(block_shape(blocks, layout, sampling), std, key, out)


def add_echo_blocks(
    signal: Complex[np.ndarray, "b f c e"],
    arrivals: Arrivals,
    layout: Layout | Scattered,
    sampling: Sampling,
) -> None:
    """Add arrivals to a recording of block sums, which begins at the end of the vehicle's call."""
    amplitude, duration = 10.0 ** (arrivals.level_db / 20.0), _durations(arrivals, sampling)
    sounds = arrivals.delay, amplitude, arrivals.bearing, arrivals.frequency, duration
    grid = sampling.tones, sampling.rate, sampling.block, sampling.pulse
    if isinstance(layout, Scattered):
        early, gain = _heard_by_each(arrivals, layout, sampling)
        _add_scattered_blocks(signal[:, 0], sounds, grid, early, gain)
        return
    ears = layout.normal, layout.position, sampling.speed_of_sound
    _add_echo_blocks(signal.view(np.float64), sounds, grid, ears)


def _heard_by_each(
    arrivals: Arrivals, layout: Layout | Scattered, sampling: Sampling
) -> tuple[Float[np.ndarray, "a m"], Float[np.ndarray, "a m"] | Complex[np.ndarray, "a m"]]:
    """Return each microphone's time lead over the centre [s] and gain, for each arrival.

    In blocks, the envelope of a tone reaches a whole face at once, and only phases differ.
    """
    c = sampling.speed_of_sound
    if isinstance(layout, Scattered):
        off = np.cos(arrivals.bearing[:, np.newaxis] - layout.normal[layout.group])
        gain = np.where(off < 0.0, 0.0, layout.amplitude)  # NaN: all directions
        return layout.lead(arrivals.bearing) / c, gain
    angle = arrivals.bearing[:, np.newaxis] - layout.normal
    ahead = np.repeat(np.cos(angle) >= 0.0, layout.position.size, axis=1)
    early = (np.sin(angle)[..., np.newaxis] * layout.position / c).reshape(ahead.shape)
    if sampling.banded:
        return early, ahead.astype(np.float64)
    return np.zeros(early.shape), ahead * np.exp(2j * np.pi * arrivals.frequency[:, None] * early)


OVERSAMPLING = 1.25
"""Samples of an envelope per second and Hz of its band."""

Envelopes = list[Complex[np.ndarray, "m s"]]
"""Complex envelopes of all channels, face by face, in each call's band."""
InBands = tuple[int, int, Envelopes, list[Complex[np.ndarray, "m b"]]]
"""Lags of a window, of them before the call ends, echoes, and noise by channel and bin."""


class BandRecorder:
    """Recorder of arrivals and noise in the band of each call, at the rate that the band needs.

    Windows are `lags` times `interval` long.
    """

    def __init__(self, layout: Layout | Scattered, sampling: Sampling) -> None:
        self.layout, self.sampling = layout, sampling
        calls, rate, self.channels = sampling.calls, sampling.rate, math.prod(layout.shape)
        self.interval, self.bands = lag_step(calls, rate) / rate, bands_of(calls, rate)
        self._tables = [
            _envelopes_of(calls, band, carrier_of(band, self.interval)) for band in self.bands
        ]
        faintest = sampling.noise_std * math.sqrt(np.finfo(np.float32).eps)  # after the filter
        self._least = [
            faintest / np.linalg.norm(tables, axis=1) / math.sqrt(_table_grid(band)[0] * rate)
            for band, tables in zip(self.bands, self._tables, strict=True)
        ]
        """Least amplitude of each caller's arrivals in each band."""

    def silence(self, lags: int) -> Envelopes:
        """Return envelopes without sound."""
        from scipy.fft import next_fast_len

        length = OVERSAMPLING * lags * self.interval
        sizes = [next_fast_len(math.ceil(length * (one.high - one.low))) for one in self.bands]
        return [np.zeros((self.channels, size), dtype=np.complex64) for size in sizes]

    def noise(self, lags: int, key: int) -> list[Complex[np.ndarray, "m b"]]:
        """Draw the spectra of the noise in each band; numbers of the random stream are bins."""
        length, noise = lags * self.interval, []
        std = math.sqrt(length / self.sampling.rate) * self.sampling.noise_std
        for band in self.bands:
            middle, low, high = bins_of(band, lags, self.interval)
            noise.append(np.empty((self.channels, high - low + 1), dtype=np.complex64))
            for m, row in enumerate(noise[-1]):
                first = m * round(length * self.sampling.rate) + middle + low
                complex_noise(row.shape, std, stream_from(key, first), row)
        return noise

    def add(self, envelopes: Envelopes, arrivals: Arrivals, lags: int, start: float) -> None:
        """Add arrivals to envelopes that begin at a delay [s], from the end of the call on."""
        on = self.sampling
        early, gain = _heard_by_each(arrivals, self.layout, on)
        scale = arrivals.frequency / on.tones[arrivals.caller]
        sounds = arrivals.delay, 10.0 ** (arrivals.level_db / 20.0), scale, arrivals.caller
        each = zip(envelopes, self.bands, self._tables, self._least, strict=True)
        for envelope, band, tables, least in each:
            rate = envelope.shape[1] / (lags * self.interval)
            first = math.ceil((on.pulse * on.interval - start) * rate - 1e-6)
            grid = rate, start, first, *_table_grid(band), carrier_of(band, self.interval), least
            _add_envelopes(envelope, sounds, grid, tables, early, gain)


def _table_grid(band: Band) -> tuple[float, float]:
    """Return the step of a table of envelopes in a band, and its length before a call [s].

    Linear interpolation between 64 values per sample is exact to 1e-4.
    """
    width = band.high - band.low
    return 1.0 / (FINER**2 * OVERSAMPLING * width), 2.0 / (OVERSAMPLING - 1.0) / width


def _envelopes_of(calls: Sequence[Call], band: Band, carrier: float) -> Complex[np.ndarray, "c n"]:
    """Return fine tables of calls' envelopes in a band, about the band's carrier.

    The filter is flat in the band, and zero where sampling would fold its edge into the band.
    """
    from scipy.fft import fft, ifft, next_fast_len

    (step, before), longest = _table_grid(band), max(call.duration for call in calls)
    time = step * (np.arange(math.ceil((longest + 2.0 * before) / step)) + 0.5) - before
    count = next_fast_len(2 * time.size)
    away = np.abs(np.fft.fftfreq(count, step) - 0.5 * (band.low + band.high))
    spare = (away / (band.high - band.low) - 0.5) / (OVERSAMPLING - 1.0)  # 0 to 1: falls off
    share = 0.5 + 0.5 * np.cos(np.pi * np.clip((4.0 * spare - 1.0) / 3.0, 0.0, 1.0))
    tables = []
    for call in calls:
        inside = (time >= 0.0) & (time < call.duration)
        sent = 2.0 * call.waveform(np.where(inside, time, 0.0), call.frequency).real * inside
        tables.append(ifft(fft(sent, count) * share)[: time.size])
    return (np.stack(tables) * np.exp(-2j * np.pi * carrier * time)).astype(np.complex64)


@kernel
def _add_envelopes(
    envelope: Complex[np.ndarray, "m s"],
    sounds: tuple,
    grid: tuple,
    tables: Complex[np.ndarray, "c n"],
    early: Float[np.ndarray, "a m"],
    gain: Float[np.ndarray, "a m"],
) -> None:
    """Add every arrival to each microphone's envelope, by its time lead [s] and gain there."""
    (delay, amplitude, scale, caller), size = sounds, tables.shape[1]
    rate, start, first, step, before, carrier, least = grid
    for a in range(delay.size):
        if amplitude[a] < least[caller[a]]:
            continue
        table, stride, turns = tables[caller[a]], scale[a] / (rate * step), carrier / rate
        turn = 2.0 * math.pi * turns * (scale[a] - 1.0)
        turned = complex(math.cos(turn), math.sin(turn))
        for m in range(envelope.shape[0]):
            late = delay[a] - early[a, m] - start
            place = (before - scale[a] * late) / step - 0.5
            low = max(math.ceil(-place / stride), first)
            high = min(math.floor((size - 2 - place) / stride), envelope.shape[1] - 1)
            if gain[a, m] == 0.0 or high < low:
                continue
            phase = turn * low - 2.0 * math.pi * carrier * scale[a] * late
            phasor = gain[a, m] * amplitude[a] * complex(math.cos(phase), math.sin(phase))
            for k in range(low, high + 1):
                here = place + k * stride
                i = int(here)
                part = here - i
                envelope[m, k] += phasor * ((1.0 - part) * table[i] + part * table[i + 1])
                phasor *= turned


def record_samples(
    blocks: int, arrivals: Arrivals, layout: Layout | Scattered, sampling: Sampling
) -> Complex[np.ndarray, "t f e"] | Float[np.ndarray, "t f e"]:
    """Return every sample of arrivals at the microphones, without noise.

    `blocks`: length; the first sample follows the vehicle's call. Returns (blocks * 40, faces,
    elements): the analytic signal, or its real part with `Sampling.banded`.
    """
    signal = np.zeros((blocks * sampling.block, *layout.shape), dtype=np.complex128)
    channels = signal.reshape(len(signal), -1)
    first, rate = sampling.pulse * sampling.block, sampling.rate
    early, gain = _heard_by_each(arrivals, layout, sampling)
    gain = gain * 10.0 ** (arrivals.level_db[:, np.newaxis] / 20.0)
    for a, duration in enumerate(_durations(arrivals, sampling)):
        late, call = arrivals.delay[a] - early[a], sampling.calls[arrivals.caller[a]]
        start, stop = np.ceil(late * rate), np.ceil((late + duration) * rate)
        n = np.arange(max(start.min(), first), min(stop.max(), first + len(signal)), dtype=int)
        n = n[:, np.newaxis]
        sound = call.waveform(n / rate - late, arrivals.frequency[a])
        channels[n[:, 0] - first] += np.where((start <= n) & (n < stop), sound * gain[a], 0.0)
    return signal.real if sampling.banded else signal


def _durations(arrivals: Arrivals, sampling: Sampling) -> Float[np.ndarray, " a"]:
    """Return the duration of each arrival [s], a call's scaled by the Doppler shift."""
    nominal, length = sampling.tones[arrivals.caller], [call.duration for call in sampling.calls]
    return np.array(length)[arrivals.caller] * nominal / arrivals.frequency


class _Sounds(NamedTuple):
    """Delay, amplitude, bearing, frequency and duration of arrivals, for compiled functions."""

    delay: Float[np.ndarray, " a"]
    amplitude: Float[np.ndarray, " a"]
    bearing: Float[np.ndarray, " a"]
    frequency: Float[np.ndarray, " a"]
    duration: Float[np.ndarray, " a"]
    """`delay` and `duration` [s]."""


class _Grid(NamedTuple):
    """Tones, sample rate and block lengths of a recording, for compiled functions."""

    tones: Float[np.ndarray, " c"]
    rate: float
    block: int
    """Samples per block."""
    blank: int
    """Blocks before the first that is recorded."""


@kernel
def _geometric_sum(omega: float, start: Whole, stop: Whole) -> complex:
    """Return the sum of exp(i omega n) over the integers n with start <= n < stop."""
    count = stop - start
    half = 0.5 * omega
    gain = float(count) if half == 0.0 else math.sin(half * count) / math.sin(half)
    phase = omega * (start + 0.5 * (count - 1))
    return complex(gain * math.cos(phase), gain * math.sin(phase))


@no_alloc
def _envelope(
    sums: Complex[np.ndarray, "c b"],
    p: Whole,
    omega: float,
    start: Whole,
    stop: Whole,
    block: Whole,
) -> Whole:
    """Write the sums of a complex exponential over the blocks it covers; return their number."""
    first, last = start // block, (stop - 1) // block
    sums[p, 0] = _geometric_sum(omega, start, min(stop, (first + 1) * block))
    if last == first:
        return 1
    turn = complex(math.cos(omega * block), math.sin(omega * block))
    whole = _geometric_sum(omega, (first + 1) * block, (first + 2) * block)
    for b in range(first + 1, last):
        sums[p, b - first] = whole
        whole *= turn
    sums[p, last - first] = _geometric_sum(omega, last * block, stop)
    return last - first + 1


@no_alloc
def _steer(
    direct: Float[np.ndarray, " i"],
    turned: Float[np.ndarray, " i"],
    phasor: complex,
    wave: float,
    position: Float[np.ndarray, " e"],
) -> None:
    """Write an arrival's phasor at each element, and i times it, real and imaginary interleaved."""
    elements = position.size
    for e in range(elements):
        mirror = elements - 1 - e
        if mirror < e and position[e] == -position[mirror]:
            cosine, sine = direct[2 * mirror], -direct[2 * mirror + 1]
        else:
            phase = wave * position[e]
            cosine, sine = math.cos(phase), math.sin(phase)
        direct[2 * e], direct[2 * e + 1] = cosine, sine
    for e in range(elements):
        phase = phasor * complex(direct[2 * e], direct[2 * e + 1])
        direct[2 * e], direct[2 * e + 1] = phase.real, phase.imag
        turned[2 * e], turned[2 * e + 1] = -phase.imag, phase.real


@no_alloc
def _add_echo(
    heard: Float[np.ndarray, "b f c i"],
    room: tuple,
    phasor: complex,
    bearing: float,
    frequency: float,
    ears: tuple,
) -> None:
    """Add an arrival to the block sums of every face that receives it.

    ``room``: block sums of the envelope per tone, and work arrays; ``ears``: normals of the faces,
    positions of the elements, and the speed of sound.
    """
    sums, direct, turned = room
    normal, position, speed_of_sound = ears
    for f in range(normal.size):
        angle = bearing - normal[f]
        if math.cos(angle) < 0.0:
            continue
        wave = 2.0 * math.pi * frequency * math.sin(angle) / speed_of_sound
        _steer(direct, turned, phasor, wave, position)
        for b in range(heard.shape[0]):
            for p in range(heard.shape[2]):
                re, im, parts = sums[p, b].real, sums[p, b].imag, heard[b, f, p]
                for i in range(parts.size):
                    parts[i] += re * direct[i] + im * turned[i]


@kernel
def _add_echo_blocks(
    signal: Float[np.ndarray, "b f c i"], sounds: tuple, grid: tuple, ears: tuple
) -> None:
    """Add every arrival to the faces' block sums, with real and imaginary parts interleaved."""
    sound, on = _Sounds(*sounds), _Grid(*grid)
    blocks, _, tones, parts = signal.shape
    rate, block, blank = on.rate, on.block, on.blank
    sums = np.empty((tones, blocks), dtype=np.complex128)
    room = sums, np.empty(parts), np.empty(parts)
    for a in range(sound.delay.size):
        delay, frequency = sound.delay[a], sound.frequency[a]
        start = max(math.ceil(delay * rate), blank * block)
        stop = min(math.ceil((delay + sound.duration[a]) * rate), (blank + blocks) * block)
        if stop <= start:
            continue
        count = 0
        for p in range(tones):
            omega = 2.0 * math.pi * (frequency - on.tones[p]) / rate
            count = _envelope(sums, p, omega, start, stop, block)
        turns = -2.0 * math.pi * frequency * delay
        phasor = sound.amplitude[a] * complex(math.cos(turns), math.sin(turns))
        first = start // block - blank
        touched = signal[first : first + count]
        _add_echo(touched, room, phasor, sound.bearing[a], frequency, ears)


@kernel
def _add_scattered_blocks(
    signal: Complex[np.ndarray, "b c e"],
    sounds: tuple,
    grid: tuple,
    early: Float[np.ndarray, "a e"],
    gain: Float[np.ndarray, "a e"],
) -> None:
    """Add every arrival to each microphone's block sums, by its time lead [s] and gain there."""
    sound, on = _Sounds(*sounds), _Grid(*grid)
    blocks, tones, elements = signal.shape
    rate, block, blank = on.rate, on.block, on.blank
    sums = np.empty((tones, blocks), dtype=np.complex128)
    for a in range(sound.delay.size):
        frequency = sound.frequency[a]
        for e in range(elements):
            delay = sound.delay[a] - early[a, e]
            start = max(math.ceil(delay * rate), blank * block)
            stop = min(math.ceil((delay + sound.duration[a]) * rate), (blank + blocks) * block)
            if stop <= start or gain[a, e] == 0.0:
                continue
            turns = -2.0 * math.pi * frequency * delay
            phasor = gain[a, e] * sound.amplitude[a] * complex(math.cos(turns), math.sin(turns))
            first = start // block - blank
            for p in range(tones):
                omega = 2.0 * math.pi * (frequency - on.tones[p]) / rate
                for b in range(_envelope(sums, p, omega, start, stop, block)):
                    signal[first + b, p, e] += phasor * sums[p, b]


def real_samples(
    heard: Complex[np.ndarray, "b f c e"] | InBands,
    arrivals: Arrivals,
    layout: Layout | Scattered,
    sampling: Sampling,
    length: int,
    rng: np.random.Generator,
    leak: float = 0.0,
) -> Float[np.ndarray, "t m"]:
    """Simulate the microphones' real samples from one call of the vehicle to the next.

    `heard`: block sums from the end of the vehicle's call, or the sound in the calls' bands;
    `arrivals`: their sources, besides noise; `length`: samples from the start of the vehicle's call
    to the next; later sound is dropped, and noise follows shorter sound; `rng`:
    source of the noise at other frequencies, and after the sums; `leak`: amplitude of the vehicle's
    own call in each microphone. Returns float32, face by face.
    """
    channels, std = math.prod(layout.shape), np.float32(0.5 * sampling.noise_std)
    samples = rng.standard_normal((length, channels), dtype=np.float32) * std
    first = min(sampling.pulse * sampling.block, length)
    time = np.arange(first) / sampling.rate
    own = leak * sampling.calls[0].waveform(time, sampling.calls[0].frequency).real
    samples[:first] += own.astype(np.float32)[:, np.newaxis]
    blocks = (length - first) // sampling.block
    if not isinstance(heard, tuple):
        blocks = min(len(heard), blocks)
    after = samples[first : first + blocks * sampling.block]
    sound = record_samples(blocks, arrivals, layout, sampling)
    after += sound.real.reshape(after.shape).astype(np.float32)
    if isinstance(heard, tuple):
        _replace_bands(after, heard, sampling)
    else:
        _replace_tones(after.reshape(blocks, sampling.block, -1), heard[:blocks], sampling)
    return samples


def _replace_bands(samples: Float[np.ndarray, "t m"], heard: InBands, sampling: Sampling) -> None:
    """Change samples after the vehicle's call in place so that their spectrum in bands is given."""
    (lags, cut, *sounds), step = heard, lag_step(sampling.calls, sampling.rate)
    window = np.zeros((lags * step, samples.shape[1]))
    inside = window[cut * step :][: len(samples)]
    inside[:] = samples[: len(inside)]
    spectrum = np.fft.rfft(window, axis=0)
    bands = bands_of(sampling.calls, sampling.rate)
    for band, envelope, noise in zip(bands, *sounds, strict=True):
        middle, low, high = bins_of(band, lags, step / sampling.rate)
        bins = np.arange(low, high + 1)
        factor = lags * step / sampling.rate / envelope.shape[1]
        echoes = factor * np.fft.fft(envelope, axis=1)[:, bins % envelope.shape[1]]
        held = (middle + bins > 0) & (middle + bins < len(spectrum) - 1)
        spectrum[middle + bins[held]] = 0.5 * sampling.rate * (echoes + noise)[:, held].T
    samples[: len(inside)] = np.fft.irfft(spectrum, len(window), axis=0)[cut * step :][
        : len(inside)
    ]


def _replace_tones(
    samples: Float[np.ndarray, "b n m"], sums: Complex[np.ndarray, "b f c e"], sampling: Sampling
) -> None:
    """Change blocks of samples in place so that their sums at each tone are the given ones."""
    turns = -2j * np.pi * sampling.tones / sampling.rate
    wave = np.exp(np.outer(turns, np.arange(sampling.block)))
    begin = sampling.block * (sampling.pulse + np.arange(len(sums)))
    wanted = 0.5 * np.moveaxis(sums, 2, 1).reshape(len(sums), len(wave), samples.shape[2])
    wanted *= np.exp(-np.outer(begin, turns))[:, :, np.newaxis]
    parts = np.concatenate((wave.real, wave.imag))
    missing = np.concatenate((wanted.real, wanted.imag), axis=1) - parts @ samples
    samples += (np.linalg.pinv(parts) @ missing).astype(np.float32)
