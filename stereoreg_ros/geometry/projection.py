"""Where rods cut the slice: eq. 28 of Maurin 2009, its Jacobian, and its inverse for one spot and one rod."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, cross
from stereoreg_ros.geometry.slice import PixelScale

# Below this cosine between rod and slice normal the cut runs away along the rod: treated as no cut at all.
_MIN_COSINE = 1e-6


class BoundedLines(Protocol):
    """What can be cut: a `Frame`, or many at once with axes for the poses in between; see there for the arrays."""

    @property
    def directions(self) -> Array: ...
    @property
    def origins(self) -> Array: ...
    @property
    def lambda_min(self) -> Array: ...
    @property
    def lambda_max(self) -> Array: ...


class Cuts(NamedTuple):
    """Where lines cut the slice, for any number of poses.

    points_mm: (..., n, 2) in the slice; lambdas: (..., n) mm along each line; inside: (..., n), true where the
    cut exists and lies between the rod's ends; directions: (..., n, 3), the lines' directions in slice axes.
    Where a line runs within the slice, points and lambdas are NaN and inside is false.
    """

    points_mm: Array
    lambdas: Array
    inside: NDArray[np.bool_]
    directions: Array

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Cuts:
        """Only those of the given poses."""
        return Cuts(self.points_mm[rows], self.lambdas[rows], self.inside[rows], self.directions[rows])


def cut(frame: BoundedLines, rotations: Array, translations: Array) -> Cuts:
    """Cut all lines of `frame` by the slice, for poses slice_from_frame (..., 3, 3), (..., 3) mm.

    This is eq. 28 of Maurin 2009: its least-squares form reduces to the line's intersection with the plane z = 0.
    """
    frame_from_slice = np.swapaxes(rotations, -1, -2)
    directions = frame.directions @ frame_from_slice
    origins = frame.origins @ frame_from_slice + translations[..., None, :]
    cosine = directions[..., 2]
    crosses = np.abs(cosine) > _MIN_COSINE
    lambdas = np.where(crosses, -origins[..., 2] / np.where(crosses, cosine, 1.0), np.nan)
    points = origins[..., :2] + lambdas[..., None] * directions[..., :2]
    with np.errstate(invalid="ignore"):
        inside = (lambdas >= frame.lambda_min) & (lambdas <= frame.lambda_max)
    return Cuts(points, lambdas, inside, directions)


def cut_jacobian(cuts: Cuts, translations: Array) -> Array:
    """d points_mm / d pose, (..., n, 2, 6), in mm per mm and mm per rad.

    The pose slice_from_frame is perturbed as in `Pose.perturbed`: position first, then rotation vector, in slice axes.
    NaN where a line runs within the slice.
    """
    cosine = np.where(np.isnan(cuts.lambdas), np.nan, cuts.directions[..., 2])
    # A point of the rod that moves by dp moves the cut by dp_xy - slope dp_z: the rod slides through the plane. Turned
    # by w about the frame's origin, the point moves by w x arm.
    slope_x, slope_y = cuts.directions[..., 0] / cosine, cuts.directions[..., 1] / cosine
    arm_x = cuts.points_mm[..., 0] - translations[..., None, 0]
    arm_y = cuts.points_mm[..., 1] - translations[..., None, 1]
    arm_z = -translations[..., None, 2]
    jacobian: Array = np.zeros((*slope_x.shape, 2, 6))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -slope_x, -slope_y
    jacobian[..., 0, 3], jacobian[..., 1, 3] = -slope_x * arm_y, -slope_y * arm_y - arm_z
    jacobian[..., 0, 4], jacobian[..., 1, 4] = slope_x * arm_x + arm_z, slope_y * arm_x
    jacobian[..., 0, 5], jacobian[..., 1, 5] = -arm_y, arm_x
    return jacobian


def rod_covariances(frame: BoundedLines, tolerances_mm: Array, cuts: Cuts) -> Array:
    """Covariances (..., n, 2, 2) mm^2 of where the slice cuts rods whose ends are not where the frame file has them.

    tolerances_mm: (n,), standard deviation per axis of each rod's ends. The two ends err independently, so that the
    middle of a rod is known better than its ends; a point of the rod that is off by e moves the cut by
    e_xy - slope e_z. NaN where a rod runs within the slice.
    """
    cosine = np.where(np.isnan(cuts.lambdas), np.nan, cuts.directions[..., 2])
    along = (cuts.lambdas - frame.lambda_min) / (frame.lambda_max - frame.lambda_min)
    variance = tolerances_mm**2 * ((1.0 - along) ** 2 + along**2)
    slope_x, slope_y = cuts.directions[..., 0] / cosine, cuts.directions[..., 1] / cosine
    covariances: Array = np.empty((*variance.shape, 2, 2))
    covariances[..., 0, 0] = variance * (1.0 + slope_x**2)
    covariances[..., 1, 1] = variance * (1.0 + slope_y**2)
    covariances[..., 0, 1] = covariances[..., 1, 0] = variance * slope_x * slope_y
    return covariances


def project(frame: Frame, slice_from_frame: Pose, scale: PixelScale) -> tuple[Array, Cuts]:
    """Pixels (n, 2) at which the lines of `frame` cut the slice (Maurin 2009, eq. 28), and the cuts in mm."""
    cuts = cut(frame, slice_from_frame.rotation, slice_from_frame.translation)
    return scale.to_px(cuts.points_mm), cuts


def projection_jacobian(cuts: Cuts, slice_from_frame: Pose, scale: PixelScale) -> tuple[Array, Array]:
    """d pixel / d pose (n, 2, 6) as in `cut_jacobian`, and d pixel / d (sx, sy, shear) (n, 2, 3)."""
    by_pose = scale.inverse_matrix @ cut_jacobian(cuts, slice_from_frame.translation)
    return by_pose, scale_jacobian(scale.to_px(cuts.points_mm), scale)


def scale_jacobian(pixels: Array, scale: PixelScale) -> Array:
    """d pixel / d (sx, sy, shear), (..., 2, 3), of slice points that lie at pixels (..., 2).

    S Q = p: where S grows by dS, Q moves by -S^-1 dS Q.
    """
    u, v = pixels[..., 0], pixels[..., 1]
    by_matrix = np.zeros((*pixels.shape, 3))
    by_matrix[..., 0, 0] = u
    by_matrix[..., 1, 1] = v
    by_matrix[..., 0, 2] = v
    return np.asarray(-scale.inverse_matrix @ by_matrix)


def point_line_distances(frame: Frame, lines: NDArray[np.intp], slice_from_frame: Pose, points_mm: Array) -> Array:
    """Distances (m,) in mm from slice points (m, 2) to the given lines (m,) (Maurin 2009, the residual of eq. 8)."""
    in_slice = np.zeros((len(points_mm), 3))
    in_slice[:, :2] = points_mm
    in_frame = slice_from_frame.inverse() @ in_slice
    offset = cross(frame.directions[lines], in_frame) - frame.moments[lines]
    distances: Array = np.linalg.norm(offset, axis=-1)
    return distances
