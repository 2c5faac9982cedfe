r"""Where the vehicle is sent: by controls, by way-points that a driver steers for, or along poses.

The paper's course is a circle of constant controls, driven blindly. A vehicle on any other shape
would lose it within a round, so a driver who sees where the vehicle is steers for a point a little
ahead on the line through the way-points (pure pursuit): by the angle off the heading,
:math:`\gamma = \varphi`, for a front wheel, along the arc through the point, :math:`\omega = 2 V
\sin\varphi / a`, for a unicycle, with a how far ahead that is. Noise is added to what he commands;
what he commands is what the filters know.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.config import InputError, MotionConfig, ScenarioConfig
from pipistrelle.estimation.motion import Motion, controls_between, motion_step
from pipistrelle.geometry import path_at, wrap_angle

LOOK_AHEAD = 1.0
"""How far ahead of the vehicle the driver aims [m]."""
MAX_STEERING = 0.6
"""Largest angle to which he turns a front wheel [rad]."""
TIME_TOLERANCE = 1e-6
"""By how much two times may differ that are one, in steps or seconds."""
EIGHT_POINTS = 96
"""Way-points of a figure of eight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Commands:
    """Commanded controls; the vehicle starts where the settings say."""

    time: Float[np.ndarray, " n"]
    """Since the start, rising: a row holds until the next one's, the last only ends the drive
    [s]."""
    rows: Float[np.ndarray, "n 2"]
    """Speed [m/s], and steering angle [rad] of a bicycle or angular rate [rad/s] of a unicycle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoints:
    """A line through points, and from the last to the first as often as there is time."""

    points: Float[np.ndarray, "n 2"]
    """At least two; the vehicle starts at the first [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Poses:
    """Poses of the vehicle, and the controls that its filters assume."""

    time: Float[np.ndarray, " n"]
    """Since the start, rising; poses in between are interpolated [s]."""
    path: Float[np.ndarray, "n 3"]
    """Path [m, m, rad]."""
    commands: Commands | None = None
    """None: what would have led along the path, less noise."""


Course = Commands | Waypoints | Poses


def motion_of(motion: MotionConfig) -> Motion:
    """Return the settings' motion model, as the filters take it.

    Bradley & Abaid, Eq. (5).

    >>> motion_of(MotionConfig(speed_std=0.2)).control_std
    (0.2, 0.03)
    """
    bicycle = motion.model == "bicycle"
    return Motion(
        model=motion.model,
        control_std=(motion.speed_std, motion.steering_std if bicycle else motion.angular_rate_std),
        wheelbase=motion.wheelbase,
    )


def course_of(setup: ScenarioConfig, motion: Motion) -> Course:
    """Return the course that the settings name.

    A circle gives its constant controls; a unicycle turns as the bicycle of its wheelbase
    does.

    Bradley & Abaid, Sec. IV: the circle.

    >>> unicycle = Motion(model="unicycle", control_std=(0.1, 0.1))
    >>> course_of(ScenarioConfig(course="corridor", extent=9.0, lane=4.0), unicycle).points
    array([[-9., -1.],
           [ 9., -1.],
           [ 9.,  1.],
           [-9.,  1.]])
    """
    a = setup.extent
    if setup.course == "eight":
        t = np.linspace(0.0, 2.0 * np.pi, EIGHT_POINTS, endpoint=False)
        return Waypoints(points=a * np.column_stack((np.sin(t), np.sin(t) * np.cos(t))))
    if setup.course == "corridor":
        side = 0.25 * setup.lane
        return Waypoints(points=np.array([[-a, -side], [a, -side], [a, side], [-a, side]]))
    if setup.course == "lawn-mower":
        return Waypoints(points=_lanes(a, setup.lane))
    turn = setup.steering
    if motion.model == "unicycle":
        turn = setup.speed * math.sin(setup.steering) / motion.wheelbase
    always = np.array([[setup.speed, turn], [0.0, 0.0]])
    return Commands(time=np.array([0.0, math.inf]), rows=always)


def steps_of(course: Course, setup: ScenarioConfig) -> int:
    """Return the number of control steps of a course that ends.

    `setup`: its step, and the speed between way-points. Way-points give as many steps as the line
    takes, from the first to the last.

    >>> steps_of(Waypoints(points=np.array([[0.0, 0.0], [7.5, 0.0]])), ScenarioConfig())
    80
    """
    if isinstance(course, Waypoints):
        _check_speed(setup)
        seconds = float(np.hypot(*np.diff(course.points, axis=0).T).sum()) / setup.speed
        return max(math.ceil(seconds / setup.step - TIME_TOLERANCE), 1)
    return math.floor(float(course.time[-1]) / setup.step + TIME_TOLERANCE)


def driven(
    course: Course,
    setup: ScenarioConfig,
    motion: Motion,
    rng: np.random.Generator,
    bias: tuple[float, float] = (0.0, 0.0),
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t-1 2"]]:
    """Drive a course, with noise on both controls.

    `setup`: its steps, their length, and the speed between way-points; `bias`: what the vehicle
    does beyond what it is told, noise apart: of speed [m/s], and of steering angle [rad] or angular
    rate [rad/s]. Returns `path` [m, m, rad]: true poses, the start first; `controls`: as the
    filters know them.

    Bradley & Abaid, Eq. (5).

    Straight on without noise, then round the first corner of a corridor:

    >>> still = Motion(model="unicycle", control_std=(0.0, 0.0))
    >>> setup = ScenarioConfig(course="corridor", extent=3.0, steps=80)
    >>> path, _ = driven(course_of(setup, still), setup, still, np.random.default_rng(7))
    >>> path[16].round(3), path[-1, :2].round(1)
    (array([-1.5, -1. ,  0. ]), array([2.8, 0.8]))
    """
    if not isinstance(course, Waypoints):
        _check_length(course, setup)
    time = np.arange(setup.steps + 1) * setup.step
    if isinstance(course, Poses):
        path = _poses_at(time, course)
        if course.commands is not None:
            return path, _held(time, course.commands)
        return path, controls_between(path, setup.step, motion) - _noise(setup, motion, rng, bias)
    noise = _noise(setup, motion, rng, bias)
    if isinstance(course, Waypoints):
        return _steered(course.points, noise, setup, motion)
    controls, path = _held(time, course), np.empty((setup.steps + 1, 3))
    path[0] = setup.start
    for k, control in enumerate(controls + noise):
        path[k + 1] = motion_step(motion, path[k], control, setup.step)
    return path, controls


def _lanes(extent: float, lane: float) -> Float[np.ndarray, "n 2"]:
    """Return the corners of parallel lanes from one side of a square to the other."""
    across = np.arange(-extent, extent + 0.5 * lane, lane)
    ends = np.tile([[-extent, extent], [extent, -extent]], (len(across), 1))[: len(across)]
    return np.column_stack((ends.ravel(), np.repeat(across, 2)))


def _noise(
    setup: ScenarioConfig, motion: Motion, rng: np.random.Generator, bias: tuple[float, float]
) -> Float[np.ndarray, "k 2"]:
    """Draw the noise on both controls, about its bias."""
    return rng.standard_normal((setup.steps, 2)) * motion.control_std + bias


def _held(time: Float[np.ndarray, " t"], commands: Commands) -> Float[np.ndarray, "t-1 2"]:
    """Return the controls commanded at the start of each step."""
    rows = np.searchsorted(commands.time, time[:-1] + TIME_TOLERANCE, side="right") - 1
    return commands.rows[rows]


def _poses_at(time: Float[np.ndarray, " t"], course: Poses) -> Float[np.ndarray, "t 3"]:
    """Return the poses at some times: to the bit, where they are those of the course."""
    if np.array_equal(time, course.time[: len(time)]):
        return course.path[: len(time)].copy()
    return path_at(time, course.time, course.path)


def _steered(
    points: Float[np.ndarray, "n 2"],
    noise: Float[np.ndarray, "k 2"],
    setup: ScenarioConfig,
    motion: Motion,
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "k 2"]]:
    """Return the controls that follow the closed line through the way-points, by pure pursuit."""
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
    """Move the aim along a line until it is far enough ahead, by one round at most [m]."""
    for _ in range(math.ceil(10.0 * along[-1] / LOOK_AHEAD)):
        x, y = _at(aim, line, along)
        if math.hypot(x - pose[0], y - pose[1]) >= LOOK_AHEAD:
            break
        aim += 0.1 * LOOK_AHEAD
    return aim


def _at(
    aim: float, line: Float[np.ndarray, "n 2"], along: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the point at a length along a closed line."""
    here = aim % along[-1]
    return float(np.interp(here, along, line[:, 0])), float(np.interp(here, along, line[:, 1]))


def _towards(
    pose: Float[np.ndarray, "3"], point: tuple[float, float], speed: float, motion: Motion
) -> tuple[float, float]:
    """Return controls that turn the vehicle towards a point ahead, within the steering limit."""
    off = wrap_angle(math.atan2(point[1] - pose[1], point[0] - pose[0]) - pose[2])
    if motion.model == "bicycle":
        return speed, min(max(off, -MAX_STEERING), MAX_STEERING)
    off = min(max(off, -0.5 * math.pi), 0.5 * math.pi)
    return speed, 2.0 * speed * math.sin(off) / LOOK_AHEAD


def _check_speed(setup: ScenarioConfig) -> None:
    """Refuse a speed of zero."""
    if setup.speed <= 0.0:
        raise InputError(
            f"scenario.speed: found {setup.speed:g} m/s, expected more than 0 to drive between "
            "way-points; correct it"
        )


def _check_length(course: Commands | Poses, setup: ScenarioConfig) -> None:
    """Refuse a course that ends before the drive."""
    if course.time[-1] < setup.steps * setup.step - TIME_TOLERANCE:
        raise InputError(
            f"scenario.steps: found {setup.steps}, but the path of {setup.world} ends after "
            f"{steps_of(course, setup)} steps of {setup.step:g} s; expected as many, or fewer"
        )
