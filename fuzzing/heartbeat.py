"""What a process that tries inputs leaves in memory for the one that watches it, also when it dies or hangs."""

from __future__ import annotations

import mmap
import struct
import time
from pathlib import Path
from typing import Final

_HEAD: Final = struct.Struct("<7Q")
_LARGEST: Final = 2**20


class Heartbeat:
    """A file of fixed size in the memory of both processes.

    tried, accepted: numbers of inputs; started_ns: of the input that is being tried, by the monotonic clock, which all
    processes share; 0 between inputs. started_cpu_ns: the processor's time that the process had taken by then.
    slowest_ns: most of that time that an input took; other work on the machine does not count.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(_HEAD.size + 2 * _LARGEST))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 0)

    @property
    def tried(self) -> int:
        return self._read(0)

    @property
    def accepted(self) -> int:
        return self._read(1)

    @property
    def started_ns(self) -> int:
        return self._read(2)

    @property
    def started_cpu_ns(self) -> int:
        return self._read(6)

    @property
    def slowest_ns(self) -> int:
        return self._read(3)

    @property
    def current(self) -> bytes:
        """The input that is being tried, or was tried last."""
        return self._memory[_HEAD.size : _HEAD.size + self._read(4)]

    @property
    def slowest(self) -> bytes:
        start = _HEAD.size + _LARGEST
        return self._memory[start : start + self._read(5)]

    def begin(self, data: bytes) -> None:
        """Say that an input is tried from now on."""
        self._memory[_HEAD.size : _HEAD.size + len(data)] = data
        self._write(4, len(data))
        self._write(6, time.process_time_ns())
        self._write(2, time.monotonic_ns())

    def end(self, accepted: bool) -> None:
        """Say that it has been tried."""
        took_ns = time.process_time_ns() - self.started_cpu_ns
        self._write(2, 0)
        self._write(0, self.tried + 1)
        self._write(1, self.accepted + accepted)
        if took_ns > self.slowest_ns:
            size = self._read(4)
            start = _HEAD.size + _LARGEST
            self._memory[start : start + size] = self.current
            self._write(5, size)
            self._write(3, took_ns)

    def given_up(self) -> None:
        """For the watcher, when the process is gone: the input counts as tried."""
        self._write(2, 0)
        self._write(0, self.tried + 1)

    def _read(self, place: int) -> int:
        number: int = struct.unpack_from("<Q", self._memory, 8 * place)[0]
        return number

    def _write(self, place: int, number: int) -> None:
        struct.pack_into("<Q", self._memory, 8 * place, number)
