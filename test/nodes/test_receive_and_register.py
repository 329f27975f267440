"""From the scanner's network to the pose: receiver and register_node as two processes, over DDS."""

from __future__ import annotations

import json
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest

from support.dicom_clients import run_dcmtk, send
from support.dicom_files import CATPHAN, real, write_slice
from support.real_images import CATPHAN_OPTIONS

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros import load_frame, register_slice
from stereoreg_ros.dicom import read_series
from stereoreg_ros.nodes.common.conversions import pose_from_message
from support.contract import STATUS_NAME
from support.register_bench import SCALE, Bench, image_of, of_stamp, rendered
from support.ros_process import RosClient, node_process
from support.scanner_nodes import SUCCESS, pixels, port_of, receiving_process, seconds

IMAGE = np.zeros((64, 64), np.uint16)


@pytest.fixture
def client():
    with RosClient() as ros:
        yield ros


def register_process(**parameters: Any):
    flags = [part for name, value in parameters.items() for part in ("-p", f"{name}:={json.dumps(value)}")]
    return node_process("register_node", "--ros-args", *flags)


class Registered:
    """What register_node says of each image, in order; the last word on one that it was sent again."""

    def __init__(self, client: RosClient) -> None:
        self._client = client
        self._heard = client.collect(DiagnosticArray, "/diagnostics")
        # Discovery takes its time in one direction and in the other: until an answer comes, some may be lost.
        while not self._heard:
            client.publish("image", Image())
            with suppress(AssertionError):
                client.wait_for(lambda: self._heard, "", 0.5)
        client.unpublish("image")

    @property
    def messages(self) -> list[DiagnosticArray]:
        # The status of the stream bears the time of its report.
        of_images = [one for one in self._heard if one.status[0].name == STATUS_NAME]
        by_stamp = {(one.header.stamp.sec, one.header.stamp.nanosec): one for one in of_images}
        return [message for (sec, _), message in by_stamp.items() if sec > 0]

    def wait(self, count: int, deadline_s: float = 60.0) -> list[dict[str, str]]:
        self._client.wait_for(lambda: len(self.messages) >= count, f"{count} answers", deadline_s)
        return [{one.key: one.value for one in message.status[0].values} for message in self.messages]


@contextmanager
def both(client: RosClient, **parameters: Any):
    """register_node and the receiver; gives what the first says, and the port of the second."""
    with register_process(**parameters):
        registered = Registered(client)
        with receiving_process(register_node="register_node") as process:
            yield registered, port_of(process, client)


def test_storescu_sends_the_real_catphan_and_the_poses_are_those_of_the_offline_tool(client):
    series = read_series(real(CATPHAN))
    frame = load_frame("catphan_ctp404")
    parameters = {"threshold": CATPHAN_OPTIONS.threshold, "max_rotation_deg": CATPHAN_OPTIONS.max_rotation_deg}
    with both(client, frame_file="catphan_ctp404", **parameters) as (registered, port):
        poses = client.collect(PoseStamped, "pose")
        files = [header.path for header in series.headers]
        sent = run_dcmtk("storescu", "-aec", "STEREOREG", "127.0.0.1", str(port), *files)
        assert sent.returncode == 0, sent.stderr
        answers = registered.wait(len(files), 300.0)
        accepted = [message.header.stamp for message in registered.messages if is_accepted(message)]
        client.wait_for(lambda: len(poses) >= len(accepted), "the poses")
    assert len(answers) == len(files)
    assert [pose.header.stamp for pose in poses] == accepted
    published = iter(poses)
    off_mm, off_rad = [], []
    for one, answer in zip(series, answers, strict=True):
        expected = register_slice(one.ct_slice, frame, CATPHAN_OPTIONS)
        assert answer["outcome"] == ("accepted" if expected else "refused"), one.header.path
        if not expected:
            assert answer["reason"] == expected.reason
            continue
        found = pose_from_message(next(published))
        off = expected.scanner_from_frame.inverse() @ found
        off_mm.append(float(np.linalg.norm(off.translation)))
        off_rad.append(float(np.abs(off.rotation - np.eye(3)).max()))
    print(f"{len(off_mm)} poses of {len(files)} slices: at most {max(off_mm):.2g} mm and {max(off_rad):.2g} rad off")
    assert len(off_mm) >= 9
    # The node starts from the pose before, the tool from none: the refinement ends near the same digits, not on them.
    assert max(off_mm) < 1e-4
    assert max(off_rad) < 1e-5


def is_accepted(message: DiagnosticArray) -> bool:
    return any(one.key == "outcome" and one.value == "accepted" for one in message.status[0].values)


def test_every_slice_is_registered_with_its_own_spacing(client, tmp_path):
    """Also where the spacing changes while slices wait."""
    spacings = [[0.5, 0.5]] * 3 + [[0.7, 0.4]] * 2 + [[0.5, 0.5], [0.9, 0.9], [0.5, 0.5]]
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE, z, PixelSpacing=one) for z, one in enumerate(spacings)]
    with both(client) as (registered, port):
        assert [one.Status for one in send(port, *paths)] == [SUCCESS] * len(paths)
        answers = registered.wait(len(paths))
    found = [[float(one["pixel_spacing_y_mm"]), float(one["pixel_spacing_x_mm"])] for one in answers]
    assert found == spacings
    assert {one["reason"] for one in answers} == {"too_few_spots"}


def test_a_burst_is_registered_slice_by_slice_and_none_is_lost(client, tmp_path):
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE, z) for z in range(60)]
    with both(client) as (registered, port):
        assert [one.Status for one in send(port, *paths)] == [SUCCESS] * len(paths)
        answers = registered.wait(len(paths))
    stamps = [seconds(message.header) for message in registered.messages]
    assert len(answers) == len(paths)
    assert (np.diff(stamps) > 0).all()
    assert {one["reason"] for one in answers} == {"too_few_spots"}


def wait_for_slices(client: RosClient, images: list[Image], count: int) -> None:
    """All of them but the last were answered then; one that was sent twice bears the same stamp."""
    client.wait_for(lambda: len({seconds(image.header) for image in images}) >= count, f"{count} slices", 90.0)


def test_slices_wait_for_register_node_and_for_the_one_that_takes_its_place(client, tmp_path):
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE + z, z, PixelSpacing=[0.6, 0.3]) for z in range(6)]
    with receiving_process(register_node="register_node") as process:
        port = port_of(process, client)
        images = client.collect(Image, "image")
        assert [one.Status for one in send(port, *paths[:2])] == [SUCCESS] * 2
        client.wait_for(
            lambda: "slices wait for register_node to take images" in process.output, "the receiver to wait"
        )
        assert not images
        with register_process():
            wait_for_slices(client, images, 2)
        assert [one.Status for one in send(port, *paths[2:4])] == [SUCCESS] * 2
        with register_process():
            wait_for_slices(client, images, 4)
            assert [one.Status for one in send(port, *paths[4:])] == [SUCCESS] * 2
            wait_for_slices(client, images, 6)
    in_order = list(dict.fromkeys(int(pixels(image)[0, 0]) + 1024 for image in images))
    assert in_order == list(range(6))


def test_a_slice_sent_to_a_register_node_that_was_killed_unnoticed_is_sent_again_to_its_successor(client, tmp_path):
    """DDS goes on counting a killed process for a while: nothing but its successor's coming shows that it is gone."""
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE + z, z, PixelSpacing=[0.6, 0.3]) for z in range(4)]
    with receiving_process(register_node="register_node") as process:
        port = port_of(process, client)
        images = client.collect(Image, "image")
        with register_process() as killed:
            assert [one.Status for one in send(port, *paths[:2])] == [SUCCESS] * 2
            wait_for_slices(client, images, 2)
            killed.kill()
        with register_process():
            assert [one.Status for one in send(port, *paths[2:])] == [SUCCESS] * 2
            # The third was answered then, with its own spacing.
            wait_for_slices(client, images, 4)
    assert list(dict.fromkeys(int(pixels(image)[0, 0]) + 1024 for image in images)) == [0, 1, 2, 3]


class SlowRegisterNode:
    """Stands in for register_node, and answers an image when it is asked to."""

    def __init__(self) -> None:
        self.stamps: list[Any] = []
        self.client = RosClient("register_node")
        self._answers = self.client.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.client.node.create_subscription(PoseStamped, "slice_pose", lambda pose: None, 10)
        self.client.node.create_subscription(Image, "image", self._on_image, 10)

    def _on_image(self, image: Any) -> None:
        self.stamps.append(image.header.stamp)

    def answer(self, number: int, spacing: tuple[float, float], calibration: str = "configured") -> None:
        """Answer the image that came as the one of this number, as registered with this spacing."""
        sx, sy = spacing
        values = {"calibration": calibration, "pixel_spacing_x_mm": str(sx), "pixel_spacing_y_mm": str(sy)}
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        status = DiagnosticStatus(name=STATUS_NAME, values=pairs)
        self._answers.publish(DiagnosticArray(header=Header(stamp=self.stamps[number]), status=[status]))


def test_a_slice_that_was_registered_with_another_spacing_is_sent_again(tmp_path):
    """As by a register_node that has not heard of the spacings yet."""
    slow = SlowRegisterNode()
    with slow.client as client, receiving_process(register_node="register_node") as process:
        port = port_of(process, client)
        paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE, z, PixelSpacing=[0.5, 0.5]) for z in range(2)]
        assert [one.Status for one in send(port, *paths)] == [SUCCESS] * 2
        client.wait_for(lambda: slow.stamps, "the first slice")
        slow.answer(0, (0.5, 0.505))
        client.wait_for(lambda: len(slow.stamps) >= 2, "the slice again")
        assert slow.stamps[0] == slow.stamps[1]
        # What was measured in its place is right.
        slow.answer(1, (0.507, 0.493), "measured")
        client.wait_for(lambda: len(slow.stamps) >= 3, "the second slice")
        assert slow.stamps[2] != slow.stamps[1]
        slow.answer(2, (0.5, 0.5))


def test_a_register_node_that_was_started_anew_publishes_no_pose_before_it_has_a_slice(client):
    """The latest pose of before, which late subscribers get, has gone with the process that knew how old it is."""
    told = {"pixel_spacing": [SCALE.sx, SCALE.sy]}
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    late: list[PoseStamped] = []
    with register_process(**told) as killed:
        bench = Bench(client)
        bench.warm_up()
        before = bench.poses[-1].header.stamp
        killed.kill()
    with register_process(**told) as process:
        subscription = client.node.create_subscription(PoseStamped, "pose", late.append, latched)
        client.wait_for(lambda: "ready, frame" in process.output, "the node")
        bench.diagnostics.clear()
        bench.warm_up(bench.diagnostics)
        stamp = bench.send(image_of(rendered(2)[0]))
        client.wait_for(lambda: of_stamp(late, stamp), "the new pose")
        client.node.destroy_subscription(subscription)
    assert min(seconds(pose.header) for pose in late) > before.sec + 1e-9 * before.nanosec
