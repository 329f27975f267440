"""Plays a DICOM file or folder as CT slices on topics, in table order."""

from __future__ import annotations

import time
from typing import Final

from rclpy.node import Node

from stereoreg_ros.dicom import DicomError, read_series, read_slice
from stereoreg_ros.nodes.common.parameters import Entry, ParameterError, declare
from stereoreg_ros.nodes.common.process import run
from stereoreg_ros.nodes.common.slice_publisher import UNUSED_REGISTER_NODE, SlicePublisher

FLUSH_S: Final = 10.0
_POLL_S: Final = 0.02
_SCANNER: Final = "scanner"
# What the images' frame_id is in place of that: nobody must take the axes of one slice for the scanner's.
_SLICE: Final = "ct_slice"

ENTRIES: Final = (
    Entry("path", "", "DICOM file, or folder with the slices of one series"),
    Entry("rate", 1.0, "slices per second", 0.01, 100.0),
    Entry("loop", False, "start again after the last slice, for ever"),
    Entry("frame_id", _SCANNER, "frame_id of the images and slice poses: the patient axes of the DICOM files"),
    Entry(
        "slice_axes",
        False,
        "take every image for a slice in its own axes, also one without a plane: no slice_pose, "
        f"and '{_SLICE}' as frame_id where it is left at '{_SCANNER}'",
    ),
    UNUSED_REGISTER_NODE,
    Entry("wait_for_subscriber", True, "play nothing before somebody subscribes to image"),
)


class PlayDicomNode(Node):
    """Publishes each slice as `image` (in HU) and what belongs to it, with one stamp; see `SlicePublisher`.

    A slice that cannot be read is reported and left out.
    finished: the last slice has reached all subscribers; faults: number of slices left out.
    """

    def __init__(self) -> None:
        super().__init__("play_dicom_node")
        values = declare(self, ENTRIES)
        self.finished = False
        self.faults = 0
        self._loop: bool = values["loop"]
        self._period_s = 1.0 / values["rate"]
        self._wait_for_subscriber: bool = values["wait_for_subscriber"]
        if not values["path"]:
            raise ParameterError("parameter path is empty, expected a DICOM file or folder")
        try:
            self._series = read_series(values["path"], slice_axes=values["slice_axes"])
        except DicomError as error:
            raise ParameterError(str(error)) from None
        for skipped in self._series.skipped:
            self.get_logger().info(f"skipped {skipped.path}: {skipped.what}")
        frame_id: str = values["frame_id"]
        if self._series.slice_axes:
            frame_id = _SLICE if frame_id == _SCANNER else frame_id
            self.get_logger().warning(f"each slice is in its own axes, '{frame_id}': no slice_pose")
        self._publisher = SlicePublisher(self, frame_id)
        self._next = 0
        self._due_s = 0.0
        self._flush_by_s: float | None = None
        self._started = False
        self.create_timer(min(_POLL_S, self._period_s), self._step)
        self.get_logger().info(f"{len(self._series)} slices from {values['path']}, {values['rate']:g} per second")

    def _step(self) -> None:
        if self._flush_by_s is not None:
            self._flush(self._flush_by_s)
            return
        now_s = time.monotonic()
        listened_to = not self._wait_for_subscriber or self._started or self._publisher.listened_to()
        if now_s < self._due_s or not listened_to:
            return
        self._started = True
        # On time, the pace is kept; after a pause it starts afresh instead of catching up.
        on_time = now_s < self._due_s + self._period_s
        self._due_s = (self._due_s if on_time else now_s) + self._period_s
        self._play_next()

    def _play_next(self) -> None:
        path = self._series.headers[self._next].path
        try:
            stamp = self._publisher.unique_stamp(self.get_clock().now().nanoseconds)
            self._publisher.publish(read_slice(path, slice_axes=self._series.slice_axes), stamp)
        except DicomError as error:
            self.faults += 1
            self.get_logger().error(f"left out: {error}")
        self._next += 1
        if self._next == len(self._series):
            self._next = 0
            if not self._loop:
                self._flush_by_s = time.monotonic() + FLUSH_S

    def _flush(self, deadline_s: float) -> None:
        """Finish when every subscriber has everything, or at the deadline."""
        if self._publisher.delivered():
            self.finished = True
            self.get_logger().info(f"played {len(self._series) - self.faults} of {len(self._series)} slices")
        elif time.monotonic() > deadline_s:
            self.finished = True
            self.get_logger().warning(f"a subscriber did not take the last slices within {FLUSH_S:g} s")


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
