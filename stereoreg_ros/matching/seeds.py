"""Seeds of one triple of rods, and which spots the further rods could have, by where each seed predicts them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.visibility import END_SLACK_MM, LEAST_COSINE, SURE_MM
from stereoreg_ros.matching.consensus import GATE, MISSING_COST
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.solvers.distance_equations import PAIRS
from stereoreg_ros.solvers.three_rods import Seeds, ThreeRodSolver

# A seed's prediction is of first order only: its gate need but let the right spot through.
_SEED_GATE = 2 * GATE
# Spots whose triangle is flatter than this (height over a side) fix no pose: rods of one plane.
_LEAST_FLATNESS = 0.03
# Two spots nearer than this are one spot found twice.
_LEAST_DISTANCE_MM = 1e-3
# What the first order may leave out of a squared distance.
_FIRST_ORDER_SLACK = 10.0
# A prediction of a larger variance, mm^2, says nothing: its rod runs within the slice.
_VAGUE_MM2 = 1e12
# A seed so near an explanation (mm, and the rotation matrix's elements) leads to it.
_SAME_MM, _SAME_ROTATION = 5.0, 0.1
# Triples of spots looked at in one piece: what belongs to it then stays in the processor's cache.
_PIECE = 40000
# Stripes of the slice in which spots are looked up.
_STRIPES = 256


class Starts(NamedTuple):
    """Where to start refining, m of them.

    rotations (m, 3, 3), translations (m, 3) mm: slice_from_frame; spot_of_line (m, n), UNMATCHED where none; origin
    (m,): the same number for starts from the same seed.
    """

    rotations: Array
    translations: Array
    spot_of_line: NDArray[np.intp]
    origin: NDArray[np.intp]

    def take(self, rows: slice) -> Starts:
        """Only the given ones."""
        return Starts(self.rotations[rows], self.translations[rows], self.spot_of_line[rows], self.origin[rows])


def joined(starts: Sequence[Starts]) -> Starts:
    """All of them, with origins of their own."""
    first = np.cumsum([0, *(int(one.origin.max(initial=-1)) + 1 for one in starts)])
    return Starts(
        np.concatenate([one.rotations for one in starts]),
        np.concatenate([one.translations for one in starts]),
        np.concatenate([one.spot_of_line for one in starts]),
        np.concatenate([one.origin + number for one, number in zip(starts, first, strict=False)]),
    )


class TripleSeeds(NamedTuple):
    """The seeds of one triple of rods that hit enough spots, m of them, with every spot that each further rod may have.

    rotations (m, 3, 3), translations (m, 3) mm: slice_from_frame. spot_of_line: (m, n), the three spots of each seed.
    hit_seed, hit_line, hit_spot: (h,), a further rod whose prediction a spot is near; hit_rank: (h,), 0 for the rod of
    that seed that is predicted the sharpest, and so on; hit_squared: (h,), squared distance in standard deviations.
    nearest_hits: (m, n), spot_of_line with the nearest hit of every rod; nearest_squared: (m, k), its squared distance
    for each further rod. reach: (m,), three and the number of further rods that are hit: no consensus has more.
    unhit: (m,), rods that the slice must cut among the spots, and that are not hit.
    triples: how many were looked at.
    """

    rotations: Array
    translations: Array
    spot_of_line: NDArray[np.intp]
    hit_seed: NDArray[np.intp]
    hit_line: NDArray[np.intp]
    hit_spot: NDArray[np.intp]
    hit_rank: NDArray[np.intp]
    hit_squared: Array
    nearest_hits: NDArray[np.intp]
    nearest_squared: Array
    reach: NDArray[np.intp]
    unhit: NDArray[np.intp]
    triples: int

    def reaching(self, level: int, most_chi_square: float, known: list[Hypothesis]) -> Starts:
        """Starts that a consensus of `level` rods needs besides those of the levels above.

        A consensus of `level` misses reach - level of the rods that the seed's predictions hit. So it holds one of the
        reach - level + 1 sharpest of them; the levels above have started from all of these but the last. Each hit of
        that rod gives two starts: with it alone, and with the nearest hit of every other rod too, as four matches leave
        the tilt of parallel rods so open that the fifth rod would not be where the first order has it.

        most_chi_square: what a consensus may have at most, in chi-square and the cost of missing rods together; known:
        explanations that are not sought again.
        """
        # Each match alone, given the seed, brings its squared distance to chi-square, to first order.
        most_squared = most_chi_square + _FIRST_ORDER_SLACK
        wanted = (self.nearest_squared <= most_squared).sum(axis=1) >= level - 3
        wanted &= 2 * MISSING_COST * self.unhit <= most_chi_square
        wanted &= ~self._leads_to(known)
        chosen = np.flatnonzero(
            (self.hit_rank == self.reach[self.hit_seed] - level)
            & (self.hit_squared <= most_squared)
            & wanted[self.hit_seed]
        )
        seed = self.hit_seed[chosen]
        spot_of_line = self.spot_of_line[seed]
        spot_of_line[np.arange(len(chosen)), self.hit_line[chosen]] = self.hit_spot[chosen]
        full = self.nearest_hits[seed]
        full[np.arange(len(chosen)), self.hit_line[chosen]] = self.hit_spot[chosen]
        # A spot that another rod had is that rod's no more.
        clash = (full == self.hit_spot[chosen][:, None]) & (np.arange(full.shape[1]) != self.hit_line[chosen][:, None])
        full[clash] = UNMATCHED
        more = (full != UNMATCHED).sum(axis=1) > 4
        rows = np.concatenate([seed, seed[more]])
        return Starts(self.rotations[rows], self.translations[rows], np.concatenate([spot_of_line, full[more]]), rows)

    def _leads_to(self, known: list[Hypothesis]) -> NDArray[np.bool_]:
        """Which seeds are near one of these explanations, and give no rod another spot."""
        leads = np.zeros(len(self.reach), dtype=bool)
        for hypothesis in known:
            same = ((self.spot_of_line == hypothesis.spot_of_line) | (self.spot_of_line == UNMATCHED)).all(axis=1)
            same &= np.linalg.norm(self.translations - hypothesis.translation, axis=1) < _SAME_MM
            same &= np.abs(self.rotations - hypothesis.rotation).max(axis=(1, 2)) < _SAME_ROTATION
            leads |= same
        return leads


def seeds_of_triple(problem: Problem, solver: ThreeRodSolver, rods_cut: tuple[int, int]) -> TripleSeeds:
    """The seeds of the solver's rods within the prior, and what they hit.

    rods_cut: how many rods the slice may cut, the least and the most. Only seeds that hit enough for a consensus
    of the fewest rods are kept.
    """
    spots, frame, prior = problem.spots, problem.frame, problem.prior
    lines = list(solver.lines)
    others = _others(frame, solver)
    table = solver.table(*rods_cut)
    cells = None if prior.max_rotation >= np.pi else solver.cells_near(prior.normal, prior.seed_angle)
    triples, distances = spot_triples(spots.mm, lines, table.low, table.high, prior)
    stripes = _Stripes.of(spots.mm)
    pieces = []
    for start in range(0, max(triples.shape[1], 1), _PIECE):
        part = slice(start, start + _PIECE)
        seeds = solver.solve(distances[:, part], table, cells)
        own_spots = triples[:, part][:, seeds.triples]
        if cells is not None:
            near = prior.angles(solver.poses(seeds.lambdas, spots.mm[own_spots.T])[0]) <= prior.seed_angle
            own_spots, seeds = own_spots[:, near], seeds.take(near)
        predicted = _predict(spots, frame, solver, others, own_spots, seeds)
        hits = _hits(spots, stripes, predicted, own_spots, others, prior)
        kept = _kept(problem, solver, own_spots, seeds, predicted.sure, hits)
        pieces.append(kept._replace(triples=triples[:, part].shape[1]))
    return _merged(pieces)


def _others(frame: Frame, solver: ThreeRodSolver) -> NDArray[np.intp]:
    """The rods that are not the solver's."""
    return np.array([line for line in range(len(frame)) if line not in solver.lines])


def spot_triples(
    mm: Array, lines: list[int], low: Array, high: Array, prior: Prior
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Rows (3, t) of distinct spots (s, 2) mm that three rods can have, and their distances (3, t) mm.

    low, high: (3,) mm, bounds of the distances; distances and bounds are in the order of PAIRS.
    """
    x, y = mm[:, 0][:, None] - mm[:, 0], mm[:, 1][:, None] - mm[:, 1]
    distance = np.sqrt(x * x + y * y)
    allowed = []
    for row, (a, b) in enumerate(PAIRS):
        pair = (distance >= max(low[row], _LEAST_DISTANCE_MM)) & (distance <= high[row])
        if prior.near is not None:
            pair &= prior.near.spots_of_line[lines[a]][:, None] & prior.near.spots_of_line[lines[b]]
        allowed.append(pair)
    first, second = np.nonzero(allowed[0])
    chosen, third = np.nonzero(allowed[1][first] & allowed[2][second])
    first, second = first[chosen], second[chosen]
    flat, count = distance.astype(np.float32).ravel(), len(mm)
    pairs = (first * count + second, first * count + third, second * count + third)
    return np.stack([first, second, third]), np.stack([flat[pair] for pair in pairs])


class _Stripes(NamedTuple):
    """Spots sorted by x, and where each stripe of the slice starts among them."""

    order: NDArray[np.intp]
    low: float
    width: float
    start: NDArray[np.intp]

    @classmethod
    def of(cls, mm: Array) -> _Stripes:
        order = np.argsort(mm[:, 0], kind="stable")
        x = mm[order, 0]
        width = max(float(x[-1] - x[0]) / _STRIPES, 1e-6)
        return cls(order, float(x[0]), width, np.searchsorted(x, x[0] + width * np.arange(_STRIPES + 2)))

    def between(self, low: Array, high: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows of the ranges low to high (p,) mm and of the spots whose stripe they touch."""
        first = np.clip((low - self.low) / self.width, 0, _STRIPES + 1).astype(np.intp)
        last = np.clip((high - self.low) / self.width + 1, 0, _STRIPES + 1).astype(np.intp)
        start = self.start[first]
        count = np.where(high >= self.low, self.start[last] - start, 0)
        row = np.repeat(np.arange(len(count)), count)
        rank = np.arange(len(row)) - (np.cumsum(count) - count)[row]
        return row, self.order[start[row] + rank]


class _Prediction(NamedTuple):
    """Where m seeds have the slice cut k further rods; arrays are (k, m) where nothing else is said.

    x, y: mm in the slice; xx, yy, xy: their covariance, mm^2, with the noise of the spot that is looked for; on_rod:
    whether the cut may lie on the rod; sure: whether it must, and among the spots.
    """

    x: Array
    y: Array
    xx: Array
    yy: Array
    xy: Array
    on_rod: NDArray[np.bool_]
    sure: NDArray[np.bool_]


def _predict(
    spots: Spots,
    frame: Frame,
    solver: ThreeRodSolver,
    others: NDArray[np.intp],
    own_spots: NDArray[np.intp],
    seeds: Seeds,
) -> _Prediction:
    """Where each seed has the slice cut the further rods.

    The three points of a seed span the slice, in the frame as in the image: what is known in terms of two sides of the
    triangle in the one is known in the other, without a pose. A further rod's cut follows the seed's positions lambda:
    its point moves by w = slope y_z - y_xy of each seed rod, weighted by the cut's barycentric coordinate.
    """
    points = np.ascontiguousarray(np.moveaxis(solver.points(seeds.lambdas), 0, -1))  # (3 rods, 3 axes, m)
    u, v = points[1] - points[0], points[2] - points[0]
    normal = _cross(u, v)
    squared = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    # Dual to the sides: a vector's components along u and v are its products with these.
    dual_u, dual_v = _cross(v, normal) / squared, _cross(normal, u) / squared
    corner_x, corner_y = spots.mm[:, 0][own_spots], spots.mm[:, 1][own_spots]
    ax, ay = corner_x[1] - corner_x[0], corner_y[1] - corner_y[0]
    bx, by = corner_x[2] - corner_x[0], corner_y[2] - corner_y[0]
    unit = np.copysign(1.0 / np.sqrt(squared), ax * by - ay * bx)

    def in_slice(rows: NDArray[np.intp] | list[int]) -> tuple[Array, Array, Array]:
        """Directions of rods, components (rods, m) in slice axes."""
        y = frame.directions[rows]
        along_u, along_v = y @ dual_u, y @ dual_v
        return along_u * ax + along_v * bx, along_u * ay + along_v * by, (y @ normal) * unit

    own_x, own_y, own_z = in_slice(list(solver.lines))
    to_x, to_y, to_z = in_slice(others)
    directions, origins = frame.directions[others], frame.origins[others]
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = 1.0 / to_z
        lambdas = ((normal * points[0]).sum(axis=0) - origins @ normal) * unit * inverse
        slope_x, slope_y = to_x * inverse, to_y * inverse
        second = origins @ dual_u - (dual_u * points[0]).sum(axis=0) + lambdas * (directions @ dual_u)
        third = origins @ dual_v - (dual_v * points[0]).sum(axis=0) + lambdas * (directions @ dual_v)
        weights = (1.0 - second - third, second, third)
        xx = spots.sigma_mm**2 * (1.0 + weights[0] ** 2 + weights[1] ** 2 + weights[2] ** 2)
        # A rod that is off along the slice's normal is cut elsewhere by as much as it leans.
        rod_mm2 = spots.tolerances.rod_mm[others, None] ** 2
        xy = rod_mm2 * slope_x * slope_y
        yy = xx + rod_mm2 * slope_y**2
        xx += rod_mm2 * slope_x**2
        moved_x = [weights[i] * (slope_x * own_z[i] - own_x[i]) for i in range(3)]
        moved_y = [weights[i] * (slope_y * own_z[i] - own_y[i]) for i in range(3)]
        for i in range(3):
            row = [seeds.lambda_covariance[:, i, j] for j in range(3)]
            by_x = row[0] * moved_x[0] + row[1] * moved_x[1] + row[2] * moved_x[2]
            by_y = row[0] * moved_y[0] + row[1] * moved_y[1] + row[2] * moved_y[2]
            xx += moved_x[i] * by_x
            yy += moved_y[i] * by_y
            xy += moved_x[i] * by_y
        # How far the cut may yet slide along its rod.
        slide = 4.0 * np.sqrt(np.maximum(xx, yy) / np.maximum(slope_x**2 + slope_y**2, 0.01))
        low, high = frame.lambda_min[others, None] - END_SLACK_MM, frame.lambda_max[others, None] + END_SLACK_MM
        upright = np.abs(to_z) >= LEAST_COSINE
        on_rod = (lambdas >= low - slide) & (lambdas <= high + slide)
        slide += END_SLACK_MM + SURE_MM
        sure = (lambdas >= low + slide) & (lambdas <= high - slide) & upright
        on_rod &= xx + yy < _VAGUE_MM2
    longest = np.maximum(ax**2 + ay**2, bx**2 + by**2)
    on_rod &= np.abs(ax * by - ay * bx) > _LEAST_FLATNESS * longest
    x = corner_x[0] + second * ax + third * bx
    y = corner_y[0] + second * ay + third * by
    sure &= spots.surround(np.stack([x, y], axis=-1))
    return _Prediction(x, y, xx, yy, xy, on_rod, sure)


def _cross(a: Array, b: Array) -> Array:
    """Cross products of vectors (3, m)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class _Hits(NamedTuple):
    """Spots near predictions. area: determinant of the prediction's covariance, mm^4; squared: distance, in standard
    deviations, squared.
    """

    seed: NDArray[np.intp]
    other: NDArray[np.intp]
    spot: NDArray[np.intp]
    area: Array
    squared: Array

    def take(self, rows: NDArray[np.intp]) -> _Hits:
        return _Hits(self.seed[rows], self.other[rows], self.spot[rows], self.area[rows], self.squared[rows])


def _hits(
    spots: Spots,
    stripes: _Stripes,
    predicted: _Prediction,
    own_spots: NDArray[np.intp],
    others: NDArray[np.intp],
    prior: Prior,
) -> _Hits:
    chosen = np.flatnonzero(predicted.on_rod)
    x, y, xx, yy, xy = (
        part.ravel()[chosen] for part in (predicted.x, predicted.y, predicted.xx, predicted.yy, predicted.xy)
    )
    reach = np.sqrt(_SEED_GATE * xx)
    row, spot = stripes.between(x - reach, x + reach)
    # Most spots are far from most predictions: a box around the gate sorts them out before the ellipse is looked at.
    off_y = spots.mm[spot, 1] - y[row]
    near = off_y * off_y <= _SEED_GATE * yy[row]
    row, spot, off_y = row[near], spot[near], off_y[near]
    off_x = spots.mm[spot, 0] - x[row]
    area = xx[row] * yy[row] - xy[row] ** 2
    squared = yy[row] * off_x**2 + xx[row] * off_y**2 - 2 * xy[row] * off_x * off_y
    other, seed = np.divmod(chosen[row], max(own_spots.shape[1], 1))
    inside = (squared <= _SEED_GATE * area) & (own_spots[:, seed] != spot).all(axis=0)
    if prior.near is not None:
        inside &= prior.near.spots_of_line[others[other], spot]
    return _Hits(seed[inside], other[inside], spot[inside], area[inside], squared[inside] / area[inside])


def _kept(
    problem: Problem,
    solver: ThreeRodSolver,
    own_spots: NDArray[np.intp],
    seeds: Seeds,
    sure: NDArray[np.bool_],
    hits: _Hits,
) -> TripleSeeds:
    """The seeds that hit enough rods, with their hits in order."""
    frame, min_inliers, others = problem.frame, problem.min_inliers, _others(problem.frame, solver)
    gate = np.full((own_spots.shape[1], len(others)), np.inf)
    gate[hits.seed, hits.other] = hits.area
    is_hit = np.isfinite(gate)
    reach = 3 + is_hit.sum(axis=1)
    rows = np.flatnonzero(reach >= min_inliers)
    hits = hits.take(np.flatnonzero(reach[hits.seed] >= min_inliers))
    hit_seed, hit_line = np.searchsorted(rows, hits.seed), others[hits.other]
    order = np.argsort(np.argsort(gate[rows], axis=1, kind="stable"), axis=1, kind="stable")
    spot_of_line = np.full((len(rows), len(frame)), UNMATCHED)
    spot_of_line[:, list(solver.lines)] = own_spots[:, rows].T
    nearest_hits = spot_of_line.copy()
    farthest_first = np.argsort(-hits.squared, kind="stable")  # so that the nearest is written last
    nearest_hits[hit_seed[farthest_first], hit_line[farthest_first]] = hits.spot[farthest_first]
    nearest_squared = np.full((len(rows), len(others)), np.inf)
    nearest_squared[hit_seed[farthest_first], hits.other[farthest_first]] = hits.squared[farthest_first]
    return TripleSeeds(
        *solver.poses(seeds.lambdas[rows], problem.spots.mm[own_spots[:, rows].T]),
        spot_of_line,
        hit_seed,
        hit_line,
        hits.spot,
        order[hit_seed, hits.other],
        hits.squared,
        nearest_hits,
        nearest_squared,
        reach[rows],
        (sure.T[rows] & ~is_hit[rows]).sum(axis=1),
        0,
    )


def _merged(pieces: list[TripleSeeds]) -> TripleSeeds:
    if len(pieces) == 1:
        return pieces[0]
    before = np.cumsum([0, *(len(piece.reach) for piece in pieces[:-1])]).tolist()

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(piece, name) for piece in pieces])

    return TripleSeeds(
        joined("rotations"),
        joined("translations"),
        joined("spot_of_line"),
        np.concatenate([piece.hit_seed + first for piece, first in zip(pieces, before, strict=True)]),
        joined("hit_line"),
        joined("hit_spot"),
        joined("hit_rank"),
        joined("hit_squared"),
        joined("nearest_hits"),
        joined("nearest_squared"),
        joined("reach"),
        joined("unhit"),
        sum(piece.triples for piece in pieces),
    )
