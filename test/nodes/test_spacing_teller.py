"""Telling register_node the spacing of the next slices: all or nothing, and anew to whoever comes in its place."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from rclpy.parameter import Parameter

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.scanner.tell_spacing import ANSWER_S, RETRY_S, SpacingTeller

SCALE = PixelScale(0.4, 0.7, -0.02)
OTHER = PixelScale(0.7, 0.4, -0.02)


class Target:
    """Stands in for the node that tells, its client and the graph around it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, with_slice_poses: bool = True) -> None:
        self.now_s = 100.0
        self.is_ready = True
        self.processes = [1]
        self.requests: list[Any] = []
        self.answers: list[SimpleNamespace] = []
        self.said: list[str] = []
        monkeypatch.setattr("stereoreg_ros.nodes.scanner.tell_spacing.time.monotonic", lambda: self.now_s)
        logger = SimpleNamespace(info=self.said.append, error=self.said.append)
        client = SimpleNamespace(
            srv_name="register_node/set_parameters_atomically",
            service_is_ready=lambda: self.is_ready,
            call_async=self._call,
            remove_pending_request=lambda _: None,
        )
        node: Any = SimpleNamespace(
            create_client=lambda _type, _name: client,
            get_logger=lambda: logger,
            resolve_service_name=lambda name: f"/{name}",
            get_publishers_info_by_topic=self._publishers,
        )
        self.teller = SpacingTeller(node, "register_node", with_slice_poses=with_slice_poses)

    def _call(self, request: Any) -> SimpleNamespace:
        self.requests.append(request)
        answer = SimpleNamespace(result=None)
        answer.done = lambda: answer.result is not None
        self.answers.append(answer)
        return answer

    def _publishers(self, topic: str) -> list[Any]:
        assert topic == "/parameter_events"
        others = [SimpleNamespace(node_namespace="/", node_name="another", endpoint_gid=[99] * 16)]
        return others + [
            SimpleNamespace(node_namespace="/", node_name="register_node", endpoint_gid=[process] * 16)
            for process in self.processes
        ]

    def answer(self, successful: bool = True, reason: str = "") -> None:
        """To the last request."""
        result = SimpleNamespace(successful=successful, reason=reason)
        self.answers[-1].result = lambda: SimpleNamespace(result=result)

    def told(self) -> dict[str, Any]:
        """What the last request sets."""
        parameters = [Parameter.from_parameter_msg(one) for one in self.requests[-1].parameters]
        return {one.name: one.value if isinstance(one.value, (bool, float)) else list(one.value) for one in parameters}


@pytest.mark.parametrize("with_slice_poses", [True, False])
def test_all_of_the_scale_is_told_at_once_and_whether_poses_come(
    monkeypatch: pytest.MonkeyPatch, with_slice_poses: bool
) -> None:
    target = Target(monkeypatch, with_slice_poses)
    assert not target.teller.tell(SCALE)
    assert target.told() == {
        "pixel_spacing": [0.4, 0.7],
        "pixel_shear": -0.02,
        "slice_pose_required": with_slice_poses,
    }
    # Not before it is accepted, and not asked twice.
    assert not target.teller.tell(SCALE)
    target.answer()
    assert target.teller.tell(SCALE)
    assert target.teller.tell(SCALE)
    assert len(target.requests) == 1


def test_what_was_accepted_is_this_scale_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    target = Target(monkeypatch)
    target.teller.tell(SCALE)
    target.answer()
    assert target.teller.tell(SCALE)
    assert not target.teller.tell(OTHER)
    assert target.told()["pixel_spacing"] == [0.7, 0.4]
    # The answer to the one request is none to the other.
    target.answer()
    assert not target.teller.tell(SCALE)
    target.answer()
    assert target.teller.tell(SCALE)
    assert len(target.requests) == 3


def test_an_answer_that_comes_when_another_scale_is_due_is_for_the_one_that_was_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    target = Target(monkeypatch)
    target.teller.tell(SCALE)
    target.answer()
    assert not target.teller.tell(OTHER)
    assert len(target.requests) == 2
    target.answer()
    assert target.teller.tell(OTHER)


def test_a_refusal_is_told_and_asked_again_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    target = Target(monkeypatch)
    target.teller.tell(SCALE)
    target.answer(successful=False, reason="pixel_spacing is too large")
    assert not target.teller.tell(SCALE)
    assert target.said[-1] == "register_node refused the pixel spacing: pixel_spacing is too large"
    target.now_s += RETRY_S - 0.01
    assert not target.teller.tell(SCALE)
    assert len(target.requests) == 1
    target.now_s += 0.01
    assert not target.teller.tell(SCALE)
    assert len(target.requests) == 2


def test_who_does_not_answer_in_time_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    target = Target(monkeypatch)
    target.teller.tell(SCALE)
    target.now_s += ANSWER_S
    target.teller.tell(SCALE)
    assert len(target.requests) == 1
    target.now_s += 0.01
    target.teller.tell(SCALE)
    assert len(target.requests) == 2


def test_another_process_under_its_name_is_told_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that was killed is counted on for a while, and its service is ready."""
    target = Target(monkeypatch)
    target.teller.tell(SCALE)
    target.answer()
    assert target.teller.tell(SCALE)
    target.processes = [1, 2]
    assert target.teller.processes_seen() == 2
    assert not target.teller.tell(SCALE)
    assert len(target.requests) == 2
    target.answer()
    assert target.teller.tell(SCALE)
    # That the old one is gone at last changes nothing.
    target.processes = [2]
    assert target.teller.tell(SCALE)
    assert target.teller.processes_seen() == 2


def test_who_goes_away_is_told_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    target = Target(monkeypatch)
    target.teller.tell(SCALE)
    target.answer()
    assert target.teller.tell(SCALE)
    target.is_ready = False
    assert not target.teller.tell(SCALE)
    target.is_ready = True
    assert not target.teller.tell(SCALE)
    assert len(target.requests) == 2
