"""Imports run one way, and the core knows nothing of ROS."""

from __future__ import annotations

import ast
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import stereoreg_ros

PACKAGE = Path(stereoreg_ros.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# What each part may import of the package, itself apart. A part that is not listed is at the rim: all but nodes.
MAY_IMPORT: dict[str, set[str]] = {
    "files": set(),
    "geometry": {"files"},
    "options": {"geometry"},
    "spots": {"geometry", "options"},
    "solvers": {"geometry"},
    "uncertainty": {"geometry"},
    "simulation": {"geometry"},
    "dicom": {"files", "geometry"},
    "reception": {"geometry", "dicom"},
    "matching": {"geometry", "options", "solvers"},
    "result": {"geometry", "options", "uncertainty"},
    "judgement": {"geometry", "options", "matching", "result"},
    "registration": {"geometry", "options", "spots", "solvers", "matching", "judgement", "result", "uncertainty"},
    "calibration": {"files", "geometry", "options", "spots", "solvers", "result", "registration", "uncertainty"},
    "worst_case": {"geometry", "solvers", "result"},
    "drawing": {"geometry", "options", "result", "registration"},
}


def part_of(module: str) -> str:
    """The part of the package that a module `stereoreg_ros.x.y` belongs to; the package itself is a part of no name."""
    return [*module.split("."), ""][1]


def imported(path: Path) -> set[str]:
    """Every module that a file imports, wherever in the file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: relative import, expected full names"
            assert node.module is not None
            # `from stereoreg_ros.nodes import conversions` may name a module in either place.
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def own_part(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def test_the_parts_exist() -> None:
    assert set(MAY_IMPORT) <= {own_part(path) for path in MODULES}


@pytest.mark.parametrize("path", [p for p in MODULES if own_part(p) != "nodes"], ids=name_of)
def test_imports_run_one_way(path: Path) -> None:
    part = own_part(path)
    parts = {own_part(module) for module in MODULES}
    used = {part_of(module) for module in imported(path) if module.startswith("stereoreg_ros.")} & parts - {part}
    assert "nodes" not in used
    if part in MAY_IMPORT:
        assert used <= MAY_IMPORT[part]
        # The package itself imports nearly all of them.
        assert "stereoreg_ros" not in imported(path)


@pytest.mark.parametrize("path", [p for p in MODULES if own_part(p) != "nodes"], ids=name_of)
def test_only_nodes_import_ros(path: Path) -> None:
    assert not {module for module in imported(path) if is_ros(module)}


def is_ros(module: str) -> bool:
    top = module.split(".")[0]
    return top in {"rclpy", "builtin_interfaces", "rcl_interfaces", "std_srvs"} or top.endswith("_msgs")


def test_the_core_runs_without_ros() -> None:
    core = [
        module.name
        for module in pkgutil.walk_packages([str(PACKAGE)], "stereoreg_ros.")
        if part_of(module.name) not in {"nodes", "__main__"}
    ]
    assert "stereoreg_ros.registration" in core
    assert "stereoreg_ros.geometry.pose" in core
    program = f"import importlib, sys\nfor name in {core!r}: importlib.import_module(name)\nprint(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 0, ran.stderr
    loaded = ran.stdout.split()
    assert set(core) <= set(loaded)
    assert not [module for module in loaded if is_ros(module)]
    assert not [module for module in loaded if module.startswith("stereoreg_ros.nodes")]
