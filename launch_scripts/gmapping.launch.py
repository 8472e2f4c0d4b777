"""Start gmapping alone: ros2 launch slamfusion gmapping.launch.py."""

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
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "namespace", default_value="", description="before every relative name"
            ),
            DeclareLaunchArgument(
                "params_file", default_value=default_params, description="YAML of parameters"
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", description="time is that of /clock"
            ),
            DeclareLaunchArgument("scan", default_value="scan", description="topic of the scans"),
            DeclareLaunchArgument("odom", default_value="odom", description="topic of odometry"),
            Node(
                package="slamfusion",
                executable="gmapping_node",
                name="gmapping",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params_file"), {"use_sim_time": use_sim_time}],
                remappings=[
                    ("scan", LaunchConfiguration("scan")),
                    ("odom", LaunchConfiguration("odom")),
                ],
                output="screen",
                respawn=True,
                respawn_delay=2.0,
            ),
        ]
    )
