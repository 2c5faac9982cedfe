"""Everything that one emission of vehicle and beacon brings back to the vehicle.

Stop-and-hop: path lengths and directions are those of the moment of emission, as if the vehicle
stood still until the last echo; of its motion only the Doppler shift is kept.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int, Int8

from pipistrelle.acoustics.emitter import in_front, piston_directivity
from pipistrelle.acoustics.propagation import (
    absorption_db_per_m,
    doppler_frequency,
    passive_spreading_loss_db,
    spreading_loss_db,
)
from pipistrelle.acoustics.target import target_strength_db
from pipistrelle.config import AirConfig, Config, InputError
from pipistrelle.geometry import range_and_bearing

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
    >>> east, ahead, behind = np.zeros(3), [5.0, 0.0], [-5.0, 0.0]
    >>> heard = arrivals_of_emission(
    ...     east, np.zeros(2), np.array([ahead, behind]), np.array([0.0, 9.0]), Config()
    ... )
    >>> heard.source, heard.landmark
    (array([0, 0, 1, 1, 1], dtype=int8), array([1, 3, 1, 2, 3]))
    """
    targets = np.concatenate((landmarks, beacon[np.newaxis]))
    homeward, bearing = range_and_bearing(pose, targets)
    offset, incoming = targets - pose[:2], targets - beacon
    outward = np.hypot(incoming[:, 0], incoming[:, 1])
    _refuse_impossible(pose, homeward, outward[:-1])
    closing = (offset[:, 0] * velocity[0] + offset[:, 1] * velocity[1]) / homeward
    ahead = np.flatnonzero(in_front(bearing))
    label = np.arange(1, len(targets) + 1)
    path = np.concatenate((2.0 * homeward[ahead], outward + homeward))
    source = np.full(len(path), PASSIVE, dtype=np.int8)
    source[: len(ahead)] = ACTIVE
    return Arrivals(
        delay=path / config.air.speed_of_sound,
        level_db=np.concatenate(
            (
                _active_levels_db(homeward[ahead], config),
                _passive_levels_db(outward[:-1], homeward[:-1], _turn(incoming, offset), config),
                _direct_level_db(homeward[-1:], config),
            )
        ),
        bearing=np.concatenate((bearing[ahead], bearing)),
        frequency=_frequencies(closing, ahead, config),
        source=source,
        landmark=np.concatenate((label[ahead], label)),
    )
