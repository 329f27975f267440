"""What a matcher is given: find which of these spots belong to which rods of this frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_from_quaternion
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.spots import Spots, Streaks
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.options import RegistrationOptions

# Explanations that differ by fewer decades of likelihood are never taken to be distinguishable.
_LEAST_DECADES_APART: Final = 1.0


@dataclass(frozen=True, eq=False)
class Problem:
    """Spots to be matched to a frame's rods.

    spots: in mm, with their errors and with what the frame and the scale may be off by; frame: the rods; prior: the
    poses that are allowed. min_inliers: fewest rods that must have a spot; max_log10_false_alarms: log10 of the number
    of matches as good that chance may bring. guess: slice_from_frame where the frame was before, None where that is not
    known.
    """

    spots: Spots
    frame: Frame
    prior: Prior
    min_inliers: int
    max_log10_false_alarms: float
    guess: Pose | None = None

    @classmethod
    def of(cls, spots: SliceSpots, frame: Frame, options: RegistrationOptions, previous: Pose | None = None) -> Problem:
        """The problem that a slice's spots pose; previous: scanner_from_frame of the slice before.

        With a pose from before, half of the false alarms that are allowed are for poses near it, half for all poses.
        """
        scale = spots.scale
        covariances_mm2 = scale.matrix @ spots.noise_px2(options.spot_noise_px) @ scale.matrix.T
        tolerances = tolerances_of(frame, scale, options, spots.scale_covariance)
        streaks = Streaks.of(spots, options.slice_thickness_mm)
        in_mm = Spots.of(spots.centres_mm, covariances_mm2, spots.area_mm2, tolerances, streaks)
        nominal = spots.scanner_from_slice.rotation.T @ rotation_from_quaternion(options.nominal_orientation)
        prior = Prior(nominal, math.radians(options.max_rotation_deg))
        allowed = options.max_log10_false_alarms
        if previous is None:
            return cls(in_mm, frame, prior, options.min_inliers, allowed)
        guess = spots.scanner_from_slice.inverse() @ previous
        return cls(in_mm, frame, prior, options.min_inliers, allowed - math.log10(2), guess)

    @property
    def gains(self) -> Array:
        """Log-likelihood ratios (s,) of the spots; see `Spots.gains`."""
        return self.spots.gains(self.frame)

    @property
    def decades_apart(self) -> float:
        """By how many decades of likelihood explanations must differ to be distinguishable.

        Half of those by which chance must be ruled out, a thousand to one by default: who wants more certainty of the
        one kind wants more of the other.
        """
        return max(-self.max_log10_false_alarms / 2, _LEAST_DECADES_APART)

    def only(self, rows: NDArray[np.intp]) -> Problem:
        """The same with some of the spots."""
        return replace(self, spots=self.spots.only(rows), prior=self.prior.only(rows))


def tolerances_of(
    frame: Frame, scale: PixelScale, options: RegistrationOptions, scale_covariance: Array | None = None
) -> Tolerances:
    """How the frame and the scale may be off, by the options and the frame's file."""
    rods_mm = frame.tolerances_or(options.frame_tolerance_mm)
    return Tolerances.of(frame, rods_mm, scale, options.scale_tolerance, scale_covariance, options.slice_thickness_mm)
