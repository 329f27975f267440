"""How far to believe a pose: covariances in the axes they are used in, and error balls."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, gammaincinv

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, skew
from stereoreg_ros.geometry.projection import project, projection_jacobian
from stereoreg_ros.geometry.slice import PixelScale

# A scale that the spots say so little of, in standard deviations of what is stated, is not judged by them.
_LEAST_INFORMATION: Final = 1e-4


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


def enclosing_covariance(one: Array, other: Array) -> Array:
    """A covariance (n, n) that is in no direction smaller than either of two, positive definite ones.

    In the axes in which both are diagonal it has the larger variance of each.
    """
    root = np.linalg.cholesky(other)
    back = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(back @ one @ back.T)
    axes = root @ vectors
    larger: Array = (axes * np.maximum(values, 1.0)) @ axes.T
    return larger


def point_covariance(covariance: Array, scanner_from_frame: Pose, point_in_frame: Array) -> Array:
    """Covariance (3, 3) mm^2, in scanner axes, of where the pose puts a point (3,) mm of the frame.

    Its square root is the target registration error to first order.
    """
    arm = scanner_from_frame.rotation @ point_in_frame
    jacobian = np.hstack([np.eye(3), -skew(arm)])
    moved: Array = jacobian @ covariance @ jacobian.T
    return moved


class ScaleMisfit(NamedTuple):
    """How much better spots fit with another scale.

    fall: by how much chi-square falls where the scale is free instead of known as well as stated; where all is as
    stated it is distributed as chi-square of degrees_of_freedom, one for each error of the scale. stated: standard
    deviation of the scale, as a share of it.
    """

    fall: float = 0.0
    degrees_of_freedom: int = 0
    stated: float = 0.0

    @property
    def probability(self) -> float:
        """Of as large a fall by the stated errors alone; one where the scale is not judged."""
        return float(chdtrc(self.degrees_of_freedom, self.fall)) if self.degrees_of_freedom else 1.0


class Whitened(NamedTuple):
    """The residuals of k rods at a pose slice_from_frame, in standard deviations, and what moves them.

    by_pose: (2k, 6), their Jacobian by the pose (see `Pose.perturbed`); by_common: (2k, c), by errors that all spots
    share, of unit variance each; residual: (2k,), spot less prediction. shifts: (6, c), how far each of these errors
    moves the pose besides, as it moves all spots alike. scale: (c,), which of them are errors of the scale; scale_std:
    standard deviation of the scale, as a share of it.
    """

    by_pose: Array
    by_common: Array
    residual: Array
    shifts: Array
    scale: NDArray[np.bool_]
    scale_std: float = 0.0

    def covariance_by_shifts(self) -> Array:
        """What is to be added for the shifts to the pose's covariance (6, 6), the inverse of its information.

        With the shared errors c integrated out, the pose's error is P (noise + N c) + T c: P the pose's sensitivity to
        the residuals, N `by_common`, T `shifts`. That of the first term is the inverse of the information.
        """
        inner = np.linalg.inv(np.eye(self.by_common.shape[1]) + self.by_common.T @ self.by_common)
        weighted = self.by_pose - self.by_common @ inner @ (self.by_common.T @ self.by_pose)
        covariance = np.linalg.pinv(weighted.T @ self.by_pose, hermitian=True)
        cross = covariance @ weighted.T @ self.by_common @ self.shifts.T
        added: Array = cross + cross.T + self.shifts @ self.shifts.T
        return added

    def scale_misfit(self) -> ScaleMisfit:
        """How much better the spots fit with another scale."""
        if not self.scale.any():
            return ScaleMisfit()
        estimated = np.linalg.solve(
            np.eye(self.by_common.shape[1]) + self.by_common.T @ self.by_common, self.by_common.T @ self.residual
        )[self.scale]
        free, other = self.by_common[:, self.scale], self.by_common[:, ~self.scale]
        rest = np.hstack([self.by_pose, other])
        inner = rest.T @ rest
        inner[6:, 6:] += np.eye(other.shape[1])
        information = free.T @ free - free.T @ rest @ np.linalg.pinv(inner, hermitian=True) @ rest.T @ free
        values, vectors = np.linalg.eigh(information)
        along = vectors.T @ estimated
        fall = float((along**2 * (1.0 + 1.0 / np.maximum(values, _LEAST_INFORMATION))).sum())
        return ScaleMisfit(fall, len(values), self.scale_std)


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
