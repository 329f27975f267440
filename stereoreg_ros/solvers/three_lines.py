"""Three rods and three spots: the least from which a pose follows, in up to eight ways.

Unknown are the positions lambda (3) at which the slice cuts the rods; the three distances between the spots are known.
Each squared distance is a quadratic in two of them. The rods are divided into cells once; a table from distances to
cells says which cells a triple of spots can belong to, and a few damped steps from a cell's centre reach the solution
in it, so that no starting guess is needed. Where noise has pushed a double root off the
real axis, as parallel rods and a slice at right angles to them make normal, the steps end at the nearest point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array

# Pairs of the three rods, in the order of all arrays of three distances.
PAIRS = ((0, 1), (0, 2), (1, 2))
_CELLS_PER_ROD = 10
_STEPS = 6
# Damping of the steps, in units of squared cosines: reached only where a double root is near.
_DAMPING = 1e-5


class Seeds(NamedTuple):
    """Poses from three rods and three spots, m of them.

    triples: (m,), row of the triple of spots; rotations (m, 3, 3), translations (m, 3) mm: slice_from_frame;
    lambdas: (m, 3) mm; lambda_covariance: (m, 3, 3) mm^2, finite at double roots too.
    """

    triples: NDArray[np.intp]
    rotations: Array
    translations: Array
    lambdas: Array
    lambda_covariance: Array

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Seeds:
        """Only the given seeds."""
        return Seeds(
            self.triples[rows],
            self.rotations[rows],
            self.translations[rows],
            self.lambdas[rows],
            self.lambda_covariance[rows],
        )


class ThreeLineSolver:
    """All poses that put three given rods on three given spots."""

    def __init__(self, frame: Frame, lines: tuple[int, int, int], tolerance_mm: float, end_slack_mm: float) -> None:
        """Prepare for three rods of `frame`, by their rows.

        tolerance_mm: how far noise may change a distance between two spots; end_slack_mm: how far beyond its ends a rod
        may be cut.
        """
        self.lines = lines
        self.tolerance_mm = tolerance_mm
        rows = list(lines)
        self._origins, self._directions = frame.origins[rows], frame.directions[rows]
        low, high = frame.lambda_min[rows] - end_slack_mm, frame.lambda_max[rows] + end_slack_mm
        self.lambda_low, self.lambda_high = low, high
        self._cell = (high - low) / _CELLS_PER_ROD
        steps = (np.arange(_CELLS_PER_ROD) + 0.5) / _CELLS_PER_ROD
        axes = [low[i] + (high - low)[i] * steps for i in range(3)]
        self._centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self._nearest, self._farthest = self._distance_bounds()
        self.distance_low = self._nearest.min(axis=0) - tolerance_mm
        self.distance_high = self._farthest.max(axis=0) + tolerance_mm
        self._fill_table()

    def _points(self, lambdas: Array) -> Array:
        points: Array = self._origins + lambdas[..., None] * self._directions
        return points

    def _distance_bounds(self) -> tuple[Array, Array]:
        """Least and greatest distances (cells, 3) of the pairs of rods within each cell.

        The distance is a convex function of the two positions: its tangent bounds it from below, its corners
        from above.
        """
        nearest, farthest = [], []
        for a, b in PAIRS:
            half_a, half_b = self._cell[a] / 2, self._cell[b] / 2

            def offset(shift_a: float, shift_b: float, a: int = a, b: int = b) -> Array:
                moved = self._centres.copy()
                moved[:, a] += shift_a
                moved[:, b] += shift_b
                points = self._points(moved)
                difference: Array = points[:, a] - points[:, b]
                return difference

            centre = offset(0.0, 0.0)
            distance = np.linalg.norm(centre, axis=1)
            unit = centre / np.maximum(distance, 1e-9)[:, None]
            slope = np.abs(unit @ self._directions[a]) * half_a + np.abs(unit @ self._directions[b]) * half_b
            corners = [np.linalg.norm(offset(i * half_a, j * half_b), axis=1) for i in (-1, 1) for j in (-1, 1)]
            nearest.append(np.maximum(distance - slope, 0.0))
            farthest.append(np.max(corners, axis=0))
        return np.stack(nearest, axis=1), np.stack(farthest, axis=1)

    def _fill_table(self) -> None:
        """Bins over the three distances, each with the cells that can have them."""
        span = self.distance_high - self.distance_low
        self._bin = np.maximum(span / 24, 1e-6)
        self._shape = np.full(3, 25)
        first = ((self._nearest - self.tolerance_mm - self.distance_low) / self._bin).astype(np.intp)
        last = ((self._farthest + self.tolerance_mm - self.distance_low) / self._bin).astype(np.intp)
        first, last = np.clip(first, 0, 24), np.clip(last, 0, 24)
        extent = last - first + 1
        count = extent.prod(axis=1)
        cell = np.repeat(np.arange(len(count)), count)
        rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        x = rank % extent[cell, 0]
        y = rank // extent[cell, 0] % extent[cell, 1]
        z = rank // (extent[cell, 0] * extent[cell, 1])
        flat = self._flat(first[cell] + np.stack([x, y, z], axis=1))
        order = np.argsort(flat, kind="stable")
        self._table = cell[order]
        self._table_start = np.searchsorted(flat[order], np.arange(self._shape.prod() + 1))

    def _flat(self, bins: NDArray[np.intp]) -> NDArray[np.intp]:
        flat: NDArray[np.intp] = (bins[:, 0] * self._shape[1] + bins[:, 1]) * self._shape[2] + bins[:, 2]
        return flat

    def solve(self, spots_mm: Array) -> Seeds:
        """Poses for triples of spots (t, 3, 2) mm in the slice; the spots in the order of the rods."""
        sides = np.stack([spots_mm[:, a] - spots_mm[:, b] for a, b in PAIRS], axis=1)
        distances = np.linalg.norm(sides, axis=-1)
        possible = ((distances >= self.distance_low) & (distances <= self.distance_high)).all(axis=1)
        rows = np.flatnonzero(possible)
        bins = ((distances[rows] - self.distance_low) / self._bin).astype(np.intp)
        flat = self._flat(np.clip(bins, 0, 24))
        start, stop = self._table_start[flat], self._table_start[flat + 1]
        count = stop - start
        triple = np.repeat(rows, count)
        position = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count)
        cell = self._table[position]
        near = distances[triple]
        fits = (near >= self._nearest[cell] - self.tolerance_mm).all(axis=1)
        fits &= (near <= self._farthest[cell] + self.tolerance_mm).all(axis=1)
        triple, cell, near = triple[fits], cell[fits], near[fits]
        lambdas = self._centres[cell]
        for _ in range(_STEPS):
            error, jacobian = self._equations(lambdas, near)
            step = _damped_step(jacobian, error)
            lambdas = lambdas - np.clip(step, -self._cell, self._cell)
        error, jacobian = self._equations(lambdas, near)
        found = (np.abs(error) <= self.tolerance_mm).all(axis=1)
        # A solution far from the cell it was sought in is another cell's.
        found &= (np.abs(lambdas - self._centres[cell]) <= self._cell).all(axis=1)
        found &= ((lambdas >= self.lambda_low) & (lambdas <= self.lambda_high)).all(axis=1)
        # Of the steps' ends that are close together, the one that fits best is the solution's.
        rows = np.flatnonzero(found)
        rows = rows[np.argsort(np.abs(error[rows]).max(axis=1), kind="stable")]
        rounded = np.round(lambdas[rows] / (0.1 * self._cell)).astype(np.int64)
        _, first = np.unique(np.column_stack([triple[rows], rounded]), axis=0, return_index=True)
        kept = np.sort(rows[first])
        triple, lambdas, jacobian = triple[kept], lambdas[kept], jacobian[kept]
        rotations, translations = _pose(self._points(lambdas), spots_mm[triple])
        return Seeds(triple, rotations, translations, lambdas, self._covariance(jacobian, distances[triple]))

    def _equations(self, lambdas: Array, distances: Array) -> tuple[Array, Array]:
        """Errors of the three distances (m, 3) mm and their derivatives (m, 3, 3) by the positions.

        (d^2 - D^2) / 2D is the distance's error to first order, and smooth where rods meet.
        """
        points = self._points(lambdas)
        error = np.empty_like(lambdas)
        jacobian = np.zeros((len(lambdas), 3, 3))
        for row, (a, b) in enumerate(PAIRS):
            difference = points[:, a] - points[:, b]
            known = distances[:, row]
            error[:, row] = (np.einsum("mi,mi->m", difference, difference) - known**2) / (2 * known)
            jacobian[:, row, a] = difference @ self._directions[a] / known
            jacobian[:, row, b] = -difference @ self._directions[b] / known
        return error, jacobian

    def _covariance(self, jacobian: Array, distances: Array) -> Array:
        """Covariance (m, 3, 3) mm^2 of the positions, for distances known to a quarter of the tolerance.

        At a double root the distance changes only with the square of the position, x^2 / 2D: there a position is known
        to sqrt(2 D sigma), not to infinity.
        """
        sigma = self.tolerance_mm / 4
        curved = 2 * distances.max(axis=1) * sigma
        information = np.swapaxes(jacobian, 1, 2) @ jacobian / sigma**2
        np.einsum("mii->mi", information)[:] += 1 / curved[:, None]
        return np.asarray(np.linalg.inv(information), dtype=np.float64)


def _damped_step(jacobian: Array, error: Array) -> Array:
    """(J'J + mu)^-1 J' e for many 3x3 J, by the adjugate: a tenth of the time of LAPACK's call for each."""
    a = np.einsum("mki,mkj->mij", jacobian, jacobian)
    mu = _DAMPING
    xx, yy, zz = a[:, 0, 0] + mu, a[:, 1, 1] + mu, a[:, 2, 2] + mu
    xy, xz, yz = a[:, 0, 1], a[:, 0, 2], a[:, 1, 2]
    right = np.einsum("mki,mk->mi", jacobian, error)
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * cxx + xy * cxy + xz * cxz
    step = np.stack(
        [
            cxx * right[:, 0] + cxy * right[:, 1] + cxz * right[:, 2],
            cxy * right[:, 0] + cyy * right[:, 1] + cyz * right[:, 2],
            cxz * right[:, 0] + cyz * right[:, 1] + czz * right[:, 2],
        ],
        axis=1,
    )
    result: Array = step / determinant[:, None]
    return result


def _pose(points: Array, spots_mm: Array) -> tuple[Array, Array]:
    """slice_from_frame (m, 3, 3), (m, 3) that lays triangles of frame points (m, 3, 3) on spots (m, 3, 2)."""
    flat = np.zeros((*spots_mm.shape[:2], 3))
    flat[..., :2] = spots_mm
    rotations = _triad(flat) @ np.swapaxes(_triad(points), -1, -2)
    centre, flat_centre = points.mean(axis=1), flat.mean(axis=1)
    return rotations, flat_centre - np.einsum("mij,mj->mi", rotations, centre)


def _triad(triangles: Array) -> Array:
    """Axes (m, 3, 3), in columns, that triangles (m, 3, 3) span."""
    side = triangles[:, 1] - triangles[:, 0]
    first = side / np.sqrt((side**2).sum(axis=1, keepdims=True))
    across = np.cross(first, triangles[:, 2] - triangles[:, 0])
    normal = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    axes: Array = np.stack([first, np.cross(normal, first), normal], axis=-1)
    return axes
