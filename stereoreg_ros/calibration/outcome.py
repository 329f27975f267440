"""The outcome of a calibration: a scale, or a refusal with its reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale


@dataclass(frozen=True, eq=False)
class Calibration:
    """An accepted scale. True as a condition.

    scale, previous_scale: mm/pixel; standard_errors: of (sx, sy) and, where it was measured, the shear, mm/pixel;
    covariance: (2, 2) or (3, 3), mm^2/pixel^2; frame_errors: the part of standard_errors that the tolerance of the
    frame's rods brings, which no further slice makes smaller; slices, rods: from how many slices, and how many spots in
    all; residual_before_px, residual_after_px: RMS over these spots, with the frame as in its file; poses:
    slice_from_frame of the slices used; message: what an operator has to know, in one line.
    """

    scale: PixelScale
    previous_scale: PixelScale
    standard_errors: tuple[float, ...]
    covariance: Array
    frame_errors: tuple[float, ...]
    slices: int
    rods: int
    residual_before_px: float
    residual_after_px: float
    poses: tuple[Pose, ...]
    message: str

    def __bool__(self) -> Literal[True]:
        return True


@dataclass(frozen=True)
class CalibrationRefusal:
    """No scale that can be trusted; message: why, with figures. False as a condition."""

    message: str

    def __bool__(self) -> Literal[False]:
        return False
