"""Scale unknown, correspondences known: pixel scale and pose from five or more rods (Maurin 2009, section 3).

The unknown is x = (l1, l2, t) in R^9, with p_frame = l1 u + l2 v + t: l1, l2 in mm/pixel, t in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation, skew
from stereoreg_ros.geometry.slice import PixelScale

MIN_LINES = 5
# Smallest singular value of the normalised system over its largest below which the rods fix no scale.
_SINGULAR = 1e-6
_MAX_ITERATIONS = 50
_CONVERGED = 1e-12


class DegenerateCalibrationError(ValueError):
    """Rods and spots from which no scale follows; the text says why."""


@dataclass(frozen=True, eq=False)
class ScaleSolution:
    """A pixel scale with its pose.

    scale: mm/pixel, without shear; frame_from_slice: mm, its rotation the nearest to [r1 r2 r1xr2];
    unknowns: x (9,); converged, iterations: of the Newton-Raphson steps, true and 0 for the linear solution.
    """

    scale: PixelScale
    frame_from_slice: Pose
    unknowns: Array
    converged: bool
    iterations: int


def solve_linear(frame: Frame, lines: NDArray[np.intp], spots_px: Array) -> ScaleSolution:
    """Linear least squares (Maurin 2009, eq. 10-12) for the spots (n, 2) of the given rods (n,), n >= 5.

    Raises DegenerateCalibrationError where the rods are too few or do not fix the scale.
    """
    system = _System(frame, lines, spots_px)
    return system.solution(system.least_squares(), True, 0)


def solve_newton_raphson(frame: Frame, lines: NDArray[np.intp], spots_px: Array) -> ScaleSolution:
    """Least squares with the constraint l1 . l2 = 0, by Newton-Raphson from the linear solution (eq. 17-23).

    Raises DegenerateCalibrationError as `solve_linear` does, and where a step has no solution.
    """
    system = _System(frame, lines, spots_px)
    a, b = system.matrix, system.right_side
    hessian = 2 * a.T @ a
    # h(x) = x' C x / 2 = l1 . l2 (half of the paper's h, whose C is this one: the constraint is the same).
    c = np.zeros((9, 9))
    c[:3, 3:6] = c[3:6, :3] = np.eye(3)
    x = system.least_squares()
    multiplier = 0.0
    for iteration in range(1, _MAX_ITERATIONS + 1):
        normal = c @ x
        kkt = np.zeros((10, 10))
        kkt[:9, :9] = hessian + multiplier * c
        kkt[:9, 9] = kkt[9, :9] = normal
        gradient = hessian @ x - 2 * a.T @ b + multiplier * normal
        try:
            step = np.linalg.solve(kkt, -np.append(gradient, x @ normal / 2))
        except np.linalg.LinAlgError:
            raise DegenerateCalibrationError("the Newton-Raphson step has no solution") from None
        x = x + step[:9]
        multiplier += float(step[9])
        if np.abs(step[:9]).max() <= _CONVERGED * np.abs(x).max():
            return system.solution(x, True, iteration)
    return system.solution(x, False, _MAX_ITERATIONS)


class _System:
    """A x = b of eq. 12, over pixels moved to their centroid and divided by their spread, for good condition."""

    def __init__(self, frame: Frame, lines: NDArray[np.intp], spots_px: Array) -> None:
        lines = np.asarray(lines)
        spots_px = np.asarray(spots_px, dtype=np.float64)
        if spots_px.shape != (len(lines), 2):
            raise ValueError(f"spots_px has shape {spots_px.shape}, expected ({len(lines)}, 2), a spot for each line")
        if len(lines) < MIN_LINES:
            raise DegenerateCalibrationError(f"{len(lines)} rods are identified, the scale needs at least {MIN_LINES}")
        self.centre = spots_px.mean(axis=0)
        self.spread = float(np.abs(spots_px - self.centre).max())
        if self.spread == 0:
            raise DegenerateCalibrationError("all spots are in one place")
        homogeneous = np.column_stack([(spots_px - self.centre) / self.spread, np.ones(len(lines))])
        blocks = homogeneous[:, None, :, None] * skew(frame.directions[lines])[:, :, None, :]
        self.matrix = blocks.reshape(-1, 9)
        self.right_side = frame.moments[lines].reshape(-1)

    def least_squares(self) -> Array:
        left, values, right = np.linalg.svd(self.matrix, full_matrices=False)
        if values[-1] < _SINGULAR * values[0]:
            raise DegenerateCalibrationError(
                f"the rods do not fix the scale: singular values down to {values[-1] / values[0]:.1e} of the largest"
            )
        x: Array = right.T @ ((left.T @ self.right_side) / values)
        return x

    def solution(self, normalised: Array, converged: bool, iterations: int) -> ScaleSolution:
        l1, l2 = normalised[:3] / self.spread, normalised[3:6] / self.spread
        t = normalised[6:] - l1 * self.centre[0] - l2 * self.centre[1]
        sx, sy = float(np.linalg.norm(l1)), float(np.linalg.norm(l2))
        r1, r2 = l1 / sx, l2 / sy
        rotation = nearest_rotation(np.column_stack([r1, r2, np.cross(r1, r2)]))
        return ScaleSolution(PixelScale(sx, sy), Pose(rotation, t), np.concatenate([l1, l2, t]), converged, iterations)
