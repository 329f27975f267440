"""A simulated scanner: CT slices of a frame that passes through the plane, and where the frame truly stands."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.nodes.common.conversions import image_from_hu, pose_to_message, scale_to_message
from stereoreg_ros.nodes.common.parameters import ParameterError, declare, entries_of, setting
from stereoreg_ros.nodes.common.process import run
from stereoreg_ros.nodes.common.slice_publisher import UNUSED_REGISTER_NODE
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, centred_pose, passage, random_pose, render_slice

POSE_GRACE_S: Final = 1.0
FLUSH_S: Final = 10.0
_POLL_S: Final = 0.02
_QOS: Final = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)
# Latched for late subscribers: to judge a slice one needs its truth.
_TRUTH_QOS: Final = QoSProfile(
    depth=100, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
_ABOVE_THE_PATIENT: Final = (0.5, 0.27)
_CENTRE: Final = (0.5, 0.5)
_SMALL_FRAME: Final = 0.3


@dataclass(frozen=True)
class SimulationSettings:
    """The settings of `simulate_node` at its start.

    Raises ValueError, naming the parameter, what was found and what was expected.
    """

    frame_file: str = setting("cube6", "frame file: a path, or the name of a shipped frame")
    rate: float = setting(2.0, "slices per second", 0.01, 50.0)
    slices: int = setting(0, "number of slices, after which the node ends; 0: without end", 0, 1_000_000_000)
    seed: int = setting(1, "seed of everything random: the same seed, the same slices", 0, 2**31 - 1)
    step_mm: float = setting(2.0, "how far the frame moves along the slice's normal between slices, mm", 0.001, 100.0)
    max_tilt_deg: float = setting(10.0, "largest tilt of the frame about each axis of the slice, degrees", 0.0, 45.0)
    missing_probability: float = setting(0.1, "probability that one rod of a slice is left out", 0.0, 1.0)
    false_spots: int = setting(3, "largest number of bright spots in a slice that are no rods", 0, 30)
    needle: bool = setting(True, "whether a needle of steel lies in the slice")
    body: bool = setting(True, "whether a patient lies in the slice")
    noise_hu: float = setting(20.0, "standard deviation of the noise, HU", 0.0, 1000.0)
    slice_thickness_mm: float = setting(1.0, "thickness of the slice, mm", 0.05, 50.0)
    pixel_spacing: tuple[float, float] = setting(
        (0.5, 0.5), "pixel spacing [sx, sy]: between columns, between rows, mm/pixel"
    )
    rows: int = setting(512, "rows of the image", 16, 4096)
    columns: int = setting(512, "columns of the image", 16, 4096)
    frame_id: str = setting("scanner", "frame_id of the images and of the true poses")
    register_node: str = setting("", UNUSED_REGISTER_NODE.description)
    wait_for_subscriber: bool = setting(False, "begin only when somebody subscribes to image, so that no slice is lost")

    def __post_init__(self) -> None:
        for entry in entries_of(type(self)):
            value = getattr(self, entry.name)
            # The range that rclpy checks lets NaN through.
            if entry.low is not None and entry.high is not None and not entry.low <= value <= entry.high:
                raise ValueError(f"{entry.name} is {value!r}, expected a number from {entry.low:g} to {entry.high:g}")
        if len(self.pixel_spacing) != 2:
            raise ValueError(f"pixel_spacing has {len(self.pixel_spacing)} numbers, expected two: [sx, sy] in mm/pixel")

    @property
    def scanner(self) -> ScannerSettings:
        """The scanner, with the largest number of false spots."""
        return ScannerSettings(
            shape=(self.rows, self.columns),
            scale=PixelScale(*self.pixel_spacing),
            slice_thickness_mm=self.slice_thickness_mm,
            noise_hu=self.noise_hu,
            false_spots=self.false_spots,
            body=self.body,
            needle=self.needle,
        )


class Passage:
    """The slices of one run, one after the other, each with the true slice_from_frame.

    Raises ValueError where the frame does not fit into the image.
    """

    def __init__(self, frame: Frame, settings: SimulationSettings) -> None:
        self.scanner = settings.scanner
        self._frame = frame
        self._missing_probability = settings.missing_probability
        self._rng = np.random.default_rng(settings.seed)
        ends = np.concatenate([frame.starts, frame.ends])
        small = float(np.ptp(ends, axis=0)[:2].max()) < _SMALL_FRAME * self.scanner.size_mm.min()
        middle = random_pose(
            self._rng,
            frame,
            self.scanner,
            max_tilt_deg=settings.max_tilt_deg,
            max_offset_mm=5.0 if small else 0.0,
            max_depth_mm=0.0,
            min_rods=3,
            nominal=centred_pose(frame, self.scanner, _ABOVE_THE_PATIENT if small else _CENTRE),
        )
        self._poses = passage(frame, middle, settings.step_mm)

    def next_slice(self) -> tuple[Slice, Pose]:
        """The next slice and its slice_from_frame, mm. Clutter for which the image has no room is left out."""
        pose = next(self._poses)
        hidden: tuple[str, ...] = ()
        if self._rng.uniform() < self._missing_probability:
            hidden = (str(self._rng.choice(self._frame.line_names)),)
        placed = [PlacedFrame(self._frame, pose, hidden)]
        count = int(self._rng.integers(self.scanner.false_spots, endpoint=True))
        try:
            return render_slice(placed, replace(self.scanner, false_spots=count), self._rng), pose
        except ValueError:
            bare = replace(self.scanner, false_spots=0, needle=False)
            return render_slice(placed, bare, self._rng), pose


class SimulateNode(Node):
    """Publishes `true_pose` (scanner_from_frame), `slice_spacing` and then `image` (in HU, 16SC1), with one stamp.

    finished: the number of slices asked for has been published and has reached all subscribers.
    """

    def __init__(self) -> None:
        super().__init__("simulate_node")
        values = declare(self, entries_of(SimulationSettings))
        self.finished = False
        try:
            self._settings = SimulationSettings(**values)
            frame = load_frame(self._settings.frame_file)
            self._passage = Passage(frame, self._settings)
        except FrameFileError as error:
            raise ParameterError(f"frame_file: {error}") from None
        except ValueError as error:
            raise ParameterError(str(error)) from None
        self._spacing_publisher = self.create_publisher(Vector3Stamped, "slice_spacing", _QOS)
        self._image_publisher = self.create_publisher(Image, "image", _QOS)
        self._pose_publisher = self.create_publisher(PoseStamped, "true_pose", _TRUTH_QOS)
        self._published = 0
        self._due_s = 0.0
        self._audience_s: float | None = None
        self._flush_by_s: float | None = None
        self.create_timer(min(_POLL_S, 1.0 / self._settings.rate), self._step)
        self.add_on_set_parameters_callback(self._refuse_changes)
        length = f"{self._settings.slices} slices" if self._settings.slices else "slices without end"
        self.get_logger().info(f"{length} of frame '{frame.name}', {self._settings.rate:g} per second")

    def _step(self) -> None:
        now_s = time.monotonic()
        if self._flush_by_s is not None:
            self._flush(self._flush_by_s)
            return
        if now_s < self._due_s or not (self._published or self._may_begin(now_s)):
            return
        # On time, the pace is kept; after a pause it starts afresh instead of catching up.
        period_s = 1.0 / self._settings.rate
        self._due_s = (self._due_s if now_s < self._due_s + period_s else now_s) + period_s
        self._publish(*self._passage.next_slice())
        self._published += 1
        if self._published == self._settings.slices:
            self._flush_by_s = time.monotonic() + FLUSH_S

    def _may_begin(self, now_s: float) -> bool:
        """Whether the first slice may go out: where that matters, somebody takes it."""
        if self._settings.wait_for_subscriber and self._image_publisher.get_subscription_count() == 0:
            self._audience_s = None
            return False
        if self._audience_s is None:
            self._audience_s = now_s
        waited_s = now_s - self._audience_s
        # Who judges by true_pose subscribes to it besides, and may be discovered a little later.
        poses_taken = self._pose_publisher.get_subscription_count() > 0 or waited_s >= POSE_GRACE_S
        return poses_taken or not self._settings.wait_for_subscriber

    def _publish(self, ct_slice: Slice, scanner_from_frame: Pose) -> None:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._settings.frame_id)
        self._pose_publisher.publish(PoseStamped(header=header, pose=pose_to_message(scanner_from_frame)))
        spacing = scale_to_message(ct_slice.scale)
        self._spacing_publisher.publish(Vector3Stamped(header=header, vector=spacing))
        image = image_from_hu(ct_slice.hu.astype(np.int16))
        image.header = header
        self._image_publisher.publish(image)

    def _refuse_changes(self, parameters: list[Parameter]) -> SetParametersResult:
        own = {entry.name for entry in entries_of(SimulationSettings)}
        fixed = [parameter.name for parameter in parameters if parameter.name in own]
        reason = f"{', '.join(fixed)}: the simulation takes its parameters when it starts" if fixed else ""
        return SetParametersResult(successful=not fixed, reason=reason)

    def _flush(self, deadline_s: float) -> None:
        """Finish when every subscriber has everything, or at the deadline."""
        now = Duration(seconds=0)
        publishers = (self._pose_publisher, self._spacing_publisher, self._image_publisher)
        if all(publisher.wait_for_all_acked(now) for publisher in publishers):
            self.finished = True
            self.get_logger().info(f"published {self._published} slices")
        elif time.monotonic() > deadline_s:
            self.finished = True
            self.get_logger().warning(f"a subscriber did not take the last slices within {FLUSH_S:g} s")


def main() -> int:
    """Entry point of `simulate_node`."""
    return run(SimulateNode)


if __name__ == "__main__":
    sys.exit(main())
