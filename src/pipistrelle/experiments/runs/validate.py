"""Checks of estimators and settings before a mission or a study, warnings, and texts of errors."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from traceback import extract_tb, format_exc

import numpy as np

from pipistrelle.acoustics.paths import VEHICLE, Caller, callers_of, moves
from pipistrelle.arrays.beamforming import pattern_of
from pipistrelle.arrays.layout import Scattered, layout_of
from pipistrelle.arrays.sampling import sampling
from pipistrelle.config import SQUARE, Config, InputError, Section
from pipistrelle.detection.front_end import front_end
from pipistrelle.estimation.beliefs import Belief, Gaussian, completed
from pipistrelle.estimation.catalogue import CATALOGUE, check_distinct, entry, worded
from pipistrelle.estimation.data_association.sequential import association_of
from pipistrelle.estimation.motion import Motion
from pipistrelle.experiments.hearing.scenario import ALL_DRAWN, Scenario, World, world_of
from pipistrelle.experiments.machine import check_length, check_recording
from pipistrelle.jit import judging


def check_filters(
    filters: Sequence[str], motion: Motion, config: Config, moving: Iterable[str] = ()
) -> None:
    """Raise if an estimator or association cannot be built, or does not fit the settings.

    `moving`: names of the moving callers.
    """
    check_distinct(filters)
    known = association_of(config) is None or not config.listening.excess_paths
    roving, asked = "" if known else ", ".join(moving), ", ".join(config.filter.calibrate)
    for name in filters:
        if roving and not entry(name).follows:
            able = ", ".join(one.name for one in CATALOGUE.values() if one.follows)
            why = f"found callers that move ({roving}) with the filter {name}, which follows none"
            fix = f"take {able}, or add --listening.excess-paths false"
            raise InputError(f"association.method: {why}; {fix}")
        if name in CATALOGUE and asked and not CATALOGUE[name].calibrates:
            able = ", ".join(one.name for one in CATALOGUE.values() if one.calibrates)
            why = f"found {asked} with the filter {name}, which calibrates nothing"
            fix = f"take {able}, or leave it out (in a plan, name it under [own.{able}])"
            raise InputError(f"filter.calibrate: {why}; {fix}")
        if name in CATALOGUE:
            continue
        try:
            belief = first_belief(name, motion, config)
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"filter {name}: init fails: {located(error)}") from error
        parts = ("pose", "landmarks", "gated")
        if lacking := [part for part in parts if not hasattr(belief, part)]:
            why = f"init returns a belief that lacks {', '.join(lacking)}"
            raise InputError(f"filter {name}: {why}; a belief has {', '.join(parts)}")
        methods = ("pose", "landmarks", "path", "cloud")
        whole = completed(belief, Belief)
        if fixed := [part for part in methods if not callable(getattr(whole, part))]:
            why = f"init returns a belief whose {', '.join(fixed)} cannot be called"
            fix = f"of a belief {', '.join(methods)} are methods, the last two where it has them"
            raise InputError(f"filter {name}: {why}; {fix}")


@judging()
def first_belief(name: str, motion: Motion, config: Config) -> Belief:
    """Return the initial belief of an estimator, before any motion or measurement."""
    return entry(name).build(config, motion).init(Gaussian(mean=np.zeros(3), covariance=np.eye(3)))


def failure_text(error: Exception) -> str:
    """Return the traceback of the current error, with its message as the last line."""
    let_interruptions_pass(error)
    return f"{format_exc()}{worded(error)}\n"


def let_interruptions_pass(error: Exception) -> None:
    """Raise again a KeyboardInterrupt that is the cause or context of another error."""
    behind: BaseException | None = error
    while behind is not None:
        if isinstance(behind, KeyboardInterrupt):
            raise behind
        behind = behind.__cause__ or behind.__context__


def located(error: Exception) -> str:
    """Return the message of an error, with the file and line that raised it."""
    place = extract_tb(error.__traceback__)[-1]
    return f"{worded(error)} ({Path(place.filename).name}, line {place.lineno})"


MANY_DOUBLES = 0.1
"""Share of ambiguous bearings that gives a warning."""
CLOSEST = 0.25
"""Spacing of hydrophones, in wavelengths, below which a warning is given."""


@judging()
def checked_scenario(
    config: Config,
    *,
    world: World = ALL_DRAWN,
    strategies: int = 1,
    filters: int = 1,
    workers: int = 1,
) -> Scenario:
    """Generate the first world of a mission; raise if its sound cannot be simulated.

    Memory is checked for the numbers of strategies and filters, and of workers on this machine (0
    for a cluster).
    """
    check_length(config.scenario, strategies=strategies, filters=filters, workers=workers)
    scenario = world_of(config, world=world)
    settled = sampling(config, scenario.callers)
    layout = layout_of(config)
    front_end(config, layout, settled.tones, calls=settled.calls)
    check_recording(scenario, config, layout, settled, workers=workers)
    _refuse_supersonic(scenario, config)
    return scenario


def warnings_of(config: Config, callers: Sequence[Caller] = ()) -> tuple[str, ...]:
    r"""Return warnings about ambiguous bearings, aliased tones and settings for the wrong medium.

    Elements with spacing d cannot distinguish the angle :math:`\theta` from their normal from the
    grating lobe

    .. math:: \sin\theta_g = \sin\theta - \lambda / d .

    Van Trees, Optimum Array Processing (2002), Sec. 2.4.
    """
    spacing, rate = config.receiver.spacing, config.receiver.sample_rate
    layout = layout_of(config)
    limit = min(config.detection.angle_limit_deg, config.detection.scan_limit_deg)
    callers = callers or callers_of(config, np.zeros(2))
    warnings: list[str] = []
    for caller in callers:
        frequency, key = caller.frequency, caller.key or caller.name
        tone, wave = f"{key}.frequency ({frequency:g} Hz)", config.medium.sound_speed / frequency
        nearest = wave / spacing - math.sin(math.radians(limit))  # its lobe is at the limit
        if isinstance(layout, Scattered):
            warnings += _doubles(layout, frequency, tone, config.medium.sound_speed)
        elif nearest < 1.0 and caller.sound is None:  # the delays of a band resolve the ambiguity
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
    """Return warnings about frequencies below 1 kHz, probably given in kilohertz.

    Sonars call at 1 kHz to 1 MHz.
    """
    warnings = []
    for name, field in type(section).model_fields.items():
        key, value = f"{place}{name}", getattr(section, name)
        values = value if isinstance(value, tuple) else (value,)
        for number, one in enumerate(values, start=1):
            if isinstance(one, Section):
                inner = f"{key}.{number}." if isinstance(value, tuple) else f"{key}."
                warnings += _kilohertz(one, inner)
            elif "[Hz]" in (field.description or "") and one is not None and one < 1e3:
                warnings.append(
                    f"{key}: {one:g} Hz is below 1 kHz; is it in kHz? {one:g} kHz are "
                    f"{1e3 * one:g} Hz"
                )
    return warnings


def _of_the_other_medium(config: Config) -> list[str]:
    """Return warnings about settings of the unused medium and, in water, values meant for air."""
    medium = config.scenario.medium
    other = "air" if medium == "water" else "water"
    warnings = [
        f'{other}.{name}: counts for nothing where scenario.medium is "{medium}"; expected it to '
        f'be "{other}"'
        for name in getattr(config, other).model_dump(exclude_defaults=True)
    ]
    return warnings + (_left_from_air(config) if medium == "water" else [])


def _left_from_air(config: Config) -> list[str]:
    """Return warnings about call duration and microphone spacing in water that suit only air."""
    pulse, c = config.emitter.call_duration, config.medium.sound_speed
    nearest, deaf = config.rays.range_bounds[0], 0.5 * c * pulse
    wave, warnings = c / config.emitter.centre, []
    if deaf > nearest:
        warnings.append(
            f"emitter.call_duration: a call of {pulse:g} s in water hides echoes from less than "
            f"{deaf:.2g} m; rays.range_bounds begin at {nearest:g} m: expected a shorter call, or "
            "a greater range"
        )
    spacing = config.receiver.spacing
    if config.receiver.array == SQUARE and spacing < CLOSEST * wave:
        warnings.append(
            f"receiver.spacing: {spacing:g} m is {spacing / wave:.2f} of a wave in water at "
            f"{config.emitter.centre:g} Hz: bearings are "
            f"{0.5 * wave / spacing:.1f} times as coarse as of half a wave ({wave / 2.0:.2g} m)"
        )
    return warnings


def _doubles(layout: Scattered, frequency: float, tone: str, c: float) -> list[str]:
    """Return warnings about groups of microphones with many ambiguous bearings."""
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
    """Raise if the vehicle or a caller is faster than sound."""

    def fastest(path: np.ndarray) -> float:
        return np.hypot(*np.diff(path, axis=0).T).max(initial=0.0) / config.scenario.step

    speed, c = fastest(scenario.path[:, :2]), config.medium.sound_speed
    slower = f"expected less than the speed of sound ({c:.3g} m/s); slow it down"
    for caller in scenario.callers[VEHICLE + 1 :]:
        if moves(caller) and not (his := fastest(np.asarray(caller.place))) < c:
            raise InputError(f"{caller.key or caller.name}: it reaches {his:.3g} m/s, {slower}")
    if not speed < c:
        key = "motion.speed_std" if abs(config.scenario.speed) < c else "scenario.speed"
        raise InputError(f"{key}: the vehicle reaches {speed:.3g} m/s, {slower}")
