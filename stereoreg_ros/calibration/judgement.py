"""The only place that accepts a measured scale or refuses it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc

from stereoreg_ros.calibration.measured import Explained, identified_in
from stereoreg_ros.calibration.outcome import Calibration, CalibrationRefusal
from stereoreg_ros.geometry.pose import Pose, nearest_rotation
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import CalibrationOptions
from stereoreg_ros.solvers.identified import ScaleAndPoses
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine
from stereoreg_ros.solvers.tolerant_calibration import calibrate_tolerantly

# A scale whose standard error is larger than this share of it is not a measurement worth having.
MAX_RELATIVE_ERROR = 0.01
# Residuals that must be left over to judge a scale by.
_LEAST_FREEDOM = 4
# Probability of a residual as large by the stated noise alone, below which it is not the noise.
_IMPLAUSIBLE = 1e-6
# Standard deviations by which the change of sx must differ from that of sy before the frame's size explains neither.
_APART = 3.0
_SCALE_OR_SIZE = "Slices cannot distinguish the scale from the size of the frame"


def judge(found: Explained, previous: PixelScale, calibration: CalibrationOptions) -> Calibration | CalibrationRefusal:
    kept = _refined(found, previous)
    fault = _untrusted(found, previous, kept)
    if fault:
        return CalibrationRefusal(f"calibration refused: {fault}")
    scale, errors, stated = found.joint.scale, found.errors, found.stated
    reference = stated or previous
    measured = f"({scale.sx:.4f} +- {errors[0]:.4f}, {scale.sy:.4f} +- {errors[1]:.4f}) mm/pixel"
    size, of_frame = _other_size(reference, scale, errors), _of_frame(found)
    limit = calibration.largest_change(came_with_slices=stated is not None)
    change = max(abs(scale.sx / reference.sx - 1), abs(scale.sy / reference.sy - 1))
    if change > limit:
        origin = "came with the slices" if stated is not None else "is in use"
        return CalibrationRefusal(
            f"calibration refused: scanner, or frame file? The pixel spacing that {origin} is ({reference.sx:.4f}, "
            f"{reference.sy:.4f}) mm/pixel, the one measured is {measured}: {100 * change:.1f} % off, more than "
            f"{100 * limit:.3g} %; if the first is right, the frame {size}. {_SCALE_OR_SIZE}, and {of_frame}; measure "
            "the frame, or set calibration_max_change to allow such a change"
        )
    slices = len(found.matched)
    shear = f", shear {scale.shear:.4f} +- {errors[2]:.4f}" if len(errors) > 2 else ""
    before, after = _rms_px(found, kept, previous), _rms_px(found, _refined(found, scale), scale)
    message = (
        f"pixel spacing changed from ({previous.sx:.4f}, {previous.sy:.4f}) to {measured}{shear} from {slices} "
        f"slice{'s' if slices > 1 else ''} with {found.rods} rods; residual {before:.3f} pixel before, {after:.3f} "
        f"pixel after; {of_frame}. {_SCALE_OR_SIZE}: if ({reference.sx:.4f}, {reference.sy:.4f}) is right, the frame "
        f"{size}"
    )
    at = found.joint.at
    poses = tuple(Pose(nearest_rotation(r), t) for r, t in zip(at.rotations, at.translations, strict=True))
    return Calibration(
        scale,
        previous,
        errors,
        found.covariance,
        found.frame_errors,
        slices,
        found.rods,
        before,
        after,
        poses,
        message,
    )


def _untrusted(found: Explained, previous: PixelScale, kept: Refined) -> str:
    """Why what was found cannot be trusted, or nothing. kept: the poses with the previous scale."""
    joint, scale, options = found.joint, found.joint.scale, found.matched[0].options
    if not joint.converged:
        return "the joint solution did not converge"
    if joint.degrees_of_freedom < _LEAST_FREEDOM:
        return (
            f"{found.rods} rods in {len(found.matched)} slice leave too little to check the scale by, another slice or "
            "another rod is needed"
        )
    if chdtrc(joint.degrees_of_freedom, joint.chi_square) < _IMPLAUSIBLE:
        rms = math.sqrt(float((joint.residuals_px**2).sum()) / found.rods)
        return (
            f"the residual of {rms:.3f} pixel RMS cannot come from the stated spot noise of {options.spot_noise_px:g} "
            f"pixel and rod ends that are known to {_tolerance(found)}"
        )
    for name, new, error in (("sx", scale.sx, found.errors[0]), ("sy", scale.sy, found.errors[1])):
        if not error <= MAX_RELATIVE_ERROR * new:
            return (
                f"{name} = {new:.4f} mm/pixel has a standard error of {error:.4f} mm/pixel, more than "
                f"{100 * MAX_RELATIVE_ERROR:.3g} %"
            )
    identified = identified_in(found.frame, found.matched)
    at = ScaleAndPoses(previous, kept.rotations, kept.translations)
    before = calibrate_tolerantly(found.frame, found.tolerances_mm, identified, at, measured=0).chi_square
    if joint.chi_square > before + 1e-6:
        return (
            f"the slices fit ({previous.sx:.4f}, {previous.sy:.4f}) mm/pixel with a chi-square of {before:.1f}, better "
            f"than ({scale.sx:.4f}, {scale.sy:.4f}) mm/pixel with {joint.chi_square:.1f}"
        )
    return ""


def _other_size(stated: PixelScale, measured: PixelScale, errors: Sequence[float]) -> str:
    """What the frame's size would have to be for the stated scale to be right: a larger frame has more pixels."""
    by_x, by_y = 100 * (stated.sx / measured.sx - 1), 100 * (stated.sy / measured.sy - 1)
    apart = math.hypot(100 * errors[0] / measured.sx, 100 * errors[1] / measured.sy)
    if abs(by_x - by_y) <= _APART * apart + 0.05:
        both = 0.5 * (by_x + by_y)
        return (
            "is as large as its file says"
            if abs(both) < 0.05
            else f"would have to be {_larger(both)} than its file says"
        )
    return (
        f"would have to be {_larger(by_x)} along the rows and {_larger(by_y)} along the columns than its file says, "
        "which no other size of it is"
    )


def _larger(percent: float) -> str:
    return f"{abs(percent):.1f} % {'smaller' if percent < 0 else 'larger'}"


def _of_frame(found: Explained) -> str:
    """What the frame's tolerance does to the standard errors."""
    by_x, by_y = found.frame_errors[:2]
    if not found.tolerances_mm.any():
        return "the frame is taken to be exact"
    return f"rod ends known to {_tolerance(found)} contribute {by_x:.4f} and {by_y:.4f} to the errors"


def _tolerance(found: Explained) -> str:
    """The tolerance of the rods, the least and the largest where they differ."""
    least, most = float(found.tolerances_mm.min()), float(found.tolerances_mm.max())
    return f"{most:g} mm" if least == most else f"{least:g} to {most:g} mm"


def _refined(found: Explained, scale: PixelScale) -> Refined:
    """The poses fitted to a scale, with the rods where the frame's file has them."""
    identified, at = identified_in(found.frame, found.matched), found.joint.at
    # From mm to pixels, and these to standard deviations.
    whitening = identified.whitening() @ scale.inverse_matrix
    spots_mm = scale.to_mm(identified.spots_px)
    return refine(found.frame, at.rotations, at.translations, spots_mm, identified.used, whitening)


def _rms_px(found: Explained, fitted: Refined, scale: PixelScale) -> float:
    """RMS of the distances between the rods' spots and their predictions, pixel."""
    spots_px, used, _ = identified_in(found.frame, found.matched)
    residual = np.where(used[..., None], scale.to_px(fitted.cuts.points_mm) - spots_px, 0.0)
    return math.sqrt(float((residual**2).sum()) / found.rods)
