r"""Real samples -> block sums at the tones, as the front end takes them.

.. math:: S_b = 2 \sum_{n=bB}^{(b+1)B-1} x[n] e^{-2\pi i f n / f_s}

with n counted from the vehicle's call. Where a call and a block last a whole number of 0.2 ms and
tones are whole bins, blocks are those of the simulation, and noise is independent from tone to
tone; elsewhere blocks are about a fourteenth of a call, and tones any below half the rate.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from pipistrelle.config import BLOCK, InputError
from pipistrelle.jit import kernel

MIN_SAMPLES = 10
"""Fewest samples of a call."""


class Blocks(NamedTuple):
    """How samples are summed."""

    rate: float
    """[Hz]."""
    block: int
    """Samples per block."""
    pulse: int
    """Blocks per call."""
    blank: int
    """Samples from the beginning of the vehicle's call to the first block."""
    tones: Float[np.ndarray, " c"]
    """The vehicle's first [Hz]."""

    @property
    def interval(self) -> float:
        """Length of a block [s]."""
        return self.block / self.rate


def blocks_of(
    rate: float,
    duration: float,
    tones: Float[np.ndarray, " c"],
    where: str,
    deaf: float | None = None,
) -> Blocks:
    """Choose the blocks of a call of a duration [s].

    `where`: the file, for refusals; `deaf`: time before the first block, else the duration [s].

    >>> blocks_of(200e3, 2.8e-3, np.array([35e3, 30e3]), "")[1:4]
    (40, 14, 560)
    >>> blocks_of(192e3, 5e-4, np.array([40e3]), "")[1:4]
    (8, 12, 96)
    """
    if tones.max() >= rate / 2.0:
        raise InputError(
            f"{where}: found a frequency of {tones.max():g} Hz, expected less than half the sample "
            f"rate of {rate:g} Hz; correct the one that is wrong"
        )
    length = duration * rate
    if length < MIN_SAMPLES:
        raise InputError(
            f"{where}: found a duration of {duration:g} s, {length:.3g} samples at {rate:g} Hz; "
            f"expected {MIN_SAMPLES} or more; correct the one that is wrong"
        )
    whole = [rate * BLOCK, duration / BLOCK, *(tones * BLOCK)]
    if all(round(one) >= 1 and abs(one - round(one)) < 1e-6 for one in whole):
        block, pulse = round(rate * BLOCK), round(duration / BLOCK)
    else:
        choice = [(max(round(length / count), 1), count) for count in range(MIN_SAMPLES, 21)]
        block, pulse = min(choice, key=lambda b: (abs(b[0] * b[1] - length), abs(b[1] - 14)))
    blank = length if deaf is None else deaf * rate
    return Blocks(rate, block, pulse, math.ceil(blank - 1e-6), tones)


class ToneSums:
    """Sums samples of the channels of an array, each scaled by its own noise."""

    apart, gaps = 1, 256
    """Sums from one that tells of the noise to the next; most gaps between calls, spread over the
    recording, in which it is listened to."""

    def __init__(self, blocks: Blocks, channel: Int[np.ndarray, "f e"]) -> None:
        self.blocks, self.channel = blocks, channel
        turns = np.outer(blocks.tones, np.arange(blocks.block)) / blocks.rate
        wave = np.exp(-2j * np.pi * turns)
        self._table = np.ascontiguousarray(np.stack((wave.real, wave.imag), axis=1))
        self.gain = np.full((len(channel), blocks.tones.size, channel.shape[1]), 2.0)
        """What a sum is multiplied by."""
        self.mean = np.zeros(int(channel.max()) + 1)
        """Of the samples of each channel; taken away."""

    def __call__(
        self, samples: Float[np.ndarray, "t m"], out: Complex[np.ndarray, "..."] | None = None
    ) -> Complex[np.ndarray, "b f c e"]:
        """Return the sums of the blocks after the call with which the samples begin."""
        heard, on = samples[self.blocks.blank :], self.blocks
        shape = (len(heard) // on.block, *self.gain.shape)
        sums = np.empty(shape, dtype=np.complex128) if out is None else out
        begin = on.blank + on.block * np.arange(shape[0])
        turn = np.exp(-2j * np.pi * np.outer(begin, on.tones) / on.rate)
        _sum_blocks(heard, self._table, turn, self.channel, self.gain, self.mean, sums)
        return sums


@kernel
def _sum_blocks(
    samples: Float[np.ndarray, "t m"],
    table: Float[np.ndarray, "c 2 n"],
    turn: Complex[np.ndarray, "b c"],
    channel: Int[np.ndarray, "f e"],
    gain: Float[np.ndarray, "f c e"],
    mean: Float[np.ndarray, " k"],
    sums: Complex[np.ndarray, "b f c e"],
) -> None:
    """Write the sums of whole blocks at each tone."""
    tones, _, block = table.shape
    channels = samples.shape[1]
    total, offset = np.empty((tones, 2, channels)), np.zeros((tones, 2))
    for c in range(tones):
        for part in range(2):
            for n in range(block):
                offset[c, part] += table[c, part, n]
    for b in range(sums.shape[0]):
        total[:] = 0.0
        for n in range(block):
            row = samples[b * block + n]
            for c in range(tones):
                cosine, sine = table[c, 0, n], table[c, 1, n]
                real, imaginary = total[c, 0], total[c, 1]
                for m in range(channels):
                    real[m] += cosine * row[m]
                    imaginary[m] += sine * row[m]
        for f in range(channel.shape[0]):
            for c in range(tones):
                for e in range(channel.shape[1]):
                    m = channel[f, e]
                    real = total[c, 0, m] - mean[m] * offset[c, 0]
                    imaginary = total[c, 1, m] - mean[m] * offset[c, 1]
                    sums[b, f, c, e] = gain[f, c, e] * turn[b, c] * complex(real, imaginary)
