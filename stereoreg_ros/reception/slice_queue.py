"""Slices on their way from the scanner to the publisher: a bounded queue, in order, without loss."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from stereoreg_ros.dicom import DicomSlice

MAX_BYTES: Final = 2**30


class QueueFullError(Exception):
    """No room for more slices; the text says how many are waiting."""


@dataclass(frozen=True, eq=False)
class ReceivedSlice:
    """A slice, and when it arrived: seconds of the monotonic clock."""

    dicom_slice: DicomSlice
    arrival_s: float


class SliceQueue:
    """A queue of at most `max_slices` slices, and of at most 1 GiB of pixels, between threads."""

    def __init__(self, max_slices: int) -> None:
        self._max_slices = max_slices
        self._waiting: deque[ReceivedSlice] = deque()
        self._reserved = 0
        self._bytes = 0
        self._closed = False
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._waiting)

    @contextmanager
    def room_for(self, slices: Sequence[ReceivedSlice]) -> Iterator[None]:
        """Reserve room for the slices; they join the queue at the end of the block, unless it raises.

        Raises QueueFullError, before the block, where there is no room for all of them, or the queue is closed.
        """
        size = sum(_bytes_of(one) for one in slices)
        with self._lock:
            if self._closed:
                raise QueueFullError("the receiver is ending")
            taken = len(self._waiting) + self._reserved
            if taken + len(slices) > self._max_slices or self._bytes + size > MAX_BYTES:
                raise QueueFullError(f"{taken} slices are already waiting, no room for {len(slices)} more")
            self._reserved += len(slices)
            self._bytes += size
        try:
            yield
        except BaseException:
            with self._lock:
                self._reserved -= len(slices)
                self._bytes -= size
            raise
        with self._lock:
            self._reserved -= len(slices)
            self._waiting.extend(slices)

    def first(self) -> ReceivedSlice | None:
        """The slice that has waited longest, or None; it stays in the queue."""
        with self._lock:
            return self._waiting[0] if self._waiting else None

    def remove_first(self) -> None:
        """Remove the slice that `first` returned."""
        with self._lock:
            self._bytes -= _bytes_of(self._waiting.popleft())

    def close(self) -> None:
        """Accept no more slices."""
        with self._lock:
            self._closed = True


def _bytes_of(received: ReceivedSlice) -> int:
    return received.dicom_slice.ct_slice.hu.nbytes
