"""`ros2 launch stereoreg_ros demo.launch.py`: a simulated scanner, register_node, and RViz to watch them."""

from __future__ import annotations

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, LogInfo, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from stereoreg_ros.files.given_path import expanded

# The layout names topics from the root; these find them in a namespace.
_SHOWN = ("markers", "overlay", "pose_with_covariance", "target")


def generate_launch_description() -> LaunchDescription:
    """What is started, and its arguments: `ros2 launch -s stereoreg_ros demo.launch.py` lists them."""
    names = ("frame_file", "params_file", "namespace", "publish_tf")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "frame_file", default_value="cube6", description="frame file: a path, or the name of a shipped frame"
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([ThisLaunchFileDir(), "demo.yaml"]),
                description="parameter file of register_node",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of nodes and topics"),
            DeclareLaunchArgument(
                "publish_tf",
                default_value="",
                choices=["", "true", "false"],
                description="whether the pose is published to TF as well",
            ),
            DeclareLaunchArgument(
                "rviz", default_value="true", choices=["true", "false"], description="whether RViz is started"
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(PathJoinSubstitution([ThisLaunchFileDir(), "register.launch.py"])),
                launch_arguments=[(name, LaunchConfiguration(name)) for name in names],
            ),
            OpaqueFunction(function=_simulation),
            OpaqueFunction(function=_rviz),
        ]
    )


def _simulation(context: LaunchContext) -> list[Node]:
    frame_file = expanded("frame_file", LaunchConfiguration("frame_file").perform(context))
    return [
        Node(
            package="stereoreg_ros",
            executable="simulate_node",
            name="simulate_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"frame_file": ParameterValue(frame_file, value_type=str), "wait_for_subscriber": True}],
            output="screen",
        )
    ]


def _rviz(context: LaunchContext) -> list[Node | LogInfo]:
    if LaunchConfiguration("rviz").perform(context) == "false":
        return []
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return [LogInfo(msg="rviz2 is not installed, nothing is shown; Foxglove can: config/stereoreg.foxglove.json")]
    layout = PathJoinSubstitution([FindPackageShare("stereoreg_ros"), "config", "stereoreg.rviz"])
    return [
        Node(
            package="rviz2",
            executable="rviz2",
            name="rviz2",
            namespace=LaunchConfiguration("namespace"),
            arguments=["-d", layout],
            remappings=[(f"/{topic}", topic) for topic in _SHOWN],
        )
    ]
