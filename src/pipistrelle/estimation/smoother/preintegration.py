r"""Preintegration of control steps between nodes, and calibration parameters of vehicle and sensor.

**Preintegration.** The chain has a node for each scan, not for each control step, as a step's noise
has rank 2 and nothing measures the poses between. `Odometry` keeps these relative to the node
before: means :math:`d_j` and covariances :math:`P_j` of x, y and heading in its axes. Smoothed
poses a and b of the two nodes update them by the gain

.. math:: G_j = P_j \Phi_{mj}^T P_m^{-1}, \quad d_j \leftarrow d_j + G_j (a^{-1} b - d_m)

with :math:`\Phi_{mj}` the derivative of the last step by step j (Rauch, Tung & Striebel 1965).

**Calibration.** Each parameter is constant over the mission, with a normal prior about its assumed
value. Odometry parameters change the motion between nodes to first order, sensor parameters the
measurements (`observations`).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipistrelle.config import Config, InputError
from pipistrelle.estimation.beliefs import Gaussian
from pipistrelle.estimation.motion import (
    ACKERMANN,
    BY_POSES,
    Controls,
    Durations,
    Motion,
    MotionNumbers,
    Pose,
    PoseCovariance,
    motion_increment,
    motion_numbers,
    propagate_pose,
)
from pipistrelle.estimation.observations.range import cholesky
from pipistrelle.estimation.smoother.records import (
    Arrays,
    Legs,
    PlainLegs,
    add,
    add_product,
    congruent,
    multiply,
    solve_with,
    transpose,
    write,
    write_identity,
)
from pipistrelle.geometry import wrap_angle
from pipistrelle.jit import no_alloc, optimised_once

_ODOMETRY: dict[str, tuple[str, ...]] = {
    name: (name,) for name in ("speed_scale", "turn_bias", "wheelbase")
}
_SENSOR: dict[str, tuple[str, ...]] = {
    "speed_of_sound": ("speed_of_sound", "bearing_lean"),
    "sensor_heading": ("sensor_heading",),
    "sensor_place": ("sensor_place_x", "sensor_place_y"),
    "time_offset": ("time_offset",),
    "range_scale": ("range_scale",),
    "range_bias": ("range_bias",),
}
NUMBERS = _ODOMETRY | _SENSOR
"""Names of the numbers of each parameter, in the order of the separator."""
LEAN_STD = 0.003
"""Prior std of the relative lean of bearings with the speed of sound, which other errors of an
array resemble; the `physics` preset leans by 0.1 to 0.3 %."""
OF_ODOMETRY, OF_SENSOR = tuple(_ODOMETRY), tuple(_SENSOR)
"""Parameters of odometry, by their codes in kernels, and of the sensor, as in `Places.sensor`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """The calibration parameters that a smoother estimates, with assumed values and priors."""

    names: tuple[str, ...]
    """Names of the numbers."""
    assumed: Float[np.ndarray, " p"]
    """Assumed values."""
    unit: Float[np.ndarray, " p"]
    """Factors that convert numbers of the separator to deviations from the assumed values."""
    stds: Float[np.ndarray, " p"]
    """Prior standard deviations, in the separator's units."""
    odometry: Int[np.ndarray, " q"]
    """Codes of the odometry parameters (`OF_ODOMETRY`), which come first."""
    sensor: Int[np.ndarray, "6"]
    """Separator columns of the sensor parameters (`OF_SENSOR`); 0 if not estimated."""


def numbers_of(parameters: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the scalar components of calibration parameters, in a fixed order.

    >>> numbers_of(["sensor_place", "wheelbase"])
    ('wheelbase', 'sensor_place_x', 'sensor_place_y')
    """
    asked = set(parameters)
    return tuple(one for name, parts in NUMBERS.items() if name in asked for one in parts)


def calibration_of(config: Config, motion: Motion) -> Calibration:
    """Build the calibration parameters that ``filter.calibrate`` selects, for a motion model.

    >>> from pipistrelle.config import FilterConfig
    >>> config = Config(filter=FilterConfig(calibrate=("sensor_place", "speed_of_sound")))
    >>> calibration_of(config, Motion(model="unicycle", control_std=(0.1, 0.1))).sensor
    array([1, 0, 3, 0, 0, 0])
    """
    asked, about, sound = {*config.filter.calibrate}, config.prior, config.assumed_sound_speed
    if "wheelbase" in asked and motion.model != "bicycle":
        raise InputError(
            f'filter.calibrate: found "wheelbase" for a {motion.model} model of motion, which has '
            "none; leave it out"
        )
    names = [name for name in NUMBERS if name in asked]
    units = {"speed_of_sound": sound, "wheelbase": motion.wheelbase}
    assumed = units | {"speed_scale": 1.0, "range_scale": 1.0}
    stds = {"bearing_lean": LEAN_STD}
    for name in names:
        for number in NUMBERS[name]:
            stds.setdefault(number, getattr(about, f"{name}_std"))
    stds |= {"speed_of_sound": about.speed_of_sound_std / sound}
    numbers = numbers_of(names)
    column: dict[str, int] = {name: 1 + numbers.index(NUMBERS[name][0]) for name in names}
    return Calibration(
        names=numbers,
        assumed=np.array([assumed.get(number, 0.0) for number in numbers]),
        unit=np.array([units.get(number, 1.0) for number in numbers]),
        stds=np.array([stds[number] for number in numbers]),
        odometry=np.array([OF_ODOMETRY.index(name) for name in names if name in OF_ODOMETRY], int),
        sensor=np.array([column.get(name, 0) for name in OF_SENSOR]),
    )


NOTHING = calibration_of(Config(), Motion(model="unicycle", control_std=(0.0, 0.0)))
"""Calibration without parameters."""


Steps = tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3 3"]]
"""Means and covariances of control steps relative to the node before."""
Led = tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3 3"], Float[np.ndarray, "s 3 q"]]
"""Means, covariances and parameter Jacobians of control steps relative to the node before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """Poses after each control step since the last scan, relative to the pose at that scan."""

    mean: Float[np.ndarray, "m 3"]  # after each step, relative to that node [m, m, rad]
    covariance: Float[np.ndarray, "m 3 3"]  # of x, y and heading in the node's axes
    slopes: Float[np.ndarray, "m 3 q"]  # Jacobian of the mean by the odometry parameters
    seconds: float = 0.0  # total duration [s]


def no_odometry(parameters: int = 0) -> Odometry:
    """Return odometry without control steps, for a number of calibration parameters."""
    return Odometry(
        mean=np.empty((0, 3)), covariance=np.empty((0, 3, 3)), slopes=np.empty((0, 3, parameters))
    )


def extended(
    odometry: Odometry,
    motion: Motion,
    controls: Controls,
    dt: Durations,
    parameters: Int[np.ndarray, " q"],
) -> Odometry:
    """Return odometry extended by control steps; ``parameters``: codes of calibrated parameters."""
    steps = odometry.mean, odometry.covariance, odometry.slopes
    numbers = motion_numbers(motion)
    mean, covariance, slopes = _extended(steps, controls, dt, numbers, parameters)
    seconds = odometry.seconds + float(dt.sum())
    return Odometry(mean=mean, covariance=covariance, slopes=slopes, seconds=seconds)


def placed(start: Gaussian, odometry: Odometry, first: int = 0) -> Gaussian:
    """Convert odometry to world poses with covariances, after each step from ``first`` on."""
    steps = odometry.mean[first:], odometry.covariance[first:]
    poses, spreads = _placed((start.mean, start.covariance), steps)
    return Gaussian(mean=poses, covariance=spreads)


@optimised_once
def _placed(start: tuple[Pose, PoseCovariance], steps: Steps) -> Steps:
    """Convert poses relative to a start pose to world poses with covariances."""
    poses, spreads = np.empty(steps[0].shape), np.empty(steps[1].shape)
    for k in range(len(poses)):
        place(start, steps[0][k], steps[1][k], poses[k], spreads[k])
    return poses, spreads


@optimised_once
def _extended(
    steps: Led,
    controls: Controls,
    dt: Durations,
    motion: MotionNumbers,
    parameters: Int[np.ndarray, " q"],
) -> Led:
    """Return poses relative to the last scan extended by control steps, with covariances."""
    (before, _, q), size = steps[2].shape, dt.size
    mean, covariance = np.empty((before + size, 3)), np.empty((before + size, 3, 3))
    slopes = np.empty((before + size, 3, q))
    pose, P, J = np.zeros(3), np.zeros((3, 3)), np.zeros((3, q))
    for j in range(before):
        pose[:] = steps[0][j]
        write(steps[1][j], P)
        write(steps[2][j], J)
        mean[j] = pose
        write(P, covariance[j])
        write(J, slopes[j])
    for k in range(size):
        if q > 0:
            _lead_on(J, pose, (controls[k], dt[k]), motion, parameters)
        propagate_pose(pose, P, controls[k], dt[k], motion)
        mean[before + k] = pose
        write(P, covariance[before + k])
        write(J, slopes[before + k])
    return mean, covariance, slopes


@no_alloc
def _lead_on(
    J: Float[np.ndarray, "3 q"],
    pose: Pose,
    control: tuple[Float[np.ndarray, " c"], float],
    motion: MotionNumbers,
    parameters: Int[np.ndarray, " q"],
) -> None:
    """Propagate a pose's derivatives by calibration parameters through a control step, in place."""
    controls, dt = control
    dx, dy, turn, sx, sy, sh, tx, ty, th = motion_increment(motion, pose[2], controls, dt)
    for e in range(parameters.size):
        J[0, e] -= dy * J[2, e]
        J[1, e] += dx * J[2, e]
        if parameters[e] == 0:
            bent = motion.model == ACKERMANN  # its motion is not proportional to its speed
            J[0, e] += sx * controls[0] if bent else dx
            J[1, e] += sy * controls[0] if bent else dy
            J[2, e] += 0.0 if motion.model == BY_POSES else sh * controls[0]
        elif parameters[e] == 1 and motion.model == BY_POSES:
            J[2, e] += dt
        elif parameters[e] == 1:
            J[0, e] += tx
            J[1, e] += ty
            J[2, e] += th
        else:
            J[2, e] -= turn


@no_alloc
def place(
    start: tuple[Pose, PoseCovariance],
    relative: Pose,
    P: PoseCovariance,
    pose: Pose,
    covariance: PoseCovariance,
) -> None:
    """Convert a pose relative to ``start`` to a world pose with covariance, written in place."""
    (x, y, heading), C = start[0], start[1]
    c, s = math.cos(heading), math.sin(heading)
    dx, dy = c * relative[0] - s * relative[1], s * relative[0] + c * relative[1]
    pose[0], pose[1], pose[2] = x + dx, y + dy, wrap_angle(heading + relative[2])
    covariance[0, 0] = C[0, 0] - 2.0 * dy * C[0, 2] + dy * dy * C[2, 2]
    covariance[0, 1] = C[0, 1] + dx * C[0, 2] - dy * C[1, 2] - dx * dy * C[2, 2]
    covariance[1, 1] = C[1, 1] + 2.0 * dx * C[1, 2] + dx * dx * C[2, 2]
    covariance[0, 2], covariance[1, 2] = C[0, 2] - dy * C[2, 2], C[1, 2] + dx * C[2, 2]
    covariance[0, 0] += c * c * P[0, 0] - 2.0 * c * s * P[0, 1] + s * s * P[1, 1]
    covariance[0, 1] += c * s * (P[0, 0] - P[1, 1]) + (c * c - s * s) * P[0, 1]
    covariance[1, 1] += s * s * P[0, 0] + 2.0 * c * s * P[0, 1] + c * c * P[1, 1]
    covariance[0, 2] += c * P[0, 2] - s * P[1, 2]
    covariance[1, 2] += s * P[0, 2] + c * P[1, 2]
    covariance[2, 2] = C[2, 2] + P[2, 2]
    covariance[1, 0] = covariance[0, 1]
    covariance[2, 0], covariance[2, 1] = covariance[0, 2], covariance[1, 2]


@optimised_once
def poses_between(
    legs: PlainLegs,
    ends: Float[np.ndarray, "k 2"],
    steps: Arrays,
    nodes: Steps,
    cross: Float[np.ndarray, "k 3 3"],
) -> Steps:
    """Return the pose and covariance after every control step, from the smoothed poses at scans."""
    legs, count = Legs(*legs), ends[-1, 1]
    mean, covariance = np.empty((1 + count, 3)), np.empty((1 + count, 3, 3))
    mean[0], covariance[0] = nodes[0][0], nodes[1][0]
    by_a, by_b, total, G, R, L = np.zeros((6, 3, 3))
    for k in range(1, ends.shape[0]):
        a, b, way, N = nodes[0][k - 1], nodes[0][k], legs.mean[k], legs.noise[k]
        c, s = math.cos(a[2]), math.sin(a[2])
        dx, dy, turn = b[0] - a[0], b[1] - a[1], wrap_angle(b[2] - a[2] - way[2])
        ahead, aside = c * dx + s * dy - way[0], c * dy - s * dx - way[1]
        for j in range(ends[k, 0], ends[k, 1]):
            pose, spread, d, P = mean[1 + j], covariance[1 + j], steps[0][j], steps[1][j]
            for e in range(3):
                pose[e] = b[e]
            write(nodes[1][k], spread)
            if N[2, 2] <= 0.0 or j + 1 >= ends[k, 1]:
                continue
            write(P, G)  # G = P Phi^T N^-1
            for e in range(3):
                G[e, 0] -= (way[1] - d[1]) * P[e, 2]
                G[e, 1] += (way[0] - d[0]) * P[e, 2]
            cholesky(N, L)
            for e in range(3):
                solve_with(L, G[e])
            x = d[0] + G[0, 0] * ahead + G[0, 1] * aside + G[0, 2] * turn
            y = d[1] + G[1, 0] * ahead + G[1, 1] * aside + G[1, 2] * turn
            h = d[2] + G[2, 0] * ahead + G[2, 1] * aside + G[2, 2] * turn
            x, y = c * x - s * y, s * x + c * y
            pose[0], pose[1], pose[2] = a[0] + x, a[1] + y, wrap_angle(a[2] + h)
            write(P, by_a)
            multiply(G, N, L)
            transpose(G, by_b)
            add_product(L, by_b, by_a, -1.0)  # P - G N G^T
            write_identity(R)
            R[0, 0], R[0, 1], R[1, 0], R[1, 1] = c, -s, s, c
            multiply(R, by_a, L)
            transpose(R, by_b)
            multiply(L, by_b, total)
            multiply(R, G, L)
            multiply(L, by_b, R)
            write(R, by_b)  # the Jacobians by a and b
            write_identity(by_a)
            add(by_b, by_a, -1.0)
            for e in range(3):
                by_a[e, 2] += by_b[e, 0] * dy - by_b[e, 1] * dx
            by_a[0, 2] -= y
            by_a[1, 2] += x
            congruent(by_a, nodes[1][k - 1], L, total)
            congruent(by_b, nodes[1][k], L, total)
            transpose(by_a, G)
            multiply(by_b, cross[k], L)
            multiply(L, G, R)
            for e in range(3):
                for f in range(3):
                    spread[e, f] = 0.5 * (total[e, f] + total[f, e]) + (R[e, f] + R[f, e])
    return mean, covariance
