"""What a registration says: a pose that may be believed, or a refusal with its reason."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.uncertainty import ScaleMisfit, error_ball_95, point_covariance

Reason = Literal[
    "too_few_spots",
    "no_consensus",
    "ambiguous",
    "degenerate",
    "inaccurate",
    "contradicted",
    "bad_image",
    "bad_frame",
    "skipped",
    "internal_error",
]
REASONS: Final[tuple[Reason, ...]] = get_args(Reason)


@dataclass(frozen=True, eq=False)
class Match:
    """One rod and its spot.

    line: the rod's name; line_index: its row in the frame; spot: the spot's row in the spots given;
    spot_px: (2,) pixel; predicted_px: (2,) pixel, where the pose has the rod cut the slice;
    residual_mm: distance from the spot to the rod (point to line).
    """

    line: str
    line_index: int
    spot: int
    spot_px: Array
    predicted_px: Array
    residual_mm: float

    @property
    def residual_px(self) -> float:
        """Distance in the image from the spot to the predicted one, pixel."""
        return float(np.linalg.norm(self.spot_px - self.predicted_px))


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """One explanation of a slice: a pose with the matches it rests on.

    slice_from_frame, scanner_from_frame: the pose, mm. covariance: (6, 6), position (mm) then rotation vector (rad),
    in scanner axes, of the perturbation of `Pose.perturbed` on scanner_from_frame; this is the order of ROS.
    chi_square: sum of the squared residuals over the noise, with `degrees_of_freedom`.
    log10_false_alarms: log10 of how many as good explanations chance alone would bring. scale_misfit: how much better
    the spots fit with another pixel spacing.
    """

    slice_from_frame: Pose
    scanner_from_frame: Pose
    covariance: Array
    matches: tuple[Match, ...]
    chi_square: float
    log10_false_alarms: float
    scale_misfit: ScaleMisfit = field(default_factory=ScaleMisfit)

    @property
    def inliers(self) -> int:
        """Number of rods with a spot."""
        return len(self.matches)

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of `chi_square`."""
        return 2 * len(self.matches) - 6

    @property
    def residual_rms_mm(self) -> float:
        """Root mean square of the distances from spot to rod, mm."""
        return math.sqrt(sum(match.residual_mm**2 for match in self.matches) / len(self.matches))

    @property
    def residual_rms_px(self) -> float:
        """Root mean square of the distances in the image, pixel."""
        return math.sqrt(sum(match.residual_px**2 for match in self.matches) / len(self.matches))

    @property
    def position_std_mm(self) -> float:
        """Standard deviation of the frame origin's position along its worst axis, mm."""
        return math.sqrt(max(0.0, float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])))

    @property
    def rotation_std_deg(self) -> float:
        """Standard deviation of the rotation about its worst axis, degrees."""
        return math.degrees(math.sqrt(max(0.0, float(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))))

    def target_error_95_mm(self, target_in_frame_mm: ArrayLike) -> float:
        """Radius in mm of the ball that holds 95 % of the errors at a point (3,) of the frame, mm."""
        target = np.asarray(target_in_frame_mm, dtype=np.float64)
        return error_ball_95(point_covariance(self.covariance, self.scanner_from_frame, target))


class _OfSlice:
    """What results have in common: the spots of the slice that they are about."""

    spots: SliceSpots

    @property
    def scale(self) -> PixelScale:
        """The pixel scale, mm/pixel."""
        return self.spots.scale

    @property
    def spots_px(self) -> Array:
        """The centres (n, 2) in pixel of all spots offered."""
        return self.spots.centres_px

    @property
    def covariances_px2(self) -> Array:
        """(n, 2, 2) of the spots' centres, as their image shows them; zero where nothing is known of that."""
        return self.spots.covariances_px2


@dataclass(frozen=True, eq=False)
class Registration(_OfSlice):
    """An accepted slice. True as a condition.

    spots: all that were offered, with the slice's scale and plane; options: what it was made with; estimate: the pose
    and all that supports it; caution: a sentence where the pose is accepted but something deserves a look, else empty.
    """

    frame: Frame
    spots: SliceSpots
    options: RegistrationOptions
    estimate: PoseEstimate
    caution: str = ""

    def __bool__(self) -> Literal[True]:
        return True

    @property
    def scanner_from_frame(self) -> Pose:
        """The frame in the scanner, mm."""
        return self.estimate.scanner_from_frame

    @property
    def covariance(self) -> Array:
        """(6, 6) covariance of scanner_from_frame; see `PoseEstimate`."""
        return self.estimate.covariance

    @property
    def matches(self) -> tuple[Match, ...]:
        """Which spot is which rod."""
        return self.estimate.matches


@dataclass(frozen=True, eq=False)
class Recognition(_OfSlice):
    """What the spots of a slice look most like, which nobody has judged: it may well be wrong.

    For those who go on to test it in another way; fields as in `Registration`.
    """

    spots: SliceSpots
    options: RegistrationOptions
    estimate: PoseEstimate

    @property
    def matches(self) -> tuple[Match, ...]:
        """Which spot is which rod."""
        return self.estimate.matches


@dataclass(frozen=True, eq=False)
class Refusal(_OfSlice):
    """A slice without a pose that may be believed. False as a condition.

    reason: one of REASONS; message: one sentence with the figures that decided; estimates: the explanations that
    were found, best first (several for `ambiguous`, none where none was found). They are for looking at, not for use.
    options: what was to be registered with.
    """

    frame: Frame
    spots: SliceSpots
    reason: Reason
    message: str
    estimates: tuple[PoseEstimate, ...] = ()
    options: RegistrationOptions = field(default_factory=RegistrationOptions)

    def __bool__(self) -> Literal[False]:
        return False


# The diagnostic keys of the contract, in its order, of a slice in which nothing was found: a number that does not exist
# is NaN.
NOTHING_FOUND: Final[dict[str, str | int | float]] = {
    "outcome": "refused",
    "reason": "",
    "frame": "",
    "spots": 0,
    "lines": 0,
    "inliers": 0,
    "residual_rms_mm": math.nan,
    "residual_rms_px": math.nan,
    "log10_false_alarms": math.nan,
    "ambiguous_poses": 0,
    "position_std_mm": math.nan,
    "rotation_std_deg": math.nan,
    "target_error_95_mm": math.nan,
    "pixel_spacing_x_mm": math.nan,
    "pixel_spacing_y_mm": math.nan,
    "calibration": "configured",
    "duration_ms": math.nan,
}


def diagnostics(result: Registration | Refusal, calibration: str, duration_s: float) -> dict[str, str | int | float]:
    """The diagnostic keys of the contract, in its order; a number that does not exist is NaN.

    calibration: `configured` or `measured`; duration_s: seconds spent on the slice.
    """
    values = NOTHING_FOUND | {
        "frame": result.frame.name,
        "spots": len(result.spots),
        "lines": len(result.frame),
        "pixel_spacing_x_mm": result.scale.sx,
        "pixel_spacing_y_mm": result.scale.sy,
        "calibration": calibration,
        "duration_ms": 1e3 * duration_s,
    }
    best: PoseEstimate | None
    if result:
        best = result.estimate
        values |= {"outcome": "accepted", "ambiguous_poses": 1}
    else:
        best = result.estimates[0] if result.estimates else None
        values |= {"reason": result.reason, "ambiguous_poses": len(result.estimates)}
    if best is not None:
        values |= {
            "inliers": best.inliers,
            "residual_rms_mm": best.residual_rms_mm,
            "residual_rms_px": best.residual_rms_px,
            "log10_false_alarms": best.log10_false_alarms,
            "position_std_mm": best.position_std_mm,
            "rotation_std_deg": best.rotation_std_deg,
            "target_error_95_mm": best.target_error_95_mm(result.options.target_in_frame_mm),
        }
    return values
