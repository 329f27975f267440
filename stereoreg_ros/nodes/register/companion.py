"""What comes with an image on a topic of its own, its pixel spacing or its pose: waited for where somebody tells it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.subscription import Subscription

from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.common.qos import QUEUE, subscription_of
from stereoreg_ros.nodes.register.by_stamp import WAIT_S, ByStamp

_Part = TypeVar("_Part")
_Whole = TypeVar("_Whole")


class Companion(Generic[_Part, _Whole]):
    """A topic each of whose messages belongs to the image with its stamp.

    message_type: with a header; read: from such a message to what it tells, MessageError where it cannot be used; same:
    whether two say the same; required: whether it is waited for though nobody has told any yet; met: called with each
    image (or what it has met before) and what came with it, None where nothing does, or why that cannot be used.
    """

    def __init__(
        self,
        node: Node,
        message_type: type,
        topic: str,
        read: Callable[[Any], _Part],
        *,
        same: Callable[[_Part, _Part], bool],
        required: Callable[[], bool],
        met: Callable[[_Whole, _Part | MessageError | None], None],
    ) -> None:
        self._node = node
        self._topic = topic
        self._read = read
        self._required = required
        self._met = met
        self._seen = False
        self._by_stamp: ByStamp[_Part, _Whole] = ByStamp(topic, same)
        self.subscription: Subscription = subscription_of(node, message_type, topic, self._on_message, QUEUE)

    def meet(self, stamp: Time, whole: _Whole) -> None:
        """Bring an image together with its part, now or when that comes."""
        if not self._expected():
            self._met(whole, None)
        elif stamp == Time():
            self._met(whole, MessageError(f"its stamp is 0, expected one by which to know its {self._topic}"))
        elif (part := self._by_stamp.take(stamp)) is not None:
            self._met(whole, part)
        else:
            self._by_stamp.wait(stamp, whole, time.monotonic())

    def give_up(self, stamp: Time) -> None:
        """Do without what comes with an image that is not registered: a later one with its stamp must not have it."""
        if self._expected():
            self._by_stamp.give_up(stamp)

    def refuse_overdue(self) -> None:
        """Wait no longer for what should have come; to be called every tenth of a second or so."""
        now_s = time.monotonic()
        while (whole := self._by_stamp.take_overdue(now_s)) is not None:
            self._met(whole, MessageError(f"no {self._topic} with the image's stamp came within {WAIT_S:g} s"))

    def _expected(self) -> bool:
        # Who publishes slices has announced their spacings and poses before their images, and DDS keeps that order: by
        # the time of the first image it is known what comes with it.
        return self._seen or self._required() or self._node.count_publishers(self.subscription.topic_name) > 0

    def _on_message(self, message: Any) -> None:
        self._seen = True
        part: _Part | MessageError
        try:
            part = self._read(message)
        except MessageError as error:
            part = MessageError(f"{self._topic}: {error}")
            self._node.get_logger().warning(str(part))
        met = self._by_stamp.add(message.header.stamp, part)
        if met is not None:
            self._met(*met)
