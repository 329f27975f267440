"""The parameters of `register_node`: one table, declared from it and validated as a whole."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from stereoreg_ros.geometry.slice import SPACING_RANGE_MM, PixelScale
from stereoreg_ros.nodes.common.parameters import ParameterError, declare, entries_of, plain, setting
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions


@dataclass(frozen=True)
class NodeSettings:
    """The settings of `register_node`, valid as a whole.

    Raises ValueError, naming the parameter, what was found and what was expected.
    """

    options: RegistrationOptions
    calibration: CalibrationOptions
    frame_file: str = setting("cube6", "frame file: a path, or the name of a shipped frame")
    frame_files: tuple[str, ...] = setting(
        (), "files of several frames, in place of frame_file; each gets topics under its name"
    )
    pixel_spacing: tuple[float, float] = setting(
        (0.0, 0.0),
        "pixel spacing [sx, sy] of images without one of their own: between columns and between rows, mm; [0, 0]: none",
    )
    pixel_shear: float = setting(0.0, "shear of the pixel grid, mm/pixel", -10.0, 10.0)
    rescale_slope: float = setting(1.0, "HU = value * rescale_slope + rescale_intercept; not 0", -1e6, 1e6)
    rescale_intercept: float = setting(0.0, "HU = value * rescale_slope + rescale_intercept", -1e6, 1e6)
    scanner_frame_id: str = setting("", "frame_id of the scanner in all messages; empty: the image's frame_id")
    fiducial_frame_id: str = setting("stereotactic_frame", "name of the stereotactic frame's axes in messages")
    slice_pose_required: bool = setting(
        False, "whether an image must come with a slice_pose, even before anybody publishes one"
    )
    publish_tf: bool = setting(False, "whether to send each pose to TF too, which needs tf2_ros")
    max_pose_age: float = setting(
        60.0, "oldest pose that target_in_frame may rest on, s since its slice came", 0.1, 1e6
    )
    max_target_age: float = setting(
        1800.0, "oldest target that is still answered, s since it came; the patient may have moved", 1.0, 1e6
    )
    stale_after: float = setting(10.0, "how long no slice may come before the stream counts as stale, s", 0.1, 1e6)
    calibration_timeout: float = setting(5.0, "how long recalibration waits for slices that it can use, s", 0.0, 600.0)
    calibration_file: str = setting(
        "", "file that keeps a measured pixel spacing over a restart; empty: it is forgotten"
    )

    def __post_init__(self) -> None:
        for entry in entries_of(type(self)):
            value = getattr(self, entry.name)
            if entry.low is not None and entry.high is not None and not entry.low <= value <= entry.high:
                raise ValueError(f"{entry.name} is {value!r}, expected a number from {entry.low:g} to {entry.high:g}")
        low, high = SPACING_RANGE_MM
        if len(self.pixel_spacing) != 2:
            raise ValueError(f"pixel_spacing has {len(self.pixel_spacing)} numbers, expected two: [sx, sy] in mm/pixel")
        numbers = all(isinstance(spacing, float | int) for spacing in self.pixel_spacing)
        in_range = numbers and all(low <= spacing <= high for spacing in self.pixel_spacing)
        if self.pixel_spacing != (0.0, 0.0) and not in_range:
            raise ValueError(
                f"pixel_spacing is {list(self.pixel_spacing)}, "
                f"expected two positive numbers of mm/pixel, from {low:g} to {high:g}"
            )
        if self.rescale_slope == 0 or not math.isfinite(self.rescale_slope):
            raise ValueError(f"rescale_slope is {self.rescale_slope!r}, expected a number that is not 0")
        # An empty list in a parameter file arrives as nothing at all.
        names = () if self.frame_files is None else self.frame_files
        object.__setattr__(self, "frame_files", names)
        if not isinstance(names, tuple) or not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"frame_files is {names!r:.200}, expected a list of names or paths")
        for name in ("frame_file", "fiducial_frame_id"):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty, expected a name")

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any]) -> NodeSettings:
        """Settings from the values of all parameters by name."""

        def of(settings: type) -> dict[str, Any]:
            return {entry.name: values[entry.name] for entry in entries_of(settings) if entry.name in values}

        options, calibration = (
            RegistrationOptions(**of(RegistrationOptions)),
            CalibrationOptions(**of(CalibrationOptions)),
        )
        return cls(options=options, calibration=calibration, **of(cls))

    @property
    def frame_sources(self) -> tuple[str, ...]:
        """Files or names of the frames to be registered."""
        return self.frame_files or (self.frame_file,)

    @property
    def in_force(self) -> str:
        """The frames, and the limits that a pose and a target have to keep, in one line."""
        options = self.options
        within = f"within {options.max_rotation_deg:g} degrees of nominal_orientation"
        return (
            f"frame {', '.join(self.frame_sources)}; "
            f"limits: {within if options.max_rotation_deg < 180.0 else 'any orientation'}, "
            f"target error up to {options.max_target_error_mm:g} mm, "
            f"standard deviation of the position up to {options.max_position_std_mm:g} mm, "
            f"{options.min_inliers} rods or more, false alarms up to 10^{options.max_log10_false_alarms:g}, "
            f"poses up to {self.max_pose_age:g} s old, targets up to {self.max_target_age:g} s"
        )

    @property
    def scale(self) -> PixelScale | None:
        """The pixel scale of images that come without one; None where pixel_spacing is not set."""
        return PixelScale(*self.pixel_spacing, self.pixel_shear) if self.pixel_spacing != (0.0, 0.0) else None


ENTRIES = (*entries_of(NodeSettings), *entries_of(RegistrationOptions), *entries_of(CalibrationOptions))


def declare_settings(node: Node) -> NodeSettings:
    """Declare all parameters of `register_node` and return its settings at start; raises ParameterError."""
    values = declare(node, ENTRIES)
    try:
        return NodeSettings.from_parameters(values)
    except ValueError as error:
        raise ParameterError(str(error)) from None


def changed_settings(node: Node, changes: Sequence[Parameter]) -> NodeSettings:
    """The node's settings as they would be with `changes`; ValueError where they would not be valid.

    Parameters that are not in the table, which rclpy declares itself, are passed over.
    """
    values = {entry.name: plain(node.get_parameter(entry.name)) for entry in ENTRIES}
    for parameter in changes:
        # rclpy would not let go of a static parameter, but of one of dynamic type, and nobody could read that again.
        if parameter.name in values and parameter.type_ == Parameter.Type.NOT_SET:
            raise ValueError(f"{parameter.name} is not set, expected a value")
    values |= {parameter.name: plain(parameter) for parameter in changes if parameter.name in values}
    return NodeSettings.from_parameters(values)
