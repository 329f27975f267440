"""One pixel scale from several slices, with a pose for each: maximum likelihood, rods and spots known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_exp
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.geometry.slice import PixelScale

_ITERATIONS = 60
_STILL = 1e-12
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e10


@dataclass(frozen=True, eq=False)
class JointScale:
    """A pixel scale with the poses of m slices.

    scale: mm/pixel; covariance: (2, 2) of (sx, sy), or (3, 3) with the shear, mm^2/pixel^2, for the spots' covariances;
    rotations (m, 3, 3), translations (m, 3) mm: slice_from_frame; residuals_px: (m, n, 2), spot less prediction, zero
    where a rod has no spot; chi_square, degrees_of_freedom: of all residuals together; converged.
    """

    scale: PixelScale
    covariance: Array
    rotations: Array
    translations: Array
    residuals_px: Array
    chi_square: float
    degrees_of_freedom: int
    converged: bool


def calibrate_jointly(
    frame: Frame,
    rotations: Array,
    translations: Array,
    spots_px: Array,
    used: NDArray[np.bool_],
    covariances_px2: Array,
    scale: PixelScale,
    with_shear: bool = False,
) -> JointScale:
    """Least squares of the whitened residuals in the image over the scale and the poses of m slices, n rods.

    rotations (m, 3, 3), translations (m, 3) mm, scale: where to start. spots_px (m, n, 2): the spot of each rod,
    covariances_px2 (m, n, 2, 2): of their centres; anything where used (m, n) is false. The poses are eliminated from
    the normal equations slice by slice (Schur complement), so that the work grows with m and not with its cube.
    """
    size = 3 if with_shear else 2
    whitening = _inverse(np.linalg.cholesky(np.where(used[..., None, None], covariances_px2, np.eye(2))))
    target = np.where(used[..., None], spots_px, 0.0)
    state = _evaluate(frame, rotations, translations, target, used, whitening, scale, size)
    damping, converged = _FIRST_DAMPING, False
    for _ in range(_ITERATIONS):
        by_scale, by_pose = state.step(damping)
        shear = scale.shear + (by_scale[2] if with_shear else 0.0)
        sx, sy = scale.sx + by_scale[0], scale.sy + by_scale[1]
        tried = None
        if min(sx, sy) > 0 and np.isfinite([sx, sy, shear]).all():
            turned = rotation_exp(by_pose[:, 3:]) @ rotations
            new = (turned, translations + by_pose[:, :3], PixelScale(float(sx), float(sy), float(shear)))
            tried = _evaluate(frame, new[0], new[1], target, used, whitening, new[2], size)
        if tried is not None and tried.chi_square <= state.chi_square:
            gain = state.chi_square - tried.chi_square
            (rotations, translations, scale), state, damping = new, tried, 0.1 * damping
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
    freedom = int(2 * used.sum()) - 6 * len(rotations) - size
    return JointScale(
        scale, covariance, rotations, translations, state.residuals_px, state.chi_square, freedom, converged
    )


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


def _evaluate(
    frame: Frame,
    rotations: Array,
    translations: Array,
    target_px: Array,
    used: NDArray[np.bool_],
    whitening: Array,
    scale: PixelScale,
    size: int,
) -> _State:
    m, n = used.shape
    cuts = cut(frame, rotations, translations)
    predicted = scale.to_px(cuts.points_mm)
    mask = used[..., None]
    residual = np.where(mask, target_px - predicted, 0.0)
    # S Q = p: where S grows by dS, Q moves by -S^-1 dS Q.
    moved = np.zeros((m, n, 2, 3))
    moved[..., 0, 0] = predicted[..., 0]
    moved[..., 1, 1] = predicted[..., 1]
    moved[..., 0, 2] = predicted[..., 1]
    by_scale = -scale.inverse_matrix @ moved[..., :size]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pose = scale.inverse_matrix @ cut_jacobian(cuts, translations)
    white = (whitening @ residual[..., None]).reshape(m, 2 * n, 1)
    scales = np.where(mask[..., None], whitening @ by_scale, 0.0).reshape(m, 2 * n, size)
    poses = np.where(mask[..., None], whitening @ by_pose, 0.0).reshape(m, 2 * n, 6)
    turned = np.swapaxes(poses, 1, 2)
    chi_square = float((white**2).sum())
    return _State(
        residual,
        chi_square if np.isfinite(chi_square) else float("inf"),
        (np.swapaxes(scales, 1, 2) @ scales).sum(axis=0),
        turned @ scales,
        turned @ poses,
        (np.swapaxes(scales, 1, 2) @ white)[..., 0].sum(axis=0),
        (turned @ white)[..., 0],
    )
