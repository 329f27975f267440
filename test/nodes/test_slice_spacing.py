"""A slice that states its pixel spacing is registered with that, whatever the parameter says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    values = [f"pixel_spacing:=[{spacing.sx},{spacing.sy}]", *more]
    return ["--ros-args", "-r", f"__ns:={namespace}", *[part for one in values for part in ("-p", one)]]


def spacing_used(bench: SpacedBench, stamp: Any) -> float:
    return float(values_of(bench.status(stamp))["pixel_spacing_x_mm"])


def test_a_slice_is_registered_with_the_spacing_that_it_states_whatever_the_parameter_says(client):
    """As by a node that was started with the spacing of another series: a pose with that would have been believed."""
    hu, slice_from_frame = rendered(2)
    with node_process("register_node", *arguments("/other", OTHER)):
        bench = SpacedBench(client, "/other", "/other/image")
        bench.warm_up(bench.diagnostics)
        assert spacing_used(bench, bench.send(image_of(hu))) == OTHER.sx
        # Slices of two series in turn; in those of the other one the frame looks larger and is further off.
        for _ in range(3):
            stamp = bench.send_spaced(hu, SCALE)
            assert_near(bench.pose(stamp), slice_from_frame)
            assert spacing_used(bench, stamp) == pytest.approx(SCALE.sx, rel=1e-9)
            stamp = bench.send_spaced(hu, OTHER)
            assert spacing_used(bench, stamp) == pytest.approx(OTHER.sx, rel=1e-9)
            off_mm = np.linalg.norm(bench.pose(stamp).translation - slice_from_frame.translation)
            assert off_mm > 0.5
        # The parameter is whose it was, and an image that has lost its spacing is not registered with it.
        assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == [OTHER.sx, OTHER.sy]
        status = bench.status(bench.send(image_of(hu)))
        assert "no slice_spacing with the image's stamp came" in status.message


def test_slices_that_state_their_spacing_need_no_parameter(client):
    hu, slice_from_frame = rendered(2)
    with node_process("register_node", "--ros-args", "-r", "__ns:=/bare"):
        bench = SpacedBench(client, "/bare", "/bare/image")
        # Until the node knows of the spacings, an image is one without.
        client.announce("/bare/slice_spacing", Vector3Stamped)
        client.wait_for(lambda: spacing_used(bench, bench.send_spaced(hu, SCALE)) > 0, "a spacing to be used")
        assert_near(bench.pose(bench.send_spaced(hu, SCALE)), slice_from_frame)
        assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == [0.0, 0.0]


def test_a_measured_spacing_is_used_for_the_slices_that_it_was_measured_for(client, tmp_path: Path):
    path = tmp_path / "scale.yaml"
    variance = (1e-4 * SCALE.sx) ** 2
    covariance = ((variance, 0.0), (0.0, variance))
    record = CalibrationRecord(SCALE, OTHER, covariance, "cube6", 10, 60, "2026-01-01T00:00:00+00:00", "test")
    save_calibration(path, record)
    hu, slice_from_frame = rendered(3)
    with node_process("register_node", *arguments("/measured", OTHER, f"calibration_file:={path}")):
        bench = SpacedBench(client, "/measured", "/measured/image")
        bench.warm_up(bench.diagnostics)
        # Whoever watches the parameter sees what was measured.
        assert list(client.get_parameters(bench.node, "pixel_spacing")[0]) == [SCALE.sx, SCALE.sy]
        # Two scanners in turn, of which one was measured.
        for stated, calibration in ((OTHER, "measured"), (SCALE, "configured"), (OTHER, "measured")):
            stamp = bench.send_spaced(hu, stated)
            assert_near(bench.pose(stamp), slice_from_frame)
            values = values_of(bench.status(stamp))
            assert values["calibration"] == calibration
            assert float(values["pixel_spacing_x_mm"]) == pytest.approx(SCALE.sx, rel=1e-9)
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
