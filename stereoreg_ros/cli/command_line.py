"""`stereoreg COMMAND`: from the arguments of a call to its exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

from stereoreg_ros.cli import calibrate, design, inspect, register, reproduce
from stereoreg_ros.cli.output import complain
from stereoreg_ros.cli.parsing import BAD_FILE, INTERRUPTED, WRONG_CALL, Parser, WrongCallError, shielded


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code: 0; 1 where a file could not be read or written; 2 for a usage error."""
    given = sys.argv[1:] if arguments is None else arguments
    parsed = _parser().parse_args([shielded(argument) for argument in given])
    try:
        code: int = parsed.command(parsed)
    except WrongCallError as error:
        complain(str(error))
        return WRONG_CALL
    except BrokenPipeError:
        # The reader of the output has closed it. What is still buffered must not fail again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BAD_FILE
    except OSError as error:
        complain(str(error))
        return BAD_FILE
    except KeyboardInterrupt:
        return INTERRUPTED
    return code


def _parser() -> Parser:
    parser = Parser(
        prog="stereoreg",
        description="Registers a stereotactic frame to a CT scanner from one slice through its straight rods.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"stereoreg {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    register.add_to(commands)
    calibrate.add_to(commands)
    inspect.add_to(commands)
    design.add_to(commands)
    reproduce.add_to(commands)
    return parser


def _version() -> str:
    try:
        return version("stereoreg_ros")
    except PackageNotFoundError:
        return "(not installed)"
