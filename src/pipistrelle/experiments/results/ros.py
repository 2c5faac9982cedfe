"""ROS messages of results: poses, maps and transforms, and a bag of a mission.

A message is a dict of its fields, by the names of ROS's common interfaces, which
``rosidl_runtime_py.set_message_fields`` converts on a robot, and the package rosbags here.
"""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.logs.bag import need_rosbags
from pipistrelle.detection.logs.bag_log import PLANE, after, inverse, planar
from pipistrelle.estimation.catalogue import short_name
from pipistrelle.experiments.results.scores import TrialResult
from pipistrelle.experiments.results.writing import landmark_table
from pipistrelle.refusals import refusal

if TYPE_CHECKING:
    import polars as pl
    from rosbags.typesys.store import Typestore

Fields = dict[str, Any]
BAG = "mission.mcap"
"""Name of the bag in a result folder."""
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
MAP = "visualization_msgs/msg/MarkerArray"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
_NUMBERS = ("weight", "x_m", "y_m", "xx_m2", "xy_m2", "yy_m2")
_COLORS = {"full": {"r": 0.0, "g": 0.6, "b": 0.5}, "partial": {"r": 0.9, "g": 0.6, "b": 0.0}}
_END = 2**31


Message = tuple[str, str, float, Fields]
"""Topic, type, time [s] and fields of a message for a ROS bag."""


def header(time: float, frame: str) -> Fields:
    """Return a ROS message header: the time [s] as a stamp, and the coordinate frame."""
    if not 0.0 <= time < _END:
        found, expected = f"the time {time} s", f"0 s or more, below {_END}, as a stamp can tell"
        raise refusal("a message of ROS", found, expected, "count from another zero")
    sec, nanosec = divmod(_stamp(time), 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def _stamp(time: float) -> int:
    """Convert a time [s] to whole nanoseconds."""
    whole = math.floor(time)
    return whole * 10**9 + round((time - whole) * 1e9)


def pose_fields(
    time: float, frame: str, pose: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]
) -> Fields:
    """Convert a pose in the plane [m, m, rad] and its covariance to a `POSE` message."""
    six = np.zeros((6, 6))
    six[np.ix_(PLANE, PLANE)] = covariance
    x, y, heading = map(float, pose)
    place = {"position": {"x": x, "y": y}, "orientation": _turn(heading)}
    return {"header": header(time, frame), "pose": {"pose": place, "covariance": six.ravel()}}


def correction_fields(
    time: float, frames: tuple[str, str], pose: Sequence[float], odometry: Sequence[float]
) -> Fields:
    """Return the transform from the map's to the odometry's coordinate frame, as a `TRANSFORM`.

    `frames` are the names of the map's and the odometry's frame; `pose` and `odometry` [m, m, rad]
    are the vehicle's poses in them at the same time.
    """
    turned, (x, y, _) = after(planar(*pose), inverse(planar(*odometry)))
    heading = math.atan2(turned[1, 0], turned[0, 0])
    return {
        "header": header(time, frames[0]),
        "child_frame_id": frames[1],
        "transform": {"translation": {"x": float(x), "y": float(y)}, "rotation": _turn(heading)},
    }


def map_fields(time: float, frame: str, table: "pl.DataFrame") -> Fields:
    r"""Convert a map to a `MAP` message, with a marker for each hypothesis of each landmark.

    A marker is the 1-sigma ellipse: its axes' lengths are :math:`2\sigma` along ``scale.x`` and
    ``scale.y``, turned by its orientation. Its name space is the landmark's label, its opacity the
    hypothesis' weight. The first marker deletes all earlier markers. `table` has the columns of
    ``landmarks.parquet``; rows that are not finite are omitted.
    """
    head = header(time, frame)
    markers: list[Fields] = [{"header": head, "action": 3}]  # DELETEALL
    for number, row in enumerate(table.iter_rows(named=True)):
        if not all(math.isfinite(row[name]) for name in _NUMBERS):
            continue
        along, across, angle = _ellipse(row["xx_m2"], row["xy_m2"], row["yy_m2"])
        place = {"x": row["x_m"], "y": row["y_m"]}
        markers.append(
            {
                "header": head,
                "ns": f"landmark {row['landmark']}",
                "id": number,
                "type": 2,  # SPHERE
                "pose": {"position": place, "orientation": _turn(angle)},
                "scale": {"x": 2.0 * along, "y": 2.0 * across, "z": 0.05},
                "color": _COLORS[row["status"]] | {"a": row["weight"]},
                "text": row["status"],
            }
        )
    return {"markers": markers}


def _turn(heading: float) -> Fields:
    """Convert a heading [rad] to the quaternion of a ROS message."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2.0), "w": math.cos(heading / 2.0)}


def _ellipse(xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return a covariance's standard deviations along and across its major axis, and its angle."""
    middle, spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    least = max(middle - spread, 0.0)
    return math.sqrt(middle + spread), math.sqrt(least), 0.5 * math.atan2(2.0 * xy, xx - yy)


def messages_of(trials: Sequence[TrialResult], frame: str = "map") -> Iterator[Message]:
    """Yield the ROS messages of each estimate: its poses, if finite, and its final map."""
    for trial in trials:
        track, name = trial.track, re.sub(r"\W", "_", short_name(trial.filter))
        rows = zip(track.time.tolist(), track.pose.mean, track.pose.covariance, strict=True)
        for time, mean, covariance in rows:
            if np.isfinite(mean).all() and np.isfinite(covariance).all():
                fields = pose_fields(time, frame, mean, covariance)
                yield f"/{trial.strategy}/{name}/pose", POSE, time, fields
        end = float(track.time[-1])
        fields = map_fields(end, frame, landmark_table(track.landmarks, None))
        yield f"/{trial.strategy}/{name}/map", MAP, end, fields


def write_bag(path: Path, messages: Sequence[Message]) -> None:
    """Write ROS messages in order of time into a new .mcap file; map topics are latched."""
    need_rosbags(str(path))
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, known = get_typestore(Stores.ROS2_HUMBLE), {}
    with TemporaryDirectory(dir=path.parent) as room:
        writer = Writer(Path(room) / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
        with writer:
            for topic, kind in dict.fromkeys(message[:2] for message in messages):
                qos = [_latched()] if kind == MAP else []
                how = {"typestore": store, "offered_qos_profiles": qos}
                known[topic] = writer.add_connection(topic, kind, **how)
            for topic, kind, time, fields in sorted(messages, key=lambda message: message[2]):
                data = store.serialize_cdr(_made(store, kind, fields), kind)
                writer.write(known[topic], _stamp(time), data)
        (Path(room) / "bag" / "bag.mcap").replace(path)


def _latched() -> Any:
    """Return the ROS quality of service that repeats the last message for late subscribers."""
    from rosbags import interfaces as its

    never = its.QosTime(0, 0)
    return its.Qos(
        history=its.QosHistory.KEEP_LAST,
        depth=1,
        reliability=its.QosReliability.RELIABLE,
        durability=its.QosDurability.TRANSIENT_LOCAL,
        deadline=never,
        lifespan=never,
        liveliness=its.QosLiveliness.SYSTEM_DEFAULT,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )


def _made(store: "Typestore", kind: str, fields: Fields) -> Any:
    """Create a ROS message from its fields, zero where missing; raise if a field is unknown."""
    types = store.fielddefs[kind][1]
    if unknown := fields.keys() - {name for name, _ in types}:
        raise ValueError(f"{kind}: has no field {', '.join(sorted(unknown))}")
    return store.types[kind](**{name: _field(store, how, fields.get(name)) for name, how in types})


def _field(store: "Typestore", how: Any, value: Any) -> Any:
    """Convert a value to the field of a ROS message; a missing value gives zero or empty."""
    from rosbags.interfaces import Nodetype

    node, inner = how
    if node == Nodetype.NAME:
        return _made(store, inner, value or {})
    if node == Nodetype.BASE:
        return value if value is not None else {"string": "", "bool": False}.get(inner[0], 0)
    (of, one), size = inner
    if of == Nodetype.NAME:
        return [_made(store, one, each) for each in value or ()]
    numbers = np.zeros(size if node == Nodetype.ARRAY else 0) if value is None else value
    return np.asarray(numbers, dtype=one[0])
