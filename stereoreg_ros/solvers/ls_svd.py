"""LS-SVD and LS-SVD (DR): pose from four rods or more by singular vectors (Maurin 2009, section 4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.linear_system import POSE_RANK, LinearSystem, linear_system
from stereoreg_ros.solvers.one_parameter import orthogonality_roots, poses
from stereoreg_ros.solvers.pose_solution import PoseSolution


def solve_ls_svd(frame: Frame, lines: NDArray[np.intp], spots_px: Array, scale: PixelScale) -> list[PoseSolution]:
    """Both candidates for c from the orthogonality r1 . r2 = 0 alone (eq. 24, 25, 31), best first.

    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    system = linear_system(frame, lines, scale.to_mm(np.asarray(spots_px, dtype=np.float64)), POSE_RANK)
    a, b = _family(system)
    return poses(system, a, b, orthogonality_roots(a, b))


def solve_ls_svd_dr(frame: Frame, lines: NDArray[np.intp], spots_px: Array, scale: PixelScale) -> list[PoseSolution]:
    """c from all three constraints, |r1| = 1, |r2| = 1, r1 . r2 = 0, stacked (eq. 29-32): one solution, or none.

    The singular vector of the smallest singular value is proportional to (1, c, c^2); of its two ratios and their mean
    that one is c which violates the constraints least.
    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    system = linear_system(frame, lines, scale.to_mm(np.asarray(spots_px, dtype=np.float64)), POSE_RANK)
    a, b = _family(system)
    unit = system.spread**2  # |r|^2 = 1, in the normalised unknowns
    a1, a2, b1, b2 = a[:3], a[3:6], b[:3], b[3:6]
    # c is of the size of a over b: measured in that unit, the three columns are alike.
    size = float(np.linalg.norm(a[:6]) / np.linalg.norm(b[:6]))
    stacked = np.array(
        [
            [a1 @ a1 - unit, 2 * (a1 @ b1) * size, b1 @ b1 * size**2],
            [a2 @ a2 - unit, 2 * (a2 @ b2) * size, b2 @ b2 * size**2],
            [a1 @ a2, (a1 @ b2 + a2 @ b1) * size, b1 @ b2 * size**2],
        ]
    )
    vector = np.linalg.svd(stacked)[2][2]
    if min(abs(vector[0]), abs(vector[1])) < 1e-12:
        return []
    first, second = vector[1] / vector[0], vector[2] / vector[1]
    candidates = np.array([first, second, (first + second) / 2])
    violation = ((stacked @ np.stack([np.ones(3), candidates, candidates**2])) ** 2).sum(axis=0)
    return poses(system, a, b, [float(size * candidates[violation.argmin()])])


def _family(system: LinearSystem) -> tuple[Array, Array]:
    """a, b of xi = a + c b: the solution in the eight leading singular vectors, and the ninth (steps 1-4)."""
    left, values, right = np.linalg.svd(system.matrix)
    projected = left.T @ system.right_side
    return right[:8].T @ (projected[:8] / values[:8]), right[8]
