"""`stereoreg reproduce`: the paper's results, simulated."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereoreg_ros.cli.output import print_line
from stereoreg_ros.cli.parsing import OK, Commands, WrongCallError, make_folder


def add_to(commands: Commands) -> None:
    """Add the command."""
    reproduce = commands.add_parser(
        "reproduce",
        help="repeat the results section of Maurin 2009 with simulated data",
        description="Repeats section 6 of Maurin 2009 with simulated data and writes a report (report.md, PNG, CSV) "
        "that compares the paper's figures with ours. The full run takes about a quarter of an hour.",
        allow_abbrev=False,
    )
    reproduce.add_argument(
        "--output", metavar="DIR", type=Path, required=True, help="folder for the report, created if missing"
    )
    reproduce.add_argument("--quick", action="store_true", help="fewer poses and levels: done within two minutes")
    reproduce.add_argument("--seed", metavar="N", type=int, default=0, help="seed of everything random (default: 0)")
    reproduce.set_defaults(command=_reproduce)


def _reproduce(arguments: argparse.Namespace) -> int:
    """`stereoreg reproduce`."""
    if arguments.seed < 0:
        raise WrongCallError(f"--seed is {arguments.seed}, expected 0 or more")
    try:
        # Imported only here: the other commands do without matplotlib.
        from stereoreg_ros.reproduction.run import reproduce
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] != "matplotlib":
            raise
        raise WrongCallError(
            "reproduce draws plots with matplotlib, which is not installed; it is python3-matplotlib in Ubuntu"
        ) from None
    from stereoreg_ros.reproduction.effort import FULL, QUICK

    make_folder("--output", arguments.output)
    report = reproduce(arguments.output, QUICK if arguments.quick else FULL, arguments.seed)
    print_line(str(report))
    return OK
