"""Sampling: the rate, the blocks and the tones of a recording, and how long one is."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.arrivals import Arrivals
from pipistrelle.acoustics.call import Call, ToneBurst
from pipistrelle.acoustics.callers import MAX_CALLERS, Caller, check_caller
from pipistrelle.acoustics.medium import Medium, medium_of
from pipistrelle.arrays.layout import Layout, Scattered
from pipistrelle.config import BLOCK, SQUARE, Config, InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """How a frame is sampled; the receiver is blanked while the vehicle calls."""

    rate: float
    """Rate [Hz]."""
    block: int
    """Samples per block."""
    pulse: int
    """Blocks per call; the first block heard is the one after it."""
    calls: tuple[Call, ...]
    """The call of each caller, the vehicle first."""
    tones: Float[np.ndarray, " c"]
    """Their frequencies [Hz]."""
    noise_std: float
    """Of one complex sample."""
    speed_of_sound: float
    """Speed of sound [m/s]."""


def sampling(
    config: Config,
    callers: Sequence[Caller],
    *,
    call: Callable[[float, float], Call] = ToneBurst,
    medium: Medium | None = None,
) -> Sampling:
    """Settle how a frame is sampled.

    Parameters
    ----------
    config : Config
    callers : sequence of c Caller, up to 8
        The vehicle first. What they call at counts, not the settings' frequencies.
    call : callable
        Makes each one's `Call` of its frequency [Hz] and duration [s].
    medium : Medium, optional
        That of the settings by default.

    Returns
    -------
    Sampling

    Raises
    ------
    InputError
        When a tone is no whole bin of a block or, once it is sampled, the tone of two callers, the
        call no whole number of blocks, there are too many callers, or as `check_caller`.

    Examples
    --------
    >>> from pipistrelle.acoustics.callers import callers_of
    >>> settled = sampling(Config(), callers_of(Config(), np.zeros(2)))
    >>> settled.block, settled.pulse, settled.tones
    (40, 14, array([35000., 30000.]))
    """
    rate, pulse = config.receiver.sample_rate, config.emitter.pulse
    for caller in callers:
        check_caller(caller)
    keys = [f"{caller.key or caller.name}.frequency" for caller in callers]
    tones = np.array([caller.frequency for caller in callers])
    for key, value, unit, count in (
        ("receiver.sample_rate", rate, "Hz", rate * BLOCK),
        *((key, tone, "Hz", tone * BLOCK) for key, tone in zip(keys, tones, strict=True)),
        ("emitter.pulse", pulse, "s", pulse / BLOCK),
    ):
        if round(count) < 1 or abs(count - round(count)) > 1e-6:
            step = f"{BLOCK:g} s" if unit == "s" else f"{1 / BLOCK:g} Hz"
            free = free_tones(config, callers, value) if key in keys else ""
            raise InputError(f"{key}: found {value:g} {unit}, expected a multiple of {step}{free}")
    if not 1 <= len(callers) <= MAX_CALLERS:
        raise InputError(
            f"callers: found {len(callers)}, expected 1 to {MAX_CALLERS}; leave some out"
        )
    _refuse_alike(config, callers, keys)
    return Sampling(
        rate=rate,
        block=round(rate * BLOCK),
        pulse=round(pulse / BLOCK),
        calls=tuple(call(caller.frequency, pulse) for caller in callers),
        tones=tones,
        noise_std=10.0 ** (config.receiver.noise_level_db / 20.0),
        speed_of_sound=(medium or medium_of(config.medium)).speed_of_sound,
    )


def clear_frequency(config: Config) -> float:
    r"""Return the highest tone without grating lobes and without aliases.

    Elements a distance d apart cannot tell the angle :math:`\theta` off their normal from another,
    the grating lobe, :math:`\sin\theta_g = \sin\theta - \lambda / d`: of a longer wave than d times
    :math:`1 + \sin\theta`, with the largest angle that is kept, it lies outside. Half the sampling
    rate is the highest that real samples hold, and the only limit here of an array from a file
    (`pipistrelle.arrays.pattern` tells its lobes).

    Returns [Hz].

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
    """Return the two free unambiguous tones that are nearest to a tone, for a refusal.

    `near` [Hz]. Returns for a refusal, in brackets; empty where there is none.

    >>> from pipistrelle.acoustics.callers import callers_of
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
    """Refuse tones that fall into one bin of a block: equal ones, or ones a sampling rate apart."""
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

    Parameters
    ----------
    arrivals : Arrivals
        Of the frame, the inaudible ones too: the window must not depend on the beam.
    sampling : Sampling
    layout : Layout or Scattered, optional
        Of microphones anywhere the last hears the arrival later than the vehicle's centre.

    Returns
    -------
    int
    """
    last = arrivals.delay.max(initial=0.0) / BLOCK + sampling.pulse
    if isinstance(layout, Scattered):
        farthest = np.linalg.norm(layout.position, axis=1).max()
        last += float(farthest) / sampling.speed_of_sound / BLOCK
    return max(math.ceil(last) + 1 - sampling.pulse, 2 * sampling.pulse)


def block_shape(
    blocks: int, layout: Layout | Scattered, sampling: Sampling
) -> tuple[int, int, int, int]:
    """Return the shape of a recording in block sums.

    >>> from pipistrelle.acoustics.callers import callers_of
    >>> from pipistrelle.arrays.layout import square_of_four
    >>> config = Config()
    >>> settled = sampling(config, callers_of(config, np.zeros(2)))
    >>> block_shape(300, square_of_four(config.receiver), settled)
    (300, 4, 2, 10)
    """
    faces, elements = layout.shape
    return (blocks, faces, sampling.tones.size, elements)
