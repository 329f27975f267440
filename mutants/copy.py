"""A copy of the repository in which tests can be run."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
# Installed and downloaded, not changed by any bug: shared with the copy.
_LINKED = (".venv", ".cache")
# A bug that makes its tests hang is noticed too.
LIMIT_S = 300.0
HUNG = "(hung)"
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


class UnsoundTestsError(RuntimeError):
    """Tests were not found, or fail without any bug."""


@dataclass(frozen=True)
class TestRun:
    """What pytest came to; failed: the first test that failed, empty where none did; output: all that it wrote."""

    __test__ = False

    failed: str
    seconds: float
    output: str


class Copy:
    """The files that git knows or would add, in a folder of their own, and what lies beside the repository."""

    def __init__(self, folder: Path, repository: Path = REPOSITORY) -> None:
        self.root, self._original = folder / repository.name, repository
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=repository,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for name in filter(None, listed.split("\0")):
            if (repository / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(repository / name, self.root / name)
        for name in _LINKED:
            if (repository / name).exists():
                (self.root / name).symlink_to(repository / name)
        shared = repository.parent / "shared"
        if shared.exists():
            (folder / "shared").symlink_to(shared.resolve())

    def test(self, tests: Iterable[str], limit_s: float | None = LIMIT_S) -> TestRun:
        """Run tests until the first that fails. Raises UnsoundTestsError where pytest could not."""
        environment = {
            **os.environ,
            "PYTHONPATH": str(self.root),
            # Of a file that is changed twice within a second, a compiled one would be taken for new.
            "PYTHONDONTWRITEBYTECODE": "1",
            "AMENT_PREFIX_PATH": str(self._original / ".venv"),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "OPENBLAS_NUM_THREADS": "1",
        }
        # By the path of the copy, as nodes are started by the same Python.
        python = self.root / ".venv/bin/python"
        begun = time.monotonic()
        process = subprocess.Popen(
            [str(python), "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests],
            cwd=self.root,
            env=environment,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            return TestRun(HUNG, time.monotonic() - begun, output)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        seconds = time.monotonic() - begun
        if process.returncode not in (0, 1, 2):
            raise UnsoundTestsError(f"pytest {' '.join(tests)} ended with status {process.returncode}:\n{output}")
        found = _FAILED.search(output)
        if process.returncode and not found:
            raise UnsoundTestsError(f"pytest {' '.join(tests)} failed without naming a test:\n{output}")
        return TestRun(found.group(1) if found else "", seconds, output)
