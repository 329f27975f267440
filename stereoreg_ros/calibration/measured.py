"""The scale from slices whose rods are known, and what is known of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.result import Recognition, Registration
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import calibrate_linear, calibrate_newton_raphson
from stereoreg_ros.solvers.identified import IdentifiedSpots, ScaleAndPoses
from stereoreg_ros.solvers.joint_calibration import calibrate_jointly
from stereoreg_ros.solvers.tolerant_calibration import TolerantScale, calibrate_tolerantly

MIN_LINES = 5
# The Newton-Raphson solution of one slice is no start where it changes the scale by more than this share.
_LARGEST_CHANGE = 0.1


@dataclass(frozen=True, eq=False)
class Explained:
    """Slices that one scale explains."""

    frame: Frame
    joint: TolerantScale
    matched: list[Registration]
    slices: list[SliceSpots]

    @property
    def rods(self) -> int:
        """Spots of rods in all slices."""
        return sum(len(one.matches) for one in self.matched)

    @property
    def tolerances_mm(self) -> Array:
        """Of the rods (n,)."""
        return self.frame.tolerances_or(self.matched[0].options.frame_tolerance_mm)

    @property
    def covariance(self) -> Array:
        """Of the scale: where the residuals are larger than stated, so are the errors."""
        return self._excess * self.joint.covariance

    @property
    def errors(self) -> tuple[float, ...]:
        """Standard errors of the scale, mm/pixel."""
        return _roots(self.covariance)

    @property
    def frame_errors(self) -> tuple[float, ...]:
        """The part of these that the frame's tolerance brings, mm/pixel."""
        return _roots(self._excess * self.joint.frame_covariance)

    @property
    def stated(self) -> PixelScale | None:
        """The scale that came with the slices, with the last one that has any."""
        return next((one.stated_scale for one in reversed(self.slices) if one.stated_scale is not None), None)

    @property
    def _excess(self) -> float:
        return max(self.joint.chi_square / self.joint.degrees_of_freedom, 1.0)


def measured_scale(frame: Frame, matched: Sequence[Registration | Recognition], with_shear: bool) -> TolerantScale:
    """The scale from slices whose rods are known, from the Newton-Raphson solution of one (Maurin 2009, section 3)."""
    richest = max(matched, key=lambda one: len(one.matches))
    first = calibrate_newton_raphson(frame, *_couples(richest))
    start = richest.scale
    change = max(abs(first.scale.sx / start.sx - 1), abs(first.scale.sy / start.sy - 1))
    if first.converged and change < _LARGEST_CHANGE:
        # A shear that is not measured stays as it is; that solution has none.
        start = replace(start, sx=first.scale.sx, sy=first.scale.sy)
    identified = identified_in(frame, matched)
    poses = [one.estimate.slice_from_frame for one in matched]
    rotations = np.array([pose.rotation for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    exact = calibrate_jointly(frame, identified, ScaleAndPoses(start, rotations, translations), with_shear)
    tolerances_mm = frame.tolerances_or(richest.options.frame_tolerance_mm)
    return calibrate_tolerantly(frame, tolerances_mm, identified, exact.at, 3 if with_shear else 2)


def identified_in(frame: Frame, matched: Sequence[Registration | Recognition]) -> IdentifiedSpots:
    """The spots of the slices' rods."""
    m, n = len(matched), len(frame)
    spots_px, covariances = np.zeros((m, n, 2)), np.tile(np.eye(2), (m, n, 1, 1))
    used = np.zeros((m, n), dtype=bool)
    for row, one in enumerate(matched):
        lines, spots = _couples(one)
        spots_px[row, lines], used[row, lines] = spots, True
        own = [match.spot for match in one.matches]
        covariances[row, lines] = one.spots.noise_px2(one.options.spot_noise_px)[own]
    return IdentifiedSpots(spots_px, used, covariances)


def _couples(registration: Registration | Recognition) -> tuple[NDArray[np.intp], Array]:
    """The rods (k,) that were identified, and their spots (k, 2) in pixel."""
    lines = np.array([match.line_index for match in registration.matches])
    return lines, np.array([match.spot_px for match in registration.matches])


def why_degenerate(frame: Frame, matched: Sequence[Registration | Recognition]) -> str:
    """Why no slice by itself fixes the scale (Maurin 2009, section 3.1); empty where one does."""
    reason = ""
    for one in matched:
        if len(one.matches) >= MIN_LINES:
            try:
                calibrate_linear(frame, *_couples(one))
            except DegenerateArrangementError as fault:
                reason = str(fault)
            else:
                return ""
    return reason


def _roots(covariance: Array) -> tuple[float, ...]:
    """Standard deviations."""
    return tuple(float(error) for error in np.sqrt(np.diag(covariance)))
