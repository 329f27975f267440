"""From a line of solutions xi = a + c b of the linear system to poses: appendix A of Maurin 2009."""

from __future__ import annotations

import numpy as np

from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation
from stereoreg_ros.solvers.linear_system import LinearSystem
from stereoreg_ros.solvers.pose_solution import PoseSolution


def orthogonality_roots(a: Array, b: Array) -> list[float]:
    """The c of eq. 31, r1 . r2 = 0 with r1 = a[:3] + c b[:3] and r2 = a[3:6] + c b[3:6]: two, one, or none.

    Where noise has pushed a double root off the real axis, the nearest real one stands for it.
    """
    quadratic = float(b[:3] @ b[3:6])
    linear = float(a[:3] @ b[3:6] + a[3:6] @ b[:3])
    constant = float(a[:3] @ a[3:6])
    if abs(quadratic) <= 1e-14 * (abs(linear) + abs(constant)):
        return [-constant / linear] if linear else []
    discriminant = linear**2 - 4 * quadratic * constant
    if discriminant <= 0:
        return [-linear / (2 * quadratic)]
    # The form that does not cancel.
    first = -(linear + np.copysign(np.sqrt(discriminant), linear)) / 2
    return [first / quadratic, constant / first] if first else [0.0, -linear / quadratic]


def unit_length_violation(system: LinearSystem, xi: Array) -> float:
    """How far the columns of a solution (9,) are from unit length: what tells true roots of eq. 31 from false ones."""
    r1, r2, _ = system.affine(xi)
    return float((r1 @ r1 - 1) ** 2 + (r2 @ r2 - 1) ** 2)


def poses(system: LinearSystem, a: Array, b: Array, roots: list[float]) -> list[PoseSolution]:
    """Poses of the given c, those of nearly unit columns first."""
    candidates = sorted((a + c * b for c in roots), key=lambda xi: unit_length_violation(system, xi))
    return [pose(system, xi) for xi in candidates]


def pose(system: LinearSystem, xi: Array, converged: bool = True, iterations: int = 0) -> PoseSolution:
    """The pose of a solution (9,): its rotation is the nearest to (r1 r2 r1xr2) (Maurin 2009, section 4.1)."""
    r1, r2, t = system.affine(xi)
    rotation = nearest_rotation(np.column_stack([r1, r2, np.cross(r1, r2)]))
    return PoseSolution(Pose(rotation, t), converged, iterations)
