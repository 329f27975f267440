"""Image messages, as they come over the wire: CDR bytes."""

from __future__ import annotations

import functools
import random
import zlib
from typing import Final

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image

from fuzzing.kind import Kind
from fuzzing.mutation import mutate_bytes
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.nodes.common.conversions import MessageError, hu_from_image, image_from_hu
from stereoreg_ros.options import AUTO, RegistrationOptions
from stereoreg_ros.registration import prepare, register_frames
from stereoreg_ros.result import REASONS
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice

# One in this many is registered as well, which takes a hundred times as long.
_REGISTERED_ONCE_IN: Final = 200
_LARGEST_REGISTERED: Final = 96 * 96
# What the node's parameters may be; the message's stamp chooses, so that the message is all there is to an input.
_RESCALES: Final = ((1.0, 0.0), (1.0, -1024.0), (-1.0, 0.0), (1e6, 1e6), (1e-6, -1e6))
_OPTIONS: Final = (
    RegistrationOptions(threshold=2000.0, frame_tolerance_mm=0.0, scale_tolerance=0.0),
    RegistrationOptions(threshold=AUTO, max_rotation_deg=30.0),
    RegistrationOptions(threshold=-32768.0, max_spot_area_mm2=10000.0),
    RegistrationOptions(slice_thickness_mm=5.0),
)
_SCALE: Final = PixelScale(1.0, 1.0)
_SIZES: Final = (0, 1, 2, 3, 16, 17, 255, 8192, 8193, 65535, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
_ENCODINGS: Final = (
    "16SC1",
    "16UC1",
    "mono16",
    "32FC1",
    "mono8",
    "bgr8",
    "64FC1",
    "",
    "16SC1 ",
    "\x01\ufffd",
    "a" * 5000,
)
_VALUES: Final = (0.0, -0.0, 1e-45, 3000.0, -32768.0, 65535.0, 3.4e38, -3.4e38, np.inf, -np.inf, np.nan)


class _MalformedError(ValueError):
    """Bytes that the middleware does not hand over as a message."""


@functools.cache
def _frames() -> tuple[Frame, ...]:
    """Two frames, with their tables filled, as the node does before the first slice comes."""
    frames = (load_frame("cube6"), load_frame("cube5"))
    for frame in frames:
        prepare(frame, _SCALE)
    return frames


def _attempt(data: bytes) -> None:
    try:
        image = deserialize_message(data, Image)
    except rclpy_implementation.RMWError as error:
        raise _MalformedError(f"image: {error}") from None
    slope, intercept = _RESCALES[image.header.stamp.sec % len(_RESCALES)]
    hu = hu_from_image(image, slope, intercept)
    assert hu.shape == (image.height, image.width)
    assert hu.dtype == np.float32
    ct_slice = Slice(hu, _SCALE)
    if hu.size > _LARGEST_REGISTERED or zlib.crc32(data) % _REGISTERED_ONCE_IN:
        return
    options = _OPTIONS[image.header.stamp.nanosec % len(_OPTIONS)]
    for result in register_frames(ct_slice, _frames(), options, [Pose.identity(), None]):
        if result:
            assert np.isfinite(result.scanner_from_frame.rotation).all()
            assert np.isfinite(result.scanner_from_frame.translation).all()
            assert np.isfinite(result.covariance).all()
            assert len(result.matches) >= options.min_inliers
        else:
            assert result.reason in REASONS
            assert result.message


def _seeds() -> list[bytes]:
    rng = np.random.default_rng(0)
    pixels = rng.integers(-1000, 3000, (8, 12))
    images = [image_from_hu(pixels.astype(kind)) for kind in (np.int16, np.uint16, np.float32)]
    settings = ScannerSettings(false_spots=2, shape=(80, 80), scale=_SCALE)
    frame = _frames()[0]
    placed = PlacedFrame(frame, random_pose(rng, frame, settings))
    images.append(image_from_hu(render_slice([placed], settings, rng).hu.astype(np.int16)))
    return [serialize_message(image) for image in images]


def _mutate(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.15:
        return mutate_bytes(data, rng)
    try:
        image = deserialize_message(data, Image)
    except rclpy_implementation.RMWError:
        return mutate_bytes(data, rng)
    for _ in range(rng.randint(1, 3)):
        _change(image, rng)
    if rng.random() < 0.6:
        _make_fit(image, rng)
    return bytes(serialize_message(image))


def _change(image: Image, rng: random.Random) -> None:
    match rng.randrange(7):
        case 0:
            image.encoding = rng.choice(_ENCODINGS)
        case 1:
            image.width = rng.choice((*_SIZES, rng.randint(1, 64)))
        case 2:
            image.height = rng.choice((*_SIZES, rng.randint(1, 64)))
        case 3:
            image.step = rng.choice((*_SIZES, (image.step + rng.randint(-3, 3)) % 2**32))
        case 4:
            image.is_bigendian = rng.choice((0, 1, 2, 255))
        case 5:
            image.header.stamp.sec = rng.randrange(-(2**31), 2**31)
            image.header.stamp.nanosec = rng.randrange(2**32)
            image.header.frame_id = rng.choice(("", "scanner", "../x", "a" * 3000))
        case 6:
            image.data = _pixels(bytes(image.data), rng)


def _make_fit(image: Image, rng: random.Random) -> None:
    """Step and data as width, height and encoding want them, so that what comes after is reached."""
    pixel = 4 if image.encoding == "32FC1" else 2
    image.height, image.width = min(image.height, 96), min(image.width, 96)
    image.step = image.width * pixel + rng.choice((0, 0, 0, 1, 7))
    data = bytes(image.data) or b"\0"
    size = image.step * image.height
    image.data = (data * (size // len(data) + 1))[:size]


def _pixels(data: bytes, rng: random.Random) -> bytes:
    pixels = np.frombuffer(data[: len(data) // 4 * 4], "<f4" if rng.random() < 0.5 else "<i2").copy()
    if not len(pixels):
        return rng.randbytes(rng.randint(0, 64))
    for _ in range(1 << rng.randrange(8)):
        value = rng.choice(_VALUES)
        if pixels.dtype.kind == "i":
            value = min(max(np.nan_to_num(value), -32768), 32767)
        pixels[rng.randrange(len(pixels))] = value
    return pixels.tobytes() if rng.random() < 0.9 else mutate_bytes(pixels.tobytes(), rng)


IMAGE = Kind(
    name="image",
    ending=".cdr",
    attempt=_attempt,
    # Of a slice whose pixels are not finite: a ValueError, as that is the core, which knows of no messages.
    refusals=(MessageError, _MalformedError, ValueError),
    names=lambda text: text.startswith("image"),
    seeds=_seeds,
    mutate=_mutate,
    # The matcher keeps up to 64 tables, of some 25 MB, filled when the first slice needs them.
    memory_bytes=2**31,
)
