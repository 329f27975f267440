"""The page of promises names a test for every fault, and every test that it names is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

TESTS = Path(__file__).parents[1]
PAGE = TESTS.parent / "docs" / "promises.md"
_NAMED = re.compile(r"`(test_\w+\.py)::(test_\w+)`")


def rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    start = lines.index("| fault | detection | reaction | test |") + 2
    table = [line for line in lines[start:] if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table[: lines[start:].index("")]]


def functions_of(file: str) -> set[str]:
    (path,) = TESTS.rglob(file)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_fault_has_a_reaction_and_tests_that_are_there():
    assert len(rows()) >= 20
    for fault, _, reaction, tests in rows():
        assert reaction, fault
        named = _NAMED.findall(tests)
        assert named, fault
        # Nothing that only looks like a name.
        assert len(named) == tests.count("`") // 2, fault
        for file, function in named:
            assert function in functions_of(file), f"{fault}: {file}::{function}"
