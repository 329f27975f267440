"""The DICOM player as a process of its own, over DDS."""

from __future__ import annotations

import signal
import time
from typing import Any

import numpy as np
import pytest

from support.contract import STATUS_NAME
from support.dicom_files import SHARED_DATA, real, write_slice

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from support.ros_process import RosClient, node_process
from support.scanner_nodes import pixels, play

IMAGE = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)


@pytest.fixture
def client():
    with RosClient() as ros:
        yield ros


@pytest.fixture
def series(tmp_path):
    """Five slices, 2.5 mm apart, whose names and numbers do not tell their order; pixel (0, 0) does."""
    for z, number in enumerate([3, 0, 4, 1, 2]):
        write_slice(tmp_path / f"{number}.dcm", IMAGE + z, 2.5 * z, InstanceNumber=number, PixelSpacing=[0.7, 0.4])
    return tmp_path


def test_folder_is_played_once_in_table_order(client, series):
    with play(series) as player:
        poses, images = client.collect(PoseStamped, "slice_pose"), client.collect(Image, "image")
        client.wait_for(lambda: len(images) == 5 and len(poses) == 5, "five slices")
        assert player.wait() == 0
    for z, (pose, image) in enumerate(zip(poses, images, strict=True)):
        assert pose.header == image.header
        assert image.header.frame_id == "scanner"
        assert image.encoding == "16SC1"
        np.testing.assert_array_equal(pixels(image), IMAGE.astype(int) + z - 1024)
        position, orientation = pose.pose.position, pose.pose.orientation
        np.testing.assert_allclose([position.x, position.y, position.z], [-0.010, -0.020, 0.0025 * z], atol=1e-12)
        assert (orientation.x, orientation.y, orientation.z, orientation.w) == (0, 0, 0, 1)
    stamps = [image.header.stamp.sec + 1e-9 * image.header.stamp.nanosec for image in images]
    assert (np.diff(stamps) > 0).all()


def test_hu_that_are_not_whole_are_played_as_floats(client, tmp_path):
    path = write_slice(tmp_path / "a.dcm", IMAGE, RescaleSlope=0.5)
    with play(path, frame_id="ct"):
        images = client.collect(Image, "image")
        client.wait_for(lambda: images, "the slice")
    assert (images[0].encoding, images[0].header.frame_id) == ("32FC1", "ct")
    np.testing.assert_array_equal(pixels(images[0]), IMAGE * 0.5 - 1024)


NO_PLANE: dict[str, Any] = {"ImagePositionPatient": None, "ImageOrientationPatient": None}


def test_a_slice_without_a_plane_is_refused(tmp_path):
    with play(write_slice(tmp_path / "a.dcm", IMAGE, **NO_PLANE)) as player:
        assert player.wait() == 1
        assert "Image Position (Patient) (0020,0032) is missing, expected the position of the slice" in player.output
        assert "slice_axes of play_dicom_node" in player.output
        assert "Traceback" not in player.output


@pytest.mark.parametrize(("named", "published"), [({}, "ct_slice"), ({"frame_id": "phantom"}, "phantom")])
def test_slices_in_their_own_axes_have_no_slice_pose_and_another_frame_id(client, tmp_path, named, published):
    write_slice(tmp_path / "a.dcm", IMAGE, InstanceNumber=1, **NO_PLANE)
    write_slice(tmp_path / "b.dcm", IMAGE + 1, InstanceNumber=2)
    with play(tmp_path, slice_axes=True, **named) as player:
        poses, images = client.collect(PoseStamped, "slice_pose"), client.collect(Image, "image")
        client.wait_for(lambda: len(images) == 2, "two slices")
        assert player.wait() == 0
        assert f"each slice is in its own axes, '{published}': no slice_pose" in player.output
    assert [int(pixels(image)[0, 0]) + 1024 for image in images] == [0, 1]
    assert {image.header.frame_id for image in images} == {published}
    # The poses are published before the images.
    assert not poses


def test_rate_and_loop(client, series):
    with play(series, rate=20.0, loop=True) as player:
        images = client.collect(Image, "image")
        client.wait_for(lambda: len(images) >= 21, "the series four times")
        assert player.running
        code, seconds = player.stop(signal.SIGTERM)
        assert (code, seconds < 5) == (0, True)
    order = [int(pixels(image)[0, 0]) + 1024 for image in images]
    assert order == [number % 5 for number in range(len(order))]
    stamps = [image.header.stamp.sec + 1e-9 * image.header.stamp.nanosec for image in images]
    assert np.diff(stamps).mean() == pytest.approx(0.05, rel=0.2)


def test_nothing_is_lost_on_a_subscriber_that_is_busy(client, tmp_path):
    for z in range(10):
        write_slice(tmp_path / f"{z}.dcm", np.full((512, 512), z, np.uint16), z)
    with play(tmp_path, rate=100.0) as player:
        images = client.collect(Image, "image")
        assert player.wait() == 0
        # Everything must have arrived before the player left.
        client.wait_for(lambda: len(images) == 10, "ten slices", deadline_s=5.0)
    assert [int(pixels(image)[0, 0]) for image in images] == [z - 1024 for z in range(10)]


def test_nothing_is_played_to_nobody(client, series):
    with play(series) as player:
        client.wait_for(lambda: "5 slices" in player.output, "the player")
        time.sleep(0.5)
        assert player.running
        assert player.stop(signal.SIGTERM)[0] == 0


def test_without_waiting_it_plays_to_nobody(series):
    with play(series, wait_for_subscriber=False) as player:
        assert player.wait() == 0
        assert "played 5 of 5 slices" in player.output


def test_each_slice_brings_its_spacing_and_its_frame_of_reference(client, tmp_path):
    """By which a register_node knows what to make of it, whatever it was started with."""
    uids = ["1.2.826.1", "1.2.826.1", None]
    for z, uid in enumerate(uids):
        write_slice(tmp_path / f"{z}.dcm", IMAGE + z, z, PixelSpacing=[0.7, 0.4], FrameOfReferenceUID=uid)
    with play(tmp_path):
        spacings = client.collect(Vector3Stamped, "slice_spacing")
        references = client.collect(Header, "slice_frame_of_reference")
        client.collect(PoseStamped, "slice_pose")
        images = client.collect(Image, "image")
        client.wait_for(lambda: min(map(len, (spacings, references, images))) == 3, "three slices")
    stamps = [image.header.stamp for image in images]
    assert [one.header.stamp for one in spacings] == stamps
    assert [one.stamp for one in references] == stamps
    assert [(1e3 * one.vector.x, 1e3 * one.vector.y, one.vector.z) for one in spacings] == [(0.4, 0.7, 0.0)] * 3
    assert [one.frame_id for one in references] == ["1.2.826.1", "1.2.826.1", ""]


def test_faulty_slice_is_left_out_and_reported(client, series):
    write_slice(series / "short.dcm", IMAGE, 6.0, PixelSpacing=[0.7, 0.4], PixelData=IMAGE.tobytes()[:100])
    with play(series) as player:
        images = client.collect(Image, "image")
        client.wait_for(lambda: len(images) == 5, "five slices")
        assert player.wait() == 1
        assert "short.dcm: Pixel Data (7FE0,0010) has 100 bytes, expected 384 bytes" in player.output


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"path": ""}, "parameter path is empty, expected a DICOM file or folder"),
        ({"path": "/nowhere"}, "/nowhere: no such file, expected a DICOM file"),
        ({"rate": 0.0}, "rate"),
        ({"rate": 5}, "rate"),
    ],
)
def test_it_does_not_start_on_wrong_parameters(series, parameters, sentence):
    with play(**{"path": series, **parameters}) as player:
        assert player.wait() == 1
        assert sentence in player.output
        assert "Traceback" not in player.output


def test_it_does_not_start_on_mixed_series(series):
    write_slice(series / "other.dcm", IMAGE, SeriesInstanceUID="1.2.3")
    with play(series) as player:
        assert player.wait() == 1
        assert "holds 2 series, expected one" in player.output
        assert "Traceback" not in player.output


def test_parameters_are_described(client, series):
    names = ["path", "rate", "loop", "frame_id", "slice_axes", "register_node", "wait_for_subscriber"]
    with play(series):
        described = client.describe_parameters("play_dicom_node", *names)
    assert all(one.description for one in described)
    (rate_range,) = described[1].floating_point_range
    assert (rate_range.from_value, rate_range.to_value) == (0.01, 100.0)


def test_with_register_node_on_a_real_slice(client):
    path = real(SHARED_DATA / "leksell_ct" / "slice.dcm")
    parameters = ["--ros-args", "-p", "frame_file:=leksell_ct", "-p", "threshold:=1000.0"]
    with node_process("register_node", *parameters):
        arrays = client.collect(DiagnosticArray, "/diagnostics")

        def of_the_slice() -> list[DiagnosticStatus]:
            return [status for array in arrays for status in array.status if status.name == STATUS_NAME]

        with play(path) as player:
            client.wait_for(of_the_slice, "the diagnostics of the slice")
            assert player.wait() == 0
    (status,) = of_the_slice()
    values = {one.key: one.value for one in status.values}
    assert float(values["pixel_spacing_x_mm"]) == float(values["pixel_spacing_y_mm"]) == 0.625
    assert values["reason"] == "ambiguous", status.message
