"""The node that registers a stereotactic frame from every CT slice it receives."""

from __future__ import annotations

import sys
import time
import traceback
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from stereoreg_ros.calibration import Sighting, sighting_of
from stereoreg_ros.calibration_file import (
    CalibrationFileError,
    CalibrationRecord,
    load_calibration,
    remove_calibration,
    save_calibration,
)
from stereoreg_ros.drawing import draw_overlay
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.nodes import conversions
from stereoreg_ros.nodes.conversions import MessageError
from stereoreg_ros.nodes.diagnostic_status import status_of, status_of_unusable
from stereoreg_ros.nodes.markers import markers_of
from stereoreg_ros.nodes.parameters import changed_settings, declare_settings
from stereoreg_ros.nodes.recalibration import NextTurn, Recalibration
from stereoreg_ros.nodes.slice_poses import WAIT_S, SlicePoses
from stereoreg_ros.nodes.spinning import run
from stereoreg_ros.registration import register_slice
from stereoreg_ros.result import Reason, Refusal, Registration

# Deep enough that no slice is lost while one is registered, and small enough not to hoard memory.
_QUEUE = 10
_LOOK_FOR_OVERDUE_S = 0.1
_REPEAT_WARNING_S = 5.0
_POLL_S = 0.002


@dataclass(frozen=True, eq=False)
class _Accepted:
    """The latest pose: its header and the registration it comes from."""

    header: Header
    registration: Registration


class RegisterNode(Node):
    """Image in, pose or refusal out; topics, services and diagnostics are described in the README."""

    def __init__(self) -> None:
        super().__init__("register_node")
        self._settings = declare_settings(self)
        self._frame, self._frame_fault = self._load_start_frame()
        self._checked_frame = self._frame
        self._configured_scale = self._settings.scale
        self._calibration: Literal["configured", "measured"] = "configured"
        # Of the measured scale; a configured one is taken to be exact.
        self._scale_covariance: Array | None = None
        self._changes_scale_itself = False
        self._slice_poses = SlicePoses()
        self._slice_pose_seen = False
        self._target: PointStamped | None = None
        self._latest: _Accepted | None = None
        self._sightings: deque[Sighting] = deque(maxlen=self._settings.calibration.calibration_slices)
        self._recalibration: Recalibration | None = None

        self._pose = self.create_publisher(PoseStamped, "pose", _QUEUE)
        self._pose_with_covariance = self.create_publisher(PoseWithCovarianceStamped, "pose_with_covariance", _QUEUE)
        self._target_in_frame = self.create_publisher(PointStamped, "target_in_frame", _QUEUE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", _QUEUE)
        self._overlay = self.create_publisher(Image, "overlay", _QUEUE)
        self._markers = self.create_publisher(MarkerArray, "markers", _QUEUE)
        # The pose before the image: where both are there, rclpy serves them in this order and no image has to wait.
        self._slice_pose_input = self.create_subscription(PoseStamped, "slice_pose", self._on_slice_pose, _QUEUE)
        self._image_input = self.create_subscription(Image, "image", self._on_image, _QUEUE)
        self.create_subscription(PointStamped, "target", self._on_target, _QUEUE)
        # A call goes on over many turns of the executor, and must keep neither slices nor other calls from theirs.
        self.create_service(Trigger, "~/recalibrate", self._on_recalibrate, callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, "~/reset_calibration", self._on_reset_calibration)
        self.create_timer(_LOOK_FOR_OVERDUE_S, self._refuse_overdue, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._load_calibration()
        self.get_logger().info(f"ready, frame {self._settings.frame_file}")

    # From an image to a pose, in the order of the data.

    def _on_image(self, image: Image) -> None:
        if not self._slice_pose_expected():
            self._register(image, Pose.identity())
            return
        scanner_from_slice = self._slice_poses.take_pose(image.header.stamp)
        if scanner_from_slice is None:
            self._slice_poses.add_image(image, time.monotonic())
        else:
            self._register(image, scanner_from_slice)

    def _on_slice_pose(self, message: PoseStamped) -> None:
        self._slice_pose_seen = True
        scanner_from_slice: Pose | MessageError
        try:
            scanner_from_slice = conversions.pose_from_message(message)
        except MessageError as error:
            scanner_from_slice = MessageError(f"slice_pose: {error}")
            self.get_logger().warning(str(scanner_from_slice))
        image = self._slice_poses.add_pose(message.header.stamp, scanner_from_slice)
        if image is not None:
            self._register(image, scanner_from_slice)

    def _refuse_overdue(self) -> None:
        while (image := self._slice_poses.take_overdue(time.monotonic())) is not None:
            self._register(image, MessageError(f"no slice_pose with the image's stamp came within {WAIT_S:g} s"))

    def _slice_pose_expected(self) -> bool:
        return self._slice_pose_seen or self.count_publishers(self._slice_pose_input.topic_name) > 0

    def _register(self, image: Image, scanner_from_slice: Pose | MessageError) -> None:
        """Register one image and publish what came of it; whatever is in the image, the node lives on."""
        started = time.perf_counter()
        header = Header(stamp=image.header.stamp, frame_id=self._settings.scanner_frame_id or image.header.frame_id)
        if self._frame is None:
            self._refuse_unusable("bad_frame", self._frame_fault, header, started)
            return
        try:
            ct_slice = self._slice_from(image, scanner_from_slice)
            previous = self._latest.registration.scanner_from_frame if self._latest else None
            result = register_slice(ct_slice, self._frame, self._settings.options, previous, self._scale_covariance)
            duration_s = time.perf_counter() - started
            status = status_of(result, self._calibration, duration_s, header.frame_id)
        except ValueError as error:
            self._refuse_unusable("bad_image", str(error), header, started)
            return
        except Exception as error:
            self.get_logger().error(f"internal error while registering an image\n{traceback.format_exc()}")
            self._refuse_unusable("bad_image", f"internal error: {type(error).__name__}: {error}", header, started)
            return
        if len(result.spots_px) >= self._settings.options.min_inliers:
            self._sightings.append(sighting_of(result, ct_slice.hu.size, ct_slice.scanner_from_slice))
        if result:
            self._publish_pose(result, header)
        else:
            self._latest = None
        self._publish_status(status, header)
        self._publish_pictures(ct_slice, result, header)

    def _slice_from(self, image: Image, scanner_from_slice: Pose | MessageError) -> Slice:
        if isinstance(scanner_from_slice, MessageError):
            raise scanner_from_slice
        settings = self._settings
        if settings.scale is None:
            raise MessageError("pixel_spacing is not told yet, set the parameter to [sx, sy] in mm/pixel")
        hu = conversions.hu_from_image(image, settings.rescale_slope, settings.rescale_intercept)
        return Slice(hu, settings.scale, scanner_from_slice)

    def _publish_pose(self, registration: Registration, header: Header) -> None:
        pose = conversions.pose_to_message(registration.scanner_from_frame)
        self._pose.publish(PoseStamped(header=header, pose=pose))
        with_covariance = PoseWithCovarianceStamped(header=header)
        with_covariance.pose.pose = pose
        with_covariance.pose.covariance = conversions.covariance_to_message(registration.covariance)
        self._pose_with_covariance.publish(with_covariance)
        self._latest = _Accepted(header, registration)
        self._publish_target_in_frame()

    def _refuse_unusable(self, reason: Reason, message: str, header: Header, started: float) -> None:
        self._latest = None
        self.get_logger().warning(f"image refused: {message}", throttle_duration_sec=_REPEAT_WARNING_S)
        settings, frame = self._settings, self._frame
        status = status_of_unusable(
            reason,
            message,
            frame_name=frame.name if frame else settings.frame_file,
            lines=len(frame) if frame else 0,
            pixel_spacing=settings.pixel_spacing,
            calibration=self._calibration,
            duration_s=time.perf_counter() - started,
            hardware_id=header.frame_id,
        )
        self._publish_status(status, header)

    def _publish_status(self, status: DiagnosticStatus, header: Header) -> None:
        # The image's stamp, so that a status can be laid beside its pose.
        self._diagnostics.publish(DiagnosticArray(header=Header(stamp=header.stamp), status=[status]))

    def _publish_pictures(self, ct_slice: Slice, result: Registration | Refusal, header: Header) -> None:
        overlay_wanted = self._overlay.get_subscription_count() > 0
        markers_wanted = self._markers.get_subscription_count() > 0
        overlay = markers = None
        try:
            if overlay_wanted:
                overlay = conversions.image_from_bgr(draw_overlay(ct_slice, result))
                overlay.header = header
            if markers_wanted:
                markers = markers_of(ct_slice, result, header, self._settings.fiducial_frame_id)
        except Exception:
            self.get_logger().error(f"internal error while drawing a slice\n{traceback.format_exc()}")
        if overlay is not None:
            self._overlay.publish(overlay)
        if markers is not None:
            self._markers.publish(markers)

    # The target.

    def _on_target(self, message: PointStamped) -> None:
        # A target that cannot be used takes the place of the one before: steering to that one would look right.
        self._target = None
        try:
            conversions.point_from_message(message)
        except MessageError as error:
            self.get_logger().warning(f"target ignored: {error}")
            return
        self._target = message
        self._publish_target_in_frame()

    def _publish_target_in_frame(self) -> None:
        if self._target is None or self._latest is None:
            return
        header, registration = self._latest.header, self._latest.registration
        if self._target.header.frame_id != header.frame_id:
            self.get_logger().warning(
                f"target ignored: its frame_id is '{self._target.header.frame_id}', "
                f"expected that of the pose, '{header.frame_id}'",
                throttle_duration_sec=_REPEAT_WARNING_S,
            )
            self._target = None
            return
        target_in_scanner: Array = conversions.point_from_message(self._target)
        target_in_frame: Array = registration.scanner_from_frame.inverse() @ target_in_scanner
        self._target_in_frame.publish(
            PointStamped(
                header=Header(stamp=header.stamp, frame_id=self._settings.fiducial_frame_id),
                point=conversions.point_to_message(target_in_frame),
            )
        )

    # The pixel scale.

    async def _on_recalibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running already, wait for its answer"
            return response
        settings, frame = self._settings, self._frame
        if frame is None or settings.scale is None or not (self._sightings or self._images_come()):
            response.success, response.message = False, "no slice has been accepted yet, nothing to calibrate from"
            return response
        wait_s = settings.calibration_timeout if self._images_come() else 0.0
        self._recalibration = Recalibration(
            frame, settings.scale, settings.options, settings.calibration, time.monotonic() + wait_s
        )
        try:
            response.success, response.message = await self._recalibrate(self._recalibration)
        except Exception as error:
            self.get_logger().error(f"internal error in recalibrate\n{traceback.format_exc()}")
            response.success, response.message = False, f"internal error: {type(error).__name__}: {error}"
        finally:
            self._recalibration.close()
            self._recalibration = None
        return response

    async def _recalibrate(self, recalibration: Recalibration) -> tuple[bool, str]:
        """Whether the scale was changed, and the sentence for the operator."""
        while (outcome := recalibration.poll(self._sightings, time.monotonic())) is None:
            # Slices have their turn meanwhile; the sleep leaves the processor to the thread that measures.
            time.sleep(_POLL_S)
            await NextTurn()
        if self._frame is not recalibration.frame or self._settings.scale != recalibration.scale:
            return False, "calibration refused: the frame or the pixel spacing was changed meanwhile"
        if not outcome:
            return False, outcome.message
        configured = self._configured_scale or recalibration.scale
        fault = self._set_scale(outcome.scale, "measured", outcome.covariance)
        if fault:
            return False, f"the measured scale cannot be set: {fault}"
        if not self._settings.calibration_file:
            return True, outcome.message
        path = Path(self._settings.calibration_file)
        try:
            save_calibration(path, CalibrationRecord.of(outcome, configured, recalibration.frame.name))
        except OSError as error:
            self.get_logger().warning(f"calibration_file {path} cannot be written: {error}")
            return True, f"{outcome.message}; but it will be forgotten: {path} cannot be written: {error.strerror}"
        return True, outcome.message

    def _images_come(self) -> bool:
        return self.count_publishers(self._image_input.topic_name) > 0

    def _on_reset_calibration(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running, wait for its answer"
            return response
        if self._configured_scale is None:
            response.success, response.message = False, "pixel_spacing has not been configured, nothing to go back to"
            return response
        if self._settings.calibration_file:
            path = Path(self._settings.calibration_file)
            try:
                remove_calibration(path)
            except OSError as error:
                response.success = False
                response.message = f"calibration_file {path} cannot be removed: {error.strerror}; nothing was changed"
                return response
        fault = self._set_scale(self._configured_scale, "configured")
        scale = self._configured_scale
        back = f"pixel_spacing is the configured one, [{scale.sx:.9g}, {scale.sy:.9g}] mm/pixel"
        response.success, response.message = not fault, fault or back
        return response

    def _load_calibration(self) -> None:
        """Take up what was measured before the restart, where that can be trusted."""
        if not self._settings.calibration_file:
            return
        path = Path(self._settings.calibration_file)
        try:
            record = load_calibration(path)
        except CalibrationFileError as error:
            self.get_logger().warning(f"calibration_file is not used, the configured pixel_spacing is: {error}")
            return
        if record is None:
            return
        configured = self._settings.scale
        if configured is None or not record.replaces(configured):
            told = "not told" if configured is None else f"[{configured.sx:.6g}, {configured.sy:.6g}]"
            self.get_logger().warning(
                f"calibration_file is not used: {path} was measured in place of the pixel_spacing "
                f"[{record.configured.sx:.6g}, {record.configured.sy:.6g}], which is {told}"
            )
            return
        fault = self._set_scale(record.scale, "measured", np.array(record.covariance))
        if fault:
            self.get_logger().warning(f"calibration_file is not used: {path}: {fault}")
            return
        self.get_logger().info(
            f"pixel_spacing [{record.scale.sx:.6g}, {record.scale.sy:.6g}] as measured on {record.date}, from {path}"
        )

    def _set_scale(
        self, scale: PixelScale, calibration: Literal["configured", "measured"], covariance: Array | None = None
    ) -> str:
        """Change the scale's parameters as one; returns why they cannot be, or nothing."""
        self._changes_scale_itself = True
        try:
            outcome = self.set_parameters_atomically(
                [
                    Parameter("pixel_spacing", value=[float(scale.sx), float(scale.sy)]),
                    Parameter("pixel_shear", value=float(scale.shear)),
                ]
            )
        finally:
            self._changes_scale_itself = False
        if outcome.successful:
            self._calibration, self._scale_covariance = calibration, covariance
        return str(outcome.reason)

    # Parameters.

    def _load_start_frame(self) -> tuple[Frame | None, str]:
        try:
            return load_frame(self._settings.frame_file), ""
        except ValueError as error:
            self.get_logger().error(f"no slice can be registered until frame_file is set: {error}")
            return None, str(error)

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            settings = changed_settings(self, parameters)
            if settings.scale is None and self._settings.scale is not None:
                raise ValueError("pixel_spacing is [0, 0], expected two positive numbers of mm/pixel")
            if any(parameter.name == "frame_file" for parameter in parameters):
                self._checked_frame = load_frame(settings.frame_file)
        except Exception as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        names = {parameter.name for parameter in parameters}
        scale_before, self._settings = self._settings.scale, changed_settings(self, [])
        if "calibration_slices" in names:
            self._sightings = deque(self._sightings, maxlen=self._settings.calibration.calibration_slices)
        if "frame_file" in names:
            self._frame, self._frame_fault = self._checked_frame, ""
            self._forget_slices()
        if names & {"pixel_spacing", "pixel_shear"} and not self._changes_scale_itself:
            self._configured_scale, self._calibration = self._settings.scale, "configured"
            self._scale_covariance = None
            if self._settings.scale != scale_before:
                self._forget_slices()

    def _forget_slices(self) -> None:
        """A slice seen under another frame or scale says nothing about this one."""
        self._latest = None
        self._sightings.clear()


def main() -> int:
    """Entry point of `register_node`."""
    return run(RegisterNode)


if __name__ == "__main__":
    sys.exit(main())
