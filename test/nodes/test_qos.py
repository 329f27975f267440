"""Quality of service: as it is meant for each topic, whatever is overridden for another."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from stereoreg_ros.nodes.common.qos import LATCHED, QUEUE, publisher_of, subscription_of


class Overriding:
    """Stands in for a node; as in ROS, overrides are written into the profile that is given."""

    def __init__(self) -> None:
        self.profiles: list[QoSProfile] = []

    def create_publisher(self, _type: type, _topic: str, profile: QoSProfile, **_: object) -> Any:
        return self._overridden(profile)

    def create_subscription(self, _type: type, _topic: str, _callback: object, profile: QoSProfile, **_: object) -> Any:
        return self._overridden(profile)

    def _overridden(self, profile: QoSProfile) -> Any:
        values = profile.depth, profile.durability, profile.history, profile.reliability
        self.profiles.append(
            QoSProfile(depth=values[0], durability=values[1], history=values[2], reliability=values[3])
        )
        profile.depth, profile.durability, profile.reliability = (
            77,
            DurabilityPolicy.VOLATILE,
            ReliabilityPolicy.BEST_EFFORT,
        )
        return SimpleNamespace()


def test_the_overrides_of_one_topic_are_of_no_other() -> None:
    overriding = Overriding()
    node: Any = overriding
    for _ in range(2):
        publisher_of(node, PoseStamped, "pose", LATCHED)
        publisher_of(node, PoseStamped, "target_in_frame", QUEUE)
        subscription_of(node, PoseStamped, "slice_pose", print, QUEUE)
    latched = (1, DurabilityPolicy.TRANSIENT_LOCAL)
    queue = (30, DurabilityPolicy.VOLATILE)
    assert [(one.depth, one.durability) for one in overriding.profiles] == [latched, queue, queue] * 2
    assert {one.reliability for one in overriding.profiles} == {ReliabilityPolicy.RELIABLE}
    assert {one.history for one in overriding.profiles} == {HistoryPolicy.KEEP_LAST}
