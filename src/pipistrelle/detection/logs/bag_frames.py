"""Where a sensor is on the vehicle: static transforms of a bag, followed from frame to frame.

A transform takes points of its child's frame to its parent's (tf2_msgs); frames form a tree.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from pipistrelle.detection.logs.bag_messages import Pose, TurnError, pose_of

TRANSFORMS = "/tf_static"
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"
"""The topic of the static transforms, and the type of its messages."""


class Frames:
    """The frames of a bag, and how they stand to each other."""

    def __init__(self) -> None:
        self._beside: dict[str, dict[str, Pose]] = {}

    def add(self, message: Any) -> list[str]:
        """Learn the transforms of a message; say which are left out as no turns."""
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
        """Return what takes points of a frame to another; None where nothing ties them."""
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
    """Return a frame's name without the slash that ROS 1 may begin it with."""
    return frame.removeprefix("/")


def after(outer: Pose, inner: Pose) -> Pose:
    """Return the inner pose followed by the outer one."""
    return outer[0] @ inner[0], outer[0] @ inner[1] + outer[1]


def inverse(pose: Pose) -> Pose:
    """Return the way back."""
    return pose[0].T, -pose[0].T @ pose[1]


def planar(x: float, y: float, heading: float) -> Pose:
    """Return a pose in the plane.

    >>> planar(1.0, 2.0, 0.0)[1]
    array([1., 2., 0.])
    """
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0])


def along_axis(points: Float[np.ndarray, "n 3"], mount: Pose) -> Float[np.ndarray, "n 3"]:
    """Return points about a sensor's axis in its frame's axes, whose x or z is that axis.

    Profiling sonars have their frame's z along the axis and y to starboard, as ProjectedSonarImage
    of marine_acoustic_msgs says; others have x ahead. The one that lies flatter is meant.
    """
    (_, _, x), (_, _, z) = mount[0][:, 0], mount[0][:, 2]
    return points if abs(x) <= abs(z) else points[:, ::-1] * [1.0, -1.0, 1.0]
