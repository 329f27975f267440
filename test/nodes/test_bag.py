"""The tutorial's way from DICOM slices to poses, with its own examples: into an MCAP bag, and out of it to the node."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.dicom_files import CATPHAN, real, write_slice
from support.real_images import CATPHAN_OPTIONS, shows_module

pytest.importorskip("rclpy", reason="ROS 2 is not there")
pytest.importorskip("rosbags", reason="rosbags is not there")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped
from rosbags.highlevel import AnyReader

from stereoreg_ros import PixelScale, Pose, RegistrationOptions, load_frame, register_slice
from stereoreg_ros.dicom import read_series
from stereoreg_ros.nodes.common.conversions import pose_from_message
from stereoreg_ros.result import Registration
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, passage, random_pose, render_slice
from support.contract import STATUS_NAME
from support.ros_process import REPOSITORY, ROS_ENVIRONMENT, RosClient, node_process

EXAMPLES = REPOSITORY / "docs" / "examples"
DEADLINE_S = 120.0


def rendered_series(folder: Path) -> Path:
    """Six slices of cube6 2 mm apart, as DICOM files; the fourth shows nothing."""
    scanner = ScannerSettings(shape=(256, 256), scale=PixelScale(0.5, 0.6))
    frame, rng = load_frame("cube6"), np.random.default_rng(3)
    middle = random_pose(rng, frame, scanner, max_tilt_deg=10.0, max_depth_mm=0.0)
    for number, pose in zip(range(6), passage(frame, middle, 2.0, min_rods=6), strict=False):
        hu = render_slice([PlacedFrame(frame, pose)], scanner, rng).hu
        stored = (np.zeros_like(hu) if number == 3 else hu) + 1024
        write_slice(folder / f"{number}.dcm", stored, 2.0 * number, PixelSpacing=[0.6, 0.5], InstanceNumber=number)
    return folder


def catphan_module(folder: Path) -> Path:
    """The slices of the CatPhan scan that show the module with the wires."""
    for one in read_series(real(CATPHAN)):
        if shows_module(one):
            shutil.copy(one.header.path, folder)
    return folder


def started(name: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    environment = {**os.environ, **ROS_ENVIRONMENT, "PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen([sys.executable, str(EXAMPLES / name), *arguments], env=environment, text=True, **options)


def run_example(name: str, *arguments: str) -> str:
    process = started(name, *arguments, stdout=subprocess.PIPE)
    said, _ = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, said
    return said


def registered_offline(series: Path, frame_name: str, options: RegistrationOptions) -> list[Pose | None]:
    """scanner_from_frame of every slice, None where it is refused; each after the other, as the node does it."""
    frame, poses = load_frame(frame_name), list[Pose | None]()
    for one in read_series(series):
        result = register_slice(one.ct_slice, frame, options, poses[-1] if poses else None)
        poses.append(result.scanner_from_frame if isinstance(result, Registration) else None)
    return poses


def stamps_of_images(bag: Path) -> list[tuple[int, int]]:
    """Read by a reader that knows nothing of our ROS: the bag is one for others too."""
    stamps = []
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            if connection.topic == "/image":
                message: Any = reader.deserialize(data, connection.msgtype)
                stamps.append((message.header.stamp.sec, message.header.stamp.nanosec))
    return stamps


@pytest.mark.parametrize(
    ("make_series", "frame", "options", "accepted"),
    [
        (rendered_series, "cube6", RegistrationOptions(), 5),
        (catphan_module, "catphan_ctp404", CATPHAN_OPTIONS, 5),
    ],
    ids=["rendered", "catphan"],
)
def test_slices_from_a_bag_give_the_poses_of_the_slices(tmp_path, make_series, frame, options, accepted):
    folder, bag = tmp_path / "series", tmp_path / "bag"
    folder.mkdir()
    series = make_series(folder)
    expected = registered_offline(series, frame, options)
    assert sum(pose is not None for pose in expected) >= accepted

    # So slowly that none is skipped on a busy computer.
    said = run_example("slices_to_bag.py", str(series), str(bag), "--rate", "1")
    stamps = stamps_of_images(bag)
    assert len(set(stamps)) == len(expected)

    spacing = said[said.index("pixel_spacing:=") :].strip()
    told = [spacing, f"frame_file:={frame}", f"threshold:={options.threshold}"]
    told.append(f"max_rotation_deg:={options.max_rotation_deg}")
    parameters = [word for one in told for word in ("-p", one)]
    with node_process("register_node", "--ros-args", *parameters), RosClient() as client:
        poses = client.collect(PoseStamped, "/pose")
        diagnostics = client.collect(DiagnosticArray, "/diagnostics")
        log = tmp_path / "printed"
        with log.open("w") as output:
            printer = started("print_poses.py", stdout=output)

        def printer_hears() -> bool:
            # By what it prints: that this client has found it does not say that the node has. The target is refused, as
            # it names no axes.
            diagnostics.clear()
            client.publish("/target", PointStamped())
            client.wait_for(lambda: diagnostics, "the answer to a target")
            return "register_node: target" in log.read_text()

        client.wait_for(printer_hears, "the example that prints")
        player = started("play_bag.py", str(bag))
        try:

            def outcomes() -> dict[tuple[int, int], tuple[str, str]]:
                return {
                    (array.header.stamp.sec, array.header.stamp.nanosec): (
                        status.values[0].value,
                        status.values[1].value,
                    )
                    for array in diagnostics
                    for status in array.status
                    if status.name == STATUS_NAME
                }

            client.wait_for(lambda: set(outcomes()) >= set(stamps), "the diagnostics of every slice", DEADLINE_S)
            # Played in real time: beside a dozen busy processes, slices come faster than they are registered.
            skipped = {stamp for stamp, outcome in outcomes().items() if outcome == ("refused", "skipped")}
            could = {stamp for stamp, pose in zip(stamps, expected, strict=True) if pose is not None}
            accepted_stamps = could - skipped
            assert accepted_stamps
            client.wait_for(lambda: len(poses) >= len(accepted_stamps), "the poses")
            assert player.wait(DEADLINE_S) == 0

            def all_printed() -> bool:
                said, count = log.read_text(), len(accepted_stamps)
                return (said.count("frame at x"), said.count("registration: registered")) == (count, count)

            client.wait_for(all_printed, "the printed answers")
            printer.send_signal(signal.SIGINT)
            assert printer.wait(DEADLINE_S) == 0
        finally:
            for process in (player, printer):
                if process.poll() is None:
                    process.kill()
                    process.wait()
            print(f"--- output of print_poses.py\n{log.read_text()}---")
    found = {(one.header.stamp.sec, one.header.stamp.nanosec): pose_from_message(one) for one in poses}
    assert set(found) == accepted_stamps
    assert {stamp for stamp, outcome in outcomes().items() if outcome == ("accepted", "")} == accepted_stamps
    for stamp, pose in zip(stamps, expected, strict=True):
        if pose is not None and stamp in found:
            assert np.allclose(found[stamp].translation, pose.translation, atol=1e-6)
            assert np.allclose(found[stamp].rotation, pose.rotation, atol=1e-9)
