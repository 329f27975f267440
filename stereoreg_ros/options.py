"""The options of a registration: one table for the Python call, the command line and the node's parameters."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np

from stereoreg_ros.geometry.pose import rotation_from_quaternion

AUTO: Final = "auto"
MATCHERS: Final = ("three_line", "maurin2009")
# No point that matters is farther from the frame; one that is was given in other units.
_FARTHEST_MM: Final = 10_000.0
# How far a pixel spacing may be off, as a share: what a scanner states with its slices, and what somebody typed in.
_STATED_CHANGE: Final = 0.005
_TYPED_CHANGE: Final = 0.15


def _option(
    default: Any, description: str, low: float | None = None, high: float | None = None, word: str | None = None
) -> Any:
    """A field with its description for users; word: what it may be instead of a number."""
    return field(default=default, metadata={"description": description, "low": low, "high": high, "word": word})


@dataclass(frozen=True)
class RegistrationOptions:
    """How to find and judge a registration; the fields are the node's parameters of the same names.

    Raises ValueError, naming the field, what was found and what was expected.
    """

    threshold: float | str = _option(
        AUTO,
        "HU above which a pixel may belong to a rod's spot, 2000 in the paper; 'auto': what stands out from around it",
        -32768.0,
        65535.0,
        AUTO,
    )
    min_spot_area_mm2: float = _option(0.5, "smallest area of a spot, mm^2", 0.0, 1000.0)
    max_spot_area_mm2: float = _option(80.0, "largest area of a spot, mm^2", 0.01, 10000.0)
    spot_noise_px: float = _option(
        0.3,
        "standard deviation per axis of a spot's centre, pixel; of one that shows to be worse, more",
        0.001,
        10.0,
    )
    frame_tolerance_mm: float = _option(
        0.2,
        "standard deviation per axis of the ends of rods whose tolerance the frame file does not state, mm",
        0.0,
        10.0,
    )
    scale_tolerance: float = _option(0.002, "standard deviation of the pixel spacing, as a fraction of it", 0.0, 0.1)
    slice_thickness_mm: float = _option(
        0.0, "thickness of the slice, mm: a leaning rod's spot is as long as it has to be; 0: not known", 0.0, 50.0
    )
    min_inliers: int = _option(4, "fewest rods that must have a spot", 4, 1000)
    matcher: str = _option("three_line", f"how spots are matched to rods: {' | '.join(MATCHERS)}")
    max_log10_false_alarms: float = _option(
        -6.0, "log10 of the number of such matches that chance may bring before a pose is refused", -300.0, 0.0
    )
    nominal_orientation: tuple[float, float, float, float] = _option(
        (0.0, 0.0, 0.0, 1.0), "how the frame roughly stands in the scanner: quaternion x, y, z, w"
    )
    max_rotation_deg: float = _option(
        180.0, "largest angle from the nominal orientation, degrees; 180: nothing is known", 0.1, 180.0
    )
    max_position_std_mm: float = _option(
        10.0, "largest standard deviation of the frame origin's position along its worst axis, mm", 0.001, 1000.0
    )
    target_in_frame_mm: tuple[float, float, float] = _option(
        (0.0, 0.0, 0.0), "the point whose error counts, such as the needle's tip: x, y, z in the frame's axes, mm"
    )
    max_target_error_mm: float = _option(
        3.0, "largest radius of the ball that holds 95 % of the errors at the target, mm", 0.001, 1000.0
    )

    def __post_init__(self) -> None:
        _check_ranges(self)
        if int(self.min_inliers) != self.min_inliers:
            raise ValueError(f"min_inliers is {self.min_inliers!r}, expected a whole number")
        if not isinstance(self.matcher, str) or self.matcher not in MATCHERS:
            raise ValueError(f"matcher is {self.matcher!r:.200}, expected one of {', '.join(MATCHERS)}")
        if self.min_spot_area_mm2 >= self.max_spot_area_mm2:
            raise ValueError(
                f"min_spot_area_mm2 is {self.min_spot_area_mm2:g}, expected less than "
                f"max_spot_area_mm2, which is {self.max_spot_area_mm2:g}"
            )
        try:
            rotation_from_quaternion(self.nominal_orientation)
        except (ValueError, TypeError) as error:
            raise ValueError(f"nominal_orientation: {error}") from None
        object.__setattr__(self, "target_in_frame_mm", _checked_point("target_in_frame_mm", self.target_in_frame_mm))
        object.__setattr__(self, "min_inliers", int(self.min_inliers))
        object.__setattr__(self, "nominal_orientation", tuple(float(q) for q in self.nominal_orientation))


@dataclass(frozen=True)
class CalibrationOptions:
    """How to measure the pixel scale; the fields are the node's parameters of the same names.

    Raises ValueError, naming the field, what was found and what was expected.
    """

    calibration_slices: int = _option(10, "how many of the last slices recalibration uses", 1, 200)
    calibrate_shear: bool = _option(False, "whether recalibration measures the shear of the pixel grid too")
    calibration_max_change: float | str = _option(
        AUTO,
        "largest change of the pixel spacing that recalibration may make, as a share of it; 'auto': "
        f"{_STATED_CHANGE:g} where the spacing came with the slices, {_TYPED_CHANGE:g} where it was typed in",
        0.001,
        0.5,
        AUTO,
    )

    def __post_init__(self) -> None:
        _check_ranges(self)
        if int(self.calibration_slices) != self.calibration_slices:
            raise ValueError(f"calibration_slices is {self.calibration_slices!r}, expected a whole number")
        if not isinstance(self.calibrate_shear, bool):
            raise ValueError(f"calibrate_shear is {self.calibrate_shear!r}, expected true or false")
        object.__setattr__(self, "calibration_slices", int(self.calibration_slices))

    def largest_change(self, came_with_slices: bool) -> float:
        """Largest change of the pixel spacing, as a share of it: as was set, or by where the spacing came from."""
        if isinstance(self.calibration_max_change, str):
            return _STATED_CHANGE if came_with_slices else _TYPED_CHANGE
        return self.calibration_max_change


def _checked_point(name: str, value: Any) -> tuple[float, float, float]:
    try:
        point = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not (np.abs(point) <= _FARTHEST_MM).all():
        raise ValueError(
            f"{name} is {value!r:.200}, expected three numbers of mm from {-_FARTHEST_MM:g} to {_FARTHEST_MM:g}"
        )
    return (float(point[0]), float(point[1]), float(point[2]))


def _check_ranges(options: RegistrationOptions | CalibrationOptions) -> None:
    for entry in fields(options):
        low, high = entry.metadata["low"], entry.metadata["high"]
        value = getattr(options, entry.name)
        word = entry.metadata["word"]
        if low is None or (word is not None and isinstance(value, str) and value == word):
            continue
        number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
        if not number or not low <= value <= high:
            or_word = f", or '{word}'" if word else ""
            raise ValueError(f"{entry.name} is {value!r:.200}, expected a number from {low:g} to {high:g}{or_word}")
