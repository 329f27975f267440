"""Images and what is told beside them on another topic: waited for where somebody tells it, and refused without."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.register import companion
from stereoreg_ros.nodes.register.by_stamp import WAIT_S
from stereoreg_ros.nodes.register.companion import Companion

ONE, TWO = Time(sec=1, nanosec=5), Time(sec=2)


class Table:
    """A companion topic whose messages tell a number, without a node, and what images have met."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, required: bool = False, publishers: int = 0) -> None:
        self.now_s = 0.0
        self.publishers = publishers
        self.met: list[tuple[str, object]] = []
        monkeypatch.setattr("stereoreg_ros.nodes.register.companion.time.monotonic", lambda: self.now_s)
        monkeypatch.setattr(companion, "subscription_of", self._subscribe)
        logger = SimpleNamespace(warning=lambda _: None)
        node: Any = SimpleNamespace(count_publishers=self._count, get_logger=lambda: logger)
        self.companion: Companion[int, str] = Companion(
            node,
            object,
            "number",
            self._read,
            same=lambda one, other: one == other,
            required=lambda: required,
            met=lambda whole, part: self.met.append((whole, str(part) if isinstance(part, MessageError) else part)),
        )

    def _subscribe(self, _node: Any, _type: type, topic: str, on_message: Any, _qos: Any) -> Any:
        self.tell_message = on_message
        return SimpleNamespace(topic_name=f"/{topic}")

    def _count(self, topic: str) -> int:
        assert topic == "/number"
        return self.publishers

    @staticmethod
    def _read(message: Any) -> int:
        if message.number < 0:
            raise MessageError("is negative")
        return int(message.number)

    def tell(self, stamp: Time, number: int) -> None:
        self.tell_message(SimpleNamespace(header=Header(stamp=stamp), number=number))


def test_where_nobody_tells_it_an_image_goes_on_without(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch)
    table.companion.meet(ONE, "image")
    assert table.met == [("image", None)]


@pytest.mark.parametrize("why", ["required", "a publisher", "one was told before"])
def test_where_somebody_tells_it_an_image_waits_for_its_own(monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    table = Table(monkeypatch, required=why == "required", publishers=int(why == "a publisher"))
    if why == "one was told before":
        table.tell(TWO, 7)
    table.companion.meet(ONE, "image")
    assert table.met == []
    table.tell(Time(sec=1), 8)
    assert table.met == []
    table.tell(ONE, 9)
    assert table.met == [("image", 9)]


def test_what_comes_first_is_kept_for_its_image(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch)
    table.tell(ONE, 0)
    table.companion.meet(ONE, "image")
    assert table.met == [("image", 0)]


def test_an_image_without_a_stamp_is_refused_where_something_belongs_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, publishers=1)
    table.companion.meet(Time(), "image")
    assert table.met == [("image", "its stamp is 0, expected one by which to know its number")]


def test_in_vain_it_is_waited_for_four_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, publishers=1)
    table.companion.meet(ONE, "first")
    table.now_s = 1.0
    table.companion.meet(TWO, "second")
    table.now_s = WAIT_S - 0.01
    table.companion.refuse_overdue()
    assert table.met == []
    table.now_s = WAIT_S + 0.5
    table.companion.refuse_overdue()
    assert table.met == [("first", "no number with the image's stamp came within 4 s")]
    table.tell(TWO, 3)
    assert table.met[1:] == [("second", 3)]


def test_what_cannot_be_read_refuses_its_image_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch)
    table.tell(ONE, -1)
    table.companion.meet(ONE, "image")
    assert table.met == [("image", "number: is negative")]


def test_of_an_image_that_is_given_up_nothing_is_left_for_a_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, publishers=1)
    table.companion.give_up(ONE)
    table.tell(ONE, 4)
    table.companion.meet(ONE, "later")
    assert table.met == []
    table.tell(ONE, 5)
    assert table.met == [("later", 5)]
