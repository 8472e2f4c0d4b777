"""Play a log or bag: ros2 launch slamfusion player.launch.py log:=FILE."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    default_params = PathJoinSubstitution(
        [FindPackageShare("slamfusion"), "config", "slamfusion.yaml"]
    )
    log = ParameterValue(LaunchConfiguration("log"), value_type=str)
    rate = ParameterValue(LaunchConfiguration("rate"), value_type=float)
    return LaunchDescription(
        [
            DeclareLaunchArgument("log", description="the log or bag"),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="times as fast as it was recorded"
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="before every relative name"
            ),
            DeclareLaunchArgument(
                "params_file", default_value=default_params, description="YAML of parameters"
            ),
            Node(
                package="slamfusion",
                executable="player_node",
                name="player",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("params_file"),
                    {"file": log, "rate": rate},
                ],
                output="screen",
            ),
        ]
    )
