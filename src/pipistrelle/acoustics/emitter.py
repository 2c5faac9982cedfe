"""The vehicle's emitter: a circular piston that calls forward only.

The wider the piston, the narrower its beam. The paper names its emitters by their half-power
beamwidth, the full angle within which the power stays above half of that on the axis.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import j1

from pipistrelle.config import Config, InputError

HALF_POWER = 1.6163399483107033
"""Root x of (2 J1(x) / x)^2 = 1/2: ka sin(angle) where the beam has fallen to half its power."""


def jinc(x: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    r"""Return the far field of a uniform disc, 1 on its axis.

    .. math:: \operatorname{jinc}(x) = 2 J_1(x) / x

    `x`: ka times the sine of the angle off the axis. The values lie in [-0.133, 1].

    >>> jinc(np.array([0.0, 1.0, 5.1356])).round(3)
    array([ 1.   ,  0.88 , -0.132])
    """
    on_axis = np.abs(x) < 1e-8  # where 1 - x^2 / 8 is 1 in double precision
    x = np.where(on_axis, 1.0, x)
    return np.where(on_axis, 1.0, 2.0 * j1(x) / x)


def in_front(bearing: Float[np.ndarray, "*n"] | float) -> Bool[np.ndarray, "*n"]:
    """Tell whether a direction is within 90 degrees of a back-baffled emitter's axis.

    `bearing` [rad].

    Bradley & Abaid, Sec. II-A.

    >>> in_front(np.radians([0.0, -90.0, 91.0, 270.5]))
    array([ True,  True, False,  True])
    """
    return np.asarray(np.cos(bearing) >= 0.0)


def piston_directivity(
    bearing: Float[np.ndarray, "*n"] | float,
    *,
    frequency: float,
    radius: float,
    speed_of_sound: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the pressure of a back-baffled circular piston, relative to its axis.

    .. math:: p(\phi) = \left| \frac{2 J_1(ka\sin\phi)}{ka\sin\phi} \right|
              \text{ for } |\phi| \le 90°, \text{ else } 0, \qquad k = 2\pi f / c
       :label: eq-1

    Parameters
    ----------
    bearing : (*n) [rad]
        Angle off the axis, which is the vehicle's heading.
    frequency : [Hz]
    radius : [m]
        Radius a of the piston.
    speed_of_sound : [m/s]

    Returns
    -------
    (*n)
        Pressure ratio in [0, 1].

    Notes
    -----
    Bradley & Abaid, Eq. (1), after Arditi et al. (2015). As printed, its brackets leave the sine
    out of the Bessel function's argument; here it is inside.

    Examples
    --------
    At the edge of its beamwidth a piston sends half of its power.

    >>> call = dict(frequency=35e3, speed_of_sound=343.0)
    >>> edge = beamwidth(0.0088, **call) / 2
    >>> np.round(piston_directivity(np.array([0.0, edge, np.pi]), radius=0.0088, **call) ** 2, 12)
    array([1. , 0.5, 0. ])
    """
    ka = 2.0 * np.pi * frequency / speed_of_sound * radius
    return np.where(in_front(bearing), np.abs(jinc(ka * np.sin(bearing))), 0.0)


def beamwidth(
    radius: Float[np.ndarray, "*n"] | float, *, frequency: float, speed_of_sound: float
) -> Float[np.ndarray, "*n"]:
    r"""Return the half-power beamwidth of a back-baffled piston.

    .. math:: 2 \arcsin \frac{x}{ka}, \quad (2 J_1(x) / x)^2 = \tfrac12, \quad x = 1.6163...

    Parameters
    ----------
    radius : (*n) [m]
    frequency : [Hz]
    speed_of_sound : [m/s]

    Returns
    -------
    (*n) [rad]
        Full width; pi where the power never falls to half within 90 degrees of the axis.

    Raises
    ------
    InputError
        A radius that is not a positive number.

    Notes
    -----
    Bradley & Abaid, Sec. II-A and Appendix B.

    Examples
    --------
    >>> radius = np.array([0.0025, 0.0088])
    >>> np.degrees(beamwidth(radius, frequency=35e3, speed_of_sound=343.0)).round(1)
    array([180. ,  33.3])
    """
    if not np.all((np.asarray(radius) > 0) & np.isfinite(radius)):
        raise InputError(f"radius: found {radius}, expected metres above 0; give a piston a size")
    k = 2.0 * np.pi * frequency / speed_of_sound
    return np.asarray(2.0 * np.arcsin(np.minimum(HALF_POWER / (k * np.asarray(radius)), 1.0)))


def beamwidth_of(config: Config) -> float:
    """Return the half-power beamwidth of the vehicle's call, as the settings have it.

    Returns [rad].

    >>> round(float(np.degrees(beamwidth_of(Config()))), 1)
    33.3
    """
    call = {"frequency": config.emitter.centre, "speed_of_sound": config.medium.sound_speed}
    return float(beamwidth(config.emitter.radius, **call))


def piston_radius(
    beamwidth: Float[np.ndarray, "*n"] | float, *, frequency: float, speed_of_sound: float
) -> Float[np.ndarray, "*n"]:
    r"""Return the radius of the piston that makes a half-power beamwidth.

    .. math:: a = \frac{x}{k \sin(\text{beamwidth} / 2)}, \quad (2 J_1(x) / x)^2 = \tfrac12

    `beamwidth` [rad]: full width, in (0, pi]; `frequency` [Hz]; `speed_of_sound` [m/s]. Returns
    [m]: at pi, the largest of the pistons that are that wide.

    Bradley & Abaid, Sec. II-A and Appendix B.

    >>> wide = piston_radius(np.pi, frequency=35e3, speed_of_sound=343.0)
    >>> round(1e3 * float(wide), 2)
    2.52
    """
    width = np.asarray(beamwidth)
    if not np.all((width > 0) & (width <= np.pi)):
        raise InputError(
            f"beamwidth: found {np.degrees(width)} degrees, expected above 0 and up to 180; "
            "180 is the widest beam of a back-baffled piston"
        )
    k = 2.0 * np.pi * frequency / speed_of_sound
    return np.asarray(HALF_POWER / (k * np.sin(width / 2.0)))
