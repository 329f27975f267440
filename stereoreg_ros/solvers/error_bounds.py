"""How far errors of the spots can carry a solution, to first order: the polytope of Maurin 2009, section 3.2."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, skew
from stereoreg_ros.solvers.calibration import calibrate_linear
from stereoreg_ros.solvers.linear_system import SCALE_RANK, linear_system

# Sine of an angle below which two directions are one.
_PARALLEL = 1e-10


class LinearErrorModel:
    """dx = sensitivity @ dE: errors of unknowns x (k,) for errors dE = (du_1..du_n, dv_1..dv_n) of the spots, pixel.

    sensitivity: (k, 2n), in units of x per pixel.
    """

    sensitivity: Array

    def __init__(self, sensitivity: Array) -> None:
        self.sensitivity = sensitivity

    def bounds_box(self, max_error_px: ArrayLike) -> tuple[Array, Array]:
        """Least and greatest dx, both (k,), where no coordinate of a spot is off by more than `max_error_px`.

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
        """Least and greatest d' dx for dE within its limits (2n,), (2n,), the linear programme of eq. 16.

        With the unit vectors these are the bounds of the components; other directions give a tighter polytope.
        """
        cost = np.asarray(direction, dtype=np.float64) @ self.sensitivity
        low = np.broadcast_to(np.asarray(low_errors_px, dtype=np.float64), cost.shape)
        high = np.broadcast_to(np.asarray(high_errors_px, dtype=np.float64), cost.shape)
        if not (low <= high).all():
            raise ValueError("low_errors_px must not exceed high_errors_px")
        # Each coordinate goes to one of its limits, whatever the others do.
        at_low, at_high = cost * low, cost * high
        return float(np.minimum(at_low, at_high).sum()), float(np.maximum(at_low, at_high).sum())

    def greatest_length(self, max_error_px: ArrayLike) -> tuple[float, Array]:
        """The greatest |dx| of a part of three components, k = 3, over the box, and the corner dE (2n,) that has it.

        max_error_px: as in `bounds_box`. The length is convex, so that a corner of the box has the greatest, and the
        image of the box is a zonotope: only the corners that are extreme in some direction need be looked at.
        """
        limits = np.broadcast_to(np.asarray(max_error_px, dtype=np.float64), self.sensitivity.shape[1])
        signs = _extreme_signs((self.sensitivity * limits).T)
        lengths = np.linalg.norm((signs * limits) @ self.sensitivity.T, axis=1)
        best = int(lengths.argmax())
        corner: Array = signs[best] * limits
        return float(lengths[best]), corner


def _extreme_signs(generators: Array) -> Array:
    """Signs (c, m) of the vertices of the zonotope that the segments +-generators (m, 3) span; half of each pair.

    A vertex lies on an edge along some generator, and the edge on a face along this and another one: the face's normal
    gives the signs of all others. Those that lie in the face are told by the direction in it across the edge, and those
    along the edge by the edge.
    """
    m = len(generators)
    size = np.linalg.norm(generators, axis=1).max(initial=0.0)
    if not size:
        return np.ones((1, m))
    unit = generators / size
    # A pair of one with itself stands for generators that are all parallel.
    first, second = (part.ravel() for part in np.indices((m, m)))
    normals = np.asarray(np.cross(unit[first], unit[second]), dtype=np.float64)
    across = np.asarray(np.cross(normals, unit[first]), dtype=np.float64)
    levels = [_signs(directions, unit) for directions in (normals, across, unit[first])]
    found = []
    for by_across in (1.0, -1.0):
        for by_edge in (1.0, -1.0):
            signs = levels[0]
            for level in (by_across * levels[1], by_edge * levels[2]):
                signs = np.where(signs == 0, level, signs)
            found.append(signs)
    signs = np.concatenate(found)
    # What no direction tells has no length.
    return np.unique(np.where(signs == 0, 1.0, signs), axis=0)


def _signs(directions: Array, unit: Array) -> Array:
    """Signs (d, m) of the products of directions (d, 3) and generators (m, 3), 0 where they are zero to rounding."""
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    along = np.divide(directions, lengths, out=np.zeros_like(directions), where=lengths > _PARALLEL)
    products = along @ unit.T
    signs: Array = np.where(np.abs(products) <= _PARALLEL * np.linalg.norm(unit, axis=1), 0.0, np.sign(products))
    return signs


class CalibrationErrorModel(LinearErrorModel):
    """Errors of the linear calibration's x = (l1, l2, t).

    sensitivity: (9, 2n) = (A'A)^-1 M of eq. 15, in mm/pixel per pixel for l1, l2 and mm per pixel for t.
    """

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
        super().__init__(np.linalg.pinv(a.T @ a, hermitian=True, rcond=1e-15) @ m)
