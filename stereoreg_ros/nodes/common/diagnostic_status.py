"""Statuses on `/diagnostics`: their names, and their values as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

# What the status of a slice is called, by register_node and by those who wait for its answers.
NAME: Final = "registration"


def name_of_status(node_name: str, what: str) -> str:
    """Name of a status: the fully qualified name of the node that it is of, and what it is about.

    Two nodes in two namespaces would take each other's place in a table that goes by the name.
    """
    return f"{node_name.lstrip('/')}: {what}"


def status_with(
    level: bytes, name: str, message: str, values: Mapping[str, str | int | float], hardware_id: str
) -> DiagnosticStatus:
    """A status; numbers as plain text, those that do not exist as `nan`."""
    return DiagnosticStatus(
        level=level,
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
    )


def _text(value: str | int | float) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)
