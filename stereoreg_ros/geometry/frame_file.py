"""Frames from YAML files; every fault is reported with file, line and key.

A file whose axes are left-handed, or whose rods are mirrored, cannot be recognised here, nor by a single slice, which
it fits exactly: only a series shows it, by a frame at rest that seems to move.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from stereoreg_ros.files.bounded_yaml import MOST_BYTES, UnusableYamlError, compose, shown
from stereoreg_ros.files.whole_file import read_whole
from stereoreg_ros.geometry.frame import MIN_LINES, Frame
from stereoreg_ros.geometry.pose import Array

_MAX_LINES = 60
_MAX_NAME = 100
# Frames all of whose rods are shorter, or all longer, than this are not written in mm.
_SHORTEST_MM, _LONGEST_MM = 5.0, 2000.0
# A rod's ends must be known to this share of its length and of its distance from the next rod. With less, two rods
# could stand for each other, and a rod's direction would be known to 8 degrees only.
_LARGEST_TOLERANCE: Final = 0.1
# To which a frame is written: what was read may be a little shorter when it is read again.
_ROUNDED_MM: Final = 1e-3


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
    """The frame as the text of a frame file, under a comment; coordinates to a thousandth of a millimetre.

    A tolerance that all rods share stands with the frame, others with their rods, and unknown ones nowhere.
    """
    tolerances = frame.tolerances_or(np.nan)
    shared = float(tolerances[0]) if (tolerances == tolerances[0]).all() else None
    text = [f"# {line}".rstrip() for line in comment.splitlines()]
    text.append(f"name: {_quoted(frame.name)}")
    if shared is not None:
        text.append(f"tolerance_mm: {shared!r}")
    if frame.orientation_required:
        text.append("orientation_required: true")
    text.append("lines:")
    rods = zip(frame.line_names, frame.starts, frame.ends, frame.diameters, tolerances, strict=True)
    for name, start, end, diameter, tolerance in rods:
        points = [", ".join(f"{round(float(value), 3) + 0.0:.9g}" for value in point) for point in (start, end)]
        own = "" if shared is not None or np.isnan(tolerance) else f", tolerance_mm: {float(tolerance)!r}"
        text.append(
            f"  - {{name: {_quoted(name)}, from: [{points[0]}], to: [{points[1]}], diameter: {diameter:.9g}{own}}}"
        )
    return "\n".join(text) + "\n"


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


class _Rod(NamedTuple):
    """A rod as its file has it. tolerance: its own in mm, or None; tolerance_node: where that stands."""

    name: str
    start: list[float]
    end: list[float]
    diameter: float
    tolerance: float | None
    tolerance_node: yaml.Node | None


class _Reader:
    """Turns YAML nodes, which still know their lines, into a Frame."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fault(self, node: yaml.Node | None, key: str, found: str, expected: str) -> FrameFileError:
        where = f"line {node.start_mark.line + 1}, " if node is not None else ""
        return FrameFileError(f"{self.path}: {where}{key}: found {found}, expected {expected}")

    def frame(self, root: yaml.Node | None) -> Frame:
        entries = self.mapping(root, "frame file", ("name", "lines"), ("tolerance_mm", "orientation_required"))
        name = self.text(entries["name"], "name")
        lines = entries["lines"]
        if not isinstance(lines, yaml.SequenceNode):
            raise self.fault(lines, "lines", _kind(lines), "a list of rods")
        if not MIN_LINES <= len(lines.value) <= _MAX_LINES:
            expected = f"at least {MIN_LINES} and at most {_MAX_LINES} rods"
            raise self.fault(lines, "lines", f"{len(lines.value)} rods", expected)
        shared_node = entries.get("tolerance_mm")
        shared = None if shared_node is None else self.tolerance(shared_node, "tolerance_mm")
        required_node = entries.get("orientation_required")
        required = False if required_node is None else self.truth(required_node, "orientation_required")
        rods: list[_Rod] = []
        for number, node in enumerate(lines.value):
            rods.append(self.rod(node, f"lines[{number}]", {rod.name for rod in rods}))
        starts, ends = np.array([rod.start for rod in rods]), np.array([rod.end for rod in rods])
        self.check_unit(lines, starts, ends)
        self.check_tolerances(rods, starts, ends, shared, shared_node)
        default = np.nan if shared is None else shared
        return Frame(
            name,
            tuple(rod.name for rod in rods),
            starts,
            ends,
            np.array([rod.diameter for rod in rods]),
            np.array([default if rod.tolerance is None else rod.tolerance for rod in rods]),
            required,
        )

    def rod(self, node: yaml.Node, key: str, taken: set[str]) -> _Rod:
        """taken: names of the rods before it."""
        entries = self.mapping(node, key, ("name", "from", "to", "diameter"), ("tolerance_mm",))
        name = self.text(entries["name"], f"{key}.name")
        if name in taken:
            raise self.fault(entries["name"], f"{key}.name", f"'{name}' a second time", "distinct names")
        start, end = self.point(entries["from"], f"{key}.from"), self.point(entries["to"], f"{key}.to")
        if np.linalg.norm(np.subtract(end, start)) < 1e-6:
            raise self.fault(entries["to"], f"{key}.to", "the same point as 'from'", "a rod with a length")
        diameter = self.number(entries["diameter"], f"{key}.diameter")
        if diameter <= 0:
            raise self.fault(entries["diameter"], f"{key}.diameter", f"{diameter:g}", "a positive length in mm")
        tolerance_node = entries.get("tolerance_mm")
        tolerance = None if tolerance_node is None else self.tolerance(tolerance_node, f"{key}.tolerance_mm")
        return _Rod(name, start, end, diameter, tolerance, tolerance_node)

    def check_unit(self, lines: yaml.Node, starts: Array, ends: Array) -> None:
        """Refuse a frame that was written in another unit: its search would take minutes and find nothing."""
        lengths = np.linalg.norm(ends - starts, axis=1)
        if (lengths < _SHORTEST_MM).all() or (lengths > _LONGEST_MM).all():
            found = f"rods of {lengths.min():.3g} to {lengths.max():.3g}"
            expected = f"at least one of {_SHORTEST_MM:g} to {_LONGEST_MM:g} mm; metres or inches instead of mm?"
            raise self.fault(lines, "lines", found, expected)

    def check_tolerances(
        self, rods: list[_Rod], starts: Array, ends: Array, shared: float | None, shared_node: yaml.Node | None
    ) -> None:
        """Refuse tolerances with which rods could stand for each other."""
        lengths = np.linalg.norm(ends - starts, axis=1)
        nearest, apart = _nearest_rods(starts, ends)
        for row, rod in enumerate(rods):
            tolerance = shared if rod.tolerance is None else rod.tolerance
            if tolerance is None or tolerance <= _LARGEST_TOLERANCE * min(lengths[row], apart[row]) + _ROUNDED_MM:
                continue
            node, key = shared_node, "tolerance_mm"
            if rod.tolerance is not None:
                node, key = rod.tolerance_node, f"lines[{row}].{key}"
            if lengths[row] <= apart[row]:
                limit = f"the {lengths[row]:.3g} mm that rod '{rod.name}' is long"
            else:
                limit = f"the {apart[row]:.3g} mm between rods '{rod.name}' and '{rods[nearest[row]].name}'"
            raise self.fault(node, key, f"{tolerance:g}", f"at most a tenth of {limit}")

    def mapping(
        self, node: yaml.Node | None, key: str, required: tuple[str, ...], optional: tuple[str, ...]
    ) -> dict[str, yaml.Node]:
        expected = f"the keys {', '.join(required)}, and if wanted {', '.join(optional)}"
        if not isinstance(node, yaml.MappingNode):
            raise self.fault(node, key, _kind(node), expected)
        entries: dict[str, yaml.Node] = {}
        for key_node, value in node.value:
            name = key_node.value if isinstance(key_node, yaml.ScalarNode) else _kind(key_node)
            if name not in required + optional:
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

    def tolerance(self, node: yaml.Node, key: str) -> float:
        value = self.number(node, key)
        if value < 0:
            raise self.fault(node, key, f"{value:g}", "a standard deviation in mm, 0 or more")
        return value

    def truth(self, node: yaml.Node, key: str) -> bool:
        is_bool = isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:bool"
        value = yaml.SafeLoader.bool_values.get(node.value.lower()) if is_bool else None
        if value is None:
            raise self.fault(node, key, _kind(node), "true or false")
        return value

    def point(self, node: yaml.Node, key: str) -> list[float]:
        if not isinstance(node, yaml.SequenceNode) or len(node.value) != 3:
            found = f"{len(node.value)} numbers" if isinstance(node, yaml.SequenceNode) else _kind(node)
            raise self.fault(node, key, found, "three numbers [x, y, z] in mm")
        return [self.number(child, f"{key}[{axis}]") for child, axis in zip(node.value, "xyz", strict=True)]


def _nearest_rods(starts: Array, ends: Array) -> tuple[NDArray[np.intp], Array]:
    """For each rod the one that it is most like (n,), and the distance (n,) in mm between the two.

    The distance is that of the two rods as a whole (Hausdorff's): the largest from an end of one to the other. Rods
    that meet in a corner, as those of an N, are not near each other.
    """
    span = ends - starts
    offset = np.stack([starts, ends], axis=1)[:, :, None] - starts
    share = np.clip(np.einsum("iejx,jx->iej", offset, span) / np.einsum("jx,jx->j", span, span), 0.0, 1.0)
    from_ends = np.linalg.norm(offset - share[..., None] * span, axis=-1).max(axis=1)
    apart = np.maximum(from_ends, from_ends.T)
    np.fill_diagonal(apart, np.inf)
    return apart.argmin(axis=1), apart.min(axis=1)


def _kind(node: yaml.Node | None) -> str:
    if node is None:
        return "an empty file"
    if isinstance(node, yaml.ScalarNode):
        return f"'{shown(node.value)}'" if node.value else "nothing"
    return "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"
