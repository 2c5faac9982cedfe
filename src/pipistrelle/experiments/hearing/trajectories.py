r"""Courses of the vehicle: constant or timed controls, way-points followed by a driver, or poses.

The paper's circle is driven open loop with constant controls. On other shapes the vehicle would
soon drift off the course, so a driver with access to the true pose steers for a point at a distance
a ahead on the line through the way-points (pure pursuit): with the angle :math:`\varphi` to that
point, :math:`\gamma = \varphi` for a front wheel, and :math:`\omega = 2 V \sin\varphi / a` for a
unicycle. The vehicle executes the commands with noise; the estimators know the commands.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError, MotionConfig, ScenarioConfig
from pipistrelle.estimation.motion import Motion, controls_between, motion_step
from pipistrelle.geometry import path_at, wrap_angle
from pipistrelle.refusals import refusal

LOOK_AHEAD = 1.0
"""Distance of the driver's aim from the vehicle [m]."""
MAX_STEERING = 0.6
"""Largest steering angle that the driver commands [rad]."""
TIME_TOLERANCE = 1e-6
"""Difference below which two times count as equal, in steps or seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Commands:
    """A course given by timed control commands; the vehicle starts at the settings' pose."""

    time: Float[np.ndarray, " n"]
    """Times since the start [s], rising: a row holds until the next; the last only ends the
    drive."""
    rows: Float[np.ndarray, "n 2"]
    """Speed [m/s], and steering angle [rad] of a bicycle or angular rate [rad/s] of a unicycle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Poses:
    """A course given by timed poses [m, m, rad], and the controls that estimators assume."""

    time: Float[np.ndarray, " n"]
    """Times since the start [s], rising; poses between them are interpolated."""
    path: Float[np.ndarray, "n 3"]
    commands: Commands | None = None
    """None: the controls that lead along the path, minus noise."""


Waypoints = Float[np.ndarray, "n 2"]
"""A course along the closed line through two points [m] or more, repeated until the drive ends; the
vehicle starts at the first."""
Course = Commands | Poses | Waypoints


def true_motion(motion: MotionConfig) -> Motion:
    """Return the true motion model of the settings.

    Bradley & Abaid, Eq. (5).
    """
    bicycle = motion.model == "bicycle"
    return Motion(
        model=motion.model,
        control_std=(motion.speed_std, motion.steering_std if bicycle else motion.angular_rate_std),
        wheelbase=motion.wheelbase,
    )


def course_of(setup: ScenarioConfig, motion: Motion) -> Course:
    """Return the course that the settings name: circle, eight, corridor or lawn-mower.

    A circle gives constant controls; a unicycle turns at the rate of the bicycle of its wheelbase.

    Bradley & Abaid, Sec. IV: the circle.
    """
    a = setup.extent
    if setup.course == "eight":
        t = np.linspace(0.0, 2.0 * np.pi, 96, endpoint=False)
        return a * np.column_stack((np.sin(t), np.sin(t) * np.cos(t)))
    if setup.course == "corridor":
        side = 0.25 * setup.lane
        return np.array([[-a, -side], [a, -side], [a, side], [-a, side]])
    if setup.course == "lawn-mower":
        return _lanes(a, setup.lane)
    turn = setup.steering
    if motion.model == "unicycle":
        turn = setup.speed * math.sin(setup.steering) / motion.wheelbase
    always = np.array([[setup.speed, turn], [0.0, 0.0]])
    return Commands(time=np.array([0.0, math.inf]), rows=always)


def steps_of(course: Course, setup: ScenarioConfig) -> int:
    """Return the number of control steps of a course (way-points: from the first to the last).

    `setup` gives the length of a step and the speed between way-points.
    """
    if isinstance(course, np.ndarray):
        _check_speed(setup)
        seconds = float(np.hypot(*np.diff(course, axis=0).T).sum()) / setup.speed
        return max(math.ceil(seconds / setup.step - TIME_TOLERANCE), 1)
    return math.floor(float(course.time[-1]) / setup.step + TIME_TOLERANCE)


def driven(
    course: Course,
    setup: ScenarioConfig,
    motion: Motion,
    rng: np.random.Generator,
    bias: tuple[float, float] = (0.0, 0.0),
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t-1 2"]]:
    """Simulate a drive along a course, with noise on both controls of the vehicle.

    `bias` is a constant error of speed [m/s] and of steering angle [rad] or angular rate [rad/s].
    Returns the true poses [m, m, rad], the start first, and the controls that the estimators know.

    Bradley & Abaid, Eq. (5).
    """
    short = setup.steps * setup.step - TIME_TOLERANCE
    if not isinstance(course, np.ndarray) and course.time[-1] < short:
        most = f"{steps_of(course, setup)} steps of {setup.step:g} s; expected as many, or fewer"
        but = f"but the path of {setup.world} ends after {most}"
        raise InputError(f"scenario.steps: found {setup.steps}, {but}")
    time = np.arange(setup.steps + 1) * setup.step
    if isinstance(course, Poses):
        path = path_at(time, course.time, course.path)
        if np.array_equal(time, course.time[: len(time)]):  # recorded times: bit for bit
            path = course.path[: len(time)].copy()
        if course.commands is not None:
            return path, _held(time, course.commands)
        return path, controls_between(path, setup.step, motion) - _noise(setup, motion, rng, bias)
    noise = _noise(setup, motion, rng, bias)
    if isinstance(course, np.ndarray):
        return _steered(course, noise, setup, motion)
    controls, path = _held(time, course), np.empty((setup.steps + 1, 3))
    path[0] = setup.start
    for k, control in enumerate(controls + noise):
        path[k + 1] = motion_step(motion, path[k], control, setup.step)
    return path, controls


def _lanes(extent: float, lane: float) -> Float[np.ndarray, "n 2"]:
    """Return the way-points of parallel lanes that cover a square."""
    across = np.arange(-extent, extent + 0.5 * lane, lane)
    ends = np.tile([[-extent, extent], [extent, -extent]], (len(across), 1))[: len(across)]
    return np.column_stack((ends.ravel(), np.repeat(across, 2)))


def _noise(
    setup: ScenarioConfig, motion: Motion, rng: np.random.Generator, bias: tuple[float, float]
) -> Float[np.ndarray, "k 2"]:
    """Draw the random errors of both controls at every step, with mean `bias`."""
    return rng.standard_normal((setup.steps, 2)) * motion.control_std + bias


def _held(time: Float[np.ndarray, " t"], commands: Commands) -> Float[np.ndarray, "t-1 2"]:
    """Return the controls of each step: the command in force when the step starts."""
    rows = np.searchsorted(commands.time, time[:-1] + TIME_TOLERANCE, side="right") - 1
    return commands.rows[rows]


def _steered(
    points: Float[np.ndarray, "n 2"],
    noise: Float[np.ndarray, "k 2"],
    setup: ScenarioConfig,
    motion: Motion,
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "k 2"]]:
    """Simulate a vehicle that follows the closed line through way-points by pure pursuit."""
    _check_speed(setup)
    line = np.vstack((points, points[:1]))
    along = np.append(0.0, np.hypot(*np.diff(line, axis=0).T).cumsum())
    x, y = points[0].tolist()
    dx, dy = (points[1] - points[0]).tolist()
    path, controls = np.empty((len(noise) + 1, 3)), np.empty((len(noise), 2))
    path[0], aim = (x, y, wrap_angle(math.atan2(dy, dx))), 0.0
    for k, off in enumerate(noise):
        aim = _ahead(path[k], aim, line, along)
        controls[k] = _towards(path[k], _at(aim, line, along), setup.speed, motion)
        path[k + 1] = motion_step(motion, path[k], controls[k] + off, setup.step)
    return path, controls


def _ahead(
    pose: Float[np.ndarray, "3"],
    aim: float,
    line: Float[np.ndarray, "n 2"],
    along: Float[np.ndarray, " n"],
) -> float:
    """Advance an aim point's arc length along a closed line to `LOOK_AHEAD` from the vehicle."""
    for _ in range(math.ceil(10.0 * along[-1] / LOOK_AHEAD)):
        x, y = _at(aim, line, along)
        if math.hypot(x - pose[0], y - pose[1]) >= LOOK_AHEAD:
            break
        aim += 0.1 * LOOK_AHEAD
    return aim


def _at(
    aim: float, line: Float[np.ndarray, "n 2"], along: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the point x, y of a closed line at the arc length `aim` [m]."""
    here = aim % along[-1]
    return float(np.interp(here, along, line[:, 0])), float(np.interp(here, along, line[:, 1]))


def _towards(
    pose: Float[np.ndarray, "3"], point: tuple[float, float], speed: float, motion: Motion
) -> tuple[float, float]:
    """Return speed and steering that turn the vehicle towards a point, within the limits."""
    off = wrap_angle(math.atan2(point[1] - pose[1], point[0] - pose[0]) - pose[2])
    if motion.model == "bicycle":
        return speed, min(max(off, -MAX_STEERING), MAX_STEERING)
    off = min(max(off, -0.5 * math.pi), 0.5 * math.pi)
    return speed, 2.0 * speed * math.sin(off) / LOOK_AHEAD


def _check_speed(setup: ScenarioConfig) -> None:
    """Raise if the speed in the settings is not positive, as way-points need."""
    if setup.speed <= 0.0:
        found, expected = f"{setup.speed:g} m/s", "more than 0 to drive between way-points"
        raise refusal("scenario.speed", found, expected, "correct it")
