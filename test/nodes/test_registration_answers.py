"""Whether register_node has done with a slice: by the stamp, and with the spacing that the slice has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.parameters import ParameterError
from stereoreg_ros.nodes.scanner.registration_answers import RegistrationAnswers
from support.contract import STATUS_NAME

STAMP = Time(sec=5, nanosec=7)
SCALE = PixelScale(0.5, 0.6)


class Heard:
    """Answers that are heard without a node."""

    def __init__(
        self, register_node: str = "register_node", namespace: str = "/", expected: Time | None = STAMP
    ) -> None:
        self.takers: list[SimpleNamespace] = []
        self.speakers: list[SimpleNamespace] = []
        self.topics: set[str] = set()
        node: Any = SimpleNamespace(
            create_subscription=self._subscribe,
            get_namespace=lambda: namespace,
            resolve_topic_name=lambda topic: f"{namespace.rstrip('/')}/{topic}",
            get_subscriptions_info_by_topic=lambda topic: self._endpoints(topic, self.takers),
            get_publishers_info_by_topic=lambda topic: self._endpoints(topic, self.speakers),
        )
        self.answers = RegistrationAnswers(node, register_node)
        if expected is not None:
            self.answers.expect(expected)

    def _subscribe(self, _type: type, topic: str, callback: Any, _queue: int) -> None:
        assert topic == "/diagnostics"
        self.hear = callback

    def _endpoints(self, topic: str, endpoints: list[SimpleNamespace]) -> list[SimpleNamespace]:
        self.topics.add(topic)
        return endpoints

    def answer(self, *statuses: DiagnosticStatus, stamp: Time = STAMP) -> None:
        self.hear(DiagnosticArray(header=Header(stamp=stamp), status=list(statuses)))


def status(
    name: str = STATUS_NAME,
    calibration: str = "configured",
    spacing: tuple[float, float] = (0.5, 0.6),
) -> DiagnosticStatus:
    values = {
        "calibration": calibration,
        "pixel_spacing_x_mm": str(spacing[0]),
        "pixel_spacing_y_mm": str(spacing[1]),
    }
    return DiagnosticStatus(name=name, values=[KeyValue(key=key, value=value) for key, value in values.items()])


def test_only_answers_with_the_stamp_of_the_slice_count() -> None:
    heard = Heard()
    for stamp in (Time(), Time(sec=5), Time(sec=4, nanosec=7), Time(sec=5, nanosec=8)):
        heard.answer(status(), stamp=stamp)
    assert heard.answers.count == 0
    heard.answer(status())
    heard.answer(status())
    assert heard.answers.count == 2
    heard.answers.expect(Time(sec=6))
    assert heard.answers.count == 0
    heard.answer(status())
    assert heard.answers.count == 0


@pytest.mark.parametrize(
    ("register_node", "namespace", "name"),
    [
        ("register_node", "/", "register_node"),
        ("register_node", "/robot1", "robot1/register_node"),
        ("/register_node", "/robot1", "register_node"),
        ("robot2/register_node", "/", "robot2/register_node"),
        ("/robot2/register_node", "/robot1", "robot2/register_node"),
    ],
)
def test_only_answers_of_the_node_that_is_waited_for_count(register_node: str, namespace: str, name: str) -> None:
    """Another one registers slices with the same stamps: with its answer, a slice of ours would never be registered."""
    heard = Heard(register_node, namespace)
    for other in {"register_node", "robot1/register_node", "robot2/register_node", "robot3/register_node"} - {name}:
        heard.answer(status(f"{other}: registration"), status(f"{other}: registration of cube6"))
    heard.answer(status(f"{name}: registrations"), status(f"{name}: stream"))
    assert heard.answers.count == 0
    heard.answer(status(f"{name}: registration"))
    heard.answer(status(f"{name}: registration of cube6"), status(f"{name}: registration of cube8"))
    assert heard.answers.count == 2


def test_before_a_slice_is_expected_nothing_counts() -> None:
    heard = Heard(expected=None)
    heard.answer(status(), stamp=Time())
    assert heard.answers.count == 0


def test_of_several_frames_there_is_one_answer_by_the_first() -> None:
    heard = Heard()
    heard.answer(
        status("register_node: stream"),
        status(f"{STATUS_NAME} of cube6", spacing=(0.5, 0.6)),
        status(f"{STATUS_NAME} of cube8", spacing=(0.7, 0.7)),
    )
    assert heard.answers.count == 1
    assert heard.answers.came_with(SCALE)


def test_other_statuses_are_no_answers() -> None:
    heard = Heard()
    heard.answer(status("register_node: stream"), status("register_node: target"))
    assert heard.answers.count == 0


@pytest.mark.parametrize(
    ("spacing", "is_this"),
    [
        ((0.5, 0.6), True),
        ((0.50004, 0.60005), True),
        ((0.50006, 0.6), False),
        ((0.5, 0.6001), False),
        ((0.6, 0.5), False),
        ((0.0, 0.0), False),
    ],
)
def test_the_answer_has_to_rest_on_the_slices_spacing(spacing: tuple[float, float], is_this: bool) -> None:
    heard = Heard()
    heard.answer(status(spacing=spacing))
    assert bool(heard.answers.came_with(SCALE)) is is_this


def test_a_measured_spacing_stands_in_the_place_of_the_one_that_the_slice_states() -> None:
    heard = Heard()
    heard.answer(status(calibration="measured", spacing=(0.507, 0.593)))
    assert heard.answers.came_with(SCALE)


def endpoint(process: int, name: str = "register_node", namespace: str = "/") -> SimpleNamespace:
    """An endpoint of a process, by its identifier: twelve bytes of the process, and four of the endpoint."""
    gid = [process] * 12 + [len(name), 1, 2, 3]
    return SimpleNamespace(node_name=name, node_namespace=namespace, endpoint_gid=gid)


def test_only_a_process_of_register_node_that_takes_images_and_answers_is_there() -> None:
    heard = Heard("register_node", "/robot1")
    heard.takers, heard.speakers = [endpoint(1, namespace="/robot1")], []
    assert heard.answers.processes() == set()
    heard.speakers = [endpoint(2, namespace="/robot1"), endpoint(1, "viewer", "/robot1"), endpoint(1)]
    assert heard.answers.processes() == set()
    heard.speakers.append(endpoint(1, namespace="/robot1"))
    assert heard.answers.processes() == {bytes([1] * 12)}
    # Another process comes in its place, while DDS still counts the one that was killed.
    heard.takers.append(endpoint(2, namespace="/robot1"))
    assert heard.answers.processes() == {bytes([1] * 12), bytes([2] * 12)}
    assert heard.topics == {"/robot1/image", "/diagnostics"}


def test_a_name_that_no_node_can_have_is_refused() -> None:
    with pytest.raises(ParameterError, match="register_node: 'two words' is no name of a node"):
        Heard("two words")
    Heard("")  # nobody is waited for
