"""Three rods and three spots: the least from which a pose follows, in up to eight ways.

Unknown are the positions lambda (3) at which the slice cuts the rods; the three distances between the spots are known.
Each squared distance is a quadratic in two of them (`distance_equations`). The rods are divided into cells once; a
table from distances to cells (`distance_table`) says which cells a triple of spots can belong to, and a few damped
steps from a cell's centre reach the solution in it, so that no starting guess is needed. Where noise has pushed a
double root off the real axis, as parallel rods and a slice at right angles to them make normal, the steps end at the
nearest point.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, cross
from stereoreg_ros.solvers.distance_equations import PAIRS, DistanceEquations
from stereoreg_ros.solvers.distance_table import DistanceTable

_CELLS_PER_ROD = 14
_STEPS, _SLOW_STEPS = 3, 4
_SMALL_STEP_MM = 0.01
# How much larger the bounds of a cell's distances are made than those of the points tried in it.
_MARGIN = 1.05
# Share of the least cosine that is asked for in the points tried in a cell: between them it may be larger.
_LOOSENED = 0.8


class Seeds(NamedTuple):
    """Positions along three rods that have the distances of three spots, m of them.

    triples: (m,), row of the triple of spots; lambdas: (m, 3) mm; lambda_covariance: (m, 3, 3) mm^2, finite at double
    roots too. Both are stored column by column, as the arithmetic on many seeds is.
    """

    triples: NDArray[np.intp]
    lambdas: Array
    lambda_covariance: Array

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Seeds:
        """Only the given seeds."""
        return Seeds(self.triples[rows], self.lambdas[rows], self.lambda_covariance[rows])


class ThreeRodSolver:
    """All poses that put three given rods on three given spots."""

    def __init__(
        self,
        frame: Frame,
        lines: tuple[int, int, int],
        tolerance_mm: float,
        end_slack_mm: float,
        least_cosine: float = 0.0,
    ) -> None:
        """Prepare for three rods of `frame`, by their rows.

        tolerance_mm: how far noise may change a distance between two spots; end_slack_mm: how far beyond its ends a rod
        may be cut; least_cosine: between the slice's normal and a rod that it cuts, below which the cut does not count.
        """
        self.lines = lines
        self.tolerance_mm = tolerance_mm
        rows = list(lines)
        self._origins, self._directions = frame.origins[rows], frame.directions[rows]
        low, high = frame.lambda_min[rows] - end_slack_mm, frame.lambda_max[rows] + end_slack_mm
        self.lambda_low, self.lambda_high = low, high
        self._cell = (high - low) / _CELLS_PER_ROD
        self._equations = DistanceEquations(self._origins, self._directions)
        steps = (np.arange(_CELLS_PER_ROD) + 0.5) / _CELLS_PER_ROD
        axes = [low[i] + (high - low)[i] * steps for i in range(3)]
        self._centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        nearest, farthest = self._distance_bounds()
        self._single_centres = np.ascontiguousarray(self._centres.T, dtype=np.float32)
        self._nearest, self._farthest = nearest - tolerance_mm, farthest + tolerance_mm
        self._box = self._oblique_bounds()
        self._normals, self._normal_spread, self.rods_cut = self._planes(frame, least_cosine)
        self._tables: dict[tuple[int, int], DistanceTable] = {}

    def points(self, lambdas: Array) -> Array:
        """Points (..., 3, 3) mm of the frame at positions (..., 3) mm along the three rods."""
        points: Array = self._origins + lambdas[..., None] * self._directions
        return points

    def _samples(self) -> Array:
        """Positions (cells, 27, 3) mm in every cell: its centre (row 13), and the middles and corners of its faces."""
        offsets = 0.5 * np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
        samples: Array = self._centres[:, None] + offsets * self._cell
        return samples

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
                points = self.points(moved)
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

    def _planes(self, frame: Frame, least_cosine: float) -> tuple[Array, Array, NDArray[np.intp]]:
        """Of each cell, the slice's normal in the frame (cells, 3), up to sign, how far it turns within the cell
        (cells,) in rad, and how many rods a slice there may cut (cells,): 0 where not the three themselves.
        """
        corners = self.points(self._samples())
        normals = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
        cosine = np.einsum("csi,ni->csn", normals, frame.directions)
        at_least = _LOOSENED * least_cosine
        crosses = np.abs(cosine) >= max(at_least, 1e-9)
        height = np.einsum("csi,csi->cs", normals, corners[..., 0, :])[..., None] - normals @ frame.origins.T
        lambdas = height / np.where(crosses, cosine, 1.0)
        reach = (self.lambda_high - self.lambda_low).max() / _CELLS_PER_ROD / 2
        cut = crosses & (lambdas >= frame.lambda_min - reach) & (lambdas <= frame.lambda_max + reach)
        cut[..., list(self.lines)] = crosses[..., list(self.lines)]
        possible = cut.any(axis=1)
        rods_cut = np.where(possible[:, list(self.lines)].all(axis=1), possible.sum(axis=1), 0)
        centre = normals[:, 13]
        turned = np.abs(np.einsum("csi,ci->cs", normals, centre)).min(axis=1)
        return centre, np.arccos(np.minimum(turned, 1.0)), rods_cut

    def cells_near(self, normal: Array, angle: float) -> NDArray[np.bool_]:
        """Cells (cells,) where the slice's normal may be within `angle` (rad) of +-normal (3,) in the frame."""
        between = np.arccos(np.minimum(np.abs(self._normals @ normal), 1.0))
        near: NDArray[np.bool_] = between <= angle + self._normal_spread
        return near

    def table(self, least_rods: int, most_rods: int) -> DistanceTable:
        """From distances to the cells in which a slice may cut from `least_rods` to `most_rods` rods."""
        key = (least_rods, most_rods)
        if key not in self._tables:
            cells = np.flatnonzero((self.rods_cut >= least_rods) & (self.rods_cut <= most_rods))
            self._tables[key] = DistanceTable.of(cells, self._nearest[cells], self._farthest[cells])
        return self._tables[key]

    def _oblique_bounds(self) -> Array:
        """Rows (cells, 12) that turn three distances d into three numbers, 9 factors and 3 constants.

        All three lie within -1 and 1 where d can belong to the cell: the distances within a cell form a skewed box,
        which its own axes bound far more closely than the axes of d do.
        """
        samples = self.points(self._samples())
        distances = np.stack([np.linalg.norm(samples[..., a, :] - samples[..., b, :], axis=-1) for a, b in PAIRS], -1)
        centre = distances[:, 13]
        spread = distances - centre[:, None]
        axes = np.linalg.svd(spread, full_matrices=False)[2]
        along = spread @ np.swapaxes(axes, 1, 2)
        low, high = along.min(axis=1), along.max(axis=1)
        half = _MARGIN * (high - low) / 2 + self.tolerance_mm
        factors = axes / half[..., None]
        constants = -np.einsum("cij,cj->ci", factors, centre) - (low + high) / 2 / half
        return np.concatenate([factors.reshape(-1, 9), constants], axis=1).astype(np.float32)

    def solve(
        self, distances: NDArray[np.floating[Any]], table: DistanceTable, cells: NDArray[np.bool_] | None = None
    ) -> Seeds:
        """Positions for triples of spots, by their distances (3, t) mm in the order of PAIRS.

        table: of the cells in which solutions are sought; cells: (cells,), of these only the ones that are set.
        """
        # Many starts, most of them to be dropped, go in single precision: finer than the noise, and twice as fast.
        single = distances.astype(np.float32, copy=False)
        triple, cell = self._candidates(single, table, cells)
        start = [centre[cell] for centre in self._single_centres]
        known = [distance[triple] for distance in single]
        lambdas = self._stepped(start, known, _STEPS)
        misfit = self._equations.misfits(lambdas, known).largest
        found = misfit <= self.tolerance_mm
        for value, first, size, low, high in zip(
            lambdas, start, self._cell.tolist(), self.lambda_low.tolist(), self.lambda_high.tolist(), strict=True
        ):
            # A start that leads away leads to another cell's solution, or to none.
            found &= (np.abs(value - first) <= 1.25 * size) & (value >= low) & (value <= high)
        rows = self._distinct(np.flatnonzero(found), triple, lambdas, misfit)
        exact = [distance.astype(np.float64) for distance in distances[:, triple[rows]]]
        ends, are_slow = self._polished([value[rows].astype(np.float64) for value in lambdas], exact)
        misfits = self._equations.misfits(ends, exact)
        seeds = Seeds(
            triple[rows], np.stack(ends).T, misfits.covariance(self.tolerance_mm / 4, np.maximum.reduce(exact))
        )
        if not are_slow:
            return seeds
        misfit = misfits.largest
        found = misfit <= self.tolerance_mm
        for value, low, high in zip(ends, self.lambda_low, self.lambda_high, strict=True):
            found &= (value >= low) & (value <= high)
        return seeds.take(self._distinct(np.flatnonzero(found), seeds.triples, ends, misfit))

    def _distinct(
        self, rows: NDArray[np.intp], triple: NDArray[np.intp], lambdas: list[Any], misfit: NDArray[Any]
    ) -> NDArray[np.intp]:
        """Of rows with the same triple that lie in one place the one of least misfit; in the order of the triples."""
        # The first of each place is kept, which is the best when they are sorted by their misfit.
        rows = rows[np.argsort(misfit[rows], kind="stable")]
        key = triple[rows].astype(np.int64)
        for value, low, size in zip(lambdas, self.lambda_low.tolist(), self._cell.tolist(), strict=True):
            key = key * 256 + np.round((value[rows] - low) / (0.1 * size)).astype(np.int64)
        return np.sort(rows[np.unique(key, return_index=True)[1]])

    def poses(self, lambdas: Array, spots_mm: Array) -> tuple[Array, Array]:
        """slice_from_frame (m, 3, 3), (m, 3) mm that lays the rods' points at lambdas (m, 3) on spots (m, 3, 2)."""
        points = self.points(lambdas)
        flat = np.zeros((*spots_mm.shape[:2], 3))
        flat[..., :2] = spots_mm
        rotations = _triad(flat) @ np.swapaxes(_triad(points), -1, -2)
        centre, flat_centre = points.mean(axis=1), flat.mean(axis=1)
        return rotations, flat_centre - np.einsum("mij,mj->mi", rotations, centre)

    def _candidates(
        self, distances: NDArray[np.float32], table: DistanceTable, cells: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows of triples, in order, and of the cells that their distances (3, t) allow."""
        triple, cell = table.look_up(distances)
        if cells is not None:
            wanted = cells[cell]
            triple, cell = triple[wanted], cell[wanted]
        box = self._box.take(cell, axis=0)
        d0, d1, d2 = (distance[triple] for distance in distances)
        fits = np.ones(len(cell), dtype=bool)
        for axis in range(3):
            value = box[:, 3 * axis] * d0
            value += box[:, 3 * axis + 1] * d1
            value += box[:, 3 * axis + 2] * d2
            value += box[:, 9 + axis]
            fits &= np.abs(value) <= 1.0
        return triple[fits], cell[fits]

    def _stepped(self, lambdas: list[Any], distances: list[Any], steps: int) -> list[Any]:
        """Positions, three times (c,), after damped Newton steps, none longer than a cell."""
        for _ in range(steps):
            step = self._equations.misfits(lambdas, distances).step()
            lambdas = [
                value - np.minimum(np.maximum(change, -size), size)
                for value, change, size in zip(lambdas, step, self._cell.tolist(), strict=True)
            ]
        return lambdas

    def _polished(self, lambdas: list[Array], distances: list[Array]) -> tuple[list[Array], bool]:
        """Positions, three times (c,), after a step, and more where that one was not small: near double roots; and
        whether there were such.
        """
        ends = self._stepped(lambdas, distances, 1)
        moved = np.maximum.reduce([np.abs(end - value) for end, value in zip(ends, lambdas, strict=True)])
        rows = np.flatnonzero(moved > _SMALL_STEP_MM)
        if rows.size:
            slow = self._stepped([end[rows] for end in ends], [known[rows] for known in distances], _SLOW_STEPS)
            for end, value in zip(ends, slow, strict=True):
                end[rows] = value
        return ends, bool(rows.size)


def _triad(triangles: Array) -> Array:
    """Axes (m, 3, 3), in columns, that triangles (m, 3, 3) span."""
    side = triangles[:, 1] - triangles[:, 0]
    first = side / np.sqrt((side**2).sum(axis=1, keepdims=True))
    across = cross(first, triangles[:, 2] - triangles[:, 0])
    normal = across / np.sqrt((across**2).sum(axis=1, keepdims=True))
    axes: Array = np.stack([first, cross(normal, first), normal], axis=-1)
    return axes
