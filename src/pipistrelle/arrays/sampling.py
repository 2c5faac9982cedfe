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
    blocks_of,
    check_sampled,
    cross_talk,
    is_whole,
    on_raster,
)
from pipistrelle.acoustics.paths import MAX_CALLERS, Caller, check_caller
from pipistrelle.acoustics.propagation import Medium, medium_of
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.config import BLOCK, Config, InputError

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
    banded: bool = False
    """Whether sound is recorded in each call's band, as not all calls are tones."""
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
    `check_caller`.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> settled = sampling(Config(), callers_of(Config(), np.zeros(2)))
    >>> settled.block, settled.pulse, settled.tones
    (40, 14, array([35000., 30000.]))
    """
    rate, pulse = config.receiver.sample_rate, config.emitter.call_duration
    for caller in callers:
        check_caller(caller)
    if not 1 <= len(callers) <= MAX_CALLERS:
        raise InputError(
            f"callers: found {len(callers)}, expected 1 to {MAX_CALLERS}; leave some out"
        )
    tones = np.array([caller.frequency for caller in callers])
    raster = on_raster(rate, pulse, tones)
    length = round(pulse / BLOCK) * BLOCK if raster else pulse
    calls = tuple(caller.sound or call(caller.frequency, length) for caller in callers)
    banded = not all(isinstance(one, ToneBurst) for one in calls)
    if banded or not raster:
        _refuse_undersampled(config, callers, calls)
    else:
        _refuse_alike(config, callers)
    block, pulse = blocks_of(rate, length, tones)
    whole = math.ceil(length * rate - 1e-6)
    if banded and block * pulse > whole:  # the record begins with the end of the call
        block, pulse = 1, whole
    return Sampling(
        rate=rate,
        block=block,
        pulse=pulse,
        banded=banded,
        calls=calls,
        tones=tones,
        noise_std=10.0 ** (config.receiver.noise_level_db / 20.0),
        speed_of_sound=(medium or medium_of(config.medium)).speed_of_sound,
    )


def _refuse_undersampled(config: Config, callers: Sequence[Caller], calls: Sequence[Call]) -> None:
    """Raise if the sample rate is too low for a call, or two calls are too similar."""
    rate = config.receiver.sample_rate
    if not (LEAST_RATE <= rate <= LARGEST_RATE or is_whole(rate * BLOCK)):
        raise InputError(
            f"receiver.sample_rate: found {rate:g} Hz, expected a multiple of {1 / BLOCK:g} Hz, or "
            f"{LEAST_RATE:g} to {LARGEST_RATE:g} Hz"
        )
    for caller, call in zip(callers, calls, strict=True):
        named = {"duration": "emitter.call_duration", "named": "receiver.sample_rate"}
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


def _refuse_alike(config: Config, callers: Sequence[Caller]) -> None:
    """Raise if two callers' tones are in the same frequency bin of a block, directly or aliased."""
    rate = config.receiver.sample_rate
    for j, caller in enumerate(callers):
        for other in callers[:j]:
            apart = round((caller.frequency - other.frequency) * BLOCK)
            if apart % round(rate * BLOCK) == 0:
                own = f"the {other.name}'s own"
                if apart:
                    own = f"{own} {other.frequency:g} Hz once it is sampled at {rate:g} Hz"
                raise InputError(
                    f"{caller.key or caller.name}.frequency: found {caller.frequency:g} Hz, {own}; "
                    "expected another, or the two calls cannot be told apart"
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
