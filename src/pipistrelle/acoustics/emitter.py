"""The vehicle's emitter, a back-baffled circular piston, and the target strength of bodies.

The wider the piston, the narrower its beam. The paper names its emitters by their half-power
beamwidth, the full angle within which the power exceeds half of the axial.

`SHAPES` contains the shapes of bodies by name. The two here are Morse's short-wave limit of a rigid
body: a mirror on the lit side, and around the forward direction the shadow, which radiates like the
body's outline. Their interference is left out, so the formulae are near the exact series (0.1 to
0.9 dB) at 90 to 180 degrees and a smooth version of it nearer to the forward direction.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.special import j1

from pipistrelle.config import Config, InputError, TargetConfig

HALF_POWER = 1.6163399483107033
"""Root x of (2 J1(x) / x)^2 = 1/2: ka sin(angle) at half the axial power."""


def jinc(x: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    r"""Return 2 J1(x) / x, the far-field pressure of a uniform disc relative to its axis.

    .. math:: \operatorname{jinc}(x) = 2 J_1(x) / x

    `x`: ka times the sine of the angle off the axis. The values are in [-0.133, 1].

    >>> jinc(np.array([0.0, 1.0, 5.1356])).round(3)
    array([ 1.   ,  0.88 , -0.132])
    """
    on_axis = np.abs(x) < 1e-8  # where 1 - x^2 / 8 is 1 in double precision
    x = np.where(on_axis, 1.0, x)
    return np.where(on_axis, 1.0, 2.0 * j1(x) / x)


def in_front(bearing: Float[np.ndarray, "*n"] | float) -> Bool[np.ndarray, "*n"]:
    """Return whether a direction [rad] is within 90 degrees of a back-baffled emitter's axis.

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
    r"""Return the pressure of a back-baffled piston at angles off its axis, relative to the axis.

    .. math:: p(\phi) = \left| \frac{2 J_1(ka\sin\phi)}{ka\sin\phi} \right|
              \text{ for } |\phi| \le 90°, \text{ else } 0, \qquad k = 2\pi f / c
       :label: eq-1

    `bearing` [rad]: angle off the axis, the vehicle's heading; `frequency` [Hz]; `radius` [m]: a of
    the piston; `speed_of_sound` [m/s]. Returns a ratio in [0, 1].

    Bradley & Abaid, Eq. (1), after Arditi et al. (2015). As printed, its brackets leave the sine
    out of the Bessel function's argument; here it is inside. At the edge of its beamwidth a piston
    sends half of its power:

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
    r"""Return the full half-power beamwidth [rad] of a back-baffled piston of a radius [m].

    .. math:: 2 \arcsin \frac{x}{ka}, \quad (2 J_1(x) / x)^2 = \tfrac12, \quad x = 1.6163...

    `radius` [m]; `frequency` [Hz]; `speed_of_sound` [m/s]. Returns the full width [rad], pi if the
    power exceeds half within 90 degrees of the axis. Raises InputError if a radius is not a
    positive number.

    Bradley & Abaid, Sec. II-A and Appendix B.

    >>> radius = np.array([0.0025, 0.0088])
    >>> np.degrees(beamwidth(radius, frequency=35e3, speed_of_sound=343.0)).round(1)
    array([180. ,  33.3])
    """
    if not np.all((np.asarray(radius) > 0) & np.isfinite(radius)):
        raise InputError(f"radius: found {radius}, expected metres above 0; give a piston a size")
    k = 2.0 * np.pi * frequency / speed_of_sound
    return np.asarray(2.0 * np.arcsin(np.minimum(HALF_POWER / (k * np.asarray(radius)), 1.0)))


def beamwidth_of(config: Config) -> float:
    """Return the half-power beamwidth of the vehicle's piston in the settings [rad].

    >>> round(float(np.degrees(beamwidth_of(Config()))), 1)
    33.3
    """
    call = {"frequency": config.emitter.centre, "speed_of_sound": config.medium.sound_speed}
    return float(beamwidth(config.emitter.radius, **call))


def piston_radius(
    beamwidth: Float[np.ndarray, "*n"] | float, *, frequency: float, speed_of_sound: float
) -> Float[np.ndarray, "*n"]:
    r"""Return the radius [m] of the piston that has a given half-power beamwidth [rad].

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """Scattering law of a body's shape: intensity by angle, and growth with the radius."""

    intensity: Callable[
        [Float[np.ndarray, "*n"] | float, float | Float[np.ndarray, " m"]], Float[np.ndarray, "*n"]
    ]
    """Scattered intensity relative to backscatter, I(angle) / I(pi), by the turn of the sound
    [rad] and kr, the wavenumber times the radius."""
    growth: float
    """Backscatter is proportional to this power of the radius."""


def _cylinder(
    angle: Float[np.ndarray, "*n"] | float, kr: float | Float[np.ndarray, " m"]
) -> Float[np.ndarray, "*n"]:
    """Return the intensity that a cylinder scatters, relative to backscatter, by angle; Eq. (4)."""
    lit = np.abs(np.sin(np.asarray(angle) / 2.0))
    shadow = 1.0 - lit**2  # cos^2 of half the angle
    return lit + 4.0 * kr / np.pi * (shadow * np.sinc(kr * np.sin(angle) / np.pi)) ** 2


def _sphere(
    angle: Float[np.ndarray, "*n"] | float, kr: float | Float[np.ndarray, " m"]
) -> Float[np.ndarray, "*n"]:
    """Return the intensity that a sphere scatters, relative to backscatter, by angle."""
    shadow = 1.0 - np.abs(np.sin(np.asarray(angle) / 2.0)) ** 2
    return 1.0 + (kr * shadow * jinc(kr * np.sin(angle))) ** 2


SHAPES = {
    "cylinder": Shape(intensity=_cylinder, growth=1.0),
    "sphere": Shape(intensity=_sphere, growth=2.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Bodies:
    """Radius and shape of each reflecting body."""

    radius: Float[np.ndarray, " n"]
    """[m]; NaN if not stated: the settings' target, at a point."""
    shape: Shaped[np.ndarray, " n"]
    """Name of its shape in `SHAPES`."""


def target_strength_db(
    angle: Float[np.ndarray, "*n"] | float,
    *,
    radius: float | Float[np.ndarray, " m"],
    frequency: float,
    shape: str,
    speed_of_sound: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the intensity that a body scatters at an angle [rad], relative to backscatter [dB].

    .. math:: I_\text{cylinder}(\gamma) &= \frac r2 \sin\frac\gamma2
              + \frac1{2\pi k} \cot^2\frac\gamma2 \, \sin^2(kr\sin\gamma) \\
              I_\text{sphere}(\gamma) &= \frac{r^2}4 \left[ 1
              + \cot^2\frac\gamma2 \, J_1^2(kr\sin\gamma) \right]
       :label: eq-4

    Written with :math:`\cot(\gamma/2) = 2\cos^2(\gamma/2) / \sin\gamma` they are finite everywhere:
    in the forward direction :math:`I(0)/I(\pi)` is :math:`4kr/\pi` and :math:`1 + (kr)^2`.

    `angle` [rad]: turn of the sound, pi is back to the source, 0 straight on; `radius` [m]: one, or
    one for each entry of the last axis of `angle`; `frequency` [Hz]; `shape`: in `SHAPES`. Returns
    [dB]: 0 at pi; even, and of period 2 pi, in the angle. Raises InputError for an unknown shape.

    Bradley & Abaid, Eq. (4), which is the cylinder with two misprints: as printed (a sine of the
    full angle, a sine not squared) I(pi) is 0 and I becomes negative. Source: Morse, Vibration and
    Sound, scattering from cylinders and spheres at short wavelengths.

    >>> tin = dict(radius=0.025, frequency=30e3, shape="cylinder", speed_of_sound=343.0)
    >>> target_strength_db(np.radians([180.0, 90.0, 0.0]), **tin).round(2)
    array([ 0.  , -1.39, 12.43])
    """
    kr = 2.0 * np.pi * frequency / speed_of_sound * radius
    return np.asarray(10.0 * np.log10(shape_of(shape).intensity(angle, kr)))


def shape_of(name: str) -> Shape:
    """Return the scattering law of a named shape, such as "cylinder"; raise if it is unknown."""
    if name not in SHAPES:
        expected = " or ".join(map(repr, SHAPES))
        raise InputError(f"target.shape: found {name!r}, expected {expected}; choose")
    return SHAPES[name]


def strength_of_bodies_db(
    angle: Float[np.ndarray, "*k n"],
    bodies: Bodies,
    *,
    usual: TargetConfig,
    frequency: float,
    speed_of_sound: float,
) -> Float[np.ndarray, "*k n"]:
    r"""Return the intensity that bodies scatter [dB], relative to backscatter at the usual radius.

    Backscatter grows with the radius as :math:`I(\pi) = r / 2` for a cylinder and :math:`r^2 / 4`
    for a sphere, so a body of radius r has :math:`10 \log_{10} (r / r_0)` or :math:`20 \log_{10} (r
    / r_0)` more than one of its shape with the usual radius :math:`r_0`, to which the source levels
    refer.

    `angle` [rad]: turn of the sound; `frequency` [Hz]; `speed_of_sound` [m/s]. Returns [dB].

    Bradley & Abaid, Eq. (4), for the relative part. See `target_strength_db`.

    >>> shapes = np.array(["cylinder", "cylinder", "sphere"])
    >>> posts = Bodies(radius=np.array([0.025, 0.25, 0.25]), shape=shapes)
    >>> heard = dict(usual=TargetConfig(), frequency=30e3, speed_of_sound=343.0)
    >>> strength_of_bodies_db(np.full((1, 3), np.pi), posts, **heard)
    array([[ 0., 10., 20.]])
    """
    of = {
        "radius": _radius(bodies, usual),
        "frequency": frequency,
        "speed_of_sound": speed_of_sound,
    }
    relative = np.empty(np.shape(angle))
    for name in np.unique(bodies.shape).tolist():
        of_shape = bodies.shape == name
        relative[..., of_shape] = target_strength_db(angle, shape=name, **of)[..., of_shape]
    return relative + backscatter_db(bodies, usual)


def backscatter_db(bodies: Bodies, usual: TargetConfig) -> Float[np.ndarray, " n"]:
    """Return each body's backscatter [dB], relative to its shape with the settings' radius."""
    growth = np.array([shape_of(name).growth for name in bodies.shape.tolist()])
    return 10.0 * growth * np.log10(_radius(bodies, usual) / usual.radius)


def _radius(bodies: Bodies, usual: TargetConfig) -> Float[np.ndarray, " n"]:
    """Return each body's radius [m], or the settings' radius if it is not stated."""
    return np.where(np.isnan(bodies.radius), usual.radius, bodies.radius)


def with_usual(bodies: Bodies, count: int, usual: TargetConfig) -> Bodies:
    """Append a number of point bodies with the settings' shape to the given bodies."""
    return Bodies(
        radius=np.append(bodies.radius, np.full(count, np.nan)),
        shape=np.append(bodies.shape, np.full(count, usual.shape)),
    )
