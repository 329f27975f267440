"""How far a pose may be off at most, where no spot is off by more than a given error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.result import Registration
from stereoreg_ros.solvers.pose_error_bounds import PoseErrorModel


@dataclass(frozen=True, eq=False)
class WorstCase:
    """Bounds of a registration's errors for spots of which no coordinate is off by more than `max_spot_error_px`.

    target_error_mm: of the distance between the target of the options and where the pose puts it; position_mm (3,),
    rotation_deg (3,): of the components of the perturbation of `Pose.perturbed`, in scanner axes.
    """

    max_spot_error_px: float
    target_error_mm: float
    position_mm: Array
    rotation_deg: Array


def worst_case(registration: Registration, max_spot_error_px: float) -> WorstCase | None:
    """The bounds, which no such error exceeds (see `solvers.pose_error_bounds`); None where none can be proven.

    The spots' identities and the pixel scale are taken to be right. Raises ValueError where max_spot_error_px is
    negative or not finite.
    """
    estimate, spots = registration.estimate, [match.spot for match in registration.matches]
    model = PoseErrorModel(
        registration.frame,
        np.array([match.line_index for match in registration.matches]),
        estimate.slice_from_frame,
        registration.spots_px[spots],
        registration.spots.noise_px2(registration.options.spot_noise_px)[spots],
        registration.scale,
    )
    reach = model.reach(max_spot_error_px)
    if reach is None:
        return None
    # The error along an axis of the scanner, from its components along those of the slice.
    scanner_from_slice = (estimate.scanner_from_frame @ estimate.slice_from_frame.inverse()).rotation
    bounds = np.array([reach.bound(row) for row in np.kron(np.eye(2), scanner_from_slice)])
    return WorstCase(
        max_spot_error_px,
        reach.point_mm(registration.options.target_in_frame_mm),
        bounds[:3],
        bounds[3:] * (180 / math.pi),
    )
