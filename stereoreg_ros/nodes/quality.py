"""Quality of service of the node's topics: reliable, to be overridden by parameters, and told where it does not fit."""

from __future__ import annotations

from typing import Any, Final, TypeVar

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

# Deep enough that no slice is lost while one is registered, and small enough not to hoard memory.
QUEUE: Final = QoSProfile(depth=10)
# Who comes late gets the last message, and no older one.
LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_OVERRIDDEN: Final = (
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.DURABILITY,
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.RELIABILITY,
)
_Message = TypeVar("_Message")


def overridable() -> QoSOverridingOptions:
    """The policies that `qos_overrides` parameters may change."""
    return QoSOverridingOptions(_OVERRIDDEN)


def copy_of(profile: QoSProfile) -> QoSProfile:
    """A profile of one's own: overrides are written into the one that is given."""
    return QoSProfile(
        history=profile.history,
        depth=profile.depth,
        reliability=profile.reliability,
        durability=profile.durability,
    )


def publisher_of(node: Node, message_type: type[_Message], topic: str, profile: QoSProfile) -> Publisher:
    """A publisher whose quality can be overridden, and which tells of subscribers that ask for more than it offers."""

    def tell(event: Any) -> None:
        policy = _policy(event)
        node.get_logger().warning(
            f"a subscriber of {publisher.topic_name} gets nothing: it asks for more {policy} than is offered; start it "
            f"with less, or this node with -p qos_overrides.{publisher.topic_name}.publisher.{policy}:=<its value>"
        )

    publisher: Publisher = node.create_publisher(
        message_type,
        topic,
        copy_of(profile),
        event_callbacks=PublisherEventCallbacks(incompatible_qos=tell),
        qos_overriding_options=overridable(),
    )
    return publisher


def telling_subscription(node: Node, topic: str) -> SubscriptionEventCallbacks:
    """Event callbacks of a subscription that tell of publishers which offer less than it asks for."""

    def tell(event: Any) -> None:
        policy, name = _policy(event), node.resolve_topic_name(topic)
        less = {"reliability": "best_effort", "durability": "volatile"}.get(policy, "<its value>")
        node.get_logger().warning(
            f"a publisher of {name} is not heard: it offers less {policy} than is asked for; start this node with "
            f"-p qos_overrides.{name}.subscription.{policy}:={less}"
        )

    return SubscriptionEventCallbacks(incompatible_qos=tell)


def _policy(event: Any) -> str:
    """Name of the policy that does not fit, as in a parameter."""
    return QoSPolicyKind(event.last_policy_kind).name.lower()
