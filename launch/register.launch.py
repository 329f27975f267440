"""`ros2 launch stereoreg_ros register.launch.py`: register_node with the arguments given."""

from __future__ import annotations

from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from stereoreg_ros.files.given_path import existing_file, expanded


def generate_launch_description() -> LaunchDescription:
    """What is started, and its arguments: `ros2 launch -s stereoreg_ros register.launch.py` lists them."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "frame_file", default_value="", description="frame file: a path, or the name of a shipped frame"
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value="",
                description="parameter file; config/register_node.yaml is the one to copy",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of node and topics"),
            DeclareLaunchArgument(
                "publish_tf",
                default_value="",
                choices=["", "true", "false"],
                description="whether the pose is published to TF as well",
            ),
            OpaqueFunction(function=_start),
        ]
    )


def _start(context: LaunchContext) -> list[Node]:
    def given(name: str) -> str:
        return str(LaunchConfiguration(name).perform(context))

    # In this order: an argument counts more than the file. What was not given must not hide what the file says.
    parameters: list[str | dict[str, Any]] = []
    if given("params_file"):
        # launch_ros itself would leave out a file that is not there, and start the node with no limits.
        parameters.append(existing_file("params_file", given("params_file")))
    if given("frame_file"):
        # Without its type, the name of a frame that looks like a number would become one.
        frame_file = ParameterValue(expanded("frame_file", given("frame_file")), value_type=str)
        parameters.append({"frame_file": frame_file})
    if given("publish_tf"):
        parameters.append({"publish_tf": given("publish_tf") == "true"})
    return [
        Node(
            package="stereoreg_ros",
            executable="register_node",
            name="register_node",
            namespace=given("namespace"),
            parameters=parameters,
            output="screen",
            # Matrices of six rods gain nothing from several threads of OpenBLAS, which would only wait for each other.
            additional_env={"OPENBLAS_NUM_THREADS": "1"},
        )
    ]
