"""The list of bugs fits the code, and a bug that the tests do not notice is told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from mutants.__main__ import described, try_all
from mutants.bug import Bug, BugListError, read_bugs
from mutants.copy import REPOSITORY, UnsoundTestsError

# Every room of the package, each a folder or a file at its top.
ROOMS = (
    "matching",
    "solvers",
    "geometry",
    "spots",
    "nodes",
    "dicom",
    "reception",
    "cli",
    "simulation",
    "calibration",
    "files",
    "frames",
)


def test_every_bug_fits_the_code_and_names_tests_that_are_there() -> None:
    bugs = read_bugs()
    assert len(bugs) >= 120
    for bug in bugs:
        found = (REPOSITORY / bug.file).read_text(encoding="utf-8").count(bug.old)
        assert found == 1, f"{bug.name}: its old text stands {found} times in {bug.file}"
        assert (REPOSITORY / bug.tests[0].split("::")[0]).is_file(), bug.name


@pytest.mark.parametrize("room", ROOMS)
def test_there_are_bugs_in_every_room(room: str) -> None:
    assert any(bug.file.split("/")[1] == room for bug in read_bugs())


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A small one, with a test that notices one of two bugs."""
    root = tmp_path / "small"
    root.mkdir()
    (root / ".gitignore").write_text("/.venv\n")
    (root / "sums.py").write_text("def total(a, b):\n    return a + b\n\n\ndef least(a, b):\n    return min(a, b)\n")
    (root / "test_sums.py").write_text("from sums import total\n\n\ndef test_total():\n    assert total(1, 2) == 3\n")
    (root / ".venv" / "bin").mkdir(parents=True)
    # A link would have Python look for its packages beside itself.
    python = root / ".venv" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    subprocess.run(["git", "init", "--quiet"], cwd=root, check=True)
    return root


NOTICED = Bug("minus", "sums.py", "a + b", "a - b", ("test_sums.py",))
UNNOTICED = Bug("most", "sums.py", "min(", "max(", ("test_sums.py",))


def test_what_is_noticed_and_what_is_not(repository: Path) -> None:
    before = (repository / "sums.py").read_text()
    runs = try_all([NOTICED, UNNOTICED], 2, repository)
    assert [run.failed for run in runs] == ["test_sums.py::test_total", ""]
    table, wrong = described([NOTICED, UNNOTICED], runs)
    assert wrong == 1
    assert "NOT NOTICED" in table.splitlines()[1]
    assert table.splitlines()[-1] == "1 of 2 bugs noticed, 1 otherwise than the list has it"
    assert (repository / "sums.py").read_text() == before


def test_a_reason_excuses_a_bug_only_as_long_as_it_survives(repository: Path) -> None:
    because = "no test is meant to"
    bugs = [Bug(**{**vars(bug), "survives": because}) for bug in (NOTICED, UNNOTICED)]
    table, wrong = described(bugs, try_all(bugs, 1, repository))
    assert wrong == 1
    assert "though a reason stands beside it" in table.splitlines()[0]
    assert because in table.splitlines()[1]


def test_tests_that_fail_without_a_bug_are_no_measure(repository: Path) -> None:
    (repository / "test_sums.py").write_text("def test_total():\n    assert False\n")
    with pytest.raises(UnsoundTestsError, match=r"test_sums\.py::test_total fails without a bug"):
        try_all([NOTICED], 1, repository)


def test_tests_that_are_not_there_are_told(repository: Path) -> None:
    with pytest.raises(UnsoundTestsError, match="ended with status 4"):
        try_all([Bug("minus", "sums.py", "a + b", "a - b", ("test_other.py",))], 1, repository)


def test_a_bug_that_does_not_fit_the_code_is_named(repository: Path) -> None:
    with pytest.raises(BugListError, match="bug 'gone': its old text stands 0 times in sums"):
        try_all([Bug("gone", "sums.py", "a * b", "a - b", ("test_sums.py",))], 1, repository)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("- {name: a, file: f, old: x, new: y}", "bug 1 has no tests"),
        ("- {name: a, file: f, old: x, new: y, tests: t, odd: 1}", "bug 1 has an unknown key odd"),
        ("- {name: a, file: f, old: x, new: x, tests: t}", "bug 1, 'a', changes nothing"),
        ("- &a {name: a, file: f, old: x, new: y, tests: t}\n- *a", "two bugs are called 'a'"),
    ],
)
def test_a_malformed_list_is_told(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "bugs.yaml").write_text(text)
    with pytest.raises(BugListError, match=sentence):
        read_bugs(tmp_path / "bugs.yaml")
