r"""Arrivals -> what the microphones record, by two engines with one contract.

An arrival of delay tau, amplitude A and received frequency f' is heard by element e of a face as

.. math:: x_e(t) = A e^{2\pi i f'(t - \tau)} e^{2\pi i f' y_e \sin\theta / c},
          \qquad \tau \le t < \tau + T f / f'

with theta the angle off the face's normal and y the element's place on the face: a plane wave
whose envelope reaches all elements of a face at once (they differ by at most 4.5 % of the call).
Samples are complex (the analytic signal) and so is the noise, of variance sigma^2 per sample.

``dense`` writes every sample at 200 kHz. ``block`` writes the sums over 0.2 ms blocks, one per
tone,

.. math:: S_{b} = \sum_{n=40b}^{40b+39} x[n] e^{-2\pi i f_p n / f_s} ,

which are closed-form geometric sums for the arrivals, and for white noise exactly independent
normals of variance 40 sigma^2, because both tones are whole bins of a 40-sample transform.
Everything later, the matched filter first, needs no more than these sums: a whole number of
blocks makes the call.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.arithmetic.noise import complex_noise
from pipistrelle.arrays.layout import Layout
from pipistrelle.config import Config, InputError
from pipistrelle.jit import kernel, lean

BLOCK = 2e-4
"""Length of a block [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """How a frame is sampled; the receiver is blanked while the vehicle calls.

    Attributes
    ----------
    rate : [Hz]
    block : int
        Samples per block.
    pulse : int
        Blocks per call; the first block heard is the one after it.
    tones : (2) [Hz]
        The vehicle's and the beacon's frequency.
    noise_std : float
        Of one complex sample.
    speed_of_sound : [m/s]
    """

    rate: float
    block: int
    pulse: int
    tones: Float[np.ndarray, "2"]
    noise_std: float
    speed_of_sound: float


def sampling(config: Config) -> Sampling:
    """Settle how a frame is sampled.

    Parameters
    ----------
    config : Config

    Returns
    -------
    Sampling

    Raises
    ------
    InputError
        When a tone is no whole bin of a block, or the call no whole number of blocks.

    Examples
    --------
    >>> settled = sampling(Config())
    >>> settled.block, settled.pulse
    (40, 14)
    """
    rate = config.receiver.sample_rate
    tones = np.array([config.emitter.frequency, config.beacon.frequency])
    for key, value, unit, count in (
        ("receiver.sample_rate", rate, "Hz", rate * BLOCK),
        ("emitter.frequency", tones[0], "Hz", tones[0] * BLOCK),
        ("beacon.frequency", tones[1], "Hz", tones[1] * BLOCK),
        ("emitter.pulse", config.emitter.pulse, "s", config.emitter.pulse / BLOCK),
    ):
        if round(count) < 1 or abs(count - round(count)) > 1e-6:
            step = f"{BLOCK:g} s" if unit == "s" else f"{1 / BLOCK:g} Hz"
            raise InputError(f"{key}: found {value:g} {unit}, expected a multiple of {step}")
    if tones[0] == tones[1]:
        raise InputError(
            f"beacon.frequency: found {tones[1]:g} Hz, the vehicle's own; expected another, "
            "or the two calls cannot be told apart"
        )
    return Sampling(
        rate=rate,
        block=round(rate * BLOCK),
        pulse=round(config.emitter.pulse / BLOCK),
        tones=tones,
        noise_std=10.0 ** (config.receiver.noise_level_db / 20.0),
        speed_of_sound=config.air.speed_of_sound,
    )


def blocks_to_hear(arrivals: Arrivals, sampling: Sampling) -> int:
    """Blocks from the end of the vehicle's call to the end of the last arrival.

    Parameters
    ----------
    arrivals : Arrivals
        Of the frame, the inaudible ones too: the window must not depend on the beam.
    sampling : Sampling

    Returns
    -------
    int
    """
    last = arrivals.delay.max(initial=0.0) / BLOCK + sampling.pulse
    return max(math.ceil(last) + 1 - sampling.pulse, 2 * sampling.pulse)


def block_shape(blocks: int, layout: Layout) -> tuple[int, int, int, int]:
    """Shape of a recording in block sums: (blocks, faces, tones, elements)."""
    return (blocks, layout.normal.size, 2, layout.position.size)


def noise_blocks(
    blocks: int,
    layout: Layout,
    sampling: Sampling,
    key: int,
    out: Complex[np.ndarray, "b f 2 e"] | None = None,
) -> Complex[np.ndarray, "b f 2 e"]:
    """Block sums of the microphones' noise.

    Parameters
    ----------
    blocks : int
    layout : Layout
    sampling : Sampling
    key : int
        Of the random stream; a block's noise does not depend on how many are drawn.
    out : (blocks, faces, tones, elements) complex, optional
        Written and returned instead of a new array.

    Returns
    -------
    (blocks, faces, tones, elements) complex
        Independent, of variance 40 sigma^2.
    """
    std = math.sqrt(sampling.block) * sampling.noise_std
    return complex_noise(block_shape(blocks, layout), std, key, out)


def add_echo_blocks(
    signal: Complex[np.ndarray, "b f 2 e"], arrivals: Arrivals, layout: Layout, sampling: Sampling
) -> None:
    """Add the block sums of arrivals to a recording, in place.

    Parameters
    ----------
    signal : (blocks, faces, tones, elements) complex
        Its first block follows the vehicle's call.
    arrivals : Arrivals
    layout : Layout
    sampling : Sampling
    """
    _add_echo_blocks(
        signal.view(np.float64), arrivals.delay, 10.0 ** (arrivals.level_db / 20.0),
        arrivals.bearing, arrivals.frequency, _durations(arrivals, sampling), layout.normal,
        layout.position, sampling.tones, sampling.rate, sampling.block, sampling.pulse,
        sampling.speed_of_sound,
    )  # fmt: skip


def record_samples(
    blocks: int,
    arrivals: Arrivals,
    layout: Layout,
    sampling: Sampling,
    rng: np.random.Generator | None,
    *,
    single: bool = False,
) -> Complex[np.ndarray, "t f e"]:
    """Every sample of a frame at the full rate: the reference engine.

    Parameters
    ----------
    blocks : int
        Length of the recording; its first sample follows the vehicle's call.
    arrivals : Arrivals
    layout : Layout
    sampling : Sampling
    rng : Generator or None
        Source of the noise; None records without.
    single : bool
        In single precision, as a recording would be kept.

    Returns
    -------
    (blocks * 40, faces, elements) complex
    """
    first = sampling.pulse * sampling.block
    shape = (blocks * sampling.block, layout.normal.size, layout.position.size)
    real, whole = (np.float32, np.complex64) if single else (np.float64, np.complex128)
    if rng is None:
        signal = np.zeros(shape, dtype=whole)
    else:
        signal = rng.standard_normal((*shape, 2), dtype=real).view(whole)[..., 0]
        signal *= real(sampling.noise_std / math.sqrt(2.0))
    duration = _durations(arrivals, sampling)
    for a in range(arrivals.delay.size):
        frequency, delay = arrivals.frequency[a], arrivals.delay[a]
        start = max(math.ceil(delay * sampling.rate), first)
        stop = min(math.ceil((delay + duration[a]) * sampling.rate), first + shape[0])
        n = np.arange(start, max(stop, start))
        pulse = 10.0 ** (arrivals.level_db[a] / 20.0) * np.exp(
            2j * np.pi * frequency * (n / sampling.rate - delay)
        )
        for f in range(layout.normal.size):
            angle = arrivals.bearing[a] - layout.normal[f]
            if math.cos(angle) >= 0.0:
                lead = layout.position * math.sin(angle) / sampling.speed_of_sound
                signal[n - first, f] += np.outer(pulse, np.exp(2j * np.pi * frequency * lead))
    return signal


def _durations(arrivals: Arrivals, sampling: Sampling) -> Float[np.ndarray, " a"]:
    """Length of each arrival [s]: the Doppler shift compresses the call."""
    nominal = sampling.tones[arrivals.source]
    return sampling.pulse * BLOCK * nominal / arrivals.frequency


@kernel
def _geometric_sum(omega, start, stop):
    """Sum of exp(i omega n) over start <= n < stop."""
    count = stop - start
    half = 0.5 * omega
    gain = float(count) if half == 0.0 else math.sin(half * count) / math.sin(half)
    phase = omega * (start + 0.5 * (count - 1))
    return complex(gain * math.cos(phase), gain * math.sin(phase))


@lean
def _envelope(sums, p, omega, start, stop, block):
    """Write a tone's block sums of exp(i omega n), start <= n < stop; return the blocks touched."""
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


@lean
def _steer(direct, turned, phasor, wave, position):
    """Write a phasor times each element's phase, and i times that, parts interleaved."""
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


@lean
def _add_echo(
    signal, first, sums, count, phasor, bearing, frequency, normal, position, speed_of_sound,
    direct, turned,
):  # fmt: skip
    """Add an arrival's envelope, block by block, times its steering vector."""
    for f in range(normal.size):
        angle = bearing - normal[f]
        if math.cos(angle) < 0.0:
            continue
        wave = 2.0 * math.pi * frequency * math.sin(angle) / speed_of_sound
        _steer(direct, turned, phasor, wave, position)
        for b in range(count):
            for p in range(2):
                re, im, heard = sums[p, b].real, sums[p, b].imag, signal[first + b, f, p]
                for i in range(heard.size):
                    heard[i] += re * direct[i] + im * turned[i]


@kernel
def _add_echo_blocks(
    signal, delay, amplitude, bearing, frequency, duration, normal, position,
    tones, rate, block, blank, speed_of_sound,
):  # fmt: skip
    """Add every arrival; of the signal each element's real and imaginary part are neighbours."""
    blocks = signal.shape[0]
    sums = np.empty((2, blocks), dtype=np.complex128)
    direct, turned = np.empty(signal.shape[3]), np.empty(signal.shape[3])
    for a in range(delay.size):
        start = max(math.ceil(delay[a] * rate), blank * block)
        stop = min(math.ceil((delay[a] + duration[a]) * rate), (blank + blocks) * block)
        if stop <= start:
            continue
        count = 0
        for p in range(2):
            omega = 2.0 * math.pi * (frequency[a] - tones[p]) / rate
            count = _envelope(sums, p, omega, start, stop, block)
        turns = -2.0 * math.pi * frequency[a] * delay[a]
        _add_echo(
            signal, start // block - blank, sums, count,
            amplitude[a] * complex(math.cos(turns), math.sin(turns)),
            bearing[a], frequency[a], normal, position, speed_of_sound, direct, turned,
        )  # fmt: skip
