"""Start the node: ros2 launch examples/ros2/slam.launch.py vehicle:=/path/to/log.toml"""

import runpy
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

NODE = Path(__file__).with_name("slam_node.py")


def generate_launch_description():
    """Declare an argument for each parameter of the node, and start it with them."""
    defaults = runpy.run_path(str(NODE))["PARAMETERS"]
    declared = [DeclareLaunchArgument(name, default_value=str(defaults[name])) for name in defaults]
    words = ["python3", str(NODE), "--ros-args"]
    for name in defaults:
        words += ["-p", [f"{name}:=", LaunchConfiguration(name)]]
    return LaunchDescription([*declared, ExecuteProcess(cmd=words, output="screen")])
