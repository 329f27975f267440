"""Newton-Raphson on least squares with equality constraints (Maurin 2009, section 3.3), for scale and for pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.linear_system import POSE_RANK, LinearSystem, linear_system
from stereoreg_ros.solvers.ls_tz import solve_system
from stereoreg_ros.solvers.one_parameter import pose
from stereoreg_ros.solvers.pose_solution import PoseSolution, is_same

_MAX_ITERATIONS = 50
_CONVERGED = 1e-13


def constraint_matrix(first: int, second: int) -> Array:
    """C (9, 9) with x' C x = a . b for the 3-vectors a, b at rows `first`, `second` of x (half the paper's C)."""
    c = np.zeros((9, 9))
    for axis in range(3):
        c[first + axis, second + axis] += 0.5
        c[second + axis, first + axis] += 0.5
    return c


def minimise(
    system: LinearSystem, constraints: Sequence[tuple[Array, float]], start: Array
) -> tuple[Array, Array, bool, int]:
    """Minimise |A x - b|^2 subject to x' C x = d for each (C, d): x, multipliers, whether it converged, iterations.

    Each step solves [[2 A'A + sum 2 mu C, 2 C x], [(2 C x)', 0]] (dx, mu_new) = -(2 A'(A x - b), x' C x - d)
    (eq. 21-23). Where that matrix is singular the steps end, not converged.
    """
    a, b = system.matrix, system.right_side
    gram, projected = 2 * a.T @ a, 2 * a.T @ b
    x, multipliers = start.copy(), np.zeros(len(constraints))
    m = len(constraints)
    for iteration in range(1, _MAX_ITERATIONS + 1):
        normals = np.column_stack([2 * c @ x for c, _ in constraints])
        kkt = np.zeros((9 + m, 9 + m))
        kkt[:9, :9] = gram + sum(2 * mu * c for mu, (c, _) in zip(multipliers, constraints, strict=True))
        kkt[:9, 9:], kkt[9:, :9] = normals, normals.T
        violation = np.array([x @ c @ x - d for c, d in constraints])
        try:
            step = np.linalg.solve(kkt, -np.concatenate([gram @ x - projected, violation]))
        except np.linalg.LinAlgError:
            return x, multipliers, False, iteration
        x, multipliers = x + step[:9], step[9:]
        if np.abs(step[:9]).max() <= _CONVERGED * np.abs(x).max():
            return x, multipliers, True, iteration
        if not np.isfinite(x).all():
            return start, multipliers, False, iteration
    return x, multipliers, False, _MAX_ITERATIONS


def pose_constraints(system: LinearSystem) -> list[tuple[Array, float]]:
    """|r1| = 1, |r2| = 1, r1 . r2 = 0 in the system's normalised unknowns."""
    unit = system.spread**2
    return [(constraint_matrix(0, 0), unit), (constraint_matrix(3, 3), unit), (constraint_matrix(0, 3), 0.0)]


def solve_newton_raphson(
    frame: Frame, lines: NDArray[np.intp], spots_px: Array, scale: PixelScale
) -> list[PoseSolution]:
    """Least squares in the frame with the three constraints, from each closed-form solution; least residual first.

    Solutions that did not converge are left out. Raises as `linear_system` does.
    """
    system = linear_system(frame, lines, scale.to_mm(np.asarray(spots_px, dtype=np.float64)), POSE_RANK)
    constraints = pose_constraints(system)
    found: list[tuple[float, PoseSolution]] = []
    for start in solve_system(system):
        r1, r2 = start.frame_from_slice.rotation[:, 0], start.frame_from_slice.rotation[:, 1]
        guess = system.normalised(r1, r2, start.frame_from_slice.translation)
        x, _, converged, iterations = minimise(system, constraints, guess)
        if converged:
            residual = float(((system.matrix @ x - system.right_side) ** 2).sum())
            solution = pose(system, x, converged, iterations)
            if not any(is_same(solution, other) for _, other in found):
                found.append((residual, solution))
    return [solution for _, solution in sorted(found, key=lambda one: one[0])]
