"""The node that registers stereotactic frames from every CT slice it receives."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Final

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Header

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.common.diagnostic_status import name_of_status
from stereoreg_ros.nodes.common.parameters import ParameterError
from stereoreg_ros.nodes.common.process import run
from stereoreg_ros.nodes.common.qos import QUEUE, publisher_of
from stereoreg_ros.nodes.common.transforms import broadcaster_of, has_tf2
from stereoreg_ros.nodes.register.backlog import MOST_WAIT_S, Backlog
from stereoreg_ros.nodes.register.frame_loading import load_frames
from stereoreg_ros.nodes.register.frame_output import FrameOutput, FrameTopics
from stereoreg_ros.nodes.register.incoming_slice import IncomingSlice
from stereoreg_ros.nodes.register.parameters import NodeSettings, changed_settings, declare_settings
from stereoreg_ros.nodes.register.pictures import Pictures
from stereoreg_ros.nodes.register.scale_keeper import ScaleInUse, ScaleKeeper
from stereoreg_ros.nodes.register.scale_services import ScaleServices
from stereoreg_ros.nodes.register.slice_input import SliceInput
from stereoreg_ros.nodes.register.slice_registration import Registered, SliceSetup, Unusable, register_incoming
from stereoreg_ros.nodes.register.slice_status import status_of, status_of_unusable
from stereoreg_ros.nodes.register.stream_status import StreamCounts, StreamStatus
from stereoreg_ros.nodes.register.target_keeper import TargetKeeper
from stereoreg_ros.nodes.register.worker import Worker

_REPORT_STREAM_S: Final = 1.0
_REPEAT_WARNING_S: Final = 5.0
# Before the node says that it is ready; the rest is prepared bit by bit while no slice waits.
_PREPARE_AT_START_S: Final = 2.0
_SPARE_TIME_S: Final = 0.2
# Tables for one spacing serve those near it, so that they are worth preparing before one is known.
_TYPICAL_SCALE: Final = PixelScale(0.5, 0.5)


class RegisterNode(Node):
    """Slices in, poses or refusals out; topics, services and diagnostics are described in the README.

    The callbacks receive and publish; what takes time is done by one worker, slice after slice.
    """

    def __init__(self) -> None:
        super().__init__("register_node")
        self.settings: NodeSettings = declare_settings(self)
        if self.settings.publish_tf and not has_tf2():
            raise ParameterError(_NO_TF2)
        self._checked_frames: tuple[Frame, ...] = ()
        # They are there before a frame is, so that a controller can wait for them.
        self._topics = [FrameTopics(self)]
        self._outputs: list[FrameOutput] = []
        self._preparation: Iterator[None] | None = None
        self._prepared_for: PixelScale | None = None
        self._frame_fault = self._load_start_frames()
        if self._preparation is not None and self.settings.scale is not None:
            end_s = time.monotonic() + _PREPARE_AT_START_S
            for _ in self._preparation:
                if time.monotonic() >= end_s:
                    break
        self._backlog = Backlog()
        self._worker = Worker(self)
        self._registering = False
        # Counts changes of what slices are registered with.
        self._revision = 0
        # The axes of the last slice, by frame_id and frame of reference, and the spacing that it stated.
        self._axes: tuple[str, str | None] | None = None
        self._spacing_stated = False
        self._stream = StreamStatus(time.monotonic())
        self._send_transform: Callable[[TransformStamped], None] | None = None
        self._choose_tf()

        self._diagnostics = publisher_of(self, DiagnosticArray, "/diagnostics", QUEUE)
        self._pictures = Pictures(self)
        self._input = SliceInput(self, lambda: self.settings.slice_pose_required, self._on_slice)
        self._target = TargetKeeper(self, lambda: (self.settings, self._outputs), self._diagnose_now)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_REPORT_STREAM_S, self._report_stream, clock=steady)
        self.create_timer(_SPARE_TIME_S, self._prepare_some, clock=steady)
        self._scale = ScaleKeeper(self, self)
        self._scale_services = ScaleServices(
            self, self._scale, lambda: (self.settings, self._frame_to_measure_with(), self._input.has_source)
        )
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._scale.load()
        self.get_logger().info(f"ready, {self.settings.in_force}")

    def destroy_node(self) -> None:
        """End; a recalibration that goes on is refused."""
        self._scale_services.close()
        self._worker.close()
        super().destroy_node()

    @property
    def is_computing(self) -> bool:
        """Whether a thread of the node is at work, which nothing can stop."""
        return self._worker.is_running or self._scale_services.is_measuring

    # From a slice to a pose, in the order of the data.

    def _on_slice(self, incoming: IncomingSlice) -> None:
        self._backlog.add(incoming, time.monotonic())
        self._go_on()

    def _go_on(self) -> None:
        """Begin with the slice whose turn it is."""
        for late in self._backlog.take_late(time.monotonic()):
            self._skip(late)
        while self._worker.is_free and (incoming := self._backlog.take()) is not None:
            self._begin(incoming)

    def _begin(self, incoming: IncomingSlice) -> None:
        """Refuse a slice that cannot be registered, or have the worker register it."""
        self._spacing_stated = self._spacing_stated or incoming.spacing is not None
        scale = self._scale.scale_for(incoming.spacing)
        fault = self._fault_of(incoming, scale)
        if fault is not None or scale is None:
            self._refuse(incoming, fault or Unusable("bad_image", _NO_SPACING))
            return
        self._enter(self._axes_of(incoming), incoming.frame_of_reference)
        if scale.scale != self._prepared_for:
            self._prepare_tables(scale.scale)
        latest = [output.latest for output in self._outputs]
        setup = SliceSetup(
            self.settings,
            tuple(output.registrar for output in self._outputs),
            tuple(one.registration.scanner_from_frame if one else None for one in latest),
            scale,
        )
        then = partial(self._on_outcome, incoming, setup, self._revision)
        self._registering = True
        self._worker.submit(partial(register_incoming, incoming, setup), then)

    def _fault_of(self, incoming: IncomingSlice, scale: ScaleInUse | None) -> Unusable | None:
        """Why the slice is refused before anybody looks into its image."""
        if not self._outputs:
            return Unusable("bad_frame", self._frame_fault)
        named, plane = self.settings.scanner_frame_id, incoming.plane
        if incoming.fault:
            return Unusable("bad_image", incoming.fault)
        if fault := self._input.fault(time.monotonic()):
            return Unusable("bad_image", fault)
        if plane is not None and named and plane.frame_id not in ("", named):
            return Unusable(
                "bad_image",
                f"slice_pose has the frame_id '{plane.frame_id}', expected the parameter scanner_frame_id, '{named}': "
                "set that to the axes of slice_pose, or leave it empty",
            )
        return Unusable("bad_image", _NO_SPACING) if scale is None else None

    def _axes_of(self, incoming: IncomingSlice) -> str:
        """The frame_id of the axes in which the slice's poses are."""
        return self.settings.scanner_frame_id or incoming.axes

    def _enter(self, frame_id: str, frame_of_reference: str | None) -> None:
        """Note the axes of a slice; in other axes than the last slice's no earlier pose or target means anything."""
        before, self._axes = self._axes, (frame_id, frame_of_reference)
        if before is None or before == self._axes:
            return
        names = [
            f"'{name}'" + (f" (frame of reference {uid or 'unknown'})" if uid is not None else "")
            for name, uid in (before, self._axes)
        ]
        why = f"the slices are in other axes now, {names[1]}, before in {names[0]}"
        self.get_logger().warning(f"{why}: the poses so far are forgotten")
        self._forget_poses()
        self._target.drop(why, unless_in=frame_id if frame_id != before[0] else "")

    def _on_outcome(
        self, incoming: IncomingSlice, setup: SliceSetup, revision: int, outcome: Registered | Unusable
    ) -> None:
        self._registering = False
        try:
            if revision != self._revision:
                # With what was set meanwhile it may be another pose, or none.
                self._begin(incoming)
            elif isinstance(outcome, Unusable):
                self._refuse(incoming, outcome)
            else:
                self._publish(incoming, setup.scale, outcome)
        finally:
            # Whatever becomes of one slice, the next has its turn.
            self._go_on()

    def _publish(self, incoming: IncomingSlice, scale: ScaleInUse, registered: Registered) -> None:
        header = Header(stamp=incoming.stamp, frame_id=self._axes_of(incoming))
        ct_slice, results = registered.ct_slice, registered.results
        if len(results[0].spots_px) >= self.settings.options.min_inliers:
            self._scale.add(replace(results[0].spots, stated_scale=incoming.spacing))
        for output, result in zip(self._outputs, results, strict=True):
            output.publish(result, header, incoming.received_s, self._send_transform)
        statuses = [status_of(result, scale.source, registered.duration_s, header.frame_id) for result in results]
        self._publish_statuses(statuses, header.stamp)
        self._count(header.stamp)
        self._target.answer()
        named = [(result, output.axes) for result, output in zip(results, self._outputs, strict=True)]
        self._pictures.publish(ct_slice, named, header, self._target.of_axes(header.frame_id))

    def _refuse(self, incoming: IncomingSlice, unusable: Unusable) -> None:
        if unusable.traceback:
            self.get_logger().error(f"internal error while registering an image\n{unusable.traceback}")
        self.get_logger().warning(f"image refused: {unusable.message}", throttle_duration_sec=_REPEAT_WARNING_S)
        self._forget_poses()
        self._publish_statuses(self._statuses_of(incoming, unusable), incoming.stamp)
        self._count(incoming.stamp)

    def _skip(self, incoming: IncomingSlice) -> None:
        """Answer a slice that is not registered, since newer ones wait; the latest pose stays as it is."""
        message = f"skipped for a newer slice: it had waited for over {MOST_WAIT_S:g} s"
        self._publish_statuses(self._statuses_of(incoming, Unusable("skipped", message)), incoming.stamp)

    def _statuses_of(self, incoming: IncomingSlice, unusable: Unusable) -> list[DiagnosticStatus]:
        """Statuses, one for each frame, of a slice that did not come to registration."""
        frames = [(output.frame.name, len(output.frame)) for output in self._outputs]
        scale = self._scale.scale_for(incoming.spacing)
        return [
            status_of_unusable(unusable, name, rods, scale, self._axes_of(incoming))
            for name, rods in frames or [(source, 0) for source in self.settings.frame_sources]
        ]

    def _publish_statuses(self, statuses: list[DiagnosticStatus], stamp: Time) -> None:
        if len(statuses) > 1:
            for status in statuses:
                frame = next(pair.value for pair in status.values if pair.key == "frame")
                status.name = f"{status.name} of {frame}"
        # The image's stamp, so that a status can be laid beside its pose.
        self._diagnose(statuses, stamp)

    def _diagnose(self, statuses: list[DiagnosticStatus], stamp: Time) -> None:
        for status in statuses:
            status.name = name_of_status(self.get_fully_qualified_name(), status.name)
        self._diagnostics.publish(DiagnosticArray(header=Header(stamp=stamp), status=statuses))

    def _diagnose_now(self, statuses: list[DiagnosticStatus]) -> None:
        self._diagnose(statuses, self.get_clock().now().to_msg())

    # The stream as a whole.

    def _count(self, stamp: Time) -> None:
        """Count a slice that was answered, with its latency."""
        # Not as a Time of rclpy, which knows none before 1970.
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        latency_ms = (self.get_clock().now().nanoseconds - stamp_ns) / 1e6 if stamp_ns else float("nan")
        self._stream.registered(time.monotonic(), latency_ms)

    def _report_stream(self) -> None:
        now_s = time.monotonic()
        if fault := self._input.fault(now_s):
            self.get_logger().warning(fault, throttle_duration_sec=_REPEAT_WARNING_S)
        waiting = self._input.waiting + len(self._backlog) + self._registering
        counts = StreamCounts(self._input.received, self._backlog.skipped, waiting)
        status = self._stream.report(
            now_s, counts, self.settings.stale_after, self.settings.scanner_frame_id, self._missing()
        )
        self._diagnose_now([status])

    def _missing(self) -> str:
        """What has to be set before a slice can be registered; empty where nothing has."""
        if not self._outputs:
            return f"no frame: {self._frame_fault}"
        if self._scale.configured is None and not self._spacing_stated:
            return "no pixel spacing: set the parameter pixel_spacing, or send slices with slice_spacing"
        return ""

    # Frames and their tables.

    def _frame_to_measure_with(self) -> Frame | None:
        return self._outputs[0].frame if self._outputs else None

    def _load_start_frames(self) -> str:
        """Load the frames; returns why they cannot be, or nothing."""
        try:
            self._checked_frames = load_frames(self.settings.frame_sources)
        except ValueError as error:
            self.get_logger().error(f"no slice can be registered until frame_file is set: {error}")
            return str(error)
        self._use_frames()
        return ""

    def _use_frames(self) -> None:
        for topics in self._topics:
            topics.destroy()
        frames, alone = self._checked_frames, len(self._checked_frames) == 1
        self._topics = [FrameTopics(self, "" if alone else f"{frame.name}/") for frame in frames]
        self._outputs = [FrameOutput(frame, topics, "") for frame, topics in zip(frames, self._topics, strict=True)]
        self._name_axes()
        self._prepare_tables(self._prepared_for or self.settings.scale or _TYPICAL_SCALE)

    def _name_axes(self) -> None:
        """The parameter's name where a frame is alone, else the frame's own."""
        for output in self._outputs:
            output.axes = self.settings.fiducial_frame_id if len(self._outputs) == 1 else output.frame.name

    def _prepare_tables(self, scale: PixelScale) -> None:
        """Begin anew with the tables that slices of this scale would wait for."""
        self._prepared_for, options = scale, self.settings.options
        registrars = [output.registrar for output in self._outputs]
        self._preparation = chain.from_iterable(one.preparation(scale, options) for one in registrars)

    def _prepare_some(self) -> None:
        """Fill some tables while no slice waits."""
        if self._worker.is_free and self._preparation is not None:
            tables = self._preparation
            self._worker.submit(partial(next, tables, _DONE), partial(self._on_prepared, tables))

    def _on_prepared(self, tables: Iterator[None], outcome: object) -> None:
        if outcome is _DONE and tables is self._preparation:
            self._preparation = None
        self._go_on()

    # Parameters.

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
                self._checked_frames = load_frames(settings.frame_sources)
        except Exception as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        names = {parameter.name for parameter in parameters}
        scale_before, self.settings = self.settings.scale, changed_settings(self, [])
        self._revision += 1
        if "calibration_slices" in names:
            self._scale.keep_slices(self.settings.calibration.calibration_slices)
        if "publish_tf" in names:
            self._choose_tf()
        if names & {"frame_file", "frame_files"}:
            self._frame_fault = ""
            self._use_frames()
            self._forget_slices()
        if "fiducial_frame_id" in names:
            self._name_axes()
        if names & {"pixel_spacing", "pixel_shear"}:
            self._apply_scale(scale_before)
        if names & _OF_THE_TABLES:
            self._prepare_tables(self.settings.scale or self._prepared_for or _TYPICAL_SCALE)
        if self._worker.is_free:
            self._go_on()

    def scale_changed(self) -> None:
        """Slices are registered with another scale from now on: no target may rest on a pose of the one before."""
        self._revision += 1
        self._forget_poses()

    def _apply_scale(self, before: PixelScale | None) -> None:
        if self._scale.sets_it_itself:
            # It was measured from slices that are there, which say the same as before; a pose of theirs does not.
            self._forget_poses()
            return
        self._scale.configure()
        if self.settings.scale != before:
            self._forget_slices()

    def _forget_slices(self) -> None:
        """A slice seen under another frame or scale says nothing about this one."""
        self._forget_poses()
        self._scale.sightings.clear()

    def _forget_poses(self) -> None:
        """No target may rest any more on the poses so far."""
        for output in self._outputs:
            output.latest = None


# What the matcher's tables depend on.
_OF_THE_TABLES: Final = {
    "pixel_spacing",
    "spot_noise_px",
    "frame_tolerance_mm",
    "scale_tolerance",
    "matcher",
    "nominal_orientation",
    "max_rotation_deg",
    "min_inliers",
}
_DONE: Final = object()
_NO_TF2: Final = "publish_tf is true, but tf2_ros cannot be imported, expected the package ros-jazzy-tf2-ros"
_NO_SPACING: Final = (
    "pixel_spacing is not set, and the slice came without slice_spacing: set the parameter to [sx, sy] in mm/pixel"
)


def main() -> int:
    """Entry point of `register_node`."""
    return run(RegisterNode)


if __name__ == "__main__":
    sys.exit(main())
