"""register_node as a process of its own, and its load on the machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import IO, Final

import psutil

from benchmarks.slice_source import SCANNER

DEADLINE_S: Final = 60.0
_READY: Final = "ready, frame"
_MIB: Final = 2**20


class RegisterProcess:
    """register_node, configured with the scale of the slices and with how the frame roughly stands.

    ready_s: from its start until it said that it was ready.
    """

    def __init__(self, log: IO[bytes]) -> None:
        scale = SCANNER.scale
        self._log = log
        begun = time.monotonic()
        command = [sys.executable, "-m", "stereoreg_ros.nodes.register.register_node"]
        command += ["--ros-args", "-p", f"pixel_spacing:=[{scale.sx}, {scale.sy}]", "-p", "max_rotation_deg:=30.0"]
        self._popen = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        while _READY not in self.output:
            if not self.running or time.monotonic() > begun + DEADLINE_S:
                self.end()
                raise RuntimeError(f"register_node did not become ready:\n{self.output}")
            time.sleep(0.01)
        self.ready_s = time.monotonic() - begun
        self.process = psutil.Process(self._popen.pid)

    @property
    def output(self) -> str:
        """Everything it has written so far."""
        descriptor = self._log.fileno()
        return os.pread(descriptor, os.fstat(descriptor).st_size, 0).decode(errors="replace")

    @property
    def running(self) -> bool:
        """Whether the process is alive."""
        return self._popen.poll() is None

    def end(self) -> None:
        """End it by SIGINT, or if that does not help by SIGKILL."""
        self._popen.send_signal(signal.SIGINT)
        try:
            self._popen.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()


@dataclass(frozen=True)
class Load:
    """The node's load over some time: CPU in % of a core, and its largest resident memory in MiB."""

    cpu_percent: float
    memory_mib: float


class LoadMeter:
    """Measures the load of a process from now on."""

    def __init__(self, process: psutil.Process) -> None:
        self._process = process
        self._start = self._used(), time.monotonic()
        self._largest = 0

    def load(self) -> Load:
        """The load until now; memory is the largest at any call."""
        self._largest = max(self._largest, self._process.memory_info().rss)
        used, begun = self._start
        return Load(100 * (self._used() - used) / (time.monotonic() - begun), self._largest / _MIB)

    def _used(self) -> float:
        times = self._process.cpu_times()
        return float(times.user + times.system)
