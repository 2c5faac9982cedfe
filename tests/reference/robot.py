"""Fake ROS 2 in Python: a node that receives given messages and stores the published ones.

Messages are plain objects with the fields that rosbags knows of each type; an unknown field is an
error, as in `rosidl_runtime_py`.
"""

import sys
from types import MappingProxyType, ModuleType, SimpleNamespace

import numpy as np

from reference.bags import ARRAY, BASE, NAME, SEQUENCE, store_of

STORE = store_of()
PLAIN = {"string": str, "bool": bool, "float32": float, "float64": float}


class Message:
    """A message with all fields zero."""

    def __init__(self, kind):
        self._kind = kind
        for name, (node, inner) in STORE.fielddefs[kind][1]:
            setattr(self, name, _zero(int(node), inner))


def _zero(node, inner):
    if node == NAME:
        return Message(inner)
    if node == BASE:
        return PLAIN.get(inner[0], int)()
    (of, one), size = inner
    if int(of) == NAME:
        return []
    return np.zeros(size if node == ARRAY else 0, dtype=one[0])


def filled(message, fields):
    """Set fields of a message, as `rosidl_runtime_py.set_message_fields` does."""
    kinds = dict(STORE.fielddefs[message._kind][1])
    for name, value in fields.items():
        if name not in kinds:
            raise AttributeError(f"{message._kind} has no field {name}")
        node, inner = kinds[name]
        old = getattr(message, name)
        if isinstance(old, Message):
            filled(old, value)
        elif isinstance(old, np.ndarray):
            value = np.array(value, dtype=old.dtype)
            assert int(node) == SEQUENCE or value.shape == old.shape
            setattr(message, name, value)
        elif isinstance(old, list):
            setattr(message, name, [filled(Message(inner[0][1]), one) for one in value])
        else:
            setattr(message, name, type(old)(value))
    return message


class Node:
    """Fake `rclpy.node.Node` with subscriptions, publishers and warnings."""

    given = MappingProxyType({})
    """Parameters of the node."""

    def __init__(self, name):
        self.name, self.takes, self.told, self.warned = name, {}, {}, []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.given.get(name, default))

    def create_subscription(self, kind, topic, take, quality):
        self.takes[topic] = take

    def create_publisher(self, kind, topic, quality):
        self.told[topic] = []
        return SimpleNamespace(publish=self.told[topic].append)

    def get_logger(self):
        return SimpleNamespace(warning=self.warned.append)


class Broadcaster:
    """Fake `tf2_ros.TransformBroadcaster`."""

    def __init__(self, node):
        self.sendTransform = node.told.setdefault("/tf", []).append


def install(monkeypatch, **parameters):
    """Install the fake modules of ROS, with the parameters of a node."""
    monkeypatch.setattr(Node, "given", parameters)
    quality = {"QoSProfile": SimpleNamespace}
    for name in ("QoSDurabilityPolicy", "QoSReliabilityPolicy"):
        quality[name] = SimpleNamespace(TRANSIENT_LOCAL="kept", BEST_EFFORT="any")
    alike = {"init": lambda: None, "spin": lambda node: None, "try_shutdown": lambda: None}
    of_launch = {"DeclareLaunchArgument": dict, "ExecuteProcess": dict}
    for name, holds in {
        "rclpy": alike,
        "rclpy.executors": {"ExternalShutdownException": RuntimeError},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": quality,
        "rosidl_runtime_py": {"set_message_fields": filled},
        "rosidl_runtime_py.utilities": {"get_message": lambda kind: lambda: Message(kind)},
        "tf2_ros": {"TransformBroadcaster": Broadcaster},
        "launch": {"LaunchDescription": list},
        "launch.actions": {one: lambda *w, one=one, **k: (one, w, k) for one in of_launch},
        "launch.substitutions": {"LaunchConfiguration": lambda name: f"<{name}>"},
    }.items():
        module = ModuleType(name)
        vars(module).update(holds)
        monkeypatch.setitem(sys.modules, name, module)
