"""ROS messages to core types and back: metres meet millimetres here and nowhere else."""

from __future__ import annotations

import math
import sys
from typing import Final

import numpy as np
from geometry_msgs.msg import Point, PointStamped, PoseStamped, Quaternion, Vector3, Vector3Stamped
from geometry_msgs.msg import Pose as PoseMessage
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale

MM_PER_M: Final = 1000.0
MAX_SIDE_PX: Final = 8192
_PIXEL_TYPES: Final = {"16SC1": "i2", "16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_QUATERNION_TOLERANCE: Final = 1e-3


class MessageError(ValueError):
    """A message that cannot be used; the text names the field, what was found and what was expected."""


def hu_from_image(image: Image, rescale_slope: float = 1.0, rescale_intercept: float = 0.0) -> NDArray[np.float32]:
    """Pixels (height, width) of a slice in HU: value * rescale_slope + rescale_intercept.

    Shares the message's memory where nothing has to change. Raises MessageError.
    """
    pixel_type = _PIXEL_TYPES.get(image.encoding)
    if pixel_type is None:
        # It may be of any length.
        raise MessageError(f"image encoding is '{image.encoding:.40}', expected one of {', '.join(_PIXEL_TYPES)}")
    for name, side in (("width", image.width), ("height", image.height)):
        if not 0 < side <= MAX_SIDE_PX:
            raise MessageError(f"image {name} is {side}, expected 1 to {MAX_SIDE_PX} pixels")
    dtype = np.dtype(pixel_type).newbyteorder(">" if image.is_bigendian else "<")
    row_bytes = image.width * dtype.itemsize
    if image.step < row_bytes:
        raise MessageError(
            f"image step is {image.step}, expected at least {row_bytes} bytes for {image.width} pixels {image.encoding}"
        )
    if len(image.data) != image.step * image.height:
        raise MessageError(
            f"image data has {len(image.data)} bytes, "
            f"expected step * height = {image.step} * {image.height} = {image.step * image.height}"
        )
    stored: NDArray[np.generic] = np.ndarray(
        (image.height, image.width), dtype, buffer=image.data, strides=(image.step, dtype.itemsize)
    )
    hu = stored.astype(np.float32, copy=False)
    if (rescale_slope, rescale_intercept) != (1.0, 0.0):
        # A product too large for float32 becomes infinite, and an infinite pixel is refused with the image.
        with np.errstate(over="ignore", invalid="ignore"):
            hu = hu * np.float32(rescale_slope) + np.float32(rescale_intercept)
    return hu


def image_from_bgr(bgr: NDArray[np.uint8]) -> Image:
    """A bgr8 image message of a picture (rows, columns, 3)."""
    rows, columns, _ = bgr.shape
    return Image(
        height=rows,
        width=columns,
        encoding="bgr8",
        is_bigendian=0,
        step=3 * columns,
        data=np.ascontiguousarray(bgr).tobytes(),
    )


def image_from_hu(hu: NDArray[np.generic]) -> Image:
    """An image message of pixels (rows, columns): int16 as 16SC1, uint16 as 16UC1, anything else as 32FC1."""
    encoding = {"i2": "16SC1", "u2": "16UC1"}.get(hu.dtype.str[1:], "32FC1")
    pixels = np.ascontiguousarray(hu, dtype=np.dtype(_PIXEL_TYPES[encoding]))
    rows, columns = pixels.shape
    return Image(
        height=rows,
        width=columns,
        encoding=encoding,
        is_bigendian=int(sys.byteorder == "big"),
        step=columns * pixels.itemsize,
        data=pixels.tobytes(),
    )


def pose_to_message(pose: Pose) -> PoseMessage:
    """A pose in metres and x, y, z, w."""
    x, y, z, w = (float(value) for value in pose.quaternion_xyzw)
    return PoseMessage(position=point_to_message(pose.translation), orientation=Quaternion(x=x, y=y, z=z, w=w))


def pose_from_message(message: PoseStamped) -> Pose:
    """The pose of a PoseStamped, mm; MessageError where it is not finite or its quaternion is not a unit one."""
    position = _point_mm("pose.position", message.pose.position)
    orientation = message.pose.orientation
    quaternion = (orientation.x, orientation.y, orientation.z, orientation.w)
    length = math.hypot(*quaternion)
    # Written so that NaN is refused as well.
    if not abs(length - 1) <= _QUATERNION_TOLERANCE:
        raise MessageError(
            f"pose.orientation is {list(quaternion)} of length {length:g}, expected a unit quaternion x, y, z, w"
        )
    return Pose.from_quaternion(quaternion, position)


def covariance_to_message(covariance: Array) -> list[float]:
    """Covariance (6, 6), position (mm) then rotation (rad), as the 36 numbers of ROS in m and rad, row by row."""
    to_ros = np.array([1 / MM_PER_M] * 3 + [1.0] * 3)
    numbers: list[float] = (covariance * np.outer(to_ros, to_ros)).ravel().tolist()
    return numbers


def scale_to_message(scale: PixelScale) -> Vector3:
    """A pixel scale as x = sx, y = sy, z = shear in metres per pixel."""
    x, y, z = (float(value) / MM_PER_M for value in (scale.sx, scale.sy, scale.shear))
    return Vector3(x=x, y=y, z=z)


def scale_from_message(message: Vector3Stamped) -> PixelScale:
    """The pixel scale of a Vector3Stamped; MessageError where it is invalid."""
    vector = message.vector
    try:
        return PixelScale(vector.x * MM_PER_M, vector.y * MM_PER_M, vector.z * MM_PER_M)
    except ValueError as error:
        raise MessageError(str(error)) from None


def point_to_message(point_mm: Array) -> Point:
    """A point (3,) mm in metres."""
    x, y, z = (float(value) / MM_PER_M for value in point_mm)
    return Point(x=x, y=y, z=z)


def point_from_message(message: PointStamped) -> Array:
    """The point (3,) of a PointStamped, mm; MessageError where it is not finite."""
    return _point_mm("point", message.point)


def _point_mm(name: str, point: Point) -> Array:
    point_mm: Array = np.array([point.x * MM_PER_M, point.y * MM_PER_M, point.z * MM_PER_M])
    if not np.isfinite(point_mm).all():
        raise MessageError(f"{name} is {[point.x, point.y, point.z]}, expected finite numbers of metres")
    return point_mm
