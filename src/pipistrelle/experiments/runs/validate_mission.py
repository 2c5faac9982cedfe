"""Checks of the settings of a simulated mission before anything is heard, and warnings on them.

`run` asks for one mission, a study for every combination of its plan: through the same door.
"""

import math
from collections.abc import Sequence

import numpy as np

from pipistrelle.acoustics.callers import VEHICLE, Caller, callers_of, moves
from pipistrelle.arrays.layout import Scattered, layout_of
from pipistrelle.arrays.pattern import pattern_of
from pipistrelle.arrays.sampling import off_raster, sampling
from pipistrelle.config import SQUARE, Config, InputError, Section
from pipistrelle.detection.front_end import front_end
from pipistrelle.experiments.hearing.scenario import Scenario, world_of
from pipistrelle.experiments.hearing.world import ALL_DRAWN, World
from pipistrelle.experiments.machine import check_length, check_recording
from pipistrelle.kernel_clock import judging

MANY_DOUBLES = 0.1
"""Share of the bearings with a double from which on a warning is given."""
CLOSEST = 0.25
"""Spacing of hydrophones below which they warn, in waves."""
KILOHERTZ = 1e3
"""Sonars call at 1 kHz to 1 MHz, so a smaller number of hertz is probably of kilohertz [Hz]."""


@judging()
def checked_scenario(
    config: Config,
    *,
    world: World = ALL_DRAWN,
    strategies: int = 1,
    filters: int = 1,
    workers: int = 1,
) -> Scenario:
    """Draw the first world of a mission, and refuse settings with which it cannot be heard.

    Memory is estimated for so many strategies and filters, and for so many workers on this machine
    (0 if they are elsewhere).

    >>> from pipistrelle.config import EmitterConfig, ReceiverConfig
    >>> len(checked_scenario(Config()).landmarks)
    50
    >>> sums = ReceiverConfig(engine="block")
    >>> checked_scenario(Config(emitter=EmitterConfig(frequency=36e3), receiver=sums))
    Traceback (most recent call last):
    pipistrelle.config.InputError: emitter.frequency: found 36000 Hz, expected a multiple of 5000 Hz
    (the nearest that are free: 25000 and 35000 Hz)
    """
    check_length(config.scenario, strategies=strategies, filters=filters, workers=workers)
    scenario = world_of(config, world=world)
    settled = sampling(config, scenario.callers)
    layout = layout_of(config)
    front_end(config, layout, settled.tones, calls=settled.calls if settled.real else ())
    check_recording(scenario, config, layout, settled, workers=workers)
    _refuse_supersonic(scenario, config)
    return scenario


def warnings_of(config: Config, callers: Sequence[Caller] = ()) -> tuple[str, ...]:
    r"""Warn of a receiver whose spacing makes bearings ambiguous, or whose sampling aliases tones.

    In water also of what fits air: a call that is deaf too far, and hydrophones too close.

    Elements a distance d apart cannot tell the angle :math:`\theta` off their normal from another,
    the grating lobe,

    .. math:: \sin\theta_g = \sin\theta - \lambda / d .

    Notes
    -----
    Van Trees, Optimum Array Processing (2002), Sec. 2.4.

    >>> from pipistrelle.config import ReceiverConfig
    >>> warnings_of(Config())
    ()
    >>> print(warnings_of(Config(receiver=ReceiverConfig(spacing=0.007)))[0])
    receiver.spacing: 0.007 m is 0.71 of a wave at emitter.frequency (35000 Hz): echoes 26 degrees
    off a face's normal or more look as if from the other side, as from -75 degrees; expected half a
    wave (0.0049 m)
    """
    spacing, rate = config.receiver.spacing, config.receiver.sample_rate
    layout = layout_of(config)
    limit = min(config.detection.angle_limit_deg, config.detection.scan_limit_deg)
    callers = callers or callers_of(config, np.zeros(2))
    warnings = _cost(config, callers)
    for caller in callers:
        frequency, key = caller.frequency, caller.key or caller.name
        tone, wave = f"{key}.frequency ({frequency:g} Hz)", config.medium.sound_speed / frequency
        nearest = wave / spacing - math.sin(math.radians(limit))  # its lobe lies at the limit
        if isinstance(layout, Scattered):
            warnings += _doubles(layout, frequency, tone, config.medium.sound_speed)
        elif nearest < 1.0 and caller.sound is None:  # a band's delays tell the lobe
            warnings.append(
                f"receiver.spacing: {spacing:g} m is {spacing / wave:.2f} of a wave at {tone}: "
                f"echoes {math.degrees(math.asin(max(nearest, 0.0))):.0f} degrees off a face's "
                f"normal or more look as if from the other side, as from {-limit:.0f} degrees; "
                f"expected half a wave ({wave / 2.0:.2g} m)"
            )
        if frequency > rate / 2.0:
            warnings.append(
                f"receiver.sample_rate: {rate:g} Hz is less than twice {tone}: real samples would "
                f"hold it as {abs(frequency - rate * round(frequency / rate)):g} Hz; expected more"
            )
    return (*_kilohertz(config), *warnings, *_of_the_other_medium(config))


def _kilohertz(section: Section, place: str = "") -> list[str]:
    """Ask whether frequencies below 1 kHz are in kilohertz, of all settings in hertz.

    >>> from pipistrelle.config import EmitterConfig
    >>> _kilohertz(Config(emitter=EmitterConfig(frequency=40.0)))
    ['emitter.frequency: 40 Hz is below 1 kHz; is it in kHz? 40 kHz are 40000 Hz']
    """
    warnings = []
    for name, field in type(section).model_fields.items():
        key, value = f"{place}{name}", getattr(section, name)
        values = value if isinstance(value, tuple) else (value,)
        for number, one in enumerate(values, start=1):
            if isinstance(one, Section):
                inner = f"{key}.{number}." if isinstance(value, tuple) else f"{key}."
                warnings += _kilohertz(one, inner)
            elif "[Hz]" in (field.description or "") and one is not None and one < KILOHERTZ:
                warnings.append(
                    f"{key}: {one:g} Hz is below 1 kHz; is it in kHz? {one:g} kHz are "
                    f"{KILOHERTZ * one:g} Hz"
                )
    return warnings


def _of_the_other_medium(config: Config) -> list[str]:
    """Warn of settings that count in the other medium alone, and in water of those that suit air.

    >>> from pipistrelle.config import WaterConfig
    >>> config = Config(water=WaterConfig(salinity=0.0))
    >>> print(_of_the_other_medium(config)[0])
    water.salinity: counts for nothing where scenario.medium is "air"; expected it to be "water"
    """
    medium = config.scenario.medium
    other = "air" if medium == "water" else "water"
    warnings = [
        f'{other}.{name}: counts for nothing where scenario.medium is "{medium}"; expected it to '
        f'be "{other}"'
        for name in getattr(config, other).model_dump(exclude_defaults=True)
    ]
    return warnings + (_left_from_air(config) if medium == "water" else [])


def _left_from_air(config: Config) -> list[str]:
    """Warn of settings that suit sound in air, and not the longer waves and ways of water."""
    pulse, spacing, c = config.emitter.pulse, config.receiver.spacing, config.medium.sound_speed
    nearest, deaf = config.rays.range_bounds[0], 0.5 * c * pulse
    wave, warnings = c / config.emitter.centre, []
    if deaf > nearest:
        warnings.append(
            f"emitter.pulse: nothing nearer than {deaf:.2g} m is heard, for a call of {pulse:g} s "
            f"is that long in water; rays.range_bounds begin at {nearest:g} m: expected a shorter "
            "call, or a greater range"
        )
    if config.receiver.array == SQUARE and spacing < CLOSEST * wave:
        warnings.append(
            f"receiver.spacing: {spacing:g} m is {spacing / wave:.2f} of a wave in water at "
            f"{config.emitter.centre:g} Hz: bearings are "
            f"{0.5 * wave / spacing:.1f} times as coarse as of half a wave ({wave / 2.0:.2g} m)"
        )
    return warnings


def _cost(config: Config, callers: Sequence[Caller]) -> list[str]:
    """Say what it costs to record every sample, where nobody has asked for that."""
    why = off_raster(config, callers)
    swept = [caller.key or caller.name for caller in callers if caller.sound is not None]
    if config.receiver.engine != "auto" or not (why or swept):
        return []
    cause = f"{', '.join(swept)}: no plain tone" if swept else str(why)
    return [
        f"receiver.engine: every sample is recorded, some 0.3 s a frame in place of 1 ms ({cause})"
    ]


def _doubles(layout: Scattered, frequency: float, tone: str, c: float) -> list[str]:
    """Warn of groups of microphones to which much of the circle sounds as another part of it."""
    warnings = []
    for g, name in enumerate(layout.name):
        found = pattern_of(layout, g, frequency=frequency, speed_of_sound=c)
        if found.alike >= MANY_DOUBLES:
            this, that = (f"{math.degrees(angle):.0f}" for angle in found.worst)
            whose = f"face {name}" if name else "the microphones that hang free"
            warnings.append(
                f"receiver.array: at {tone} {found.alike:.0%} of the bearings sound to {whose} as "
                f"another, as {this} degrees as {that}; rows state deviations that say so, see "
                "`pipistrelle array`"
            )
    return warnings


def _refuse_supersonic(scenario: Scenario, config: Config) -> None:
    """Refuse a vehicle or a caller that is faster than sound."""

    def fastest(path: np.ndarray) -> float:
        return np.hypot(*np.diff(path, axis=0).T).max(initial=0.0) / config.scenario.step

    speed, c = fastest(scenario.path[:, :2]), config.medium.sound_speed
    for caller in scenario.callers[VEHICLE + 1 :]:
        if moves(caller) and not (his := fastest(np.asarray(caller.place))) < c:
            raise InputError(
                f"{caller.key or caller.name}: it reaches {his:.3g} m/s, expected less than the "
                f"speed of sound ({c:.3g} m/s); slow it down"
            )
    if not speed < c:
        key = "motion.speed_std" if abs(config.scenario.speed) < c else "scenario.speed"
        raise InputError(
            f"{key}: the vehicle reaches {speed:.3g} m/s, expected less than the speed of sound "
            f"({c:.3g} m/s); slow it down"
        )
