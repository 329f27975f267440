"""The pixel scale while the node runs: stated by slices, configured, measured, kept in a file, gone back on."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from rclpy.node import Node
from rclpy.parameter import Parameter

from stereoreg_ros.calibration.calibrate import Calibration
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


@dataclass(frozen=True, eq=False)
class ScaleInUse:
    """The pixel scale that a slice is registered with, and where it comes from.

    covariance: of a measured scale, see `register_spots`; None of a configured one, known to `scale_tolerance`.
    """

    scale: PixelScale
    source: Literal["configured", "measured"] = "configured"
    covariance: Array | None = None


class _Registering(Protocol):
    """What the keeper asks of the node: its settings, and to take note of a scale that no parameter shows."""

    @property
    def settings(self) -> NodeSettings: ...
    def scale_changed(self) -> None: ...


class ScaleKeeper:
    """Which scale a slice is registered with: its own, or the one configured where it brings none; or what was measured
    in place of that one.

    sightings: the last slices that the scale can be measured from, all of one scale.
    """

    def __init__(self, node: Node, registering: _Registering) -> None:
        self.sightings: deque[SliceSpots] = deque(maxlen=registering.settings.calibration.calibration_slices)
        self._node, self._registering = node, registering
        self._configured = registering.settings.scale
        self._record: CalibrationRecord | None = None
        # Of the sightings.
        self._stated: PixelScale | None = None
        self._sets_it_itself = False

    @property
    def configured(self) -> PixelScale | None:
        """The parameters' scale, before a measured one took its place there; None where none was set."""
        return self._configured

    @property
    def sets_it_itself(self) -> bool:
        """Whether it is the keeper that is setting the parameters just now."""
        return self._sets_it_itself

    def scale_for(self, stated: PixelScale | None) -> ScaleInUse | None:
        """The scale for a slice that states this one, or None; None where nobody has said what a pixel is."""
        nominal = stated or self._configured
        if nominal is None:
            return None
        if self._record is not None and self._record.replaces(nominal):
            return ScaleInUse(self._record.scale, "measured", np.array(self._record.covariance))
        return ScaleInUse(nominal)

    @property
    def to_measure(self) -> ScaleInUse | None:
        """The scale of the sightings, or of the slices to come, which a measured one would replace."""
        return self.scale_for(self._stated)

    def add(self, spots: SliceSpots) -> None:
        """Take a slice to measure from; slices of another scale say nothing about this one's."""
        if spots.stated_scale != self._stated:
            self.sightings.clear()
            self._stated = spots.stated_scale
        self.sightings.append(spots)

    def keep_slices(self, count: int) -> None:
        """Keep the last `count` slices to measure from."""
        self.sightings = deque(self.sightings, maxlen=count)

    def configure(self) -> None:
        """Somebody has set the scale's parameters: what was measured counts on only where the file has it."""
        self._configured, self._record = self._registering.settings.scale, None
        self.load()

    def load(self) -> None:
        """Take up what was measured before, where that can be believed, for the slices that it was measured for."""
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
        self._record = record
        old, new, now = record.configured, record.scale, self._configured
        measured = (
            f"pixel spacing [{new.sx:.6g}, {new.sy:.6g}] in place of [{old.sx:.6g}, {old.sy:.6g}], as measured on "
            f"{record.date}, from {path}"
        )
        if now is None:
            log.info(measured)
        elif not record.replaces(now):
            log.warning(
                f"calibration_file is not used for images without a spacing of their own: {path} was measured in place "
                f"of the pixel_spacing [{old.sx:.6g}, {old.sy:.6g}], which is [{now.sx:.6g}, {now.sy:.6g}]"
            )
        elif fault := self._set(new):
            self._record = None
            log.warning(f"calibration_file is not used: {path}: {fault}")
        else:
            log.info(measured)

    def take(self, outcome: Calibration, frame: Frame) -> tuple[bool, str]:
        """Use a scale measured from the sightings; returns whether it could be set, and a sentence for the operator."""
        nominal = self._stated or self._configured
        if nominal is None:
            return False, "the measured scale cannot be set: there is no pixel spacing that it could replace"
        before, self._record = self._record, CalibrationRecord.of(outcome, nominal, frame.name)
        if fault := self._set(outcome.scale):
            self._record = before
            return False, f"the measured scale cannot be set: {fault}"
        self._configured = nominal
        if not self._registering.settings.calibration_file:
            return True, outcome.message
        path = Path(self._registering.settings.calibration_file)
        try:
            save_calibration(path, self._record)
        except OSError as error:
            self._node.get_logger().warning(f"calibration_file {path} cannot be written: {error}")
            return True, f"{outcome.message}; but it will be forgotten: {path} cannot be written: {error.strerror}"
        return True, outcome.message

    def reset(self) -> tuple[bool, str]:
        """Forget what was measured; returns whether that is so now, and the sentence for the operator."""
        scale = self._configured
        if scale is None and self._record is None:
            return False, "pixel_spacing has not been configured, nothing to go back to"
        if self._registering.settings.calibration_file:
            path = Path(self._registering.settings.calibration_file)
            try:
                remove_calibration(path)
            except OSError as error:
                return False, f"calibration_file {path} cannot be removed: {error.strerror}; nothing was changed"
        self._record = None
        if scale is None:
            self._registering.scale_changed()
            return True, "slices are registered with the pixel spacing that they state"
        fault = self._set(scale)
        return not fault, fault or f"pixel_spacing is the configured one, [{scale.sx:.9g}, {scale.sy:.9g}] mm/pixel"

    def _set(self, scale: PixelScale) -> str:
        """Change the scale's parameters as one, for whoever watches them; returns why they cannot be, or nothing."""
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
        return "" if outcome.successful else str(outcome.reason)
