"""A slice that bears its own pixel spacing is registered with that or with none, whoever told register_node what."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import PoseStamped, Vector3Stamped

from stereoreg_ros import PixelScale, Pose
from stereoreg_ros.calibration.file import CalibrationRecord, load_calibration, save_calibration
from stereoreg_ros.nodes.common.conversions import MessageError, pose_to_message, scale_from_message, scale_to_message
from support.register_bench import (
    OTHER,
    SCALE,
    SpacedBench,
    assert_near,
    image_of,
    rendered,
    values_of,
)
from support.ros_process import RosClient, node_process


@pytest.fixture
def client():
    with RosClient("scanner") as scanner:
        yield scanner


def arguments(namespace: str, spacing: PixelScale, *more: str) -> list[str]:
    told = [f"pixel_spacing:=[{spacing.sx},{spacing.sy}]", *more]
    return ["--ros-args", "-r", f"__ns:={namespace}", *[part for one in told for part in ("-p", one)]]


def test_a_node_that_was_told_another_spacing_registers_nothing_until_it_is_told(client):
    """As one that takes the place of a killed one, and was started with the spacing of another series."""
    hu, slice_from_frame = rendered(2)
    with node_process("register_node", *arguments("/other", OTHER)):
        bench = SpacedBench(client, "/other", "/other/image")
        bench.warm_up(bench.diagnostics)
        # So near that without its spacing it would have been believed.
        assert values_of(bench.status(bench.send(image_of(hu))))["outcome"] == "accepted"
        bench.refuse_spaced(hu, SCALE)
        assert bench.set(pixel_spacing=[SCALE.sx, SCALE.sy]) == ""
        assert_near(bench.pose(bench.send_spaced(hu, SCALE)), slice_from_frame)
        # Slices of two series in turn: each other one is refused, and none is wrong.
        for _ in range(3):
            bench.refuse_spaced(hu, OTHER)
            assert_near(bench.pose(bench.send_spaced(hu, SCALE)), slice_from_frame)
        # From now on an image without its spacing is none that could be trusted.
        status = bench.status(bench.send(image_of(hu)))
        assert "no slice_spacing with the image's stamp came" in status.message


def test_a_measured_spacing_is_used_again_when_the_one_it_stands_for_is_told(client, tmp_path: Path):
    path = tmp_path / "scale.yaml"
    variance = (1e-4 * SCALE.sx) ** 2
    covariance = ((variance, 0.0), (0.0, variance))
    record = CalibrationRecord(SCALE, OTHER, covariance, "cube6", 10, 60, "2026-01-01T00:00:00+00:00", "test")
    save_calibration(path, record)
    hu, slice_from_frame = rendered(3)
    with node_process("register_node", *arguments("/measured", OTHER, f"calibration_file:={path}")):
        bench = SpacedBench(client, "/measured", "/measured/image")
        bench.warm_up(bench.diagnostics)
        for told, calibration in ((OTHER, "measured"), (SCALE, "configured"), (OTHER, "measured")):
            assert bench.set(pixel_spacing=[told.sx, told.sy], pixel_shear=0.0) == ""
            stamp = bench.send_spaced(hu, told)
            assert_near(bench.pose(stamp), slice_from_frame)
            values = values_of(bench.status(stamp))
            assert values["calibration"] == calibration
            assert float(values["pixel_spacing_x_mm"]) == pytest.approx(SCALE.sx, rel=1e-9)
        # What bears the measured one as its own is of another series.
        bench.refuse_spaced(hu, SCALE)
    assert load_calibration(path) == record


def test_an_image_waits_for_what_belongs_to_it_in_any_order(client):
    hu, slice_from_frame = rendered(4)
    with node_process("register_node", *arguments("/order", SCALE)):
        bench = SpacedBench(client, "/order", "/order/image")
        # A source announces what its images bear before its images.
        client.announce("/order/slice_pose", PoseStamped)
        client.announce("/order/slice_spacing", Vector3Stamped)
        bench.warm_up(bench.diagnostics)
        stamp = bench.next_stamp()
        image = image_of(hu)
        image.header.stamp = stamp
        pose = PoseStamped(pose=pose_to_message(slice_from_frame.inverse()))
        spacing = Vector3Stamped(vector=scale_to_message(SCALE))
        pose.header.stamp = spacing.header.stamp = stamp
        topics = {"/order/image": image, "/order/slice_pose": pose, "/order/slice_spacing": spacing}
        for topic, message in topics.items():
            client.publish(topic, message)
        # The plane was such that the frame stands in the scanner's origin.
        assert_near(bench.pose(stamp), Pose.identity())


def test_a_spacing_that_is_none_is_named():
    with pytest.raises(MessageError, match="pixel spacing sx is 0"):
        scale_from_message(Vector3Stamped())
    message = Vector3Stamped(vector=scale_to_message(PixelScale(0.5, 0.6, 0.01)))
    found = scale_from_message(message)
    np.testing.assert_allclose([found.sx, found.sy, found.shear], [0.5, 0.6, 0.01], rtol=1e-12)
