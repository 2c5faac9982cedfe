"""Mistakes that everybody makes: what is odd about a recording, and what would explain it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pipistrelle.acoustics.call import Call, ToneBurst
from pipistrelle.arrays.bands import extent_of, replica
from pipistrelle.config import Config
from pipistrelle.detection.sounds.calls import Calls, calls_of
from pipistrelle.detection.sounds.check_array import BETTER, array_faults
from pipistrelle.detection.sounds.copied_channels import copied_channels
from pipistrelle.detection.sounds.description import Description
from pipistrelle.detection.sounds.hearing import Hearing, sums_of
from pipistrelle.detection.sounds.recorded_array import RecordedArray, recorded_array
from pipistrelle.detection.sounds.sound_file import Sound, open_sound
from pipistrelle.detection.sounds.tone_sums import Blocks

GAPS = 16
"""Most gaps that are looked at, spread over the recording."""
RATES = (44_100, 48_000, 88_200, 96_000, 176_400, 192_000, 200_000, 250_000, 256_000, 300_000,
         384_000, 500_000)  # fmt: skip
"""Usual sample rates [Hz]."""
_FAINT, _FLAT = 10 ** (-30 / 20), 10
"""A dead channel's noise beside the others'; fewest flat tops of a clipped one."""
LEAKS = 0.5
"""Least share of the sound while the vehicle calls that is its call at some sample rate."""


def check_recording(folder: Path, about: Description, config: Config) -> list[str]:
    """Return what is odd about a recording, a line each."""
    with open_sound(folder, about) as sound:
        array = recorded_array(folder, sound.channels, one_centre=about.one_centre)
        sums, sent = sums_of(folder, sound, about, array)
        blocks = sums.blocks
        calls = calls_of(folder, about, sound, blocks, sent[0])
        gaps = np.unique(np.linspace(0, calls.sample.size - 1, GAPS).round().astype(np.int64))
        dead, faults = _channels(sound, calls, gaps, array)
        faults += copied_channels(sound, calls, blocks.blank, array.used)
        look = _tone_rate if isinstance(sent[0], ToneBurst) else _call_rate
        faults += look(sound, calls, gaps, sent[0])
        faults += _clock(calls, blocks)
        if dead:
            return [*faults, "the order of the channels was not looked at, for some are dead"]
        hearing = Hearing.of(folder, sound, about, config)
        return [*faults, *array_faults(hearing)]


def _channels(
    sound: Sound, calls: Calls, gaps: Int[np.ndarray, " g"], array: RecordedArray
) -> tuple[bool, list[str]]:
    """Look for channels that are dead, clipped or off zero; tell whether any is dead."""
    noise, mean, flat = [], [], np.zeros(sound.channels)
    for k in gaps:
        samples = sound.read(int(calls.sample[k]), int(calls.length[k]))
        sound.refuse_odd(int(calls.sample[k]), samples)
        mean.append(samples.mean(axis=0, dtype=np.float64))
        noise.append(np.median(np.abs(samples - np.median(samples, axis=0)), axis=0))
        most = np.abs(samples).max(axis=0)
        top = (np.abs(samples) == most) & (most > 0.0)
        flat += (top[1:] & top[:-1] & (np.sign(samples[1:]) == np.sign(samples[:-1]))).sum(axis=0)
    level, offset = np.median(noise, axis=0), np.mean(mean, axis=0)
    used = array.used
    usual = float(np.median(level[used]))
    faults, dead = [], [m for m in used if level[m] <= _FAINT * usual]
    for m in used:
        if m in dead:
            faults.append(f"channel {m + 1} is dead: its noise is {level[m]:.2g}, that of the "
                          f"others {usual:.2g}")  # fmt: skip
        elif flat[m] >= _FLAT:
            faults.append(f"channel {m + 1} is clipped: {flat[m]:.0f} samples stay at its largest "
                          "value; turn the gain down")  # fmt: skip
        if m not in dead and abs(offset[m]) > 3.0 * level[m]:
            times = abs(offset[m]) / level[m]
            faults.append(f"channel {m + 1} is off zero by {offset[m]:.3g}, {times:.0f} times its "
                          "noise; hear takes that away")  # fmt: skip
    return bool(dead), faults


def _tone_rate(
    sound: Sound, calls: Calls, gaps: Int[np.ndarray, " g"], sent: Call
) -> Iterator[str]:
    """Ask whether the tone that leaks into the microphones has the frequency that it should."""
    length = round(sent.duration * sound.rate)
    power = np.zeros(8 * length // 2 + 1)
    for k in gaps:
        samples = sound.read(int(calls.sample[k]), min(length, int(calls.length[k])))
        windowed = (samples - samples.mean(axis=0)) * np.hanning(len(samples))[:, np.newaxis]
        power += (np.abs(np.fft.rfft(windowed, 8 * length, axis=0)) ** 2).sum(axis=1)
    peak = int(power[1:-1].argmax()) + 1
    if power[peak] < 50.0 * np.median(power):
        return  # nothing leaks
    a, b, c = np.log(power[peak - 1 : peak + 2])
    found = (peak + 0.5 * (a - c) / (a - 2.0 * b + c)) * sound.rate / (8 * length)
    own = sent.frequency
    if abs(found - own) <= 0.5 * sound.rate / length:
        return
    fits = sound.rate * own / found
    near = min(RATES, key=lambda rate: abs(rate - fits))
    usual = f", as {near} Hz nearly would" if abs(near / fits - 1.0) < 0.005 else ""
    yield (
        f"while the vehicle calls, {found:.0f} Hz are loudest, not {own:g} Hz (call.frequency): a "
        f"sample rate of {fits:.0f} Hz in place of {sound.rate:g} Hz would explain it{usual}"
    )


def _call_rate(
    sound: Sound, calls: Calls, gaps: Int[np.ndarray, " g"], sent: Call
) -> Iterator[str]:
    """Ask at which sample rate what leaks into the microphones is the call."""
    share = {}
    for rate in (sound.rate, *RATES):
        if extent_of(sent, rate)[1] >= rate / 2.0:
            continue
        own, energy, answer = replica(sent, rate), 0.0, 0.0
        for k in gaps:
            some = sound.read(int(calls.sample[k]), min(own.size, int(calls.length[k])))
            some = some - some.mean(axis=0)
            answers = np.fft.ifft(
                np.fft.fft(some, 2 * own.size, axis=0)
                * np.fft.fft(own, 2 * own.size).conj()[:, np.newaxis],
                axis=0,
            )
            answer += float((np.abs(answers) ** 2).max(axis=0).sum())
            energy += 0.5 * float((some**2).sum() * np.sum(np.abs(own) ** 2))
        share[rate] = answer / energy
    best = max(share, key=lambda rate: share[rate])
    if share[best] > LEAKS and share[sound.rate] < BETTER * share[best]:
        yield (
            f"while the vehicle calls, {share[sound.rate]:.0%} of the sound are its call at "
            f"{sound.rate:g} Hz, and {share[best]:.0%} at a sample rate of {best:g} Hz"
        )


def _clock(calls: Calls, blocks: Blocks) -> Iterator[str]:
    """Ask whether the calls come as regularly as most of them do."""
    gap = np.diff(calls.sample)
    if gap.size < 5:
        return
    usual = float(np.median(gap))
    off = np.abs(gap - usual) > max(2.0, 1e-4 * usual)
    odd = np.flatnonzero(off)
    if not 0 < odd.size <= 0.2 * gap.size:
        return  # regular, or not meant to be
    k = int(odd[0])
    more = f", and {odd.size - 1} more such" if odd.size > 1 else ""
    yield (
        f"from call {k} to the next (counted from 0) there are {gap[k]} samples, elsewhere "
        f"{usual:.0f}{more}: {abs(gap[k] - usual) / blocks.rate:.3g} s were "
        f"{'lost' if gap[k] < usual else 'put in'}, or the call is not when it is said to be"
    )
