r"""Recording of arrivals by microphones, with two equivalent engines, ``block`` and ``dense``.

An arrival of delay tau, amplitude A and received frequency f' is at element e of a face

.. math:: x_e(t) = A e^{2\pi i f'(t - \tau)} e^{2\pi i f' y_e \sin\theta / c},
          \qquad \tau \le t < \tau + T f / f'

with theta the angle off the face's normal and y the element's position on the face: a plane wave
whose envelope reaches all elements of a face at once (they differ by at most 4.5 % of the call).
Samples are complex (the analytic signal) and so is the noise, of variance sigma^2 per sample.

``dense`` writes every sample at 200 kHz. ``block`` writes the sums over 0.2 ms blocks for each
tone,

.. math:: S_{b} = \sum_{n=40b}^{40b+39} x[n] e^{-2\pi i f_p n / f_s} ,

which are closed-form geometric sums for the arrivals, and for white noise exactly independent
normals of variance 40 sigma^2, as all tones are whole bins of a 40-sample transform. A call is a
whole number of blocks, so the matched filter and later stages need only these sums.

With microphones in any positions (`Scattered`), each has its own envelope:

.. math:: x_m(t) = g_m A e^{2\pi i f'(t - \tau_m)}, \qquad \tau_m \le t < \tau_m + T f / f',
          \qquad \tau_m = \tau - p_m \cdot u / c

**Real samples from block sums.** Of the call of frequency f a real signal has half at f and half at
-f, so its block sums are half the analytic signal's, and real white noise of variance
:math:`\sigma^2 / 4` has, at f, the density of complex noise of variance :math:`\sigma^2`:

.. math:: S_b = 2 \sum_{n=bB}^{(b+1)B-1} x[n] e^{-2\pi i f_p n / f_s} .

The waveforms of the arrivals and white noise are written first, and then the components at the
tones in each block are replaced by the given sums. So the sums of the samples are the given ones up
to rounding, including noise. With `Sampling.real`, the recorded samples are used unchanged.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import ToneBurst
from pipistrelle.arithmetic.random_stream import complex_noise
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.arrays.sampling import Sampling, block_shape
from pipistrelle.config import InputError
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
    for call in sampling.calls:
        if not isinstance(call, ToneBurst):
            raise InputError(
                f"receiver.engine: found 'block', whose sums are those of tone bursts, for a "
                f"{type(call).__name__}; expected 'dense'"
            )
    amplitude, duration = 10.0 ** (arrivals.level_db / 20.0), _durations(arrivals, sampling)
    sounds = arrivals.delay, amplitude, arrivals.bearing, arrivals.frequency, duration
    grid = sampling.tones, sampling.rate, sampling.block, sampling.pulse
    if isinstance(layout, Scattered):
        each = _heard_by_each(arrivals, layout, sampling.speed_of_sound)
        _add_scattered_blocks(signal[:, 0], sounds, grid, *each)
        return
    ears = layout.normal, layout.position, sampling.speed_of_sound
    _add_echo_blocks(signal.view(np.float64), sounds, grid, ears)


def _heard_by_each(
    arrivals: Arrivals, layout: Scattered, speed_of_sound: float
) -> tuple[Float[np.ndarray, "a e"], Float[np.ndarray, "a e"]]:
    """Return each microphone's time lead over the centre [s] and gain, for each arrival."""
    off = np.cos(arrivals.bearing[:, np.newaxis] - layout.normal[layout.group])
    ahead = ~(off < 0.0)  # NaN: all directions
    early = layout.lead(arrivals.bearing) / speed_of_sound
    return early, np.where(ahead, layout.amplitude, 0.0)


def record_samples(
    blocks: int,
    arrivals: Arrivals,
    layout: Layout | Scattered,
    sampling: Sampling,
    rng: np.random.Generator | None,
    *,
    single: bool = False,
) -> Complex[np.ndarray, "t f e"] | Float[np.ndarray, "t f e"]:
    """Return every sample that the microphones record in a frame: the reference engine.

    `blocks`: length; the first sample follows the vehicle's call; `rng`: None records without
    noise; `single`: in single precision. Returns (blocks * 40, faces, elements).

    A call that is not a tone burst reaches each element at its own time. Real samples
    (`Sampling.real`) are the real part of the analytic signal, with white noise of a quarter of the
    complex variance, which has the same density at each frequency.
    """
    shape = (blocks * sampling.block, *layout.shape)
    signal = _noise(shape, sampling, rng, single=single)
    c, duration = sampling.speed_of_sound, _durations(arrivals, sampling)
    if isinstance(layout, Scattered):
        early, gain = _heard_by_each(arrivals, layout, c)
        for a, e in np.argwhere(gain > 0.0):
            n, wave = _wave(len(signal), arrivals, a, early[a, e], duration[a], sampling)
            wave = gain[a, e] * wave
            signal[n, 0, e] += wave.real if sampling.real else wave
        return signal
    angles = arrivals.bearing[:, np.newaxis] - layout.normal
    for a, f in np.argwhere(np.cos(angles) >= 0.0):
        if isinstance(sampling.calls[arrivals.caller[a]], ToneBurst):
            n, wave = _wave(len(signal), arrivals, a, 0.0, duration[a], sampling)
            phases = layout.phases(angles[a, f], arrivals.frequency[a], c)
            wave = np.outer(wave, np.exp(1j * phases))
            signal[n, f] += wave.real if sampling.real else wave
            continue
        for e, early in enumerate(layout.position * math.sin(angles[a, f]) / c):
            n, wave = _wave(len(signal), arrivals, a, early, duration[a], sampling)
            signal[n, f, e] += wave.real if sampling.real else wave
    return signal


def _noise(
    shape: tuple[int, ...], sampling: Sampling, rng: np.random.Generator | None, *, single: bool
) -> Complex[np.ndarray, "t f e"] | Float[np.ndarray, "t f e"]:
    """Draw the microphones' noise for every sample, real or complex; zeros without a generator."""
    real, whole = (np.float32, np.complex64) if single else (np.float64, np.complex128)
    if rng is None:
        return np.zeros(shape, dtype=real if sampling.real else whole)
    if sampling.real:
        return rng.standard_normal(shape, dtype=real) * real(0.5 * sampling.noise_std)
    signal = rng.standard_normal((*shape, 2), dtype=real).view(whole)[..., 0]
    signal *= real(sampling.noise_std / math.sqrt(2.0))
    return signal


def _wave(
    length: int, arrivals: Arrivals, a: int, early: float, duration: float, sampling: Sampling
) -> tuple[slice, Complex[np.ndarray, " n"]]:
    """Return the slice of a recording that an arrival fills at a microphone, and its samples."""
    first, rate, delay = sampling.pulse * sampling.block, sampling.rate, arrivals.delay[a] - early
    start = max(math.ceil(delay * rate), first)
    stop = max(min(math.ceil((delay + duration) * rate), first + length), start)
    call = sampling.calls[arrivals.caller[a]]
    sound = call.waveform(np.arange(start, stop) / rate - delay, arrivals.frequency[a])
    return slice(start - first, stop - first), 10.0 ** (arrivals.level_db[a] / 20.0) * sound


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
    sums: Complex[np.ndarray, "b f c e"] | Float[np.ndarray, "t f e"],
    arrivals: Arrivals,
    layout: Layout | Scattered,
    sampling: Sampling,
    length: int,
    rng: np.random.Generator,
    leak: float = 0.0,
) -> Float[np.ndarray, "t m"]:
    """Simulate the microphones' real samples from one call of the vehicle to the next.

    `sums`: (blocks, faces, callers, elements) complex, or (samples, faces, elements) real, from the
    end of the vehicle's call; `arrivals`: their sources, besides noise; `length`: samples from the
    start of the vehicle's call to the next; sums beyond it are dropped, and noise follows shorter
    ones; `rng`: source of the noise at other frequencies, and after the sums; `leak`: amplitude of
    the vehicle's own call in each microphone. Returns float32, face by face.
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
    """Change blocks of samples in place so that their sums at each tone are the given ones."""
    turns = np.outer(sampling.tones, np.arange(sampling.block)) / sampling.rate
    wave = np.exp(-2j * np.pi * turns)
    wanted = np.moveaxis(sums, 2, 1).reshape(len(sums), len(wave), samples.shape[2])
    missing = 0.5 * wanted - (wave.real @ samples + 1j * (wave.imag @ samples))
    missing *= 2.0 / sampling.block
    samples += (wave.real.T @ missing.real + wave.imag.T @ missing.imag).astype(np.float32)
