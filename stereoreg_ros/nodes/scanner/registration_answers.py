"""Whether register_node has done with an image: its diagnostics bear the image's stamp."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.diagnostic_status import NAME, OTHER_SPACING, name_of_status

_QUEUE = 10
_SAME_SPACING = 1e-4


class RegistrationAnswers:
    """Listens to `/diagnostics` for the answers to one image at a time, which may have been sent more than once.

    count: of its answers so far, registered or refused.
    """

    def __init__(self, node: Node, register_node: str) -> None:
        """register_node: its name, seen from the namespace of `node`."""
        full_name = register_node if register_node.startswith("/") else f"{node.get_namespace()}/{register_node}"
        self._name = name_of_status(full_name, NAME)
        self._subscription = node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _QUEUE)
        self._stamp: Time | None = None
        self.count = 0
        self._measured = self._refused_for_spacing = False
        self._spacing = (0.0, 0.0)

    @property
    def can_be_heard(self) -> bool:
        """Whether anybody publishes diagnostics; an answer given before is lost."""
        return bool(self._subscription.get_publisher_count() > 0)

    def expect(self, stamp: Time) -> None:
        """Wait for answers to the image of this stamp."""
        self._stamp, self.count = stamp, 0

    def came_with(self, scale: PixelScale) -> bool:
        """Whether the last answer rests on this pixel spacing, or on one that was measured in its place."""
        if self._refused_for_spacing:
            return False
        return self._measured or np.allclose(self._spacing, (scale.sx, scale.sy), rtol=_SAME_SPACING, atol=0.0)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if message.header.stamp != self._stamp:
            return
        for status in message.status:
            # Of several frames each has a status, under the same name and its own; the first stands for all.
            if status.name == self._name or status.name.startswith(f"{self._name} of "):
                self.count += 1
                values = {one.key: one.value for one in status.values}
                self._refused_for_spacing = status.message.startswith(OTHER_SPACING)
                self._measured = values["calibration"] == "measured"
                self._spacing = (float(values["pixel_spacing_x_mm"]), float(values["pixel_spacing_y_mm"]))
                return
