"""`make fuzz`: hostile input of every kind; each must come to a result or to a refusal that says what is wrong."""

from __future__ import annotations

import argparse
import platform
import shutil
import sys
from pathlib import Path

from fuzzing.attempts import HAS_ATHERIS
from fuzzing.kind import CORPUS
from fuzzing.kinds import KINDS
from fuzzing.watch import Report, run


def main() -> int:
    """Print a table of what was tried; 1 where anything was found, which is then added to the corpus."""
    parser = argparse.ArgumentParser(prog="python -m fuzzing", description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}; all by default")
    parser.add_argument("--inputs", type=int, default=10_000, help="inputs of each kind (default 10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument("--output", type=Path, default=Path("build/fuzzing"), help="folder for findings and logs")
    arguments = parser.parse_args()
    unknown = [kind for kind in arguments.kinds if kind not in KINDS]
    if unknown:
        parser.error(f"found kind {unknown[0]!r}, expected of {', '.join(KINDS)}")
    if HAS_ATHERIS:
        print("inputs are made by atheris, from those that reach new branches", flush=True)
    else:
        print(f"atheris is not installed for Python {platform.python_version()}: inputs are made from valid ones alone")
    reports = []
    for name in arguments.kinds or KINDS:
        folder = arguments.output / name
        reports.append(run(KINDS[name], arguments.inputs, arguments.seed, folder))
        _to_corpus(name, folder)
    _print(reports)
    return int(any(report.findings for report in reports))


def _to_corpus(name: str, folder: Path) -> None:
    """Copy findings to where the tests try them again."""
    for note in folder.glob("*.txt"):
        found = note.with_suffix(KINDS[name].ending)
        (CORPUS / name).mkdir(parents=True, exist_ok=True)
        shutil.copy(found, CORPUS / name)


def _print(reports: list[Report]) -> None:
    print(f"\n{'kind':12s} {'inputs':>9s} {'accepted':>9s} {'refused':>9s} {'findings':>9s} {'slowest/ms':>11s}")
    for report in reports:
        found = report.findings.total()
        refused = report.inputs - report.accepted - found
        counts = f"{report.inputs:9d} {report.accepted:9d} {refused:9d} {found:9d}"
        print(f"{report.kind:12s} {counts} {report.slowest_ms:11.0f}")
    for report in reports:
        for finding, count in report.findings.most_common():
            print(f"{report.kind}: {count} times: {finding}")


if __name__ == "__main__":
    sys.exit(main())
