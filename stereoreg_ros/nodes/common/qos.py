"""Quality of service of topics: reliable, can be overridden by parameters, and logged where it does not match."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TypeVar

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription

from stereoreg_ros.nodes.common.parameters import ParameterError

# Deep enough that no slice of a stream is lost in a search of a second, and small enough not to hoard memory.
QUEUE: Final = QoSProfile(depth=30)
# The last message is latched, and no older one.
LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_OVERRIDDEN: Final = (
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.DURABILITY,
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.RELIABILITY,
)
_Message = TypeVar("_Message")


def _overridable() -> QoSOverridingOptions:
    """The policies that `qos_overrides` parameters may change."""
    return QoSOverridingOptions(_OVERRIDDEN)


def _copy_of(profile: QoSProfile) -> QoSProfile:
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

    with _overrides_by_name():
        publisher: Publisher = node.create_publisher(
            message_type,
            topic,
            _copy_of(profile),
            event_callbacks=PublisherEventCallbacks(incompatible_qos=tell),
            qos_overriding_options=_overridable(),
        )
    return publisher


def subscription_of(
    node: Node, message_type: type[_Message], topic: str, callback: Callable[..., None], profile: QoSProfile
) -> Subscription:
    """A subscription whose quality can be overridden, and which tells of publishers that offer too little."""

    def tell(event: Any) -> None:
        policy = _policy(event)
        less = {"reliability": "best_effort", "durability": "volatile"}.get(policy, "<its value>")
        node.get_logger().warning(
            f"a publisher of {subscription.topic_name} is not heard: it offers less {policy} than is asked for; start "
            f"this node with -p qos_overrides.{subscription.topic_name}.subscription.{policy}:={less}"
        )

    with _overrides_by_name():
        subscription: Subscription = node.create_subscription(
            message_type,
            topic,
            callback,
            _copy_of(profile),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=tell),
            qos_overriding_options=_overridable(),
        )
    return subscription


@contextmanager
def _overrides_by_name() -> Iterator[None]:
    """Invalid overrides end in a ParameterError."""
    try:
        yield
    except (RuntimeError, ValueError, ParameterException, InvalidQosOverridesError) as error:
        raise ParameterError(f"qos_overrides: {error}") from None


def _policy(event: Any) -> str:
    """Name of the policy that does not fit, as in a parameter."""
    return QoSPolicyKind(event.last_policy_kind).name.lower()
