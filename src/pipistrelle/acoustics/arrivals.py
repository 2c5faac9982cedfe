"""Everything that one emission of all callers brings to the vehicle.

Stop-and-hop: path lengths and directions are those of the moment of emission, as if the vehicle
stood still until the last echo; of its motion, and of that of callers that move, only the Doppler
shift is kept.
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
    """Sound that reaches the vehicle after one emission."""

    delay: Float[np.ndarray, " a"]
    """Since the emission [s]."""
    level_db: Float[np.ndarray, " a"]
    """On the scale of the source levels [dB]."""
    bearing: Float[np.ndarray, " a"]
    """Where it comes from, relative to the heading, in [-pi, pi) [rad]."""
    frequency: Float[np.ndarray, " a"]
    """As received, Doppler shift included [Hz]."""
    caller: Int8[np.ndarray, " a"]
    """Index into the list of callers: VEHICLE, or from 1 on."""
    landmark: Int[np.ndarray, " a"]
    """Label of what it comes from: landmark i (from 0) bears i + 1, caller j (from 1) n + j."""
    departure: Float[np.ndarray, " a"] | None = None
    """Where it left another vehicle, relative to that one's heading; NaN of a caller
    without a beam [rad]. None where there is no other vehicle."""


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

    The vehicle calls in all directions within 90 degrees of its heading, with the same pressure:
    `through_piston` gives it a beam. Path lengths and directions are frozen at the emission
    (stop-and-hop); of the motion only the Doppler shift is kept, with v the vehicle's speed towards
    where the sound comes from and s the caller's along the sound that it sends. What reflects on
    the move, at a speed r towards the one who called and q towards the vehicle, adds the factor
    (c + r) / (c - q). Absorption is that of the nominal frequency.

    Parameters
    ----------
    pose : (3) [m, m, rad]
        Of the vehicle when it calls.
    velocity : (2) [m/s]
        In the world frame.
    landmarks : (n, 2) [m]
    callers : sequence of c Caller
        The vehicle first; the others reflect each other's calls, and the vehicle's, as landmarks
        do.
    config : Config
        Its sections air and target.

    Returns
    -------
    Arrivals
        In this order: active echoes by label, those behind the baffle left out (the target
        strength is 0 dB: all come straight back); then for each other caller its passive echoes
        by label, among them, under its own label, its direct call, which no target has weakened;
        of another vehicle those that left ahead of it, as `through_piston` takes them.

    Raises
    ------
    InputError
        Two of vehicle, callers and landmarks at one point, a coordinate that is not finite, or
        anyone as fast as sound.

    Notes
    -----
    Bradley & Abaid, Secs. II-A and II-B, Eqs. (2) to (4).

    Examples
    --------
    The second landmark is behind the baffle: only the beacon's call shows it.

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
    """Return the arrivals of several emissions in one world, one emission after the other.

    `poses` [m, m, rad]; `velocities` [m/s]; `landmarks` [m]; `callers`: the vehicle first; paths
    and velocities (k, 2), a row for each emission (`callers_at`); `bodies`: of the landmarks; as
    the settings have them, by default. Those whose radius is stated throw sound from their surface
    (`reflecting_points`): delay, bearing, Doppler shift, absorption and spreading are those of the
    way over it. The target strength stays that of the turn about the centre, for which its
    far-field formula stands. At a distance d from the surface a sphere's own echo would be 20
    log10(1 + radius / d) fainter: 0.6 dB for 0.3 m at 4 m. Arrivals are those of the first
    emission, then those of the second, and so on, each in the order of `arrivals_of_emission`;
    `count`: how many belong to each emission. `medium`: that of the settings by default.

    The vehicle turns round, and its next call meets the beacon instead of the landmark.

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
            departure = _departures(j, surface, heading)
            sent = in_front(departure)
            parts[-1] = arrivals_at(replace(parts[-1], departure=departure), sent)
            emissions[-1] = emissions[-1][sent]
    emission = np.concatenate(emissions)
    order = np.argsort(emission, kind="stable")
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts]).take(order)
        for name in Arrivals.__slots__
        if name != "departure"
    }
    if any(part.departure is not None for part in parts):
        alike = [np.full(part.delay.size, np.nan) for part in parts]
        left = [
            a if p.departure is None else p.departure for a, p in zip(alike, parts, strict=True)
        ]
        columns["departure"] = np.concatenate(left).take(order)
    return Arrivals(**columns), np.bincount(emission, minlength=len(poses))


def through_piston(
    arrivals: Arrivals,
    *,
    radius: float,
    frequency: float,
    speed_of_sound: float,
    off_axis: str = "pressure",
) -> Arrivals:
    r"""Return what arrives when a piston sends the vehicle's call.

    .. math:: L_\text{active} \leftarrow L_\text{active} + 20 \log_{10} p(\phi)

    An echo left in the direction that it comes from, and the piston only sends, so its pressure p
    counts once. In its nulls p is taken as 1e-12 (-240 dB): levels stay finite.

    With ``off_axis = "power"`` the factor is 10, as if p were a ratio of powers. That is no
    physics, but a slip that a program can hold unseen: the half-power beamwidths of the paper's
    Appendix B are those of a pressure, and its fitted level hides the rest.

    Parameters
    ----------
    arrivals : Arrivals
        Of `arrivals_of_emission`.
    radius : [m]
        Of the piston.
    frequency : [Hz]
        Of the vehicle's call.
    speed_of_sound : [m/s]
    off_axis : "pressure" or "power"

    Returns
    -------
    Arrivals
        The same rows in the same order; those of other callers as they were.

    Notes
    -----
    Bradley & Abaid, Eq. (1). One world is heard through twelve pistons; all else they share.

    Examples
    --------
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


def arrivals_at(arrivals: Arrivals, rows: Bool[np.ndarray, " a"] | slice) -> Arrivals:
    """Return some rows of the arrivals."""
    return Arrivals(
        delay=arrivals.delay[rows],
        level_db=arrivals.level_db[rows],
        bearing=arrivals.bearing[rows],
        frequency=arrivals.frequency[rows],
        caller=arrivals.caller[rows],
        landmark=arrivals.landmark[rows],
        departure=None if arrivals.departure is None else arrivals.departure[rows],
    )


def arrivals_together(parts: Sequence[Arrivals]) -> Arrivals:
    """Concatenate arrivals of the same callers."""
    names = [name for name in Arrivals.__slots__ if getattr(parts[0], name) is not None]
    return Arrivals(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


def _own_echoes(
    paths: SoundPaths, caller: Caller, medium: Medium, usual: TargetConfig, bodies: Bodies | None
) -> tuple[Arrivals, Int[np.ndarray, " a"]]:
    """Return the echoes of the vehicle's call from all targets ahead, and each one's emission."""
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
    """Return another caller's sounds at all emissions, by label: its echoes and its direct call."""
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


def _departures(
    j: int, paths: SoundPaths, heading: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " a"]:
    """Return the angles, off its heading, at which sound leaves another vehicle [rad], by label."""
    itself = paths.landmarks + j - 1
    way = paths.target - paths.target[:, itself : itself + 1]
    way[:, itself] = -paths.offset[:, itself]  # the direct call goes to the vehicle
    return wrap(np.arctan2(way[..., 1], way[..., 0]) - heading[:, np.newaxis]).ravel()


def through_pistons(
    arrivals: Arrivals,
    callers: Sequence[Caller],
    beam: Callable[..., Arrivals],
    *,
    radius: float,
    speed_of_sound: float,
) -> Arrivals:
    """Give the calls of the vehicle and of other vehicles the beams of pistons of one radius.

    `arrivals`: of `arrivals_of_emission`; `callers`: of the same emission; `beam`: gives the
    vehicle's call its directivity, as `through_piston` does; of another vehicle it is handed the
    sounds as if they were echoes where they departed to; `radius` [m]; `speed_of_sound` [m/s].
    The rows keep their order; those of callers without a beam are
    unchanged.
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
    """Shift the frequency of another caller's sounds by all who move, the vehicle last."""
    if paths.drift is None:
        return doppler_frequency(frequency, receiver_speed=paths.closing, speed_of_sound=c)
    echo = np.arange(paths.closing.shape[1]) != itself
    with np.errstate(divide="ignore", invalid="ignore"):  # the caller's way to itself is not used
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
    """Return the spreading loss of a caller's sounds, less the target strength of its echoes."""
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
    """Return the target strength of every body that reflects a tone [Hz]."""
    c = medium.speed_of_sound
    if bodies is not None:
        return strength_of_bodies_db(turn, bodies, usual=usual, frequency=tone, speed_of_sound=c)
    return target_strength_db(
        turn, radius=usual.radius, frequency=tone, shape=usual.shape, speed_of_sound=c
    )
