"""Lines for the shell, beside progress bars."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, TextIO

from tqdm import tqdm

NAME_WIDTH: Final = 32


def complain(sentence: str) -> None:
    """A sentence on standard error."""
    _write(f"stereoreg: {sentence}", sys.stderr)


def print_line(line: str) -> None:
    """A line of the result on standard output."""
    _write(line, sys.stdout)


def _write(line: str, stream: TextIO) -> None:
    """Write a line and redraw the progress bar, if there is one, below it."""
    # File names may contain what the terminal cannot show.
    encoding = stream.encoding or "utf-8"
    tqdm.write(line.encode(encoding, errors="replace").decode(encoding), file=stream)
    stream.flush()


def watched() -> bool:
    """Whether standard error is a terminal, which can show a progress bar."""
    return sys.stderr.isatty()


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[float], bool]]:
    """A bar on a terminal's standard error; its callback takes the share that is done, and says to go on."""
    with tqdm(total=1.0, desc=what, leave=False, disable=not watched(), file=sys.stderr) as bar:

        def report(share: float) -> bool:
            bar.update(max(share - bar.n, 0.0))
            return True

        yield report
