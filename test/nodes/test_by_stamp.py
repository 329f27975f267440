"""Images and what belongs to them find each other by their stamps, and nothing piles up."""

from __future__ import annotations

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.register.by_stamp import WAIT_S, ByStamp


def pose(x_mm: float) -> Pose:
    return Pose(np.eye(3), np.array([x_mm, 0.0, 0.0]))


def slice_poses() -> ByStamp[Pose, Image]:
    def same(one: Pose, other: Pose) -> bool:
        return bool((one.translation == other.translation).all())

    return ByStamp("slice_pose", same)


def image(stamp: Time) -> Image:
    return Image(header=Header(stamp=stamp))


def test_pose_first():
    poses, known = slice_poses(), pose(1.0)
    assert poses.add(Time(sec=1), known) is None
    assert poses.take(Time(sec=1, nanosec=1)) is None
    assert poses.take(Time(sec=1)) is known
    # A pose serves one image.
    assert poses.take(Time(sec=1)) is None


def test_image_first():
    poses, first, second = slice_poses(), image(Time(sec=1)), image(Time(sec=2))
    poses.wait(Time(sec=1), first, now_s=0.0)
    poses.wait(Time(sec=2), second, now_s=0.1)
    assert poses.add(Time(sec=3), pose(3.0)) is None
    known = pose(2.0)
    assert poses.add(Time(sec=2), known) == (second, known)
    assert poses.take_overdue(now_s=WAIT_S - 0.01) is None
    assert poses.take_overdue(now_s=WAIT_S) is first
    assert poses.take_overdue(now_s=WAIT_S) is None


def test_same_pose_twice_is_one():
    poses = slice_poses()
    poses.add(Time(sec=1), pose(1.0))
    poses.add(Time(sec=1), pose(1.0))
    assert isinstance(poses.take(Time(sec=1)), Pose)


def test_two_poses_of_one_stamp_are_none():
    poses = slice_poses()
    poses.add(Time(sec=1), pose(1.0))
    poses.add(Time(sec=1), pose(2.0))
    assert isinstance(poses.take(Time(sec=1)), MessageError)


@pytest.mark.parametrize("third", [1.0, 2.0, 3.0])
def test_a_third_pose_does_not_make_two_different_ones_one_again(third: float):
    poses = slice_poses()
    for x_mm in (1.0, 2.0, third):
        poses.add(Time(sec=1), pose(x_mm))
    assert isinstance(poses.take(Time(sec=1)), MessageError)
    # Once the image has had its answer, the stamp is free again.
    poses.add(Time(sec=1), pose(4.0))
    assert isinstance(poses.take(Time(sec=1)), Pose)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_pose_and_one_that_cannot_be_read_are_none(is_first: bool):
    poses, unreadable = slice_poses(), MessageError("cannot be read")
    for one in (unreadable, pose(1.0)) if is_first else (pose(1.0), unreadable):
        poses.add(Time(sec=1), one)
    assert poses.take(Time(sec=1)) is unreadable


def test_two_images_of_one_stamp_are_refused_a_pose_that_may_be_of_either():
    poses, first, second = slice_poses(), image(Time(sec=1)), image(Time(sec=1))
    for one in (first, second):
        poses.wait(Time(sec=1), one, now_s=0.0)
    met = poses.add(Time(sec=1), pose(2.0))
    assert met is not None
    assert met[0] is first
    assert isinstance(met[1], MessageError)
    assert poses.take_overdue(now_s=WAIT_S) is second


def test_pose_of_an_image_that_is_given_up_meets_no_later_one():
    for pose_first in (True, False):
        poses, known = slice_poses(), pose(2.0)
        if pose_first:
            poses.add(Time(sec=1), pose(1.0))
        poses.give_up(Time(sec=1))
        if not pose_first:
            assert poses.add(Time(sec=1), pose(1.0)) is None
        assert poses.take(Time(sec=1)) is None
        # Those that come after belong to the later image.
        poses.add(Time(sec=1), known)
        assert poses.take(Time(sec=1)) is known


def test_neither_poses_nor_images_pile_up():
    poses = slice_poses()
    for sec in range(100):
        poses.add(Time(sec=sec), pose(float(sec)))
        poses.wait(Time(sec=1000 + sec), image(Time(sec=1000 + sec)), now_s=0.0)
    assert poses.take(Time(sec=0)) is None
    assert poses.take(Time(sec=99)) is not None
    overdue = []
    while (found := poses.take_overdue(now_s=0.0)) is not None:
        overdue.append(found.header.stamp.sec)
    assert overdue == list(range(1000, 1068))
