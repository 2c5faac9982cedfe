"""What a landmark throws in each direction, relative to what it throws back.

`SHAPES` lists the shapes by name; another one is another `Shape` in it. The two here are Morse's
short-wave limit of a rigid body: sound that mirrors off the lit side, and around the forward
direction the shadow, which radiates as the body's outline would. Interference of the two is left
out, so the formulae are near the exact series (0.1 to 0.9 dB) at 90 to 180 degrees and a smooth
version of it nearer to the forward direction.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from pipistrelle.acoustics.emitter import jinc
from pipistrelle.config import InputError, TargetConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """How bodies of a shape scatter sound."""

    intensity: Callable[
        [Float[np.ndarray, "*n"] | float, float | Float[np.ndarray, " m"]], Float[np.ndarray, "*n"]
    ]
    """Scattered intensity relative to backscatter, I(angle) / I(pi), by the angle [rad] by which
    the sound is turned and by kr, the wavenumber times the radius."""
    growth: float
    """Backscatter grows with the radius to this power."""


def _cylinder(
    angle: Float[np.ndarray, "*n"] | float, kr: float | Float[np.ndarray, " m"]
) -> Float[np.ndarray, "*n"]:
    """Return the intensity of a cylinder, Eq. (4)."""
    lit = np.abs(np.sin(np.asarray(angle) / 2.0))
    shadow = 1.0 - lit**2  # cos^2 of half the angle
    return lit + 4.0 * kr / np.pi * (shadow * np.sinc(kr * np.sin(angle) / np.pi)) ** 2


def _sphere(
    angle: Float[np.ndarray, "*n"] | float, kr: float | Float[np.ndarray, " m"]
) -> Float[np.ndarray, "*n"]:
    """Return the intensity of a sphere."""
    shadow = 1.0 - np.abs(np.sin(np.asarray(angle) / 2.0)) ** 2
    return 1.0 + (kr * shadow * jinc(kr * np.sin(angle))) ** 2


SHAPES = {
    "cylinder": Shape(intensity=_cylinder, growth=1.0),
    "sphere": Shape(intensity=_sphere, growth=2.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Bodies:
    """Sizes and shapes of things that reflect, each its own."""

    radius: Float[np.ndarray, " n"]
    """NaN of a body whose size is not stated: it has the usual target's, and counts as a point
    [m]."""
    shape: Shaped[np.ndarray, " n"]
    """Name of each one's shape, of `SHAPES`."""


def target_strength_db(
    angle: Float[np.ndarray, "*n"] | float,
    *,
    radius: float | Float[np.ndarray, " m"],
    frequency: float,
    shape: str,
    speed_of_sound: float,
) -> Float[np.ndarray, "*n"]:
    r"""Return the scattered intensity relative to backscatter: 10 log10(I(angle) / I(pi)).

    .. math:: I_\text{cylinder}(\gamma) &= \frac r2 \sin\frac\gamma2
              + \frac1{2\pi k} \cot^2\frac\gamma2 \, \sin^2(kr\sin\gamma) \\
              I_\text{sphere}(\gamma) &= \frac{r^2}4 \left[ 1
              + \cot^2\frac\gamma2 \, J_1^2(kr\sin\gamma) \right]
       :label: eq-4

    Written with :math:`\cot(\gamma/2) = 2\cos^2(\gamma/2) / \sin\gamma` they are finite everywhere:
    in the forward direction :math:`I(0)/I(\pi)` is :math:`4kr/\pi` and :math:`1 + (kr)^2`.

    Parameters
    ----------
    angle : (*n) [rad]
        By how much the sound is turned: pi is back to where it came from, 0 straight on.
    radius : [m]
        Or one for each of the last axis of the angles.
    frequency : [Hz]
    shape : str
        Of `SHAPES`.
    speed_of_sound : [m/s]

    Returns
    -------
    (*n) [dB]
        0 at pi; even, and of period 2 pi, in the angle.

    Raises
    ------
    InputError
        An unknown shape.

    Notes
    -----
    Bradley & Abaid, Eq. (4), which is the cylinder with two misprints: as printed (a sine of the
    full angle, a sine not squared) I(pi) is 0 and I goes negative. Source: Morse, Vibration and
    Sound, scattering from cylinders and spheres at short wavelengths.

    Examples
    --------
    >>> tin = dict(radius=0.025, frequency=30e3, shape="cylinder", speed_of_sound=343.0)
    >>> target_strength_db(np.radians([180.0, 90.0, 0.0]), **tin).round(2)
    array([ 0.  , -1.39, 12.43])
    """
    kr = 2.0 * np.pi * frequency / speed_of_sound * radius
    return np.asarray(10.0 * np.log10(shape_of(shape).intensity(angle, kr)))


def shape_of(name: str) -> Shape:
    """Return the shape of a name; refuse one that is not there."""
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
    r"""Return the scattered intensity relative to backscatter of the usual target.

    Backscatter grows with the radius as :math:`I(\pi) = r / 2` of a cylinder and :math:`r^2 / 4` of
    a sphere, so a body of radius r throws back :math:`10 \log_{10} (r / r_0)` or :math:`20
    \log_{10} (r / r_0)` more than one of its shape with the usual radius :math:`r_0`, for which the
    source levels stand.

    `angle` [rad]: by how much the sound is turned; `frequency` [Hz]; `speed_of_sound` [m/s].
    Returns [dB].

    Bradley & Abaid, Eq. (4), of which only the relative part is theirs. See `target_strength_db`.

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
    """Return how much more bodies throw back than one of their shape with the usual radius.

    Returns [dB]: as `strength_of_bodies_db` at an angle of pi.
    """
    growth = np.array([shape_of(name).growth for name in bodies.shape.tolist()])
    return 10.0 * growth * np.log10(_radius(bodies, usual) / usual.radius)


def _radius(bodies: Bodies, usual: TargetConfig) -> Float[np.ndarray, " n"]:
    """Return the bodies' radii, the usual target's where none is stated [m]."""
    return np.where(np.isnan(bodies.radius), usual.radius, bodies.radius)


def with_usual(bodies: Bodies, count: int, usual: TargetConfig) -> Bodies:
    """Append point bodies of the settings' shape.

    The given bodies come first.
    """
    return Bodies(
        radius=np.append(bodies.radius, np.full(count, np.nan)),
        shape=np.append(bodies.shape, np.full(count, usual.shape)),
    )
