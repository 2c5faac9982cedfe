"""What messages of ROS say: poses and velocities of the vehicle, and echoes of landmarks.

Definitions: `marine_acoustic_msgs` (github.com/apl-ocean-engineering/marine_msgs, BSD 3-Clause) and
`mrpt_msgs` (github.com/mrpt-ros-pkg/mrpt_msgs, BSD); all others are ROS's own common interfaces.
Echoes are given as points in the frame of their sensor, x ahead, y to the left.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipistrelle.config import InputError
from pipistrelle.detection.scans import UNLABELLED

ODOMETRY = "nav_msgs/msg/Odometry"
_PINGS = "marine_acoustic_msgs/msg/"
DEFINITIONS = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
        f"{_PINGS}PingInfo": "float32 frequency\nfloat32 sound_speed\n"
        "float32[] tx_beamwidths\nfloat32[] rx_beamwidths\n",
        f"{_PINGS}DetectionFlag": "uint8 flag\n",
        f"{_PINGS}SonarDetections": "std_msgs/Header header\nPingInfo ping_info\n"
        "DetectionFlag[] flags\nfloat32[] two_way_travel_times\nfloat32[] tx_delays\n"
        "float32[] intensities\nfloat32[] tx_angles\nfloat32[] rx_angles\n",
        f"{_PINGS}SonarRanges": "std_msgs/Header header\nPingInfo ping_info\n"
        "DetectionFlag[] flags\nfloat32[] transmit_delays\nfloat32[] intensities\n"
        "geometry_msgs/Vector3[] beam_unit_vec\nfloat32[] ranges\n",
        "mrpt_msgs/msg/SingleRangeBearingObservation": "float64 range\nfloat64 yaw\n"
        "float64 pitch\nint32 id\n",
        "mrpt_msgs/msg/ObservationRangeBearing": "std_msgs/Header header\n"
        "geometry_msgs/Pose sensor_pose_on_robot\nfloat64 min_sensor_distance\n"
        "float64 max_sensor_distance\nfloat64 sensor_std_range\nfloat64 sensor_std_yaw\n"
        "float64 sensor_std_pitch\nSingleRangeBearingObservation[] sensed_data\n",
    }
)
"""Types that rosbags does not know, for bags that do not define them."""

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]
"""Rotation and translation [m] from a frame to another."""
_ROUNDING = 0.01
"""How far the length of a quaternion may be from 1: components of 8 bits, the coarsest of drivers,
are each off by half of 1/127 and the length by up to 1/127."""
_UNIFORM = 12.0**-0.5
"""Standard deviation of what lies anywhere within a width, as a share of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Echoes:
    """The echoes of one message."""

    point: Float[np.ndarray, "n 3"]
    """Seen from the sensor [m]."""
    delay: Float[np.ndarray, " n"]
    """How much later than the header says each was sent [s]."""
    range_std: Float[np.ndarray, " n"]
    """[m]; NaN where the message does not say it."""
    bearing_std: Float[np.ndarray, " n"]
    """[rad]; NaN where the message does not say it."""
    landmark: Int[np.ndarray, " n"]
    mount: Pose | None = None
    """Where the sensor is on the vehicle, if the message says it."""
    ignored: Counter[str] = field(default_factory=Counter)
    """Echoes left out, by reason."""


class TurnError(InputError):
    """The orientation of a message is none, or that of a vehicle upside down."""


def yaw_of(q: Any) -> float:
    """Return the heading of a quaternion, of length 1 but for rounding [rad]."""
    x, y, z, w = q.x, q.y, q.z, q.w
    if not abs((length := math.hypot(x, y, z, w)) - 1.0) <= _ROUNDING:
        raise TurnError(
            f"found the quaternion ({x:g}, {y:g}, {z:g}, {w:g}) of length {length:.3g}, expected "
            "the length 1; fill in x, y, z and w"
        )
    return float(np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))


def rotation_of(q: Any) -> Float[np.ndarray, "3 3"]:
    """Return the matrix of a quaternion."""
    yaw_of(q)
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / np.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def pose_of(place: Any, q: Any) -> Pose:
    """Return a pose of a place and a quaternion."""
    return rotation_of(q), np.array([place.x, place.y, place.z], dtype=float)


def _planar(place: Any, q: Any) -> tuple[float, float, float]:
    """Return x, y and heading of a vehicle that is not upside down."""
    heading = yaw_of(q)
    if q.x * q.x + q.y * q.y > q.z * q.z + q.w * q.w:
        raise TurnError(
            f"found the quaternion ({q.x:g}, {q.y:g}, {q.z:g}, {q.w:g}), a vehicle upside down, "
            "expected its z upwards; is the order x, y, z, w, and the frame's z up?"
        )
    return place.x, place.y, heading


POSES: dict[str, Callable[[Any], tuple[float, float, float]]] = {
    ODOMETRY: lambda m: _planar(m.pose.pose.position, m.pose.pose.orientation),
    "geometry_msgs/msg/PoseStamped": lambda m: _planar(m.pose.position, m.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _planar(
        m.pose.pose.position, m.pose.pose.orientation
    ),
    "geometry_msgs/msg/TransformStamped": lambda m: _planar(
        m.transform.translation, m.transform.rotation
    ),
}
"""Types that tell where the vehicle is; each gives x, y [m] and heading [rad]."""


def _sonar_detections(message: Any, speed_of_sound: float | None) -> Echoes:
    """Read travel times by angles, ahead and to starboard."""
    time = np.asarray(message.two_way_travel_times, dtype=float)
    speed = message.ping_info.sound_speed or speed_of_sound
    if not speed:
        raise InputError("found no speed of sound, expected one; add --bag.speed-of-sound")
    across = _per_beam("rx_angles", message.rx_angles, time.size)
    along = _per_beam("tx_angles", message.tx_angles, time.size, 0.0)
    level, up = np.cos(along), np.sin(along)
    ways = np.column_stack([level * np.cos(across), -level * np.sin(across), up])
    distance = 0.5 * speed * time
    return _beams(message, ways, distance, message.tx_delays)


def _sonar_ranges(message: Any, _: float | None) -> Echoes:
    """Read ranges along unit vectors."""
    distance = np.asarray(message.ranges, dtype=float)
    vectors = [(v.x, v.y, v.z) for v in message.beam_unit_vec]
    if len(vectors) != distance.size:
        raise InputError(f"found {len(vectors)} unit vectors, expected one for each range")
    ways = np.array(vectors, dtype=float).reshape(-1, 3)
    return _beams(message, ways, distance, message.transmit_delays)


def _beams(
    message: Any,
    ways: Float[np.ndarray, "n 3"],
    distance: Float[np.ndarray, " n"],
    delays: Any,
) -> Echoes:
    """Return the echoes of beams that are not flagged and heard one: anywhere in their width."""
    size = distance.size
    flags = np.array([flag.flag for flag in message.flags])
    flagged = _per_beam("flags", flags, size, 0.0) != 0.0
    heard = np.isfinite(distance) & (distance > 0.0)
    width = _per_beam("rx_beamwidths", message.ping_info.rx_beamwidths, size)
    ignored = Counter(flagged=int(flagged.sum()), nothing_heard=int((~heard & ~flagged).sum()))
    kept = heard & ~flagged
    return _echoes(
        (ways * np.where(kept, distance, 0.0)[:, None])[kept],
        delay=_per_beam("delays", delays, size, 0.0)[kept],
        bearing_std=np.where(width > 0.0, _UNIFORM * width, np.nan)[kept],
        ignored=ignored,
    )


def _range(message: Any, _: float | None) -> Echoes:
    """Read a range in a cone: a bearing straight ahead, uniform over its width.

    Nothing is heard at infinity, nearer than the nearest range, and, as Gazebo and many drivers
    write it, at the farthest range itself, which single precision may round down by a last place.
    """
    distance, near, far = float(message.range), float(message.min_range), float(message.max_range)
    below = float(np.nextafter(np.float32(far), np.float32(0.0)))
    heard = int(math.isfinite(distance) and max(near, 0.0) <= distance < below and distance > 0.0)
    width, variance = float(message.field_of_view), float(getattr(message, "variance", 0.0))
    return _echoes(
        np.array([[distance, 0.0, 0.0]])[:heard],
        bearing_std=np.array([_UNIFORM * width if width > 0.0 else np.nan])[:heard],
        range_std=np.array([variance**0.5 if variance > 0.0 else np.nan])[:heard],
        ignored=Counter(nothing_heard=1 - heard),
    )


def _range_bearing(message: Any, _: float | None) -> Echoes:
    """Read ranges and angles with labels, by a sensor whose place the message says."""
    rows = [(one.range, one.yaw, one.pitch, one.id) for one in message.sensed_data]
    distance, yaw, pitch, label = np.array(rows, dtype=float).reshape(-1, 4).T
    if not (distance > 0.0).all():
        raise InputError(f"found the range {distance[~(distance > 0.0)][0]:g}, expected above 0")
    level = distance * np.cos(pitch)
    points = [level * np.cos(yaw), level * np.sin(yaw), -distance * np.sin(pitch)]
    stated = message.sensor_std_range, message.sensor_std_yaw
    range_std, bearing_std = (np.full(len(rows), s if s > 0.0 else np.nan) for s in stated)
    pose = message.sensor_pose_on_robot
    q = pose.orientation
    turned = rotation_of(q) if any((q.x, q.y, q.z, q.w)) else np.eye(3)
    place = np.array([pose.position.x, pose.position.y, pose.position.z], dtype=float)
    return _echoes(
        np.column_stack(points),
        range_std=range_std,
        bearing_std=bearing_std,
        landmark=label.astype(np.int64),
        mount=(turned, place),
    )


ECHOES: dict[str, Callable[[Any, float | None], Echoes]] = {
    f"{_PINGS}SonarDetections": _sonar_detections,
    f"{_PINGS}SonarRanges": _sonar_ranges,
    "sensor_msgs/msg/Range": _range,
    "mrpt_msgs/msg/ObservationRangeBearing": _range_bearing,
}
"""Types that tell echoes; each is read with the speed of sound that a ping without one has."""
ANGLES = f"{_PINGS}SonarDetections"
"""The type whose angles are about its sensor's axis, positive to starboard."""
CONES = "sensor_msgs/msg/Range"


def _per_beam(
    name: str, values: Any, size: int, default: float = np.nan
) -> Float[np.ndarray, " n"]:
    """Return a number for each beam: of one for all, of each, or the default where none is said."""
    numbers = np.asarray(values, dtype=float)
    if numbers.size not in (0, 1, size):
        raise InputError(f"found {numbers.size} {name}, expected one for each of {size} beams")
    if numbers.size == size:
        return numbers
    return np.full(size, numbers[0] if numbers.size else default)


def _echoes(point: Float[np.ndarray, "n 3"], **said: Any) -> Echoes:
    """Return echoes; refuse places that are no numbers, and fill in what is not said."""
    nothing = np.full(len(point), np.nan)
    given: dict[str, Any] = {
        "delay": np.zeros(len(point)),
        "range_std": nothing,
        "bearing_std": nothing,
    }
    given |= {"landmark": np.full(len(point), UNLABELLED)} | said
    wrong: Bool[np.ndarray, " n"] = ~np.isfinite(np.column_stack([point, given["delay"]]))
    if wrong.any():
        raise InputError("found an angle or a delay that is no number, expected finite ones")
    return Echoes(point=point, **given)
