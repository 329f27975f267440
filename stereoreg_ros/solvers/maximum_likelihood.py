"""The pose of least squared distances in the slice: maximum likelihood for Gaussian spot noise, many poses at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation, rotation_exp
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.ls_tz import solve_ls_tz
from stereoreg_ros.solvers.newton_raphson import solve_newton_raphson
from stereoreg_ros.solvers.pose_solution import PoseSolution, is_same

# Relative decrease of chi-square below which a step no longer matters.
_STILL = 1e-9
_FIRST_DAMPING = 1e-3
_LARGEST_DAMPING = 1e8
# Four rods near a degenerate arrangement make a long valley; few poses need more than ten.
_PATIENCE = 300
# From different starts the steps end within 0.01 mm of an optimum; two optima are millimetres apart.
_SAME_MM, _SAME_RAD = 0.05, 1e-3


class Refined(NamedTuple):
    """Refined poses, m of them.

    rotations (m, 3, 3) and translations (m, 3) mm of slice_from_frame; chi_square (m,): sum of squared residuals over
    the noise; information (m, 6, 6): J'J at the solution, the inverse of the pose's covariance, in the perturbation
    of `Pose.perturbed`; converged (m,); cuts: where the poses have the rods cut the slice.
    """

    rotations: Array
    translations: Array
    chi_square: Array
    information: Array
    converged: NDArray[np.bool_]
    cuts: Cuts

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Refined:
        """Only the given poses."""
        return Refined(
            self.rotations[rows],
            self.translations[rows],
            self.chi_square[rows],
            self.information[rows],
            self.converged[rows],
            self.cuts.take(rows),
        )


def refine(
    frame: Frame,
    rotations: Array,
    translations: Array,
    spots_mm: Array,
    used: NDArray[np.bool_],
    whitening: Array,
    iterations: int = 30,
    common: Array | None = None,
) -> Refined:
    """Refine m poses slice_from_frame by Levenberg-Marquardt on the residuals in the slice.

    rotations (m, 3, 3), translations (m, 3) mm: where to start. spots_mm (m, n, 2): the spot of each rod, in mm in the
    slice, anything where used (m, n) is false. whitening, (m, n, 2, 2) or (2, 2) for all alike, 1/mm: turns a residual
    in mm into one of unit variance, S^-1 / sigma for isotropic noise of sigma pixel. common: (m, n, 2, k) mm, errors
    that all spots share: how far each spot moves by one standard deviation of each of k of them. The likelihood is that
    with these errors integrated out; chi_square and information are those of that likelihood.
    """
    m = len(rotations)
    target = np.where(used[..., None], spots_mm, 0.0)
    state = evaluate(frame, rotations, translations, target, used, whitening, common)
    # Where poses at rest are written to; the others go on among themselves.
    ended = Evaluated(*(part.copy() for part in state))
    converged = np.zeros(m, dtype=bool)
    whitening = np.broadcast_to(whitening, (m, len(frame), 2, 2))
    rows, damping = np.arange(m), np.full(m, _FIRST_DAMPING)
    for number in range(iterations if m else 0):
        damped = state.information.copy()
        diagonal = np.einsum("mii->mi", damped)
        # The floor keeps a direction that the spots do not determine at all from making the system singular.
        diagonal += damping[:, None] * diagonal + (1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-12)
        step: Array = np.linalg.solve(damped, state.gradient[..., None])[..., 0].astype(np.float64, copy=False)
        turned = rotation_exp(step[:, 3:]) @ state.rotations
        tried = evaluate(frame, turned, state.translations + step[:, :3], target, used, whitening, common)
        old = state.chi_square
        # A pose that loses a cut has NaN here, which is not better.
        better = tried.chi_square <= old
        gain = np.abs(old - tried.chi_square)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        state = tried if better.all() else state.replaced(tried, better)
        settled = better & (gain <= _STILL * (1.0 + old))
        stuck = damping > _LARGEST_DAMPING
        resting = settled | stuck
        if resting.any() or number == iterations - 1:
            for kept, now in zip(ended, state, strict=True):
                kept[rows] = now
            # No step however short helps: at the optimum to rounding, or at a cut that is about to be lost.
            converged[rows] = settled | (stuck & (gain <= 1e-6 * (1.0 + old)))
            if resting.all():
                break
            going = ~resting
            rows, damping, target, used = rows[going], damping[going], target[going], used[going]
            whitening = whitening[going]
            common = None if common is None else common[going]
            state = Evaluated(*(part[going] for part in state))
    cuts = cut(frame, ended.rotations, ended.translations)
    return Refined(ended.rotations, ended.translations, ended.chi_square, ended.information, converged, cuts)


def solve_maximum_likelihood(
    frame: Frame, lines: NDArray[np.intp], spots_px: Array, scale: PixelScale
) -> list[PoseSolution]:
    """Least squared residuals in the image, from every closed-form and Newton-Raphson solution; least residual first.

    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    starts = [*solve_newton_raphson(frame, lines, spots_px, scale), *solve_ls_tz(frame, lines, spots_px, scale)]
    if not starts:
        return []
    slice_from_frame = [start.frame_from_slice.inverse() for start in starts]
    spots_mm = np.zeros((len(frame), 2))
    used = np.zeros(len(frame), dtype=bool)
    spots_mm[lines], used[lines] = scale.to_mm(np.asarray(spots_px, dtype=np.float64)), True
    m = len(starts)
    refined = refine(
        frame,
        np.array([pose.rotation for pose in slice_from_frame]),
        np.array([pose.translation for pose in slice_from_frame]),
        np.broadcast_to(spots_mm, (m, *spots_mm.shape)),
        np.broadcast_to(used, (m, len(frame))),
        scale.inverse_matrix,
        _PATIENCE,
    )
    found: list[tuple[float, PoseSolution]] = []
    for i in np.argsort(refined.chi_square, kind="stable"):
        if not refined.converged[i]:
            continue
        found_pose = Pose(nearest_rotation(refined.rotations[i]), refined.translations[i]).inverse()
        solution = PoseSolution(found_pose, True, 0)
        if not any(is_same(solution, other, _SAME_MM, _SAME_RAD) for _, other in found):
            found.append((float(refined.chi_square[i]), solution))
    return [solution for _, solution in found]


class Evaluated(NamedTuple):
    """Poses (m, 3, 3), (m, 3) mm with chi-square (m,), J'J (m, 6, 6) and J'r (m, 6) of their whitened residuals r."""

    rotations: Array
    translations: Array
    chi_square: Array
    information: Array
    gradient: Array

    def replaced(self, other: Evaluated, rows: NDArray[np.bool_]) -> Evaluated:
        """These poses, but in the given rows those of another state."""
        return Evaluated(
            *(
                np.where(rows.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
                for new, old in zip(other, self, strict=True)
            )
        )


def evaluate(
    frame: Frame,
    rotations: Array,
    translations: Array,
    target: Array,
    used: NDArray[np.bool_],
    whitening: Array,
    common: Array | None = None,
) -> Evaluated:
    """Chi-square and its slope at poses slice_from_frame; arguments as in `refine`, without its broadcasting."""
    m, n = used.shape
    cuts = cut(frame, rotations, translations)
    mask = used[..., None]
    residual = (whitening @ np.where(mask, target - cuts.points_mm, 0.0)[..., None]).reshape(m, 2 * n, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = whitening @ cut_jacobian(cuts, translations)
    flat = np.where(mask[..., None], jacobian, 0.0).reshape(m, 2 * n, 6)
    turned = np.swapaxes(flat, 1, 2)
    chi_square = np.einsum("mki,mki->m", residual, residual)
    information, gradient = turned @ flat, turned @ residual
    if common is not None:
        # The covariance of all residuals is I + N N', whose inverse is I - N (I + N'N)^-1 N' (Woodbury).
        moved = np.where(mask[..., None], whitening @ common, 0.0).reshape(m, 2 * n, -1)
        moved_turned = np.swapaxes(moved, 1, 2)
        inner = np.linalg.inv(np.eye(moved.shape[2]) + moved_turned @ moved)
        by_pose, by_residual = moved_turned @ flat, moved_turned @ residual
        shared = inner @ by_residual
        information = information - np.swapaxes(by_pose, 1, 2) @ inner @ by_pose
        gradient = gradient - np.swapaxes(by_pose, 1, 2) @ shared
        chi_square = chi_square - np.einsum("mki,mki->m", by_residual, shared)
    return Evaluated(rotations, translations, chi_square, information, gradient[..., 0])
