r"""Times of the vehicle's calls in a recording, and the matched-filter sums of its samples.

Calls are stated by ``calls.csv`` or a period, or found in the sound: by a trigger channel whose
level rises when a call begins, or else by the call's leakage into the microphones, the strongest
output of its matched filter. A peak counts if it passes a share of the typical loudest level.

For tones, real samples become block sums, as in the front end:

.. math:: S_b = 2 \sum_{n=bB}^{(b+1)B-1} x[n] e^{-2\pi i f n / f_s}

with n counted from the vehicle's call, and the blocks of the simulation
(`pipistrelle.acoustics.call.blocks_of`). If any call is not a tone, samples become outputs of
matched filters.
"""

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from pipistrelle.acoustics.call import Call, ToneBurst
from pipistrelle.config import BLOCK
from pipistrelle.detection.matched import GROUP, BandFilters, Workspace
from pipistrelle.detection.sounds.sound_file import FILE as ABOUT
from pipistrelle.detection.sounds.sound_file import Description, Sound
from pipistrelle.jit import kernel
from pipistrelle.refusals import refusal
from pipistrelle.text_tables import place_of, read_table


class Blocks(NamedTuple):
    """Sampling of a frame: sample rate, block length and tones."""

    rate: float
    """[Hz]."""
    block: int
    """Samples per block."""
    pulse: int
    """Blocks per call."""
    blank: int
    """Samples from the beginning of the vehicle's call to the first block."""
    tones: Float[np.ndarray, " c"]
    """Frequencies of the calls, the vehicle's first [Hz]."""

    @property
    def interval(self) -> float:
        """Duration of a block of samples [s]."""
        return self.block / self.rate


class ToneSums:
    """Converter of samples to block sums at each tone, for all channels, in units of the noise."""

    apart, gaps, cut = 1, 256, 0
    """Step between sums for the noise; most gaps between calls that are read for it; sums at each
    end at which a call is only partly in the record."""

    def __init__(self, blocks: Blocks, channel: Int[np.ndarray, "f e"]) -> None:
        self.blocks, self.channel = blocks, channel
        turns = np.outer(blocks.tones, np.arange(blocks.block)) / blocks.rate
        wave = np.exp(-2j * np.pi * turns)
        self._table = np.ascontiguousarray(np.stack((wave.real, wave.imag), axis=1))
        self.gain = np.full((len(channel), blocks.tones.size, channel.shape[1]), 2.0)
        """Factor of a sum."""
        self.mean = np.zeros(int(channel.max()) + 1)
        """Mean of each channel's samples, which is subtracted."""

    def __call__(
        self, samples: Float[np.ndarray, "t m"], out: Complex[np.ndarray, "..."] | None = None
    ) -> Complex[np.ndarray, "b f c e"]:
        """Return the block sums of the samples after a call; the samples begin with the call."""
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
    """Write the sums of each channel's samples over blocks at each tone."""
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


class CallOutputs:
    """Converter of samples to matched-filter outputs per call and channel, in units of the noise.

    Used instead of `ToneSums` and its boxcar if any call is not a tone; a block is a lag here.
    """

    gaps = 64
    """Most gaps between calls that give the noise."""

    def __init__(
        self, calls: Sequence[Call], rate: float, blank: int, channel: Int[np.ndarray, "f e"]
    ) -> None:
        self._filters = BandFilters(calls, rate)
        tones = np.array([call.frequency for call in calls])
        self.blocks = Blocks(rate, self._filters.step, self._filters.pulse, blank, tones)
        self.cut = self._filters.cut
        self.channel = channel
        tone = any(isinstance(call, ToneBurst) for call in calls)
        alike = self.blocks.pulse if tone else round(BLOCK / self.blocks.interval)
        self.apart = max(alike, 1)
        """Step between outputs that give the noise, so that they are independent."""
        self.gain = np.ones((len(channel), len(calls), channel.shape[1]))
        """Factor of an output."""
        self.mean = np.zeros(int(channel.max()) + 1)
        """Mean of each channel's samples, which is subtracted."""

    def __call__(
        self, samples: Float[np.ndarray, "t m"], room: Workspace | None = None
    ) -> Complex[np.ndarray, "l f c e"]:
        """Return the outputs of the samples after a call; the samples begin with the vehicle's.

        At `cut` lags of each end, only a part of a call is received.
        """
        heard, gain = samples[self.blocks.blank :], self.gain.swapaxes(0, 1)
        return self._filters(heard, self.channel, gain, self.mean, room)


FILE = "calls.csv"
LONGEST = 2.0
"""Longest time after a call that is used [s]."""
MIN_GAP = 2
"""Fewest call lengths from the end of a call to the beginning of the next."""
MOST_CALLS = 10_000_000
"""Most calls of a period: a day of a hundred a second, half a gigabyte of numbers."""
ONSET = 0.35
"""Share of the usual amplitude of a leak or a trigger that counts as a call."""
_STRETCH = 10.0
"""Time in which the vehicle calls at least once, if calls are sought in the sound [s]."""
_CHUNK = 1 << 21
"""Numbers that are read at a time to find calls."""


class Calls(NamedTuple):
    """First samples, times and lengths of the vehicle's calls in a recording."""

    sample: Int[np.ndarray, " k"]
    """Sample at which each begins, from 0."""
    time: Float[np.ndarray, " k"]
    """Time by the odometry's clock [s]."""
    length: Int[np.ndarray, " k"]
    """Samples that belong to each call, from its beginning."""

    def spread(self, most: int) -> Int[np.ndarray, " g"]:
        """Return the indices of at most `most` calls, spread evenly over the recording."""
        return np.unique(np.linspace(0, self.sample.size - 1, most).round().astype(np.int64))

    def gaps(
        self, sound: Sound, numbers: Int[np.ndarray, " g"]
    ) -> Iterator[Float[np.ndarray, "t m"]]:
        """Yield the samples of some calls, each from its beginning to the next call."""
        for first, count in zip(self.sample[numbers], self.length[numbers], strict=True):
            samples = sound.read(int(first), int(count))
            sound.refuse_odd(int(first), samples)
            yield samples


def calls_of(folder: Path, about: Description, sound: Sound, blocks: Blocks, sent: Call) -> Calls:
    """Return the vehicle's calls: from ``calls.csv`` or a setting, or found in the sound."""
    path, call = folder / FILE, about.call
    stated = None
    if os.path.lexists(path):
        sample, stated = _told(path, sound)
        where = str(path)
    elif call.period is not None:
        count = max((sound.samples / sound.rate - call.first) / call.period, 0.0)
        where = f"{folder / ABOUT}, key 'call.period'"
        if count > MOST_CALLS:
            expected = f"{MOST_CALLS} or fewer"
            raise refusal(where, f"{count:.0f} calls in the sound", expected, "part the recording")
        sample = np.rint((call.first + np.arange(np.ceil(count)) * call.period) * sound.rate)
    elif call.trigger is not None:
        where = f"{folder / ABOUT}, key 'call.trigger'"
        sample = _triggered(sound, call.trigger - 1, where, blocks.blank)
    else:
        where = f"{folder}, the call's leak into the microphones"
        sample = _leaks(sound, sent, 2 * blocks.blank)
    time = about.start + sample / sound.rate
    if stated is not None:
        time = np.where(np.isnan(stated), time, stated)
    heard = sample + blocks.blank + (blocks.pulse + 1) * blocks.block <= sound.samples
    if not heard.any():
        found = "no call in the sound"
        if sample.size:
            left = sound.samples - int(sample[0])
            found = f"no call after which an echo could be heard: {left} samples follow the first"
        raise refusal(where, found, "one or more", "say when it calls")
    sample = sample[heard].astype(np.int64)
    return Calls(sample, time[heard], _lengths(sample, sound, blocks, where))


def _told(path: Path, sound: Sound) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Read ``calls.csv``; return the sample and the time of each call, NaN if not stated."""
    table = read_table(path, ("sample",), optional=("time",))
    sample, time = table.column["sample"], table.column["time"]
    for wrong, found, expected in (
        (sample != np.rint(sample), "no whole number", "the number of a sample"),
        ((sample < 0) | (sample >= sound.samples), "a sample outside the sound",
         f"0 to {sound.samples - 1}"),
        (np.diff(sample, prepend=-np.inf) <= 0, "a call not after the one before it",
         "samples that rise"),
    ):  # fmt: skip
        if wrong.any():
            row = int(np.argmax(wrong))
            found = f"{found}: {sample[row].item()!r}"
            raise refusal(place_of(table, row), found, expected, "correct or remove the row")
    return sample, time


def _lengths(
    sample: Int[np.ndarray, " k"], sound: Sound, blocks: Blocks, where: str
) -> Int[np.ndarray, " k"]:
    """Return the number of samples from each call to the next; raise if calls follow too fast."""
    gap = np.diff(sample)
    last = int(np.median(gap)) if gap.size else round(LONGEST * sound.rate)
    least = blocks.blank + MIN_GAP * blocks.pulse * blocks.block
    if gap.size and gap.min() < least:
        number = int(np.argmin(gap)) + 1
        found = f"{gap.min()} samples from call {number} to the next"
        expected = f"{least} or more: {1 + MIN_GAP} times its duration of {blocks.blank} samples"
        raise refusal(where, found, expected, f"correct call.duration, or say in {FILE} when")
    length = np.append(gap, last).clip(max=round(LONGEST * sound.rate))
    return np.minimum(length, sound.samples - sample)


def _pieces(sound: Sound, step: int, more: int) -> Iterator[tuple[int, Float[np.ndarray, "t m"]]]:
    """Yield a recording's samples in consecutive pieces, each with `more` samples of the next."""
    size = max(_CHUNK // sound.channels // step, 1) * step
    for first in range(0, sound.samples, size):
        samples = sound.read(first, min(size + more, sound.samples - first))
        sound.refuse_odd(first, samples)
        yield first, samples


def _least(sound: Sound, sample: Float[np.ndarray, " k"], level: Float[np.ndarray, " k"]) -> float:
    """Return the least level that counts as a call, a share of the median loudest level."""
    stretches, stretch = np.unique(sample / sound.rate // _STRETCH, return_inverse=True)
    loudest = np.zeros(stretches.size)
    np.maximum.at(loudest, stretch, level)
    return ONSET * float(np.median(loudest))


def _triggered(sound: Sound, channel: int, where: str, apart: int) -> Float[np.ndarray, " k"]:
    """Return the samples where the trigger channel rises, with a minimum gap."""
    if channel >= sound.channels:
        found, expected = f"channel {channel + 1}", f"1 to {sound.channels}"
        raise refusal(where, found, expected, "correct it")
    loudest = [(first, np.abs(some[:, channel]).max()) for first, some in _pieces(sound, 1, 0)]
    least, found = _least(sound, *np.array(loudest).T), [-np.inf]
    for begin, samples in _pieces(sound, 1, 2):
        above = np.abs(samples[:, channel]) >= least
        rises = np.flatnonzero(above[1:-1] & above[2:] & ~above[:-2]) + 1
        for sample in begin + rises:
            if sample - found[-1] > apart:
                found.append(float(sample))
    return np.array(found[1:])


def _leaks(sound: Sound, sent: Call, apart: int) -> Float[np.ndarray, " k"]:
    """Return the samples where the call leaks into the microphones, with a minimum gap."""
    filters = BandFilters((sent,), sound.rate)
    channel = np.arange(0, sound.channels, math.ceil(sound.channels / GROUP))[np.newaxis]
    step, loudest = filters.step, []
    some = max(apart // step, 1)
    for first, samples in _pieces(sound, some * step, filters.length + step):
        outputs = filters(samples, channel, mean=samples.mean(axis=0))
        outputs = outputs[filters.cut : len(outputs) - filters.cut]
        level = np.sqrt((outputs.real**2 + outputs.imag**2).sum(axis=(1, 2, 3)))
        found = np.empty((-(-len(level) // some), 2))
        for i, begin in enumerate(range(0, len(level), some)):
            k = begin + int(level[begin : begin + some].argmax())
            found[i] = first + step * (k + _aside(level[max(k - 1, 0) : k + 2])), level[k]
        loudest.append(found)
    if not sum(map(len, loudest)):
        return np.empty(0)
    sample, level = np.concatenate(loudest).T
    loud = (level >= _least(sound, sample, level)) & (level > 0.0)
    kept = _loudest_around(sample[loud], level[loud], apart)
    return np.rint(np.maximum(sample[loud][kept], 0.0))


def _loudest_around(
    sample: Float[np.ndarray, " k"], level: Float[np.ndarray, " k"], apart: int
) -> Bool[np.ndarray, " k"]:
    """Return a mask of the samples that are the loudest within a gap, the first of equals."""
    order = np.argsort(sample, kind="stable")
    place = sample[order]
    begin = np.searchsorted(place, place - apart - 1.0)
    until = np.searchsorted(place, place + apart + 1.0)
    kept = np.zeros(sample.size, dtype=bool)
    for i, first, last in zip(order, begin, until, strict=True):
        near = np.sort(order[first:last])
        near = near[np.abs(sample[near] - sample[i]) <= apart]
        kept[i] = i == near[level[near].argmax()]
    return kept


def _aside(level: Float[np.ndarray, " n"]) -> float:
    """Return the offset of a parabola's peak from the middle of three levels, in steps."""
    if level.size < 3 or level[1] <= max(level[0], level[2]):
        return 0.0
    return float(0.5 * (level[2] - level[0]) / (2.0 * level[1] - level[0] - level[2]))
