"""One small bug of the kind a maintainer makes, and the tests of which at least one must fail for it."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

LIST = Path(__file__).parent / "bugs.yaml"
_NEEDED, _MORE = {"name", "file", "old", "new", "tests"}, {"quick", "survives"}


class BugListError(ValueError):
    """The list of bugs, or a bug in it, is not as it has to be."""


@dataclass(frozen=True)
class Bug:
    """A text of a file that is replaced by another.

    file: from the repository's root; old stands there exactly once. tests: arguments of pytest, for tests of which at
    least one must fail. quick: whether it is tried in CI. survives: why no test fails for it;
    empty where one must.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    quick: bool = False
    survives: str = ""

    def put_into(self, root: Path) -> str:
        """Replace the text in the copy under `root`; returns what the file held before."""
        path = root / self.file
        before = path.read_text(encoding="utf-8")
        if (found := before.count(self.old)) != 1:
            raise BugListError(f"bug '{self.name}': its old text stands {found} times in {self.file}, expected once")
        path.write_text(before.replace(self.old, self.new), encoding="utf-8")
        return before


def read_bugs(path: Path = LIST) -> list[Bug]:
    """The bugs of a list; BugListError where it is malformed."""
    bugs = [_bug(entry, f"{path}: bug {number}") for number, entry in enumerate(yaml.safe_load(path.read_text()), 1)]
    names = [bug.name for bug in bugs]
    for name in names:
        if names.count(name) > 1:
            raise BugListError(f"{path}: two bugs are called '{name}', expected distinct names")
    return bugs


def _bug(entry: dict[str, Any], where: str) -> Bug:
    if missing := _NEEDED - entry.keys():
        raise BugListError(f"{where} has no {', '.join(sorted(missing))}")
    if unknown := entry.keys() - _NEEDED - _MORE:
        raise BugListError(f"{where} has an unknown key {', '.join(sorted(unknown))}")
    if entry["old"] == entry["new"]:
        raise BugListError(f"{where}, '{entry['name']}', changes nothing")
    return Bug(**{**entry, "tests": tuple(shlex.split(entry["tests"]))})
