"""Play a log or bag: ros2 launch slamfusion player.launch.py log:=FILE."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# Kernels that were never compiled on this machine take their time, seconds.
START_TIMEOUT_S = 300.0


def _start(context: LaunchContext) -> list[Node]:
    """Return the node; what is not said is that of the parameter file."""
    asked = {
        name: LaunchConfiguration(name).perform(context)
        for name in ("frame_prefix", "base_frame", "odom_frame", "wait_for")
    }
    prefix, more = asked.pop("frame_prefix"), {}
    if prefix:
        names = {"base_frame": "base_link", "odom_frame": "odom", "laser_frame": "laser"}
        more = {key: prefix + name for key, name in names.items()}
    more |= {key: name for key, name in asked.items() if name}
    if asked["wait_for"]:
        more["start_timeout_s"] = START_TIMEOUT_S
    log = ParameterValue(LaunchConfiguration("log"), value_type=str)
    rate = ParameterValue(LaunchConfiguration("rate"), value_type=float)
    parameters = [LaunchConfiguration("params_file"), {"file": log, "rate": rate}]
    return [
        Node(
            package="slamfusion",
            executable="player_node",
            name="player",
            namespace=LaunchConfiguration("namespace"),
            parameters=[*parameters, more] if more else parameters,
            remappings=[
                ("scan", LaunchConfiguration("scan")),
                ("odom", LaunchConfiguration("odom")),
                ("/tf", LaunchConfiguration("tf")),
                ("/tf_static", LaunchConfiguration("tf_static")),
            ],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    default_params = PathJoinSubstitution(
        [FindPackageShare("slamfusion"), "config", "slamfusion.yaml"]
    )
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
            DeclareLaunchArgument(
                "wait_for",
                default_value="",
                description="producers, by commas, that must hear the first scan before the others "
                "are played; default: of params_file",
            ),
            DeclareLaunchArgument("scan", default_value="scan", description="topic of the scans"),
            DeclareLaunchArgument("odom", default_value="odom", description="topic of odometry"),
            DeclareLaunchArgument("tf", default_value="/tf", description="topic of transforms"),
            DeclareLaunchArgument(
                "tf_static", default_value="/tf_static", description="topic of static transforms"
            ),
            DeclareLaunchArgument(
                "frame_prefix", default_value="", description="before the name of every frame"
            ),
            DeclareLaunchArgument(
                "base_frame", default_value="", description="the robot; default: of params_file"
            ),
            DeclareLaunchArgument(
                "odom_frame", default_value="", description="odometry; default: of params_file"
            ),
            OpaqueFunction(function=_start),
        ]
    )
