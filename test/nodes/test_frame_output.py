"""What goes out for an accepted slice: each topic's header, axes and units, of a result made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import Header

from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.register.frame_output import FrameOutput, FrameTopics
from stereoreg_ros.nodes.register.targets import TargetInFrame
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import PoseEstimate, Refusal, Registration

FRAME = load_frame("cube6")
HEADER = Header(stamp=Time(sec=12, nanosec=34), frame_id="ct")
IN_SLICE = Pose(rotation_exp(np.array([0.0, 1.0, 0.0])), np.array([4.0, 5.0, 6.0]))
IN_SCANNER = Pose(rotation_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.25, -20.5, 300.0]))
COVARIANCE = np.diag([1.0, 4.0, 9.0, 1e-4, 4e-4, 9e-4]) + 0.25 * np.eye(6, k=1) + 0.25 * np.eye(6, k=-1)
ACCEPTED = Registration(
    FRAME,
    SliceSpots(np.zeros((9, 2)), PixelScale(0.4, 0.7)),
    RegistrationOptions(),
    PoseEstimate(IN_SLICE, IN_SCANNER, COVARIANCE, (), 0.0, -9.0),
)
REFUSED = Refusal(FRAME, SliceSpots(np.zeros((9, 2)), PixelScale(0.4, 0.7)), "no_consensus", "nothing fits")


class Output:
    """The output of one frame, without a node, and what it has published."""

    def __init__(self, prefix: str = "") -> None:
        self.messages: dict[str, Any] = {}
        self.transforms: list[TransformStamped] = []
        node: Any = SimpleNamespace(create_publisher=self._topic)
        self.output = FrameOutput(FRAME, FrameTopics(node, prefix), "cube")

    def _topic(self, _type: type, name: str, _profile: object, **_: object) -> Any:
        assert name not in self.messages
        self.messages[name] = None
        return SimpleNamespace(publish=lambda message: self.messages.update({name: message}))

    def publish(self, result: Registration | Refusal) -> None:
        self.output.publish(result, HEADER, 77.5, self.transforms.append)


def test_pose_covariance_and_transform_are_of_one_slice_in_the_scanner() -> None:
    made = Output()
    made.publish(ACCEPTED)
    pose, with_covariance = made.messages["pose"], made.messages["pose_with_covariance"]
    assert pose.header == with_covariance.header == made.transforms[0].header == HEADER
    assert with_covariance.pose.pose == pose.pose
    position, turn = pose.pose.position, pose.pose.orientation
    assert (position.x, position.y, position.z) == pytest.approx((0.00125, -0.0205, 0.3))
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0, 0, 0.5**0.5, 0.5**0.5))
    units = np.array([1e-3] * 3 + [1.0] * 3)
    published = np.reshape(with_covariance.pose.covariance, (6, 6))
    np.testing.assert_allclose(published, COVARIANCE * units * units[:, None], atol=1e-15)
    assert made.transforms[0].child_frame_id == "cube"
    latest = made.output.latest
    assert latest is not None
    assert (latest.header, latest.registration, latest.received_s) == (HEADER, ACCEPTED, 77.5)


def test_of_a_refused_slice_nothing_goes_out_and_no_pose_is_left() -> None:
    made = Output()
    made.publish(ACCEPTED)
    made.messages.update(dict.fromkeys(made.messages))
    made.publish(REFUSED)
    assert set(made.messages.values()) == {None}
    assert len(made.transforms) == 1
    assert made.output.latest is None


def test_a_target_has_the_stamp_of_its_pose_and_the_axes_of_the_frame() -> None:
    made = Output()
    made.output.publish_target(TargetInFrame(np.array([10.0, -20.0, 30.0]), 0.5, HEADER, 1.5))
    target = made.messages["target_in_frame"]
    assert (target.header.stamp, target.header.frame_id) == (HEADER.stamp, "cube")
    assert (target.point.x, target.point.y, target.point.z) == pytest.approx((0.01, -0.02, 0.03))


def test_each_of_several_frames_has_topics_of_its_own() -> None:
    assert list(Output("cube6/").messages) == ["cube6/pose", "cube6/pose_with_covariance", "cube6/target_in_frame"]
