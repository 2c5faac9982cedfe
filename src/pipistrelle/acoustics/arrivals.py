"""Arrivals: all echoes and direct calls at the vehicle after one emission of all callers.

Stop-and-hop: path lengths and directions are frozen at the moment of emission; of the motion of the
vehicle and of callers only the Doppler shift is used.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from pipistrelle.acoustics.emitter import (
    Bodies,
    backscatter_db,
    in_front,
    piston_directivity,
    strength_of_bodies_db,
    target_strength_db,
    with_usual,
)
from pipistrelle.acoustics.paths import (
    VEHICLE,
    Caller,
    SoundPaths,
    paths_over_surfaces,
    paths_to_vehicle,
    refuse_impossible,
    turn_of_sound,
)
from pipistrelle.acoustics.propagation import (
    Medium,
    doppler_frequency,
    medium_of,
    passive_spreading_loss_db,
    spreading_loss_db,
)
from pipistrelle.config import Config, TargetConfig
from pipistrelle.geometry import wrap

_DEEPEST_NULL = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrivals:
    """Delays, levels and bearings of echoes and calls that reach the vehicle after an emission."""

    delay: Float[np.ndarray, " a"]
    """Since the emission [s]."""
    level_db: Float[np.ndarray, " a"]
    """Relative to the source levels' reference [dB]."""
    bearing: Float[np.ndarray, " a"]
    """Direction of the source, relative to the heading, in [-pi, pi) [rad]."""
    frequency: Float[np.ndarray, " a"]
    """As received, with Doppler shift [Hz]."""
    caller: Int8[np.ndarray, " a"]
    """Index into the list of callers: VEHICLE, or from 1."""
    landmark: Int[np.ndarray, " a"]
    """Label of the source: landmark i (from 0) has i + 1, caller j (from 1) n + j."""
    departure: Float[np.ndarray, " a"] | None = None
    """Direction of departure from another vehicle, relative to its heading; NaN for callers
    without a beam [rad]. None if there is no other vehicle."""


def arrivals_of_emission(
    pose: Float[np.ndarray, "3"],
    velocity: Float[np.ndarray, "2"],
    landmarks: Float[np.ndarray, "n 2"],
    callers: Sequence[Caller],
    config: Config,
) -> Arrivals:
    r"""Return the echoes and calls that reach the vehicle after all callers have called at once.

    .. math:: L = L_0 - \beta - \alpha d + TS(\gamma), \qquad t = d / c, \qquad
              f' = f \, \frac{c + v}{c - s}

    The vehicle calls with equal pressure in all directions within 90 degrees of its heading; apply
    `through_piston` for its beam. Path lengths and directions are frozen at the emission
    (stop-and-hop); v is the vehicle's speed towards the source of the sound and s the caller's
    along the sound that it sends. A moving reflector, with the speed r towards the caller and q
    towards the vehicle, adds the factor (c + r) / (c - q). Absorption is at the nominal frequency.

    `pose` [m, m, rad]: of the vehicle when it calls; `velocity` [m/s]: in the world frame;
    `landmarks` [m]; `callers`: the vehicle first; the others also reflect each other's calls and
    the vehicle's, as landmarks do; `config`: sections of the medium and target are used.

    Returns first the active echoes by label, without landmarks behind the baffle (their target
    strength is 0 dB); then for each other caller its passive echoes by label, with its direct call
    under its own label, without target strength; for another vehicle only sound that left within 90
    degrees of its heading. Raises InputError if two of vehicle, callers and landmarks coincide, a
    coordinate is not finite, or a speed reaches the speed of sound.

    Bradley & Abaid, Secs. II-A and II-B, Eqs. (2) to (4). The second landmark is behind the baffle:
    only the beacon's call reveals it.

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> east, still = np.zeros(3), np.zeros(2)
    >>> landmarks, beacon = np.array([[5.0, 0.0], [-5.0, 0.0]]), np.array([0.0, 9.0])
    >>> heard = arrivals_of_emission(east, still, landmarks, callers_of(Config(), beacon), Config())
    >>> heard.caller, heard.landmark
    (array([0, 0, 1, 1, 1], dtype=int8), array([1, 3, 1, 2, 3]))
    """
    poses, velocities = pose[np.newaxis], velocity[np.newaxis]
    return arrivals_of_emissions(poses, velocities, landmarks, callers, config)[0]


def arrivals_of_emissions(
    poses: Float[np.ndarray, "k 3"],
    velocities: Float[np.ndarray, "k 2"],
    landmarks: Float[np.ndarray, "n 2"],
    callers: Sequence[Caller],
    config: Config,
    bodies: Bodies | None = None,
    medium: Medium | None = None,
) -> tuple[Arrivals, Int[np.ndarray, " k"]]:
    """Return the echoes and direct calls that reach the vehicle after each of several emissions.

    `poses` [m, m, rad]; `velocities` [m/s]; `landmarks` [m]; `callers`: the vehicle first, with
    paths and velocities (k, 2), a row for each emission (`callers_at`); `bodies`: of the landmarks,
    by default the settings'; `medium`: by default the settings'. Also returns the number of
    arrivals of each emission; the order within an emission is that of `arrivals_of_emission`.

    Bodies with a radius reflect at their surface (`reflecting_points`): delay, bearing, Doppler
    shift, absorption and spreading are of the path over it. The target strength is of the turn
    about the centre, as in its far-field formula; at a distance d from the surface a sphere's echo
    would be 20 log10(1 + radius / d) fainter: 0.6 dB for 0.3 m at 4 m.

    The vehicle turns round, and its next call meets the beacon instead of the landmark:

    >>> from pipistrelle.acoustics.paths import callers_of
    >>> poses, still = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]]), np.zeros((2, 2))
    >>> landmarks, beacon = np.array([[5.0, 0.0]]), np.array([-9.0, 0.0])
    >>> callers = callers_of(Config(), beacon)
    >>> heard, count = arrivals_of_emissions(poses, still, landmarks, callers, Config())
    >>> count, heard.landmark
    (array([3, 3]), array([1, 1, 2, 2, 1, 2]))
    """
    medium, usual = medium or medium_of(config.medium), config.target
    paths = paths_to_vehicle(poses, velocities, landmarks, callers)
    extent = np.zeros(paths.homeward.shape[1])
    if bodies is not None:
        bodies = with_usual(bodies, len(callers) - 1, usual)
        extent = np.nan_to_num(bodies.radius)
    refuse_impossible(paths, callers, extent)
    surface = paths_over_surfaces(paths, VEHICLE, extent)
    own, emission = _own_echoes(surface, callers[VEHICLE], medium, usual, bodies)
    parts, emissions = [own], [emission]
    for j in range(1, len(callers)):
        place = paths.target[:, paths.landmarks + j - 1, np.newaxis]
        turn = turn_of_sound(paths.target - place, paths.offset)
        strength_db = _strength_db(turn, callers[j].frequency, medium, usual, bodies)
        surface = paths_over_surfaces(paths, j, extent)
        parts.append(_sounds_of(j, surface, callers[j], medium, strength_db))
        emissions.append(np.repeat(np.arange(len(poses)), paths.homeward.shape[1]))
        if (heading := callers[j].heading) is not None:
            itself = surface.landmarks + j - 1
            way = surface.target - surface.target[:, itself : itself + 1]
            way[:, itself] = -surface.offset[:, itself]  # the direct call goes to the vehicle
            departure = wrap(np.arctan2(way[..., 1], way[..., 0]) - heading[:, np.newaxis]).ravel()
            sent = in_front(departure)
            parts[-1] = arrivals_at(replace(parts[-1], departure=departure), sent)
            emissions[-1] = emissions[-1][sent]
    emission = np.concatenate(emissions)
    order = np.argsort(emission, kind="stable")
    if any(part.departure is not None for part in parts):
        unknown = [np.full(part.delay.size, np.nan) for part in parts]
        parts = [
            replace(part, departure=nan) if part.departure is None else part
            for part, nan in zip(parts, unknown, strict=True)
        ]
    heard = arrivals_at(arrivals_together(parts), order)
    return heard, np.bincount(emission, minlength=len(poses))


def through_piston(
    arrivals: Arrivals,
    *,
    radius: float,
    frequency: float,
    speed_of_sound: float,
    off_axis: str = "pressure",
) -> Arrivals:
    r"""Attenuate the echoes of the vehicle's call by the directivity of its circular piston.

    .. math:: L_\text{active} \leftarrow L_\text{active} + 20 \log_{10} p(\phi)

    An echo left in the direction that it comes from, and the piston is only the source, so its
    pressure p counts once. In its nulls p is 1e-12 (-240 dB), so that levels stay finite.

    With ``off_axis = "power"`` the factor is 10, as if p were a ratio of powers. That is not
    physics, but an easily overlooked slip: the half-power beamwidths of the paper's Appendix B are
    a pressure's, and its fitted level hides the rest.

    `radius` [m]: of the piston; `frequency` [Hz]: of the vehicle's call; `speed_of_sound` [m/s].
    Returns the same rows; other callers' are unchanged.

    Bradley & Abaid, Eq. (1). One world is used with twelve pistons, with everything else shared.

    >>> one, beam = np.ones(2), np.array([0.0, 1.5])
    >>> level = through_piston(
    ...     Arrivals(delay=one, level_db=0 * one, bearing=beam, frequency=35e3 * one,
    ...              caller=np.zeros(2, dtype=np.int8), landmark=np.array([1, 2])),
    ...     radius=0.0088, frequency=35e3, speed_of_sound=343.0,
    ... ).level_db
    >>> level.round(1)
    array([  0. , -18.6])
    """
    own = np.flatnonzero(arrivals.caller == VEHICLE)
    pressure = piston_directivity(
        arrivals.bearing[own], frequency=frequency, radius=radius, speed_of_sound=speed_of_sound
    )
    level_db = arrivals.level_db.copy()
    decibels = 20.0 if off_axis == "pressure" else 10.0
    level_db[own] += decibels * np.log10(np.maximum(pressure, _DEEPEST_NULL))
    return replace(arrivals, level_db=level_db)


def arrivals_at(
    arrivals: Arrivals, rows: Bool[np.ndarray, " a"] | Int[np.ndarray, " k"] | slice
) -> Arrivals:
    """Select arrivals by a mask, indices or a slice."""
    return Arrivals(
        delay=arrivals.delay[rows],
        level_db=arrivals.level_db[rows],
        bearing=arrivals.bearing[rows],
        frequency=arrivals.frequency[rows],
        caller=arrivals.caller[rows],
        landmark=arrivals.landmark[rows],
        departure=None if arrivals.departure is None else arrivals.departure[rows],
    )  # faster than by their names


def arrivals_together(parts: Sequence[Arrivals]) -> Arrivals:
    """Concatenate several sets of arrivals into one."""
    names = [name for name in Arrivals.__slots__ if getattr(parts[0], name) is not None]
    return Arrivals(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


def _own_echoes(
    paths: SoundPaths, caller: Caller, medium: Medium, usual: TargetConfig, bodies: Bodies | None
) -> tuple[Arrivals, Int[np.ndarray, " a"]]:
    """Return the vehicle's echoes from targets ahead of it, and the emission index of each."""
    c, absorption = medium.speed_of_sound, medium.absorption_db_per_m(caller.frequency)
    ahead = np.flatnonzero(in_front(paths.bearing))
    back, closing = paths.homeward.ravel()[ahead], paths.closing.ravel()[ahead]
    emission, target = np.divmod(ahead, paths.homeward.shape[1])
    path, loss_db = back + back, spreading_loss_db(2.0 * back, ways=2)
    if bodies is not None:
        loss_db = loss_db - backscatter_db(bodies, usual)[target]
    frequency = doppler_frequency(
        caller.frequency, receiver_speed=closing, source_speed=closing, speed_of_sound=c
    )
    if isinstance(paths.approach, np.ndarray):
        moved = paths.approach.ravel()[ahead]
        frequency = doppler_frequency(
            frequency, receiver_speed=moved, source_speed=moved, speed_of_sound=c
        )
    heard = Arrivals(
        delay=path / c,
        level_db=caller.level_db - loss_db - absorption * path,
        bearing=paths.bearing.ravel()[ahead],
        frequency=frequency,
        caller=np.full(ahead.size, VEHICLE, dtype=np.int8),
        landmark=target + 1,
    )
    return heard, emission


def _sounds_of(
    j: int, paths: SoundPaths, caller: Caller, medium: Medium, strength_db: Float[np.ndarray, "k t"]
) -> Arrivals:
    """Return the echoes and direct calls of a caller, other than the vehicle, at all emissions."""
    c, (emissions, targets) = medium.speed_of_sound, paths.homeward.shape
    itself = paths.landmarks + j - 1
    incoming = paths.target - paths.target[:, itself : itself + 1]
    outward = np.hypot(incoming[..., 0], incoming[..., 1])
    path = paths.homeward + outward
    loss_db = _loss_db(itself, paths, outward, strength_db, medium)
    frequency = _shifted(itself, paths, incoming, outward, caller.frequency, c)
    absorption = medium.absorption_db_per_m(caller.frequency)
    return Arrivals(
        delay=(path / c).ravel(),
        level_db=(caller.level_db - loss_db - absorption * path).ravel(),
        bearing=paths.bearing.ravel(),
        frequency=frequency.ravel(),
        caller=np.full(path.size, j, dtype=np.int8),
        landmark=np.tile(np.arange(1, targets + 1), emissions),
    )


def through_pistons(
    arrivals: Arrivals,
    callers: Sequence[Caller],
    beam: Callable[..., Arrivals],
    *,
    radius: float,
    speed_of_sound: float,
) -> Arrivals:
    """Attenuate the calls of all vehicles by the directivity of pistons with the same radius.

    `arrivals`: of `arrivals_of_emission`; `callers`: of the same emission; `beam`: applies the
    vehicle's directivity, such as `through_piston`; another vehicle's arrivals are passed to it
    with their departures as bearings; `radius` [m]; `speed_of_sound` [m/s]. Order and arrivals of
    callers without a beam are unchanged.
    """
    c, own = speed_of_sound, callers[VEHICLE].frequency
    heard = beam(arrivals, radius=radius, frequency=own, speed_of_sound=c)
    departure = arrivals.departure
    if departure is None:
        return heard
    as_echoes = replace(arrivals, bearing=departure, caller=np.zeros_like(arrivals.caller))
    level_db = heard.level_db.copy()
    for j in np.unique(arrivals.caller[np.isfinite(departure)]):
        rows, tone = arrivals.caller == j, callers[j].frequency
        as_own = arrivals_at(as_echoes, rows)
        level_db[rows] = beam(as_own, radius=radius, frequency=tone, speed_of_sound=c).level_db
    return replace(heard, level_db=level_db)


def _shifted(
    itself: int,
    paths: SoundPaths,
    incoming: Float[np.ndarray, "_ t 2"],
    outward: Float[np.ndarray, "_ t"],
    frequency: float,
    c: float,
) -> Float[np.ndarray, "k t"]:
    """Return the received frequencies of a caller's sounds, Doppler-shifted by all motions [Hz]."""
    if paths.drift is None:
        return doppler_frequency(frequency, receiver_speed=paths.closing, speed_of_sound=c)
    echo = np.arange(paths.closing.shape[1]) != itself
    with np.errstate(divide="ignore", invalid="ignore"):  # the caller's path to itself is not used
        unit = incoming / outward[..., np.newaxis]
    sent = np.sum(paths.drift[:, itself : itself + 1] * unit, axis=-1)
    met = -np.sum(paths.drift * unit, axis=-1)
    heard = doppler_frequency(
        frequency,
        receiver_speed=paths.closing,
        source_speed=np.where(echo, sent, paths.approach),
        speed_of_sound=c,
    )
    return doppler_frequency(
        heard,
        receiver_speed=np.where(echo, met, 0.0),
        source_speed=np.where(echo, paths.approach, 0.0),
        speed_of_sound=c,
    )


def _loss_db(
    itself: int,
    paths: SoundPaths,
    outward: Float[np.ndarray, "_ t"],
    strength_db: Float[np.ndarray, "k t"],
    medium: Medium,
) -> Float[np.ndarray, "k t"]:
    """Return a caller's spreading losses to the vehicle [dB], less the echoes' target strengths."""
    sent = np.broadcast_to(outward, strength_db.shape).copy()
    sent[:, itself] = 1.0  # no echo of itself: any distance will do
    loss_db = passive_spreading_loss_db(sent, paths.homeward, law=medium.spreading) - strength_db
    loss_db[:, itself] = spreading_loss_db(paths.homeward[:, itself])
    return loss_db


def _strength_db(
    turn: Float[np.ndarray, "k t"],
    tone: float,
    medium: Medium,
    usual: TargetConfig,
    bodies: Bodies | None,
) -> Float[np.ndarray, "k t"]:
    """Return the target strength of every target at every emission for a tone [dB]."""
    c = medium.speed_of_sound
    if bodies is not None:
        return strength_of_bodies_db(turn, bodies, usual=usual, frequency=tone, speed_of_sound=c)
    return target_strength_db(
        turn, radius=usual.radius, frequency=tone, shape=usual.shape, speed_of_sound=c
    )
