"""Messages to core types and back: every encoding, step and byte order; every fault named."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import Point, PointStamped, PoseStamped, Quaternion, Vector3, Vector3Stamped
from geometry_msgs.msg import Pose as PoseMessage
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image

from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.common.conversions import MAX_SIDE_PX, MessageError
from stereoreg_ros.nodes.common.transforms import transform_of

PIXEL_TYPES = {"16SC1": "i2", "16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def image_of(pixels: np.ndarray, encoding: str, big: bool = False, padding: int = 0) -> Image:
    """An image message with `padding` bytes of rubbish after every row."""
    stored = pixels.astype(np.dtype(PIXEL_TYPES[encoding]).newbyteorder(">" if big else "<"))
    rows, columns = stored.shape
    row_bytes = columns * stored.itemsize
    padded = np.full((rows, row_bytes + padding), 0xA5, np.uint8)
    padded[:, :row_bytes] = stored.view(np.uint8).reshape(rows, row_bytes)
    return Image(
        height=rows,
        width=columns,
        encoding=encoding,
        is_bigendian=int(big),
        step=row_bytes + padding,
        data=padded.tobytes(),
    )


@given(
    encoding=st.sampled_from(sorted(PIXEL_TYPES)),
    big=st.booleans(),
    padding=st.integers(0, 9),
    rows=st.integers(1, 7),
    columns=st.integers(1, 7),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_layout_gives_the_pixels(encoding, big, padding, rows, columns, seed):
    low, high = (0, 65536) if PIXEL_TYPES[encoding] == "u2" else (-32768, 32768)
    pixels = np.random.default_rng(seed).integers(low, high, (rows, columns))
    hu = conversions.hu_from_image(image_of(pixels, encoding, big, padding))
    assert hu.dtype == np.float32
    assert np.array_equal(hu, pixels)


def test_rescale():
    hu = conversions.hu_from_image(image_of(np.array([[0, 1024, 4095]]), "16UC1"), 2.0, -1024.0)
    assert np.array_equal(hu, [[-1024, 1024, 7166]])


def test_an_intercept_alone_is_added_and_a_slope_alone_multiplied():
    """Most scanners write a slope of 1."""
    image = image_of(np.array([[0, 1024, 4095]]), "16UC1")
    assert np.array_equal(conversions.hu_from_image(image, 1.0, -1024.0), [[-1024, 0, 3071]])
    assert np.array_equal(conversions.hu_from_image(image, 2.0), [[0, 2048, 8190]])


def test_float_pixels_are_not_copied():
    image = image_of(np.arange(12.0).reshape(3, 4), "32FC1", padding=8)
    assert np.shares_memory(conversions.hu_from_image(image), np.frombuffer(image.data, np.uint8))


def test_pixels_too_large_after_the_rescale_become_infinite_quietly():
    hu = conversions.hu_from_image(image_of(np.array([[3e38]]), "32FC1"), 1e6)
    assert np.isinf(hu).all()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"encoding": "rgb8"}, "image encoding is 'rgb8', expected one of 16SC1, 16UC1, mono16, 32FC1"),
        ({"encoding": ""}, "image encoding is '', expected"),
        ({"width": 0}, "image width is 0, expected 1 to"),
        ({"height": 0}, "image height is 0, expected 1 to"),
        ({"width": MAX_SIDE_PX + 1}, "image width is 8193, expected 1 to 8192"),
        ({"height": 2**32 - 1, "step": 2**32 - 1}, "image height is 4294967295, expected"),
        ({"step": 7}, "image step is 7, expected at least 8 bytes for 4 pixels 16SC1"),
        ({"step": 0}, "image step is 0, expected at least 8"),
        ({"step": 9}, r"image data has 24 bytes, expected step \* height = 9 \* 3 = 27"),
        ({"data": b""}, "image data has 0 bytes, expected"),
        ({"data": bytes(25)}, "image data has 25 bytes, expected"),
        ({"data": bytes(23)}, "image data has 23 bytes, expected"),
        ({"encoding": "32FC1"}, "image step is 8, expected at least 16 bytes"),
    ],
)
def test_faulty_image_is_named(changes, sentence):
    image = image_of(np.zeros((3, 4)), "16SC1")
    for name, value in changes.items():
        setattr(image, name, value)
    with pytest.raises(MessageError, match=sentence):
        conversions.hu_from_image(image)


@pytest.mark.parametrize(("dtype", "encoding"), [("i2", "16SC1"), (">i2", "16SC1"), ("u2", "16UC1"), ("f8", "32FC1")])
def test_image_there_and_back(dtype, encoding):
    pixels = np.arange(12).reshape(3, 4).astype(dtype)[:, ::2]
    image = conversions.image_from_hu(pixels)
    assert image.encoding == encoding
    assert np.array_equal(conversions.hu_from_image(image), pixels)


def test_picture():
    bgr = np.arange(3 * 5 * 3, dtype=np.uint8).reshape(3, 5, 3)
    image = conversions.image_from_bgr(bgr[:, ::-1])
    assert (image.height, image.width, image.step, image.encoding) == (3, 5, 15, "bgr8")
    assert bytes(image.data) == bgr[:, ::-1].tobytes()


def stamped(position: tuple[float, ...], quaternion: tuple[float, ...]) -> PoseStamped:
    x, y, z, w = quaternion
    px, py, pz = position
    return PoseStamped(pose=PoseMessage(position=Point(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w)))


def test_pose_there_and_back():
    pose = Pose(rotation_exp(np.array([0.4, -2.0, 1.1])), np.array([12.5, -700.0, 3.25]))
    message = conversions.pose_to_message(pose)
    assert message.position.y == pytest.approx(-0.7)
    back = conversions.pose_from_message(PoseStamped(pose=message))
    assert np.allclose(back.rotation, pose.rotation, atol=1e-12)
    assert np.allclose(back.translation, pose.translation, atol=1e-9)


def test_quaternion_of_almost_unit_length_is_taken():
    pose = conversions.pose_from_message(stamped((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0009)))
    assert np.allclose(pose.rotation, np.eye(3))
    assert np.allclose(pose.translation, [1000, 2000, 3000])


@pytest.mark.parametrize(
    ("position", "quaternion", "sentence"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), "pose.orientation is .* of length 0, expected a unit quaternion"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.002), "of length 1.002, expected a unit quaternion"),
        ((0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), "of length nan, expected a unit quaternion"),
        ((0.0, np.inf, 0.0), (0.0, 0.0, 0.0, 1.0), "pose.position is .*inf.*, expected finite numbers"),
        ((0.0, 1e308, 0.0), (0.0, 0.0, 0.0, 1.0), "pose.position is .*, expected finite numbers"),
    ],
)
def test_faulty_pose_is_named(position, quaternion, sentence):
    with pytest.raises(MessageError, match=sentence):
        conversions.pose_from_message(stamped(position, quaternion))


def test_covariance_in_metres_and_radians():
    deviations = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    ros = np.reshape(conversions.covariance_to_message(np.outer(deviations, deviations)), (6, 6))
    assert ros[0, 0] == pytest.approx(1e-6)
    assert ros[1, 2] == pytest.approx(6e-6)
    assert ros[2, 5] == pytest.approx(9e-4)
    assert ros[5, 2] == pytest.approx(9e-4)
    assert ros[3, 4] == pytest.approx(0.02)


def test_covariance_is_that_of_the_axes_and_the_order_of_ros():
    """A pose perturbed in each of the six ways, as a receiver computes it from the message's own numbers.

    REP 103 and PoseWithCovariance: x, y, z, then rotations about the fixed axes x, y, z, of the same header's frame.
    """
    pose = Pose(rotation_exp(np.array([0.4, -2.0, 1.1])), np.array([12.5, -700.0, 3.25]))
    axes = np.eye(6)
    for which in range(6):
        deviation = np.array([0.3, 0.5, 0.7, 0.002, 0.003, 0.005])[which]
        ros = np.reshape(conversions.covariance_to_message(deviation**2 * np.outer(axes[which], axes[which])), (6, 6))
        (told,) = (int(row) for row in np.flatnonzero(np.diag(ros)))
        size = np.sqrt(ros[told, told])
        moved = pose.perturbed(deviation * axes[which, :3], deviation * axes[which, 3:])
        rest, message = conversions.pose_to_message(pose), conversions.pose_to_message(moved)
        # Where a point of the body, metres, goes by the message's own numbers: turned about its place, then shifted.
        body = np.array([0.05, -0.02, 0.11])
        turn = {3: "x", 4: "y", 5: "z"}
        by_hand = Rotation.from_quat(xyzw(rest)).apply(body)
        if told in turn:
            by_hand = Rotation.from_euler(turn[told], size).apply(by_hand)
        by_hand += xyz(rest)
        if told not in turn:
            by_hand[told] += size
        arrived = Rotation.from_quat(xyzw(message)).apply(body)
        arrived += xyz(message)
        np.testing.assert_allclose(by_hand, arrived, atol=1e-12)


def xyz(message: PoseMessage) -> np.ndarray:
    return np.array([message.position.x, message.position.y, message.position.z])


def xyzw(message: PoseMessage) -> list[float]:
    q = message.orientation
    return [q.x, q.y, q.z, q.w]


def test_point_there_and_back():
    message = PointStamped(point=conversions.point_to_message(np.array([1.0, -20.0, 300.0])))
    assert (message.point.x, message.point.y, message.point.z) == pytest.approx((1e-3, -0.02, 0.3))
    assert np.allclose(conversions.point_from_message(message), [1.0, -20.0, 300.0])


def test_faulty_point_is_named():
    with pytest.raises(MessageError, match=r"point is .*nan.*, expected finite numbers of metres"):
        conversions.point_from_message(PointStamped(point=Point(x=float("nan"))))


def test_pixel_scale_in_metres_there_and_back():
    message = conversions.scale_to_message(PixelScale(0.4, 0.7, -0.02))
    assert (message.x, message.y, message.z) == pytest.approx((4e-4, 7e-4, -2e-5))
    back = conversions.scale_from_message(Vector3Stamped(vector=message))
    assert (back.sx, back.sy, back.shear) == pytest.approx((0.4, 0.7, -0.02))
    with pytest.raises(MessageError, match="pixel spacing sy is -700"):
        conversions.scale_from_message(Vector3Stamped(vector=Vector3(x=0.4, y=-0.7, z=0.0)))


def test_transform_is_the_pose_from_its_axes_to_the_frames():
    pose = Pose(rotation_exp(np.array([0.4, -2.0, 1.1])), np.array([12.5, -700.0, 3.25]))
    stamped_pose = PoseStamped(pose=conversions.pose_to_message(pose))
    stamped_pose.header.frame_id = "scanner"
    stamped_pose.header.stamp.sec = 7
    transform = transform_of(stamped_pose, "stereotactic_frame")
    assert (transform.header, transform.child_frame_id) == (stamped_pose.header, "stereotactic_frame")
    moved = transform.transform.translation
    assert (moved.x, moved.y, moved.z) == pytest.approx((0.0125, -0.7, 0.00325))
    assert transform.transform.rotation == stamped_pose.pose.orientation
