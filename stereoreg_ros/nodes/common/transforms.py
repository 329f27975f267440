"""TF from the scanner to the frame, on robots that have tf2_ros; everywhere else nothing needs it."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseStamped, TransformStamped, Vector3
from rclpy.node import Node


def transform_of(pose: PoseStamped, child_frame_id: str) -> TransformStamped:
    """The pose of a frame as the transform from its header's frame_id to `child_frame_id`."""
    message = TransformStamped(header=pose.header, child_frame_id=child_frame_id)
    position = pose.pose.position
    message.transform.translation = Vector3(x=position.x, y=position.y, z=position.z)
    message.transform.rotation = pose.pose.orientation
    return message


def has_tf2() -> bool:
    """Whether tf2_ros can be imported."""
    try:
        import tf2_ros  # noqa: F401
    except ImportError:
        return False
    return True


def broadcaster_of(node: Node) -> Callable[[TransformStamped], None]:
    """What sends a transform to /tf; ImportError where `has_tf2` is false."""
    import tf2_ros

    send: Callable[[TransformStamped], None] = tf2_ros.TransformBroadcaster(node).sendTransform
    return send
