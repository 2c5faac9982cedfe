"""When the vehicle called: told by ``calls.csv`` or a period, or found in the sound.

A trigger is a channel whose level rises when a call begins. Where nothing tells, the call is found
by its own leak into the microphones: nothing answers its matched filter as loudly. Counted is what
passes a share of the level that the loudest has in most stretches.
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.acoustics.call import Call
from pipistrelle.detection.logs.text_tables import place_of, read_table
from pipistrelle.detection.matched import BandFilters
from pipistrelle.detection.sounds.description import FILE as ABOUT
from pipistrelle.detection.sounds.description import Description
from pipistrelle.detection.sounds.sound_file import Sound
from pipistrelle.detection.sounds.tone_sums import Blocks
from pipistrelle.refusals import refusal

FILE = "calls.csv"
LONGEST = 2.0
"""How long is listened after a call at most [s]."""
MIN_GAP = 2
"""Fewest lengths of a call from the end of one to the beginning of the next."""
MOST_CALLS = 10_000_000
"""Most calls of a period: a day of a hundred a second, half a gigabyte of numbers."""
ONSET = 0.35
"""Share of the usual amplitude of a leak or a trigger that counts as a call."""
_STRETCH = 10.0
"""Time in which the vehicle calls at least once, where that is sought in the sound [s]."""
_LISTEN = 8
"""Most channels in which a leak is sought."""
_CHUNK = 1 << 21
"""Numbers that are read at a time where calls are sought."""


class Calls(NamedTuple):
    """The vehicle's calls, in order."""

    sample: Int[np.ndarray, " k"]
    """At which each begins, from 0 on."""
    time: Float[np.ndarray, " k"]
    """When, by the odometry's clock [s]."""
    length: Int[np.ndarray, " k"]
    """Samples that are listened to, from its beginning."""


def calls_of(folder: Path, about: Description, sound: Sound, blocks: Blocks, sent: Call) -> Calls:
    """Return when the vehicle called: told by a file or a setting, else found in the sound.

    A call is left out where the sound ends before a whole echo could be heard after it.
    """
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
    """Read ``calls.csv``: samples, and times where there are any."""
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
    """Return how many samples belong to each call; refuse calls that follow too fast."""
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
    """Yield the sound in pieces of whole steps, each with so many samples more of the next."""
    size = max(_CHUNK // sound.channels // step, 1) * step
    for first in range(0, sound.samples, size):
        samples = sound.read(first, min(size + more, sound.samples - first))
        sound.refuse_odd(first, samples)
        yield first, samples


def _least(sound: Sound, sample: Float[np.ndarray, " k"], level: Float[np.ndarray, " k"]) -> float:
    """Return the least level of a call, from the loudest of stretches."""
    stretches, stretch = np.unique(sample / sound.rate // _STRETCH, return_inverse=True)
    loudest = np.zeros(stretches.size)
    np.maximum.at(loudest, stretch, level)
    return ONSET * float(np.median(loudest))


def _triggered(sound: Sound, channel: int, where: str, apart: int) -> Float[np.ndarray, " k"]:
    """Return where one channel rises, and is as loud at the next sample, so far apart at least."""
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
    """Return where a call's matched filter answers the loudest, so many samples apart at least."""
    filters = BandFilters((sent,), sound.rate)
    step, loudest = filters.step, []
    some = max(apart // step, 1)
    for first, samples in _pieces(sound, some * step, filters.length + step):
        some_channels = samples[:, :: math.ceil(sound.channels / _LISTEN)]
        outputs = filters((some_channels - some_channels.mean(axis=0))[:, np.newaxis])
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
    """Return which are the loudest within so many samples, the first of several that are.

    Only neighbours in time are compared: of hours of a loud tone there are millions.
    """
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
    """Return how many steps beside the second of three levels a parabola through them peaks."""
    if level.size < 3 or level[1] <= max(level[0], level[2]):
        return 0.0
    return float(0.5 * (level[2] - level[0]) / (2.0 * level[1] - level[0] - level[2]))
