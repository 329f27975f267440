"""Which axes a pose is in, by its frame_id, and from when its age counts, over DDS."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from stereoreg_ros import Pose
from stereoreg_ros.geometry.pose import rotation_exp
from stereoreg_ros.nodes.common.conversions import point_from_message, pose_to_message
from support.register_bench import SCALE, Bench, assert_near, image_of, of_stamp, rendered, target_of, values_of
from support.ros_process import RosClient, node_process

SCANNER_FROM_SLICE = Pose(rotation_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([10.0, -20.0, 5.0]))


class PlacedBench(Bench):
    """Sends with every image the plane of its slice."""

    def plane_of(self, stamp: Time, frame_id: str) -> PoseStamped:
        return PoseStamped(header=Header(stamp=stamp, frame_id=frame_id), pose=pose_to_message(SCANNER_FROM_SLICE))

    def send_placed(self, image_axes: str, plane_axes: str) -> Time:
        stamp = self.next_stamp()
        self.client.publish(f"{self.namespace}/slice_pose", self.plane_of(stamp, plane_axes))
        return self.send(image_of(rendered(2)[0]), image_axes, stamp)

    def reason_of_target(self, frame_id: str) -> str:
        """What is said of a target in these axes that is sent now."""
        self.diagnostics.clear()
        self.client.publish(f"{self.namespace}/target", target_of([1.0, 2.0, 3.0], frame_id))

        def reasons() -> list[str]:
            statuses = [status for array in self.diagnostics for status in array.status]
            return [values_of(one)["reason"] for one in statuses if one.name == self.name_of("target")]

        return self.client.wait_for(lambda: [*map(repr, reasons())], "a status of the target")[0].strip("'")


@pytest.fixture(scope="module")
def running() -> Iterator[PlacedBench]:
    spacing = f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"
    arguments = ["--ros-args", "-r", "__ns:=/axes", "-p", spacing, "-p", "slice_pose_required:=true"]
    with RosClient("scanner") as client, node_process("register_node", *arguments):
        bench = PlacedBench(client, "/axes", "/axes/image")

        def is_heard() -> bool:
            bench.send_placed("ct", "ct")
            return bool(bench.poses) and bool(bench.diagnostics)

        client.announce("/axes/slice_pose", PoseStamped)
        client.wait_for(is_heard, "a pose")
        yield bench


@pytest.fixture
def bench(running: PlacedBench) -> PlacedBench:
    assert running.set(scanner_frame_id="", max_pose_age=60.0) == ""
    return running


@pytest.mark.parametrize(
    ("image_axes", "plane_axes", "parameter", "expected"),
    [
        ("ct_slice", "ct_scanner", "", "ct_scanner"),
        ("ct_slice", "", "", "ct_slice"),
        ("ct_slice", "ct_scanner", "ct_scanner", "ct_scanner"),
        ("ct_slice", "", "room", "room"),
    ],
)
def test_a_pose_has_the_frame_id_of_its_slice_pose(bench, image_axes, plane_axes, parameter, expected):
    assert bench.set(scanner_frame_id=parameter) == ""
    stamp = bench.send_placed(image_axes, plane_axes)
    assert_near(bench.pose(stamp), SCANNER_FROM_SLICE @ rendered(2)[1])
    assert of_stamp(bench.poses, stamp).header.frame_id == expected
    with_covariance = bench.client.wait_for(lambda: of_stamp(bench.with_covariance, stamp), "pose_with_covariance")
    assert with_covariance.header.frame_id == expected
    assert bench.status(stamp).hardware_id == expected
    # A target is converted where it was given in these axes, and in no others.
    assert bench.reason_of_target(expected) == ""
    for other in {"ct_slice", "ct_scanner", "room"} - {expected}:
        assert bench.reason_of_target(other) == "bad_target"


def test_a_slice_pose_in_other_axes_than_the_parameter_names_is_refused(bench):
    """Under the parameter's name its numbers would be those of other axes."""
    assert bench.set(scanner_frame_id="room") == ""
    refused = bench.send_placed("ct_slice", "ct_scanner")
    status = bench.status(refused)
    assert values_of(status)["reason"] == "bad_image"
    assert status.message.startswith(
        "slice_pose has the frame_id 'ct_scanner', expected the parameter scanner_frame_id"
    )
    last = bench.send_placed("ct_slice", "room")
    bench.pose(last)
    bench.assert_no_pose_of(refused)


def test_the_age_of_a_pose_counts_from_its_image_not_from_its_plane(bench):
    """The plane of a slice may come seconds after its image, when the frame may stand elsewhere."""
    waited_s = 1.2
    stamp = bench.next_stamp()
    bench.diagnostics.clear()
    bench.send(image_of(rendered(2)[0]), "ct", stamp)

    def waits() -> bool:
        statuses = [status for array in bench.diagnostics for status in array.status]
        return any(int(values_of(one).get("slices_waiting", "0")) for one in statuses)

    bench.client.wait_for(waits, "the image to wait for its plane")
    known_s = time.monotonic()
    bench.client.wait_for(lambda: time.monotonic() > known_s + waited_s, "the image to grow old")
    bench.client.publish("/axes/slice_pose", bench.plane_of(stamp, "ct"))
    bench.pose(stamp)
    assert bench.set(max_pose_age=waited_s) == ""
    assert bench.reason_of_target("ct") == "pose_too_old"
    assert bench.set(max_pose_age=1e3) == ""
    bench.targets.clear()
    assert bench.reason_of_target("ct") == ""
    ages = [
        float(values_of(status)["pose_age_s"])
        for array in bench.diagnostics
        for status in array.status
        if status.name == bench.name_of("target")
    ]
    assert ages[-1] >= waited_s
    target = bench.client.wait_for(lambda: of_stamp(bench.targets, stamp), "target_in_frame")
    expected = (SCANNER_FROM_SLICE @ rendered(2)[1]).inverse() @ np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(point_from_message(target), expected, atol=0.5)
