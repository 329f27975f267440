"""What a running node has, as others on the network see it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from support.ros_process import RosClient


@dataclass(frozen=True)
class NodeInterface:
    """Names, from the root, with their types."""

    published: dict[str, str]
    subscribed: dict[str, str]
    services: dict[str, str]


def from_root(name: str, node: str) -> str:
    """A name of the contract, of a node without namespace, as it is called from the root."""
    return f"/{node}/{name[2:]}" if name.startswith("~/") else name if name.startswith("/") else f"/{name}"


def interface_of(client: RosClient, node: str, expected: Iterable[str]) -> NodeInterface:
    """What the node `node` has, once all that is expected (names of the contract) has been discovered."""
    wanted = {from_root(name, node) for name in expected}

    def complete() -> NodeInterface | None:
        if node not in client.node.get_node_names():
            return None
        ours = client.node
        found = NodeInterface(
            _of_one_type(ours.get_publisher_names_and_types_by_node(node, "/")),
            _of_one_type(ours.get_subscriber_names_and_types_by_node(node, "/")),
            _of_one_type(ours.get_service_names_and_types_by_node(node, "/")),
        )
        return found if wanted <= {*found.published, *found.subscribed, *found.services} else None

    found = client.wait_for(complete, f"topics and services of {node}")
    assert found is not None
    return found


def _of_one_type(names_and_types: Any) -> dict[str, str]:
    found = {}
    for name, types in names_and_types:
        (found[name],) = types
    return found
