"""One pixel scale from several slices of a frame whose rods are known to a tolerance only: maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.identified import IdentifiedSpots, ScaleAndPoses, linearised

_ITERATIONS = 60
_STILL = 1e-12
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-6, 1e10


@dataclass(frozen=True, eq=False)
class TolerantScale:
    """A pixel scale with the poses of m slices and the rods where they fit best.

    at: scale and poses; covariance: (q, q) of as many of (sx, sy, shear) as were measured, mm^2/pixel^2, for the spots'
    covariances and the rods' tolerances together; frame_covariance: (q, q), the part of it that the rods' tolerances
    bring; frame: with the rods' ends moved; residuals_px: (m, n, 2), spot less prediction, zero where a rod has no
    spot; chi_square, degrees_of_freedom: of all residuals and of the rods' displacements together; converged.
    """

    at: ScaleAndPoses
    covariance: Array
    frame_covariance: Array
    frame: Frame
    residuals_px: Array
    chi_square: float
    degrees_of_freedom: int
    converged: bool

    @property
    def scale(self) -> PixelScale:
        """mm/pixel."""
        return self.at.scale


def calibrate_tolerantly(
    frame: Frame,
    tolerances_mm: Array,
    identified: IdentifiedSpots,
    start: ScaleAndPoses,
    measured: int = 2,
) -> TolerantScale:
    """Least squares of the whitened residuals over the scale, the poses of m slices and the ends of n rods.

    tolerances_mm: (n,), standard deviation per axis of each rod's ends. How far an end is off is the same in every
    slice: more slices do not average it away. start: near the solution. measured: how many of (sx, sy, shear) are
    unknown, 0, 2 or 3; the others stay.
    """
    rods = _LooseRods(frame, tolerances_mm, identified, identified.whitening(), measured)
    at, displacements = start, np.zeros((len(frame), 6))
    state = rods.evaluated(at, displacements)
    damping, converged = _FIRST_DAMPING, False
    for _ in range(_ITERATIONS):
        common, by_pose = state.step(damping)
        moved = tried = None
        if np.isfinite(common).all():
            moved = at.moved(np.concatenate([common[:measured], np.zeros(3 - measured)]), by_pose)
        displaced = displacements + common[measured:].reshape(-1, 6)
        if moved is not None:
            tried = rods.evaluated(moved, displaced)
        if moved is not None and tried is not None and tried.chi_square <= state.chi_square:
            gain = state.chi_square - tried.chi_square
            at, displacements, state, damping = moved, displaced, tried, 0.1 * damping
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
        at,
        covariance,
        frame_covariance,
        rods.displaced(displacements),
        state.residuals_px,
        state.chi_square,
        int(2 * identified.used.sum()) - 6 * len(at.rotations) - measured,
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


def _by_ends(frame: Frame, cuts: Cuts, rotations: Array) -> Array:
    """d points_mm / d (start, end), (m, n, 2, 6), of each rod in the frame's axes."""
    # A point of the rod that moves by dp moves the cut by dp_xy - slope dp_z: the rod slides through the plane.
    slide = np.zeros((*cuts.lambdas.shape, 2, 3))
    slide[..., 0, 0] = slide[..., 1, 1] = 1.0
    slide[..., 2] = -cuts.directions[..., :2] / cuts.directions[..., 2:]
    by_point = slide @ rotations[:, None]
    along = ((cuts.lambdas - frame.lambda_min) / (frame.lambda_max - frame.lambda_min))[..., None, None]
    return np.concatenate([(1.0 - along) * by_point, along * by_point], axis=-1)


class _LooseRods(NamedTuple):
    """What is fitted: a frame whose rods' ends are known to tolerances (n,) mm, to the spots of these rods."""

    frame: Frame
    tolerances_mm: Array
    identified: IdentifiedSpots
    whitening: Array
    measured: int

    def displaced(self, displacements: Array) -> Frame:
        """The frame with its rods' ends displaced by (n, 6), start then end, in units of their tolerances."""
        off_mm = self.tolerances_mm[:, None] * displacements
        return replace(self.frame, starts=self.frame.starts + off_mm[:, :3], ends=self.frame.ends + off_mm[:, 3:])

    def evaluated(self, at: ScaleAndPoses, displacements: Array) -> _State:
        """The normal equations at a scale, poses and displacements."""
        frame, measured = self.displaced(displacements), self.measured
        (m, n), mask = self.identified.used.shape, self.identified.used[..., None, None]
        now = linearised(frame, at, self.identified, self.whitening)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_ends = at.scale.inverse_matrix @ _by_ends(frame, now.cuts, at.rotations)
            by_ends = by_ends * self.tolerances_mm[:, None, None]
        # Of the rods' ends, each spot knows only those of its own.
        rod, of_rods = np.arange(n), np.zeros((m, n, 2, n, 6))
        of_rods[:, rod, :, rod] = np.swapaxes(np.where(mask, self.whitening @ by_ends, 0.0), 0, 1)
        of_scale = now.by_scale[..., :measured]
        common = np.concatenate([of_scale, of_rods.reshape(m, n, 2, 6 * n)], axis=-1).reshape(m, 2 * n, -1)
        turned, poses_turned = np.swapaxes(common, 1, 2), np.swapaxes(now.by_pose, 1, 2)
        known = np.concatenate([np.zeros(measured), np.ones(6 * n)])
        off = np.concatenate([np.zeros(measured), displacements.ravel()])
        chi_square = float((now.white**2).sum() + (off**2).sum())
        return _State(
            now.residuals_px,
            chi_square if np.isfinite(chi_square) else float("inf"),
            (turned @ common).sum(axis=0) + np.diag(known),
            poses_turned @ common,
            poses_turned @ now.by_pose,
            (turned @ now.white)[..., 0].sum(axis=0) - off,
            (poses_turned @ now.white)[..., 0],
        )
