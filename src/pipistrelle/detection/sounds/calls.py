"""When the vehicle called: told by ``calls.csv`` or a period, or found in the sound.

A trigger is a channel whose level rises when a call begins. Where nothing tells, the call is found
by its own leak into the microphones: nothing at its frequency is as loud, so its front edge stands
where the level passes a share of what it is in most stretches at its loudest.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import TONE
from pipistrelle.detection.logs.text_tables import place_of, read_table
from pipistrelle.detection.sounds.description import FILE as ABOUT
from pipistrelle.detection.sounds.description import Description
from pipistrelle.detection.sounds.sound_file import Sound
from pipistrelle.detection.sounds.tone_sums import Blocks, ToneSums
from pipistrelle.refusals import refusal

FILE = "calls.csv"
LONGEST = 2.0
"""How long is listened after a call at most [s]."""
MIN_GAP = 2
"""Fewest lengths of a call from the end of one to the beginning of the next."""
ONSET = 0.35
"""Share of a leak's, or a trigger's, amplitude at which a call begins."""
_STRETCH = 10.0
"""Time in which the vehicle calls at least once, where that is sought in the sound [s]."""
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


def calls_of(folder: Path, about: Description, sound: Sound, blocks: Blocks) -> Calls:
    """Return when the vehicle called, as it is told, or else found."""
    path, call = folder / FILE, about.call
    time = None
    if os.path.lexists(path):
        sample, time = _told(path, sound)
        where = str(path)
    elif call.period is not None:
        count = max((sound.samples / sound.rate - call.first) / call.period, 0.0)
        sample = np.rint((call.first + np.arange(np.ceil(count)) * call.period) * sound.rate)
        where = f"{folder / ABOUT}, key 'call.period'"
    elif call.trigger is not None:
        where = f"{folder / ABOUT}, key 'call.trigger'"
        each = blocks._replace(block=1, pulse=4)  # an edge, to a sample
        sample = _onsets(sound, each, _trigger(sound, call.trigger - 1, where), blocks.blank)
    elif call.call != TONE:
        fix = f"write {FILE}, or call.period or call.trigger in {ABOUT}"
        raise refusal(folder, f"nothing that tells when the {call.call} comes", "it", fix)
    else:
        where = f"{folder}, the call's leak at {call.frequency:g} Hz"
        sample = _onsets(sound, blocks, _leak(sound, blocks), 2 * blocks.blank)
    sample = sample[sample + blocks.blank < sound.samples].astype(np.int64)
    if not sample.size:
        raise refusal(where, "no call in the sound", "one or more", "say when it calls")
    stamp = about.start + sample / sound.rate
    time = stamp if time is None else np.where(np.isnan(time), stamp, time)[: sample.size]
    return Calls(sample, time, _lengths(sample, sound, blocks, where))


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
        raise refusal(where, found, expected, "correct the calls, or call.duration")
    length = np.append(gap, last).clip(max=round(LONGEST * sound.rate))
    return np.minimum(length, sound.samples - sample)


Levels = Callable[[Float[np.ndarray, "t m"]], Float[np.ndarray, " b"]]
"""Gives the amplitude in each block of samples."""


def _trigger(sound: Sound, channel: int, where: str) -> Levels:
    """Return the level of one channel, sample by sample."""
    if channel >= sound.channels:
        found, expected = f"channel {channel + 1}", f"1 to {sound.channels}"
        raise refusal(where, found, expected, "correct it")

    def level(samples: Float[np.ndarray, "t m"]) -> Float[np.ndarray, " b"]:
        return np.abs(samples[:, channel]).astype(np.float64)

    return level


def _leak(sound: Sound, blocks: Blocks) -> Levels:
    """Return the level of all channels at the frequency of the vehicle's call."""
    whole = blocks._replace(blank=0, tones=blocks.tones[:1])
    sums = ToneSums(whole, np.arange(sound.channels)[np.newaxis])

    def level(samples: Float[np.ndarray, "t m"]) -> Float[np.ndarray, " b"]:
        return np.sqrt((np.abs(sums(samples)) ** 2).sum(axis=(1, 2, 3)))

    return level


def _onsets(sound: Sound, blocks: Blocks, level: Levels, apart: int) -> Float[np.ndarray, " k"]:
    """Return where a level rises for as long as a call, to a part of a block.

    `apart`: fewest samples from one to the next.
    """
    at_once = max(_CHUNK // sound.channels // blocks.block, 4 * blocks.pulse)
    starts = range(0, sound.samples // blocks.block, at_once)

    def read(start: int, count: int) -> Float[np.ndarray, " b"]:
        count = min(count, sound.samples // blocks.block - start)
        samples = sound.read(start * blocks.block, count * blocks.block)
        sound.refuse_odd(start * blocks.block, samples)
        return level(samples)

    loudest = np.array([read(start, at_once).max() for start in starts])
    parts = max(round(_STRETCH * sound.rate / blocks.block / at_once), 1)
    stretches = [loudest[i : i + parts].max() for i in range(0, loudest.size, parts)]
    least, found = ONSET * float(np.median(stretches)), [-np.inf]
    for start in starts:
        # two blocks of the piece before, and a call of the one after
        first = max(start - 2, 0)
        amplitude = read(first, at_once + start - first + blocks.pulse)
        above = amplitude >= least
        for b in np.flatnonzero(above[1:] & ~above[:-1]) + 1:
            whole = amplitude[b + 1 : b + blocks.pulse - 1]
            if not start <= first + b < start + at_once or whole.size < blocks.pulse - 2:
                continue
            if np.mean(whole >= least) < 0.75:
                continue
            share = np.minimum(amplitude[max(b - 1, 0) : b + 1] / np.median(whole), 1.0).sum()
            sample = blocks.block * max(first + b + 1 - share, 0.0)
            if sample - found[-1] > apart:
                found.append(sample)
    return np.rint(np.array(found[1:]))
