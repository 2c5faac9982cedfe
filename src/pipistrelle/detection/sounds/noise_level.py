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
from jaxtyping import Float, Int

from pipistrelle.detection.sounds.call_outputs import CallOutputs
from pipistrelle.detection.sounds.calls import Calls
from pipistrelle.detection.sounds.sound_file import Sound
from pipistrelle.detection.sounds.tone_sums import ToneSums
from pipistrelle.refusals import refusal

GROUP, FIRST_GAPS = 64, 8
"""How many gaps are listened to at a time; and how many to find which parts are quiet."""
STRETCHES, QUIET = 8, 3
"""Into how many stretches a gap is parted, and how many count at most."""
MIN_SUMS = 50
"""Fewest block sums of a channel."""
CHANCE = 5.0
"""Channels whose levels differ by fewer standard deviations have one."""


def set_noise(sums: ToneSums | CallOutputs, sound: Sound, calls: Calls, folder: Path) -> None:
    """Measure noise and mean of each channel, and have the sums scaled to unit noise."""
    last = calls.sample.size - 1
    first, gaps = (
        np.unique(np.linspace(0, last, most).round().astype(np.int64))
        for most in (FIRST_GAPS, sums.gaps)
    )
    means, constant = [], np.ones(sound.channels, dtype=bool)
    for samples in _gaps(sound, calls, first):
        heard = samples[sums.blocks.blank :]
        means.append(heard.mean(axis=0, dtype=np.float64))
        constant &= (heard == heard[0]).all(axis=0)
    sums.mean = np.mean(means, axis=0)
    quiet = _quiet(_powers(sums, sound, calls, first, range(STRETCHES)))
    groups = np.array_split(gaps, math.ceil(gaps.size / GROUP))
    level, count = np.zeros(sums.gain.shape), 0
    for group in groups:
        power = np.concatenate(_powers(sums, sound, calls, group, quiet))
        count += len(power)
        if len(power):
            middle = np.median(power, axis=0, overwrite_input=True)
            level += middle.astype(np.float64) / math.log(2.0) / len(groups)
    if count < MIN_SUMS * len(groups):
        found = f"{count} blocks in the quietest part of the gaps between calls"
        raise refusal(folder, found, f"{MIN_SUMS} or more", "record for longer")
    silent = (level == 0.0) | constant[sums.channel][:, np.newaxis]
    if silent.any():
        f, _, e = (int(one[0]) for one in np.nonzero(silent))
        where = f"{folder}, channel {sums.channel[f, e] + 1}"
        raise refusal(where, "no noise at all", "a microphone", "take it out of array.csv")
    sums.gain /= np.sqrt(_alike(level, count))


def _gaps(
    sound: Sound, calls: Calls, numbers: Int[np.ndarray, " g"]
) -> Iterator[Float[np.ndarray, "t m"]]:
    """Yield the samples of some gaps, from a call on."""
    for k in numbers:
        samples = sound.read(int(calls.sample[k]), int(calls.length[k]))
        sound.refuse_odd(int(calls.sample[k]), samples)
        yield samples


def _powers(
    sums: ToneSums | CallOutputs,
    sound: Sound,
    calls: Calls,
    numbers: Int[np.ndarray, " g"],
    stretches: Sequence[int],
) -> list[Float[np.ndarray, "b f c e"]]:
    """Return the powers in each of some stretches of some gaps."""
    power: list[list[np.ndarray]] = [[] for _ in stretches]
    for samples in _gaps(sound, calls, numbers):
        heard = sums(samples)[:: sums.apart]
        edges = np.linspace(0, len(heard), STRETCHES + 1).astype(np.int64)
        for stretch, part in zip(stretches, power, strict=True):
            some = heard[edges[stretch] : edges[stretch + 1]]
            part.append((some.real**2 + some.imag**2).astype(np.float32))
    return [np.concatenate(part) for part in power]


def _quiet(power: Sequence[Float[np.ndarray, "b f c e"]]) -> list[int]:
    """Return which stretches are as quiet as the quietest, but for chance: three at most."""
    level = np.array([np.median(part) if part.size else np.inf for part in power])
    order = level.argsort()[:QUIET]
    count = power[int(order[0])].size
    quiet = level[order] <= level.min() * (1.0 + 3.0 / math.sqrt(max(count, 1)))
    return np.sort(order[quiet]).tolist()


def _alike(power: Float[np.ndarray, "f c e"], count: int) -> Float[np.ndarray, "f c e"]:
    """Return the mean over all, or by frequency over channels, where chance explains the rest."""
    chance = CHANCE / (math.log(2.0) * math.sqrt(count))
    for axes in ((0, 1, 2), (0, 2)):
        mean = power.mean(axis=axes, keepdims=True)
        if np.abs(power / mean - 1.0).max() < chance:
            return np.broadcast_to(mean, power.shape)
    return power
