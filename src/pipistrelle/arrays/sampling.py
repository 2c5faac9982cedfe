"""Sampling of a recording: rate, block length, tones, and the length of a frame."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import (
    MAX_CROSS_TALK,
    Call,
    ToneBurst,
    check_sampled,
    cross_talk,
    is_whole,
)
from pipistrelle.acoustics.paths import MAX_CALLERS, Caller, check_caller
from pipistrelle.acoustics.propagation import Medium, medium_of
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.config import BLOCK, SQUARE, Config, InputError

LEAST_RATE, LARGEST_RATE = 8e3, 1e6
"""Rates of real samples [Hz]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Recorder settings of a frame: sample rate, block length, calls and noise."""

    rate: float
    """[Hz]."""
    block: int
    """Samples per block."""
    pulse: int
    """Blocks per call; the first recorded block is the next."""
    dense: bool = False
    """Whether every sample is recorded."""
    real: bool = False
    """Whether samples are real, and matched in each call's band: if any call is not a tone, or
    rate, tones or duration are off the raster (`off_raster`)."""
    calls: tuple[Call, ...]
    """The call of each caller, the vehicle first."""
    tones: Float[np.ndarray, " c"]
    """Frequencies of the calls [Hz]."""
    noise_std: float
    """Standard deviation of one complex sample."""
    speed_of_sound: float

    @property
    def interval(self) -> float:
        """Duration of a block of samples [s]."""
        return self.block / self.rate


def sampling(
    config: Config,
    callers: Sequence[Caller],
    *,
    call: Callable[[float, float], Call] = ToneBurst,
    medium: Medium | None = None,
) -> Sampling:
    """Choose sample rate, block length and calls of a recording from the settings and callers.

    `callers`: up to 8, the vehicle first; their calls replace the settings'; `call`: makes a call
    of a frequency [Hz] and duration [s]; `medium`: by default the settings'. Raises InputError if
    two calls are too similar, the rate is too low for one, there are too many callers, or as
    `check_caller`; with the engine ``block``, also if a tone is not a whole bin of a block or the
    call not whole blocks.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> settled = sampling(Config(), callers_of(Config(), np.zeros(2)))
    >>> settled.block, settled.pulse, settled.tones
    (40, 14, array([35000., 30000.]))
    """
    rate, pulse = config.receiver.sample_rate, config.emitter.pulse
    for caller in callers:
        check_caller(caller)
    if not 1 <= len(callers) <= MAX_CALLERS:
        raise InputError(
            f"callers: found {len(callers)}, expected 1 to {MAX_CALLERS}; leave some out"
        )
    whole = is_whole(rate * BLOCK) and is_whole(pulse / BLOCK)
    length = round(pulse / BLOCK) * BLOCK if whole else pulse
    calls = tuple(caller.sound or call(caller.frequency, length) for caller in callers)
    tones, odd = all(isinstance(one, ToneBurst) for one in calls), off_raster(config, callers)
    engine = config.receiver.engine
    if engine == "block" and odd:
        raise InputError(odd)
    real = (odd is not None or not tones) and engine != "block"
    if real:
        _refuse_undersampled(config, callers, calls)
    else:
        _refuse_alike(config, callers, _keys(callers))
    return Sampling(
        rate=rate,
        block=round(rate * BLOCK) if whole else 1,
        pulse=round(pulse / BLOCK) if whole else math.ceil(pulse * rate - 1e-6),
        dense=real or engine == "dense",
        real=real,
        calls=calls,
        tones=np.array([caller.frequency for caller in callers]),
        noise_std=10.0 ** (config.receiver.noise_level_db / 20.0),
        speed_of_sound=(medium or medium_of(config.medium)).speed_of_sound,
    )


def off_raster(config: Config, callers: Sequence[Caller]) -> str | None:
    """Return why rate, tones or call length do not fit blocks of 0.2 ms; None if they fit.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> from pipistrelle.config import BeaconConfig
    >>> off_raster(Config(), callers_of(Config(), np.zeros(2)))
    >>> odd = Config(beacon=BeaconConfig(frequency=26e3))
    >>> print(off_raster(odd, callers_of(odd, np.zeros(2))))
    beacon.frequency: found 26000 Hz, expected a multiple of 5000 Hz (the nearest that are free:
    25000 and 30000 Hz)
    """
    rate, pulse, keys = config.receiver.sample_rate, config.emitter.pulse, _keys(callers)
    tones = [(key, one) for key, one in zip(keys, callers, strict=True) if one.sound is None]
    for key, value, unit, count in (
        ("receiver.sample_rate", rate, "Hz", rate * BLOCK),
        *((key, one.frequency, "Hz", one.frequency * BLOCK) for key, one in tones),
        ("emitter.pulse", pulse, "s", pulse / BLOCK),
    ):
        if not is_whole(count):
            step = f"{BLOCK:g} s" if unit == "s" else f"{1 / BLOCK:g} Hz"
            free = free_tones(config, callers, value) if key in keys else ""
            return f"{key}: found {value:g} {unit}, expected a multiple of {step}{free}"
    return None


def _keys(callers: Sequence[Caller]) -> list[str]:
    """Return the key of the setting of each caller's frequency, for errors."""
    return [f"{caller.key or caller.name}.frequency" for caller in callers]


def _refuse_undersampled(config: Config, callers: Sequence[Caller], calls: Sequence[Call]) -> None:
    """Raise if the sample rate is too low for a call, or two calls are too similar."""
    rate = config.receiver.sample_rate
    if not LEAST_RATE <= rate <= LARGEST_RATE:
        raise InputError(
            f"receiver.sample_rate: found {rate:g} Hz, expected a multiple of {1 / BLOCK:g} Hz, or "
            f"{LEAST_RATE:g} to {LARGEST_RATE:g} Hz"
        )
    for caller, call in zip(callers, calls, strict=True):
        named = {"duration": "emitter.pulse", "named": "receiver.sample_rate"}
        check_sampled(call, rate, where=caller.key or caller.name, **named)
    share = cross_talk(calls, rate)
    np.fill_diagonal(share, 0.0)
    j, i = divmod(int(share.argmax()), len(callers))
    if share[j, i] > MAX_CROSS_TALK:
        one, other = callers[max(i, j)], callers[min(i, j)]
        raise InputError(
            f"{one.key or one.name}: found a call that is {share[j, i]:.0%} the {other.name}'s, at "
            f"some lag; expected {MAX_CROSS_TALK:.0%} at most, or the two cannot be told apart; "
            "give it another frequency, or a band or direction of its own"
        )


def clear_frequency(config: Config) -> float:
    r"""Return the highest tone that the array receives without grating lobes or aliases [Hz].

    Elements at a distance d cannot distinguish the angle :math:`\theta` off their normal from the
    grating lobe, :math:`\sin\theta_g = \sin\theta - \lambda / d`. For a wavelength above d times (1
    + sine of the largest used angle) it does not exist. Half the sampling rate is the highest
    frequency of real samples, and the only limit for an array from a file
    (`pipistrelle.arrays.beamforming` computes its lobes).

    Van Trees, Optimum Array Processing (2002), Sec. 2.4.

    >>> round(clear_frequency(Config()))
    35607
    """
    if config.receiver.array != SQUARE:
        return config.receiver.sample_rate / 2.0
    limit = math.radians(min(config.detection.angle_limit_deg, config.detection.scan_limit_deg))
    longest = config.medium.sound_speed / (config.receiver.spacing * (1.0 + math.sin(limit)))
    return min(longest, config.receiver.sample_rate / 2.0)


def free_tones(config: Config, callers: Sequence[Caller], near: float) -> str:
    """Format the two unused, unambiguous tones nearest to a frequency, for an error; empty if none.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> free_tones(Config(), callers_of(Config(), np.zeros(2)), 31e3)
    ' (the nearest that are free: 20000 and 25000 Hz)'
    """
    bins, whole = [c.frequency * BLOCK for c in callers], round(config.receiver.sample_rate * BLOCK)
    taken = {round(count) % whole for count in bins if abs(count - round(count)) <= 1e-6}
    most = min(math.floor(clear_frequency(config) * BLOCK), 1000)
    free = [count for count in range(1, most + 1) if count not in taken]
    best = sorted(sorted(free, key=lambda count: abs(count - near * BLOCK))[:2])
    if not best:
        return ""
    tones = " and ".join(f"{count / BLOCK:g}" for count in best)
    return f" (the nearest that are free: {tones} Hz)" if best[1:] else f" ({tones} Hz is free)"


def _refuse_alike(config: Config, callers: Sequence[Caller], keys: Sequence[str]) -> None:
    """Raise if two callers' tones are in the same frequency bin of a block, directly or aliased."""
    rate = config.receiver.sample_rate
    for j, (key, caller) in enumerate(zip(keys, callers, strict=True)):
        for other in callers[:j]:
            apart = round((caller.frequency - other.frequency) * BLOCK)
            if apart % round(rate * BLOCK) == 0:
                own = f"the {other.name}'s own"
                if apart:
                    own = f"{own} {other.frequency:g} Hz once it is sampled at {rate:g} Hz"
                free = free_tones(config, callers, caller.frequency)
                raise InputError(
                    f"{key}: found {caller.frequency:g} Hz, {own}; expected another{free}, or the "
                    "two calls cannot be told apart"
                )


def blocks_to_hear(
    arrivals: Arrivals, sampling: Sampling, layout: Layout | Scattered | None = None
) -> int:
    """Count the blocks from the end of the vehicle's call to the end of the last arrival.

    `arrivals` include inaudible ones, as the length must not depend on the beam. With a `Scattered`
    layout, the delay of the farthest microphone is added.
    """
    last = arrivals.delay.max(initial=0.0) / sampling.interval + sampling.pulse
    if isinstance(layout, Scattered):
        farthest = np.linalg.norm(layout.position, axis=1).max()
        last += float(farthest) / sampling.speed_of_sound / sampling.interval
    return max(math.ceil(last) + 1 - sampling.pulse, 2 * sampling.pulse)


def block_shape(
    blocks: int, layout: Layout | Scattered, sampling: Sampling
) -> tuple[int, int, int, int]:
    """Return the shape of a recording as block sums: blocks, faces, tones, elements.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> from pipistrelle.arrays.layout import square_of_four
    >>> config = Config()
    >>> settled = sampling(config, callers_of(config, np.zeros(2)))
    >>> block_shape(300, square_of_four(config.receiver), settled)
    (300, 4, 2, 10)
    """
    faces, elements = layout.shape
    return (blocks, faces, sampling.tones.size, elements)
