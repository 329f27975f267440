"""Three hosts in network namespaces: the tests of hosts_apart.py, in a process of their own.

Fast DDS looks up a process's network interfaces once: what has been in one namespace finds nobody in another.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

HOSTS_APART = Path(__file__).with_name("hosts_apart.py")


@pytest.mark.timeout(900)
def test_hosts_apart() -> None:
    names = re.findall(r"^def (test_\w+)", HOSTS_APART.read_text(encoding="utf-8"), re.MULTILINE)
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", str(HOSTS_APART)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    if skipped := re.search(r"^SKIPPED .*?: (.*)", done.stdout, re.MULTILINE):
        pytest.skip(skipped[1])
    assert f"{len(names)} passed" in done.stdout
