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
_STEPS_BEFORE_SORTING_OUT = 1
# Bins of the table along each of the three distances.
_BINS = 25
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

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Seeds:
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
        # d^2 = la^2 + lb^2 - 2 cosine la lb + 2 at_a la + 2 at_b lb + constant, for each pair of rods.
        self._quadratics = []
        for a, b in PAIRS:
            between = self._origins[a] - self._origins[b]
            self._quadratics.append(
                (
                    float(self._directions[a] @ self._directions[b]),
                    float(self._directions[a] @ between),
                    float(-self._directions[b] @ between),
                    float(between @ between),
                )
            )
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
        self._bin = np.maximum(span / (_BINS - 1), 1e-6)
        first = ((self._nearest - self.tolerance_mm - self.distance_low) / self._bin).astype(np.intp)
        last = ((self._farthest + self.tolerance_mm - self.distance_low) / self._bin).astype(np.intp)
        first, last = np.clip(first, 0, _BINS - 1), np.clip(last, 0, _BINS - 1)
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
        self._table_start = np.searchsorted(flat[order], np.arange(_BINS**3 + 1))

    def _flat(self, bins: NDArray[np.intp]) -> NDArray[np.intp]:
        flat: NDArray[np.intp] = (bins[:, 0] * _BINS + bins[:, 1]) * _BINS + bins[:, 2]
        return flat

    def solve(self, spots_mm: Array) -> Seeds:
        """Poses for triples of spots (t, 3, 2) mm in the slice; the spots in the order of the rods."""
        sides = np.stack([spots_mm[:, a] - spots_mm[:, b] for a, b in PAIRS], axis=1)
        distances = np.sqrt((sides**2).sum(axis=-1))
        triple, cell = self._candidates(distances)
        known = [np.ascontiguousarray(distances[triple, pair]) for pair in range(3)]
        start = [np.ascontiguousarray(self._centres[cell, rod]) for rod in range(3)]
        lambdas = list(start)
        for number in range(_STEPS):
            equations = self._equations(lambdas, known)
            steps = _damped_step(equations)
            lambdas = [
                value - np.minimum(np.maximum(step, -size), size)
                for value, step, size in zip(lambdas, steps, self._cell, strict=True)
            ]
            if number == _STEPS_BEFORE_SORTING_OUT:
                # A start that leads away leads to another cell's solution, or to none.
                near = self._is_near(lambdas, start, 2.0)
                triple = triple[near]
                known, start, lambdas = ([part[near] for part in parts] for parts in (known, start, lambdas))
        equations = self._equations(lambdas, known)
        misfit = np.abs(equations.error[0])
        for error in equations.error[1:]:
            np.maximum(misfit, np.abs(error), out=misfit)
        found = (misfit <= self.tolerance_mm) & self._is_near(lambdas, start, 1.25)
        for value, low, high in zip(lambdas, self.lambda_low, self.lambda_high, strict=True):
            found &= (value >= low) & (value <= high)
        rows = np.flatnonzero(found)
        # Of step ends in one place the best is kept, which is found first when they are sorted by their misfit.
        rows = rows[np.argsort(misfit[rows], kind="stable")]
        key = triple[rows].astype(np.int64)
        for value, size in zip(lambdas, self._cell, strict=True):
            key = key * 4096 + np.round(value[rows] / (0.1 * size)).astype(np.int64) % 4096
        _, first = np.unique(key, return_index=True)
        kept = rows[np.sort(first)]
        kept = kept[np.argsort(triple[kept], kind="stable")]
        triple = triple[kept]
        ends = np.column_stack([value[kept] for value in lambdas])
        rotations, translations = _pose(self._points(ends), spots_mm[triple])
        covariance = self._covariance(equations.take(kept), distances[triple])
        return Seeds(triple, rotations, translations, ends, covariance)

    def _candidates(self, distances: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows of triples and of the cells that their distances (t, 3) allow."""
        possible = ((distances >= self.distance_low) & (distances <= self.distance_high)).all(axis=1)
        rows = np.flatnonzero(possible)
        bins = ((distances[rows] - self.distance_low) / self._bin).astype(np.intp)
        flat = self._flat(np.minimum(bins, _BINS - 1))
        start, stop = self._table_start[flat], self._table_start[flat + 1]
        count = stop - start
        triple = np.repeat(rows, count)
        cell = self._table[np.arange(len(triple)) + np.repeat(start - (np.cumsum(count) - count), count)]
        fits = np.ones(len(triple), dtype=bool)
        for pair in range(3):
            known = distances[triple, pair]
            fits &= known >= self._nearest[cell, pair] - self.tolerance_mm
            fits &= known <= self._farthest[cell, pair] + self.tolerance_mm
        return triple[fits], cell[fits]

    def _is_near(self, lambdas: list[Array], start: list[Array], cells: float) -> NDArray[np.bool_]:
        near = np.ones(len(lambdas[0]), dtype=bool)
        for value, first, size in zip(lambdas, start, self._cell, strict=True):
            near &= np.abs(value - first) <= cells * size
        return near

    def _equations(self, lambdas: list[Array], distances: list[Array]) -> _Equations:
        """(d^2 - D^2) / 2D for each pair: the distance's error to first order, and smooth where rods meet.

        d^2 is quadratic in the two positions; its coefficients are those of `_quadratics`.
        """
        errors, slopes = [], []
        for (a, b), (cosine, at_a, at_b, constant), known in zip(PAIRS, self._quadratics, distances, strict=True):
            first, second = lambdas[a], lambdas[b]
            slope_a = first - cosine * second + at_a
            slope_b = second - cosine * first + at_b
            squared = first * (slope_a + at_a) + second * (slope_b + at_b) + constant
            inverse = 1.0 / known
            errors.append(0.5 * (squared * inverse - known))
            slopes.append((slope_a * inverse, slope_b * inverse))
        return _Equations(errors, slopes)

    def _covariance(self, equations: _Equations, distances: Array) -> Array:
        """Covariance (m, 3, 3) mm^2 of the positions, for distances known to a quarter of the tolerance.

        At a double root the distance changes only with the square of the position, x^2 / 2D: there a position is known
        to sqrt(2 D sigma), not to infinity.
        """
        sigma = self.tolerance_mm / 4
        damping = sigma / (2 * distances.max(axis=1))
        inverse, determinant = _inverse_normal(equations, damping)
        xx, yy, zz, xy, xz, yz = (part * (sigma**2 / determinant) for part in inverse)
        return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)


class _Equations(NamedTuple):
    """Errors of the three distances, and the derivatives of each by the positions on its two rods."""

    error: list[Array]
    slope: list[tuple[Array, Array]]

    def take(self, rows: NDArray[np.intp]) -> _Equations:
        return _Equations([part[rows] for part in self.error], [(a[rows], b[rows]) for a, b in self.slope])


def _inverse_normal(equations: _Equations, damping: Array | float) -> tuple[tuple[Array, ...], Array]:
    """Adjugate (xx, yy, zz, xy, xz, yz) and determinant of J'J + damping, in elements: LAPACK takes far longer."""
    (a0, b0), (a1, c1), (b2, c2) = equations.slope
    xx, yy, zz = a0 * a0 + a1 * a1 + damping, b0 * b0 + b2 * b2 + damping, c1 * c1 + c2 * c2 + damping
    xy, xz, yz = a0 * b0, a1 * c1, b2 * c2
    cxx, cyy, czz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    cxy, cxz, cyz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    return (cxx, cyy, czz, cxy, cxz, cyz), xx * cxx + xy * cxy + xz * cxz


def _damped_step(equations: _Equations) -> tuple[Array, Array, Array]:
    """(J'J + mu)^-1 J' e."""
    (a0, b0), (a1, c1), (b2, c2) = equations.slope
    e0, e1, e2 = equations.error
    (cxx, cyy, czz, cxy, cxz, cyz), determinant = _inverse_normal(equations, _DAMPING)
    right_x, right_y, right_z = a0 * e0 + a1 * e1, b0 * e0 + b2 * e2, c1 * e1 + c2 * e2
    inverse = 1.0 / determinant
    return (
        (cxx * right_x + cxy * right_y + cxz * right_z) * inverse,
        (cxy * right_x + cyy * right_y + cyz * right_z) * inverse,
        (cxz * right_x + cyz * right_y + czz * right_z) * inverse,
    )


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
