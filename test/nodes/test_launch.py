"""The launch files: what they name exists, and, where ROS 2's launch is there, what they start registers slices."""

from __future__ import annotations

import ast
import os
import re
import shutil
import signal
import subprocess
from importlib.util import find_spec

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from stereoreg_ros.nodes.common.conversions import pose_from_message
from support.ros_process import PACKAGE, REPOSITORY, ROS_ENVIRONMENT, RosClient

FILES = [REPOSITORY / "launch" / name for name in ("register.launch.py", "demo.launch.py")]
ARGUMENTS = {"frame_file", "params_file", "namespace", "publish_tf"}


def calls(tree: ast.AST, function: str) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == function
    ]


def text_of(node: ast.expr) -> str:
    assert isinstance(node, ast.Constant)
    return str(node.value)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_executables_are_installed_and_arguments_described(path):
    tree = ast.parse(path.read_text())
    setup = (REPOSITORY / "setup.py").read_text()
    started = [{word.arg: word.value for word in call.keywords} for call in calls(tree, "Node")]
    ours = [text_of(node["executable"]) for node in started if text_of(node["package"]) == PACKAGE]
    assert ours
    for executable in ours:
        assert re.search(rf'"{executable} = {PACKAGE}\.nodes\.\w+\.{executable}:main"', setup)
    declared = {text_of(call.args[0]): call for call in calls(tree, "DeclareLaunchArgument")}
    assert set(declared) >= ARGUMENTS
    for call in declared.values():
        assert {"default_value", "description"} <= {word.arg for word in call.keywords}


def has_launch() -> bool:
    # Not `launch`: the folder of that name here would do for it.
    if find_spec("launch_ros") is None or shutil.which("ros2") is None:
        return False
    try:
        return bool(get_package_prefix(PACKAGE))
    except PackageNotFoundError:
        return False


def test_a_parameter_file_is_checked_and_paths_are_expanded_before_anything_is_started():
    """With what, test_given_path.py shows; here, that nothing goes round it."""
    register, demo = (ast.parse(path.read_text()) for path in FILES)
    (checked,) = calls(register, "existing_file")
    assert text_of(checked.args[0]) == "params_file"
    # The demonstration has register.launch.py look at its own.
    assert calls(demo, "IncludeLaunchDescription")
    for tree in (register, demo):
        assert [text_of(call.args[0]) for call in calls(tree, "expanded")] == ["frame_file"]


@pytest.mark.skipif(not has_launch(), reason="needs ros2 launch and this package in a sourced workspace")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_nothing_is_started_without_the_parameter_file_that_was_named(tmp_path, path):
    command = ["ros2", "launch", str(path), f"params_file:={tmp_path / 'nowhere.yaml'}"]
    environment = {**os.environ, **ROS_ENVIRONMENT}
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode != 0
    assert "nowhere.yaml: no such file; nothing is started" in ran.stdout + ran.stderr
    assert "process started" not in ran.stdout + ran.stderr


@pytest.mark.skipif(not has_launch(), reason="needs ros2 launch and this package in a sourced workspace")
def test_demo_registers_slices(tmp_path):
    file = tmp_path / "told.yaml"
    told = {"frame_file": "leksell_ct", "scanner_frame_id": "from_the_file"}
    file.write_text(yaml.safe_dump({"/**/register_node": {"ros__parameters": told}}))
    arguments = {"namespace": "launched", "frame_file": "cube6", "params_file": file, "rviz": "false"}
    command = ["ros2", "launch", str(FILES[1]), *(f"{name}:={value}" for name, value in arguments.items())]
    log = tmp_path / "log"
    with log.open("w") as output, RosClient() as client:
        environment = {**os.environ, **ROS_ENVIRONMENT}
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
        try:
            kept = QoSProfile(depth=100, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
            truths: list[PoseStamped] = []
            client.node.create_subscription(PoseStamped, "/launched/true_pose", truths.append, kept)
            poses = client.collect(PoseStamped, "/launched/pose")
            diagnostics = client.collect(DiagnosticArray, "/diagnostics")

            def pairs() -> list[tuple[PoseStamped, PoseStamped]]:
                return [(pose, true) for pose in poses for true in truths if pose.header.stamp == true.header.stamp]

            pose, truth = client.wait_for(pairs, "a pose and its truth", 60.0)[0]
            found, true = pose_from_message(pose), pose_from_message(truth)
            assert np.linalg.norm(found.translation - true.translation) < 1.5
            # An argument counts more than the file, which counts for all else.
            assert pose.header.frame_id == "from_the_file"

            def registrations() -> list[DiagnosticStatus]:
                statuses = [status for array in diagnostics for status in array.status]
                return [status for status in statuses if status.name.endswith("register_node: registration")]

            status = client.wait_for(registrations, "diagnostics of a slice")[0]
            assert {pair.key: pair.value for pair in status.values}["frame"] == "cube6"
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0, log.read_text()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
