"""Live ROS messages: converted one at a time to the arguments of `Slam.move` and `Slam.hear`.

The functions of `bag_log` convert angles, frames and stamps, as for a bag.
"""

from collections import Counter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from pipistrelle.config import BagConfig, InputError
from pipistrelle.detection.logs.bag import Message, faults_named
from pipistrelle.detection.logs.bag_log import (
    BEGUN,
    TRANSFORMS,
    Frames,
    Remarks,
    TopicEchoes,
    bare,
    mounts_of,
    odometry_table,
    rows_of,
    step_row,
)
from pipistrelle.detection.logs.poses import motions_between
from pipistrelle.detection.scans import UNLABELLED
from pipistrelle.refusals import refusal

_HERE = Path("ROS")


class Step(NamedTuple):
    """The motion of the vehicle between two messages of its odometry."""

    controls: Float[np.ndarray, "1 c"]
    """As in `Slam.move`."""
    end: float
    """Time at which the step ends [s]."""


class Heard(NamedTuple):
    """The time and columns of a scan in a ROS message."""

    time: float
    """[s]."""
    columns: dict[str, Float[np.ndarray, " m"]]
    """As in `Slam.hear`."""


def motion_of(model: str) -> Literal["poses", "twist"]:
    """Return how odometry messages are used for a motion model, as in `BagConfig.motion`.

    >>> motion_of("bicycle")
    Traceback (most recent call last):
    pipistrelle.config.InputError: the vehicle, key 'motion': found 'bicycle', expected 'poses' or
    'unicycle', which nav_msgs/Odometry tells; say how surely it knows its poses
    """
    if model in ("poses", "unicycle"):
        return "poses" if model == "poses" else "twist"
    expected = "'poses' or 'unicycle', which nav_msgs/Odometry tells"
    fix = "say how surely it knows its poses"
    raise refusal("the vehicle, key 'motion'", repr(model), expected, fix)


def stamp_and_pose(message: Any) -> tuple[float, tuple[float, float, float]]:
    """Return time [s] and pose [m, m, rad] of a ``nav_msgs/Odometry``, which may be the first."""
    with faults_named("ROS, odometry"):
        row = step_row(Message("odometry", 1, 0.0, message), BagConfig())
    odometry_table(_HERE, "odometry", [(1, *row)], BagConfig(), Remarks())
    time, x, y, heading, *_ = row
    return time, (x, y, heading)


def clock_began(before: Any, now: Any) -> bool:
    """Return whether the clock began between two messages: the first has the stamp 0."""
    times = [one.header.stamp.sec + one.header.stamp.nanosec / 1e9 for one in (before, now)]
    return times[0] == 0.0 and times[1] > BEGUN


def step_between(before: Any, now: Any, settings: BagConfig) -> Step:
    """Return the step from one ``nav_msgs/Odometry`` to the next.

    With `settings.motion` "poses" the motion between their poses, else the velocities of the first.
    """
    with faults_named("ROS, odometry"):
        messages = [Message("odometry", n, 0.0, one) for n, one in enumerate((before, now), 1)]
        rows = [(one.number, *step_row(one, settings)) for one in messages]
    if not rows[1][1] > rows[0][1]:
        found, expected = f"the time {rows[1][1]} s", f"one after {rows[0][1]} s"
        raise refusal("ROS, odometry", found, expected, "leave out what comes late or twice")
    table = odometry_table(_HERE, "odometry", rows, settings, Remarks())
    time, *columns = table.column.values()
    if settings.motion == "twist":
        return Step(np.column_stack(columns)[:1], float(time[1]))
    return Step(motions_between(table, time), float(time[1]))


def learn_transforms(frames: Frames, message: Any) -> None:
    """Add the static transforms of a ``tf2_msgs/TFMessage`` to the known frames.

    Raises if a rotation is invalid, after the other transforms have been added.
    """
    with faults_named(f"ROS, {TRANSFORMS}"):
        if odd := frames.add(message):
            raise InputError(odd[0])


def scans_in(
    kind: str, message: Any, base: str, frames: Frames, settings: BagConfig
) -> list[Heard]:
    """Return the scans in a message of echoes, in order of time; beams may have delays.

    `kind`: the name of its type, with ``/msg/``; `base`: the vehicle's frame; `frames`: static
    transforms to the sensors. Rows have no labels if the whole message has none.
    """
    rows = TopicEchoes(kind)
    with faults_named(f"ROS, {kind}"):
        rows.add(Message(kind, 1, 0.0, message), settings)
    mounts = mounts_of(_HERE, kind, rows, frames, bare(base), settings)
    column = rows_of(f"ROS, {kind}", rows, mounts, Counter()).column
    time = column.pop("time")
    if (column["landmark"] == UNLABELLED).all():
        del column["landmark"]
    return [
        Heard(float(at), {name: values[time == at] for name, values in column.items()})
        for at in np.unique(time)
    ]
