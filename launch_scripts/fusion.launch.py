"""Start the fusion alone: ros2 launch slamfusion fusion.launch.py."""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def _start(context: LaunchContext) -> list[Node]:
    """Return the node; what is not asked for here is left to the parameter file."""
    asked = {
        name: LaunchConfiguration(name).perform(context)
        for name in ("frame_prefix", "base_frame", "odom_frame", "state_path")
    }
    prefix, own = asked.pop("frame_prefix"), {}
    if prefix:
        names = {"base_frame": "base_link", "odom_frame": "odom", "fused_frame": "fused_map"}
        own = {key: prefix + name for key, name in names.items()}
    own |= {key: value for key, value in asked.items() if value}
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    parameters = [LaunchConfiguration("params_file"), {"use_sim_time": use_sim_time}]
    return [
        Node(
            package="slamfusion",
            executable="fusion_node",
            name="fusion",
            namespace=LaunchConfiguration("namespace"),
            parameters=[*parameters, own] if own else parameters,
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
                "params_file",
                default_value=default_params,
                description="YAML of parameters; inputs, for other SLAMs, stands there",
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
                "state_path",
                default_value="",
                description="file that keeps the fused frame; default: of params_file",
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
