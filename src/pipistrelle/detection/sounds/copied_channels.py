r"""Channels that hold one microphone's sound, as a wrong route or list of channels makes them.

Two microphones have noise of their own, so no channel is a multiple of another. Of a copy, scaled
by a and perhaps some samples late, nothing is left but what rounding to a file's quantum q adds,

.. math:: \sum_t (x_j[t] - a x_i[t - d])^2 \le \frac{q^2}{12} (1 + a^2) n
          \left(1 + 5 \sqrt{2 / n}\right) ,

five standard deviations over its mean for n samples. Where all sound is below that, nothing can be
told of it.
"""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.detection.sounds.calls import Calls
from pipistrelle.detection.sounds.sound_file import Sound

GAPS, SAMPLES = 16, 8192
"""Most gaps that are looked at, spread over the recording, and most samples of each."""
LATEST = 2
"""Most samples by which a copy is earlier or later."""
ROUNDING = 1e-12
"""Share of a channel's power that floating-point numbers may add."""


def copied_channels(
    sound: Sound, calls: Calls, blank: int, used: Int[np.ndarray, " m"]
) -> Iterator[str]:
    """Say which of the channels that are used (numbered from 0) are copies of others.

    `blank`: samples from the beginning of a call to those that are looked at.
    """
    product, source, power, count = _sums(sound, calls, blank, used)
    audible = (source > 0.0)[:, :, np.newaxis] & (power > 0.0)
    scale = product / np.where(source > 0.0, source, 1.0)[:, :, np.newaxis]
    explained = scale * product
    chance = count * (1.0 + 5.0 * math.sqrt(2.0 / max(count, 1)))
    limit = sound.quantum**2 / 12.0 * (1.0 + scale**2) * chance + ROUNDING * power
    copied = audible & (power - explained <= limit) & (explained > limit)
    for j in range(1, used.size):
        if copied[:, :j, j].any():
            late, i = np.argwhere(copied[:, :j, j])[0]
            times, late = scale[late, i, j], int(late) - LATEST
            words = f", times {times:.3g}" if abs(times - 1.0) > 1e-3 else ""
            words += f", {abs(late)} samples {'late' if late > 0 else 'early'}" if late else ""
            yield (
                f"channel {used[j] + 1} is a copy of channel {used[i] + 1}{words}: of one "
                "microphone two are made, and bearings are wrong; mend the route, or take one out "
                "of array.csv"
            )


def _sums(
    sound: Sound, calls: Calls, blank: int, used: Int[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "d m m"], Float[np.ndarray, "d m"], Float[np.ndarray, " m"], int]:
    """Return the sums of products of channels, the first so many samples earlier, and of squares.

    And of how many samples they are.
    """
    lates = range(-LATEST, LATEST + 1)
    product, count = np.zeros((len(lates), used.size, used.size)), 0
    source, power = np.zeros((len(lates), used.size)), np.zeros(used.size)
    last = calls.sample.size - 1
    for k in np.unique(np.linspace(0, last, GAPS).round().astype(np.int64)):
        first = int(calls.sample[k]) + blank
        samples = sound.read(first, min(int(calls.length[k]) - blank, SAMPLES))
        sound.refuse_odd(first, samples)
        heard = samples[:, used].astype(np.float64)
        if len(heard) <= 2 * LATEST:
            continue
        there = heard[LATEST : len(heard) - LATEST]
        there = there - there.mean(axis=0)
        for row, late in enumerate(lates):
            before = heard[LATEST - late : len(heard) - LATEST - late]
            before = before - before.mean(axis=0)
            product[row] += before.T @ there
            source[row] += (before**2).sum(axis=0)
        power += (there**2).sum(axis=0)
        count += len(there)
    return product, source, power, count
