"""The pictures of a slice, `overlay` and `markers`: drawn only while somebody subscribes."""

from __future__ import annotations

import traceback
from collections.abc import Sequence

from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from stereoreg_ros.drawing import draw_overlay
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.nodes.common.conversions import image_from_bgr
from stereoreg_ros.nodes.common.qos import QUEUE, publisher_of
from stereoreg_ros.nodes.register.markers import markers_of
from stereoreg_ros.result import Refusal, Registration


class Pictures:
    """The publishers of the pictures; a fault in drawing is logged, and costs no pose."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._overlay = publisher_of(node, Image, "overlay", QUEUE)
        self._markers = publisher_of(node, MarkerArray, "markers", QUEUE)

    def publish(
        self,
        ct_slice: Slice,
        results: Sequence[tuple[Registration | Refusal, str]],
        header: Header,
        target: PointStamped | None,
    ) -> None:
        """Draw a slice's results, each with the name of its frame's axes; target: in the axes that `header` names."""
        overlay = markers = None
        try:
            if self._overlay.get_subscription_count() > 0:
                overlay = image_from_bgr(draw_overlay(ct_slice, [result for result, _ in results]))
                overlay.header = header
            if self._markers.get_subscription_count() > 0:
                markers = markers_of(ct_slice, results, header, target)
        except Exception:
            self._node.get_logger().error(f"internal error while drawing a slice\n{traceback.format_exc()}")
        if overlay is not None:
            self._overlay.publish(overlay)
        if markers is not None:
            self._markers.publish(markers)
