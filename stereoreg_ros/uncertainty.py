"""How far to believe a pose: covariances in the axes they are used in, and error balls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, skew
from stereoreg_ros.geometry.projection import project, projection_jacobian
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


def error_ball_95(covariance: Array) -> float:
    """Radius in mm of the ball that holds 95 % of a Gaussian error with covariance (3, 3) mm^2.

    The squared error is a weighted sum of chi-square variables; the chi-square with the same mean, variance and
    skewness stands for it (Imhof 1961), exact for one error direction and for three equal ones.
    """
    weights = np.clip(np.linalg.eigvalsh(covariance), 0.0, None)
    first, second, third = (float((weights**power).sum()) for power in (1, 2, 3))
    if third == 0:
        return 0.0
    freedom = second**3 / third**2
    quantile = 2 * float(gammaincinv(freedom / 2, 0.95))
    return math.sqrt(max(0.0, first + math.sqrt(second / freedom) * (quantile - freedom)))
