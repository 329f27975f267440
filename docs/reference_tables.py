"""Directives that generate the reference from the code: parameters, topics, services, reasons, keys, commands, imports.

For a name without a description in the code, the meaning is taken from the README or from the lines of the directive. A
name without a meaning, or a meaning without a name, is a warning, and warnings fail the build.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import rclpy
import yaml
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from stereoreg_ros import PixelScale, load_frame, register_spots
from stereoreg_ros.cli import main as command_line
from stereoreg_ros.nodes.common.parameters import Entry, entries_of
from stereoreg_ros.nodes.register import parameters
from stereoreg_ros.nodes.register.register_node import RegisterNode
from stereoreg_ros.nodes.scanner import play_dicom_node
from stereoreg_ros.nodes.scanner.reception_parameters import ReceptionSettings
from stereoreg_ros.nodes.scanner.simulate_node import SimulationSettings
from stereoreg_ros.result import REASONS, diagnostics

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
PARAMETERS: dict[str, tuple[Entry, ...]] = {
    "register_node": parameters.ENTRIES,
    "simulate_node": entries_of(SimulationSettings),
    "play_dicom_node": play_dicom_node.ENTRIES,
    "receive_dicom_node": entries_of(ReceptionSettings),
}
# Topics and services that every ROS node has.
_OF_ROS = re.compile(r"/rosout|/parameter_events|.*/(get|set|list|describe)_parameter\w*|.*/get_type_description")


class _Table(SphinxDirective):
    """A directive that produces a table."""

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[nodes.Node]:
        lines = [head, ["---"] * len(head), *rows]
        text = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
        return self.parse_text_to_nodes(text)

    def check(self, names: Iterable[str], meanings: Mapping[str, str]) -> None:
        names = set(names)
        for fault, of_these in (("has no meaning", names - set(meanings)), ("is not there", set(meanings) - names)):
            for name in sorted(of_these):
                self.state.document.reporter.warning(f"{self.name}: {name} {fault}", line=self.lineno)


class ParameterTable(_Table):
    """The parameters of one node, from the table from which the node declares them."""

    required_arguments: ClassVar[int] = 1

    def run(self) -> list[nodes.Node]:
        rows = [
            (f"`{entry.name}`", f"`{_value(entry.value)}`", _allowed(entry), entry.description)
            for entry in PARAMETERS[self.arguments[0]]
        ]
        return self.table(("name", "default", "allowed", "meaning"), rows)


def _value(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True)
    return text.removesuffix("\n...\n").strip()


def _allowed(entry: Entry) -> str:
    if entry.low is None or entry.high is None:
        return str(entry.descriptor.additional_constraints)
    word = f", or `{entry.word}`" if entry.word else ""
    return f"{entry.low:g} to {entry.high:g}{word}"


class InterfaceTable(_Table):
    """Topics and services of a register_node started for this purpose; their meanings come from the README's table."""

    def run(self) -> list[nodes.Node]:
        # Keep it invisible to others on the network.
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"
        rclpy.init(args=["--ros-args", "--log-level", "warn"])
        node = RegisterNode()
        found: list[tuple[str, str, Any]] = [
            *(("in", one.topic_name, one.msg_type) for one in node.subscriptions),
            *(("out", one.topic_name, one.msg_type) for one in node.publishers),
            *(("service", one.srv_name, one.srv_type) for one in node.services),
        ]
        node.destroy_node()
        rclpy.shutdown()
        ours = [(kind, _relative(name), _type(of)) for kind, name, of in found if not _OF_ROS.fullmatch(name)]
        # One row may describe two names.
        shown = {name: row[3] for row in _readme_rows(4) for name in row[1].strip("`").split("`, `")}
        self.check((name for _, name, _ in ours), shown)
        rows = [(kind, f"`{name}`", of, _of_this_site(shown.get(name, ""))) for kind, name, of in ours]
        return self.table(("", "name", "type", "meaning"), rows)


def _relative(name: str) -> str:
    """The name as the README writes it: relative to the namespace or the node."""
    if name.startswith("/register_node/"):
        return name.replace("/register_node/", "~/")
    return name if name == "/diagnostics" else name.removeprefix("/")


def _type(of: type) -> str:
    return f"{of.__module__.split('.')[0]}/{of.__name__}"


class ReasonTable(_Table):
    """The reasons of a refusal; their meanings come from the README's table."""

    def run(self) -> list[nodes.Node]:
        texts = {row[0].strip("`"): [_of_this_site(text) for text in row[1:]] for row in _readme_rows(3)}
        self.check(REASONS, {name: text[0] for name, text in texts.items()})
        return self.table(
            ("reason", "meaning", "what helps"), [(f"`{name}`", *texts.get(name, ("", ""))) for name in REASONS]
        )


def _readme_rows(columns: int) -> list[list[str]]:
    """The rows of all tables of the README with this number of columns, without the header rows."""
    lines = README.read_text(encoding="utf-8").splitlines()
    below_head = [
        line for line, next_line in zip(lines, [*lines[1:], ""], strict=True) if "|---|" not in line + next_line
    ]
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in below_head if line.startswith("|")]
    return [row for row in rows if len(row) == columns]


def _of_this_site(text: str) -> str:
    """The text with the README's links rewritten for a page of the reference."""
    return text.replace("](docs/", "](../")


class DiagnosticKeyTable(_Table):
    """The diagnostic keys, from a registration; the lines of the directive give their meanings: `key: meaning`."""

    has_content: ClassVar[bool] = True

    def run(self) -> list[nodes.Node]:
        meanings: dict[str, str] = yaml.safe_load("\n".join(self.content))
        keys = list(diagnostics(register_spots(np.empty((0, 2)), load_frame("cube6"), PixelScale(1, 1)), "", 0.0))
        self.check(keys, meanings)
        return self.table(("key", "meaning"), [(f"`{key}`", meanings.get(key, "")) for key in keys])


class CommandHelp(SphinxDirective):
    """The output of `stereoreg ... --help`."""

    optional_arguments: ClassVar[int] = 1

    def run(self) -> list[nodes.Node]:
        os.environ["COLUMNS"] = "100"
        said = StringIO()
        with redirect_stdout(said), suppress(SystemExit):
            command_line([*self.arguments, "--help"])
        return [nodes.literal_block(said.getvalue(), said.getvalue(), language="text")]


class ImportTable(_Table):
    """Which room may import which, from the test that enforces it."""

    def run(self) -> list[nodes.Node]:
        test = REPOSITORY / "test" / "project" / "test_architecture.py"
        (allowed,) = [
            ast.literal_eval(one.value)
            for one in ast.parse(test.read_text(encoding="utf-8")).body
            if isinstance(one, ast.AnnAssign) and one.value is not None and ast.unparse(one.target) == "MAY_IMPORT"
        ]
        rows = [
            (f"`{room}`", ", ".join(f"`{other}`" for other in sorted(others)) or "nothing of the package")
            for room, others in allowed.items()
        ]
        return self.table(("room", "may import"), rows)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_directive("parameters", ParameterTable)
    app.add_directive("topics-and-services", InterfaceTable)
    app.add_directive("reasons", ReasonTable)
    app.add_directive("diagnostic-keys", DiagnosticKeyTable)
    app.add_directive("command-help", CommandHelp)
    app.add_directive("imports", ImportTable)
    return {"parallel_read_safe": False}
