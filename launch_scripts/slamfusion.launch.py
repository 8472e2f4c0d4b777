"""Start everything: three producers, the fusion, and if asked for the player and RViz.

ros2 launch slamfusion slamfusion.launch.py [log:=FILE] [use_sim_time:=true] [rviz:=true]

A log is played when all three producers hear it. For one of several robots: namespace:=robot1
frame_prefix:=robot1/ tf:=tf tf_static:=tf_static
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PRODUCERS = "tinyslam,gmapping,graph"


def _file(name: str) -> PythonLaunchDescriptionSource:
    """Return one of the launch files beside this one."""
    return PythonLaunchDescriptionSource(
        PathJoinSubstitution([FindPackageShare("slamfusion"), "launch", name])
    )


def generate_launch_description() -> LaunchDescription:
    """Return the nodes and their arguments."""
    share = FindPackageShare("slamfusion")
    default_params = PathJoinSubstitution([share, "config", "slamfusion.yaml"])
    rviz_config = PathJoinSubstitution([share, "config", "slamfusion.rviz"])
    common = {
        name: LaunchConfiguration(name)
        for name in (
            *("namespace", "params_file", "tf", "tf_static"),
            *("frame_prefix", "base_frame", "odom_frame"),
        )
    }
    timed = {**common, "use_sim_time": LaunchConfiguration("use_sim_time")}
    topics = {name: LaunchConfiguration(name) for name in ("scan", "odom")}
    use_sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    has_log = IfCondition(NotEqualsSubstitution(LaunchConfiguration("log"), ""))
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
            DeclareLaunchArgument(
                "state_path",
                default_value="",
                description="file that keeps the fused frame; default: of params_file",
            ),
            DeclareLaunchArgument("log", default_value="", description="play this log or bag"),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="of the log: times as fast as recorded"
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="start RViz"),
            # Several nodes share the cores.
            SetEnvironmentVariable(
                "POCL_MAX_PTHREAD_COUNT",
                EnvironmentVariable("POCL_MAX_PTHREAD_COUNT", default_value="1"),
            ),
            IncludeLaunchDescription(
                _file("tinyslam.launch.py"), launch_arguments={**timed, **topics}.items()
            ),
            IncludeLaunchDescription(
                _file("gmapping.launch.py"), launch_arguments={**timed, **topics}.items()
            ),
            IncludeLaunchDescription(
                _file("graph.launch.py"), launch_arguments={**timed, **topics}.items()
            ),
            IncludeLaunchDescription(
                _file("fusion.launch.py"),
                launch_arguments={
                    **timed,
                    **topics,
                    "state_path": LaunchConfiguration("state_path"),
                }.items(),
            ),
            IncludeLaunchDescription(
                _file("player.launch.py"),
                launch_arguments={
                    **common,
                    **topics,
                    "log": LaunchConfiguration("log"),
                    "rate": LaunchConfiguration("rate"),
                    "wait_for": PRODUCERS,
                }.items(),
                condition=has_log,
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", rviz_config],
                parameters=[{"use_sim_time": use_sim_time}],
                remappings=[
                    ("/tf", LaunchConfiguration("tf")),
                    ("/tf_static", LaunchConfiguration("tf_static")),
                ],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
