"""Worlds heard with one detail of the sound or of the front end changed.

`HEARD` names the changes; `hear` listens in a world with one of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from calibration import Oracle, Run, changed, nearest
from readings import PRUNES

from pipistrelle.acoustics.arrivals import Arrivals, arrivals_of_emissions, through_piston
from pipistrelle.acoustics.emitter import Bodies
from pipistrelle.acoustics.paths import VEHICLE
from pipistrelle.config import Config
from pipistrelle.detection.front_end import FrameMeasurements, find_calls
from pipistrelle.detection.scans import scan_of
from pipistrelle.detection.snapshots import Detections
from pipistrelle.experiments.hearing import listening
from pipistrelle.experiments.hearing.scenario import Scenario, world_of
from pipistrelle.geometry import wrap

WIDEST = 0.0025
"""Radius of the smallest piston [m], to whose level the others' is fitted."""
OFFSET = 0.025
"""Distance of the faces from the vehicle's centre [m]."""


class Hearing(NamedTuple):
    """A change of what is heard, and what is fitted again because of it."""

    change: Mapping[str, Any] = {}
    growth: float = 0.0
    """Of the vehicle's level on its axis with the piston's radius: this times log10."""
    degrees: bool = False
    """Whether bearings are those of beams a degree apart."""
    offset: float = 0.0
    """Distance of the faces from the centre [m]."""
    bodies: bool = False
    """Whether sound is reflected at the targets' surface, not at their centre."""
    moving: bool = False
    """Whether echoes reach the vehicle where it has got to."""
    fitted: str = ""
    """``tau``; ``levels``: both levels and tau; ``level``: one for both callers, and tau."""


HEARD = {
    "one level for both callers": Hearing(fitted="level"),
    "level by the piston's area, same power": Hearing(growth=20.0),
    "level by the piston's area, same velocity": Hearing(growth=40.0),
    "beams a degree apart": Hearing(degrees=True, fitted="tau"),
    "80 degrees kept": Hearing(change={"detection.angle_limit_deg": 80.0}, fitted="levels"),
    "echoes meet a moving vehicle": Hearing(moving=True),
    "faces 25 mm from the centre": Hearing(offset=OFFSET),
    "echoes from the targets' surface": Hearing(bodies=True),
}
"""Readings by name. With the same radiated power a piston's pressure on its axis is proportional to
its radius, with the same velocity of its face to its area."""


def hear(
    name: str, config: Config, radii: Sequence[float], world: int, oracle: Oracle
) -> tuple[Scenario, tuple[tuple[FrameMeasurements, ...], ...]]:
    """Listen in a world with a change of `HEARD`, or none for another name."""
    how, scenario = HEARD.get(name, Hearing()), world_of(config, world)
    if how.bodies:
        n, target = len(scenario.landmarks), config.target
        scenario = replace(
            scenario,
            bodies=Bodies(radius=np.full(n, target.radius), shape=np.full(n, target.shape)),
        )
    beam = partial(grown, off_axis=config.emitter.directivity_law, growth=how.growth)
    find = partial(found, degrees=how.degrees, late=how.offset / config.assumed_sound_speed)
    with met_moving(scenario) if how.moving else nullcontext():
        heard = listening.listen(
            scenario, config, radii, iteration=world, oracle=oracle, beam=beam, find=find
        )
    return scenario, heard


def grown(arrivals: Arrivals, *, radius: float, growth: float, **how: Any) -> Arrivals:
    """Apply a piston's beam, with a level on its axis that grows with its radius."""
    heard = through_piston(arrivals, radius=radius, **how)
    louder = growth * np.log10(radius / WIDEST) * (arrivals.caller == VEHICLE)
    return replace(heard, level_db=heard.level_db + louder)


def found(matched: Any, end: Any, *, degrees: bool, late: float, **lags: Any) -> Detections:
    """Find calls; round angles to degrees, or let each face hear earlier by its place."""
    calls = find_calls(matched, end, **lags)
    if degrees:
        angle = np.radians(np.round(np.degrees(calls.angle)))
        calls = replace(calls, angle=angle, bearing=wrap(angle + end.normal[calls.face]))
    return replace(calls, delay=calls.delay - late * np.cos(calls.angle))


@contextmanager
def met_moving(scenario: Scenario) -> Iterator[None]:
    """Let delays and bearings be those of a vehicle that moves on while the sound travels."""

    def arrivals(
        poses: Any, velocities: Any, landmarks: Any, callers: Any, *more: Any
    ) -> tuple[Arrivals, np.ndarray]:
        heard, count = arrivals_of_emissions(poses, velocities, landmarks, callers, *more)
        began = np.repeat(scenario.time[_steps(scenario, poses)], count)
        origin, targets = np.repeat(poses[:, :2], count, axis=0), _places(landmarks, callers)
        target = targets[heard.landmark - 1]
        source = np.array([[0.0, 0.0], *targets[len(landmarks) :]])[heard.caller]
        source = np.where((heard.caller == VEHICLE)[:, np.newaxis], origin, source)
        outward = np.hypot(*(target - source).T)
        delay = heard.delay
        for _ in range(3):
            pose = _pose_at(scenario, began + delay)
            delay = (outward + np.hypot(*(target - pose[:, :2]).T)) / SPEED_OF_SOUND
        dx, dy = (target - pose[:, :2]).T
        return replace(heard, delay=delay, bearing=wrap(np.arctan2(dy, dx) - pose[:, 2])), count

    with patch.object(listening, "arrivals_of_emissions", arrivals):
        yield


SPEED_OF_SOUND = 343.0


def _steps(scenario: Scenario, poses: np.ndarray) -> list[int]:
    """Return the step of each pose on the path."""
    return [int(np.flatnonzero((scenario.path == pose).all(axis=1))[0]) for pose in poses]


def _places(landmarks: np.ndarray, callers: Sequence[Any]) -> np.ndarray:
    """Return the places of all labels: landmarks, then callers that stand."""
    return np.vstack([landmarks, *(np.reshape(c.place, (-1, 2))[:1] for c in callers[1:])])


def _pose_at(scenario: Scenario, time: np.ndarray) -> np.ndarray:
    """Return the true poses between the steps, (k, 3)."""
    path = scenario.path.copy()
    path[:, 2] = np.unwrap(path[:, 2])
    return np.column_stack([np.interp(time, scenario.time, column) for column in path.T])


# Fits


def seen(name: str, config: Config, oracle: Oracle, world: int) -> dict[str, int]:
    """Count what passive and fused sensing see in a world through the widest beam."""
    _, (frames,) = hear(name, config, [WIDEST], world, oracle)
    return {
        way: len(
            {label for frame in frames for label in scan_of(frame.rows, way).landmark.tolist()}
        )
        for way in ("passive", "fused")
    }


def fit_again(name: str, base: Config, run: Run, oracle: Oracle, placed: Any) -> dict[str, float]:
    """Fit levels and tau so that a change has the counts that the base has in the same worlds.

    ``placed(name, config)`` returns a function of the world: the landmarks that passive EKF-SLAM
    places.
    """
    how, keys = HEARD[name], ("emitter.level_db", "beacon.level_db")
    config = changed(base, how.change)

    def mean(name: str, settings: Config) -> dict[str, float]:
        rows = run(partial(seen, name, settings, oracle))
        return {key: float(np.mean([row[key] for row in rows])) for key in ("passive", "fused")}

    def at(*levels: float) -> Config:
        return changed(config, dict(zip(keys, np.array(levels) / 10.0, strict=True)))

    vehicle, beacon = (round(10 * changed_value(base, key)) for key in keys)
    if how.fitted != "tau":
        aim = mean("", base)
    if how.fitted == "level":
        vehicle = beacon = nearest(
            lambda one: sum(mean(name, at(one, one)).values()), sum(aim.values()), vehicle, 8
        )
    elif how.fitted == "levels":
        for _ in range(2):
            by_beacon, by_vehicle = partial(at, vehicle), lambda one, other: at(other, one)
            beacon = nearest(lambda one, at=by_beacon: mean(name, at(one))["passive"],
                             aim["passive"], beacon, 2)  # fmt: skip
            at_beacon = partial(by_vehicle, beacon)
            vehicle = nearest(lambda one, at=at_beacon: mean(name, at(one))["fused"],
                              aim["fused"], vehicle, 2)  # fmt: skip
    config = at(vehicle, beacon)
    full = float(np.mean(run(placed("", base))))
    tau = tau_for(
        full, lambda tau: run(placed(name, changed(config, {"rays.prune_threshold": tau})))
    )
    return dict(how.change) | {
        "emitter.level_db": vehicle / 10, "beacon.level_db": beacon / 10,
        "rays.prune_threshold": tau,
    }  # fmt: skip


def tau_for(aim: float, counts: Any) -> float:
    """Return the tau, of the series 1, 2, 5 up to 0.05, whose mean count is nearest to an aim."""
    means: dict[int, float] = {}

    def mean(i: int) -> float:
        if i not in means:
            means[i] = float(np.mean(counts(PRUNES[i])))
        return means[i]

    low, high = 0, len(PRUNES) - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if mean(middle) <= aim else (low, middle)
    return PRUNES[min((low, high), key=lambda i: abs(mean(i) - aim))]


def changed_value(config: Config, key: str) -> float:
    """Return a setting by its dotted name."""
    section, field = key.split(".")
    return getattr(getattr(config, section), field)
