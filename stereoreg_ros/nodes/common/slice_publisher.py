"""Publishes CT slices: `image` (in HU), and before it, with the same stamp, what belongs to it.

`slice_spacing`, `slice_pose` (scanner_from_slice) and `slice_frame_of_reference`.
"""

from __future__ import annotations

import time
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.dicom import DicomSlice
from stereoreg_ros.nodes.common.conversions import image_from_hu, pose_to_message, scale_to_message
from stereoreg_ros.nodes.common.parameters import Entry

POSE_GRACE_S: Final = 5.0
# Acknowledgements may come as late as the heartbeat of three seconds, until when nothing may be overwritten.
_QOS: Final = QoSProfile(depth=200, reliability=QoSReliabilityPolicy.RELIABLE)
# What players had to set before slices brought their own pixel spacing.
UNUSED_REGISTER_NODE: Final = Entry(
    "register_node", "", "not used any more, as slices bring their own pixel spacing; kept for launch files that set it"
)
_INT16: Final = np.iinfo(np.int16)
# Stamps may run ahead of a coarse clock; by more, the clock was set back.
_SET_BACK_NS: Final = 10**9


class SlicePublisher:
    """The publishers of a node's slices. Images are 16SC1 where all HU are whole numbers, else 32FC1.

    frame_id: of the images and slice poses, the patient axes of the DICOM files.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        self._frame_id = frame_id
        # The image's publisher last: DDS announces them in order, and who gets an image so knows what comes with it.
        self._spacing_publisher = node.create_publisher(Vector3Stamped, "slice_spacing", _QOS)
        self._pose_publisher = node.create_publisher(PoseStamped, "slice_pose", _QOS)
        self._reference_publisher = node.create_publisher(Header, "slice_frame_of_reference", _QOS)
        self._image_publisher = node.create_publisher(Image, "image", _QOS)
        self._last_stamp_ns = 0
        self._image_subscribed_s: float | None = None

    def listened_to(self) -> bool:
        """Whether somebody takes the images, and the poses too or has had time to say so."""
        if self._image_publisher.get_subscription_count() == 0:
            self._image_subscribed_s = None
            return False
        now_s = time.monotonic()
        if self._image_subscribed_s is None:
            self._image_subscribed_s = now_s
        # Of one subscriber's two subscriptions the second may be discovered later, and the first pose be lost.
        waited_s = now_s - self._image_subscribed_s
        return self._pose_publisher.get_subscription_count() > 0 or waited_s >= POSE_GRACE_S

    def unique_stamp(self, time_ns: int) -> TimeMessage:
        """The stamp of a slice of this time: a nanosecond later where that would not be after the stamp before.

        A clock that was set back is followed: a stamp from what is the future now would make a pose look new for long.
        """
        if self._last_stamp_ns - _SET_BACK_NS < time_ns <= self._last_stamp_ns:
            time_ns = self._last_stamp_ns + 1
        # Nor is it 0, which stands for no stamp: simulated time begins there.
        self._last_stamp_ns = max(time_ns, 1)
        return Time(nanoseconds=self._last_stamp_ns).to_msg()

    def publish(self, dicom_slice: DicomSlice, stamp: TimeMessage) -> None:
        """Publish one slice; without a plane it has no slice_pose."""
        header = Header(stamp=stamp, frame_id=self._frame_id)
        spacing = scale_to_message(dicom_slice.ct_slice.scale)
        self._spacing_publisher.publish(Vector3Stamped(header=header, vector=spacing))
        if dicom_slice.header.has_plane:
            pose = pose_to_message(dicom_slice.ct_slice.scanner_from_slice)
            self._pose_publisher.publish(PoseStamped(header=header, pose=pose))
        reference = dicom_slice.header.frame_of_reference_uid
        self._reference_publisher.publish(Header(stamp=stamp, frame_id=reference))
        image = image_from_hu(_smallest_exact(dicom_slice.ct_slice.hu))
        image.header = header
        self._image_publisher.publish(image)

    def delivered(self) -> bool:
        """Whether every subscriber has everything."""
        now = Duration(seconds=0)
        publishers = (
            self._spacing_publisher,
            self._pose_publisher,
            self._reference_publisher,
            self._image_publisher,
        )
        return all(publisher.wait_for_all_acked(now) for publisher in publishers)


def _smallest_exact(hu: NDArray[np.float32]) -> NDArray[Any]:
    """HU as int16 where that loses nothing, else as they are."""
    if hu.min() < _INT16.min or hu.max() > _INT16.max:
        return hu
    whole = hu.astype(np.int16)
    return whole if np.array_equal(whole, hu) else hu
