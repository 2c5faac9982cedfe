"""Everything that one emission of vehicle and beacon brings back to the vehicle.

Stop-and-hop: path lengths and directions are those of the moment of emission, as if the vehicle
stood still until the last echo; of its motion only the Doppler shift is kept.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from pipistrelle.acoustics.emitter import in_front, piston_directivity
from pipistrelle.acoustics.propagation import (
    absorption_db_per_m,
    doppler_frequency,
    passive_spreading_loss_db,
    spreading_loss_db,
)
from pipistrelle.acoustics.target import target_strength_db
from pipistrelle.config import AirConfig, Config, InputError
from pipistrelle.geometry import wrap

ACTIVE, PASSIVE = 0, 1
"""Whose call it is: the vehicle's own, or the beacon's."""

_DEEPEST_NULL = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrivals:
    """Sound that reaches the vehicle after one emission.

    Attributes
    ----------
    delay : (a) [s]
        Since the emission.
    level_db : (a) [dB]
        On the scale of the source levels.
    bearing : (a) [rad]
        Where it comes from, relative to the heading, in [-pi, pi).
    frequency : (a) [Hz]
        As received, Doppler shift included.
    source : (a)
        ACTIVE or PASSIVE.
    landmark : (a)
        Label of what it comes from: landmark i (from 0) bears i + 1, the beacon n + 1.
    """

    delay: Float[np.ndarray, " a"]
    level_db: Float[np.ndarray, " a"]
    bearing: Float[np.ndarray, " a"]
    frequency: Float[np.ndarray, " a"]
    source: Int8[np.ndarray, " a"]
    landmark: Int[np.ndarray, " a"]


def arrivals_of_emission(
    pose: Float[np.ndarray, "3"],
    velocity: Float[np.ndarray, "2"],
    landmarks: Float[np.ndarray, "n 2"],
    beacon: Float[np.ndarray, "2"],
    config: Config,
) -> Arrivals:
    r"""Echoes and calls that reach the vehicle after it and the beacon have called at once.

    .. math:: L = L_0 - \beta - \alpha d + TS(\gamma), \qquad t = d / c

    The vehicle calls in all directions within 90 degrees of its heading, with the same pressure:
    `through_piston` gives it a beam. Path lengths and directions are frozen at the emission
    (stop-and-hop); of the motion only the Doppler shift is kept. Absorption is that of the nominal
    frequency.

    Parameters
    ----------
    pose : (3) [m, m, rad]
        Of the vehicle when it calls.
    velocity : (2) [m/s]
        In the world frame.
    landmarks : (n, 2) [m]
    beacon : (2) [m]
        It reflects the vehicle's call as a landmark does.
    config : Config
        Its sections air, target, emitter and beacon.

    Returns
    -------
    Arrivals
        In this order: active echoes by label, those behind the baffle left out (the target
        strength is 0 dB: all come straight back); passive echoes by label; the beacon's direct
        call, which no target has weakened.

    Raises
    ------
    InputError
        Two of vehicle, beacon and a landmark at one point, a coordinate that is not finite, or a
        vehicle as fast as sound.

    Notes
    -----
    Bradley & Abaid, Secs. II-A and II-B, Eqs. (2) to (4).

    Examples
    --------
    The second landmark is behind the baffle: only the beacon's call shows it.

    >>> east, still = np.zeros(3), np.zeros(2)
    >>> landmarks, beacon = np.array([[5.0, 0.0], [-5.0, 0.0]]), np.array([0.0, 9.0])
    >>> heard = arrivals_of_emission(east, still, landmarks, beacon, Config())
    >>> heard.source, heard.landmark
    (array([0, 0, 1, 1, 1], dtype=int8), array([1, 3, 1, 2, 3]))
    """
    poses, velocities = pose[np.newaxis], velocity[np.newaxis]
    return arrivals_of_emissions(poses, velocities, landmarks, beacon, config)[0]


def arrivals_of_emissions(
    poses: Float[np.ndarray, "k 3"],
    velocities: Float[np.ndarray, "k 2"],
    landmarks: Float[np.ndarray, "n 2"],
    beacon: Float[np.ndarray, "2"],
    config: Config,
) -> tuple[Arrivals, Int[np.ndarray, " k"]]:
    """Arrivals of several emissions in one world, emission after emission (`arrivals_of_emission`).

    Parameters
    ----------
    poses : (k, 3) [m, m, rad]
    velocities : (k, 2) [m/s]
    landmarks : (n, 2) [m]
    beacon : (2) [m]
    config : Config

    Returns
    -------
    Arrivals
        Those of the first emission, then those of the second, and so on, each in the order of
        `arrivals_of_emission`.
    count : (k)
        How many belong to each emission.

    Raises
    ------
    InputError
        As for one emission.

    Examples
    --------
    The vehicle turns round, and its next call meets the beacon instead of the landmark.

    >>> poses, still = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]]), np.zeros((2, 2))
    >>> landmarks, beacon = np.array([[5.0, 0.0]]), np.array([-9.0, 0.0])
    >>> heard, count = arrivals_of_emissions(poses, still, landmarks, beacon, Config())
    >>> count, heard.landmark
    (array([3, 3]), array([1, 1, 2, 2, 1, 2]))
    """
    air, targets = config.air, np.concatenate((landmarks, beacon[np.newaxis]))
    offset, incoming = targets - poses[:, np.newaxis, :2], targets - beacon
    homeward = np.hypot(offset[..., 0], offset[..., 1])
    outward = np.hypot(incoming[:, 0], incoming[:, 1])
    _refuse_impossible(poses, homeward, outward)
    bearing = wrap(np.arctan2(offset[..., 1], offset[..., 0]) - poses[:, 2:])
    east, north = velocities[:, :1], velocities[:, 1:]
    closing = (offset[..., 0] * east + offset[..., 1] * north) / homeward
    ahead = np.flatnonzero(in_front(bearing))
    pair = np.concatenate((ahead, np.arange(homeward.size)))  # of an emission and a target
    order = np.argsort(pair // len(targets), kind="stable")
    pair, own = pair[order], order < len(ahead)
    target, source = pair % len(targets), np.where(own, np.int8(ACTIVE), np.int8(PASSIVE))
    back, closing = homeward.ravel()[pair], closing.ravel()[pair]
    path = back + np.where(own, back, outward[target])
    loss_db = _loss_db(homeward, outward, ahead, _turn(incoming, offset), config)[order]
    tones = (config.emitter.frequency, config.beacon.frequency)
    absorption = np.array([_absorption(air, tone) for tone in tones])[source]
    sent_db = np.array([config.emitter.level_db, config.beacon.level_db])[source]
    heard = Arrivals(
        delay=path / air.speed_of_sound,
        level_db=sent_db - loss_db - absorption * path,
        bearing=bearing.ravel()[pair],
        frequency=doppler_frequency(
            np.array(tones)[source],
            receiver_speed=closing,
            source_speed=np.where(own, closing, 0.0),
            speed_of_sound=air.speed_of_sound,
        ),
        source=source,
        landmark=target + 1,
    )
    return heard, np.bincount(pair // len(targets))


def through_piston(
    arrivals: Arrivals, *, radius: float, frequency: float, speed_of_sound: float
) -> Arrivals:
    r"""What arrives when a piston sends the vehicle's call.

    .. math:: L_\text{active} \leftarrow L_\text{active} + 20 \log_{10} p(\phi)

    An echo left in the direction that it comes from, and the piston only sends, so its pressure p
    counts once. In its nulls p is taken as 1e-12 (-240 dB): levels stay finite.

    Parameters
    ----------
    arrivals : Arrivals
        Of `arrivals_of_emission`.
    radius : [m]
        Of the piston.
    frequency : [Hz]
        Of the vehicle's call.
    speed_of_sound : [m/s]

    Returns
    -------
    Arrivals
        The same rows in the same order; passive ones as they were.

    Notes
    -----
    Bradley & Abaid, Eq. (1). One world is heard through twelve pistons; all else they share.

    Examples
    --------
    >>> one, beam = np.ones(2), np.array([0.0, 1.5])
    >>> level = through_piston(
    ...     Arrivals(delay=one, level_db=0 * one, bearing=beam, frequency=35e3 * one,
    ...              source=np.zeros(2, dtype=np.int8), landmark=np.array([1, 2])),
    ...     radius=0.0088, frequency=35e3, speed_of_sound=343.0,
    ... ).level_db
    >>> level.round(1)
    array([  0. , -18.6])
    """
    own = np.flatnonzero(arrivals.source == ACTIVE)
    pressure = piston_directivity(
        arrivals.bearing[own], frequency=frequency, radius=radius, speed_of_sound=speed_of_sound
    )
    level_db = arrivals.level_db.copy()
    level_db[own] += 20.0 * np.log10(np.maximum(pressure, _DEEPEST_NULL))
    return Arrivals(
        delay=arrivals.delay,
        level_db=level_db,
        bearing=arrivals.bearing,
        frequency=arrivals.frequency,
        source=arrivals.source,
        landmark=arrivals.landmark,
    )


def rows_of(arrivals: Arrivals, rows: Bool[np.ndarray, " a"] | slice) -> Arrivals:
    """Take some of the arrivals.

    Parameters
    ----------
    arrivals : Arrivals
    rows : (a) bool or slice

    Returns
    -------
    Arrivals
    """
    return Arrivals(
        delay=arrivals.delay[rows],
        level_db=arrivals.level_db[rows],
        bearing=arrivals.bearing[rows],
        frequency=arrivals.frequency[rows],
        source=arrivals.source[rows],
        landmark=arrivals.landmark[rows],
    )


def _loss_db(
    homeward: Float[np.ndarray, "k t"],
    outward: Float[np.ndarray, " t"],
    ahead: Int[np.ndarray, " b"],
    turn: Float[np.ndarray, "k t"],
    config: Config,
) -> Float[np.ndarray, " a"]:
    """Spreading less target strength of the echoes ahead, then of each passive echo and call."""
    air, target = config.air, config.target
    strength_db = target_strength_db(
        turn[:, :-1],
        radius=target.radius,
        frequency=config.beacon.frequency,
        shape=target.shape,
        speed_of_sound=air.speed_of_sound,
    )
    active = spreading_loss_db(2.0 * homeward.ravel()[ahead], ways=2)
    sent, back = np.broadcast_to(outward[:-1], strength_db.shape), homeward[:, :-1]
    passive = passive_spreading_loss_db(sent, back, law=air.spreading)
    direct = spreading_loss_db(homeward[:, -1:])
    return np.concatenate((active, np.hstack((passive - strength_db, direct)).ravel()))


def _turn(
    incoming: Float[np.ndarray, "t 2"], offset: Float[np.ndarray, "k t 2"]
) -> Float[np.ndarray, "k t"]:
    """Angle from the way in to the way on to the vehicle, which is -offset: pi is back [rad]."""
    x, y = incoming[:, 0], incoming[:, 1]
    u, v = -offset[..., 0], -offset[..., 1]
    return np.arctan2(x * v - y * u, x * u + y * v)


@lru_cache(maxsize=64)
def _absorption(air: AirConfig, frequency: float) -> float:
    """Absorption of one tone in this air [dB/m], computed once."""
    return float(
        absorption_db_per_m(
            frequency,
            temperature_c=air.temperature_c,
            relative_humidity=air.relative_humidity,
            pressure_kpa=air.pressure_kpa,
        )
    )


def _refuse_impossible(
    poses: Float[np.ndarray, "k 3"],
    homeward: Float[np.ndarray, "k t"],
    outward: Float[np.ndarray, " t"],
) -> None:
    """Refuse points that coincide and coordinates that are not finite."""
    paths = np.hstack((homeward, np.broadcast_to(outward[:-1], (len(poses), len(outward) - 1))))
    good = (paths.min(axis=1) > 0.0) & (paths.max(axis=1) < math.inf) & np.isfinite(poses[:, 2])
    if good.all():
        return
    bad = int(np.argmin(good))
    names = [f"landmark {i}" for i in range(1, len(outward))]
    ends = [f"vehicle to {name}" for name in [*names, "beacon"]] + [f"beacon to {n}" for n in names]
    found = [f"{e}: {d} m" for e, d in zip(ends, paths[bad], strict=True) if not 0.0 < d < math.inf]
    raise InputError(
        f"world around the pose {poses[bad]}: found {', '.join(found) or 'no finite heading'}; "
        "expected vehicle, beacon and landmarks at distinct, finite points; move them apart "
        "(scenario.clearance keeps them so)"
    )
