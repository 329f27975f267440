"""One pixel scale from several slices, with a pose for each: maximum likelihood, rods and spots known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.identified import IdentifiedSpots, Linearised, ScaleAndPoses, linearised

_ITERATIONS = 60
_STILL = 1e-12
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e10


@dataclass(frozen=True, eq=False)
class JointScale:
    """A pixel scale with the poses of m slices.

    at: scale and poses; covariance: (2, 2) of (sx, sy), or (3, 3) with the shear, mm^2/pixel^2, for the spots'
    covariances; residuals_px: (m, n, 2), spot less prediction, zero where a rod has no spot; chi_square,
    degrees_of_freedom: of all residuals together; converged.
    """

    at: ScaleAndPoses
    covariance: Array
    residuals_px: Array
    chi_square: float
    degrees_of_freedom: int
    converged: bool

    @property
    def scale(self) -> PixelScale:
        """mm/pixel."""
        return self.at.scale


def calibrate_jointly(
    frame: Frame, identified: IdentifiedSpots, start: ScaleAndPoses, with_shear: bool = False
) -> JointScale:
    """Least squares of the whitened residuals in the image over the scale and the poses of m slices, n rods.

    The poses are eliminated from the normal equations slice by slice (Schur complement), so that the work grows with m
    and not with its cube.
    """
    size = 3 if with_shear else 2
    whitening = identified.whitening()

    def evaluated(at: ScaleAndPoses) -> _State:
        return _State.of(linearised(frame, at, identified, whitening), size)

    at, state = start, evaluated(start)
    damping, converged = _FIRST_DAMPING, False
    for _ in range(_ITERATIONS):
        by_scale, by_pose = state.step(damping)
        moved = at.moved(np.concatenate([by_scale, np.zeros(3 - size)]), by_pose)
        tried = None if moved is None else evaluated(moved)
        if moved is not None and tried is not None and tried.chi_square <= state.chi_square:
            gain = state.chi_square - tried.chi_square
            at, state, damping = moved, tried, 0.1 * damping
            if gain <= _STILL * (1.0 + state.chi_square):
                converged = True
                break
        else:
            damping *= 10.0
            if damping > _LARGEST_DAMPING:
                converged = True  # no step however short helps: at the optimum to rounding
                break
    # A direction that nothing determines gets a huge variance, not none.
    values, vectors = np.linalg.eigh(state.reduced()[0])
    covariance: Array = (vectors / np.maximum(values, 1e-12 * max(float(values[-1]), 1e-12))) @ vectors.T
    freedom = int(2 * identified.used.sum()) - 6 * len(at.rotations) - size
    return JointScale(at, covariance, state.residuals_px, state.chi_square, freedom, converged)


@dataclass(frozen=True, eq=False)
class _State:
    """Normal equations of the whitened residuals: blocks of the scale (q, q), the poses (m, 6, 6), and between."""

    residuals_px: Array
    chi_square: float
    by_scale: Array
    between: Array
    by_pose: Array
    scale_gradient: Array
    pose_gradient: Array

    @classmethod
    def of(cls, at: Linearised, size: int) -> _State:
        """size: how many of (sx, sy, shear) are measured."""
        scales = at.by_scale[..., :size].reshape(*at.by_pose.shape[:2], size)
        turned = np.swapaxes(at.by_pose, 1, 2)
        chi_square = float((at.white**2).sum())
        return cls(
            at.residuals_px,
            chi_square if np.isfinite(chi_square) else float("inf"),
            (np.swapaxes(scales, 1, 2) @ scales).sum(axis=0),
            turned @ scales,
            turned @ at.by_pose,
            (np.swapaxes(scales, 1, 2) @ at.white)[..., 0].sum(axis=0),
            (turned @ at.white)[..., 0],
        )

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Information (q, q) and gradient (q,) of the scale, the poses eliminated; and the poses' inverse blocks."""
        blocks = self.by_pose.copy()
        diagonal = np.einsum("mii->mi", blocks)
        diagonal += damping * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-12
        inverse = _inverse(blocks)
        weighted = np.swapaxes(self.between, 1, 2) @ inverse
        information: Array = self.by_scale - (weighted @ self.between).sum(axis=0)
        gradient = self.scale_gradient - (weighted @ self.pose_gradient[..., None])[..., 0].sum(axis=0)
        return information, gradient, inverse

    def step(self, damping: float) -> tuple[Array, Array]:
        """Steps of the scale (q,) and of the poses (m, 6)."""
        information, gradient, inverse = self.reduced(damping)
        damped: Array = information + damping * np.diag(np.diag(self.by_scale))
        by_scale = np.asarray(np.linalg.lstsq(damped, gradient, rcond=None)[0], dtype=np.float64)
        left = self.pose_gradient - self.between @ by_scale
        return by_scale, (inverse @ left[..., None])[..., 0]


def _inverse(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
