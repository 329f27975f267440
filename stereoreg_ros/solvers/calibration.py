"""Scale unknown, correspondences known: pixel scale and pose from five or more rods (Maurin 2009, section 3).

The unknown is x = (l1, l2, t) in R^9, with p_frame = l1 u + l2 v + t: l1, l2 in mm/pixel, t in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation, rotation_exp
from stereoreg_ros.geometry.projection import project, projection_jacobian
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.linear_system import SCALE_RANK, LinearSystem, linear_system
from stereoreg_ros.solvers.newton_raphson import constraint_matrix, minimise


@dataclass(frozen=True, eq=False)
class ScaleSolution:
    """A pixel scale with its pose.

    scale: mm/pixel; frame_from_slice: mm, its rotation the nearest to [r1 r2 r1xr2]; unknowns: x (9,);
    converged, iterations: of the iterative methods; true and 0 for the linear one.
    """

    scale: PixelScale
    frame_from_slice: Pose
    unknowns: Array
    converged: bool
    iterations: int


def calibrate_linear(frame: Frame, lines: NDArray[np.intp], spots_px: Array, with_shear: bool = False) -> ScaleSolution:
    """Linear least squares (Maurin 2009, eq. 10-12) for the spots (n, 2) of the given rods (n,), n >= 5.

    with_shear: read the shear g off l1 . l2 (eq. 4) instead of neglecting it (eq. 5).
    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    system = linear_system(frame, lines, spots_px, SCALE_RANK)
    return _solution(system, system.least_squares(), with_shear, True, 0)


def calibrate_newton_raphson(frame: Frame, lines: NDArray[np.intp], spots_px: Array) -> ScaleSolution:
    """Least squares with the constraint l1 . l2 = 0, from the linear solution (eq. 17-23).

    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    system = linear_system(frame, lines, spots_px, SCALE_RANK)
    x, _, converged, iterations = minimise(system, [(constraint_matrix(0, 3), 0.0)], system.least_squares())
    return _solution(system, x, False, converged, iterations)


def calibrate_maximum_likelihood(
    frame: Frame,
    lines: NDArray[np.intp],
    spots_px: Array,
    start: ScaleSolution | None = None,
    with_shear: bool = False,
) -> ScaleSolution:
    """Least squares of the residuals in the image, from `start` or the linear solution: scale and pose together.

    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    first = start or calibrate_linear(frame, lines, spots_px, with_shear)
    spots_px = np.asarray(spots_px, dtype=np.float64)
    slice_from_frame = first.frame_from_slice.inverse()
    size = 3 if with_shear else 2

    def unpack(step: Array) -> tuple[PixelScale, Pose]:
        shear = first.scale.shear + step[2] if with_shear else 0.0
        scale = PixelScale(first.scale.sx + step[0], first.scale.sy + step[1], shear)
        moved = Pose(
            rotation_exp(step[size + 3 :]) @ slice_from_frame.rotation,
            slice_from_frame.translation + step[size : size + 3],
        )
        return scale, moved

    def residuals(step: Array) -> Array:
        scale, moved = unpack(step)
        predicted, _ = project(frame, moved, scale)
        return np.nan_to_num((predicted[lines] - spots_px).ravel(), nan=1e6)

    low = np.full(size + 6, -np.inf)
    low[:2] = -0.9 * first.scale.sx, -0.9 * first.scale.sy  # a scale is positive
    fit = least_squares(residuals, np.zeros(size + 6), bounds=(low, np.inf), x_scale="jac", xtol=1e-14, ftol=1e-14)
    scale, moved = unpack(fit.x)
    frame_from_slice = moved.inverse()
    columns = frame_from_slice.rotation[:, :2] @ scale.matrix
    unknowns = np.concatenate([columns[:, 0], columns[:, 1], frame_from_slice.translation])
    return ScaleSolution(scale, frame_from_slice, unknowns, bool(fit.success), int(fit.nfev))


def calibration_covariance(
    frame: Frame, lines: NDArray[np.intp], slice_from_frame: Pose, scale: PixelScale, noise_px: float
) -> Array:
    """Cramer-Rao bound (8, 8) of (sx, sy) in mm/pixel and the pose slice_from_frame (mm, rad; see `Pose.perturbed`).

    noise_px: standard deviation per axis of the spots. A direction that nothing determines gets no finite bound: the
    pseudo-inverse leaves it out, so use it for rods that fix the scale.
    """
    _, cuts = project(frame, slice_from_frame, scale)
    by_pose, by_scale = projection_jacobian(cuts, slice_from_frame, scale)
    jacobian = np.concatenate([by_scale[lines, :, :2], by_pose[lines]], axis=2).reshape(-1, 8)
    covariance: Array = noise_px**2 * np.linalg.pinv(jacobian.T @ jacobian)
    return covariance


def _solution(
    system: LinearSystem, normalised: Array, with_shear: bool, converged: bool, iterations: int
) -> ScaleSolution:
    l1, l2, t = system.affine(normalised)
    sx = float(np.linalg.norm(l1))
    r1 = l1 / sx
    shear = float(l1 @ l2) / sx if with_shear else 0.0
    rest = l2 - shear * r1
    sy = float(np.linalg.norm(rest))
    r2 = rest / sy
    rotation = nearest_rotation(np.column_stack([r1, r2, np.cross(r1, r2)]))
    return ScaleSolution(
        PixelScale(sx, sy, shear), Pose(rotation, t), np.concatenate([l1, l2, t]), converged, iterations
    )
