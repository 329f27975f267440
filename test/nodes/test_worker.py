"""The thread that computes beside the node's callbacks: in order, one result at a time, and no error is lost."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.nodes.register.worker import Worker


class Callbacks:
    """Stands in for a node whose callbacks run when the test says so."""

    def __init__(self) -> None:
        self.triggered = threading.Semaphore(0)
        self._deliver: Any = None

    def create_guard_condition(self, callback: Any) -> Any:
        self._deliver = callback
        return self

    def trigger(self) -> None:
        self.triggered.release()

    def serve(self, count: int = 1) -> None:
        """Run the callback so many times, each when it was asked for."""
        for _ in range(count):
            assert self.triggered.acquire(timeout=60.0)
            self._deliver()


def test_results_come_in_order_and_only_among_the_callbacks() -> None:
    node = Callbacks()
    worker = Worker(node)  # type: ignore[arg-type]
    results: list[tuple[int, bool]] = []
    here = threading.get_ident()
    for number in range(3):

        def deliver(worked_in: int, number: int = number) -> None:
            results.append((number, worked_in != here and threading.get_ident() == here))

        worker.submit(threading.get_ident, deliver)
    assert results == []
    node.serve(3)
    assert results == [(0, True), (1, True), (2, True)]


def test_it_is_free_once_the_last_result_is_delivered() -> None:
    node = Callbacks()
    worker = Worker(node)  # type: ignore[arg-type]
    free: list[bool] = [worker.is_free]
    begun, hold = threading.Event(), threading.Event()

    def work() -> None:
        begun.set()
        hold.wait(60.0)

    worker.submit(work, lambda _: free.append(worker.is_free))
    assert begun.wait(60.0)
    free.append(worker.is_free)
    hold.set()
    # Done, but not delivered.
    assert node.triggered.acquire(timeout=60.0)
    free.append(worker.is_free)
    node.trigger()
    node.serve()
    assert free == [True, False, False, True]


def test_an_error_of_the_work_is_one_of_the_callback_and_the_next_work_is_done() -> None:
    node = Callbacks()
    worker = Worker(node)  # type: ignore[arg-type]
    results: list[int] = []
    worker.submit(lambda: 1 // 0, results.append)
    worker.submit(lambda: 2, results.append)
    with pytest.raises(ZeroDivisionError):
        node.serve()
    node.serve()
    assert results == [2]
    assert worker.is_free


def test_closed_it_ends_once_its_work_is_done() -> None:
    node = Callbacks()
    idle = Worker(node)  # type: ignore[arg-type]
    idle.close()
    assert not idle.is_running
    busy = Worker(node)  # type: ignore[arg-type]
    hold = threading.Event()
    busy.submit(lambda: hold.wait(60.0), lambda _: None)
    busy.close()
    assert busy.is_running
    hold.set()
    node.serve()
    busy._thread.join(60.0)
    assert not busy.is_running


def test_triggers_that_count_as_one_leave_no_result_behind() -> None:
    node = Callbacks()
    worker = Worker(node)  # type: ignore[arg-type]
    results: list[int] = []
    hold = threading.Event()
    worker.submit(lambda: hold.wait(60.0), lambda _: None)
    for number in range(3):
        worker.submit(partial(int, number), results.append)
    hold.set()
    for _ in range(4):
        assert node.triggered.acquire(timeout=60.0)
    # As if the executor had seen a single one.
    node.trigger()
    node.serve(4)
    assert results == [0, 1, 2]
