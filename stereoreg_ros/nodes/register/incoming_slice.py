"""A slice as it came: the image and what belongs to it, from here on one object."""

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
    """An image with its pixel spacing and its plane, None where nobody tells any.

    received_s: when the image came, seconds of the steady clock; what belongs to it may have come later. fault: why it
    cannot be registered, a sentence; empty where nothing speaks against it so far.
    """

    image: Image
    received_s: float
    spacing: PixelScale | None = None
    plane: SlicePlane | None = None
    fault: str = ""

    @property
    def stamp(self) -> Time:
        """The image's, which all that is said of the slice bears."""
        return self.image.header.stamp
