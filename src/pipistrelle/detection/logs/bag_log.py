"""The log of a ROS bag: rows of odometry and of echoes, made from its messages.

Messages of the chosen topics are read one at a time, so memory holds only the rows. The log's
`notes` list the choice of topics and the conversions. The functions from `odometry_use` on convert
live messages, one at a time, to the arguments of `Slam.move` and `Slam.hear`.

The poses of sensors on the vehicle come from static transforms. A transform converts points of the
child's frame to the parent's (tf2_msgs); the frames form a tree.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from pipistrelle.config import AssociationConfig, BagConfig, InputError
from pipistrelle.detection.logs.bag import Bag, Message, Topic, faults_named, opened
from pipistrelle.detection.logs.bag_messages import (
    ANGLES,
    CONES,
    ECHOES,
    ODOMETRY,
    POSES,
    Echoes,
    Pose,
    TurnError,
    pose_of,
)
from pipistrelle.detection.logs.poses import MOTION_COVARIANCE, POSE, motions_between, path_of
from pipistrelle.detection.logs.recording import Log, assemble
from pipistrelle.detection.logs.vehicle import NOISY
from pipistrelle.detection.scans import UNLABELLED, WIDEST
from pipistrelle.refusals import refusal
from pipistrelle.text_tables import Table, check_columns, place_of, rows_kept

TRANSFORMS = "/tf_static"
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"
"""The topic of the static transforms, and the type of its messages."""


class Frames:
    """The coordinate frames of a bag, linked by static transforms."""

    def __init__(self) -> None:
        self._beside: dict[str, dict[str, Pose]] = {}

    def add(self, message: Any) -> list[str]:
        """Add a message's transforms; return an error text for each invalid rotation."""
        odd = []
        for one in message.transforms:
            parent, child = bare(one.header.frame_id), bare(one.child_frame_id)
            try:
                pose = pose_of(one.transform.translation, one.transform.rotation)
            except TurnError as error:
                odd.append(f"from {parent!r} to {child!r}: {error}")
                continue
            if not np.isfinite(pose[1]).all():
                raise ValueError(f"the translation {pose[1].tolist()}")
            self._beside.setdefault(parent, {})[child] = pose
            self._beside.setdefault(child, {})[parent] = inverse(pose)
        return odd

    def __bool__(self) -> bool:
        """Return whether any transform is known."""
        return bool(self._beside)

    def pose(self, frame: str, base: str) -> Pose | None:
        """Return the transform from a frame to `base`; None if they are not connected."""
        found = {base: planar(0.0, 0.0, 0.0)}
        waiting = [base]
        while waiting and frame not in found:
            here = waiting.pop()
            for there, step in self._beside.get(here, {}).items():
                if there not in found:
                    found[there] = after(found[here], step)
                    waiting.append(there)
        return found.get(frame)


def bare(frame: str) -> str:
    """Return a frame's name without the leading slash of ROS 1."""
    return frame.removeprefix("/")


def after(outer: Pose, inner: Pose) -> Pose:
    """Compose two transforms: the inner is applied first."""
    return outer[0] @ inner[0], outer[0] @ inner[1] + outer[1]


def inverse(pose: Pose) -> Pose:
    """Return the inverse of a rigid transform."""
    return pose[0].T, -pose[0].T @ pose[1]


def planar(x: float, y: float, heading: float) -> Pose:
    """Return the three-dimensional transform of a planar pose."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0])


def along_axis(points: Float[np.ndarray, "n 3"], mount: Pose) -> Float[np.ndarray, "n 3"]:
    """Convert points about a sonar's axis, x or z, to the axes of the sonar's frame.

    Profiling sonars have z along the axis and y to starboard (ProjectedSonarImage of
    marine_acoustic_msgs); others have x ahead. The more level of the two is the axis.
    """
    (_, _, x), (_, _, z) = mount[0][:, 0], mount[0][:, 2]
    return points if abs(x) <= abs(z) else points[:, ::-1] * [1.0, -1.0, 1.0]


def odometry_of(bag: Bag, settings: BagConfig) -> str:
    """Return the topic of the odometry: the topic in the settings, or else the only candidate."""
    if settings.odometry is not None:
        return bag.checked(settings.odometry, [ODOMETRY], "--bag.odometry")
    there = _odometries(bag.topics.values(), settings)
    if len(there) == 1:
        return there[0]
    found = f"several topics of odometry: {', '.join(there)}" if there else "no odometry"
    fix = "name it, --bag.odometry TOPIC, and the truth if there is one, --truth TOPIC"
    fix = fix if there else "--topics lists what there is"
    raise refusal(bag.path, found, f"one topic of {ODOMETRY}", fix)


def echoes_of(bag: Bag, settings: BagConfig) -> list[str]:
    """Return the topics of the echoes: the topics in the settings, or all of a known type."""
    if settings.echoes:
        names = dict.fromkeys(settings.echoes)
        return [bag.checked(name, ECHOES, "--bag.echoes") for name in names]
    names = [topic.name for topic in bag.topics.values() if topic.type in ECHOES]
    if not names:
        expected = f"a topic of {', '.join(ECHOES)}"
        raise refusal(bag.path, "no echoes", expected, "--topics lists what there is")
    return names


def transforms_of(bag: Bag) -> list[str]:
    """Return a list of the topic of static transforms, empty if the bag lacks it."""
    there = bag.topics.get(TRANSFORMS)
    if there is not None and there.type != TRANSFORMS_TYPE:
        where, fix = f"{bag.path}, topic {TRANSFORMS}", "leave the topic out of the bag"
        raise refusal(where, f"the type {there.type}", TRANSFORMS_TYPE, fix)
    return [] if there is None else [TRANSFORMS]


def roles(topics: Iterable[Topic], settings: BagConfig) -> dict[str, str]:
    """Return the role that each topic would have, such as "odometry"; empty for an unused topic."""
    topics = list(topics)
    odometries = [settings.odometry] if settings.odometry else _odometries(topics, settings)
    echoes = settings.echoes or [topic.name for topic in topics if topic.type in ECHOES]

    role = {one.name: "truth, if --truth names it" * (one.type in POSES) for one in topics}
    several = " or truth, if --bag.odometry or --truth names it" * (len(odometries) > 1)
    role |= {TRANSFORMS: "transforms"} | dict.fromkeys(echoes, "echoes")
    role |= dict.fromkeys(odometries, f"odometry{several}")
    if settings.truth:
        role[settings.truth] = "truth"
    return {one.name: role[one.name] for one in topics}


def _odometries(topics: Iterable[Topic], settings: BagConfig) -> list[str]:
    """List the names of the topics that may be the odometry."""
    return [one.name for one in topics if one.type == ODOMETRY and one.name != settings.truth]


_TWIST = ("velocity", "angular_rate")
PLANE = (0, 1, 5)
"""Indices of x, y and the rotation about z among the six coordinates of a ROS pose."""
_UNKNOWN = 100.0
"""Variance of a velocity that means unknown [m^2/s^2], [rad^2/s^2]."""
_STEEP = 0.1
"""Smallest horizontal component of an echo's direction for a bearing to be defined."""
_LATE = 1e-3
"""Smallest difference between clocks that is reported [s]."""
BEGUN = 1.0
"""Latest first pose of a clock that begins with the drive [s]."""
_ALIKE = 0.2
"""Share of a topic's messages that may hold the same range without a warning; topics of fewer than
25 messages are not checked."""


@dataclass(slots=True)
class Remarks:
    """Notes, warnings and counts of left-out messages for the user; see `Log`."""

    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)

    def leave_out(self, topic: str, reason: str, number: int, words: str) -> None:
        """Count messages of a topic that are left out, and add a warning."""
        self.ignored[reason] += number
        self.doubts.append(f"{topic}: {number} left out: {words}")


@dataclass(slots=True)
class TopicPoses:
    """Poses collected from the messages of a topic, with delays of reception."""

    path: Path
    topic: str
    rows: list[tuple[float, ...]] = field(default_factory=list)
    """Number of the message, time [s], x, y [m], heading [rad], then further columns."""
    lag: list[float] = field(default_factory=list)
    """Delay of each message's reception after its time [s]."""
    odd: list[str] = field(default_factory=list)
    """A line for each message with an invalid orientation."""

    def add(self, message: Message, settings: BagConfig, read: Callable[..., Any]) -> None:
        """Convert a message to a row of time and pose by `read`, and store it."""
        try:
            row = read(message, settings)
        except TurnError as error:
            self.odd.append(f"message {message.number}: {error}")
            return
        self.rows.append((message.number, *row))
        self.lag.append(message.received - row[0])

    def sound(self, remarks: Remarks) -> list[tuple[float, ...]]:
        """Return the valid rows of poses; raise if most messages of the topic are invalid."""
        where, count = f"{self.path}, topic {self.topic}", len(self.rows) + len(self.odd)
        if 2 * len(self.odd) > count:
            some = f"{len(self.odd)} of {count} messages are like it"
            raise InputError(f"{where}, {self.odd[0]}; {some}")
        if self.odd:
            remarks.leave_out(self.topic, "odd_orientation", len(self.odd), self.odd[0])
        stamps = [row[1] for row in self.rows]
        running = [stamp for stamp in stamps if stamp != 0.0]
        began = min(running) if running else math.inf if len(stamps) > 1 else 0.0
        kept = _kept(where, self.topic, stamps, began, remarks)
        return [row for row, keep in zip(self.rows, kept, strict=True) if keep]


def _kept(
    where: str, topic: str, stamps: list[float], began: float, remarks: Remarks
) -> list[bool]:
    """Return whether each stamp is of a running clock; `began` [s]: time of the first pose.

    Messages that are sent before a simulation publishes its clock have the stamp 0. If the clock
    begins with the drive, at less than `BEGUN`, 0 is a valid time.
    """
    kept = [stamp != 0.0 or began <= BEGUN for stamp in stamps]
    if (early := kept.count(False)) == len(stamps) and early:
        found, expected = f"the stamp 0 in all {early} messages", "times of a clock"
        raise refusal(where, found, expected, "--bag.stamps received takes the times of reception")
    if early:
        words = f"their stamp is 0, from before the clock began; others are {began:.15g} s or later"
        remarks.leave_out(topic, "before_clock", early, words)
    return kept


@dataclass(slots=True)
class TopicEchoes:
    """Echoes collected from the messages of a topic, with times and delays of reception."""

    type: str
    time: list[float] = field(default_factory=list)
    """Time of each message [s]."""
    lag: list[float] = field(default_factory=list)
    """Delay of each message's reception after its time [s]."""
    number: list[int] = field(default_factory=list)
    frame: list[str] = field(default_factory=list)
    echoes: list[Echoes] = field(default_factory=list)

    def add(self, message: Message, settings: BagConfig) -> None:
        """Convert a message's echoes, and store them with its time and coordinate frame."""
        content = message.content
        time = _time(message, settings)
        with np.errstate(all="ignore"):  # invalid numbers are left out, or raise later
            echoes = ECHOES[self.type](content, settings.speed_of_sound)
        self.time.append(time)
        self.lag.append(message.received - time)
        self.number.append(message.number)
        self.frame.append(bare(content.header.frame_id))
        self.echoes.append(echoes)

    def begin(self, path: Path, topic: str, began: float, remarks: Remarks) -> None:
        """Remove the echoes of messages with the stamp 0, from before the clock began."""
        kept = _kept(f"{path}, topic {topic}", topic, self.time, began, remarks)
        columns: tuple[list[Any], ...] = self.time, self.lag, self.number, self.frame, self.echoes
        for rows in columns:
            rows[:] = [row for row, keep in zip(rows, kept, strict=True) if keep]


def read_bag(
    path: Path, settings: BagConfig, span: tuple[float, float] = (-math.inf, math.inf)
) -> Log:
    """Read the log of a ROS bag: odometry and echoes, from the first pose of the odometry.

    `span` [s]: times to which the log is cut.
    """
    frames, remarks, base, odd = Frames(), Remarks(), "", []
    with opened(path) as bag:
        odometry = odometry_of(bag, settings)
        driven = TopicPoses(path, odometry)
        heard = {name: TopicEchoes(bag.topics[name].type) for name in echoes_of(bag, settings)}
        for message in bag.messages(dict.fromkeys([odometry, *transforms_of(bag), *heard])):
            with faults_named(f"{path}, topic {message.topic}, message {message.number}"):
                if message.topic == odometry:
                    driven.add(message, settings, step_row)
                    base = base or bare(message.content.child_frame_id)
                elif message.topic in heard:
                    heard[message.topic].add(message, settings)
                else:
                    odd += frames.add(message.content)
    if odd and not frames:
        raise InputError(f"{path}, topic {TRANSFORMS}, {odd[0]}")
    if odd:
        remarks.leave_out(TRANSFORMS, "odd_orientation", len(odd), odd[0])
    table = odometry_table(path, odometry, sound := driven.sound(remarks), settings, remarks)
    remarks.notes += _clock(odometry, driven.lag, settings)
    measured = []
    for topic, rows in heard.items():
        rows.begin(path, topic, table.column["time"][0], remarks)
        mounts = mounts_of(path, topic, rows, frames, base, settings)
        measured.append(rows_of(f"{path}, topic {topic}", rows, mounts, remarks.ignored))
        remarks.notes += _clock(topic, rows.lag, settings)
        remarks.notes += _converted(topic, rows, mounts, base)
        remarks.doubts += _alike(topic, rows)
    rows = _merged(f"{path}, topic {', '.join(heard)}", measured)
    widest = max((std for std in rows.column["bearing_std"] if std <= WIDEST), default=0.0)
    motion = "unicycle" if settings.motion == "twist" else "poses"
    same = "initial_pose_std", "range_std", "bearing_std", "range_bounds"
    return assemble(
        table,
        rows,
        step=settings.step or None,
        time_offset=settings.time_offset,
        span=span,
        ignored_rows=dict(remarks.ignored),
        name=path.resolve().name,
        initial_pose=tuple(sound[0][2:5]),
        association={"max_angle_std": widest} if widest > AssociationConfig().max_angle_std else {},
        notes=tuple(remarks.notes),
        doubts=tuple(remarks.doubts),
        motion=motion,
        control_std=tuple(getattr(settings, f"{name}_std") for name in NOISY[motion]),
        **{name: getattr(settings, name) for name in same},
    )


def read_poses(
    path: Path, settings: BagConfig, remarks: Remarks | None = None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]] | None:
    """Read a bag's true poses as `path_of`; None without a topic; `remarks` receives warnings."""
    if settings.truth is None:
        return None
    with opened(path) as bag:
        topic = bag.checked(settings.truth, POSES, "--truth")
        pose, true = POSES[bag.topics[topic].type], TopicPoses(path, topic)
        for message in bag.messages([topic]):
            with faults_named(f"{path}, topic {topic}, message {message.number}"):
                true.add(message, settings, lambda m, s: (_time(m, s), *pose(m.content)))
    rows = true.sound(remarks or Remarks())
    return path_of(_table(f"{path}, topic {topic}", ("time", *POSE), rows))


def _time(message: Message, settings: BagConfig) -> float:
    """Return a message's time [s], of its header or, by the settings, of its reception."""
    if settings.stamps == "received":
        return message.received
    stamp = message.content.header.stamp
    return stamp.sec + stamp.nanosec / 1e9


def step_row(message: Message, settings: BagConfig) -> tuple[float, ...]:
    """Return time, pose, velocities and velocity covariance of an odometry message as a row."""
    content = message.content
    twist = content.twist.twist
    plane = np.reshape(content.twist.covariance, (6, 6)).astype(float)[np.ix_(PLANE, PLANE)]
    stated = plane[np.triu_indices(3)]
    known = stated[0] > 0.0 and stated[5] > 0.0 and (np.abs(stated) < _UNKNOWN).all()
    pose = POSES["nav_msgs/msg/Odometry"](content)
    velocity = twist.linear.x, twist.linear.y, twist.angular.z
    said = stated.tolist() if known and settings.covariances else [math.nan] * stated.size
    return _time(message, settings), *pose, *velocity, *said


def _table(where: str, columns: tuple[str, ...], rows: list[Any], stated: int = 0) -> Table:
    """Build a table of rows that begin with their message's number; raise if a value is invalid."""
    if not rows:
        raise refusal(where, "no messages", "some", "name another topic; --topics lists them")
    table = _messages(where, columns, np.array(rows, dtype=float))
    column = table.column
    for name in columns[: len(columns) - stated]:
        if (wrong := ~np.isfinite(column[name])).any():
            row = int(np.argmax(wrong))
            found = f"{name} {column[name][row]:g}"
            raise refusal(place_of(table, row), found, "a finite number", "leave the message out")
    check_columns(table)
    return table


def _messages(where: str, names: tuple[str, ...], rows: Float[np.ndarray, "n c"]) -> Table:
    """Build a table of rows that begin with their message's number, without checks."""
    number, *values = rows.T
    column = dict(zip(names, values, strict=True))
    return Table(path=where, line=number.astype(np.int64), unit="message", column=column)


def odometry_table(
    path: Path, topic: str, rows: list[Any], settings: BagConfig, remarks: Remarks
) -> Table:
    """Build the odometry table from message rows: velocities, or poses with covariances."""
    where, steps = f"{path}, topic {topic}", f"in steps of {settings.step:g} s"
    steps = steps if settings.step else "each a step"
    names = ("time", *POSE, "velocity", "sideways", "angular_rate", *MOTION_COVARIANCE)
    table = _table(where, names, rows, stated=len(MOTION_COVARIANCE))
    column = table.column
    if settings.motion == "twist":
        aside = float(np.abs(column["sideways"]).max())
        remarks.notes.append(f"{topic} is the odometry, its velocities as controls {steps}")
        if aside > 0.0:
            odd = f"velocities to the side, up to {aside:.3g} m/s, are left out"
            remarks.doubts.append(f"{topic}: {odd}")
        used: tuple[str, ...] = ("time", *_TWIST)
    else:
        lasted = np.diff(column["time"], prepend=column["time"][0])
        for name in MOTION_COVARIANCE:
            column[name] = column[name] * lasted**2
        known = int(np.isfinite(column[MOTION_COVARIANCE[0]]).sum())
        stated = f"; {known} of {len(lasted)} have the covariance of its twist" * bool(known)
        remarks.notes.append(f"{topic} is the odometry, the motions of its poses {steps}{stated}")
        used = ("time", *POSE, *MOTION_COVARIANCE)
    return replace(table, column={name: column[name] for name in used})


def mounts_of(
    path: Path, topic: str, rows: TopicEchoes, frames: Frames, base: str, settings: BagConfig
) -> dict[str, Pose]:
    """Return the sensor's pose on the vehicle for each coordinate frame of a topic's messages."""
    found: dict[str, Pose] = {}
    for frame, echoes in zip(rows.frame, rows.echoes, strict=True):
        if frame in found:
            continue
        pose = echoes.mount
        if settings.sensor_pose is not None:
            pose = planar(*settings.sensor_pose)
        elif pose is None and frame in ("", base):
            pose = planar(0.0, 0.0, 0.0)
        elif pose is None:
            pose = frames.pose(frame, base)
        if pose is None:
            what = f"the frame {frame!r}, which {TRANSFORMS} does not tie to {base!r}"
            fix = "say it: --bag.sensor-pose X Y HEADING [m, m, rad]"
            raise refusal(f"{path}, topic {topic}", what, "where it is on the vehicle", fix)
        found[frame] = pose
    return found


def rows_of(where: str, rows: TopicEchoes, mounts: dict[str, Pose], ignored: Counter[str]) -> Table:
    """Convert the echoes of a topic to bearings and ranges; count left-out echoes in `ignored`."""
    check_columns(_messages(where, ("time",), np.column_stack((rows.number, rows.time))))
    parts = []
    for time, number, frame, echoes in zip(
        rows.time, rows.number, rows.frame, rows.echoes, strict=True
    ):
        mount, point = mounts[frame], echoes.point
        ways = (along_axis(point, mount) if rows.type == ANGLES else point) @ mount[0].T
        flat = np.hypot(*ways[:, :2].T) >= _STEEP * np.linalg.norm(ways, axis=1)
        x, y, _ = (ways[flat] + mount[1]).T
        ignored.update(echoes.ignored, steep=int((~flat).sum()))
        stated = echoes.bearing_std[flat], echoes.range_std[flat]
        label = echoes.landmark[flat].astype(float)
        at = [np.full(x.size, number), time + echoes.delay[flat], label]
        parts.append(np.column_stack([*at, np.arctan2(y, x), np.hypot(x, y), *stated]))
    names = ("time", "landmark", "bearing", "range", "bearing_std", "range_std")
    table = _messages(where, names, np.vstack([np.empty((0, 7)), *parts]))
    stamp = table.column.pop("time")
    if stamp.size:
        check_columns(table)
    table.column["time"] = stamp
    return table


def _merged(where: str, parts: list[Table]) -> Table:
    """Merge the echo tables of all topics into a single table in order of time."""
    names = parts[0].column
    column = {name: np.concatenate([part.column[name] for part in parts]) for name in names}
    line = np.concatenate([part.line for part in parts])
    if not line.size:
        raise refusal(where, "no echo to use", "some", "--topics lists what there is")
    table = Table(path=where, line=line, unit="message", column=column)
    return rows_kept(table, np.argsort(column["time"], kind="stable"))


def _clock(topic: str, lags: list[float], settings: BagConfig) -> list[str]:
    """Return a note if times of reception are used, or differ from the headers' by over 1 ms."""
    if settings.stamps == "received":
        return [f"{topic}: times are those at which messages were received"]
    late = float(np.median(lags)) if lags else 0.0
    when = "after" if late > 0.0 else "before"
    told = f"{topic}: times are of headers; messages were received {abs(late):.3g} s {when} them"
    return [told] if abs(late) > _LATE else []


def _alike(topic: str, rows: TopicEchoes) -> list[str]:
    """Return a warning if many messages of a topic hold the same range."""
    ranges = [np.unique(np.linalg.norm(one.point, axis=1).round(6)) for one in rows.echoes]
    value, count = np.unique(np.concatenate([np.empty(0), *ranges]), return_counts=True)
    if len(ranges) * _ALIKE < 1.0 / _ALIKE or count.max(initial=0) <= _ALIKE * len(ranges):
        return []
    most = int(np.argmax(count))
    return [
        f"{topic}: {count[most]} of {len(ranges)} messages hold the range {value[most]:g} m; is it "
        "how the sensor says that it heard nothing? Then record infinity in its place"
    ]


def _converted(topic: str, rows: TopicEchoes, mounts: dict[str, Pose], base: str) -> list[str]:
    """Return notes of the conversions applied to the echoes of a topic."""
    notes = []
    if rows.type == ANGLES:
        notes.append(f"{topic}: its angles are positive to starboard, bearings to the left")
    delay = max((float(echoes.delay.max(initial=0.0)) for echoes in rows.echoes), default=0.0)
    if delay > 0.0:
        notes.append(f"{topic}: beams are timed by their delays, up to {delay:.3g} s")
    if rows.type == CONES:
        notes.append(f"{topic}: a cone is a bearing, anywhere in its width (std width / sqrt 12)")
    for frame, (turned, place) in mounts.items():
        if np.any(place) or not np.array_equal(turned, np.eye(3)):
            x, y, z = place
            toward = math.atan2(turned[1, 0], turned[0, 0])
            notes.append(
                f"{topic}: {frame or 'its sensor'} is at ({x:.3g}, {y:.3g}, {z:.3g}) m and "
                f"{toward:.3g} rad on {base or 'the vehicle'}"
            )
    return notes


_LIVE = Path("ROS")


def odometry_use(model: str) -> Literal["poses", "twist"]:
    """Return whether a motion model uses the "poses" or the "twist" of odometry messages."""
    if model in ("poses", "unicycle"):
        return "poses" if model == "poses" else "twist"
    expected = "'poses' or 'unicycle', which nav_msgs/Odometry tells"
    fix = "say how surely it knows its poses"
    raise refusal("the vehicle, key 'motion'", repr(model), expected, fix)


def stamp_and_pose(message: Any) -> tuple[float, tuple[float, float, float]]:
    """Return time [s] and pose [m, m, rad] of a ``nav_msgs/Odometry``; raise if it is invalid."""
    with faults_named("ROS, odometry"):
        row = step_row(Message("odometry", 1, 0.0, message), BagConfig())
    odometry_table(_LIVE, "odometry", [(1, *row)], BagConfig(), Remarks())
    time, x, y, heading, *_ = row
    return time, (x, y, heading)


def clock_began(before: Any, now: Any) -> bool:
    """Return whether a clock began between two messages: the first has the stamp 0."""
    times = [one.header.stamp.sec + one.header.stamp.nanosec / 1e9 for one in (before, now)]
    return times[0] == 0.0 and times[1] > BEGUN


def step_between(
    before: Any, now: Any, settings: BagConfig
) -> tuple[Float[np.ndarray, "1 c"], float]:
    """Return the controls between two ``nav_msgs/Odometry``, and the time of the second [s].

    With `settings.motion` "poses" the motion between their poses, else the velocities of the first.
    """
    with faults_named("ROS, odometry"):
        messages = [Message("odometry", n, 0.0, one) for n, one in enumerate((before, now), 1)]
        rows = [(one.number, *step_row(one, settings)) for one in messages]
    if not rows[1][1] > rows[0][1]:
        found, expected = f"the time {rows[1][1]} s", f"one after {rows[0][1]} s"
        raise refusal("ROS, odometry", found, expected, "leave out what comes late or twice")
    table = odometry_table(_LIVE, "odometry", rows, settings, Remarks())
    time, *columns = table.column.values()
    if settings.motion == "twist":
        return np.column_stack(columns)[:1], float(time[1])
    return motions_between(table, time), float(time[1])


def learn_transforms(frames: Frames, message: Any) -> None:
    """Add the static transforms of a ``tf2_msgs/TFMessage`` to the known frames.

    Raises if a rotation is invalid, after the other transforms have been added.
    """
    with faults_named(f"ROS, {TRANSFORMS}"):
        if odd := frames.add(message):
            raise InputError(odd[0])


def scans_in(
    kind: str, message: Any, base: str, frames: Frames, settings: BagConfig
) -> list[tuple[float, dict[str, Float[np.ndarray, " m"]]]]:
    """Return the scans in a message of echoes: time [s] and columns for `Slam.hear` of each.

    `kind`: the name of its type, with ``/msg/``; `base`: the vehicle's frame; `frames`: static
    transforms to the sensors. Rows have no labels if the whole message has none.
    """
    rows = TopicEchoes(kind)
    with faults_named(f"ROS, {kind}"):
        rows.add(Message(kind, 1, 0.0, message), settings)
    mounts = mounts_of(_LIVE, kind, rows, frames, bare(base), settings)
    column = rows_of(f"ROS, {kind}", rows, mounts, Counter()).column
    time = column.pop("time")
    if (column["landmark"] == UNLABELLED).all():
        del column["landmark"]
    return [
        (float(at), {name: values[time == at] for name, values in column.items()})
        for at in np.unique(time)
    ]
