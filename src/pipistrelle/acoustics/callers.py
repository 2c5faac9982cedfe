"""Callers: the vehicle itself, and all others that it listens to.

Callers are a list. The first is the vehicle, the only one that moves with the ears. Its call is
given a beam, and so is that of other vehicles, which have a heading; the others call alike in all
directions, from a place or along a path. All call when the vehicle does, except those that have a
clock of their own. Each has a tone or a sweep of its own, by which its call is told from the rest.
The paper's list is of two: the vehicle and the beacon.

A caller other than the vehicle is also a landmark: it reflects the calls of all but itself, and is
heard directly in its own tone. Landmarks bear the labels 1 to n, caller j the label n + j.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.acoustics.call import Call
from pipistrelle.acoustics.call_settings import sound_of
from pipistrelle.config import MAX_OTHERS, Config, InputError

VEHICLE = 0
"""Where the vehicle stands in every list of callers."""
MAX_CALLERS = 1 + MAX_OTHERS
"""Callers that one recording can tell apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Caller:
    """Someone whose calls the vehicle hears."""

    name: str
    """Name in messages and figures."""
    frequency: float
    """Tone, or centre of the band [Hz]."""
    level_db: float
    """Source level at 1 m; of the vehicle, on its axis [dB]."""
    place: Float[np.ndarray, "2"] | Float[np.ndarray, "t 2"] | None = None
    """Where it calls from: one place, or one for each time (of a scenario) or emission; None for
    the vehicle, which calls from where it is [m]."""
    velocity: Float[np.ndarray, "2"] | Float[np.ndarray, "t 2"] | None = None
    """Of a caller that moves, where it calls; None where it stands, or where `callers_at` is to
    take it from the path [m/s]."""
    key: str = ""
    """Its section of the settings, where it has one: a refusal then names that."""
    heading: Float[np.ndarray, " t"] | None = None
    """Heading of another vehicle's piston at each place [rad]; None of a caller without a beam."""
    mission: tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t-1 2"]] | None = None
    """Poses [m, m, rad] and assumed controls of a caller that maps the world, too."""
    calls: Float[np.ndarray, " m"] | None = None
    """Rising times of its calls [s]; None of one that calls when the vehicle does."""
    sound: Call | None = None
    """The call; None is a tone burst."""


def callers_of(config: Config, beacon: Float[np.ndarray, "2"]) -> tuple[Caller, Caller]:
    """List the paper's two callers, vehicle and beacon, with the settings' tones and levels.

    Parameters
    ----------
    config : Config
        Its sections emitter and beacon.
    beacon : (2) [m]
        Where the beacon stands.

    Returns
    -------
    The vehicle and the beacon.

    Notes
    -----
    Bradley & Abaid, Sec. II.

    Examples
    --------
    >>> [(caller.name, caller.frequency) for caller in callers_of(Config(), np.zeros(2))]
    [('vehicle', 35000.0), ('beacon', 30000.0)]
    """
    own, other, pulse = config.emitter, config.beacon, config.emitter.pulse
    return (
        Caller(
            name="vehicle",
            frequency=own.centre,
            level_db=own.level_db,
            key="emitter",
            sound=sound_of(own, pulse, "emitter"),
        ),
        Caller(
            name="beacon",
            frequency=other.centre,
            level_db=other.level_db,
            place=beacon,
            key="beacon",
            sound=sound_of(other, pulse, "beacon"),
        ),
    )


def check_caller(caller: Caller) -> None:
    """Refuse a caller with a tone, level, place or velocity that is not finite or of wrong shape.

    >>> check_caller(Caller(name="boat", frequency=30e3, level_db=42.8, place=np.zeros(3)))
    Traceback (most recent call last):
    pipistrelle.config.InputError: caller boat: place: found an array of shape (3,), expected finite
    x and y [m], or a row of them for each time of a path; correct it
    """
    _check(caller, "frequency", "Hz", pairs=False)
    _check(caller, "level_db", "dB", pairs=False)
    if caller.place is not None:
        _check(caller, "place", "m", pairs=True)
    if caller.velocity is not None:
        _check(caller, "velocity", "m/s", pairs=True)


def _check(caller: Caller, part: str, unit: str, *, pairs: bool) -> None:
    """Refuse a value of a caller that is neither one finite number nor x and y or rows of them."""
    value = getattr(caller, part)
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):  # text, or rows of unlike lengths
        found = f"{value!r}"
    else:
        found = f"an array of shape {numbers.shape}"
        if numbers.ndim in (1, 2) and numbers.shape[-1] == 2 if pairs else numbers.ndim == 0:
            bad = ~np.isfinite(numbers)
            if not bad.any():
                return
            found = f"{numbers[bad][0]}"
    expected = f"one finite number [{unit}]"
    if pairs:
        expected = f"finite x and y [{unit}], or a row of them for each time of a path"
    raise InputError(
        f"caller {caller.name}: {part}: found {found}, expected {expected}; correct it"
    )


def moves(caller: Caller) -> bool:
    """Tell whether a caller other than the vehicle calls along a path.

    >>> [moves(caller) for caller in callers_of(Config(), np.zeros(2))]
    [False, False]
    """
    check_caller(caller)
    path = caller.place is not None and np.ndim(caller.place) == 2
    return caller.velocity is not None or path


def callers_at(
    callers: Sequence[Caller], time: Float[np.ndarray, " t"], steps: Int[np.ndarray, " k"]
) -> tuple[Caller, ...]:
    """Return the callers with their places and velocities at some times.

    Where no velocities are given, those of the steps that end there are taken, as for the vehicle.

    `callers`: the vehicle first; `time` [s]: of the paths; `steps`: which of the times. Returns
    paths and velocities (k, 2); those that stand as they were.

    >>> path = np.array([[0.0, 5.0], [0.5, 5.0], [1.5, 5.0]])
    >>> vehicle, _ = callers_of(Config(), path[0])
    >>> boat = Caller(name="boat", frequency=30e3, level_db=42.8, place=path)
    >>> callers_at((vehicle, boat), np.arange(3) * 0.5, np.array([2]))[1].velocity
    array([[2., 0.]])
    """
    placeless = [j for j, caller in enumerate(callers) if caller.place is None]
    if placeless != [VEHICLE]:
        raise InputError(
            f"callers: found {', '.join(caller.name for caller in callers) or 'none'}; expected "
            "the vehicle first, without a place, and for each of the others a place or a path"
        )
    if callers[VEHICLE].velocity is not None:
        raise InputError(
            f"caller {callers[VEHICLE].name}: found a velocity, expected none; leave it out, for "
            "the vehicle calls on its own path"
        )
    return tuple(_at(caller, time, steps) if moves(caller) else caller for caller in callers)


def _at(caller: Caller, time: Float[np.ndarray, " t"], steps: Int[np.ndarray, " k"]) -> Caller:
    """Return the places and velocities of a path at some of its times."""
    path, velocity = np.asarray(caller.place), caller.velocity
    shapes = {path.shape, path.shape if velocity is None else np.shape(velocity)}
    if shapes != {(len(time), 2)}:
        raise InputError(
            f"caller {caller.name}: found a path of shape {path.shape}"
            f"{'' if velocity is None else f' and velocities of shape {np.shape(velocity)}'}; "
            f"expected ({len(time)}, 2), a row for each time of the scenario"
        )
    if velocity is None:
        last = (path[steps] - path[steps - 1]) / (time[steps] - time[steps - 1])[:, np.newaxis]
    else:
        last = np.asarray(velocity)[steps]
    heading = None if caller.heading is None else caller.heading[steps]
    return replace(caller, place=path[steps], velocity=last, heading=heading)
