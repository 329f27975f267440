"""A slice as it came in: the image and what belongs to it, from here on one object."""

from __future__ import annotations

from dataclasses import dataclass

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale


@dataclass(frozen=True, eq=False)
class SlicePlane:
    """Where a slice lies: scanner_from_slice, in the axes that frame_id names; empty where the message named none."""

    scanner_from_slice: Pose
    frame_id: str


@dataclass(frozen=True, eq=False)
class IncomingSlice:
    """An image with its pixel spacing, its plane and its frame of reference; None for each that does not come with it.

    received_s: when the image came, seconds of the steady clock; what belongs to it may have come later.
    frame_of_reference: the UID of DICOM (0020,0052), empty where the file has none. fault: why the slice cannot be
    registered, a sentence; empty where it can, as far as is known by then.
    """

    image: Image
    received_s: float
    spacing: PixelScale | None = None
    plane: SlicePlane | None = None
    frame_of_reference: str | None = None
    fault: str = ""

    @property
    def stamp(self) -> Time:
        """The image's, which everything that is published of the slice has."""
        return self.image.header.stamp

    @property
    def axes(self) -> str:
        """The frame_id of the axes in which the slice's plane is given: the plane's own name, or else the image's."""
        return (self.plane.frame_id if self.plane is not None else "") or str(self.image.header.frame_id)
