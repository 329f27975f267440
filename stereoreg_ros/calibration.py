"""The scanner's pixel scale from an identified slice, accepted only if it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.result import Registration
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import (
    ScaleSolution,
    calibrate_linear,
    calibrate_newton_raphson,
    calibration_covariance,
)

_MIN_LINES = 5
# A scale whose standard error is larger than this share of it is not a measurement worth having.
_MAX_RELATIVE_ERROR = 0.02
# A scanner's scale is not off by more; a larger change means wrong matches or a wrong frame.
_MAX_RELATIVE_CHANGE = 0.15


@dataclass(frozen=True)
class Calibration:
    """An accepted scale. True as a condition.

    scale, previous_scale: mm/pixel; standard_errors: of (sx, sy), mm/pixel; residual_before_px, residual_after_px:
    RMS over the rods' spots; message: one sentence for an operator.
    """

    scale: PixelScale
    previous_scale: PixelScale
    standard_errors: tuple[float, float]
    residual_before_px: float
    residual_after_px: float
    message: str

    def __bool__(self) -> Literal[True]:
        return True


@dataclass(frozen=True)
class CalibrationRefusal:
    """No scale that can be trusted; message: why, with figures. False as a condition."""

    message: str

    def __bool__(self) -> Literal[False]:
        return False


def calibrate(registration: Registration) -> Calibration | CalibrationRefusal:
    """Pixel scale (sx, sy) from an accepted slice: linear, then Newton-Raphson (Maurin 2009, section 3)."""
    frame, previous = registration.frame, registration.scale
    lines = np.array([match.line_index for match in registration.matches])
    spots_px = np.array([match.spot_px for match in registration.matches])
    if len(lines) < _MIN_LINES:
        return CalibrationRefusal(
            f"calibration refused: {len(lines)} rods are identified in the latest slice, {_MIN_LINES} are needed"
        )
    try:
        linear = calibrate_linear(frame, lines, spots_px)
        solution = calibrate_newton_raphson(frame, lines, spots_px)
    except DegenerateArrangementError as fault:
        return CalibrationRefusal(f"calibration refused: the rods do not fix the scale, {fault}")
    if not solution.converged:
        return CalibrationRefusal(
            f"calibration refused: no convergence in {solution.iterations} Newton-Raphson steps, the linear solution "
            f"is {linear.scale.sx:.4f}, {linear.scale.sy:.4f} mm/pixel"
        )
    scale = solution.scale
    for name, new, old in (("sx", scale.sx, previous.sx), ("sy", scale.sy, previous.sy)):
        if abs(new / old - 1) > _MAX_RELATIVE_CHANGE:
            return CalibrationRefusal(
                f"calibration refused: {name} would change from {old:.4f} to {new:.4f} mm/pixel, "
                f"more than {100 * _MAX_RELATIVE_CHANGE:.0f} %"
            )
    errors = _standard_errors(frame, lines, solution, registration.options.spot_noise_px)
    for name, new, error in (("sx", scale.sx, errors[0]), ("sy", scale.sy, errors[1])):
        if not error <= _MAX_RELATIVE_ERROR * new:
            return CalibrationRefusal(
                f"calibration refused: {name} = {new:.4f} mm/pixel has a standard error of {error:.4f} mm/pixel, more "
                f"than {100 * _MAX_RELATIVE_ERROR:.0f} %"
            )
    before = registration.estimate.residual_rms_px
    after = _residual_rms_px(frame, lines, spots_px, solution)
    # With two more unknowns a true improvement cannot end up worse but for the criterion: in the frame, not the image.
    if after > before + registration.options.spot_noise_px:
        return CalibrationRefusal(
            f"calibration refused: the residual would grow from {before:.3f} to {after:.3f} pixel RMS"
        )
    message = (
        f"pixel spacing changed from ({previous.sx:.4f}, {previous.sy:.4f}) to ({scale.sx:.4f} +- {errors[0]:.4f}, "
        f"{scale.sy:.4f} +- {errors[1]:.4f}) mm/pixel from 1 slice with {len(lines)} rods; residual {before:.3f} pixel "
        f"before, {after:.3f} pixel after"
    )
    return Calibration(scale, previous, errors, before, after, message)


def _residual_rms_px(frame: Frame, lines: NDArray[np.intp], spots_px: Array, solution: ScaleSolution) -> float:
    predicted, _ = project(frame, _slice_from_frame(solution), solution.scale)
    return float(np.sqrt(((predicted[lines] - spots_px) ** 2).sum(axis=1).mean()))


def _standard_errors(
    frame: Frame, lines: NDArray[np.intp], solution: ScaleSolution, noise_px: float
) -> tuple[float, float]:
    """Standard errors of (sx, sy) from the spots' noise, the pose being unknown too."""
    covariance = calibration_covariance(frame, lines, _slice_from_frame(solution), solution.scale, noise_px)
    return float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[1, 1]))


def _slice_from_frame(solution: ScaleSolution) -> Pose:
    return solution.frame_from_slice.inverse()
