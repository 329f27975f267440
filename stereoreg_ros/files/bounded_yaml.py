"""YAML from outside, composed to nodes but not to Python objects, within limits of size and depth."""

from __future__ import annotations

from typing import Final

import yaml

MOST_BYTES: Final = 65536
# A frame of 60 rods has 1000 nodes; PyYAML takes 30 us for one.
_MOST_NODES: Final = 4000
_MOST_LEVELS: Final = 20
_SHOWN: Final = 60


class UnusableYamlError(ValueError):
    """Text that is not YAML, or exceeds the limits. line: where, from 1, or None."""

    def __init__(self, problem: str, line: int | None = None) -> None:
        super().__init__(problem)
        self.problem = problem
        self.line = line


def compose(content: bytes) -> yaml.Node | None:
    """The root node of the only document of a file of at most MOST_BYTES; None where the file is empty.

    An alias is the same node again: a walk over the nodes must limit its own depth.
    Raises UnusableYamlError.
    """
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise UnusableYamlError("is not UTF-8 text, expected YAML") from None
    try:
        root: yaml.Node | None = _BoundedLoader(text).get_single_node()
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise UnusableYamlError(f"is not valid YAML: {error.reason}", line) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        problem = shown(error.problem or error.context or "")
        raise UnusableYamlError(f"is not valid YAML: {problem}", mark.line + 1 if mark else None) from None
    # The scanner converts the digits of \U, of a directive's version and of an indentation to numbers without a check.
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        if isinstance(error, UnusableYamlError):
            raise
        raise UnusableYamlError(f"is not valid YAML: {shown(str(error))}") from None
    return root


def shown(text: str) -> str:
    """Text from a file as a message may quote it: in one line, and short."""
    printable = "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)
    return printable if len(printable) <= _SHOWN else f"{printable[:_SHOWN]}..."


class _BoundedLoader(yaml.SafeLoader):
    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nodes = 0
        self._levels = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        line = self.peek_event().start_mark.line + 1  # type: ignore[no-untyped-call]
        self._nodes += 1
        if self._nodes > _MOST_NODES:
            raise UnusableYamlError(f"holds more than {_MOST_NODES} values, expected fewer", line)
        self._levels += 1
        if self._levels > _MOST_LEVELS:
            raise UnusableYamlError(f"is nested more than {_MOST_LEVELS} levels deep, expected fewer", line)
        node = super().compose_node(parent, index)
        self._levels -= 1
        return node
