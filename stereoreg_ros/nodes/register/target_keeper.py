"""The target that was sent last, and what is answered to it on every new pose."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped
from rclpy.node import Node

from stereoreg_ros.nodes.common.qos import QUEUE, subscription_of
from stereoreg_ros.nodes.register.frame_output import FrameOutput
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.targets import (
    KeptTarget,
    TargetInFrame,
    TargetRefusal,
    status_of_target,
    target_in_frame,
)

_REPEAT_WARNING_S: Final = 5.0


class TargetKeeper:
    """Subscribes to `target`, and answers it with each frame's latest pose: when it comes, and again on new poses."""

    def __init__(
        self,
        node: Node,
        state: Callable[[], tuple[NodeSettings, Sequence[FrameOutput]]],
        diagnose: Callable[[list[DiagnosticStatus]], None],
    ) -> None:
        """state: the settings and the frames' outputs; diagnose: publishes statuses of now."""
        self._node, self._state, self._diagnose = node, state, diagnose
        self._kept: KeptTarget | None = None
        subscription_of(node, PointStamped, "target", self._on_target, QUEUE)

    def of_axes(self, frame_id: str) -> PointStamped | None:
        """The target, where it was given in these axes."""
        kept = self._kept
        return kept.message if kept is not None and kept.message.header.frame_id == frame_id else None

    def drop(self, why: str, unless_in: str) -> None:
        """Forget a target in other axes than `unless_in`, and say so: what it was given in has gone."""
        if self._kept is None or self.of_axes(unless_in) is not None:
            return
        _, outputs = self._state()
        refusal = TargetRefusal("other_frame_of_reference", f"the target is dropped: {why}; send it again")
        axes = self._kept.message.header.frame_id
        self._kept = None
        self._node.get_logger().warning(refusal.message)
        self._diagnose([status_of_target(refusal, output.frame.name, axes) for output in outputs])

    def answer(self) -> None:
        """Publish where the target is in each frame by its latest pose, or why it cannot be said."""
        if self._kept is None:
            return
        settings, outputs = self._state()
        axes = self._kept.message.header.frame_id
        statuses = []
        for output in outputs:
            outcome = target_in_frame(self._kept, output.latest, time.monotonic(), settings)
            if isinstance(outcome, TargetInFrame):
                output.publish_target(outcome)
            else:
                self._node.get_logger().warning(outcome.message, throttle_duration_sec=_REPEAT_WARNING_S)
            statuses.append(status_of_target(outcome, output.frame.name, axes))
            if not outcome and outcome.reason == "bad_target":
                self._kept = None
                break
        self._diagnose(statuses)

    def _on_target(self, message: PointStamped) -> None:
        # A target that cannot be used takes the place of the one before: steering to that one would look right.
        self._kept = KeptTarget(message, time.monotonic())
        self.answer()
