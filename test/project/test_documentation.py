"""The files and names that the README and the pages of docs point to exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PACKAGE = REPOSITORY / "stereoreg_ros"
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
# A path that ends in .py, without the test that may follow it.
_FILE = re.compile(r"`([\w/-]+\.py)(?:::\w+)?`")
_FILE_AND_NAMES = re.compile(r"`([\w/]+\.py)`(?:: ((?:`\w+`(?:, )?)+))?")


def page_name(page: Path) -> str:
    return page.relative_to(REPOSITORY).as_posix()


def existing_files() -> list[str]:
    rooms = ("stereoreg_ros", "test", "benchmarks", "fuzzing", "docs", "launch")
    found = [path for room in rooms for path in (REPOSITORY / room).rglob("*.py")]
    return ["/" + path.relative_to(REPOSITORY).as_posix() for path in (*found, REPOSITORY / "setup.py")]


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    existing = existing_files()
    named = set(_FILE.findall(page.read_text(encoding="utf-8")))
    assert not [name for name in named if not any(path.endswith(f"/{name}") for path in existing)]


def equations() -> list[tuple[str, str]]:
    """First and last cell of the rows of the index of equations."""
    lines = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()
    start = lines.index("| equation | what it says | where |") + 2
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[start : lines.index("", start)]]
    return [(row[0], row[-1]) for row in rows]


def test_the_index_has_every_equation_of_the_paper_once() -> None:
    numbers = []
    for which, _ in equations():
        if which.startswith("section"):
            continue
        first_and_last = [int(number) for number in which.split(" to ")] if " to " in which else []
        of_row = range(first_and_last[0], first_and_last[1] + 1) if first_and_last else map(int, which.split(", "))
        numbers += [*of_row]
    assert sorted(numbers) == [*range(1, 33)]


@pytest.mark.parametrize(("which", "where"), equations(), ids=[which for which, _ in equations()])
def test_every_equation_is_where_the_index_says(which: str, where: str) -> None:
    places = _FILE_AND_NAMES.findall(where)
    assert places, which
    for file, names in places:
        tree = ast.parse((PACKAGE / file).read_text(encoding="utf-8"))
        defined = {node.name for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
        assert set(re.findall(r"\w+", names)) <= defined, file


def test_the_page_of_the_architecture_names_classes_of_the_package() -> None:
    text = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([A-Z][a-z]+\w*)`", text))
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")]
    classes = {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    assert {"IncomingSlice", "SliceSpots", "Problem", "PoseEstimate"} <= named
    assert named <= classes
