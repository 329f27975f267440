"""Plays a DICOM file or folder as CT slices on topics, in table order."""

from __future__ import annotations

import time
from typing import Any, Final

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.dicom import DicomError, DicomSlice, read_series, read_slice
from stereoreg_ros.nodes.conversions import image_from_hu, pose_to_message
from stereoreg_ros.nodes.parameters import Entry, ParameterError, declare
from stereoreg_ros.nodes.spinning import run
from stereoreg_ros.nodes.tell_spacing import SpacingTeller

POSE_GRACE_S: Final = 5.0
FLUSH_S: Final = 10.0
_POLL_S: Final = 0.02
_QOS: Final = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
_INT16: Final = np.iinfo(np.int16)

ENTRIES: Final = (
    Entry("path", "", "DICOM file, or folder with the slices of one series"),
    Entry("rate", 1.0, "slices per second", 0.01, 100.0),
    Entry("loop", False, "start again after the last slice, for ever"),
    Entry("frame_id", "scanner", "frame_id of the images and slice poses: the patient axes of the DICOM files"),
    Entry(
        "register_node",
        "register_node",
        "node that is told the pixel spacing, and without whose consent nothing is played; empty: nobody",
    ),
    Entry("wait_for_subscriber", True, "play nothing before somebody subscribes to image"),
)


class PlayDicomNode(Node):
    """Publishes each slice as `slice_pose` (scanner_from_slice) and then `image` (in HU), with the same stamp.

    Images are 16SC1 where all HU are whole numbers, else 32FC1. A slice that cannot be read is reported and left out.
    finished: the last slice has reached all subscribers; faults: number of slices left out.
    """

    def __init__(self) -> None:
        super().__init__("play_dicom_node")
        values = declare(self, ENTRIES)
        self.finished = False
        self.faults = 0
        self._loop: bool = values["loop"]
        self._frame_id: str = values["frame_id"]
        self._period_s = 1.0 / values["rate"]
        self._wait_for_subscriber: bool = values["wait_for_subscriber"]
        if not values["path"]:
            raise ParameterError("parameter path is empty, expected a DICOM file or folder")
        try:
            self._series = read_series(values["path"])
        except DicomError as error:
            raise ParameterError(str(error)) from None
        for skipped in self._series.skipped:
            self.get_logger().info(f"skipped {skipped.path}: {skipped.what}")
        if not self._series.headers[0].has_plane:
            self.get_logger().warning(f"{values['path']} has no position and no orientation: no slice_pose")
        target: str = values["register_node"]
        self._teller = SpacingTeller(self, target) if target else None
        self._image_publisher = self.create_publisher(Image, "image", _QOS)
        self._pose_publisher = self.create_publisher(PoseStamped, "slice_pose", _QOS)
        self._next = 0
        self._due_s = 0.0
        self._image_subscribed_s: float | None = None
        self._flush_by_s: float | None = None
        self._started = False
        self.create_timer(min(_POLL_S, self._period_s), self._step)
        self.get_logger().info(f"{len(self._series)} slices from {values['path']}, {values['rate']:g} per second")

    def _step(self) -> None:
        if self._flush_by_s is not None:
            self._flush(self._flush_by_s)
            return
        # The receiver is asked every time: one that was started anew has to be told anew.
        told = self._teller is None or self._teller.tell(self._series.headers[0].scale)
        now_s = time.monotonic()
        if not told or now_s < self._due_s or not (self._started or self._listened_to(now_s)):
            return
        self._started = True
        # On time, the pace is kept; after a pause it starts afresh instead of catching up.
        on_time = now_s < self._due_s + self._period_s
        self._due_s = (self._due_s if on_time else now_s) + self._period_s
        self._play_next()

    def _listened_to(self, now_s: float) -> bool:
        """Whether playing may start: somebody takes the images, and the poses too if a receiver was named."""
        if not self._wait_for_subscriber:
            return True
        if self._image_publisher.get_subscription_count() == 0:
            self._image_subscribed_s = None
            return False
        if self._image_subscribed_s is None:
            self._image_subscribed_s = now_s
        # Of one subscriber's two subscriptions the second may be discovered later, and the first pose be lost.
        waited_s = now_s - self._image_subscribed_s
        return self._pose_publisher.get_subscription_count() > 0 or waited_s >= POSE_GRACE_S

    def _play_next(self) -> None:
        path = self._series.headers[self._next].path
        try:
            self._publish(read_slice(path))
        except DicomError as error:
            self.faults += 1
            self.get_logger().error(f"left out: {error}")
        self._next += 1
        if self._next == len(self._series):
            self._next = 0
            if not self._loop:
                self._flush_by_s = time.monotonic() + FLUSH_S

    def _publish(self, dicom_slice: DicomSlice) -> None:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._frame_id)
        if dicom_slice.header.has_plane:
            pose = pose_to_message(dicom_slice.ct_slice.scanner_from_slice)
            self._pose_publisher.publish(PoseStamped(header=header, pose=pose))
        image = image_from_hu(_smallest_exact(dicom_slice.ct_slice.hu))
        image.header = header
        self._image_publisher.publish(image)

    def _flush(self, deadline_s: float) -> None:
        """Finish when every subscriber has everything, or at the deadline."""
        now = Duration(seconds=0)
        if self._pose_publisher.wait_for_all_acked(now) and self._image_publisher.wait_for_all_acked(now):
            self.finished = True
            self.get_logger().info(f"played {len(self._series) - self.faults} of {len(self._series)} slices")
        elif time.monotonic() > deadline_s:
            self.finished = True
            self.get_logger().warning(f"a subscriber did not take the last slices within {FLUSH_S:g} s")


def _smallest_exact(hu: NDArray[np.float32]) -> NDArray[Any]:
    """HU as int16 where that loses nothing, else as they are."""
    if hu.min() < _INT16.min or hu.max() > _INT16.max:
        return hu
    whole = hu.astype(np.int16)
    return whole if np.array_equal(whole, hu) else hu


def main() -> int:
    """Entry point of the executable; the exit code is 1 where slices were left out."""
    played: list[PlayDicomNode] = []

    def create() -> PlayDicomNode:
        played.append(PlayDicomNode())
        return played[0]

    code = run(create)
    return 1 if played and played[0].faults else code


if __name__ == "__main__":
    raise SystemExit(main())
