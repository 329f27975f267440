"""Which slice is registered next."""

from __future__ import annotations

from sensor_msgs.msg import Image

from stereoreg_ros.nodes.register.backlog import MOST_WAIT_S, Backlog


def numbered(count: int) -> list[Image]:
    return [Image(height=number) for number in range(count)]


def taken(backlog: Backlog, now_s: float) -> list[int]:
    """Numbers of the images that are registered."""
    backlog.take_late(now_s)
    numbers = []
    while (image := backlog.take()) is not None:
        numbers.append(image.height)
    return numbers


def test_in_order_while_timely() -> None:
    backlog = Backlog()
    for image in numbered(5):
        backlog.add(image, 100.0)
    assert taken(backlog, 100.0 + 0.9 * MOST_WAIT_S) == [0, 1, 2, 3, 4]
    assert (backlog.received, backlog.skipped, len(backlog)) == (5, 0, 0)


def test_as_long_as_is_allowed_is_timely() -> None:
    backlog = Backlog()
    for image in numbered(3):
        backlog.add(image, 100.0)
    assert taken(backlog, 100.0 + MOST_WAIT_S) == [0, 1, 2]


def test_newest_alone_once_one_has_waited_too_long() -> None:
    backlog = Backlog()
    for image in numbered(5):
        backlog.add(image, 100.0 + 0.1 * image.height)
    assert [image.height for image in backlog.take_late(100.0 + 1.1 * MOST_WAIT_S)] == [0, 1, 2, 3]
    assert taken(backlog, 100.0 + 1.1 * MOST_WAIT_S) == [4]
    assert (backlog.received, backlog.skipped) == (5, 4)


def test_the_only_one_is_never_skipped() -> None:
    backlog = Backlog()
    backlog.add(Image(height=7), 0.0)
    assert taken(backlog, 1e6) == [7]
    assert backlog.skipped == 0


def test_a_clock_set_back_skips_nothing() -> None:
    backlog = Backlog()
    for image in numbered(3):
        backlog.add(image, 1000.0)
    assert taken(backlog, 0.0) == [0, 1, 2]
