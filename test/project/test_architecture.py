"""Imports run one way, and the core knows nothing of ROS."""

from __future__ import annotations

import ast
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import stereoreg_ros
from stereoreg_ros import options
from stereoreg_ros.matching import MATCHERS

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
    "reception": {"files", "geometry", "dicom"},
    "matching": {"geometry", "options", "solvers"},
    "result": {"geometry", "options", "uncertainty"},
    "judgement": {"geometry", "options", "matching", "result"},
    "estimation": {"geometry", "solvers", "matching", "judgement", "result", "uncertainty"},
    "registration": {"geometry", "options", "spots", "matching", "estimation", "judgement", "result", "uncertainty"},
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


@pytest.mark.parametrize("path", [p for p in MODULES if own_part(p) == "nodes"], ids=name_of)
def test_each_room_of_nodes_knows_what_all_have_in_common_and_itself(path: Path) -> None:
    room = path.relative_to(PACKAGE).parts[1]
    used = {module.split(".")[2] for module in imported(path) if module.startswith("stereoreg_ros.nodes.")}
    assert used <= {room, "common"}


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


REPOSITORY = PACKAGE.parent
TESTS = sorted((REPOSITORY / "test").rglob("*.py"))
PROGRAMS = ("benchmarks", "fuzzing", "mutants")


def within(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


@pytest.mark.parametrize("path", TESTS, ids=within)
def test_tests_share_code_through_support_alone(path: Path) -> None:
    """Not through benchmarks, and not through another test: what two of them need lies in test/support."""
    tests = {other.stem for other in TESTS if other.stem.startswith("test_")}
    assert not {module for module in imported(path) if module.split(".")[0] in {"benchmarks", "test", *tests}}


@pytest.mark.parametrize(
    "path", [path for name in PROGRAMS for path in sorted((REPOSITORY / name).rglob("*.py"))], ids=within
)
def test_programs_beside_the_tests_share_code_through_support_alone(path: Path) -> None:
    """Found as an installed module is: nothing is put into the path where it runs."""
    assert "sys.path" not in path.read_text(encoding="utf-8")
    others = set(PROGRAMS) - {path.relative_to(REPOSITORY).parts[0]}
    tests = {other.stem for other in TESTS if other.stem.startswith("test_")}
    assert not {module for module in imported(path) if module.split(".")[0] in {"test", *others, *tests}}


MOST_PARAMETERS = 6


def functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]


def takes_too_many(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether it has more than six parameters; of public functions, those with a default are free."""
    given = function.args
    names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    count = len(names) - (names[:1] in (["self"], ["cls"]))
    if not function.name.startswith("_"):
        count -= len(given.defaults) + sum(one is not None for one in given.kw_defaults)
    return count > MOST_PARAMETERS


@pytest.mark.parametrize(
    ("source", "too_many"),
    [
        ("def f(a, b, c, d, e, f): ...", False),
        ("def f(a, b, c, d, e, f, g): ...", True),
        ("def f(self, a, b, c, d, e, f): ...", False),
        ("def f(a, b, c, d, e, f, g=1, *, h=2): ...", False),
        ("def f(a, b, c, d, e, f, *, g, h=2): ...", True),
        ("def _f(a, b, c, d, e, f, g=1): ...", True),
    ],
)
def test_parameters_are_counted(source: str, too_many: bool) -> None:
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    assert takes_too_many(function) is too_many


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_no_function_takes_more_than_six_parameters(path: Path) -> None:
    assert [one.name for one in functions(path) if takes_too_many(one)] == []


# What is kept for the whole process: of pure functions of small arguments, a frame by what it says among them; and the
# tables of the last few frames, for those who register without a `Registrar`.
KEPT = {
    "matching/pose_volume.py: low_stretch",
    "matching/pose_volume.py: plane_sample",
    "matching/triple_order.py: _usable",
    "matching/triple_order.py: further_triples",
    "matching/triple_order.py: triple_order",
    "registration.py: _kept",
    "simulation/patient.py: background",
    "simulation/rendering.py: _disc",
    "simulation/rendering.py: _gauss_legendre",
    "spots/symmetry.py: _spline_coefficients",
}


def test_nothing_else_is_kept_for_the_whole_process() -> None:
    found = {
        f"{name_of(path)}: {one.name}"
        for path in MODULES
        for one in functions(path)
        if any("cache" in ast.unparse(decorator) for decorator in one.decorator_list)
    }
    assert found == KEPT


def test_the_table_of_matchers_holds_those_that_can_be_chosen() -> None:
    assert set(MATCHERS) == set(options.MATCHERS)
