"""What goes out for a slice: spacing, pose and image of one stamp, the image as small as loses nothing."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time

from stereoreg_ros.dicom import DicomSlice, read_slice
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.nodes.common.conversions import hu_from_image, pose_to_message
from stereoreg_ros.nodes.common.slice_publisher import POSE_GRACE_S, SlicePublisher
from support.dicom_files import write_slice

IMAGE = np.arange(6 * 8, dtype=np.uint16).reshape(6, 8)
STAMP = Time(sec=12, nanosec=34)
AXES = [0.0, 1.0, 0.0, 0.6, 0.0, -0.8]


class Topic:
    """Stands in for a publisher."""

    def __init__(self, messages: list[tuple[str, Any]], name: str) -> None:
        self.name, self.subscribers, self._messages = name, 0, messages

    def publish(self, message: Any) -> None:
        self._messages.append((self.name, message))

    def get_subscription_count(self) -> int:
        return self.subscribers


class Output:
    """A publisher of slices, without a node, and what it has published."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, Any]] = []
        self.topics: dict[str, Topic] = {}
        node: Any = SimpleNamespace(create_publisher=self._topic)
        self.publisher = SlicePublisher(node, "patient")

    def _topic(self, _type: type, name: str, _qos: Any) -> Topic:
        self.topics[name] = Topic(self.messages, name)
        return self.topics[name]

    def publish(self, dicom_slice: DicomSlice) -> dict[str, Any]:
        self.messages.clear()
        self.publisher.publish(dicom_slice, STAMP)
        return dict(self.messages)


def of_hu(tmp_path: Path, hu: Array) -> DicomSlice:
    """A slice of these HU, which need not be whole."""
    read = read_slice(write_slice(tmp_path / "a.dcm", IMAGE))
    ct_slice = SimpleNamespace(hu=np.asarray(hu, np.float32), scale=read.ct_slice.scale)
    ct_slice.scanner_from_slice = read.ct_slice.scanner_from_slice
    return DicomSlice(read.header, ct_slice)  # type: ignore[arg-type]


def test_the_image_comes_last_with_the_stamp_and_axes_of_all(tmp_path: Path) -> None:
    """Who gets the image so has all that belongs to it."""
    read = read_slice(write_slice(tmp_path / "a.dcm", IMAGE, PixelSpacing=[0.7, 0.4], ImageOrientationPatient=AXES))
    output = Output()
    topics = ["slice_spacing", "slice_pose", "slice_frame_of_reference", "image"]
    assert list(output.topics) == topics
    published = output.publish(read)
    assert list(published) == topics
    reference = published.pop("slice_frame_of_reference")
    assert (reference.frame_id, reference.stamp) == (read.header.frame_of_reference_uid, STAMP)
    assert {(one.header.frame_id, one.header.stamp.sec, one.header.stamp.nanosec) for one in published.values()} == {
        ("patient", 12, 34)
    }
    spacing = published["slice_spacing"].vector
    assert (spacing.x, spacing.y, spacing.z) == pytest.approx((0.0004, 0.0007, 0.0))
    assert published["slice_pose"].pose == pose_to_message(read.ct_slice.scanner_from_slice)
    np.testing.assert_array_equal(hu_from_image(published["image"]), IMAGE - 1024.0)


def test_a_slice_without_a_plane_has_no_pose(tmp_path: Path) -> None:
    """Not the identity, which would be believed."""
    elements: dict[str, Any] = {"ImagePositionPatient": None, "ImageOrientationPatient": None}
    read = read_slice(write_slice(tmp_path / "a.dcm", IMAGE, **elements), slice_axes=True)
    assert list(Output().publish(read)) == ["slice_spacing", "slice_frame_of_reference", "image"]


@pytest.mark.parametrize(
    ("values", "encoding"),
    [
        ([-32768.0, 32767.0], "16SC1"),
        ([-32769.0, 0.0], "32FC1"),
        ([0.0, 32768.0], "32FC1"),
        ([0.0, 0.5], "32FC1"),
        ([-1024.25, 3.0], "32FC1"),
        ([0.0, 70000.0], "32FC1"),
    ],
)
def test_hu_are_whole_numbers_only_where_that_loses_nothing(tmp_path: Path, values: list[float], encoding: str) -> None:
    image = Output().publish(of_hu(tmp_path, np.array([values])))["image"]
    assert image.encoding == encoding
    np.testing.assert_array_equal(hu_from_image(image), [values])


def test_it_is_listened_to_once_poses_are_taken_too_or_had_time_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("stereoreg_ros.nodes.common.slice_publisher.time.monotonic", lambda: now_s)
    output = Output()
    image, pose = output.topics["image"], output.topics["slice_pose"]
    pose.subscribers = 1
    assert not output.publisher.listened_to()
    image.subscribers = 1
    assert output.publisher.listened_to()
    pose.subscribers = 0
    assert not output.publisher.listened_to()
    now_s = 99.0 + POSE_GRACE_S + 1.0
    assert output.publisher.listened_to()
    # Who went away and came back has as much time again.
    image.subscribers = 0
    assert not output.publisher.listened_to()
    image.subscribers = 1
    assert not output.publisher.listened_to()
    now_s += POSE_GRACE_S - 0.01
    assert not output.publisher.listened_to()
    now_s += 0.02
    assert output.publisher.listened_to()
