"""Clocks that jump, stamps that repeat or run backwards: every pose bears the stamp of its own slice, and no other."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.common.conversions import pose_from_message, pose_to_message
from stereoreg_ros.nodes.common.slice_publisher import SlicePublisher
from support.dicom_clients import send
from support.dicom_files import write_slice
from support.register_bench import SCALE, Bench, assert_near, image_of, of_stamp, rendered, values_of
from support.ros_process import RosClient, node_process
from support.scanner_nodes import receiver, seconds

_NS = 10**9


@pytest.fixture(scope="module")
def client():
    with RosClient("scanner") as scanner:
        yield scanner


@pytest.fixture
def publisher(client):
    return SlicePublisher(client.node, "scanner")


def nanoseconds(stamp: Time) -> int:
    return int(stamp.sec) * _NS + int(stamp.nanosec)


def test_stamps_are_distinct_while_the_clock_stands_still_and_never_zero(publisher):
    stamps = [nanoseconds(publisher.unique_stamp(0)) for _ in range(5)]
    assert stamps == [1, 2, 3, 4, 5]


def test_stamps_follow_a_clock_that_is_set_back_and_forward(publisher):
    """A stamp of the future would make a pose look new for as long as the clock was set back."""
    hour = 3600 * _NS
    for time_ns in (10 * hour, 9 * hour, 9 * hour + 5, 12 * hour, 1):
        assert nanoseconds(publisher.unique_stamp(time_ns)) == time_ns
    assert nanoseconds(publisher.unique_stamp(1)) == 2


def test_received_slices_bear_the_time_of_a_simulated_clock_that_jumps(client, tmp_path):
    image = np.zeros((12, 16), np.uint16)
    clock = client.node.create_publisher(Clock, "/clock", 10)
    with receiver(client, use_sim_time=True) as received:
        client.wait_for(clock.get_subscription_count, "the receiver's clock")
        for number, second in enumerate((5000, 100, 100, 90_000, 7)):
            path = write_slice(tmp_path / f"{number}.dcm", image, float(number))
            end = client.node.get_clock().now().nanoseconds + _NS // 2

            def ticked(second=second, end=end) -> bool:
                clock.publish(Clock(clock=Time(sec=second)))
                return bool(client.node.get_clock().now().nanoseconds > end)

            client.wait_for(ticked, "the clock to be heard")
            assert [one.Status for one in send(received.port, path)] == [0]
            received.wait(number + 1)
    stamps = [seconds(one.header) for one in received.images]
    # The time of arrival: less what the slice has waited, which is not much.
    np.testing.assert_allclose(stamps, [5000, 100, 100, 90_000, 7], atol=1.0)
    assert len(set(stamps)) == 5


class PlacedBench(Bench):
    """Sends with every image a plane of its own, by which its pose can be known."""

    def send_placed(self, hu: np.ndarray, z_mm: float, stamp: Time) -> None:
        plane = PoseStamped(pose=pose_to_message(Pose(np.eye(3), np.array([0.0, 0.0, z_mm]))))
        plane.header.stamp = stamp
        self.client.publish(f"{self.namespace}/slice_pose", plane)
        self.send(image_of(hu), stamp=stamp)

    def accept_any(self) -> None:
        hu, _ = rendered(1)
        stamp = self.next_stamp()
        self.send_placed(hu, 0.0, stamp)
        self.pose(stamp)


@pytest.fixture(scope="module")
def running(client):
    told = ["--ros-args", "-r", "__ns:=/placed", "-p", f"pixel_spacing:=[{SCALE.sx},{SCALE.sy}]"]
    with node_process("register_node", *told):
        bench = PlacedBench(client, "/placed", "/placed/image")
        bench.warm_up()
        yield bench


@pytest.fixture
def placed(running: PlacedBench) -> PlacedBench:
    """The running node as at its start, whatever other tests have made of it."""
    running.start_anew()
    return running


def test_slices_out_of_order_and_repeated(placed):
    """Stamps that run backwards, jump by years, and come twice."""
    seconds_of_slices = [900, 800, 2_000_000_000, 5, 900, 801, 5]
    stamps = [Time(sec=one, nanosec=1) for one in seconds_of_slices]
    slices = {one: rendered(number + 20) for number, one in enumerate(dict.fromkeys(seconds_of_slices))}
    answers = 0
    for stamp in stamps:
        hu, slice_from_frame = slices[stamp.sec]
        placed.poses.clear()
        placed.send_placed(hu, float(stamp.sec % 1000), stamp)
        message = placed.client.wait_for(lambda stamp=stamp: of_stamp(placed.poses, stamp), "the pose")
        plane = Pose(np.eye(3), np.array([0.0, 0.0, float(stamp.sec % 1000)]))
        assert_near(pose_from_message(message), plane @ slice_from_frame)
        answers += 1
    assert answers == len(stamps)


def test_a_stamp_before_1970_is_one_like_others_and_keeps_no_slice_waiting(placed):
    hu, slice_from_frame = rendered(33)
    # Whether slices wait for one another is up to the machine.
    for burst in range(4):
        stamps = [Time(sec=number - 20 * (burst + 1)) for number in range(10)] + [Time(sec=6000 + burst)]
        for stamp in stamps:
            placed.send_placed(hu, 0.0, stamp)

        def all_answered(stamps=stamps) -> bool:
            return all(of_stamp(placed.diagnostics, stamp) for stamp in stamps)

        placed.client.wait_for(all_answered, "an answer to every slice")
    before_1970 = [pose for pose in placed.poses if pose.header.stamp.sec < 0]
    assert before_1970
    for message in before_1970:
        assert_near(pose_from_message(message), slice_from_frame)


def test_the_same_slice_twice_gives_the_same_pose_and_another_of_its_stamp_none_that_is_wrong(placed):
    stamp = Time(sec=77, nanosec=1)
    one, other = rendered(30), rendered(31)
    for _ in range(2):
        placed.send_placed(one[0], 0.0, stamp)
    placed.client.wait_for(lambda: len([p for p in placed.diagnostics if p.header.stamp == stamp]) >= 2, "answers", 30)
    found = [pose_from_message(pose) for pose in placed.poses if pose.header.stamp == stamp]
    assert found
    for pose in found:
        assert_near(pose, one[1])
    # Both planes are there before either image: which is whose cannot be told.
    stamp = Time(sec=78, nanosec=1)
    for z_mm in (100.0, 200.0):
        plane = PoseStamped(pose=pose_to_message(Pose(np.eye(3), np.array([0.0, 0.0, z_mm]))))
        plane.header.stamp = stamp
        placed.client.publish("/placed/slice_pose", plane)
    for hu, _ in (one, other):
        placed.send(image_of(hu), stamp=stamp)
    answers = placed.client.wait_for(
        lambda: [p for p in placed.diagnostics if p.header.stamp == stamp][1:], "both answers", 30.0
    )
    assert answers
    allowed = [one[1].translation[2] + 100.0, other[1].translation[2] + 200.0]
    for pose in (pose_from_message(pose) for pose in placed.poses if pose.header.stamp == stamp):
        assert min(abs(pose.translation[2] - z_mm) for z_mm in allowed) < 0.5


def test_an_image_without_a_stamp_is_refused_where_its_plane_is_known_by_that(placed):
    plane = PoseStamped(pose=pose_to_message(Pose.identity()))
    placed.client.publish("/placed/slice_pose", plane)
    sent = len(placed.diagnostics)
    hu, _ = rendered(32)
    placed.client.publish("/placed/image", image_of(hu))

    def refused() -> list[str]:
        told = [status for array in placed.diagnostics[sent:] for status in array.status]
        return [one.message for one in told if values_of(one).get("reason") == "bad_image"]

    assert "its stamp is 0" in placed.client.wait_for(refused, "the refusal")[0]
