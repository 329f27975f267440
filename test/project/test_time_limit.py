"""A test that hangs is a failure with a name, not a run without an end."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

SETTINGS = Path(__file__).resolve().parents[2] / "pyproject.toml"
HANGING = """
import threading

import pytest

@pytest.fixture
def {fixture}():
    threading.Event().wait()

def test_hangs({asked}):
    threading.Event().wait()

def test_after_it():
    pass
"""


def test_every_test_has_a_time_limit(request: pytest.FixtureRequest):
    assert 0 < float(request.config.getini("timeout")) <= 300
    # Another way of ending a test takes the whole run with it.
    assert request.config.getini("timeout_method") in ("", "signal")
    assert request.config.getini("timeout_func_only") is False
    # Where even that cannot end it.
    assert 0 < float(request.config.getini("faulthandler_timeout")) <= 600


@pytest.mark.parametrize("asked", ["", "endless"], ids=["test", "fixture"])
def test_one_that_hangs_fails_by_name_and_the_next_is_run(tmp_path: Path, asked: str):
    path = tmp_path / "test_hanging.py"
    path.write_text(HANGING.format(fixture="endless", asked=asked))
    told = ["-c", str(SETTINGS), "--rootdir", str(tmp_path), "-p", "no:cacheprovider", "-o", "timeout=1"]
    command = [sys.executable, "-m", "pytest", *told, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    assert re.search(r"^(FAILED|ERROR) .*test_hanging\.py::test_hangs", done.stdout, re.MULTILINE)
    assert "Failed: Timeout (>1.0s)" in done.stdout
    assert "1 passed" in done.stdout
