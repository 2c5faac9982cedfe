r"""The noise of each channel at each frequency, as a recording itself tells.

Echoes fill much of the time after a call. So the gap from call to call is parted into stretches,
and those count which are as quiet as the quietest, over all channels. Of their block sums :math:`S`
each channel's level is that of the median: the power of noise is exponentially distributed,

.. math:: \sigma^2 = \operatorname{median}(|S|^2) / \ln 2 ,

and nearly half of the sums may be anything. Where channels, or frequencies too, differ by no more
than chance, they have one level, their mean: to weigh them by their chance would move bearings.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.sounds.calls import Calls
from pipistrelle.detection.sounds.sound_file import Sound
from pipistrelle.detection.sounds.tone_sums import ToneSums
from pipistrelle.refusals import refusal

GAPS, FIRST_GAPS = 64, 8
"""Most gaps that are listened to, spread over the recording; and to find which parts are quiet."""
STRETCHES = 8
"""Into which a gap is parted."""
MIN_SUMS = 50
"""Fewest block sums of a channel."""
CHANCE = 5.0
"""Channels whose levels differ by fewer standard deviations have one."""


def set_noise(sums: ToneSums, sound: Sound, calls: Calls, folder: Path) -> None:
    """Measure noise and mean of each channel, and have the sums scaled to unit noise."""
    means = [
        part[sums.blocks.blank :].mean(axis=0, dtype=np.float64)
        for part in _gaps(sound, calls, FIRST_GAPS)
    ]
    sums.mean = np.mean(means, axis=0)
    quiet = _quiet(_powers(sums, sound, calls, FIRST_GAPS, range(STRETCHES)))
    power = _powers(sums, sound, calls, GAPS, quiet)
    square = np.concatenate([one for part in power for one in part])
    del power
    if len(square) < MIN_SUMS:
        found = f"{len(square)} blocks in the quietest part of the gaps between calls"
        raise refusal(folder, found, f"{MIN_SUMS} or more", "record for longer")
    level = np.median(square, axis=0, overwrite_input=True).astype(np.float64) / math.log(2.0)
    if not level.all():
        f, _, e = (int(one[0]) for one in np.nonzero(level == 0.0))
        where = f"{folder}, channel {sums.channel[f, e] + 1}"
        raise refusal(where, "no noise at all", "a microphone", "take it out of array.csv")
    sums.gain /= np.sqrt(_alike(level, len(square)))


def _gaps(sound: Sound, calls: Calls, most: int) -> Iterator[Float[np.ndarray, "t m"]]:
    """Yield the samples of some gaps, spread over the recording, from a call on."""
    for k in np.unique(np.linspace(0, calls.sample.size - 1, most).round().astype(np.int64)):
        samples = sound.read(int(calls.sample[k]), int(calls.length[k]))
        sound.refuse_odd(int(calls.sample[k]), samples)
        yield samples


def _powers(
    sums: ToneSums, sound: Sound, calls: Calls, most: int, stretches: Sequence[int]
) -> list[list[Float[np.ndarray, "b f c e"]]]:
    """Return the powers in some stretches of some gaps."""
    power: list[list[Float[np.ndarray, "b f c e"]]] = [[] for _ in stretches]
    for samples in _gaps(sound, calls, most):
        heard = sums(samples)
        edges = np.linspace(0, len(heard), STRETCHES + 1).astype(np.int64)
        for part, stretch in zip(power, stretches, strict=True):
            some = heard[edges[stretch] : edges[stretch + 1]]
            part.append((some.real**2 + some.imag**2).astype(np.float32))
    return power


def _quiet(power: Sequence[Sequence[Float[np.ndarray, "b f c e"]]]) -> list[int]:
    """Return which stretches are as quiet as the quietest, but for chance."""
    whole = [np.concatenate(part) for part in power]
    level = np.array([np.median(part) if part.size else np.inf for part in whole])
    count = whole[int(level.argmin())].size
    return np.flatnonzero(level <= level.min() * (1.0 + 3.0 / math.sqrt(max(count, 1)))).tolist()


def _alike(power: Float[np.ndarray, "f c e"], count: int) -> Float[np.ndarray, "f c e"]:
    """Return the mean over all, or by frequency over channels, where chance explains the rest."""
    chance = CHANCE / (math.log(2.0) * math.sqrt(count))
    for axes in ((0, 1, 2), (0, 2)):
        mean = power.mean(axis=axes, keepdims=True)
        if np.abs(power / mean - 1.0).max() < chance:
            return np.broadcast_to(mean, power.shape)
    return power
