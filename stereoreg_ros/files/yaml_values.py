"""YAML, or JSON, from outside as plain values: mappings, lists, texts, numbers, true and false; and nothing else."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Final

import yaml

from stereoreg_ros.files.bounded_yaml import UnusableYamlError, compose, shown

# More than a file of ours has anywhere.
_DEEPEST: Final = 4
_LONGEST_SCALAR: Final = 200
_TAG: Final = "tag:yaml.org,2002:"
_WHOLE: Final = re.compile(r"[-+]?(0|[1-9][0-9]*)")


def values_of(content: bytes) -> Any:
    """What the only document of a file says; None where the file is empty. Raises UnusableYamlError."""
    root = compose(content)
    return None if root is None else _value_of(root, 0, set())


def _whole(text: str) -> int:
    if not _WHOLE.fullmatch(text):
        raise ValueError
    return int(text)


def _real(text: str) -> float:
    # Python spells infinity and NaN without the point.
    return float(re.sub(r"\.(inf|nan)", r"\1", text.lower()))


_SCALARS: Final[dict[str, Callable[[str], Any]]] = {
    "str": str,
    "int": _whole,
    "float": _real,
    "bool": lambda text: yaml.SafeLoader.bool_values[text.lower()],
    "null": lambda _: None,
}


def _value_of(node: yaml.Node, level: int, seen: set[int]) -> Any:
    """What a node says: a mapping with texts as keys, a list, a text, a number, true or false, or nothing.

    PyYAML's own constructors let the second of two equal keys win and raise nearly anything on values that do not fit
    their tags; aliases of aliases say more than any message could repeat.
    """
    line = node.start_mark.line + 1
    kind = str(node.tag).removeprefix(_TAG)
    if level > _DEEPEST:
        raise UnusableYamlError(f"is nested more than {_DEEPEST} levels deep, expected fewer", line)
    if id(node) in seen:
        raise UnusableYamlError("repeats a value by an alias, expected none", line)
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode) and kind == "map":
        entries: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = _value_of(key_node, level + 1, seen)
            if not isinstance(key, str):
                raise UnusableYamlError(f"a key is {shown(repr(key))}, expected a text", line)
            if key in entries:
                raise UnusableYamlError(f"key '{shown(key)}' comes a second time", line)
            entries[key] = _value_of(value_node, level + 1, seen)
        return entries
    if isinstance(node, yaml.SequenceNode) and kind == "seq":
        return [_value_of(one, level + 1, seen) for one in node.value]
    convert = _SCALARS.get(kind)
    if convert is None or not isinstance(node, yaml.ScalarNode):
        raise UnusableYamlError(f"found a value of type {shown(kind)}, expected texts, numbers and lists", line)
    if len(node.value) > _LONGEST_SCALAR:
        raise UnusableYamlError(f"a value has {len(node.value)} characters, expected {_LONGEST_SCALAR} at most", line)
    try:
        return convert(node.value)
    except (ValueError, KeyError):
        raise UnusableYamlError(f"'{shown(node.value)}' is not of type {shown(kind)}", line) from None
