"""How far to believe a pose: covariances in the axes they are used in, and error balls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, skew
from stereoreg_ros.geometry.projection import cut_jacobian, project, projection_jacobian
from stereoreg_ros.geometry.slice import PixelScale


def cramer_rao_pose(
    frame: Frame, lines: NDArray[np.intp], slice_from_frame: Pose, scale: PixelScale, noise_px: float
) -> Array:
    """Cramer-Rao bound (6, 6) of slice_from_frame (mm, rad; see `Pose.perturbed`) from the spots of the given rods.

    noise_px: standard deviation per axis of the spots. No unbiased method has a smaller covariance.
    """
    _, cuts = project(frame, slice_from_frame, scale)
    jacobian = projection_jacobian(cuts, slice_from_frame, scale)[0][lines].reshape(-1, 6)
    return np.asarray(noise_px**2 * np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)


def in_scanner_axes(covariance: Array, scanner_from_slice: Pose) -> Array:
    """Covariance (6, 6) of scanner_from_frame from that of slice_from_frame; both as in `Pose.perturbed`."""
    turn = np.kron(np.eye(2), scanner_from_slice.rotation)
    turned: Array = turn @ covariance @ turn.T
    return turned


def point_covariance(covariance: Array, scanner_from_frame: Pose, point_in_frame: Array) -> Array:
    """Covariance (3, 3) mm^2, in scanner axes, of where the pose puts a point (3,) mm of the frame.

    Its square root is the target registration error to first order.
    """
    arm = scanner_from_frame.rotation @ point_in_frame
    jacobian = np.hstack([np.eye(3), -skew(arm)])
    moved: Array = jacobian @ covariance @ jacobian.T
    return moved


def scale_sensitivity(
    frame: Frame,
    lines: NDArray[np.intp],
    slice_from_frame: Pose,
    spots_px: Array,
    covariances_px2: Array,
    scale: PixelScale,
) -> Array:
    """d pose / d (sx, sy, shear), (6, 3) in mm and rad per mm/pixel, of the maximum-likelihood pose slice_from_frame.

    spots_px (n, 2), covariances_px2 (n, 2, 2): of the given rods (n,), the covariances as they weight the pose. A scale
    that grows by dS moves a spot Q by dS Q in the slice, and the pose follows as it would follow that spot.
    """
    _, cuts = project(frame, slice_from_frame, scale)
    jacobian = cut_jacobian(cuts, slice_from_frame.translation)[lines]
    weights = np.linalg.inv(scale.matrix @ covariances_px2 @ scale.matrix.T)
    weighted = np.swapaxes(jacobian, 1, 2) @ weights
    moved = np.zeros((len(lines), 2, 3))
    moved[:, 0, 0] = spots_px[:, 0]
    moved[:, 1, 1] = spots_px[:, 1]
    moved[:, 0, 2] = spots_px[:, 1]
    information = (weighted @ jacobian).sum(axis=0)
    return np.asarray(np.linalg.pinv(information, hermitian=True) @ (weighted @ moved).sum(axis=0), dtype=np.float64)


def checked_scale_covariance(scale_covariance: ArrayLike) -> Array:
    """The covariance of (sx, sy, shear) as (3, 3), mm^2/pixel^2, of one that is (2, 2) or (3, 3).

    Raises ValueError where it has another shape, is not finite, not symmetric, or has a negative variance.
    """
    given = np.asarray(scale_covariance, dtype=np.float64)
    if given.shape not in ((2, 2), (3, 3)):
        raise ValueError(f"scale_covariance has shape {given.shape}, expected (2, 2) or (3, 3)")
    size = float(np.abs(given).max())
    if not np.isfinite(size) or not np.allclose(given, given.T, rtol=0.0, atol=1e-6 * size):
        raise ValueError(f"scale_covariance is {given.tolist()}, expected a finite and symmetric matrix")
    if np.linalg.eigvalsh(given).min() < -1e-6 * size:
        raise ValueError(f"scale_covariance is {given.tolist()}, expected no negative variance in any direction")
    whole = np.zeros((3, 3))
    whole[: len(given), : len(given)] = 0.5 * (given + given.T)
    return whole


def error_ball_95(covariance: Array) -> float:
    """Radius in mm of the ball that holds 95 % of a Gaussian error with covariance (3, 3) mm^2.

    The squared error is a weighted sum of chi-square variables; the chi-square with the same mean, variance and
    skewness stands for it (Imhof 1961), exact for one error direction and for three equal ones; for others the
    ball holds 95.00 to 95.25 %.
    """
    weights = np.clip(np.linalg.eigvalsh(covariance), 0.0, None)
    first, second, third = (float((weights**power).sum()) for power in (1, 2, 3))
    if third == 0:
        return 0.0
    freedom = second**3 / third**2
    quantile = 2 * float(gammaincinv(freedom / 2, 0.95))
    return math.sqrt(max(0.0, first + math.sqrt(second / freedom) * (quantile - freedom)))
