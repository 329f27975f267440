"""The pixel scale while the node runs: told, measured, kept in a file, gone back on."""

from __future__ import annotations

import time
import traceback
from collections import deque
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from stereoreg_ros.calibration.file import (
    CalibrationFileError,
    CalibrationRecord,
    load_calibration,
    remove_calibration,
    save_calibration,
)
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.recalibration import NextTurn, Recalibration

_POLL_S = 0.002
_SAME_SPACING = 1e-4


class _Registering(Protocol):
    """What the keeper asks of the node: its settings, the frame to measure with, and whether somebody sends slices."""

    @property
    def settings(self) -> NodeSettings: ...
    @property
    def frame(self) -> Frame | None: ...
    def images_come(self) -> bool: ...


class ScaleKeeper:
    """The services `~/recalibrate` and `~/reset_calibration`, and where the scale in use comes from.

    source: `configured` or `measured`; covariance: of a measured scale, None of one that is known to `scale_tolerance`.
    """

    def __init__(self, node: Node, registering: _Registering) -> None:
        self.source: Literal["configured", "measured"] = "configured"
        self.covariance: Array | None = None
        self.sightings: deque[SliceSpots] = deque(maxlen=registering.settings.calibration.calibration_slices)
        self._node, self._registering = node, registering
        self._configured = registering.settings.scale
        self._recalibration: Recalibration | None = None
        self._sets_it_itself = False
        # A call goes on over many turns of the executor, and must keep neither slices nor other calls from theirs.
        node.create_service(Trigger, "~/recalibrate", self._on_recalibrate, callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, "~/reset_calibration", self._on_reset_calibration)

    @property
    def configured(self) -> PixelScale | None:
        """What was told or configured last; None where nothing was. In its place a measured scale may be in use."""
        return self._configured

    def stands_for(self, spacing: PixelScale) -> bool:
        """Whether the scale in use is the right one for a slice that came with this spacing."""
        if self._configured is None:
            return False
        ours, slices = ((one.sx, one.sy, one.shear) for one in (self._configured, spacing))
        return np.allclose(ours, slices, rtol=_SAME_SPACING, atol=_SAME_SPACING * spacing.sx)

    def scale_was_set(self, before: PixelScale | None) -> bool:
        """The scale's parameters were set; returns whether somebody else did, and the scale in use is another now."""
        if self._sets_it_itself:
            return False
        self._configured, self.source, self.covariance = self._registering.settings.scale, "configured", None
        # Whoever sends slices tells their spacing, and tells it again after every restart.
        self.load()
        return self._registering.settings.scale != before

    def keep_slices(self, count: int) -> None:
        """Keep the last `count` slices to measure from."""
        self.sightings = deque(self.sightings, maxlen=count)

    def load(self) -> None:
        """Take up what was measured in place of the configured scale, where that can be trusted."""
        settings, log = self._registering.settings, self._node.get_logger()
        if not settings.calibration_file:
            return
        path = Path(settings.calibration_file)
        try:
            record = load_calibration(path)
        except CalibrationFileError as error:
            log.warning(f"calibration_file is not used, the configured pixel_spacing is: {error}")
            return
        if record is None:
            return
        configured = settings.scale
        if configured is None or not record.replaces(configured):
            now = "not told" if configured is None else f"[{configured.sx:.6g}, {configured.sy:.6g}]"
            log.warning(
                f"calibration_file is not used: {path} was measured in place of the pixel_spacing "
                f"[{record.configured.sx:.6g}, {record.configured.sy:.6g}], which is {now}"
            )
            return
        fault = self._set(record.scale, "measured", np.array(record.covariance))
        if fault:
            log.warning(f"calibration_file is not used: {path}: {fault}")
            return
        log.info(
            f"pixel_spacing [{record.scale.sx:.6g}, {record.scale.sy:.6g}] as measured on {record.date}, from {path}"
        )

    async def _on_recalibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running already, wait for its answer"
            return response
        settings, frame = self._registering.settings, self._registering.frame
        images_come = self._registering.images_come()
        if frame is None or settings.scale is None or not (self.sightings or images_come):
            response.success, response.message = False, "no slice has been accepted yet, nothing to calibrate from"
            return response
        deadline_s = time.monotonic() + (settings.calibration_timeout if images_come else 0.0)
        self._recalibration = Recalibration(frame, settings.scale, settings.options, settings.calibration, deadline_s)
        try:
            response.success, response.message = await self._recalibrate(self._recalibration)
        except Exception as error:
            self._node.get_logger().error(f"internal error in recalibrate\n{traceback.format_exc()}")
            response.success, response.message = False, f"internal error: {type(error).__name__}: {error}"
        finally:
            self._recalibration.close()
            self._recalibration = None
        return response

    async def _recalibrate(self, recalibration: Recalibration) -> tuple[bool, str]:
        """Whether the scale was changed, and the sentence for the operator."""
        while (outcome := recalibration.poll(self.sightings, time.monotonic())) is None:
            # Slices have their turn meanwhile; the sleep leaves the processor to the thread that measures.
            time.sleep(_POLL_S)
            await NextTurn()
        settings = self._registering.settings
        if self._registering.frame is not recalibration.frame or settings.scale != recalibration.scale:
            return False, "calibration refused: the frame or the pixel spacing was changed meanwhile"
        if not outcome:
            return False, outcome.message
        configured = self._configured or recalibration.scale
        fault = self._set(outcome.scale, "measured", outcome.covariance)
        if fault:
            return False, f"the measured scale cannot be set: {fault}"
        if not settings.calibration_file:
            return True, outcome.message
        path = Path(settings.calibration_file)
        try:
            save_calibration(path, CalibrationRecord.of(outcome, configured, recalibration.frame.name))
        except OSError as error:
            self._node.get_logger().warning(f"calibration_file {path} cannot be written: {error}")
            return True, f"{outcome.message}; but it will be forgotten: {path} cannot be written: {error.strerror}"
        return True, outcome.message

    def _on_reset_calibration(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self._reset()
        return response

    def _reset(self) -> tuple[bool, str]:
        """Whether the configured scale is in use again, and the sentence for the operator."""
        if self._recalibration is not None:
            return False, "a recalibration is running, wait for its answer"
        scale = self._configured
        if scale is None:
            return False, "pixel_spacing has not been configured, nothing to go back to"
        if self._registering.settings.calibration_file:
            path = Path(self._registering.settings.calibration_file)
            try:
                remove_calibration(path)
            except OSError as error:
                return False, f"calibration_file {path} cannot be removed: {error.strerror}; nothing was changed"
        fault = self._set(scale, "configured", None)
        return not fault, fault or f"pixel_spacing is the configured one, [{scale.sx:.9g}, {scale.sy:.9g}] mm/pixel"

    def _set(self, scale: PixelScale, source: Literal["configured", "measured"], covariance: Array | None) -> str:
        """Change the scale's parameters as one; returns why they cannot be, or nothing."""
        self._sets_it_itself = True
        try:
            outcome = self._node.set_parameters_atomically(
                [
                    Parameter("pixel_spacing", value=[float(scale.sx), float(scale.sy)]),
                    Parameter("pixel_shear", value=float(scale.shear)),
                ]
            )
        finally:
            self._sets_it_itself = False
        if outcome.successful:
            self.source, self.covariance = source, covariance
        return str(outcome.reason)
