"""What goes out for one frame: its pose, with and without covariance, and the target in its axes."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.common.qos import LATCHED, QUEUE, publisher_of
from stereoreg_ros.nodes.common.transforms import transform_of
from stereoreg_ros.nodes.register.targets import Accepted, TargetInFrame
from stereoreg_ros.registration import Registrar
from stereoreg_ros.result import Refusal, Registration


class FrameTopics:
    """The publishers of one frame."""

    def __init__(self, node: Node, prefix: str = "") -> None:
        """prefix: of the topics, the frame's name and a slash where there are several frames."""
        self._node = node
        self.pose = publisher_of(node, PoseStamped, f"{prefix}pose", LATCHED)
        self.with_covariance = publisher_of(node, PoseWithCovarianceStamped, f"{prefix}pose_with_covariance", LATCHED)
        self.target = publisher_of(node, PointStamped, f"{prefix}target_in_frame", QUEUE)

    def destroy(self) -> None:
        """Withdraw the topics."""
        publishers: tuple[Publisher, ...] = (self.pose, self.with_covariance, self.target)
        for publisher in publishers:
            self._node.destroy_publisher(publisher)


class FrameOutput:
    """A frame, what registers it, the frame_id of its axes, its topics, and its latest pose if its last slice was
    accepted."""

    def __init__(self, frame: Frame, topics: FrameTopics, axes: str) -> None:
        self.frame, self.topics, self.axes = frame, topics, axes
        self.registrar = Registrar(frame)
        self.latest: Accepted | None = None

    def publish(
        self,
        result: Registration | Refusal,
        header: Header,
        received_s: float,
        send_transform: Callable[[TransformStamped], None] | None,
    ) -> None:
        """Publish an accepted pose; a refusal only ends the one before, on which no target may rest any more.

        received_s: when the slice's image came, seconds of the steady clock, from which the pose's age counts.
        """
        if not result:
            self.latest = None
            return
        message = PoseStamped(header=header, pose=conversions.pose_to_message(result.scanner_from_frame))
        self.topics.pose.publish(message)
        with_covariance = PoseWithCovarianceStamped(header=header)
        with_covariance.pose.pose = message.pose
        with_covariance.pose.covariance = conversions.covariance_to_message(result.covariance)
        self.topics.with_covariance.publish(with_covariance)
        if send_transform is not None:
            send_transform(transform_of(message, self.axes))
        self.latest = Accepted(header, result, received_s)

    def publish_target(self, target: TargetInFrame) -> None:
        """Publish the target in the frame's axes, with the stamp of the pose it rests on."""
        header = Header(stamp=target.header.stamp, frame_id=self.axes)
        self.topics.target.publish(PointStamped(header=header, point=conversions.point_to_message(target.point_mm)))
