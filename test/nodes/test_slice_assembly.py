"""Images, their pixel spacings and their planes find each other by their stamps, and nothing piles up."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice, SlicePlane
from stereoreg_ros.nodes.register.slice_assembly import CAPACITY, PLANE, SPACING, WAIT_S, SliceAssembly

ONE, TWO = Time(sec=1, nanosec=5), Time(sec=2)
BOTH = (SPACING, PLANE)
SCALE = PixelScale(0.5, 0.6)


def plane(x_mm: float = 1.0, frame_id: str = "ct") -> SlicePlane:
    return SlicePlane(Pose(np.eye(3), np.array([x_mm, 0.0, 0.0])), frame_id)


def image(stamp: Time = ONE, height: int = 0) -> Image:
    return Image(header=Header(stamp=stamp), height=height)


def only(assembly: SliceAssembly, now_s: float = 0.0) -> IncomingSlice:
    (one,) = assembly.take(now_s)
    return one


def test_where_nothing_is_expected_an_image_is_whole() -> None:
    assembly, alone = SliceAssembly(), image(Time())
    assembly.add_image(alone, 7.0, ())
    one = only(assembly)
    assert (one.image, one.received_s, one.spacing, one.plane, one.fault) == (alone, 7.0, None, None, "")
    assert assembly.take(0.0) == []


@pytest.mark.parametrize("order", ["image, spacing, plane", "plane, image, spacing", "spacing, plane, image"])
def test_the_parts_come_in_any_order(order: str) -> None:
    assembly, ours = SliceAssembly(), plane()
    for number, what in enumerate(order.split(", ")):
        assert assembly.take(0.0) == [], number
        if what == "image":
            assembly.add_image(image(), 3.0, BOTH)
        else:
            assembly.add_part(*((SPACING, ONE, SCALE) if what == "spacing" else (PLANE, ONE, ours)))
        # Those of other stamps are no one's here.
        assembly.add_part(PLANE, TWO, plane(9.0))
        assembly.add_part(SPACING, Time(sec=1, nanosec=6), PixelScale(0.9, 0.9))
    one = only(assembly)
    assert (one.spacing, one.plane, one.fault, one.stamp) == (SCALE, ours, "", ONE)
    # When the image came, whenever its parts did.
    assert one.received_s == 3.0


def test_a_part_serves_one_image() -> None:
    assembly = SliceAssembly()
    assembly.add_part(PLANE, ONE, plane(1.0))
    assembly.add_image(image(), 0.0, [PLANE])
    assert only(assembly).plane is not None
    assembly.add_image(image(), 1.0, [PLANE])
    assert assembly.take(1.0) == []
    second = plane(2.0)
    assembly.add_part(PLANE, ONE, second)
    assert only(assembly, 1.0).plane is second


def test_in_vain_it_is_waited_for_four_seconds_from_the_images_coming() -> None:
    assembly = SliceAssembly()
    assembly.add_image(image(ONE, 1), 10.0, [PLANE])
    assembly.add_image(image(TWO, 2), 11.0, BOTH)
    assembly.add_part(SPACING, TWO, SCALE)
    assert assembly.take(10.0 + WAIT_S - 0.01) == []
    first = only(assembly, 10.0 + WAIT_S)
    assert (first.image.height, first.plane) == (1, None)
    assert first.fault == "no slice_pose with the image's stamp came within 4 s"
    second = only(assembly, 11.0 + WAIT_S)
    assert (second.image.height, second.spacing) == (2, SCALE)
    assert second.fault == "no slice_pose with the image's stamp came within 4 s"


def test_those_that_are_whole_do_not_wait_for_those_before_them() -> None:
    assembly = SliceAssembly()
    for number, stamp in enumerate((ONE, TWO, Time(sec=3))):
        assembly.add_image(image(stamp, number), float(number), [PLANE])
    assembly.add_part(PLANE, Time(sec=3), plane())
    assembly.add_part(PLANE, TWO, plane())
    assert [one.image.height for one in assembly.take(2.0)] == [1, 2]


def test_an_image_without_a_stamp_is_refused_where_something_belongs_to_it() -> None:
    assembly = SliceAssembly()
    assembly.add_part(PLANE, Time(), plane())
    assembly.add_image(image(Time()), 0.0, BOTH)
    one = only(assembly)
    assert one.fault == "its stamp is 0, expected one by which to know its slice_pose and slice_spacing"
    assert (one.spacing, one.plane) == (None, None)


@pytest.mark.parametrize("image_first", [True, False])
def test_what_cannot_be_read_refuses_its_image_by_its_sentence(image_first: bool) -> None:
    assembly = SliceAssembly()
    if image_first:
        assembly.add_image(image(), 0.0, BOTH)
    assembly.add_part(SPACING, ONE, MessageError("slice_spacing: is negative"))
    assembly.add_part(PLANE, ONE, MessageError("slice_pose: is no rotation"))
    if not image_first:
        assembly.add_image(image(), 0.0, BOTH)
    assert only(assembly).fault == "slice_spacing: is negative; slice_pose: is no rotation"


def test_the_same_twice_is_one() -> None:
    assembly = SliceAssembly()
    for _ in range(2):
        assembly.add_part(PLANE, ONE, plane())
        assembly.add_part(SPACING, ONE, PixelScale(0.5, 0.6))
    assembly.add_image(image(), 0.0, BOTH)
    one = only(assembly)
    assert (one.fault, one.spacing) == ("", SCALE)
    assert one.plane is not None


@pytest.mark.parametrize("other", [plane(2.0), plane(frame_id="room")])
@pytest.mark.parametrize("third", [plane(1.0), plane(2.0), None])
def test_two_different_ones_are_none_whatever_comes_after(other: SlicePlane, third: SlicePlane | None) -> None:
    assembly = SliceAssembly()
    for one in (plane(1.0), other, *([third] if third else [])):
        assembly.add_part(PLANE, ONE, one)
    assembly.add_image(image(), 0.0, [PLANE])
    refused = only(assembly)
    assert refused.fault == "two different slice_pose messages have the image's stamp, expected one"
    assert refused.plane is None
    # Once the image has had its answer, the stamp is free again.
    assembly.add_part(PLANE, ONE, other)
    assembly.add_image(image(), 0.0, [PLANE])
    assert only(assembly).plane is other


@pytest.mark.parametrize("is_first", [True, False])
def test_one_that_cannot_be_read_and_one_that_can_are_none(is_first: bool) -> None:
    assembly, unreadable = SliceAssembly(), MessageError("cannot be read")
    for one in (unreadable, plane()) if is_first else (plane(), unreadable):
        assembly.add_part(PLANE, ONE, one)
    assembly.add_image(image(), 0.0, [PLANE])
    assert only(assembly).fault == "cannot be read"


def test_two_images_of_one_stamp_are_refused_a_plane_that_may_be_of_either() -> None:
    assembly = SliceAssembly()
    for number in (1, 2):
        assembly.add_image(image(ONE, number), 0.0, [PLANE])
    assembly.add_part(PLANE, ONE, plane())
    first = only(assembly)
    assert first.image.height == 1
    assert first.fault == "two images have the same stamp, expected one: nothing shows whose slice_pose this is"
    assert only(assembly, WAIT_S).image.height == 2


def test_neither_parts_nor_images_pile_up() -> None:
    assembly = SliceAssembly()
    for sec in range(100):
        assembly.add_part(PLANE, Time(sec=sec), plane(float(sec)))
        assembly.add_image(image(Time(sec=1000 + sec), sec), 0.0, [PLANE])
    assert [one.image.height for one in assembly.take(0.0)] == list(range(100 - CAPACITY))
    assert len(assembly) == CAPACITY
    for sec, is_kept in ((99 - CAPACITY, False), (100 - CAPACITY, True), (99, True)):
        assembly.add_image(image(Time(sec=sec)), 1.0, [PLANE])
        assert bool([one for one in assembly.take(1.0) if one.stamp.sec == sec]) is is_kept
