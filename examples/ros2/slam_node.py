"""A node of ROS 2 over `pipistrelle.Slam`, to copy: odometry and echoes in, pose and map out.

    ros2 launch examples/ros2/slam.launch.py vehicle:=/path/to/log.toml

docs/ros.md says which messages it takes, what it publishes, and what it does not do.
"""

import math
import sys
from functools import partial
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rosidl_runtime_py import set_message_fields
from rosidl_runtime_py.utilities import get_message
from tf2_ros import TransformBroadcaster

from pipistrelle import InputError, Slam
from pipistrelle.config import BagConfig
from pipistrelle.detection.logs import bag_log as live
from pipistrelle.detection.logs.vehicle import read_vehicle
from pipistrelle.experiments.results import ros

PARAMETERS = {
    "vehicle": "log.toml",
    "estimator": "iekf",
    "association": "known",
    "odometry": "/odom",
    "echoes": "/echoes",
    "echoes_type": "mrpt_msgs/msg/ObservationRangeBearing",
    "speed_of_sound": 0.0,
    "map_frame": "map",
}
FROM_ANYBODY = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.BEST_EFFORT)
LATCHED = partial(QoSProfile, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
MOST_WAITING = 1000


class SlamNode(Node):
    """Hears each scan at the end of the step that holds it, as a log does."""

    def __init__(self):
        super().__init__("pipistrelle")
        said = {
            name: self.declare_parameter(name, given).value for name, given in PARAMETERS.items()
        }
        motion = live.odometry_use(read_vehicle(Path(said["vehicle"])).motion)
        self.settings = BagConfig(motion=motion, speed_of_sound=said["speed_of_sound"] or None)
        self.begin = partial(Slam, said["vehicle"], filter=said["estimator"],
                             association__method=said["association"])  # fmt: skip
        self.slam = self.begin()  # what is wrong with vehicle or estimator is said at once
        self.kind, self.map_frame = said["echoes_type"], said["map_frame"]
        self.last, self.began, self.frames, self.waiting = None, math.inf, live.Frames(), []
        learn = partial(live.learn_transforms, self.frames)
        for kind, topic, take, quality in (
            ("nav_msgs/msg/Odometry", said["odometry"], self.drive, FROM_ANYBODY),
            (self.kind, said["echoes"], self.listen, FROM_ANYBODY),
            ("tf2_msgs/msg/TFMessage", live.TRANSFORMS, learn, LATCHED(depth=100)),
        ):
            self.create_subscription(get_message(kind), topic, partial(self.guarded, take), quality)
        self.pose = self.create_publisher(get_message(ros.POSE), "~/pose", 10)
        self.map = self.create_publisher(get_message(ros.MAP), "~/map", LATCHED(depth=1))
        self.transforms = TransformBroadcaster(self)

    def guarded(self, take, message):
        """Take a message, or say what is wrong with it."""
        try:
            take(message)
        except InputError as error:
            self.get_logger().warning(str(error))

    def drive(self, message):
        """Go to where the odometry is, and hear what came on the way."""
        if self.last is None or live.clock_began(self.last, message):
            time, _ = live.stamp_and_pose(message)
            self.slam, self.began = self.begin(time=time), math.nextafter(time, -math.inf)
        else:
            before = self.slam.time
            controls, end = live.step_between(self.last, message, self.settings)
            self.slam.move(controls, time=end)
            self.began = before
        self.last = message
        self.tell(self.hear())

    def listen(self, message):
        """Keep the scans of a message until the odometry has come to them."""
        if self.last is None:
            raise InputError("echoes without odometry before them are left out")
        base = self.last.child_frame_id
        self.waiting += live.scans_in(self.kind, message, base, self.frames, self.settings)
        self.waiting.sort(key=lambda scan: scan[0])
        if len(self.waiting) > MOST_WAITING:
            self.get_logger().warning("odometry is far behind; the oldest echoes are left out")
            del self.waiting[:-MOST_WAITING]
        if self.hear():
            self.tell(heard=True)

    def hear(self):
        """Hear the scans of this step; tell whether there were any."""
        due = [scan for scan in self.waiting if scan[0] <= self.slam.time]
        self.waiting, alarms = self.waiting[len(due) :], self.slam.alarms
        for time, columns in due:
            late = time if time <= self.began else None  # Slam refuses it, by its time
            self.guarded(lambda one, late=late: self.slam.hear(time=late, **one), columns)
        for time, cause, repaired in self.slam.alarms:
            if (time, cause, repaired) not in alarms:
                state = "repaired" if repaired else "path and map are not to be trusted"
                self.get_logger().warning(f"{cause}: no fit from {time:.3f} s on; {state}")
        return bool(due)

    def tell(self, heard):
        """Publish the pose, the frame of the odometry in that of the map, and what was mapped."""
        time, odometry = live.stamp_and_pose(self.last)
        pose, frames = self.slam.pose, (self.map_frame, self.last.header.frame_id)
        at = time, self.map_frame
        self.pose.publish(made(ros.POSE, ros.pose_fields(*at, pose[1:4], pose.covariance)))
        moved = ros.correction_fields(time, frames, pose[1:4], odometry)
        self.transforms.sendTransform(made(ros.TRANSFORM, moved))
        if heard:
            self.map.publish(made(ros.MAP, ros.map_fields(*at, self.slam.map)))


def made(kind, fields):
    """Make a message of its fields."""
    message = get_message(kind)()
    set_message_fields(message, fields)
    return message


def main():
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        rclpy.spin(SlamNode())
    except InputError as error:
        sys.exit(f"slam_node: {error}")
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
