"""Seeds of one triple of rods, and which spots the further rods could have, by where each seed predicts them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_angle
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.consensus import GATE, Spots
from stereoreg_ros.matching.hypothesis import UNMATCHED
from stereoreg_ros.matching.significance import LEAST_COSINE
from stereoreg_ros.solvers.three_lines import PAIRS, Seeds, ThreeLineSolver

# How far beyond its end a rod may be cut: the noise apart, partial volume makes its end unsharp.
END_SLACK_MM = 1.0
# A seed's prediction is of first order only: its gate need but let the right spot through.
_SEED_GATE = 2 * GATE
# Spots whose triangle is flatter than this (height over longest side) fix no pose: rods of one plane.
_LEAST_FLATNESS = 0.03
# Predictions times spots looked at in one piece: bounds the memory.
_PIECE = 2_000_000


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


class SeedSearch(NamedTuple):
    """The seeds of one triple of rods, with every spot that each further rod may have.

    spot_of_line: (m, n), the three spots of each seed. hit_seed, hit_line, hit_spot: (h,), a further rod whose
    prediction a spot is near; hit_rank: (h,), 0 for the rod of that seed that is predicted the sharpest, and so on;
    nearest_hits: (m, n), spot_of_line with the nearest hit of every rod.
    reach: (m,), three and the number of further rods that are hit: no consensus of the seed can have more.
    seeds_by_visible: at v, how many seeds have the slice cut v further rods, those that lean too far left out.
    """

    seeds: Seeds
    spot_of_line: NDArray[np.intp]
    hit_seed: NDArray[np.intp]
    hit_line: NDArray[np.intp]
    hit_spot: NDArray[np.intp]
    hit_rank: NDArray[np.intp]
    nearest_hits: NDArray[np.intp]
    reach: NDArray[np.intp]
    seeds_by_visible: NDArray[np.int64]

    def reaching(self, level: int) -> Starts:
        """Starts that a consensus of `level` rods needs besides those of the levels above.

        A consensus of `level` misses reach - level of the rods that the seed's predictions hit. So it holds one of the
        reach - level + 1 sharpest of them; the levels above have started from all of these but the last. Each hit of
        that rod gives two starts: with it alone, and with the nearest hit of every other rod too, as four matches leave
        the tilt of parallel rods so open that the fifth rod would not be where the first order has it.
        """
        chosen = np.flatnonzero(self.hit_rank == self.reach[self.hit_seed] - level)
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
        return Starts(
            self.seeds.rotations[rows], self.seeds.translations[rows], np.concatenate([spot_of_line, full[more]]), rows
        )


def search_seeds(
    spots: Spots, frame: Frame, solver: ThreeLineSolver, nominal_slice_from_frame: Array, max_rotation: float
) -> SeedSearch:
    """All seeds of the solver's rods within `max_rotation` (rad) of the nominal rotation (3, 3), and what they hit."""
    triples = spot_triples(spots.mm, solver)
    seeds = solver.solve(spots.mm[triples])
    if max_rotation < np.pi:
        seeds = seeds.take(rotation_angle(seeds.rotations @ nominal_slice_from_frame.T) <= max_rotation)
    lines = list(solver.lines)
    others = np.array([line for line in range(len(frame)) if line not in lines])
    own_spots = triples[seeds.triples]
    spot_of_line = np.full((len(own_spots), len(frame)), UNMATCHED)
    spot_of_line[:, lines] = own_spots
    visible = np.empty(len(own_spots), dtype=np.intp)
    pieces = []
    size = max(1, _PIECE // (len(spots.mm) * max(len(others), 1)))
    for start in range(0, len(own_spots), size):
        rows = slice(start, start + size)
        seen, hits = _predict(spots, frame, lines, others, own_spots[rows], seeds.take(rows))
        visible[rows] = seen
        pieces.append((hits[0] + start, *hits[1:]))
    if pieces:
        hit_seed, hit_other, hit_spot, sharpness, squared = (
            np.concatenate(parts) for parts in zip(*pieces, strict=True)
        )
    else:
        hit_seed, hit_other, hit_spot = (np.empty(0, dtype=np.intp) for _ in range(3))
        sharpness = squared = np.empty(0)
    nearest_hits = spot_of_line.copy()
    farthest_first = np.argsort(-squared, kind="stable")  # so that the nearest is written last
    nearest_hits[hit_seed[farthest_first], others[hit_other[farthest_first]]] = hit_spot[farthest_first]
    rank, rods_hit = _rank_rods(hit_seed, hit_other, sharpness, len(own_spots), len(others))
    return SeedSearch(
        seeds,
        spot_of_line,
        hit_seed,
        others[hit_other],
        hit_spot,
        rank,
        nearest_hits,
        3 + rods_hit,
        np.bincount(visible[visible >= 0], minlength=len(others) + 1).astype(np.int64),
    )


def spot_triples(mm: Array, solver: ThreeLineSolver) -> NDArray[np.intp]:
    """Rows (t, 3) of distinct spots (s, 2) at distances that the three rods can have, not nearly collinear."""
    x, y = mm[:, 0][:, None] - mm[:, 0], mm[:, 1][:, None] - mm[:, 1]
    distance = np.sqrt(x * x + y * y)
    allowed = []
    for row in range(len(PAIRS)):
        pair = (distance >= solver.distance_low[row]) & (distance <= solver.distance_high[row])
        np.fill_diagonal(pair, False)
        allowed.append(pair)
    first, second = np.nonzero(allowed[0])
    pair_row, third = np.nonzero(allowed[1][first] & allowed[2][second])
    first, second = first[pair_row], second[pair_row]
    twice_area = np.abs(x[second, first] * y[third, first] - y[second, first] * x[third, first])
    longest = np.maximum(np.maximum(distance[first, second], distance[first, third]), distance[second, third])
    spread = twice_area > _LEAST_FLATNESS * longest * longest
    return np.stack([first[spread], second[spread], third[spread]], axis=1)


def _predict(
    spots: Spots,
    frame: Frame,
    lines: list[int],
    others: NDArray[np.intp],
    own_spots: NDArray[np.intp],
    seeds: Seeds,
) -> tuple[NDArray[np.intp], tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Array, Array]]:
    """How many further rods each seed has the slice cut (m,), -1 for one that does not count, and the hits.

    Of a hit: seed, further rod, spot, size and distance. The size is the determinant of the prediction's covariance,
    mm^4; the distance is squared, in standard deviations.

    A further rod's cut follows the seed's positions lambda: its point moves by w = slope y_z - y_xy of each seed rod,
    weighted by the cut's barycentric coordinate in the seed's triangle.
    """
    cuts = cut(frame, seeds.rotations, seeds.translations)
    directions = cuts.directions
    corner = spots.mm[own_spots]
    where_x, where_y = cuts.points_mm[:, others, 0], cuts.points_mm[:, others, 1]
    ax, ay = corner[:, 1, 0] - corner[:, 0, 0], corner[:, 1, 1] - corner[:, 0, 1]
    bx, by = corner[:, 2, 0] - corner[:, 0, 0], corner[:, 2, 1] - corner[:, 0, 1]
    inverse = (1.0 / (ax * by - ay * bx))[:, None]
    dx, dy = where_x - corner[:, 0, 0, None], where_y - corner[:, 0, 1, None]
    second = (dx * by[:, None] - dy * bx[:, None]) * inverse
    third = (dy * ax[:, None] - dx * ay[:, None]) * inverse
    weights = (1.0 - second - third, second, third)
    with np.errstate(invalid="ignore", divide="ignore"):
        along = 1.0 / directions[:, others, 2]
        slope_x, slope_y = directions[:, others, 0] * along, directions[:, others, 1] * along
    moved_x, moved_y = [], []
    for weight, line in zip(weights, lines, strict=True):
        own = directions[:, line, :, None]
        moved_x.append(weight * (slope_x * own[:, 2] - own[:, 0]))
        moved_y.append(weight * (slope_y * own[:, 2] - own[:, 1]))
    noise = spots.sigma_mm**2 * (1.0 + weights[0] ** 2 + weights[1] ** 2 + weights[2] ** 2)
    xx, yy, xy = noise, noise.copy(), np.zeros_like(noise)
    for i in range(3):
        for j in range(3):
            covariance = seeds.lambda_covariance[:, i, j, None]
            xx = xx + covariance * moved_x[i] * moved_x[j]
            yy = yy + covariance * moved_y[i] * moved_y[j]
            xy = xy + covariance * moved_x[i] * moved_y[j]
    with np.errstate(invalid="ignore"):
        # How far the cut may yet slide along its rod.
        slide = 4.0 * np.sqrt(np.maximum(xx, yy)) / np.maximum(np.sqrt(slope_x**2 + slope_y**2), 0.1)
        low, high = frame.lambda_min[others] - END_SLACK_MM, frame.lambda_max[others] + END_SLACK_MM
        lambdas = cuts.lambdas[:, others]
        sound = np.abs(directions[:, others, 2]) >= LEAST_COSINE
        seen = ((lambdas >= low) & (lambdas <= high) & sound).sum(axis=1)
        # A pose that leans its own rods so far is not one that is sought, though it may lead to one.
        seen[(np.abs(directions[:, lines, 2]) < LEAST_COSINE).any(axis=1)] = -1
        on_rod = (lambdas >= low - slide) & (lambdas <= high + slide)
        determinant = xx * yy - xy * xy
    seed, other = np.nonzero(on_rod)
    chosen = (seed, other)
    xx, yy, xy, determinant = xx[chosen], yy[chosen], xy[chosen], determinant[chosen]
    # Most spots are far from most predictions: a box around the gate sorts them out before the ellipse is looked at.
    reach_x, reach_y = np.sqrt(_SEED_GATE * xx), np.sqrt(_SEED_GATE * yy)
    off_x = spots.mm[:, 0] - where_x[chosen][:, None]
    near = np.abs(off_x) <= reach_x[:, None]
    off_y = spots.mm[:, 1] - where_y[chosen][:, None]
    near &= np.abs(off_y) <= reach_y[:, None]
    prediction, spot = np.nonzero(near)
    off_x, off_y = off_x[prediction, spot], off_y[prediction, spot]
    squared = yy[prediction] * off_x**2 + xx[prediction] * off_y**2 - 2 * xy[prediction] * off_x * off_y
    inside = squared <= _SEED_GATE * determinant[prediction]
    inside &= (own_spots[seed[prediction]] != spot[:, None]).all(axis=1)
    prediction, spot = prediction[inside], spot[inside]
    determinant = determinant[prediction]
    return seen, (seed[prediction], other[prediction], spot, determinant, squared[inside] / determinant)


def _rank_rods(
    hit_seed: NDArray[np.intp], hit_other: NDArray[np.intp], sharpness: Array, seeds: int, others: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each hit the rank of its rod among those hit of its seed, smallest gate first; and how many rods are hit."""
    gate = np.full((seeds, others), np.inf)
    gate[hit_seed, hit_other] = sharpness
    order = np.argsort(np.argsort(gate, axis=1, kind="stable"), axis=1, kind="stable")
    return order[hit_seed, hit_other], np.isfinite(gate).sum(axis=1)
