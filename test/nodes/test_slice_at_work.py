"""While a slice is registered the node receives and answers, and what is set meanwhile counts."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

from stereoreg_ros import Pose, load_frame
from stereoreg_ros.nodes.register import register_node
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice, SlicePlane
from stereoreg_ros.nodes.register.slice_registration import SliceSetup, Unusable
from stereoreg_ros.simulation import PlacedFrame, random_pose, render_slice
from support.register_bench import SCALE, SCANNER, Bench, image_of, of_stamp, rendered, target_of, values_of
from support.ros_process import RosClient, node_here, node_process


class ManualWorker:
    """Does its work when the test says so."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Callable[[], Any], Callable[[Any], None]]] = []
        self.setups: list[SliceSetup] = []

    @property
    def is_free(self) -> bool:
        return not self._waiting

    def submit(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        self._waiting.append((work, then))
        self.setups += [one for one in getattr(work, "args", ()) if isinstance(one, SliceSetup)]

    def close(self) -> None:
        """Nothing to end."""

    def finish(self) -> None:
        work, then = self._waiting.pop(0)
        then(work())


class NodeHere:
    """The node in this process, with a worker by hand; told: what it has said of slices and targets."""

    def __init__(self, node: register_node.RegisterNode, monkeypatch: pytest.MonkeyPatch) -> None:
        self.node, self.worker = node, ManualWorker()
        self._said: list[DiagnosticArray] = []
        monkeypatch.setattr(node, "_worker", self.worker)
        monkeypatch.setattr(node, "_diagnostics", SimpleNamespace(publish=self._said.append))
        monkeypatch.setattr(node, "_preparation", None)
        monkeypatch.setattr(node, "_prepare_tables", lambda *_: None)
        # However slow this machine is, no slice is skipped.
        monkeypatch.setattr(node._backlog, "take_late", lambda _now_s: [])

    @property
    def outcomes(self) -> list[tuple[str, str]]:
        """What each status is about, and its reason."""
        statuses = [status for array in self._said for status in array.status]
        return [(status.name.split(": ")[1], values_of(status)["reason"]) for status in statuses]

    def set(self, **values: Any) -> None:
        (result,) = self.node.set_parameters([Parameter(name, value=value) for name, value in values.items()])
        assert result.successful, result.reason

    def send(self, frame_id: str = "ct", reference: str | None = None, plane_axes: str | None = None) -> None:
        image = image_of(rendered(2)[0])
        image.header.frame_id = frame_id
        plane = None if plane_axes is None else SlicePlane(Pose.identity(), plane_axes)
        self.node._on_slice(IncomingSlice(image, time.monotonic(), SCALE, plane, reference))

    def target(self, frame_id: str = "ct") -> None:
        self.node._target._on_target(target_of([1.0, 2.0, 3.0], frame_id))


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Iterator[NodeHere]:
    monkeypatch.setattr(register_node, "_PREPARE_AT_START_S", 0.0)
    with node_here(register_node.RegisterNode) as node:
        yield NodeHere(node, monkeypatch)


def test_slices_that_come_meanwhile_wait_and_are_registered_in_turn(here: NodeHere) -> None:
    for _ in range(3):
        here.send()
    assert len(here.worker.setups) == 1
    for _ in range(3):
        here.worker.finish()
    assert here.outcomes == [("registration", "")] * 3
    # Each starts from the pose of the one before.
    assert [one.previous[0] is None for one in here.worker.setups] == [True, False, False]


def test_a_limit_that_is_set_meanwhile_holds_for_the_slice_under_way(here: NodeHere) -> None:
    """Whoever has set it has been answered, and takes it that no pose comes that does not keep it."""
    here.send()
    here.set(max_target_error_mm=0.01)
    here.worker.finish()
    # Nothing was published: it is registered again.
    assert here.outcomes == []
    here.worker.finish()
    assert here.outcomes == [("registration", "inaccurate")]


def test_a_scale_that_no_parameter_shows_counts_for_the_slice_under_way_and_the_pose_before(here: NodeHere) -> None:
    here.send()
    here.worker.finish()
    here.send()
    here.node.scale_changed()
    here.worker.finish()
    assert here.outcomes == [("registration", "")]
    assert here.worker.setups[-1].previous == (None,)
    here.target()
    assert here.outcomes[1:] == [("target", "no_pose")]


def test_a_slice_is_registered_again_with_the_frame_that_is_set_meanwhile(here: NodeHere) -> None:
    here.send()
    here.set(frame_file="cube5")
    here.worker.finish()
    here.worker.finish()
    assert [one.registrars[0].frame.name for one in here.worker.setups] == ["cube6", "cube5"]
    assert here.outcomes != [("registration", "")]


def test_a_slice_that_cannot_be_used_does_not_wait_for_the_worker_and_is_refused_in_its_turn(here: NodeHere) -> None:
    here.send()
    bad = Image()
    here.node._on_slice(IncomingSlice(bad, time.monotonic(), SCALE, fault="no plane"))
    here.send()
    assert here.outcomes == []
    here.worker.finish()
    assert here.outcomes == [("registration", ""), ("registration", "bad_image")]
    here.worker.finish()
    assert here.outcomes[2:] == [("registration", "")]
    # After the refusal there is no pose to start from.
    assert here.worker.setups[1].previous == (None,)


def test_a_fault_of_the_program_is_said_and_the_next_slice_has_its_turn(here: NodeHere, monkeypatch) -> None:
    here.send()
    here.send()
    waiting = here.worker._waiting
    waiting[0] = (lambda: Unusable("internal_error", "internal error: it broke", 0.1, "Traceback"), waiting[0][1])
    here.worker.finish()
    here.worker.finish()
    assert here.outcomes == [("registration", "internal_error"), ("registration", "")]


# Other axes than those of the slices before.


def test_in_another_frame_of_reference_the_target_and_the_pose_before_are_dropped(here: NodeHere) -> None:
    """A patient laid anew, or a scanner with a new landmark: the same frame_id, and other axes."""
    here.send(reference="1.2.3")
    here.worker.finish()
    here.target()
    here.send(reference="1.2.3")
    here.worker.finish()
    assert here.outcomes == [("registration", ""), ("target", ""), ("registration", ""), ("target", "")]
    here.send(reference="1.2.4")
    assert here.outcomes[4:] == [("target", "other_frame_of_reference")]
    assert here.worker.setups[-1].previous == (None,)
    here.worker.finish()
    # No target rests on the new pose until it is sent again.
    assert here.outcomes[5:] == [("registration", "")]
    here.target()
    assert here.outcomes[6:] == [("target", "")]


@pytest.mark.parametrize(("before", "after"), [("1.2.3", ""), ("", "1.2.3"), ("1.2.3", None), (None, "1.2.3")], ids=str)
def test_a_frame_of_reference_that_is_not_known_may_be_another(
    here: NodeHere, before: str | None, after: str | None
) -> None:
    here.send(reference=before)
    here.worker.finish()
    here.target()
    here.send(reference=after)
    assert here.outcomes[-1] == ("target", "other_frame_of_reference")


def test_the_pose_before_ends_with_its_frame_of_reference_even_where_the_new_slice_is_searched_for_long(here: NodeHere):
    here.send(reference="1.2.3")
    here.worker.finish()
    here.send(reference="1.2.4")
    here.target()
    assert here.outcomes[-1] == ("target", "no_pose")


def test_a_target_given_in_the_new_axes_before_the_first_slice_of_them_is_kept(here: NodeHere) -> None:
    here.send("ct")
    here.worker.finish()
    here.target("ct")
    here.node._target._kept = None
    # Sent while the last pose was in the old axes it would be refused; so it comes when there is none.
    here.send("ct", plane_axes="")
    here.worker.finish()
    here.node._forget_poses()
    here.target("room")
    assert here.outcomes[-1] == ("target", "no_pose")
    here.send("ct", plane_axes="room")
    here.worker.finish()
    assert here.outcomes[-2:] == [("registration", ""), ("target", "")]


def test_under_another_frame_id_the_target_and_the_pose_before_are_dropped(here: NodeHere) -> None:
    here.send("ct")
    here.worker.finish()
    here.target("ct")
    here.send("room")
    assert here.outcomes[-1] == ("target", "other_frame_of_reference")
    assert here.worker.setups[-1].previous == (None,)


def test_slices_in_the_same_axes_are_no_change(here: NodeHere) -> None:
    for reference in ("1.2.3", "1.2.3"):
        here.send(reference=reference)
        here.worker.finish()
    assert here.worker.setups[1].previous != (None,)


# Over DDS.


def hard_slice() -> np.ndarray:
    """cube8 among false spots: a search of seconds."""
    rng = np.random.default_rng(3)
    frame = load_frame("cube8")
    hu = render_slice([PlacedFrame(frame, random_pose(rng, frame, SCANNER, max_offset_mm=5.0))], SCANNER, rng).hu
    for u, v in rng.integers(4, 252, (150, 2)):
        hu[v - 1 : v + 2, u - 1 : u + 2] = 3000
    return hu


def test_the_node_answers_while_it_searches_a_hard_slice() -> None:
    """By the order of what comes: the answer of a service and of a target before that of the slice."""
    arguments = ["-r", "__ns:=/hard", "-p", f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]", "-p", "frame_file:=cube8"]
    with RosClient("console") as client, node_process("register_node", "--ros-args", *arguments) as process:
        bench = Bench(client, "/hard", "/hard/image")
        bench.warm_up(bench.diagnostics)
        client.get_parameters(bench.node, "threshold")
        stamp = bench.send(image_of(hard_slice()))

        def is_under_way() -> bool:
            streams = [
                values_of(status)
                for array in bench.diagnostics
                for status in array.status
                if status.name == bench.name_of("stream")
            ]
            return any(int(one["slices_waiting"]) > 0 for one in streams)

        client.wait_for(is_under_way, "a status of the stream with the slice under way")
        assert client.get_parameters(bench.node, "threshold") != []
        client.publish("/hard/target", target_of([0, 0, 0]))
        client.wait_for(
            lambda: any(one.status[0].name == bench.name_of("target") for one in bench.diagnostics), "a target's status"
        )
        assert of_stamp(bench.diagnostics, stamp) is None, "the slice was no hard one"
        bench.status(stamp)
        # Nor does a search keep it from ending, or make it end otherwise than it should.
        bench.diagnostics.clear()
        bench.send(image_of(hard_slice()))
        client.wait_for(is_under_way, "a status of the stream with the slice under way")
        code, _ = process.stop(signal.SIGTERM)
        assert code == 0
