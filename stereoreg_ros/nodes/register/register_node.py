"""The node that registers stereotactic frames from every CT slice it receives."""

from __future__ import annotations

import re
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped, Vector3Stamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from stereoreg_ros.drawing import draw_overlay
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.common.diagnostic_status import OTHER_SPACING, name_of_status, status_of, status_of_unusable
from stereoreg_ros.nodes.common.process import run
from stereoreg_ros.nodes.common.qos import QUEUE, publisher_of, subscription_of
from stereoreg_ros.nodes.common.transforms import broadcaster_of, has_tf2
from stereoreg_ros.nodes.register.backlog import MOST_WAIT_S, Backlog, received_s, waiting_in
from stereoreg_ros.nodes.register.companion import Companion
from stereoreg_ros.nodes.register.frame_output import FrameOutput, FrameTopics
from stereoreg_ros.nodes.register.image_sources import ImageSources
from stereoreg_ros.nodes.register.markers import markers_of
from stereoreg_ros.nodes.register.parameters import NodeSettings, ParameterError, changed_settings, declare_settings
from stereoreg_ros.nodes.register.scale_keeper import ScaleKeeper
from stereoreg_ros.nodes.register.stream_status import StreamStatus
from stereoreg_ros.nodes.register.targets import TargetInFrame, status_of_target, target_in_frame
from stereoreg_ros.registration import preparation, register_frames
from stereoreg_ros.result import Reason, Refusal, Registration

_LOOK_FOR_OVERDUE_S = 0.1
_REPORT_STREAM_S = 1.0
_REPEAT_WARNING_S = 5.0
# Longer, and whoever sets a parameter would wait too long for the answer.
_PREPARE_S = 2.0
_SPARE_TIME_S = 0.2
_NOTHING = object()
_TOPIC_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True, eq=False)
class _Unregistered:
    """An image and the pixel spacing that it came with; None where it came with none."""

    image: Image
    spacing: PixelScale | None


class RegisterNode(Node):
    """Image in, pose or refusal out; topics, services and diagnostics are described in the README."""

    def __init__(self) -> None:
        super().__init__("register_node")
        self.settings: NodeSettings = declare_settings(self)
        if self.settings.publish_tf and not has_tf2():
            raise ParameterError(_NO_TF2)
        self._checked_frames: tuple[Frame, ...] = ()
        # They are there before a frame is, so that a controller can wait for them.
        self._topics = [FrameTopics(self)]
        self._outputs: list[FrameOutput] = []
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._preparation: Iterator[None] = iter(())
        self._spare_time = self.create_timer(_SPARE_TIME_S, self._prepare_in_spare_time, clock=steady)
        self._frame_fault = self._load_start_frames()
        self._backlog = Backlog()
        self._target: PointStamped | None = None
        self._stream = StreamStatus(time.monotonic())
        self._send_transform: Callable[[TransformStamped], None] | None = None
        self._choose_tf()

        self._diagnostics = publisher_of(self, DiagnosticArray, "/diagnostics", QUEUE)
        self._overlay = publisher_of(self, Image, "overlay", QUEUE)
        self._markers = publisher_of(self, MarkerArray, "markers", QUEUE)
        # The image last: where all are there, rclpy serves them in this order and no image has to wait.
        self._slice_spacing: Companion[PixelScale, Image] = Companion(
            self,
            Vector3Stamped,
            "slice_spacing",
            conversions.scale_from_message,
            same=PixelScale.__eq__,
            required=lambda: False,
            met=self._pair_with_pose,
        )
        self._slice_pose: Companion[Pose, _Unregistered] = Companion(
            self,
            PoseStamped,
            "slice_pose",
            conversions.pose_from_message,
            same=_same_pose,
            required=lambda: self.settings.slice_pose_required,
            met=self._register,
        )
        self._image_input = subscription_of(self, Image, "image", self._on_image, QUEUE)
        inputs = self._image_input, self._slice_pose.subscription, self._slice_spacing.subscription
        self._sources = ImageSources(self, inputs)
        subscription_of(self, PointStamped, "target", self._on_target, QUEUE)
        self._more_wait = self.create_guard_condition(self._register_next)
        self.create_timer(_LOOK_FOR_OVERDUE_S, self._refuse_overdue, clock=steady)
        self.create_timer(_REPORT_STREAM_S, self._report_stream, clock=steady)
        self._scale = ScaleKeeper(self, self)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._scale.load()
        self.get_logger().info(f"ready, {self.settings.in_force}")

    @property
    def frame(self) -> Frame | None:
        """The first frame, which the pixel scale is measured with; None where no frame could be loaded."""
        return self._outputs[0].frame if self._outputs else None

    def images_come(self) -> bool:
        """Whether somebody publishes images."""
        return self.count_publishers(self._image_input.topic_name) > 0

    # From an image to a pose, in the order of the data.

    def _on_image(self, image: Image, info: Any) -> None:
        self._backlog.add(image, received_s(info))
        self._register_next()

    def _register_next(self) -> None:
        """One slice, and then it is the turn of services, parameters and timers before the next."""
        for image, came_s in waiting_in(self._image_input):
            self._backlog.add(image, came_s)
        for late in self._backlog.take_late(time.time()):
            self._skip(late)
        image = self._backlog.take()
        try:
            if image is not None:
                self._slice_spacing.meet(image.header.stamp, image)
        finally:
            # Whatever one slice does, the next has its turn.
            if len(self._backlog):
                self._more_wait.trigger()

    def _pair_with_pose(self, image: Image, spacing: PixelScale | MessageError | None) -> None:
        if isinstance(spacing, MessageError):
            self._slice_pose.give_up(image.header.stamp)
            self._register(_Unregistered(image, None), spacing)
        else:
            self._slice_pose.meet(image.header.stamp, _Unregistered(image, spacing))

    def _refuse_overdue(self) -> None:
        self._slice_spacing.refuse_overdue()
        self._slice_pose.refuse_overdue()

    def _register(self, unregistered: _Unregistered, scanner_from_slice: Pose | MessageError | None) -> None:
        """Register one image and publish what came of it; whatever is in the image, the node lives on."""
        started, came_s = time.perf_counter(), time.monotonic()
        image = unregistered.image
        header = Header(stamp=image.header.stamp, frame_id=self.settings.scanner_frame_id or image.header.frame_id)
        if not self._outputs:
            self._refuse_unusable("bad_frame", self._frame_fault, header, started)
            return
        try:
            ct_slice = self._slice_from(unregistered, scanner_from_slice)
            results = register_frames(
                ct_slice,
                [output.frame for output in self._outputs],
                self.settings.options,
                [output.latest.registration.scanner_from_frame if output.latest else None for output in self._outputs],
                self._scale.covariance,
            )
            duration_s = time.perf_counter() - started
            statuses = [status_of(result, self._scale.source, duration_s, header.frame_id) for result in results]
        except ValueError as error:
            self._refuse_unusable("bad_image", str(error), header, started)
            return
        except Exception as error:
            self.get_logger().error(f"internal error while registering an image\n{traceback.format_exc()}")
            message = f"internal error: {type(error).__name__}: {error}; please report it with the node's log"
            self._refuse_unusable("internal_error", message, header, started)
            return
        if len(results[0].spots_px) >= self.settings.options.min_inliers:
            self._scale.sightings.append(replace(results[0].spots, stated_scale=unregistered.spacing))
        for output, result in zip(self._outputs, results, strict=True):
            output.publish(result, header, came_s, self._axes_of(output.frame), self._send_transform)
        self._publish_statuses(statuses, header)
        self._count(header)
        self._publish_target_in_frame()
        self._publish_pictures(ct_slice, results, header)

    def _skip(self, image: Image) -> None:
        """Answer an image that is not registered, since newer ones wait; the latest pose stays as it is."""
        self._slice_spacing.give_up(image.header.stamp)
        self._slice_pose.give_up(image.header.stamp)
        message = f"skipped for a newer slice: it had waited for over {MOST_WAIT_S:g} s"
        statuses = self._unusable("skipped", message, image.header.frame_id, 0.0)
        self._publish_statuses(statuses, image.header)

    def _slice_from(self, unregistered: _Unregistered, scanner_from_slice: Pose | MessageError | None) -> Slice:
        image, spacing = unregistered.image, unregistered.spacing
        if isinstance(scanner_from_slice, MessageError):
            raise scanner_from_slice
        if fault := self._sources.fault(time.monotonic()):
            raise MessageError(fault)
        settings = self.settings
        if settings.scale is None:
            raise MessageError("pixel_spacing is not told yet, set the parameter to [sx, sy] in mm/pixel")
        if spacing is not None and not self._scale.stands_for(spacing):
            raise MessageError(f"{OTHER_SPACING} {spacing}, expected that which was told, {self._scale.configured}")
        hu = conversions.hu_from_image(image, settings.rescale_slope, settings.rescale_intercept)
        return Slice(hu, settings.scale, Pose.identity() if scanner_from_slice is None else scanner_from_slice)

    def _axes_of(self, frame: Frame) -> str:
        """Name of a frame's axes in messages: the parameter's where it is alone, else its own."""
        return self.settings.fiducial_frame_id if len(self._outputs) == 1 else frame.name

    def _refuse_unusable(self, reason: Reason, message: str, header: Header, started: float) -> None:
        self.get_logger().warning(f"image refused: {message}", throttle_duration_sec=_REPEAT_WARNING_S)
        self._forget_poses()
        statuses = self._unusable(reason, message, header.frame_id, time.perf_counter() - started)
        self._publish_statuses(statuses, header)
        self._count(header)

    def _unusable(self, reason: Reason, message: str, hardware_id: str, duration_s: float) -> list[DiagnosticStatus]:
        """Statuses, one for each frame, of an image that does not come to registration."""
        frames = [(output.frame.name, len(output.frame)) for output in self._outputs]
        return [
            status_of_unusable(
                reason,
                message,
                frame_name=name,
                lines=lines,
                pixel_spacing=self.settings.pixel_spacing,
                calibration=self._scale.source,
                duration_s=duration_s,
                hardware_id=hardware_id,
            )
            for name, lines in frames or [(source, 0) for source in self.settings.frame_sources]
        ]

    def _publish_statuses(self, statuses: list[DiagnosticStatus], header: Header) -> None:
        if len(statuses) > 1:
            for status in statuses:
                frame = next(pair.value for pair in status.values if pair.key == "frame")
                status.name = f"{status.name} of {frame}"
        # The image's stamp, so that a status can be laid beside its pose.
        self._diagnose(statuses, header.stamp)

    def _diagnose(self, statuses: list[DiagnosticStatus], stamp: Time) -> None:
        for status in statuses:
            status.name = name_of_status(self.get_fully_qualified_name(), status.name)
        self._diagnostics.publish(DiagnosticArray(header=Header(stamp=stamp), status=statuses))

    def _count(self, header: Header) -> None:
        """Count a slice that was answered, with its latency."""
        # Not as a Time of rclpy, which knows none before 1970.
        stamp_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
        latency_ms = (self.get_clock().now().nanoseconds - stamp_ns) / 1e6 if stamp_ns else float("nan")
        self._stream.registered(time.monotonic(), latency_ms)

    def _publish_pictures(self, ct_slice: Slice, results: list[Registration | Refusal], header: Header) -> None:
        overlay_wanted = self._overlay.get_subscription_count() > 0
        markers_wanted = self._markers.get_subscription_count() > 0
        overlay = markers = None
        try:
            if overlay_wanted:
                overlay = conversions.image_from_bgr(draw_overlay(ct_slice, results[0]))
                overlay.header = header
            if markers_wanted:
                named = [(result, self._axes_of(result.frame)) for result in results]
                markers = markers_of(ct_slice, named, header, self._usable_target(header))
        except Exception:
            self.get_logger().error(f"internal error while drawing a slice\n{traceback.format_exc()}")
        if overlay is not None:
            self._overlay.publish(overlay)
        if markers is not None:
            self._markers.publish(markers)

    def _report_stream(self) -> None:
        now_s = time.monotonic()
        if fault := self._sources.fault(now_s):
            self.get_logger().warning(fault, throttle_duration_sec=_REPEAT_WARNING_S)
        status = self._stream.report(
            now_s,
            self.settings.stale_after,
            self._backlog.received,
            self._backlog.skipped,
            len(self._backlog),
            self.settings.scanner_frame_id,
            self._missing(),
        )
        self._diagnose([status], self.get_clock().now().to_msg())

    def _missing(self) -> str:
        """What has to be set before a slice can be registered; empty where nothing has."""
        if not self._outputs:
            return f"no frame: {self._frame_fault}"
        return "no pixel spacing: set the parameter pixel_spacing" if self.settings.scale is None else ""

    # The target.

    def _on_target(self, message: PointStamped) -> None:
        # A target that cannot be used takes the place of the one before: steering to that one would look right.
        self._target = message
        self._publish_target_in_frame()

    def _publish_target_in_frame(self) -> None:
        if self._target is None:
            return
        statuses = []
        for output in self._outputs:
            settings = self.settings
            outcome = target_in_frame(
                self._target,
                output.latest,
                time.monotonic(),
                settings.max_pose_age,
                settings.options.max_target_error_mm,
            )
            if isinstance(outcome, TargetInFrame):
                output.publish_target(outcome, self._axes_of(output.frame))
            else:
                self.get_logger().warning(outcome.message, throttle_duration_sec=_REPEAT_WARNING_S)
                if outcome.reason == "bad_target":
                    self._target = None
            statuses.append(status_of_target(outcome, output.frame.name, self._target_axes()))
            if self._target is None:
                break
        self._diagnose(statuses, self.get_clock().now().to_msg())

    def _target_axes(self) -> str:
        return self._target.header.frame_id if self._target is not None else ""

    def _usable_target(self, header: Header) -> PointStamped | None:
        """The target, where it is in the axes of what is drawn."""
        target = self._target
        return target if target is not None and target.header.frame_id == header.frame_id else None

    # Parameters.

    def _load_start_frames(self) -> str:
        """Load the frames; returns why they cannot be, or nothing."""
        try:
            self._checked_frames = _loaded(self.settings.frame_sources)
        except ValueError as error:
            self.get_logger().error(f"no slice can be registered until frame_file is set: {error}")
            return str(error)
        self._use_frames()
        return ""

    def _use_frames(self) -> None:
        for topics in self._topics:
            topics.destroy()
        alone = len(self._checked_frames) == 1
        self._topics = [FrameTopics(self, "" if alone else f"{frame.name}/") for frame in self._checked_frames]
        self._outputs = [FrameOutput(*both) for both in zip(self._checked_frames, self._topics, strict=True)]
        self._prepare()

    def _prepare(self) -> None:
        """Fill the tables that the first slices would wait for; until the scale is told nobody knows which."""
        if self.settings.scale is None:
            return
        scale, options = self.settings.scale, self.settings.options
        self._preparation = chain.from_iterable(preparation(output.frame, scale, options) for output in self._outputs)
        end_s = time.monotonic() + _PREPARE_S
        for _ in self._preparation:
            if time.monotonic() >= end_s:
                self._spare_time.reset()
                break

    def _prepare_in_spare_time(self) -> None:
        """Go on with what there was no time for, a few tables each time that no slice waits."""
        if not len(self._backlog) and next(self._preparation, _NOTHING) is _NOTHING:
            self._spare_time.cancel()

    def _choose_tf(self) -> None:
        if self.settings.publish_tf and self._send_transform is None:
            self._send_transform = broadcaster_of(self)
        if not self.settings.publish_tf:
            self._send_transform = None

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            settings = changed_settings(self, parameters)
            if settings.scale is None and self.settings.scale is not None:
                raise ValueError("pixel_spacing is [0, 0], expected two positive numbers of mm/pixel")
            if settings.publish_tf and not has_tf2():
                raise ValueError(_NO_TF2)
            if any(parameter.name in ("frame_file", "frame_files") for parameter in parameters):
                self._checked_frames = _loaded(settings.frame_sources)
        except Exception as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        names = {parameter.name for parameter in parameters}
        scale_before, self.settings = self.settings.scale, changed_settings(self, [])
        if "calibration_slices" in names:
            self._scale.keep_slices(self.settings.calibration.calibration_slices)
        if "publish_tf" in names:
            self._choose_tf()
        if names & {"frame_file", "frame_files"}:
            self._frame_fault = ""
            self._use_frames()
            self._forget_slices()
        if names & {"pixel_spacing", "pixel_shear"}:
            if self._scale.scale_was_set(scale_before):
                self._forget_slices()
            elif self.settings.scale != scale_before:
                # It was measured from slices that are there, which say the same as before; a pose of theirs does not.
                self._forget_poses()
        if names & _OF_THE_TABLES:
            self._prepare()

    def _forget_slices(self) -> None:
        """A slice seen under another frame or scale says nothing about this one."""
        self._forget_poses()
        self._scale.sightings.clear()

    def _forget_poses(self) -> None:
        """No target may rest any more on the poses so far."""
        for output in self._outputs:
            output.latest = None


# What the matcher's tables depend on.
_OF_THE_TABLES = {
    "pixel_spacing",
    "spot_noise_px",
    "frame_tolerance_mm",
    "scale_tolerance",
    "matcher",
    "nominal_orientation",
    "max_rotation_deg",
    "min_inliers",
}
_NO_TF2 = "publish_tf is true, but tf2_ros cannot be imported, expected the package ros-jazzy-tf2-ros"


def _same_pose(one: Pose, other: Pose) -> bool:
    return np.array_equal(one.rotation, other.rotation) and np.array_equal(one.translation, other.translation)


def _loaded(sources: tuple[str, ...]) -> tuple[Frame, ...]:
    """The frames; ValueError where one cannot be loaded, or several cannot have topics of their own."""
    frames = tuple(load_frame(source) for source in sources)
    names = [frame.name for frame in frames]
    for name in names:
        if len(names) > 1 and not _TOPIC_NAME.fullmatch(name):
            raise ValueError(
                f"frame_files: frame '{name}' cannot name a topic, expected a letter and then letters, digits and '_'"
            )
        if names.count(name) > 1:
            raise ValueError(f"frame_files: two frames are called '{name}', expected distinct names")
    return frames


def main() -> int:
    """Entry point of `register_node`."""
    return run(RegisterNode)


if __name__ == "__main__":
    sys.exit(main())
