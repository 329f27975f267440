"""One pixel scale from several slices of a frame whose rods are known to a tolerance only: maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_exp
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian
from stereoreg_ros.geometry.slice import PixelScale

_ITERATIONS = 60
_STILL = 1e-12
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-6, 1e10


@dataclass(frozen=True, eq=False)
class TolerantScale:
    """A pixel scale with the poses of m slices and the rods where they fit best.

    scale: mm/pixel; covariance: (q, q) of as many of (sx, sy, shear) as were measured, mm^2/pixel^2, for the spots'
    covariances and the rods' tolerances together; frame_covariance: (q, q), the part of it that the rods' tolerances
    bring; frame: with the rods' ends moved; rotations (m, 3, 3), translations (m, 3) mm: slice_from_frame;
    residuals_px: (m, n, 2), spot less prediction, zero where a rod has no spot; chi_square, degrees_of_freedom: of all
    residuals and of the rods' displacements together; converged.
    """

    scale: PixelScale
    covariance: Array
    frame_covariance: Array
    frame: Frame
    rotations: Array
    translations: Array
    residuals_px: Array
    chi_square: float
    degrees_of_freedom: int
    converged: bool


def calibrate_tolerantly(
    frame: Frame,
    tolerances_mm: Array,
    rotations: Array,
    translations: Array,
    spots_px: Array,
    used: NDArray[np.bool_],
    covariances_px2: Array,
    scale: PixelScale,
    measured: int = 2,
) -> TolerantScale:
    """Least squares of the whitened residuals over the scale, the poses of m slices and the ends of n rods.

    tolerances_mm: (n,), standard deviation per axis of each rod's ends. How far an end is off is the same in every
    slice: more slices do not average it away. rotations (m, 3, 3), translations (m, 3) mm, scale: where to start, near
    the solution. spots_px (m, n, 2): the spot of each rod, covariances_px2 (m, n, 2, 2): of their centres; anything
    where used (m, n) is false. measured: how many of (sx, sy, shear) are unknown, 0, 2 or 3; the others stay.
    """
    factors = np.linalg.cholesky(np.where(used[..., None, None], covariances_px2, np.eye(2)))
    whitening = np.linalg.inv(factors).astype(np.float64, copy=False)
    target = np.where(used[..., None], spots_px, 0.0)
    displacements = np.zeros((len(frame), 6))

    def at(scale: PixelScale, rotations: Array, translations: Array, displacements: Array) -> _State:
        moved = _moved(frame, tolerances_mm, displacements)
        return _evaluate(
            moved, tolerances_mm, displacements, rotations, translations, target, used, whitening, scale, measured
        )

    state = at(scale, rotations, translations, displacements)
    damping, converged = _FIRST_DAMPING, False
    for _ in range(_ITERATIONS):
        common, by_pose = state.step(damping)
        by_scale = np.zeros(3)
        by_scale[:measured] = common[:measured]
        sx, sy, shear = np.array([scale.sx, scale.sy, scale.shear]) + by_scale
        tried = None
        if np.isfinite(common).all() and min(sx, sy) > 0:
            new = (
                PixelScale(float(sx), float(sy), float(shear)),
                rotation_exp(by_pose[:, 3:]) @ rotations,
                translations + by_pose[:, :3],
                displacements + common[measured:].reshape(-1, 6),
            )
            tried = at(*new)
        if tried is not None and tried.chi_square <= state.chi_square:
            gain = state.chi_square - tried.chi_square
            (scale, rotations, translations, displacements), state, damping = new, tried, 0.1 * damping
            if gain <= _STILL * (1.0 + state.chi_square):
                converged = True
                break
        else:
            damping *= 10.0
            if damping > _LARGEST_DAMPING:
                converged = True  # no step however short helps: at the optimum to rounding
                break
    covariance, frame_covariance = state.covariances(measured)
    return TolerantScale(
        scale,
        covariance,
        frame_covariance,
        _moved(frame, tolerances_mm, displacements),
        rotations,
        translations,
        state.residuals_px,
        state.chi_square,
        int(2 * used.sum()) - 6 * len(rotations) - measured,
        converged,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Normal equations, by what all slices have in common, (c, c), by the poses, (m, 6, 6), and between, (m, 6, c).

    In common are the scale and then the displacements of the rods' ends, six a rod, in units of their tolerance: each
    of them counts as an observation of zero with unit variance.
    """

    residuals_px: Array
    chi_square: float
    common: Array
    between: Array
    by_pose: Array
    common_gradient: Array
    pose_gradient: Array

    def reduced(self, damping: float = 0.0) -> tuple[Array, Array, Array]:
        """Information (c, c) and gradient (c,) of what is in common without the poses; the poses' inverse blocks."""
        blocks = self.by_pose.copy()
        diagonal = np.einsum("mii->mi", blocks)
        diagonal += damping * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-12
        inverse: Array = np.linalg.inv(blocks).astype(np.float64, copy=False)
        weighted = np.swapaxes(self.between, 1, 2) @ inverse
        information: Array = self.common - (weighted @ self.between).sum(axis=0)
        gradient = self.common_gradient - (weighted @ self.pose_gradient[..., None])[..., 0].sum(axis=0)
        return information, gradient, inverse

    def step(self, damping: float) -> tuple[Array, Array]:
        """Steps of what is in common (c,) and of the poses (m, 6)."""
        information, gradient, inverse = self.reduced(damping)
        damped: Array = information + damping * np.diag(np.diag(self.common))
        common = np.asarray(np.linalg.lstsq(damped, gradient, rcond=None)[0], dtype=np.float64)
        left = self.pose_gradient - self.between @ common
        return common, (inverse @ left[..., None])[..., 0]

    def covariances(self, measured: int) -> tuple[Array, Array]:
        """Covariance (q, q) of the scale, and the part of it that is due to the rods."""
        information = self.reduced()[0]
        by_rods = information[:measured, measured:]
        # The rods' block is at least the unit matrix.
        share: Array = np.linalg.solve(information[measured:, measured:], by_rods.T).T.astype(np.float64, copy=False)
        values, vectors = np.linalg.eigh(information[:measured, :measured] - share @ by_rods.T)
        # A direction that nothing determines gets a huge variance, not none.
        floor = 1e-12 * max(float(values.max(initial=0.0)), 1e-12)
        covariance: Array = (vectors / np.maximum(values, floor)) @ vectors.T
        between = covariance @ share
        return covariance, between @ between.T


def _moved(frame: Frame, tolerances_mm: Array, displacements: Array) -> Frame:
    """The frame with its rods' ends displaced by (n, 6), start then end, in units of their tolerances."""
    off_mm = tolerances_mm[:, None] * displacements
    return replace(frame, starts=frame.starts + off_mm[:, :3], ends=frame.ends + off_mm[:, 3:])


def _by_ends(frame: Frame, cuts: Cuts, rotations: Array) -> Array:
    """d points_mm / d (start, end), (m, n, 2, 6), of each rod in the frame's axes."""
    # A point of the rod that moves by dp moves the cut by dp_xy - slope dp_z: the rod slides through the plane.
    slide = np.zeros((*cuts.lambdas.shape, 2, 3))
    slide[..., 0, 0] = slide[..., 1, 1] = 1.0
    slide[..., 2] = -cuts.directions[..., :2] / cuts.directions[..., 2:]
    by_point = slide @ rotations[:, None]
    along = ((cuts.lambdas - frame.lambda_min) / (frame.lambda_max - frame.lambda_min))[..., None, None]
    return np.concatenate([(1.0 - along) * by_point, along * by_point], axis=-1)


def _evaluate(
    frame: Frame,
    tolerances_mm: Array,
    displacements: Array,
    rotations: Array,
    translations: Array,
    target_px: Array,
    used: NDArray[np.bool_],
    whitening: Array,
    scale: PixelScale,
    measured: int,
) -> _State:
    m, n = used.shape
    cuts = cut(frame, rotations, translations)
    predicted = scale.to_px(cuts.points_mm)
    mask = used[..., None]
    residual = np.where(mask, target_px - predicted, 0.0)
    # S Q = p: where S grows by dS, Q moves by -S^-1 dS Q.
    grown = np.zeros((m, n, 2, 3))
    grown[..., 0, 0] = predicted[..., 0]
    grown[..., 1, 1] = predicted[..., 1]
    grown[..., 0, 2] = predicted[..., 1]
    by_scale = -scale.inverse_matrix @ grown[..., :measured]
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pose = scale.inverse_matrix @ cut_jacobian(cuts, translations)
        by_ends = scale.inverse_matrix @ _by_ends(frame, cuts, rotations) * tolerances_mm[:, None, None]
    white = (whitening @ residual[..., None]).reshape(m, 2 * n, 1)
    # Of the rods' ends, each spot knows only those of its own.
    rod, of_rods = np.arange(n), np.zeros((m, n, 2, n, 6))
    of_rods[:, rod, :, rod] = np.swapaxes(np.where(mask[..., None], whitening @ by_ends, 0.0), 0, 1)
    of_scale = np.where(mask[..., None], whitening @ by_scale, 0.0)
    common = np.concatenate([of_scale, of_rods.reshape(m, n, 2, 6 * n)], axis=-1).reshape(m, 2 * n, -1)
    poses = np.where(mask[..., None], whitening @ by_pose, 0.0).reshape(m, 2 * n, 6)
    turned, poses_turned = np.swapaxes(common, 1, 2), np.swapaxes(poses, 1, 2)
    known = np.concatenate([np.zeros(measured), np.ones(6 * n)])
    off = np.concatenate([np.zeros(measured), displacements.ravel()])
    chi_square = float((white**2).sum() + (off**2).sum())
    return _State(
        residual,
        chi_square if np.isfinite(chi_square) else float("inf"),
        (turned @ common).sum(axis=0) + np.diag(known),
        poses_turned @ common,
        poses_turned @ poses,
        (turned @ white)[..., 0].sum(axis=0) - off,
        (poses_turned @ white)[..., 0],
    )
