"""Paths as a user typed them where no shell expands `~`, as in the arguments of a launch file."""

from __future__ import annotations

from pathlib import Path


def expanded(name: str, given: str) -> str:
    """The path with `~` or `~user` in front replaced by that home folder.

    name: of the argument, for the ValueError that is raised where there is no such home. What does not begin
    with `~`, such as the name of a shipped frame, stays as it is.
    """
    if not given.startswith("~"):
        return given
    try:
        return str(Path(given).expanduser())
    except RuntimeError:
        raise ValueError(
            f"{name}: {given}: no such home folder, expected that of a user; give the whole path"
        ) from None


def existing_file(name: str, given: str) -> str:
    """The path, `~` expanded, of a file that is there; ValueError, by the argument's name, where it is not."""
    path = Path(expanded(name, given))
    if path.is_dir():
        raise ValueError(f"{name}: {path}: a folder, expected a file")
    if not path.exists():
        raise ValueError(f"{name}: {path}: no such file; nothing is started, as its values would silently be left out")
    return str(path)
