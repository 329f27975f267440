"""Frames from YAML files; every fault is told with file, line and key."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import yaml

from stereoreg_ros.bounded_yaml import MOST_BYTES, UnusableYamlError, compose, shown
from stereoreg_ros.geometry.frame import MIN_LINES, Frame
from stereoreg_ros.whole_file import read_whole

_MAX_LINES = 60
_MAX_NAME = 100


class FrameFileError(ValueError):
    """A frame file that cannot be used; the text names file, line and key, what was found and what was expected."""


def load_frame(source: str | os.PathLike[str]) -> Frame:
    """Frame from a YAML file, or a shipped frame by its name, such as `cube6`. Lengths in mm.

    A source without a folder and without an ending is a name; anything else is a path.
    Raises FrameFileError where the file is missing or wrong in any way.
    """
    path = Path(source)
    if path.suffix == "" and path.name == os.fspath(source) and not os.path.isfile(path):
        shipped = shipped_frames()
        if path.name not in shipped:
            raise FrameFileError(
                f"frame '{os.fspath(source):.200}' is neither a file nor a shipped frame; "
                f"shipped are: {', '.join(sorted(shipped))}"
            )
        path = shipped[path.name]
    try:
        root = compose(read_whole(path, MOST_BYTES))
    except OSError as error:
        raise FrameFileError(f"{path!s:.1000}: cannot be read: {error.strerror}, expected a frame file") from None
    except UnusableYamlError as error:
        where = f", line {error.line}" if error.line else ""
        raise FrameFileError(f"{path}{where}: {error.problem}") from None
    return _Reader(path).frame(root)


def frame_text(frame: Frame, comment: str) -> str:
    """The frame as the text of a frame file, under a comment; lengths to a thousandth of a millimetre."""
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += [f"name: {_quoted(frame.name)}", "lines:"]
    for name, start, end, diameter in zip(frame.line_names, frame.starts, frame.ends, frame.diameters, strict=True):
        points = [", ".join(f"{round(float(value), 3) + 0.0:g}" for value in point) for point in (start, end)]
        lines.append(f"  - {{name: {_quoted(name)}, from: [{points[0]}], to: [{points[1]}], diameter: {diameter:g}}}")
    return "\n".join(lines) + "\n"


def _quoted(name: str) -> str:
    """As it is where YAML takes it for the same text, else in quotes."""
    plain = name.isidentifier() and yaml.safe_load(name) == name
    return name if plain else json.dumps(name)


def shipped_frames() -> dict[str, Path]:
    """The frame files that come with the package, by name."""
    here = Path(__file__).resolve()
    # An installed package has its data under <prefix>/share; a source tree has config/ beside the package.
    for base in here.parents:
        for folder in (base / "share" / "stereoreg_ros" / "config" / "frames", base / "config" / "frames"):
            if folder.is_dir():
                return {path.stem: path for path in folder.glob("*.yaml")}
    return {}


class _Reader:
    """Turns YAML nodes, which still know their lines, into a Frame."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fault(self, node: yaml.Node | None, key: str, found: str, expected: str) -> FrameFileError:
        where = f"line {node.start_mark.line + 1}, " if node is not None else ""
        return FrameFileError(f"{self.path}: {where}{key}: found {found}, expected {expected}")

    def frame(self, root: yaml.Node | None) -> Frame:
        entries = self.mapping(root, "frame file", required=("name", "lines"))
        name = self.text(entries["name"], "name")
        lines = entries["lines"]
        if not isinstance(lines, yaml.SequenceNode):
            raise self.fault(lines, "lines", _kind(lines), "a list of rods")
        if not MIN_LINES <= len(lines.value) <= _MAX_LINES:
            expected = f"at least {MIN_LINES} and at most {_MAX_LINES} rods"
            raise self.fault(lines, "lines", f"{len(lines.value)} rods", expected)
        names: list[str] = []
        starts, ends, diameters = [], [], []
        for number, node in enumerate(lines.value):
            key = f"lines[{number}]"
            rod = self.mapping(node, key, required=("name", "from", "to", "diameter"))
            rod_name = self.text(rod["name"], f"{key}.name")
            if rod_name in names:
                raise self.fault(rod["name"], f"{key}.name", f"'{rod_name}' a second time", "distinct names")
            start, end = self.point(rod["from"], f"{key}.from"), self.point(rod["to"], f"{key}.to")
            if np.linalg.norm(np.subtract(end, start)) < 1e-6:
                raise self.fault(rod["to"], f"{key}.to", "the same point as 'from'", "a rod with a length")
            diameter = self.number(rod["diameter"], f"{key}.diameter")
            if diameter <= 0:
                raise self.fault(rod["diameter"], f"{key}.diameter", f"{diameter:g}", "a positive length in mm")
            names.append(rod_name)
            starts.append(start)
            ends.append(end)
            diameters.append(diameter)
        return Frame(name, tuple(names), np.array(starts), np.array(ends), np.array(diameters))

    def mapping(self, node: yaml.Node | None, key: str, required: tuple[str, ...]) -> dict[str, yaml.Node]:
        expected = f"the keys {', '.join(required)}"
        if not isinstance(node, yaml.MappingNode):
            raise self.fault(node, key, _kind(node), expected)
        entries: dict[str, yaml.Node] = {}
        for key_node, value in node.value:
            name = key_node.value if isinstance(key_node, yaml.ScalarNode) else _kind(key_node)
            if name not in required:
                raise self.fault(key_node, key, f"unknown key '{shown(name)}'", expected)
            if name in entries:
                raise self.fault(key_node, key, f"key '{name}' a second time", expected)
            entries[name] = value
        missing = [name for name in required if name not in entries]
        if missing:
            raise self.fault(node, key, f"no key '{missing[0]}'", expected)
        return entries

    def text(self, node: yaml.Node, key: str) -> str:
        if not isinstance(node, yaml.ScalarNode) or not str(node.value).strip():
            raise self.fault(node, key, _kind(node), "a name")
        name = str(node.value)
        # It goes into messages, which take no half of a surrogate pair, into pictures and onto terminals.
        if not name.isprintable() or len(name) > _MAX_NAME:
            raise self.fault(node, key, _kind(node), f"a name of at most {_MAX_NAME} printable characters")
        return name

    def number(self, node: yaml.Node, key: str) -> float:
        try:
            if not isinstance(node, yaml.ScalarNode):
                raise ValueError
            value = float(node.value)
        except ValueError:
            raise self.fault(node, key, _kind(node), "a number in mm") from None
        if not np.isfinite(value) or abs(value) > 1e5:
            raise self.fault(node, key, f"{value:g}", "a finite number in mm, at most 1e5")
        return value

    def point(self, node: yaml.Node, key: str) -> list[float]:
        if not isinstance(node, yaml.SequenceNode) or len(node.value) != 3:
            found = f"{len(node.value)} numbers" if isinstance(node, yaml.SequenceNode) else _kind(node)
            raise self.fault(node, key, found, "three numbers [x, y, z] in mm")
        return [self.number(child, f"{key}[{axis}]") for child, axis in zip(node.value, "xyz", strict=True)]


def _kind(node: yaml.Node | None) -> str:
    if node is None:
        return "an empty file"
    if isinstance(node, yaml.ScalarNode):
        return f"'{shown(node.value)}'" if node.value else "nothing"
    return "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"
