"""The answers of register_node to every slice, and when they arrived."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

from stereoreg_ros.nodes.common.diagnostic_status import NAME, name_of_status

DEEP: Final = QoSProfile(depth=1000)


@dataclass
class Answers:
    """When the answers to each stamp arrived, ns; the duration that the node states, s; and the reasons of refusals."""

    poses: dict[int, int] = field(default_factory=dict)
    statuses: dict[int, int] = field(default_factory=dict)
    inside_s: dict[int, float] = field(default_factory=dict)
    refused: dict[int, str] = field(default_factory=dict)


class Listener(Node):
    """Collects the poses and the statuses of the slices."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.heard = Answers()
        self.create_subscription(PoseStamped, "pose", self.on_pose, DEEP)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, DEEP)

    def hears_the_node(self) -> bool:
        """Whether both topics have a publisher."""
        return self.count_publishers("pose") > 0 and self.count_publishers("/diagnostics") > 0

    def spin(self, until: Callable[[], bool], seconds: float) -> bool:
        """Listen until a condition holds; False where it did not within the time limit."""
        deadline = time.monotonic() + seconds
        while not until():
            if time.monotonic() > deadline:
                return False
            rclpy.spin_once(self, timeout_sec=0.1)
        return True

    def on_pose(self, message: PoseStamped) -> None:
        """Note a pose."""
        self.heard.poses[nanoseconds(message)] = time.time_ns()

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Note statuses, of a slice or of something else."""
        for status in message.status:
            if status.name == name_of_status("register_node", NAME):
                stamp = nanoseconds(message)
                self.heard.statuses[stamp] = time.time_ns()
                values = {pair.key: pair.value for pair in status.values}
                self.heard.inside_s[stamp] = 1e-3 * float(values["duration_ms"])
                if values["outcome"] != "accepted":
                    self.heard.refused[stamp] = values["reason"]


def nanoseconds(message: PoseStamped | DiagnosticArray | Image) -> int:
    """A message's stamp."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
