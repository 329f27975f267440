"""Matching from seeds of three rods and three spots, the least that fixes a pose.

Triples of spots -> poses (`solvers.three_lines`) -> further rods predicted, with the uncertainty that the seed has ->
one further spot, refined -> all rods predicted and matched, refined until the matches no longer change.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, rotation_angle
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.matching.consensus import Spots, distinct, judged
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.triple_order import triple_order
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine
from stereoreg_ros.solvers.three_lines import PAIRS, Seeds, ThreeLineSolver

# Squared distance in standard deviations, two degrees of freedom, beyond which a spot is not the predicted one: 1e-4.
_GATE = 18.4
# The same for a seed, whose prediction is only first-order: it need but let the right spot through.
_SEED_GATE = 2 * _GATE
# How far beyond its end a rod may be cut: the noise apart, partial volume makes its end unsharp.
END_SLACK_MM = 1.0
# Spots whose triangle is flatter than this (height over longest side) fix no pose: rods of one plane.
_LEAST_FLATNESS = 0.03
# Angle beyond the allowed rotation at which a seed, which is not yet refined, is dropped.
_SEED_ROTATION_SLACK = np.radians(10.0)
_ROUNDS = 4
# Hypotheses refined at once: bounds the memory.
_CHUNK = 4000
# Variance of a prediction, in units of a spot's, beyond which it says nothing about where the spot should be.
_VAGUE = 1e6


def match(
    spots: Spots, frame: Frame, nominal_slice_from_frame: Array, options: RegistrationOptions
) -> list[Hypothesis]:
    """All explanations of the spots that the best one does not rule out, best first; none where there is none.

    nominal_slice_from_frame: (3, 3), how the frame roughly stands in the slice.
    Every set of rods that could hold the best explanation is visited; the search ends once no unvisited set could
    match as many rods as the best one found.
    """
    found: list[Hypothesis] = []
    seeds_by_visible = np.zeros(len(frame) - 2, dtype=np.int64)  # how many further rods a seed has the slice cut
    max_rotation = np.radians(options.max_rotation_deg)
    sizes_tried = max(len(frame) - options.min_inliers + 1, 1)
    for lines, complete_from in triple_order(frame, options.min_inliers):
        solver = _solver(frame, lines, round(6.0 * spots.sigma_mm + 0.05, 1))
        triples = _spot_triples(spots.mm, solver)
        seeds = solver.solve(spots.mm[triples])
        angle = rotation_angle(seeds.rotations @ nominal_slice_from_frame.T)
        kept = angle <= max_rotation + _SEED_ROTATION_SLACK
        seeds = seeds.take(kept)
        if not len(seeds.triples):
            continue
        extended, visible = _extend(spots, frame, lines, triples, seeds)
        seeds_by_visible += np.bincount(visible, minlength=len(seeds_by_visible))
        for start in range(0, len(extended.spot_of_line), _CHUNK):
            part = extended.take(slice(start, start + _CHUNK))
            refined, spot_of_line = _settle(spots, frame, part, options.min_inliers)
            good = rotation_angle(refined.rotations @ nominal_slice_from_frame.T) <= max_rotation
            for i in np.flatnonzero(good):
                found.append(
                    Hypothesis(
                        refined.rotations[i],
                        refined.translations[i],
                        spot_of_line[i],
                        float(refined.chi_square[i]),
                        refined.information[i],
                        np.nan,
                    )
                )
        found = distinct(found, spots)
        if found and complete_from <= found[0].inliers:
            break
    return judged(found, spots, frame, seeds_by_visible, sizes_tried)


@lru_cache(maxsize=64)
def _solver(frame: Frame, lines: tuple[int, int, int], tolerance_mm: float) -> ThreeLineSolver:
    return ThreeLineSolver(frame, lines, tolerance_mm, END_SLACK_MM)


def _spot_triples(mm: Array, solver: ThreeLineSolver) -> NDArray[np.intp]:
    """Rows (t, 3) of distinct spots at distances that the three rods can have, not nearly collinear."""
    offset = mm[:, None] - mm[None]
    distance = np.sqrt((offset**2).sum(axis=-1))
    allowed = []
    for row in range(len(PAIRS)):
        pair = (distance >= solver.distance_low[row]) & (distance <= solver.distance_high[row])
        np.fill_diagonal(pair, False)
        allowed.append(pair)
    first, second = np.nonzero(allowed[0])
    pair_row, third = np.nonzero(allowed[1][first] & allowed[2][second])
    first, second = first[pair_row], second[pair_row]
    a, b = offset[second, first], offset[third, first]
    twice_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    longest = np.maximum(np.maximum(distance[first, second], distance[first, third]), distance[second, third])
    spread = twice_area > _LEAST_FLATNESS * longest**2
    triples: NDArray[np.intp] = np.column_stack([first, second, third])[spread]
    return triples


class Extended(NamedTuple):
    """Seeds with one further match: where to start refining.

    rotations (m, 3, 3), translations (m, 3); spot_of_line (m, n), UNMATCHED where none.
    """

    rotations: Array
    translations: Array
    spot_of_line: NDArray[np.intp]

    def take(self, rows: slice) -> Extended:
        """Only the given ones."""
        return Extended(self.rotations[rows], self.translations[rows], self.spot_of_line[rows])


def _extend(
    spots: Spots, frame: Frame, lines: tuple[int, int, int], triples: NDArray[np.intp], seeds: Seeds
) -> tuple[Extended, NDArray[np.intp]]:
    """Every seed with every further rod and every spot that may be that rod's; and how many further rods each seed
    has the slice cut.

    A further rod's cut follows the seed's positions lambda: its point moves by w = slope y_z - y_xy of each seed rod,
    weighted by the cut's barycentric coordinate in the seed's triangle.
    """
    cuts = cut(frame, seeds.rotations, seeds.translations)
    others = [line for line in range(len(frame)) if line not in lines]
    corner = spots.mm[triples[seeds.triples]]
    edges = np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)
    inverse = np.linalg.inv(edges)
    with np.errstate(invalid="ignore"):
        slope = cuts.directions[..., :2] / cuts.directions[..., 2:]
    seed_directions = cuts.directions[:, list(lines)]
    chosen: list[tuple[NDArray[np.intp], int, NDArray[np.intp]]] = []
    visible = np.zeros(len(seeds.triples), dtype=np.intp)
    for line in others:
        where = cuts.points_mm[:, line]
        late = np.einsum("mij,mj->mi", inverse, where - corner[:, 0])
        weight = np.column_stack([1 - late.sum(axis=1), late])
        moved = slope[:, None, line] * seed_directions[..., 2:] - seed_directions[..., :2]
        jacobian = np.swapaxes(weight[..., None] * moved, 1, 2)
        covariance = jacobian @ seeds.lambda_covariance @ np.swapaxes(jacobian, 1, 2)
        own = spots.sigma_mm**2 * (1 + (weight**2).sum(axis=1))
        xx, yy, xy = covariance[:, 0, 0] + own, covariance[:, 1, 1] + own, covariance[:, 0, 1]
        # How far the cut may yet slide along its rod.
        slide = 4 * np.sqrt(np.maximum(xx, yy)) / np.maximum(np.linalg.norm(slope[:, line], axis=1), 0.1)
        with np.errstate(invalid="ignore"):
            on_rod = cuts.lambdas[:, line] >= frame.lambda_min[line] - END_SLACK_MM - slide
            on_rod &= cuts.lambdas[:, line] <= frame.lambda_max[line] + END_SLACK_MM + slide
        visible += on_rod
        rows = np.flatnonzero(on_rod)
        offset = spots.mm[None] - where[rows, None]
        determinant = (xx * yy - xy**2)[rows, None]
        squared = yy[rows, None] * offset[..., 0] ** 2 + xx[rows, None] * offset[..., 1] ** 2
        squared -= 2 * xy[rows, None] * offset[..., 0] * offset[..., 1]
        seed, spot = np.nonzero(squared <= _SEED_GATE * determinant)
        seed = rows[seed]
        fresh = (triples[seeds.triples[seed]] != spot[:, None]).all(axis=1)
        chosen.append((seed[fresh], line, spot[fresh]))
    seed = np.concatenate([c[0] for c in chosen])
    spot_of_line = np.full((len(seed), len(frame)), UNMATCHED)
    spot_of_line[:, list(lines)] = triples[seeds.triples[seed]]
    spot_of_line[np.arange(len(seed)), np.repeat([c[1] for c in chosen], [len(c[0]) for c in chosen])] = np.concatenate(
        [c[2] for c in chosen]
    )
    extended = Extended(seeds.rotations[seed], seeds.translations[seed], spot_of_line)
    return extended, visible


def _settle(spots: Spots, frame: Frame, start: Extended, min_inliers: int) -> tuple[Refined, NDArray[np.intp]]:
    """Refine, match all rods to the spots they predict, and repeat until the matches no longer change."""
    rotations, translations, spot_of_line = start.rotations, start.translations, start.spot_of_line
    refined = _refine(spots, frame, rotations, translations, spot_of_line, iterations=6)
    for _ in range(_ROUNDS):
        assigned = _assign(spots, frame, refined)
        enough = (assigned != UNMATCHED).sum(axis=1) >= min_inliers
        # The same matches from many seeds: one start is enough for each place the pose can be.
        place = np.round(np.column_stack([10 * refined.rotations.reshape(-1, 9), refined.translations / 5]))
        rows = np.flatnonzero(enough)
        _, first = np.unique(np.column_stack([assigned[rows], place[rows]]), axis=0, return_index=True)
        rows = rows[first]
        rotations, translations, assigned = refined.rotations[rows], refined.translations[rows], assigned[rows]
        refined = _refine(spots, frame, rotations, translations, assigned, iterations=30)
        if not len(rows) or (_assign(spots, frame, refined) == assigned).all():
            return refined, assigned
    stable = (_assign(spots, frame, refined) == assigned).all(axis=1)
    return refined.take(stable), assigned[stable]


def _refine(
    spots: Spots, frame: Frame, rotations: Array, translations: Array, spot_of_line: NDArray[np.intp], iterations: int
) -> Refined:
    used = spot_of_line != UNMATCHED
    return refine(frame, rotations, translations, spots.mm[spot_of_line], used, spots.whitening, iterations)


def _assign(spots: Spots, frame: Frame, refined: Refined) -> NDArray[np.intp]:
    """For each pose and rod the nearest spot that the pose's uncertainty and the noise allow; one rod, one spot."""
    regular = refined.information + 1e-9 * np.eye(6) * np.trace(refined.information, axis1=1, axis2=2)[:, None, None]
    covariance = np.linalg.inv(regular)
    with np.errstate(invalid="ignore", divide="ignore"):
        jacobian = spots.whitening @ cut_jacobian(refined.cuts, refined.translations)
        # Of a spot used for the pose the residual varies less than this, of another one just as much: a gate for both.
        predicted = jacobian @ covariance[:, None] @ np.swapaxes(jacobian, -1, -2)
    xx, yy, xy = predicted[..., 0, 0] + 1, predicted[..., 1, 1] + 1, predicted[..., 0, 1]
    with np.errstate(invalid="ignore", over="ignore"):
        known = xx + yy < _VAGUE  # false for NaN too: a rod that runs within the slice
        determinant = np.where(known, xx * yy - xy**2, 1.0)
        offset = (spots.mm[None, None] - refined.cuts.points_mm[:, :, None]) @ spots.whitening.T
        squared = yy[..., None] * offset[..., 0] ** 2 + xx[..., None] * offset[..., 1] ** 2
        squared = (squared - 2 * xy[..., None] * offset[..., 0] * offset[..., 1]) / determinant[..., None]
    in_slack = refined.cuts.lambdas >= frame.lambda_min - END_SLACK_MM
    in_slack &= refined.cuts.lambdas <= frame.lambda_max + END_SLACK_MM
    squared = np.where((in_slack & known)[..., None], squared, np.inf)
    nearest = squared.argmin(axis=2)
    least = np.take_along_axis(squared, nearest[..., None], axis=2)[..., 0]
    assigned = np.where(least <= _GATE, nearest, UNMATCHED)
    # Where two rods want one spot, the nearer has it.
    for line in range(len(frame)):
        rival = (assigned == assigned[:, line : line + 1]) & (assigned != UNMATCHED)
        rival[:, line] = False
        loses = (rival & (least < least[:, line : line + 1])).any(axis=1)
        loses |= (rival[:, :line] & (least[:, :line] == least[:, line : line + 1])).any(axis=1)
        assigned[loses, line] = UNMATCHED
    return assigned
