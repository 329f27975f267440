"""How far errors of the spots can carry the linear calibration: first-order bounds (Maurin 2009, section 3.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, skew
from stereoreg_ros.solvers.calibration import calibrate_linear
from stereoreg_ros.solvers.linear_system import SCALE_RANK, linear_system


class CalibrationErrorModel:
    """dx = sensitivity @ dE: errors of x = (l1, l2, t) for errors dE = (du_1..du_n, dv_1..dv_n) of the spots.

    sensitivity: (9, 2n) = (A'A)^-1 M of eq. 15, in mm/pixel per pixel for l1, l2 and mm per pixel for t.
    """

    sensitivity: Array

    def __init__(self, frame: Frame, lines: NDArray[np.intp], spots_px: Array) -> None:
        """Linearise at the linear solution for the spots (n, 2) of the rods (n,); raises as `calibrate_linear` does."""
        spots_px = np.asarray(spots_px, dtype=np.float64)
        linear_system(frame, lines, spots_px, SCALE_RANK)  # raises where the arrangement is degenerate
        x = calibrate_linear(frame, lines, spots_px).unknowns
        n = len(lines)
        crosses = skew(frame.directions[lines])
        homogeneous = np.column_stack([spots_px, np.ones(n)])
        a = (homogeneous[:, None, :, None] * crosses[:, :, None, :]).reshape(3 * n, 9)
        residual = frame.moments[lines].reshape(-1) - a @ x
        m = np.empty((9, 2 * n))
        for spot in range(n):
            rows = slice(3 * spot, 3 * spot + 3)
            for coordinate, column in ((0, spot), (1, n + spot)):
                # dA has one block, [y]x in the columns of l1 or l2 (eq. 13); A'A dx = dA'(b - A x) - A' dA x (eq. 14).
                block = slice(3 * coordinate, 3 * coordinate + 3)
                m[:, column] = -a[rows].T @ (crosses[spot] @ x[block])
                m[block, column] += crosses[spot].T @ residual[rows]
        self.sensitivity = np.linalg.pinv(a.T @ a, hermitian=True, rcond=1e-15) @ m

    def bounds_box(self, max_error_px: ArrayLike) -> tuple[Array, Array]:
        """Least and greatest dx (9,), (9,) where no coordinate of a spot is off by more than `max_error_px`.

        max_error_px: one number, or (2n,). Over a box the linear programme has this closed form.
        """
        limits = np.broadcast_to(np.asarray(max_error_px, dtype=np.float64), self.sensitivity.shape[1])
        if not (limits >= 0).all():
            raise ValueError("max_error_px must not be negative")
        reach = np.abs(self.sensitivity) @ limits
        return -reach, reach

    def bound_in_direction(
        self, direction: ArrayLike, low_errors_px: ArrayLike, high_errors_px: ArrayLike
    ) -> tuple[float, float]:
        """Least and greatest d' dx for dE within its limits (2n,), (2n,), by linear programming (eq. 16).

        With the nine unit vectors these are the bounds of the components; other directions give a tighter polytope.
        """
        cost = np.asarray(direction, dtype=np.float64) @ self.sensitivity
        low = np.broadcast_to(np.asarray(low_errors_px, dtype=np.float64), cost.shape)
        high = np.broadcast_to(np.asarray(high_errors_px, dtype=np.float64), cost.shape)
        if not (low <= high).all():
            raise ValueError("low_errors_px must not exceed high_errors_px")
        limits = np.column_stack([low, high])
        # The programme is scaled to numbers near one: the solver's tolerances are absolute.
        unit = max(float(np.abs(cost).max()), 1e-300)
        least, greatest = (linprog(sign * cost / unit, bounds=limits, method="highs") for sign in (1.0, -1.0))
        return float(least.fun * unit), float(-greatest.fun * unit)
