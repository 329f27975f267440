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
) -> Refined:
    """Refine m poses slice_from_frame by Levenberg-Marquardt on the residuals in the slice.

    rotations (m, 3, 3), translations (m, 3) mm: where to start. spots_mm (m, n, 2): the spot of each rod, in mm in the
    slice, anything where used (m, n) is false. whitening (2, 2) 1/mm: turns a residual in mm into one of unit
    variance, S^-1 / sigma for isotropic noise of sigma pixel.
    """
    m = len(rotations)
    rotations, translations = rotations.copy(), translations.copy()
    target = np.where(used[..., None], spots_mm, 0.0)
    residual, information, gradient, cuts = _normal_equations(frame, rotations, translations, target, used, whitening)
    chi_square = np.einsum("mnk,mnk->m", residual, residual)
    damping = np.full(m, _FIRST_DAMPING)
    converged = np.zeros(m, dtype=bool)
    active = np.arange(m)
    for _ in range(iterations):
        if not active.size:
            break
        diagonal = np.einsum("mii->mi", information[active])
        # The floor keeps a direction that the spots do not determine at all from making the system singular.
        floor = 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-12
        damped = information[active].copy()
        np.einsum("mii->mi", damped)[:] += damping[active, None] * diagonal + floor
        step = np.asarray(np.linalg.solve(damped, gradient[active][..., None])[..., 0], dtype=np.float64)
        tried_rotations = rotation_exp(step[:, 3:]) @ rotations[active]
        tried_translations = translations[active] + step[:, :3]
        new = _normal_equations(frame, tried_rotations, tried_translations, target[active], used[active], whitening)
        new_chi_square = np.einsum("mnk,mnk->m", new[0], new[0])
        old = chi_square[active]
        # A pose that loses a cut has NaN here, which is not better.
        better = new_chi_square <= old
        gain = old - new_chi_square
        settled = np.abs(gain) <= _STILL * (1.0 + old)
        taken = active[better]
        rotations[taken], translations[taken] = tried_rotations[better], tried_translations[better]
        information[taken], gradient[taken] = new[1][better], new[2][better]
        chi_square[taken] = new_chi_square[better]
        damping[active] = np.where(better, damping[active] * 0.1, damping[active] * 10.0)
        converged[active[settled & better]] = True
        stuck = damping[active] > _LARGEST_DAMPING
        # No step however short helps: at the optimum to rounding, or at a cut that is about to be lost.
        converged[active[stuck & (np.abs(gain) <= 1e-6 * (1.0 + old))]] = True
        active = active[~(settled & better) & ~stuck]
    cuts = cut(frame, rotations, translations)
    return Refined(rotations, translations, chi_square, information, converged, cuts)


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


def _normal_equations(
    frame: Frame,
    rotations: Array,
    translations: Array,
    target: Array,
    used: NDArray[np.bool_],
    whitening: Array,
) -> tuple[Array, Array, Array, Cuts]:
    """Whitened residuals (m, n, 2), J'J (m, 6, 6), J'r (m, 6) and the cuts."""
    cuts = cut(frame, rotations, translations)
    mask = used[..., None]
    residual = np.where(mask, target - cuts.points_mm, 0.0) @ whitening.T
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = np.where(mask[..., None], whitening @ cut_jacobian(cuts, translations), 0.0)
    m, n = used.shape
    flat = jacobian.reshape(m, 2 * n, 6)
    turned = np.swapaxes(flat, 1, 2)
    gradient = (turned @ residual.reshape(m, 2 * n, 1))[..., 0]
    return residual, turned @ flat, gradient, cuts
