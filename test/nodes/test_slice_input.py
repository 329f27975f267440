"""What an image waits for: what its source publishes or has published, and a plane where that is required."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Vector3, Vector3Stamped
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.register import slice_input
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice
from stereoreg_ros.nodes.register.slice_assembly import FRAME_OF_REFERENCE, PLANE, SPACING, WAIT_S
from stereoreg_ros.nodes.register.slice_input import SliceInput

SPACING_M = Vector3(x=0.0005, y=0.0006, z=0.0)
SCALE = PixelScale(0.5, 0.6)


class Inputs:
    """A slice input without a node; the clock stands until it is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, required: bool = False) -> None:
        self.now_s = 100.0
        self.published: set[str] = set()
        self.warnings: list[str] = []
        self.slices: list[IncomingSlice] = []
        self.topics: dict[str, Any] = {}
        monkeypatch.setattr("stereoreg_ros.nodes.register.slice_input.time.monotonic", lambda: self.now_s)
        monkeypatch.setattr(slice_input, "subscription_of", self._subscribe)
        node: Any = SimpleNamespace(
            create_timer=self._take_timer,
            count_publishers=lambda topic: int(topic in self.published),
            get_logger=lambda: SimpleNamespace(warning=self.warnings.append),
        )
        self.input = SliceInput(node, lambda: required, self.slices.append)

    def _subscribe(self, _node: Any, _type: type, topic: str, callback: Any, _qos: Any) -> Any:
        self.topics[topic] = callback
        return SimpleNamespace(topic_name=topic)

    def _take_timer(self, _period_s: float, callback: Any, clock: Any) -> None:
        self.look = callback

    def send(self, topic: str, second: int) -> None:
        """A message whose stamp is this second."""
        header = Header(stamp=Time(sec=second), frame_id="ct")
        messages: dict[str, Any] = {
            "image": Image(header=header),
            SPACING: Vector3Stamped(header=header, vector=SPACING_M),
            PLANE: PoseStamped(header=header),
            FRAME_OF_REFERENCE: header,
        }
        messages[PLANE].pose.orientation.w = 1.0
        self.topics[topic](messages[topic])


@pytest.fixture
def inputs(monkeypatch: pytest.MonkeyPatch) -> Inputs:
    return Inputs(monkeypatch)


def test_the_image_is_subscribed_to_last(inputs: Inputs) -> None:
    """Served in this order, an image that comes with the rest waits for nothing."""
    assert list(inputs.topics) == [SPACING, PLANE, FRAME_OF_REFERENCE, "image"]


def test_where_nobody_publishes_anything_else_an_image_waits_for_nothing(inputs: Inputs) -> None:
    inputs.send("image", 1)
    (one,) = inputs.slices
    assert (one.spacing, one.plane, one.frame_of_reference, one.fault, one.received_s) == (None, None, None, "", 100.0)
    assert (inputs.input.received, inputs.input.waiting) == (1, 0)


@pytest.mark.parametrize("topic", [SPACING, PLANE, FRAME_OF_REFERENCE])
def test_what_somebody_publishes_is_waited_for_and_the_image_came_when_it_came(inputs: Inputs, topic: str) -> None:
    inputs.published = {topic}
    inputs.send("image", 1)
    assert (inputs.slices, inputs.input.waiting) == ([], 1)
    inputs.now_s += 3.0
    inputs.send(topic, 1)
    (one,) = inputs.slices
    assert (one.fault, one.received_s) == ("", 100.0)
    assert one.spacing == (SCALE if topic == SPACING else None)
    assert (one.plane is not None) == (topic == PLANE)
    assert one.frame_of_reference == ("ct" if topic == FRAME_OF_REFERENCE else None)


def test_what_has_come_once_is_waited_for_though_its_publisher_has_gone(inputs: Inputs) -> None:
    inputs.send(SPACING, 1)
    inputs.send("image", 1)
    inputs.send("image", 2)
    assert [one.spacing for one in inputs.slices] == [SCALE]
    assert inputs.input.waiting == 1


def test_what_is_published_comes_first_or_last(inputs: Inputs) -> None:
    inputs.published = {SPACING, PLANE, FRAME_OF_REFERENCE}
    for topic in (PLANE, "image", FRAME_OF_REFERENCE, SPACING):
        assert inputs.slices == []
        inputs.send(topic, 1)
    (one,) = inputs.slices
    assert (one.spacing, one.axes, one.frame_of_reference) == (SCALE, "ct", "ct")


def test_a_plane_that_is_required_is_waited_for_and_then_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = Inputs(monkeypatch, required=True)
    inputs.send("image", 1)
    inputs.now_s += WAIT_S - 0.01
    inputs.look()
    assert inputs.slices == []
    inputs.now_s += 0.01
    inputs.look()
    (one,) = inputs.slices
    assert one.fault == "no slice_pose with the image's stamp came within 4 s"


def test_what_cannot_be_read_refuses_its_image_by_name(inputs: Inputs) -> None:
    header = Header(stamp=Time(sec=1))
    inputs.topics[SPACING](Vector3Stamped(header=header))
    inputs.send("image", 1)
    (one,) = inputs.slices
    assert one.spacing is None
    assert one.fault.startswith("slice_spacing: pixel spacing sx is 0")
    assert inputs.warnings == [one.fault]
