"""Images and slice poses find each other by their stamps, and nothing piles up."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.conversions import MessageError
from stereoreg_ros.nodes.slice_poses import WAIT_S, SlicePoses


def pose(x_mm: float) -> Pose:
    return Pose(np.eye(3), np.array([x_mm, 0.0, 0.0]))


def image(stamp: Time) -> Image:
    return Image(header=Header(stamp=stamp))


def test_pose_first():
    poses, known = SlicePoses(), pose(1.0)
    assert poses.add_pose(Time(sec=1), known) is None
    assert poses.take_pose(Time(sec=1, nanosec=1)) is None
    assert poses.take_pose(Time(sec=1)) is known
    # A pose serves one image.
    assert poses.take_pose(Time(sec=1)) is None


def test_image_first():
    poses, first, second = SlicePoses(), image(Time(sec=1)), image(Time(sec=2))
    poses.add_image(first, now_s=0.0)
    poses.add_image(second, now_s=0.1)
    assert poses.add_pose(Time(sec=3), pose(3.0)) is None
    assert poses.add_pose(Time(sec=2), pose(2.0)) is second
    assert poses.take_overdue(now_s=WAIT_S - 0.01) is None
    assert poses.take_overdue(now_s=WAIT_S) is first
    assert poses.take_overdue(now_s=WAIT_S) is None


def test_same_pose_twice_is_one():
    poses = SlicePoses()
    poses.add_pose(Time(sec=1), pose(1.0))
    poses.add_pose(Time(sec=1), pose(1.0))
    assert isinstance(poses.take_pose(Time(sec=1)), Pose)


def test_two_poses_of_one_stamp_are_none():
    poses = SlicePoses()
    poses.add_pose(Time(sec=1), pose(1.0))
    poses.add_pose(Time(sec=1), pose(2.0))
    assert isinstance(poses.take_pose(Time(sec=1)), MessageError)


def test_neither_poses_nor_images_pile_up():
    poses = SlicePoses()
    for sec in range(100):
        poses.add_pose(Time(sec=sec), pose(float(sec)))
        poses.add_image(image(Time(sec=1000 + sec)), now_s=0.0)
    assert poses.take_pose(Time(sec=0)) is None
    assert poses.take_pose(Time(sec=99)) is not None
    overdue = []
    while (found := poses.take_overdue(now_s=0.0)) is not None:
        overdue.append(found.header.stamp.sec)
    assert overdue == list(range(1000, 1068))
