"""What a node was given at its start, on the command line or in files, and would drop without a word."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import yaml
from rclpy.node import Node

from stereoreg_ros.nodes.common.parameters import ParameterError

_SECTION: Final = "ros__parameters"


def require_declared(node: Node, arguments: Sequence[str] = tuple(sys.argv)) -> None:
    """Raise ParameterError where a start value is for a parameter that the node has not declared, or a file for others.

    rclpy keeps such values until somebody declares them: a limit with a misspelt name would not hold.
    """
    name = node.get_fully_qualified_name()
    for file in _parameter_files(arguments):
        sections = [*_sections(yaml.safe_load(Path(file).read_text(encoding="utf-8")))]
        if sections and not any(_is_for(section, name) for section in sections):
            raise ParameterError(
                f"parameter file {file} has values for {', '.join(sections)} and none for {name}, "
                "expected a section of this node's name, or /**"
            )
    # There is no public way to what was given and not declared.
    given, declared = node._parameter_overrides, node._parameters
    for parameter in sorted(given.keys() - declared.keys()):
        nearest = get_close_matches(parameter, declared, 1)
        raise ParameterError(
            f"{parameter} is no parameter of {name}" + (f", did you mean {nearest[0]}?" if nearest else "")
        )


def _parameter_files(arguments: Sequence[str]) -> list[str]:
    return [file for flag, file in pairwise(arguments) if flag == "--params-file"]


def _sections(content: Any, name: str = "") -> Iterator[str]:
    """Names of nodes, maybe with wildcards, that a parameter file has values for; namespaces may be levels of it."""
    if not isinstance(content, dict):
        return
    for key, value in content.items():
        if key == _SECTION:
            yield name or "/"
        else:
            yield from _sections(value, f"{name}/{str(key).strip('/')}")


def _is_for(section: str, name: str) -> bool:
    """Whether a section is for a node: * stands for one level of its name, ** for any number."""
    pattern = re.escape(section).replace(r"/\*\*", r"(/[^/]+)*").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, name) is not None
