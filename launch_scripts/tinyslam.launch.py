"""Start tinySLAM alone: ros2 launch slamfusion tinyslam.launch.py."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def _start(context: LaunchContext) -> list[Node]:
    """Return the node; frames that are not named are those of the parameter file."""
    asked = {
        name: LaunchConfiguration(name).perform(context)
        for name in ("frame_prefix", "base_frame", "odom_frame")
    }
    prefix, frames = asked.pop("frame_prefix"), {}
    if prefix:
        names = {"base_frame": "base_link", "odom_frame": "odom", "map_frame": "tinyslam_map"}
        frames = {key: prefix + name for key, name in names.items()}
    frames |= {key: name for key, name in asked.items() if name}
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    parameters = [LaunchConfiguration("params_file"), {"use_sim_time": use_sim_time}]
    return [
        Node(
            package="slamfusion",
            executable="tinyslam_node",
            name="tinyslam",
            namespace=LaunchConfiguration("namespace"),
            parameters=[*parameters, frames] if frames else parameters,
            remappings=[
                ("scan", LaunchConfiguration("scan")),
                ("odom", LaunchConfiguration("odom")),
                ("/tf", LaunchConfiguration("tf")),
                ("/tf_static", LaunchConfiguration("tf_static")),
            ],
            output="screen",
            respawn=True,
            respawn_delay=2.0,
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    default_params = PathJoinSubstitution(
        [FindPackageShare("slamfusion"), "config", "slamfusion.yaml"]
    )
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
