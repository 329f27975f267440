"""Which slice is registered next."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from sensor_msgs.msg import Image

from stereoreg_ros.nodes.register.backlog import MOST_WAIT_S, Backlog
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice


def backlog_of(count: int, came_s: float = 100.0, apart_s: float = 0.0) -> Backlog:
    """Slices with the numbers 0, 1, ..., the first of which came at `came_s`."""
    backlog = Backlog()
    for number in range(count):
        # When the image came does not matter: it may have waited for its plane since.
        backlog.add(IncomingSlice(Image(height=number), received_s=0.0), came_s + number * apart_s)
    return backlog


def taken(backlog: Backlog, now_s: float) -> list[int]:
    """Numbers of the slices that are registered."""
    backlog.take_late(now_s)
    numbers = []
    while (incoming := backlog.take()) is not None:
        numbers.append(incoming.image.height)
    return numbers


def test_in_order_while_timely() -> None:
    backlog = backlog_of(5)
    assert taken(backlog, 100.0 + 0.9 * MOST_WAIT_S) == [0, 1, 2, 3, 4]
    assert (backlog.skipped, len(backlog)) == (0, 0)


def test_as_long_as_is_allowed_is_timely() -> None:
    assert taken(backlog_of(3), 100.0 + MOST_WAIT_S) == [0, 1, 2]


def test_newest_alone_once_one_has_waited_too_long() -> None:
    backlog = backlog_of(5, apart_s=0.1)
    late = backlog.take_late(100.0 + 1.1 * MOST_WAIT_S)
    assert [incoming.image.height for incoming in late] == [0, 1, 2, 3]
    assert taken(backlog, 100.0 + 1.1 * MOST_WAIT_S) == [4]
    assert backlog.skipped == 4


def test_the_only_one_is_never_skipped() -> None:
    backlog = backlog_of(1, came_s=0.0)
    assert taken(backlog, 1e6) == [0]
    assert backlog.skipped == 0
