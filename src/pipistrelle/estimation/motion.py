r"""Motion models with their Jacobians: bicycle, unicycle, car and relative poses.

The *controls* of a step are two numbers for bicycle, unicycle and car. For *poses*, as odometry
reports them, they are the motion since the previous pose in its axes, forward, sideways and turn,

.. math:: (x, y)_k = (x, y)_{k-1} + R(\theta_{k-1}) \, (d_x, d_y), \quad
          \theta_k = \theta_{k-1} + d_\theta

followed by the six numbers of its covariance, if recorded. Kernels return scalars, so that
estimators can inline them; public functions return arrays. In kernels a motion model is its index
in `MOTION_MODELS`.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.config import LARGEST, InputError
from pipistrelle.geometry import wrap, wrap_angle
from pipistrelle.jit import kernel, no_alloc

MOTION_MODELS = ("bicycle", "unicycle", "poses", "ackermann")
BY_POSES = MOTION_MODELS.index("poses")
ACKERMANN = MOTION_MODELS.index("ackermann")
MOVED = 3
"""Size of a relative motion; its covariance follows: xx, xy, xh, yy, yh, hh."""
SMALLEST_STD = 1e-6
"""Standard deviation [m, rad] added in quadrature to an exact start, a step without noise and the
pose of particles; in the smoother also the least standard deviation of a measurement."""
Pose = Float[np.ndarray, "3"]
"""x, y [m] and heading [rad]."""
PoseCovariance = Float[np.ndarray, "3 3"]
Controls = Float[np.ndarray, "k c"]
"""Control steps, a row each (`Motion.model`)."""
Durations = Float[np.ndarray, " k"]
"""Durations of control steps [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A motion model (bicycle, unicycle, poses or car) and the noise of its controls."""

    model: Literal["bicycle", "unicycle", "poses", "ackermann"]
    """Motion model by name. Controls are speed [m/s] and steering angle [rad] for a bicycle (pose:
    front wheel) or a car (Ackermann; pose: middle of the rear axle); speed [m/s] and angular
    rate [rad/s] for a unicycle; for poses the motion since the previous pose: forward, sideways
    (left) [m] and turn [rad], optionally with its covariance xx, xy, xh, yy, yh, hh (x forward,
    h turn; NaN: unknown)."""
    control_std: tuple[float, ...]
    """Standard deviation of each control in a step; for poses, of motions without covariance."""
    wheelbase: float = 1.0
    """Wheelbase of a bicycle or a car [m]."""
    speed_offset: float = 0.0
    """Lateral offset of a car's speed sensor to the left of the middle of the rear axle [m]."""
    noise_at_rest: bool = True
    """Whether a step without motion is noisy, not exact."""

    def __post_init__(self) -> None:
        """Raise InputError for an unknown model, a bad wheelbase or noise of the wrong size."""
        if self.model not in MOTION_MODELS:
            known = ", ".join(MOTION_MODELS)
            raise InputError(f"motion: found the model {self.model!r}, expected one of {known}")
        wanted = MOVED if self.model == "poses" else 2
        stds = np.asarray(self.control_std)
        sound = stds.shape == (wanted,) and stds.dtype.kind in "fiu"
        if not (sound and np.all((stds >= 0.0) & (stds <= LARGEST))):
            raise InputError(
                f"motion: found control_std {self.control_std!r}, expected {wanted} numbers from 0 "
                f"to {LARGEST:g} for a {self.model} model"
            )
        if not 0.0 < self.wheelbase <= LARGEST:
            raise InputError(f"motion: found wheelbase {self.wheelbase!r}, expected one above 0 m")
        if not abs(self.speed_offset) <= 0.5 * self.wheelbase:
            raise InputError(
                f"motion: found speed_offset {self.speed_offset!r} beside wheelbase "
                f"{self.wheelbase!r}, expected half of it at most"
            )
        object.__setattr__(self, "control_std", tuple(stds.tolist()))


class MotionNumbers(NamedTuple):
    """A motion model as plain numbers for compiled functions, with variances of a control step."""

    model: int
    wheelbase: float
    speed_variance: float
    sideways_variance: float
    turn_variance: float
    noise_at_rest: bool
    speed_offset: float


@lru_cache(maxsize=16)
def motion_numbers(motion: Motion) -> MotionNumbers:
    """Convert a motion model to plain numbers for compiled functions."""
    return MotionNumbers(
        model=MOTION_MODELS.index(motion.model),
        wheelbase=float(motion.wheelbase),
        speed_variance=float(motion.control_std[0]) ** 2,
        sideways_variance=float(motion.control_std[1]) ** 2 if motion.model == "poses" else 0.0,
        turn_variance=float(motion.control_std[-1]) ** 2,
        noise_at_rest=motion.noise_at_rest,
        speed_offset=float(motion.speed_offset),
    )


@no_alloc
def motion_increment(
    motion: MotionNumbers, heading: float, control: Float[np.ndarray, " c"], dt: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return a vehicle's motion in a noise-free control step, and its derivatives by the control.

    Returns dx, dy, dheading, then the Jacobian U by speed (x, y, heading) and by turn (x, y,
    heading). The derivatives of x and y by heading are -dy and dx. For poses, the column by the
    sideways motion, the first rotated by 90 degrees, is omitted.
    """
    if motion.model == BY_POSES:
        c, s = math.cos(heading), math.sin(heading)
        ahead, aside = control[0], control[1]
        return (
            c * ahead - s * aside, s * ahead + c * aside, control[2],
            c, s, 0.0,
            0.0, 0.0, 1.0,
        )  # fmt: skip
    speed, turn = control[0], control[1]
    if motion.model == 0:
        c, s = math.cos(heading + turn), math.sin(heading + turn)
        dx, dy = speed * dt * c, speed * dt * s
        yaw = dt / motion.wheelbase
        return (
            dx, dy, speed * yaw * math.sin(turn),
            dt * c, dt * s, yaw * math.sin(turn),
            -dy, dx, speed * yaw * math.cos(turn),
        )  # fmt: skip
    if motion.model == ACKERMANN:
        return _car_increment(motion, heading, control, dt)
    return _arc(heading, speed, turn, dt)


@no_alloc
def _arc(
    heading: float, speed: float, turn: float, dt: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the motion along a circular arc at a speed and turn rate, and its derivatives."""
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
def _car_increment(
    motion: MotionNumbers, heading: float, control: Float[np.ndarray, " c"], dt: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return a car's motion (Ackermann steering) in a control step, and its derivatives."""
    bend = math.tan(control[1]) / motion.wheelbase
    share = 1.0 / (1.0 - motion.speed_offset * bend)
    speed = control[0] * share
    dx, dy, turn, xs, ys, _, xr, yr, _ = _arc(heading, speed, speed * bend, dt)
    steer = (1.0 + (motion.wheelbase * bend) ** 2) / motion.wheelbase
    by_steering = speed * motion.speed_offset * share * steer
    rate_by_steering = speed * share * steer
    return (
        dx, dy, turn,
        share * (xs + bend * xr), share * (ys + bend * yr), share * bend * dt,
        by_steering * xs + rate_by_steering * xr, by_steering * ys + rate_by_steering * yr,
        rate_by_steering * dt,
    )  # fmt: skip


@no_alloc
def relative_noise(
    control: Float[np.ndarray, " c"], motion: MotionNumbers
) -> tuple[float, float, float, float, float, float]:
    """Return the covariance of a step's motion in the vehicle's axes: xx, xy, xh, yy, yh, hh."""
    moves = control[0] != 0.0 or control[1] != 0.0 or control[2] != 0.0
    if not (motion.noise_at_rest or moves):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if control.size > MOVED and not math.isnan(control[MOVED]):
        return (
            control[MOVED], control[MOVED + 1], control[MOVED + 2],
            control[MOVED + 3], control[MOVED + 4], control[MOVED + 5],
        )  # fmt: skip
    return motion.speed_variance, 0.0, 0.0, motion.sideways_variance, 0.0, motion.turn_variance


@no_alloc
def propagate_pose(
    pose: Pose,
    P: PoseCovariance,
    control: Float[np.ndarray, " c"],
    dt: float,
    motion: MotionNumbers,
) -> tuple[float, float]:
    """Predict a pose (3) and its covariance (3, 3) through a control step, in place.

    F P F^T + U Q U^T (Bradley & Abaid, Eq. (10)); Q has rank 2, for poses 3. Returns dx and dy [m].
    """
    dx, dy, dheading, u00, u10, u20, u01, u11, u21 = motion_increment(motion, pose[2], control, dt)
    pose[0] += dx
    pose[1] += dy
    pose[2] = wrap_angle(pose[2] + dheading)
    xx = P[0, 0] - 2.0 * dy * P[0, 2] + dy * dy * P[2, 2]
    xy = P[0, 1] + dx * P[0, 2] - dy * P[1, 2] - dx * dy * P[2, 2]
    yy = P[1, 1] + 2.0 * dx * P[1, 2] + dx * dx * P[2, 2]
    xh = P[0, 2] - dy * P[2, 2]
    yh = P[1, 2] + dx * P[2, 2]
    if motion.model == BY_POSES:
        c, s, noise = u00, u10, relative_noise(control, motion)
        P[0, 0] = xx + c * c * noise[0] - 2.0 * c * s * noise[1] + s * s * noise[3]
        P[0, 1] = P[1, 0] = xy + c * s * (noise[0] - noise[3]) + (c * c - s * s) * noise[1]
        P[1, 1] = yy + s * s * noise[0] + 2.0 * c * s * noise[1] + c * c * noise[3]
        P[0, 2] = P[2, 0] = xh + c * noise[2] - s * noise[4]
        P[1, 2] = P[2, 1] = yh + s * noise[2] + c * noise[4]
        P[2, 2] += noise[5]
        return dx, dy
    noisy = 1.0 if motion.noise_at_rest or control[0] != 0.0 or control[1] != 0.0 else 0.0
    q0, q1 = noisy * motion.speed_variance, noisy * motion.turn_variance
    P[0, 0] = xx + q0 * u00 * u00 + q1 * u01 * u01
    P[0, 1] = P[1, 0] = xy + q0 * u00 * u10 + q1 * u01 * u11
    P[1, 1] = yy + q0 * u10 * u10 + q1 * u11 * u11
    P[0, 2] = P[2, 0] = xh + q0 * u00 * u20 + q1 * u01 * u21
    P[1, 2] = P[2, 1] = yh + q0 * u10 * u20 + q1 * u11 * u21
    P[2, 2] += q0 * u20 * u20 + q1 * u21 * u21
    return dx, dy


def motion_step(motion: Motion, pose: Pose, control: Float[np.ndarray, " c"], dt: float) -> Pose:
    r"""Return the pose after a noise-free control step (Bradley & Abaid, Eq. (5)).

    .. math:: x_k = x_{k-1} + V\Delta_t \cos(\theta_{k-1} + \gamma), \quad
              y_k = y_{k-1} + V\Delta_t \sin(\theta_{k-1} + \gamma), \quad
              \theta_k = \theta_{k-1} + \tfrac{V\Delta_t}{B}\sin\gamma
       :label: eq-5

    for the bicycle's front wheel; for the unicycle the exact arc of speed V and angular rate omega,
    with the chord :math:`V\Delta_t \operatorname{sinc}(\omega\Delta_t/2)`; for poses the given
    motion. The middle of a car's rear axle follows the arc of the speed :math:`V / (1 - h
    \tan(\gamma) / B)` and the rate :math:`\tan(\gamma) / B` times this speed, if V is measured h to
    the left of it. ``pose`` is (3) [m, m, rad], ``control`` (c) of the model (`Motion.model`),
    ``dt`` in s; returns (3) [m, m, rad], with the heading wrapped.

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> motion_step(motion, np.zeros(3), np.array([np.pi, np.pi]), 0.5).round(12)
    array([1.        , 1.        , 1.57079633])
    """
    moved = _increment(motion, pose, control, dt)
    return np.array([pose[0] + moved[0], pose[1] + moved[1], wrap_angle(pose[2] + moved[2])])


def relative_motions(
    motion: Motion, controls: Controls, dt: Durations
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Return each control step's motion relative to the previous pose, and its covariance.

    ``controls`` (k, c) as in `Motion.model`, ``dt`` (k) [s]; returns (k, 3) [m, m, rad] and (k, 3,
    3).

    >>> motion = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> way, covariance = relative_motions(motion, np.array([[2.0, 0.0]]), np.array([0.5]))
    >>> way, covariance[0].diagonal().round(4)
    (array([[1., 0., 0.]]), array([0.0025, 0.0006, 0.0025]))
    """
    numbers = motion_numbers(motion)
    return _relative_motions(np.ascontiguousarray(controls, dtype=float), dt, numbers)


@kernel
def _relative_motions(
    controls: Controls, dt: Durations, motion: MotionNumbers
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Return each control step's motion and covariance, relative to the pose before the step."""
    ways, covariances = np.zeros((dt.size, 3)), np.zeros((dt.size, 3, 3))
    for k in range(dt.size):
        propagate_pose(ways[k], covariances[k], controls[k], dt[k], motion)
    return ways, covariances


def controls_between(
    path: Float[np.ndarray, "t 3"], dt: float | Float[np.ndarray, " t-1"], motion: Motion
) -> Float[np.ndarray, "t-1 2"]:
    r"""Return the controls that lead from each pose to the next, as far as the model permits.

    A unicycle's arc has the turn of the heading, and a bicycle's front wheel the steering angle
    :math:`\sin\gamma = B \Delta\theta / (V \Delta_t)`; the speed is along the arc's chord or the
    wheel's path. Sideways motion is lost. ``path`` (k + 1, 3) [m, m, rad], ``dt`` [s].

    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> there = motion_step(motion, np.zeros(3), np.array([0.75, 0.1]), 0.125)
    >>> controls_between(np.array([np.zeros(3), there]), 0.125, motion).round(9)
    array([[0.75, 0.1 ]])
    """
    moved, turned = np.diff(path[:, :2], axis=0), wrap(np.diff(path[:, 2]))
    if motion.model == "unicycle":
        ahead = path[:-1, 2] + 0.5 * turned
        along = moved[:, 0] * np.cos(ahead) + moved[:, 1] * np.sin(ahead)
        return np.column_stack((along / dt / np.sinc(turned / (2.0 * np.pi)), turned / dt))
    way = np.hypot(*moved.T)
    forwards = moved[:, 0] * np.cos(path[:-1, 2]) + moved[:, 1] * np.sin(path[:-1, 2]) >= 0.0
    way = np.where(forwards, way, -way)
    sine = np.divide(motion.wheelbase * turned, way, out=np.zeros_like(way), where=way != 0.0)
    return np.column_stack((way / dt, np.arcsin(np.clip(sine, -1.0, 1.0))))


def motion_jacobians(
    motion: Motion, pose: Pose, control: Float[np.ndarray, " c"], dt: float
) -> tuple[PoseCovariance, Float[np.ndarray, "3 n"]]:
    """Return the derivatives of a control step's pose by the pose before, F, and by control, U.

    Arguments as in `motion_step`; F is (3, 3) and U (3, 2), for poses (3, 3). Source: Bradley &
    Abaid, with Eq. (10).

    >>> motion = Motion(model="bicycle", control_std=(0.1, 0.03), wheelbase=0.2)
    >>> F, U = motion_jacobians(motion, np.zeros(3), np.array([2.0, 0.0]), 0.5)
    >>> F[1, 2], U[2, 1]
    (np.float64(1.0), np.float64(5.0))
    """
    moved = _increment(motion, pose, control, dt)
    F = np.eye(3)
    F[0, 2], F[1, 2] = -moved[1], moved[0]
    columns = [moved[3:6], moved[6:]]
    if motion.model == "poses":
        columns.insert(1, (-moved[4], moved[3], 0.0))
    return F, np.array(columns).T.copy()


def motion_noise(motion: Motion, control: Float[np.ndarray, " c"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of a control step's noise: 2 x 2, or 3 x 3 for the model of poses.

    ``control`` (c) may contain the covariance of a relative pose. Q is zero at rest if that is
    exact. Source: Bradley & Abaid, with Eq. (10).

    >>> motion_noise(Motion(model="poses", control_std=(0.5, 0.25, 0.125)), np.ones(3)).diagonal()
    array([0.25    , 0.0625  , 0.015625])
    """
    if motion.model == "poses":
        numbers = relative_noise(np.asarray(control, dtype=float), motion_numbers(motion))
        xx, xy, xh, yy, yh, hh = numbers
        return np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    exact = not motion.noise_at_rest and not np.any(control)
    return np.diag(np.square(motion.control_std)) * (0.0 if exact else 1.0)


def _increment(
    motion: Motion, pose: Pose, control: Float[np.ndarray, " c"], dt: float
) -> tuple[float, ...]:
    """Return motion and derivatives of a control step by `motion_increment`, from a `Motion`."""
    numbers = motion_numbers(motion)
    control = np.asarray(control, dtype=float)
    return motion_increment(numbers, pose[2], control, dt)
