"""A client beside a running register_node, and the slices that it sends."""

from __future__ import annotations

import math
import time
from itertools import count
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, Vector3Stamped
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from stereoreg_ros import PixelScale, Pose, load_frame
from stereoreg_ros.geometry.pose import rotation_angle
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.register.parameters import ENTRIES
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from support.contract import DIAGNOSTIC_KEYS
from support.ros_process import DEADLINE_S, RosClient

NODE = "/register_node"
SCALE = PixelScale(0.5, 0.6)
# A percent off: a slice would be accepted with it, and be off.
OTHER = PixelScale(1.01 * SCALE.sx, 1.01 * SCALE.sy)
SCANNER = ScannerSettings(shape=(256, 256), scale=SCALE)
CUBE = load_frame("cube6")
NUMBERS = set(DIAGNOSTIC_KEYS) - {"outcome", "reason", "frame", "calibration"}
START = {entry.name: entry.value for entry in ENTRIES} | {"pixel_spacing": [SCALE.sx, SCALE.sy]}


def rendered(seed: int, hidden: tuple[str, ...] = (), **settings: Any) -> tuple[np.ndarray, Pose]:
    """A slice of cube6 (rows, columns) in HU, and its slice_from_frame."""
    rng = np.random.default_rng(seed)
    pose = random_pose(rng, CUBE, SCANNER, max_offset_mm=15.0)
    scanner = ScannerSettings(shape=SCANNER.shape, scale=SCALE, **settings)
    return render_slice([PlacedFrame(CUBE, pose, hidden)], scanner, rng).hu, pose


def image_of(hu: np.ndarray, dtype: str = "<i2", encoding: str = "16SC1", padding: int = 0) -> Image:
    """An image message in any layout."""
    stored = hu.astype(dtype)
    rows, columns = stored.shape
    row_bytes = columns * stored.itemsize
    padded = np.full((rows, row_bytes + padding), 0x5A, np.uint8)
    padded[:, :row_bytes] = np.ascontiguousarray(stored).view(np.uint8)
    image = Image(height=rows, width=columns, encoding=encoding, step=row_bytes + padding, data=padded.tobytes())
    image.is_bigendian = int(dtype.startswith(">"))
    return image


class Bench:
    """A client beside a running register_node: sends slices and gathers what becomes of them."""

    _stamps = count(1000)
    _axes_of_nobody = map("axes_of_nobody_{}".format, count())

    def __init__(
        self, client: RosClient, namespace: str = "", image_topic: str = "image", scanner_frame_id: str = "ct"
    ) -> None:
        self.client = client
        self.namespace = namespace
        self._begun = 0
        self.node = f"{namespace}{NODE}"
        self.image_topic = image_topic
        self.scanner_frame_id = scanner_frame_id
        self.poses = client.collect(PoseStamped, f"{namespace}/pose")
        self.with_covariance = client.collect(PoseWithCovarianceStamped, f"{namespace}/pose_with_covariance")
        self.targets = client.collect(PointStamped, f"{namespace}/target_in_frame")
        # The last, as DDS announces in order: whom the node tells a status has its poses too.
        self.diagnostics = client.collect(DiagnosticArray, "/diagnostics")

    def name_of(self, what: str) -> str:
        """Name of a status of the node."""
        return f"{self.node.lstrip('/')}: {what}"

    def next_stamp(self) -> Time:
        return Time(sec=next(self._stamps), nanosec=1)

    def send(self, image: Image, frame_id: str = "ct", stamp: Time | None = None) -> Time:
        image.header.frame_id = frame_id
        image.header.stamp = stamp or self.next_stamp()
        self.client.publish(self.image_topic, image)
        return image.header.stamp

    def status(self, stamp: Time, deadline_s: float = DEADLINE_S) -> DiagnosticStatus:
        """The one status of the image with this stamp."""
        what = "the diagnostics of an image"
        array = self.client.wait_for(lambda: of_stamp(self.diagnostics, stamp), what, deadline_s)
        (status,) = array.status
        assert status.name == self.name_of("registration")
        assert [pair.key for pair in status.values] == DIAGNOSTIC_KEYS
        for pair in status.values:
            if pair.key in NUMBERS:
                float(pair.value)
        return status

    def pose(self, stamp: Time) -> Pose:
        """The pose published with this stamp."""
        message = self.client.wait_for(lambda: of_stamp(self.poses, stamp), "a pose")
        return conversions.pose_from_message(message)

    def accept(self, image: Image, **kwargs: Any) -> tuple[Pose, dict[str, str]]:
        """Send an image that must be accepted; returns its pose and its diagnostic values."""
        stamp = self.send(image, **kwargs)
        status = self.status(stamp)
        assert status.level != DiagnosticStatus.ERROR, status.message
        return self.pose(stamp), values_of(status)

    def is_accepted(self, image: Image) -> bool:
        """Whether an image is accepted now."""
        return values_of(self.status(self.send(image)))["outcome"] == "accepted"

    def refuse(self, image: Image, reason: str, sentence: str, **kwargs: Any) -> None:
        """Send an image that must be refused, and then a good one, before which no pose may come."""
        refused = self.refusal(image, reason, sentence, **kwargs)
        hu, slice_from_frame = rendered(1)
        assert_near(self.accept(image_of(hu))[0], slice_from_frame)
        self.assert_no_pose_of(refused)

    def refusal(self, image: Image, reason: str, sentence: str, **kwargs: Any) -> Time:
        """Send an image that must be refused, as any would be now; of its stamp, returned, no pose may come later."""
        stamp = self.send(image, **kwargs)
        status = self.status(stamp)
        assert status.level == DiagnosticStatus.ERROR
        assert sentence in status.message
        values = values_of(status)
        assert (values["outcome"], values["reason"]) == ("refused", reason)
        return stamp

    def assert_no_pose_of(self, *refused: Time) -> None:
        """To be called when the pose of a later image has come: a topic keeps its order."""
        for stamp in refused:
            assert of_stamp(self.poses, stamp) is None
            assert of_stamp(self.with_covariance, stamp) is None

    def call(self, service: str) -> Trigger.Response:
        return self.client.call(Trigger, f"{self.node}/{service}", again_after_s=None)

    def set(self, **values: Any) -> str:
        """Set parameters as one; returns why they were refused, or nothing."""
        result = self.client.set_parameters(self.node, **values)
        assert result.successful != bool(result.reason)
        return str(result.reason)

    def start_anew(self) -> None:
        """Bring the node back to its start: parameters, and no slices, poses and target. By what every user can do."""
        values = self.client.get_parameters(self.node, *START)
        # Only those that are not: a frame that is loaded again has its tables made anew, which takes seconds.
        changed = {name: START[name] for name, value in zip(START, values, strict=True) if plain(value) != START[name]}
        assert self.set(**changed) == ""
        # A target in axes that no pose is in takes the place of the one before, and is dropped for the first pose.
        axes = next(self._axes_of_nobody)
        self.client.publish(f"{self.namespace}/target", target_of([0, 0, 0], axes))
        if self._reason_of_target(axes) == "no_pose":
            self.accept_any()
            assert self._reason_of_target(f"its frame_id is '{axes}'") == "bad_target"
        # Slices and poses of another spacing are forgotten.
        assert self.set(pixel_shear=1e-3) == ""
        assert self.set(pixel_shear=0.0) == ""
        for messages in (self.poses, self.with_covariance, self.targets, self.diagnostics):
            messages.clear()
        self._begun = next(self._stamps)

    def stamps_of(self, messages: list[Any]) -> list[Time]:
        """The stamps of messages about slices since the start: one from before may come late, by a topic of its own."""
        return [one.header.stamp for one in messages if one.header.stamp.sec > self._begun]

    def accept_any(self) -> None:
        """Have some slice accepted."""
        self.accept(image_of(rendered(1)[0]))

    def _reason_of_target(self, axes: str) -> str:
        """Why the target was refused whose axes, or all that is said of them, are these."""

        def told() -> list[DiagnosticStatus]:
            statuses = [status for array in self.diagnostics for status in array.status]
            ours = [status for status in statuses if status.name == self.name_of("target")]
            return [status for status in ours if axes in status.message or axes == status.hardware_id]

        return values_of(self.client.wait_for(told, f"a status of the target in {axes}")[-1])["reason"]

    def warm_up(self, *received: list[Any]) -> None:
        """Until both sides have discovered each other, messages go astray: repeat until every topic has delivered."""
        hu, _ = rendered(1)
        received = received or (self.diagnostics, self.poses, self.with_covariance, self.targets)
        next_try = 0.0

        def all_delivered() -> bool:
            nonlocal next_try
            if time.monotonic() > next_try:
                next_try = time.monotonic() + 0.2
                self.client.publish(f"{self.namespace}/target", target_of([0, 0, 0], self.scanner_frame_id))
                self.send(image_of(hu))
            return all(received)

        self.client.wait_for(all_delivered, "the first messages of all topics")


def plain(value: Any) -> Any:
    """A parameter's value as it is set: an empty list is read as nothing, others as arrays."""
    if value is None:
        return []
    return value if isinstance(value, str | bool | int | float) else list(value)


def of_stamp(messages: list[Any], stamp: Time) -> Any:
    return next((message for message in messages if message.header.stamp == stamp), None)


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def target_of(point_mm: Any, frame_id: str = "ct") -> PointStamped:
    message = PointStamped(point=conversions.point_to_message(np.asarray(point_mm, float)))
    message.header.frame_id = frame_id
    return message


def assert_near(found: Pose, true: Pose) -> None:
    assert np.linalg.norm(found.translation - true.translation) < 0.5
    assert math.degrees(float(rotation_angle(found.rotation @ true.rotation.T))) < 1.0


class SpacedBench(Bench):
    """Sends with every image the pixel spacing that it bears."""

    def send_spaced(self, hu: np.ndarray, spacing: PixelScale):
        message = Vector3Stamped(vector=conversions.scale_to_message(spacing))
        message.header.stamp = self.next_stamp()
        self.client.publish(f"{self.namespace}/slice_spacing", message)
        return self.send(image_of(hu), stamp=message.header.stamp)
