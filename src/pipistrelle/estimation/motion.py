"""Motion models with their Jacobians.

The kernels return plain numbers, so that the filters can inline them; the functions beside them
say the same in arrays. In the kernels a motion model is a number: 0 bicycle, 1 unicycle.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import Whole, kernel, no_alloc

MOTION_MODELS = ("bicycle", "unicycle")


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A motion model and the noise of its controls.

    Attributes
    ----------
    model : "bicycle" or "unicycle"
        Controls are speed [m/s] and steering angle [rad], or speed [m/s] and angular rate [rad/s].
    control_std : (speed [m/s], steering [rad] or angular rate [rad/s])
        Noise of one control step.
    wheelbase : [m]
        Bicycle only.
    noise_at_rest : bool
        False: a step whose two controls are zero is exact.
    """

    model: Literal["bicycle", "unicycle"]
    control_std: tuple[float, float]
    wheelbase: float = 1.0
    noise_at_rest: bool = True


class MotionNumbers(NamedTuple):
    """A motion model as the kernels take it; variances are those of one control step."""

    model: int
    wheelbase: float
    speed_variance: float
    turn_variance: float
    noise_at_rest: bool


@lru_cache(maxsize=16)
def motion_numbers(motion: Motion) -> MotionNumbers:
    """Turn a motion model into numbers for the kernels, once.

    Parameters
    ----------
    motion : Motion

    Returns
    -------
    MotionNumbers

    Examples
    --------
    >>> numbers = motion_numbers(Motion(model="unicycle", control_std=(0.5, 0.25)))
    >>> numbers.model, numbers.speed_variance, numbers.turn_variance
    (1, 0.25, 0.0625)
    """
    return MotionNumbers(
        model=MOTION_MODELS.index(motion.model),
        wheelbase=float(motion.wheelbase),
        speed_variance=float(motion.control_std[0]) ** 2,
        turn_variance=float(motion.control_std[1]) ** 2,
        noise_at_rest=motion.noise_at_rest,
    )


@kernel
def motion_increment(
    model: Whole, wheelbase: float, heading: float, speed: float, turn: float, dt: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """One noise-free control step, for kernels.

    Returns dx, dy, dheading; dx/dheading, dy/dheading are -dy, dx; then the six entries of the
    Jacobian U by speed (x, y, heading) and by turn (x, y, heading).
    """
    if model == 0:
        c, s = math.cos(heading + turn), math.sin(heading + turn)
        dx, dy = speed * dt * c, speed * dt * s
        yaw = dt / wheelbase
        return (
            dx, dy, speed * yaw * math.sin(turn),
            dt * c, dt * s, yaw * math.sin(turn),
            -dy, dx, speed * yaw * math.cos(turn),
        )  # fmt: skip
    half = 0.5 * turn * dt
    if abs(half) < 1e-4:
        sinc, slope = 1.0 - half * half / 6.0, -half / 3.0
    else:
        sinc = math.sin(half) / half
        slope = (math.cos(half) - sinc) / half
    c, s = math.cos(heading + half), math.sin(heading + half)
    chord = dt * sinc
    dx, dy = speed * chord * c, speed * chord * s
    bend = 0.5 * dt * dt * speed
    return (
        dx, dy, turn * dt,
        chord * c, chord * s, 0.0,
        bend * (slope * c - sinc * s), bend * (slope * s + sinc * c), dt,
    )  # fmt: skip


@no_alloc
def propagate_pose(
    pose: Float[np.ndarray, "3"],
    P: Float[np.ndarray, "3 3"],
    speed: float,
    turn: float,
    dt: float,
    motion: MotionNumbers,
) -> tuple[float, float]:
    """Carry a pose (3) and its covariance (3, 3) through a control step, in place.

    F P F^T + U Q U^T (Bradley & Abaid, Eq. (10)); Q alone has rank 2. Returns dx and dy [m].
    """
    dx, dy, dheading, u00, u10, u20, u01, u11, u21 = motion_increment(
        motion.model, motion.wheelbase, pose[2], speed, turn, dt
    )
    pose[0] += dx
    pose[1] += dy
    pose[2] = wrap_angle(pose[2] + dheading)
    noisy = 1.0 if motion.noise_at_rest or speed != 0.0 or turn != 0.0 else 0.0
    q0, q1 = noisy * motion.speed_variance, noisy * motion.turn_variance
    xx = P[0, 0] - 2.0 * dy * P[0, 2] + dy * dy * P[2, 2]
    xy = P[0, 1] + dx * P[0, 2] - dy * P[1, 2] - dx * dy * P[2, 2]
    yy = P[1, 1] + 2.0 * dx * P[1, 2] + dx * dx * P[2, 2]
    xh = P[0, 2] - dy * P[2, 2]
    yh = P[1, 2] + dx * P[2, 2]
    P[0, 0] = xx + q0 * u00 * u00 + q1 * u01 * u01
    P[0, 1] = P[1, 0] = xy + q0 * u00 * u10 + q1 * u01 * u11
    P[1, 1] = yy + q0 * u10 * u10 + q1 * u11 * u11
    P[0, 2] = P[2, 0] = xh + q0 * u00 * u20 + q1 * u01 * u21
    P[1, 2] = P[2, 1] = yh + q0 * u10 * u20 + q1 * u11 * u21
    P[2, 2] += q0 * u20 * u20 + q1 * u21 * u21
    return dx, dy


def motion_step(
    motion: Motion, pose: Float[np.ndarray, "3"], control: Float[np.ndarray, "2"], dt: float
) -> Float[np.ndarray, "3"]:
    r"""The pose after one noise-free control step.

    .. math:: x_k = x_{k-1} + V\Delta_t \cos(\theta_{k-1} + \gamma), \quad
              y_k = y_{k-1} + V\Delta_t \sin(\theta_{k-1} + \gamma), \quad
              \theta_k = \theta_{k-1} + \tfrac{V\Delta_t}{B}\sin\gamma
       :label: eq-5

    for the bicycle's front wheel; for the unicycle the exact arc of speed V and angular rate
    omega, written by its chord :math:`V\Delta_t \operatorname{sinc}(\omega\Delta_t/2)`.

    Parameters
    ----------
    motion : Motion
    pose : (3) [m, m, rad]
    control : (2) [m/s, rad or rad/s]
    dt : [s]

    Returns
    -------
    (3) [m, m, rad]
        Heading wrapped.

    Notes
    -----
    Bradley & Abaid, Eq. (5).

    Examples
    --------
    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> motion_step(motion, np.zeros(3), np.array([np.pi, np.pi]), 0.5).round(12)
    array([1.        , 1.        , 1.57079633])
    """
    numbers = motion_numbers(motion)
    moved = motion_increment(numbers.model, numbers.wheelbase, pose[2], control[0], control[1], dt)
    return np.array([pose[0] + moved[0], pose[1] + moved[1], wrap_angle(pose[2] + moved[2])])


def motion_jacobians(
    motion: Motion, pose: Float[np.ndarray, "3"], control: Float[np.ndarray, "2"], dt: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 2"]]:
    """Derivatives F and U of `motion_step` by the pose and by the control.

    Parameters
    ----------
    motion : Motion
    pose : (3) [m, m, rad]
    control : (2) [m/s, rad or rad/s]
    dt : [s]

    Returns
    -------
    F : (3, 3)
    U : (3, 2)

    Notes
    -----
    Bradley & Abaid, with Eq. (10).

    Examples
    --------
    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> F, U = motion_jacobians(motion, np.zeros(3), np.array([2.0, 0.0]), 0.5)
    >>> F[1, 2], U[2, 1]
    (np.float64(1.0), np.float64(5.0))
    """
    numbers = motion_numbers(motion)
    moved = motion_increment(numbers.model, numbers.wheelbase, pose[2], control[0], control[1], dt)
    F = np.eye(3)
    F[0, 2], F[1, 2] = -moved[1], moved[0]
    return F, np.array(moved[3:]).reshape(2, 3).T.copy()
