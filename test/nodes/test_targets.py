"""Targets: where they are in the frame, every refusal, and none from a pose that is no longer the last slice's."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros import Pose, load_frame
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.register import register_node
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.targets import (
    Accepted,
    KeptTarget,
    TargetInFrame,
    TargetRefusal,
    status_of_target,
    target_in_frame,
)
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.result import PoseEstimate, Registration
from stereoreg_ros.simulation import PlacedFrame, render_slice
from stereoreg_ros.uncertainty import error_ball_95
from support.register_bench import CUBE, SCALE, SCANNER, Bench, image_of, of_stamp, rendered, target_of, values_of
from support.ros_process import RosClient, node_here, node_process

# A quarter turn about z: x of the frame is y of the scanner.
SCANNER_FROM_FRAME = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20.0, 30.0]))
# Of the position alone, so that every target's error is the same: 0.2 mm along one axis.
COVARIANCE = np.diag([0.04, 0.0, 0.0, 0.0, 0.0, 0.0])
ERROR_MM = error_ball_95(COVARIANCE[:3, :3])


def latest(frame_id: str = "ct") -> Accepted:
    """A pose whose slice came at 100 s. Of the slice it has another, which no target rests on."""
    estimate = PoseEstimate(Pose.identity(), SCANNER_FROM_FRAME, COVARIANCE, (), 0.0, -12.0)
    result = Registration(CUBE, SliceSpots(np.zeros((0, 2)), SCALE), RegistrationOptions(), estimate)
    return Accepted(Header(stamp=Time(sec=7, nanosec=8), frame_id=frame_id), result, 100.0)


def answer(
    target: PointStamped,
    pose: Accepted | None,
    now_s: float = 101.0,
    max_error_mm: float = 3.0,
    received_s: float = 100.5,
) -> TargetInFrame | TargetRefusal:
    options = RegistrationOptions(max_target_error_mm=max_error_mm)
    settings = NodeSettings(options, CalibrationOptions(), max_pose_age=60.0, max_target_age=90.0)
    return target_in_frame(KeptTarget(target, received_s), pose, now_s, settings)


def test_a_target_is_told_in_the_frames_axes_with_error_age_and_header_of_the_pose():
    outcome = answer(target_of([11.0, 25.0, 33.0]), latest(), 102.5)
    assert outcome
    np.testing.assert_allclose(outcome.point_mm, [5.0, -1.0, 3.0], atol=1e-12)
    assert outcome.error_95_mm == pytest.approx(1.959964 * 0.2, rel=1e-6)
    assert outcome.pose_age_s == 2.5
    assert outcome.header == Header(stamp=Time(sec=7, nanosec=8), frame_id="ct")


def test_the_error_is_that_at_the_target():
    """A turn of a milliradian about x moves what is a metre away by a millimetre, and nothing on the axis."""
    pose = latest()
    estimate = replace(pose.registration.estimate, covariance=np.diag([0.0, 0, 0, 1e-6, 0, 0]))
    turning = replace(pose, registration=replace(pose.registration, estimate=estimate))
    near, far = (answer(target_of([10.0, 20.0 + y, 30.0]), turning) for y in (0.0, 1000.0))
    assert near
    assert near.error_95_mm == 0.0
    assert far
    assert far.error_95_mm == pytest.approx(1.959964, rel=1e-6)
    assert not answer(target_of([10.0, 1020.0, 30.0]), turning, max_error_mm=1.9)
    # Along the axis of the turn, which a turn does not move.
    along = answer(target_of([1010.0, 20.0, 30.0]), turning)
    assert along
    assert along.error_95_mm == pytest.approx(0.0, abs=1e-9)


BAD_TARGETS = {
    "other axes": (target_of([1, 2, 3], "elsewhere"), "ct", "its frame_id is 'elsewhere', expected that of the pose"),
    "no axes": (target_of([1, 2, 3], ""), "ct", "its frame_id is '', expected that of the pose, 'ct'"),
    "a pose without": (target_of([1, 2, 3], "ct"), "", "its frame_id is 'ct', expected that of the pose, ''"),
    "larger letters": (target_of([1, 2, 3], "CT"), "ct", "its frame_id is 'CT', expected that of the pose, 'ct'"),
    "with a slash": (target_of([1, 2, 3], "/ct"), "ct", "its frame_id is '/ct', expected that of the pose, 'ct'"),
    "x": (target_of([math.nan, 2, 3]), "ct", "point is [nan, 0.002, 0.003], expected finite numbers of metres"),
    "y": (target_of([1, math.inf, 3]), "ct", "point is [0.001, inf, 0.003], expected finite numbers of metres"),
    "z": (target_of([1, 2, -math.inf]), "ct", "point is [0.001, 0.002, -inf], expected finite numbers of metres"),
}


@pytest.mark.parametrize(("target", "pose_axes", "sentence"), BAD_TARGETS.values(), ids=BAD_TARGETS)
def test_a_target_that_cannot_be_used_is_refused_whatever_the_pose(target, pose_axes, sentence):
    # Too old and too inaccurate as well: it will not be of use with a later pose either.
    for now_s, max_error_mm in ((101.0, 3.0), (1e4, 1e-3)):
        outcome = answer(target, latest(pose_axes), now_s, max_error_mm)
        assert isinstance(outcome, TargetRefusal)
        assert outcome.reason == "bad_target"
        assert outcome.message.startswith(f"target ignored: {sentence}")
        assert outcome.pose_age_s == now_s - 100.0


@pytest.mark.parametrize("target", [target_of([1, 2, 3]), target_of([1, 2, 3], "elsewhere")])
def test_without_a_pose_there_is_no_target(target):
    outcome = answer(target, None)
    assert isinstance(outcome, TargetRefusal)
    assert outcome.reason == "no_pose"
    assert outcome.message.startswith("there is no pose to rest on: the last slice was refused, or none has come since")
    assert math.isnan(outcome.pose_age_s)


def test_a_pose_may_be_as_old_as_is_allowed_and_no_older():
    assert answer(target_of([1, 2, 3]), latest(), 160.0)
    outcome = answer(target_of([1, 2, 3]), latest(), 160.25)
    assert isinstance(outcome, TargetRefusal)
    assert outcome.reason == "pose_too_old"
    assert outcome.message == "the pose is 60.2 s old, at most 60 s are allowed"
    assert outcome.pose_age_s == 60.25


def test_a_target_may_be_as_old_as_is_allowed_and_no_older():
    """The patient may have moved since; the pose says nothing of that."""
    assert answer(target_of([1, 2, 3]), latest(), 150.0, received_s=60.0)
    outcome = answer(target_of([1, 2, 3]), latest(), 150.25, received_s=60.0)
    assert isinstance(outcome, TargetRefusal)
    assert outcome.reason == "target_too_old"
    assert outcome.message == "the target is 90.2 s old, at most 90 s are allowed: send it again"
    assert outcome.pose_age_s == 50.25


def test_an_error_may_be_as_large_as_is_allowed_and_no_larger():
    assert answer(target_of([1, 2, 3]), latest(), max_error_mm=ERROR_MM)
    outcome = answer(target_of([1, 2, 3]), latest(), max_error_mm=0.999 * ERROR_MM)
    assert isinstance(outcome, TargetRefusal)
    assert outcome.reason == "inaccurate"
    assert outcome.message == "the target's 95 % error is 0.39 mm, at most 0.3916 mm are allowed".replace(
        "0.3916", f"{0.999 * ERROR_MM:g}"
    )
    assert outcome.pose_age_s == 1.0


def test_the_status_of_an_answer_holds_its_numbers():
    status = status_of_target(TargetInFrame(np.array([5.0, -1.0, 3.0]), 0.5, Header(), 2.5), "cube6", "ct")
    assert (status.level, status.name, status.hardware_id) == (DiagnosticStatus.OK, "target", "ct")
    assert status.message == "target at (5.0, -1.0, 3.0) mm in the frame, to 0.50 mm (95 %)"
    assert values_of(status) == {
        "outcome": "accepted",
        "reason": "",
        "frame": "cube6",
        "target_x_mm": "5",
        "target_y_mm": "-1",
        "target_z_mm": "3",
        "target_error_95_mm": "0.5",
        "pose_age_s": "2.5",
    }


@pytest.mark.parametrize(
    "reason",
    ["bad_target", "no_pose", "pose_too_old", "target_too_old", "other_frame_of_reference", "inaccurate"],
)
def test_the_status_of_a_refusal_holds_no_numbers(reason):
    status = status_of_target(TargetRefusal(reason, "so it is", 61.0), "cube6", "ct")
    assert (status.level, status.message, status.hardware_id) == (DiagnosticStatus.ERROR, "so it is", "ct")
    assert values_of(status) == {
        "outcome": "refused",
        "reason": reason,
        "frame": "cube6",
        "target_x_mm": "nan",
        "target_y_mm": "nan",
        "target_z_mm": "nan",
        "target_error_95_mm": "nan",
        "pose_age_s": "61",
    }


# Over DDS. What is not published is shown by what is published next on the same topic.


class TargetBench(Bench):
    """A bench that knows what became of its targets."""

    def told(self) -> list[list[tuple[str, str]]]:
        """What /diagnostics said of targets, each time: the frames, each with the reason, empty where accepted."""
        told = [
            [(pairs["frame"], pairs["reason"]) for pairs in map(values_of, array.status) if "pose_age_s" in pairs]
            for array in self.diagnostics
        ]
        return [one for one in told if one]

    def reach(self, point_mm: list[float], frame_id: str = "ct") -> list[tuple[str, str]]:
        """Tell a target, and return what is said of it."""
        before = len(self.told())
        self.client.publish(f"{self.namespace}/target", target_of(point_mm, frame_id))
        self.client.wait_for(lambda: len(self.told()) > before, "a status of the target")
        return self.told()[before]

    def wait_told(self, count: int) -> None:
        """Until so much was said of targets: the answers to a slice come after its status."""
        self.client.wait_for(lambda: len(self.told()) >= count, "the statuses of the target")


@pytest.fixture(scope="module")
def running() -> Iterator[TargetBench]:
    spacing = f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"
    arguments = ["--ros-args", "-r", "__ns:=/targets", "-p", spacing]
    with RosClient("controller") as client, node_process("register_node", *arguments):
        bench = TargetBench(client, "/targets", "/targets/image")
        bench.warm_up()
        yield bench


@pytest.fixture
def bench(running: TargetBench) -> TargetBench:
    running.start_anew()
    return running


def clutter() -> np.ndarray:
    """A slice of false spots."""
    hu = np.zeros((256, 256))
    for u, v in np.random.default_rng(6).integers(5, 250, (14, 2)):
        hu[v - 1 : v + 2, u - 1 : u + 2] = 3000
    return hu


def unusable() -> Image:
    image = image_of(rendered(2)[0])
    image.encoding = "rgb8"
    return image


# A slice that was searched has its target answered at once, one that could not be used has not.
REFUSED = {
    "no_consensus": (image_of(clutter()), "no_consensus", "chance alone would bring", True),
    "too_few_spots": (image_of(np.zeros((256, 256))), "too_few_spots", "0 spots", True),
    "bad_image": (unusable(), "bad_image", "image encoding is 'rgb8'", False),
}


@pytest.mark.parametrize(("image", "reason", "sentence", "answers"), REFUSED.values(), ids=REFUSED)
def test_after_a_refused_slice_no_target_rests_on_the_pose_before(bench, image, reason, sentence, answers):
    first = bench.send(image_of(rendered(2)[0]))
    bench.pose(first)
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "")]

    bench.refusal(image, reason, sentence)
    bench.wait_told(2 if answers else 1)
    assert bench.reach([4.0, 5.0, 6.0]) == [("cube6", "no_pose")]

    # The target is not lost: with the next pose it is answered, and not before.
    last = bench.send(image_of(rendered(3)[0]))
    target = bench.client.wait_for(lambda: of_stamp(bench.targets, last), "target_in_frame")
    in_frame = bench.pose(last).inverse() @ np.array([4.0, 5.0, 6.0])
    np.testing.assert_allclose(conversions.point_from_message(target), in_frame, atol=1e-6)
    assert bench.stamps_of(bench.targets) == [first, last]
    bench.wait_told(4 if answers else 3)
    assert [reason for ((_, reason),) in bench.told()] == ["", *["no_pose"] * (1 + answers), ""]


def test_before_the_first_slice_there_is_no_pose_and_the_target_is_kept(bench):
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "no_pose")]
    stamp = bench.send(image_of(rendered(2)[0]))
    bench.client.wait_for(lambda: of_stamp(bench.targets, stamp), "target_in_frame")
    assert bench.stamps_of(bench.targets) == [stamp]


@pytest.mark.parametrize("change", [{"pixel_shear": 1e-4}, {"pixel_spacing": [1.0001 * SCALE.sx, SCALE.sy]}], ids=str)
def test_a_pose_of_another_spacing_is_none_to_rest_on(bench, change):
    first = bench.send(image_of(rendered(2)[0]))
    bench.pose(first)
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "")]
    assert bench.set(**change) == ""
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "no_pose")]
    last = bench.send(image_of(rendered(2)[0]))
    bench.client.wait_for(lambda: of_stamp(bench.targets, last), "target_in_frame")
    assert bench.stamps_of(bench.targets) == [first, last]


def test_a_recalibration_ends_the_pose_before_and_so_does_the_way_back(bench):
    """It was of a pixel spacing that is known to be wrong since."""
    assert bench.set(pixel_spacing=[1.01 * SCALE.sx, 0.99 * SCALE.sy], calibration_timeout=0.0) == ""
    image = image_of(rendered(12, noise_hu=5.0)[0])
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "no_pose")]
    first = bench.send(image)
    bench.wait_told(2)
    response = bench.call("recalibrate")
    assert response.success, response.message
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "no_pose")]
    second = bench.send(image)
    bench.wait_told(4)
    assert bench.call("reset_calibration").success
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "no_pose")]
    last = bench.send(image)
    bench.client.wait_for(lambda: of_stamp(bench.targets, last), "target_in_frame")
    assert bench.stamps_of(bench.targets) == [first, second, last]


FAULTY = {
    "other axes": target_of([1, 2, 3], "elsewhere"),
    "no axes": target_of([1, 2, 3], ""),
    "not finite": target_of([math.nan, 0, 0]),
}


@pytest.mark.parametrize("faulty", FAULTY.values(), ids=FAULTY)
def test_a_faulty_target_ends_the_one_before_and_is_forgotten(bench, faulty):
    """Steering on to the target before would look right."""
    first = bench.send(image_of(rendered(2)[0]))
    bench.pose(first)
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "")]
    bench.client.publish("/targets/target", faulty)
    bench.wait_told(2)
    last = bench.send(image_of(rendered(3)[0]))
    bench.pose(last)
    assert bench.reach([1.0, 2.0, 3.0]) == [("cube6", "")]
    bench.client.wait_for(lambda: of_stamp(bench.targets, last), "target_in_frame")
    # None with the second pose, neither of the good target nor of the faulty one.
    assert [reason for ((_, reason),) in bench.told()] == ["", "bad_target", ""]
    assert bench.stamps_of(bench.targets) == [first, last]


def test_a_skipped_slice_leaves_the_pose_before(monkeypatch):
    """It says nothing of the frame, and the next slice is waiting."""
    told: list[DiagnosticArray] = []
    monkeypatch.setattr(register_node, "_PREPARE_AT_START_S", 0.0)
    at_once = SimpleNamespace(is_free=True, submit=lambda work, then: then(work()), close=lambda: None)
    with node_here(register_node.RegisterNode) as node:
        monkeypatch.setattr(node, "_diagnostics", SimpleNamespace(publish=told.append))
        monkeypatch.setattr(node, "_worker", at_once)
        monkeypatch.setattr(node, "_prepare_tables", lambda *_: None)
        image = image_of(rendered(2)[0])
        image.header.frame_id = "ct"
        incoming = IncomingSlice(image, time.monotonic(), SCALE)
        node._begin(incoming)
        node._skip(incoming)
        node._target._on_target(target_of([1.0, 2.0, 3.0]))
    assert [values_of(status)["reason"] for array in told for status in array.status] == ["", "skipped", ""]


# cube6 on the left and cube8 on the right.
PLACED = {
    "cube6": PlacedFrame(CUBE, Pose(np.eye(3), np.array([34.0, 70.0, 3.0]))),
    "cube8": PlacedFrame(load_frame("cube8"), Pose(np.eye(3), np.array([95.0, 80.0, -4.0]))),
}


def showing(*names: str) -> Image:
    return image_of(render_slice([PLACED[name] for name in names], SCANNER, np.random.default_rng(1)).hu)


def test_of_two_frames_each_forgets_its_own_pose(bench):
    assert bench.set(frame_files=list(PLACED)) == ""
    targets = {name: bench.client.collect(PointStamped, f"/targets/{name}/target_in_frame") for name in PLACED}
    slices = 0

    def show(image: Image) -> tuple[Time, list[str]]:
        """Send a slice; returns its stamp and what became of each frame."""
        nonlocal slices
        stamp, slices = bench.send(image), slices + 1
        array = bench.client.wait_for(lambda: of_stamp(bench.diagnostics, stamp), "the diagnostics of an image")
        bench.wait_told(slices)
        return stamp, [values_of(status)["outcome"] for status in array.status]

    def reach():
        nonlocal slices
        slices += 1
        return bench.reach([1.0, 2.0, 3.0])

    def both_heard() -> bool:
        show(showing("cube6", "cube8"))
        return all(targets.values())

    neither = [("cube6", "no_pose"), ("cube8", "no_pose")]
    assert reach() == neither
    bench.client.wait_for(both_heard, "targets in both frames")
    both, outcomes = show(showing("cube6", "cube8"))
    assert outcomes == ["accepted", "accepted"]
    assert reach() == [("cube6", ""), ("cube8", "")]

    second, outcomes = show(showing("cube8"))
    assert outcomes == ["refused", "accepted"]
    assert reach() == [("cube6", "no_pose"), ("cube8", "")]

    both_again, _ = show(showing("cube6", "cube8"))
    first, outcomes = show(showing("cube6"))
    assert outcomes == ["accepted", "refused"]
    assert reach() == [("cube6", ""), ("cube8", "no_pose")]

    both_before, _ = show(showing("cube6", "cube8"))
    slices -= 1  # One that cannot be used has its target not answered.
    show(unusable())
    assert reach() == neither

    last, _ = show(showing("cube6", "cube8"))
    expected = {
        "cube6": [both, both_again, first, both_before, last],
        "cube8": [both, second, both_again, both_before, last],
    }
    for name, stamps in expected.items():
        bench.client.wait_for(lambda name=name: of_stamp(targets[name], last), f"the last target in {name}")
        told = [one.header.stamp.sec for one in targets[name] if one.header.stamp.sec >= both.sec]
        assert list(dict.fromkeys(told)) == [stamp.sec for stamp in stamps]
        assert {one.header.frame_id for one in targets[name]} == {name}
