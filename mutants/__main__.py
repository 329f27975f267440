"""`make mutants`: each bug of the list is put into a copy of the code by itself, and its tests must fail.

Before that, the same tests must pass without any. Exits with 1 where a bug that has no reason beside it is not noticed,
or one that has a reason is noticed after all; with 2 where the list or the tests are at fault.
"""

from __future__ import annotations

import argparse
import queue
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tqdm import tqdm

from mutants.bug import Bug, BugListError, read_bugs
from mutants.copy import REPOSITORY, Copy, TestRun, UnsoundTestsError


def main() -> int:
    """Try the bugs and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m mutants", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", metavar="WORD", help="only bugs with one of these in their name or file")
    parser.add_argument("--quick", action="store_true", help="only those that are tried in CI")
    parser.add_argument("--workers", type=int, default=2, help="copies in which tests run at once (default 2)")
    arguments = parser.parse_args()
    try:
        bugs = [bug for bug in read_bugs() if _is_chosen(bug, arguments.words, arguments.quick)]
        if not bugs:
            parser.error("no bug is so called")
        runs = try_all(bugs, arguments.workers)
    except (BugListError, UnsoundTestsError) as error:
        print(f"mutants: {error}", file=sys.stderr)
        return 2
    table, wrong = described(bugs, runs)
    print(table)
    return int(wrong > 0)


def _is_chosen(bug: Bug, words: list[str], quick: bool) -> bool:
    return (bug.quick or not quick) and (not words or any(word in f"{bug.name} {bug.file}" for word in words))


def try_all(bugs: Sequence[Bug], workers: int, repository: Path = REPOSITORY) -> list[TestRun]:
    """Run each bug's tests with the bug in place, in `workers` temporary copies of the repository at once.

    Raises UnsoundTestsError where a test fails without a bug, BugListError where a bug does not fit the code.
    """
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(workers) as pool:
        copies: queue.SimpleQueue[Copy] = queue.SimpleQueue()
        for number in range(workers):
            copies.put(Copy(Path(folder) / str(number), repository))
        selections = _selections(bugs)
        bar = tqdm(total=len(selections) + len(bugs), unit="run", disable=None)

        def sound(tests: tuple[str, ...]) -> TestRun:
            copy = copies.get()
            try:
                return copy.test(tests, limit_s=None)
            finally:
                copies.put(copy)
                bar.update()

        def with_bug(bug: Bug) -> TestRun:
            copy = copies.get()
            before = None
            try:
                before = bug.put_into(copy.root)
                return copy.test(bug.tests)
            finally:
                if before is not None:
                    (copy.root / bug.file).write_text(before, encoding="utf-8")
                copies.put(copy)
                bar.update()

        with bar:
            for run in pool.map(sound, selections):
                if run.failed:
                    raise UnsoundTestsError(f"{run.failed} fails without a bug:\n{run.output}")
            return list(pool.map(with_bug, bugs))


def _selections(bugs: Sequence[Bug]) -> list[tuple[str, ...]]:
    """All the tests of the bugs, each once: by file as far as they are named without options."""
    plain: dict[str, set[str]] = {}
    others = set()
    for bug in bugs:
        if any(argument.startswith("-") for argument in bug.tests):
            others.add(bug.tests)
        else:
            for test in bug.tests:
                plain.setdefault(test.split("::")[0], set()).add(test)
    return [*(tuple(sorted(tests)) for tests in plain.values()), *sorted(others)]


def described(bugs: Sequence[Bug], runs: Sequence[TestRun]) -> tuple[str, int]:
    """The table, and how many bugs were noticed or not otherwise than their list has it."""
    width = max(len(bug.name) for bug in bugs)
    lines, wrong = [], 0
    for bug, run in zip(bugs, runs, strict=True):
        what = run.failed or "NOT NOTICED"
        if bool(run.failed) == bool(bug.survives):
            wrong += 1
            what += ", though a reason stands beside it" if bug.survives else ""
        elif bug.survives:
            what = f"not noticed: {bug.survives}"
        lines.append(f"{bug.name:{width}s}  {run.seconds:6.1f} s  {what}")
    caught = sum(bool(run.failed) for run in runs)
    lines += ["", f"{caught} of {len(bugs)} bugs noticed, {wrong} otherwise than the list has it"]
    return "\n".join(lines), wrong


if __name__ == "__main__":
    sys.exit(main())
