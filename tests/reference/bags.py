"""ROS 1 and 2 bags, written by rosbags from messages given as dictionaries."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipistrelle.detection.logs.bag_messages import DEFINITIONS
from pipistrelle.detection.logs.poses import relative_motions
from pipistrelle.detection.scans import rows_of
from pipistrelle.estimation.motion import Motion, motion_step

ODOMETRY = "nav_msgs/msg/Odometry"
RANGE = "sensor_msgs/msg/Range"
DETECTIONS = "marine_acoustic_msgs/msg/SonarDetections"
RANGES = "marine_acoustic_msgs/msg/SonarRanges"
LABELLED = "mrpt_msgs/msg/ObservationRangeBearing"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ENDINGS = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4


def store_of(first=False):
    """Return the message types of ROS 1 or 2, with Pipistrelle's additional ones."""
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def made(store, kind, values):
    """Create a message from a dictionary; missing fields are zero."""
    fields = store.fielddefs[kind][1]
    return store.types[kind](
        **{name: _field(store, description, values.get(name)) for name, description in fields}
    )


def _field(store, description, value):
    node, inner = int(description[0]), description[1]
    if node == NAME:
        return made(store, inner, value or {})
    if node == BASE:
        return value if value is not None else "" if inner[0] == "string" else 0
    (node_of_one, one), size = inner
    if int(node_of_one) == NAME:
        return [made(store, one, each) for each in value or ()]
    if one[0] == "string":
        return list(value or [""] * size)
    numbers = np.zeros(size if node == ARRAY else 0) if value is None else value
    return np.asarray(numbers, dtype=one[0])


def header(time, frame=""):
    """Return the header of a message."""
    whole = int(np.floor(time))
    return {"stamp": {"sec": whole, "nanosec": round((time - whole) * 1e9)}, "frame_id": frame}


def quaternion(heading):
    """Convert a heading to a quaternion."""
    return {"z": np.sin(heading / 2.0), "w": np.cos(heading / 2.0)}


def odometry(time, x, y, heading, velocity=0.0, rate=0.0, covariance=None, aside=0.0):
    """Return an odometry message with pose and velocities."""
    pose = {"position": {"x": x, "y": y}, "orientation": quaternion(heading)}
    twist = {"twist": {"linear": {"x": velocity, "y": aside}, "angular": {"z": rate}}}
    if covariance is not None:
        twist["covariance"] = covariance
    return {
        "header": header(time, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": pose},
        "twist": twist,
    }


def labelled(time, rows, *, at=(0.0, 0.0, 0.0), stds=(0.0, 0.0)):
    """Return a message of labels, bearings and ranges from a sensor at a pose on the vehicle."""
    pose = {"position": {"x": at[0], "y": at[1]}, "orientation": quaternion(at[2])}
    return {
        "header": header(time, "base_link"),
        "sensor_pose_on_robot": pose,
        "sensor_std_range": stds[0],
        "sensor_std_yaw": stds[1],
        "sensed_data": [{"id": label, "yaw": yaw, "range": far} for label, yaw, far in rows],
    }


def static(parent, child, x, y, heading=0.0, q=None):
    """Return a message with a constant transform."""
    transform = {"translation": {"x": x, "y": y}, "rotation": q or quaternion(heading)}
    one = {"header": header(0.0, parent), "child_frame_id": child, "transform": transform}
    return {"transforms": [one]}


def write_bag(path, messages, *, late=0.0, definitions=True, compression=None):
    """Write a bag: a .bag, .mcap or .db3 file, or a folder with the storage that it names.

    `messages` are tuples of topic, type, time and fields, received `late` [s] later. `definitions`
    is whether the bag contains message definitions, or a dict of texts for topics with other ones.
    """
    path = Path(path)
    if path.suffix == ".bag":
        return _write_first(path, messages, late, compression)
    store, alone = store_of(), path.suffix in (".mcap", ".db3")
    folder = path.with_suffix(".folder") if alone else path
    kind = path.suffix[1:] if alone else "mcap"
    writer = Writer2(folder, version=9, storage_plugin=ENDINGS[kind])
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        known = {}
        for topic, name, time, told in messages:
            if topic not in known:
                said = {"typestore": store} if definitions else {"msgdef": "", "rihs01": "RIHS01_0"}
                if isinstance(definitions, dict) and topic in definitions:
                    said = {"msgdef": definitions[topic], "rihs01": "RIHS01_0"}
                known[topic] = writer.add_connection(topic, name, **said)
            data = store.serialize_cdr(made(store, name, told), name)
            writer.write(known[topic], round((time + late) * 1e9), data)
    if alone:
        next(folder.glob(f"*{path.suffix}")).rename(path)
        for left in folder.iterdir():
            left.unlink()
        folder.rmdir()
    return path


def _write_first(path, messages, late, compression):
    store, known = store_of(first=True), {}
    writer = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        for topic, name, time, told in messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=store)
            data = store.serialize_ros1(made(store, name, told), name)
            writer.write(known[topic], round((time + late) * 1e9), data)
    return path


def of_log(log, *, topic="/odom", poses=None):
    """Convert a log to messages: its poses or controls, and its measurements."""
    told = []
    for i, time in enumerate(log.time):
        x, y, heading = (0.0, 0.0, 0.0) if poses is None else poses[i]
        velocity, rate = log.controls[i] if poses is None and i < len(log.controls) else (0.0, 0.0)
        told.append((topic, ODOMETRY, time, odometry(time, x, y, heading, velocity, rate)))
    for scan in log.scans:
        rows = list(zip(scan.landmark.tolist(), scan.bearing, scan.range, strict=True))
        told.append(("/seen", LABELLED, scan.time, labelled(scan.time, rows)))
    return sorted(told, key=lambda one: one[2])


def with_ranges(log):
    """Remove measurements without a range from a log, as `LABELLED` cannot represent them."""
    scans = [rows_of(scan, np.isfinite(scan.range)) for scan in log.scans]
    return replace(log, scans=tuple(scan for scan in scans if scan.landmark.size), gate=None)


def as_poses(log, stds):
    """Convert a log's odometry to noise-free poses from its controls; return both."""
    motion = Motion(model=log.motion, control_std=log.control_std, wheelbase=log.wheelbase)
    poses = [np.zeros(3)]
    for controls, dt in zip(log.controls, log.dt, strict=True):
        poses.append(motion_step(motion, poses[-1], controls, dt))
    poses = np.array(poses)
    steps = relative_motions(poses)
    return replace(log, motion="poses", controls=steps, control_std=stds), poses
