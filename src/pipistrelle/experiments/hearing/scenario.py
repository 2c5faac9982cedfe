"""The true world: a noisy drive, landmarks around it, and whoever calls there."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipistrelle.acoustics.callers import VEHICLE, Caller, callers_of, moves
from pipistrelle.arithmetic.random_stream import stream_key
from pipistrelle.config import Config, InputError, MotionConfig, ScenarioConfig
from pipistrelle.estimation.motion import Motion, motion_step
from pipistrelle.experiments.drives import LabelledPoints

TRIES = 2000
"""Draws of one landmark before the request counts as impossible."""
DENSEST = math.pi / math.sqrt(12.0)
"""Largest share of the plane that equal discs can cover."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A true world. Landmark i (from 0) bears the label i + 1, caller j (from 1) the label n + j.

    Attributes
    ----------
    time : (k + 1) [s]
    path : (k + 1, 3) [m, m, rad]
        True poses, the start first.
    controls : (k, 2)
        Nominal speed [m/s] and steering angle [rad] of each step, as the filters know them.
    landmarks : (n, 2) [m]
    callers : tuple of Caller
        The vehicle first; paths have a place for each of the times.
    """

    time: Float[np.ndarray, " t"]
    path: Float[np.ndarray, "t 3"]
    controls: Float[np.ndarray, "t-1 2"]
    landmarks: Float[np.ndarray, "n 2"]
    callers: tuple[Caller, ...]


def world_of(config: Config, iteration: int = 0) -> Scenario:
    """Draw one of the worlds that the settings' seed stands for.

    Parameters
    ----------
    config : Config
    iteration : int
        Number of the world.

    Returns
    -------
    Scenario

    Raises
    ------
    InputError
        As `draw_scenario`.

    Examples
    --------
    >>> one, again, other = world_of(Config()), world_of(Config()), world_of(Config(), 1)
    >>> (one.path == again.path).all().item(), (one.path == other.path).all().item()
    (True, False)
    """
    key = stream_key(config.seed, iteration, "scenario")
    return draw_scenario(config, np.random.default_rng(key))


def draw_scenario(config: Config, rng: np.random.Generator) -> Scenario:
    """Draw a world: the path first, then the beacon and the landmarks clear of it.

    Parameters
    ----------
    config : Config
    rng : Generator

    Returns
    -------
    Scenario

    Raises
    ------
    InputError
        When the landmarks or the beacon find no place.

    Notes
    -----
    Bradley & Abaid, Sec. IV.

    Examples
    --------
    >>> world = draw_scenario(Config(), np.random.default_rng(7))
    >>> world.path.shape, world.landmarks.shape
    ((1501, 3), (50, 2))
    """
    setup = config.scenario
    controls = np.tile([setup.speed, setup.steering], (setup.steps, 1))
    path = _drive(np.array(setup.start), controls, setup.step, config.motion, rng)
    beacon = _place_beacon(setup, path[:, :2], rng)
    return Scenario(
        time=np.arange(setup.steps + 1) * setup.step,
        path=path,
        controls=controls,
        landmarks=_place_landmarks(setup, path[:, :2], beacon, rng),
        callers=callers_of(config, beacon),
    )


def landmark_count(config: Config) -> int:
    """Count what a world of these settings has to map: the landmarks, and all callers but one.

    Parameters
    ----------
    config : Config

    Returns
    -------
    int
        The vehicle is no landmark of its own map; each other caller is one.

    Examples
    --------
    >>> landmark_count(Config(scenario=ScenarioConfig(landmarks=12)))
    13
    """
    callers = callers_of(config, np.zeros(2))  # wherever the beacon stands
    return config.scenario.landmarks + len(callers[VEHICLE + 1 :])


def standing_landmarks(scenario: Scenario) -> LabelledPoints:
    """Label what stands: the landmarks, then the callers that do not move.

    Parameters
    ----------
    scenario : Scenario

    Returns
    -------
    labels (m) and positions (m, 2) [m]
        Labels rising.

    Examples
    --------
    >>> labels, places = standing_landmarks(world_of(Config()))
    >>> labels[[0, -1]], places.shape
    (array([ 1, 51]), (51, 2))
    """
    landmarks = scenario.landmarks
    labelled = enumerate(scenario.callers[VEHICLE + 1 :], start=len(landmarks) + 1)
    standing = {label: np.asarray(c.place) for label, c in labelled if not moves(c)}
    labels = np.array([*range(1, len(landmarks) + 1), *standing])
    return labels, np.vstack((landmarks, *standing.values()))


def moving_labels(scenario: Scenario) -> tuple[int, ...]:
    """List the labels of the callers that move, which are no landmarks of a map.

    Parameters
    ----------
    scenario : Scenario

    Returns
    -------
    tuple of int
        Rising.

    Examples
    --------
    >>> moving_labels(world_of(Config()))
    ()
    """
    labelled = enumerate(scenario.callers[VEHICLE + 1 :], start=len(scenario.landmarks) + 1)
    return tuple(label for label, caller in labelled if moves(caller))


def bicycle(motion: MotionConfig) -> Motion:
    """Return the settings' motion model, as the filters take it.

    Parameters
    ----------
    motion : MotionConfig

    Returns
    -------
    Motion

    Notes
    -----
    Bradley & Abaid, Eq. (5).

    Examples
    --------
    >>> bicycle(MotionConfig(speed_std=0.2)).control_std
    (0.2, 0.03)
    """
    return Motion(
        model="bicycle",
        control_std=(motion.speed_std, motion.steering_std),
        wheelbase=motion.wheelbase,
    )


def _drive(
    start: Float[np.ndarray, "3"],
    controls: Float[np.ndarray, "k 2"],
    dt: float,
    motion: MotionConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "t 3"]:
    """Drive with noise on both controls (Bradley & Abaid, Eq. (5))."""
    model = bicycle(motion)
    noisy = controls + rng.standard_normal(controls.shape) * model.control_std
    path = np.empty((len(controls) + 1, 3))
    path[0] = start
    for k, control in enumerate(noisy):
        path[k + 1] = motion_step(model, path[k], control, dt)
    return path


def _distance(points: Float[np.ndarray, "n 2"], place: Float[np.ndarray, "2"]) -> float:
    """Distance of the nearest of the points; infinite where there is none."""
    offset = points - place
    return math.sqrt(np.min(np.sum(offset * offset, axis=1), initial=math.inf))


def _place_beacon(
    setup: ScenarioConfig, path: Float[np.ndarray, "k 2"], rng: np.random.Generator
) -> Float[np.ndarray, "2"]:
    """Put the beacon at a random bearing, clear of the path."""
    for _ in range(TRIES):
        direction = rng.uniform(-math.pi, math.pi)
        beacon = setup.beacon_distance * np.array([math.cos(direction), math.sin(direction)])
        if _distance(path, beacon) >= setup.clearance:
            return beacon
    raise InputError(
        f"scenario.beacon_distance: found {setup.beacon_distance:g} m, but no bearing there is "
        f"{setup.clearance:g} m clear of the path; expected a distance away from the path, or a "
        "smaller scenario.clearance"
    )


def _place_landmarks(
    setup: ScenarioConfig,
    path: Float[np.ndarray, "k 2"],
    beacon: Float[np.ndarray, "2"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 2"]:
    """Draw landmarks one by one, uniformly over the disc, until each keeps its distances."""
    half = 0.5 * setup.spacing
    most = DENSEST * ((setup.radius + half) / max(half, 1e-100)) ** 2
    if setup.landmarks > max(most, 1.0):
        raise _too_many(setup, f"at most {max(int(most), 1)} fit")
    placed = np.empty((setup.landmarks, 2))
    for i in range(setup.landmarks):
        for _ in range(TRIES):
            distance = setup.radius * math.sqrt(rng.uniform())
            direction = rng.uniform(-math.pi, math.pi)
            place = distance * np.array([math.cos(direction), math.sin(direction)])
            if (
                _distance(placed[:i], place) >= setup.spacing
                and _distance(path, place) >= setup.clearance
                and _distance(beacon[None], place) >= setup.clearance
            ):
                placed[i] = place
                break
        else:
            raise _too_many(setup, f"room was found for {i}")
    return placed


def _too_many(setup: ScenarioConfig, limit: str) -> InputError:
    """Say that the landmarks do not fit, and what to change."""
    return InputError(
        f"scenario.landmarks: found {setup.landmarks}, but {limit} at {setup.spacing:g} m from "
        f"each other within {setup.radius:g} m of the centre; expected fewer landmarks, a smaller "
        "scenario.spacing or scenario.clearance, or a larger scenario.radius"
    )
