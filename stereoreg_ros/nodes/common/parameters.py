"""Parameters of a node from one table: names, defaults, descriptions and ranges; declared, and read as plain values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter


class ParameterError(ValueError):
    """A start value that a node cannot run with; the text is a sentence for whoever started it."""


@dataclass(frozen=True)
class Entry:
    """One parameter: its name, default, what it means, a range (None: none), and a word in a number's place."""

    name: str
    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    word: str | None = None

    @property
    def value(self) -> Any:
        """The default as rclpy takes it: lists instead of tuples."""
        return list(self.default) if isinstance(self.default, tuple) else self.default

    @property
    def descriptor(self) -> ParameterDescriptor:
        """The description that `ros2 param describe` shows."""
        descriptor = ParameterDescriptor(description=self.description)
        if self.word is not None:
            descriptor.dynamic_typing = True
            descriptor.additional_constraints = f"a number, or '{self.word}'"
        if self.default == ():
            # An empty list has no type of its own, so that ROS would take it for one of bytes.
            descriptor.dynamic_typing = True
            descriptor.additional_constraints = "a list of names"
        elif isinstance(self.default, tuple):
            descriptor.additional_constraints = f"{len(self.default)} numbers"
        elif self.low is not None and self.high is not None:
            if isinstance(self.default, int):
                descriptor.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high))]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(self.low), to_value=float(self.high))
                ]
        return descriptor


def setting(default: Any, description: str, low: float | None = None, high: float | None = None) -> Any:
    """A dataclass field that `entries_of` makes a parameter of."""
    return field(default=default, metadata={"description": description, "low": low, "high": high})


def entries_of(settings: type) -> tuple[Entry, ...]:
    """The parameters of a dataclass whose fields were made by `setting`; fields without a default are left out."""
    return tuple(
        Entry(
            entry.name,
            entry.default,
            entry.metadata["description"],
            entry.metadata["low"],
            entry.metadata["high"],
            entry.metadata.get("word"),
        )
        for entry in fields(settings)
        if entry.default is not MISSING
    )


def declare(node: Node, entries: Iterable[Entry]) -> dict[str, Any]:
    """Declare the parameters and return their start values; ParameterError on a wrong type or beyond the range."""
    values = {}
    for entry in entries:
        try:
            parameter = node.declare_parameter(entry.name, entry.value, entry.descriptor)
        except ParameterException as error:
            raise ParameterError(str(error)) from None
        values[entry.name] = plain(parameter)
    return values


def plain(parameter: Parameter) -> Any:
    """The value of a parameter, arrays as tuples."""
    scalar = isinstance(parameter.value, (str, int, float, bool))
    return parameter.value if scalar or parameter.value is None else tuple(parameter.value)
