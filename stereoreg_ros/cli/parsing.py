"""Shared by the commands' parsers: arguments from the tables of options, and errors as one sentence."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Final, NoReturn, TypeAlias, TypeVar

from stereoreg_ros.options import CalibrationOptions, RegistrationOptions

OK: Final = 0
BAD_FILE: Final = 1
WRONG_CALL: Final = 2
INTERRUPTED: Final = 130


class WrongCallError(Exception):
    """The command cannot be run with these arguments; the text is one sentence."""


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one sentence."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_CALL, f"{self.prog}: {message}\n")


Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
_Options = TypeVar("_Options", RegistrationOptions, CalibrationOptions)


def shielded(argument: str) -> str:
    """A negative number that argparse cannot mistake for an option, as it does with -1e-3 before Python 3.14."""
    try:
        float(argument)
    except ValueError:
        return argument
    return f" {argument}"


def add_options(
    group: argparse._ArgumentGroup,
    options: type[RegistrationOptions | CalibrationOptions],
    only: Sequence[str] | None = None,
) -> None:
    """A command-line option for every field, or for those in `only`."""
    for entry in fields(options):
        if only is not None and entry.name not in only:
            continue
        if isinstance(entry.default, bool):
            group.add_argument(
                f"--{entry.name.replace('_', '-')}",
                action="store_true",
                help=entry.metadata["description"].replace("%", "%%"),
            )
            continue
        default: Any = entry.default
        several = isinstance(default, tuple)
        kind = type(default[0] if several else default)
        word = entry.metadata["word"]
        shown = " ".join(f"{value:g}" for value in default) if several else default
        group.add_argument(
            f"--{entry.name.replace('_', '-')}",
            metavar=f"N|{word}" if word is not None else "NAME" if kind is str else "N",
            nargs=len(default) if several else None,
            type=kind if word is None else _number_or(word),
            default=default,
            help=f"{entry.metadata['description']} (default: {shown})".replace("%", "%%"),
        )


def _number_or(word: str) -> Callable[[str], float | str]:
    """A function that reads a number or the word."""

    def read(text: str) -> float | str:
        return word if text.strip() == word else float(text)

    read.__name__ = "float"  # the type that argparse names in its error
    return read


def given(options: type[_Options], arguments: argparse.Namespace, only: Sequence[str] | None = None) -> _Options:
    """The options as given on the command line; ValueError where one is out of its range."""
    names = [entry.name for entry in fields(options)] if only is None else only
    return options(**{name: getattr(arguments, name) for name in names})


def make_folder(option: str, folder: Path) -> None:
    """Create the folder where it is missing; WrongCallError where that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WrongCallError(f"{option}: {folder} cannot be created: {error.strerror}") from None
