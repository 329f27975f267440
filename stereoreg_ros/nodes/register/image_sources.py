"""Who sends the slices: one source at a time, for of two at once nobody could tell whose axes a pose is in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

# A process that was killed is counted among the publishers until its lease has run out: 20 s in Fast DDS by default.
LEASE_S: Final = 30.0
# Of the identifier of a publisher, so much is that of its process.
_PROCESS_BYTES: Final = 12
# What ROS calls a node of which only the topics are known: it has just appeared, or is not a ROS node.
_UNKNOWN: Final = "_NODE_NAME_UNKNOWN_"


class ImageSources:
    """The publishers of the topics that make up a slice."""

    def __init__(self, node: Node, inputs: Sequence[Subscription]) -> None:
        self._node = node
        self._inputs = inputs
        self._seen_s: list[dict[bytes, float]] = [{} for _ in inputs]

    def fault(self, now_s: float) -> str:
        """Why the source of the slices is not clear at `now_s`, of a steady clock; an empty string where it is.

        Publishers of one process and node name are one source. Two processes of one node name are one that was killed
        and the one in its place, unless they stay. To be called at least every few seconds, so that it is seen since
        when they are there.
        """
        faults = [
            self._fault_of(one.topic_name, seen, now_s) for one, seen in zip(self._inputs, self._seen_s, strict=True)
        ]
        return next(filter(None, faults), "")

    def _fault_of(self, topic: str, seen_s: dict[bytes, float], now_s: float) -> str:
        publishers = self._node.get_publishers_info_by_topic(topic)
        processes = {bytes(one.endpoint_gid)[:_PROCESS_BYTES] for one in publishers}
        for gone in seen_s.keys() - processes:
            del seen_s[gone]
        for process in processes:
            seen_s.setdefault(process, now_s)
        names = sorted({_name_of(one) for one in publishers})
        if len(names) > 1:
            return f"{topic} is published by {' and '.join(names)} at once, expected one source of slices"
        both_since_s = sorted(seen_s.values())[1:2]
        if both_since_s and now_s - both_since_s[0] > LEASE_S:
            count, name = len(processes), names[0]
            return f"{topic} is published by {count} nodes called {name} at once, expected one source of slices"
        return ""


def _name_of(publisher: TopicEndpointInfo) -> str:
    if publisher.node_name == _UNKNOWN:
        return "a node whose name is not known"
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
