"""LS-TZ: pose from four rods or more with one unknown as pivot (Maurin 2009, section 4.2, eq. 26)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.linear_system import POSE_RANK, LinearSystem, linear_system
from stereoreg_ros.solvers.one_parameter import orthogonality_roots, poses
from stereoreg_ros.solvers.pose_solution import PoseSolution

# The paper's pivot is tz. It serves only where the open direction of the solutions has a share in it: of the unit
# vector of that direction, this much at least. Otherwise the unknown with the largest share is the pivot.
_LEAST_SHARE = 0.05
_TZ = 8


def solve_ls_tz(frame: Frame, lines: NDArray[np.intp], spots_px: Array, scale: PixelScale) -> list[PoseSolution]:
    """One pseudo-inverse, every unknown affine in the pivot, the pivot from r1 . r2 = 0 (eq. 26, 31); best first.

    Raises DegenerateArrangementError, ValueError as `linear_system` does.
    """
    return solve_system(linear_system(frame, lines, scale.to_mm(np.asarray(spots_px, dtype=np.float64)), POSE_RANK))


def solve_system(system: LinearSystem) -> list[PoseSolution]:
    """As `solve_ls_tz`, for a system over mm that is known to be sound."""
    open_direction = np.linalg.svd(system.matrix)[2][8]
    pivot = _TZ if abs(open_direction[_TZ]) >= _LEAST_SHARE else int(np.argmax(np.abs(open_direction)))
    others = np.arange(9) != pivot
    right_sides = np.column_stack([system.right_side, -system.matrix[:, pivot]])
    affine = np.linalg.lstsq(system.matrix[:, others], right_sides, rcond=None)[0]
    a, b = np.zeros(9), np.zeros(9)
    a[others], b[others] = affine[:, 0], affine[:, 1]
    b[pivot] = 1.0
    return poses(system, a, b, orthogonality_roots(a, b))
