"""Whether register_node is there, and whether it has done with a slice: its diagnostics have the slice's stamp."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_full_topic_name import validate_full_topic_name

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.diagnostic_status import NAME, name_of_status
from stereoreg_ros.nodes.common.parameters import ParameterError

_QUEUE = 10
_SAME_SPACING = 1e-4
# Of the identifier of an endpoint, so much is that of its process.
_PROCESS_BYTES = 12


class RegistrationAnswers:
    """Listens to `/diagnostics` for the answers to one image at a time, which may have been sent more than once.

    count: of its answers so far, registered or refused.
    """

    def __init__(self, node: Node, register_node: str, image_topic: str = "image") -> None:
        """register_node: its name, seen from the namespace of `node`, or nothing; image_topic: on which it gets slices.

        Raises ParameterError on a name that ROS does not allow.
        """
        name = register_node if register_node.startswith("/") else f"{node.get_namespace()}/{register_node}"
        self._node = node
        self._full_name = "/" + name.lstrip("/")
        if register_node:
            _require_name(register_node, self._full_name)
        self._status_name = name_of_status(name, NAME)
        self._image_topic = image_topic
        self._subscription = node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _QUEUE)
        self._stamp: Time | None = None
        self.count = 0
        self._measured = False
        self._spacing = (0.0, 0.0)

    def processes(self) -> set[bytes]:
        """The processes of register_node that take images and whose answers can be heard; an answer before is lost.

        DDS counts a killed process on for a while: this tells it from the one in its place.
        """
        takers = self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(self._image_topic))
        speakers = self._node.get_publishers_info_by_topic("/diagnostics")
        return self._of_register_node(takers) & self._of_register_node(speakers)

    def expect(self, stamp: Time) -> None:
        """Wait for answers to the image of this stamp."""
        self._stamp, self.count = stamp, 0

    def came_with(self, scale: PixelScale) -> bool:
        """Whether the last answer rests on this pixel spacing, or on one that was measured in its place."""
        return self._measured or np.allclose(self._spacing, (scale.sx, scale.sy), rtol=_SAME_SPACING, atol=0.0)

    def _of_register_node(self, endpoints: list[TopicEndpointInfo]) -> set[bytes]:
        return {
            bytes(one.endpoint_gid)[:_PROCESS_BYTES]
            for one in endpoints
            if f"{one.node_namespace.rstrip('/')}/{one.node_name}" == self._full_name
        }

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if message.header.stamp != self._stamp:
            return
        for status in message.status:
            # Of several frames each has a status, under the same name and its own; the first stands for all.
            if status.name == self._status_name or status.name.startswith(f"{self._status_name} of "):
                self.count += 1
                values = {one.key: one.value for one in status.values}
                self._measured = values["calibration"] == "measured"
                self._spacing = (float(values["pixel_spacing_x_mm"]), float(values["pixel_spacing_y_mm"]))
                return


def _require_name(given: str, full_name: str) -> None:
    try:
        validate_full_topic_name(full_name)
    except InvalidTopicNameException as error:
        raise ParameterError(f"register_node: '{given}' is no name of a node: {error}") from None
