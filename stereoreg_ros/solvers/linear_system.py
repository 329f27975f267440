"""A x = b: what rods and their spots say of the affine map from the slice to the frame (Maurin 2009, eq. 12).

p_frame = a1 x + a2 y + t for a slice point (x, y): over pixels a1, a2 are l1, l2 (scale unknown), over mm r1, r2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, skew
from stereoreg_ros.solvers.arrangement import (
    Arrangement,
    DegenerateArrangementError,
    degenerate_arrangements,
    three_coplanar_lines,
)

# Condition number beyond which the system says nothing: spots are known to about a thousandth of their spread.
MAX_CONDITION = 1000.0
POSE_RANK, SCALE_RANK = 8, 9
# Spots that all lie within so little of their centroid, pixel or mm, are one place and the noise about it.
LEAST_SPREAD = 2.0


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """The system over points moved to their centroid and divided by their spread, for good condition.

    matrix: (3n, 9); right_side: (3n,) mm; centre: (2,), spread: of the points, in their unit.
    The least-squares solution does not depend on this normalisation.
    """

    matrix: Array
    right_side: Array
    centre: Array
    spread: float

    def affine(self, normalised: Array) -> tuple[Array, Array, Array]:
        """a1, a2 (3,) and t (3,) mm of a solution (9,)."""
        a1, a2 = normalised[:3] / self.spread, normalised[3:6] / self.spread
        return a1, a2, normalised[6:] - a1 * self.centre[0] - a2 * self.centre[1]

    def normalised(self, a1: Array, a2: Array, t: Array) -> Array:
        """The inverse of `affine`: (9,)."""
        moved = t + a1 * self.centre[0] + a2 * self.centre[1]
        return np.concatenate([a1 * self.spread, a2 * self.spread, moved])

    def least_squares(self) -> Array:
        """The (9,) that minimises |A x - b|: needs five lines or more."""
        return np.asarray(np.linalg.lstsq(self.matrix, self.right_side, rcond=None)[0], dtype=np.float64)


def linear_system(frame: Frame, lines: NDArray[np.intp], points: Array, rank: int) -> LinearSystem:
    """Set up the system for points (n, 2), in pixel or mm, of the given rods (n,).

    rank: what the system must have. Nine fixes the scale and takes five rods; eight, which four rods give, leaves one
    unknown to the orthonormality of the axes and fixes the pose.
    Raises DegenerateArrangementError where there are too few rods, or where rods and spots are arranged so
    that the condition over that rank is beyond MAX_CONDITION; ValueError on wrong shapes.
    """
    lines = np.asarray(lines)
    points = np.asarray(points, dtype=np.float64)
    if points.shape != (len(lines), 2):
        raise ValueError(f"spots have shape {points.shape}, expected ({len(lines)}, 2), a spot for each line")
    if not np.isfinite(points).all():
        raise ValueError("spots must be finite")
    n = len(lines)
    if 2 * n < rank:
        raise DegenerateArrangementError([Arrangement("too_few_lines", tuple(range(n)), float("inf"))], float("inf"))
    if np.abs(points - points.mean(axis=0)).max() < LEAST_SPREAD:
        raise DegenerateArrangementError(degenerate_arrangements(frame, lines, points), float("inf"))
    condition = condition_number(frame, lines, _without_noise(frame, lines, points), rank)
    if condition > MAX_CONDITION:
        raise DegenerateArrangementError(degenerate_arrangements(frame, lines, points), condition)
    return assemble(frame, lines, points)


def assemble(frame: Frame, lines: NDArray[np.intp], points: Array) -> LinearSystem:
    """The system as it is, unchecked."""
    centre = points.mean(axis=0)
    spread = max(float(np.abs(points - centre).max()), 1e-300)
    homogeneous = np.column_stack([(points - centre) / spread, np.ones(len(points))])
    blocks = homogeneous[:, None, :, None] * skew(frame.directions[lines])[:, :, None, :]
    return LinearSystem(blocks.reshape(-1, 9), frame.moments[lines].reshape(-1), centre, spread)


def condition_number(frame: Frame, lines: NDArray[np.intp], points: Array, rank: int) -> float:
    """Largest singular value of the system over that of the given rank."""
    values = np.linalg.svd(assemble(frame, lines, points).matrix, compute_uv=False)
    smallest = float(values[rank - 1])
    return float(values[0]) / smallest if smallest > 0 else float("inf")


def _without_noise(frame: Frame, lines: NDArray[np.intp], points: Array) -> Array:
    """The points with those of coplanar rods put on one line, where they belong: noise must not hide a degeneracy."""
    clean = points.copy()
    row_of = {int(line): row for row, line in enumerate(lines)}
    planes: list[set[int]] = []
    for triple in three_coplanar_lines(frame, lines):
        # Two rods span a plane: triples that share two lie in one, and their spots on one line.
        plane = set(triple.members)
        for other in [known for known in planes if len(known & plane) >= 2]:
            planes.remove(other)
            plane |= other
        planes.append(plane)
    for plane in planes:
        rows = sorted(row_of[member] for member in plane)
        centre = clean[rows].mean(axis=0)
        along = np.linalg.svd(clean[rows] - centre)[2][0]
        clean[rows] = centre + np.outer((clean[rows] - centre) @ along, along)
    return clean
