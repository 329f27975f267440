"""One thread that computes while the node goes on receiving, answering and publishing."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Final, TypeVar

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

_T = TypeVar("_T")
_END_S: Final = 0.5


class Worker:
    """Work is done in the order in which it is submitted; its result goes to a callback among those of the node.

    Work must not touch the node, and what it rests on must not change: it runs beside the node's callbacks.
    """

    def __init__(self, node: Node) -> None:
        self._submitted: SimpleQueue[Callable[[], Callable[[], None]] | None] = SimpleQueue()
        self._finished: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._unfinished = 0
        self._announced = node.create_guard_condition(self._deliver)
        # A daemon: a search that takes seconds does not hold up the node's end.
        self._thread = threading.Thread(target=self._run, name="registration", daemon=True)
        self._thread.start()

    @property
    def is_free(self) -> bool:
        """Whether nothing is under way, results that wait to be delivered included."""
        return self._unfinished == 0

    @property
    def is_running(self) -> bool:
        """Whether its thread lives."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the thread once the work under way is done, which is waited for no longer than a moment."""
        self._submitted.put(None)
        self._thread.join(_END_S)

    def submit(self, work: Callable[[], _T], then: Callable[[_T], None]) -> None:
        """Have `work` done in the thread, and `then` called with its result; an error of it is the callback's error."""
        self._unfinished += 1
        self._submitted.put(partial(_done, work, then))

    def _run(self) -> None:
        while (work := self._submitted.get()) is not None:
            self._finished.put(work())
            # The node may have ended meanwhile.
            with suppress(InvalidHandle):
                self._announced.trigger()

    def _deliver(self) -> None:
        try:
            deliver = self._finished.get_nowait()
        except Empty:
            return
        self._unfinished -= 1
        if not self._finished.empty():
            # Triggers that come close together count as one.
            self._announced.trigger()
        deliver()


def _done(work: Callable[[], _T], then: Callable[[_T], None]) -> Callable[[], None]:
    """The work done: what is left is the call that delivers its result."""
    try:
        return partial(then, work())
    except Exception as error:
        return partial(_raise, error)


def _raise(error: Exception) -> None:
    raise error
