"""The topics on which slices come in: what has one stamp is put together and handed on as one slice."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

from geometry_msgs.msg import PoseStamped, Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.nodes.common.conversions import MessageError, pose_from_message, scale_from_message
from stereoreg_ros.nodes.common.qos import QUEUE, subscription_of
from stereoreg_ros.nodes.register.image_sources import ImageSources
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice, SlicePlane
from stereoreg_ros.nodes.register.slice_assembly import FRAME_OF_REFERENCE, PLANE, SPACING, Part, SliceAssembly

_LOOK_FOR_OVERDUE_S: Final = 0.1


class SliceInput:
    """Subscribes to `image` and to what comes with it.

    received: images so far.
    """

    def __init__(self, node: Node, is_plane_required: Callable[[], bool], use: Callable[[IncomingSlice], None]) -> None:
        """is_plane_required: whether an image has to wait for its slice_pose even where nobody publishes any; use:
        called with each slice, whole or with its fault, in the order in which they became so."""
        self.received = 0
        self._node, self._is_plane_required, self._use = node, is_plane_required, use
        self._assembly = SliceAssembly()
        self._seen: set[str] = set()
        # The image last: where all are there, rclpy serves them in this order and no image has to wait.
        self._parts = [
            subscription_of(node, Vector3Stamped, SPACING, self._on_spacing, QUEUE),
            subscription_of(node, PoseStamped, PLANE, self._on_plane, QUEUE),
            subscription_of(node, Header, FRAME_OF_REFERENCE, self._on_frame_of_reference, QUEUE),
        ]
        self._image = subscription_of(node, Image, "image", self._on_image, QUEUE)
        self._sources = ImageSources(node, (self._image, *self._parts))
        node.create_timer(_LOOK_FOR_OVERDUE_S, self._hand_on, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def has_source(self) -> bool:
        """Whether anybody publishes images."""
        return self._node.count_publishers(self._image.topic_name) > 0

    @property
    def waiting(self) -> int:
        """How many images wait for what belongs to them."""
        return len(self._assembly)

    def fault(self, now_s: float) -> str:
        """Why the source of the slices is not clear now; see `ImageSources.fault`."""
        return self._sources.fault(now_s)

    def _on_image(self, image: Image) -> None:
        self.received += 1
        self._assembly.add_image(image, time.monotonic(), self._expected())
        self._hand_on()

    def _expected(self) -> set[str]:
        # Whoever publishes slices has announced these topics before that of the images, and DDS keeps that order: by
        # the time of the first image it is known what comes with it.
        published = {
            name
            for name, one in zip((SPACING, PLANE, FRAME_OF_REFERENCE), self._parts, strict=True)
            if self._node.count_publishers(one.topic_name) > 0
        }
        return published | self._seen | ({PLANE} if self._is_plane_required() else set())

    def _on_spacing(self, message: Vector3Stamped) -> None:
        self._add(SPACING, message.header, lambda: scale_from_message(message))

    def _on_plane(self, message: PoseStamped) -> None:
        self._add(PLANE, message.header, lambda: SlicePlane(pose_from_message(message), message.header.frame_id))

    def _on_frame_of_reference(self, message: Header) -> None:
        self._add(FRAME_OF_REFERENCE, message, lambda: str(message.frame_id))

    def _add(self, topic: str, header: Any, read: Callable[[], Part]) -> None:
        self._seen.add(topic)
        part: Part | MessageError
        try:
            part = read()
        except MessageError as error:
            part = MessageError(f"{topic}: {error}")
            self._node.get_logger().warning(str(part))
        self._assembly.add_part(topic, header.stamp, part)
        self._hand_on()

    def _hand_on(self) -> None:
        for one in self._assembly.take(time.monotonic()):
            self._use(one)
