"""From a start to a settled match: refined, all rods matched to the spots they predict, until nothing changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut_jacobian
from stereoreg_ros.matching.consensus import GATE, Spots
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.seed_search import END_SLACK_MM, Starts
from stereoreg_ros.matching.significance import LEAST_COSINE
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine

_ROUNDS = 4
# Variance of a prediction, in units of a spot's, beyond which it says nothing about where the spot should be.
_VAGUE = 1e6


def settle(spots: Spots, frame: Frame, start: Starts, min_inliers: int) -> list[Hypothesis]:
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
            break
    stable = (_assign(spots, frame, refined) == assigned).all(axis=1)
    return [
        Hypothesis(
            refined.rotations[i],
            refined.translations[i],
            assigned[i],
            float(refined.chi_square[i]),
            refined.information[i],
            np.nan,
        )
        for i in np.flatnonzero(stable)
    ]


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
    in_slack &= np.abs(refined.cuts.directions[..., 2]) >= LEAST_COSINE
    squared = np.where((in_slack & known)[..., None], squared, np.inf)
    nearest = squared.argmin(axis=2)
    least = np.take_along_axis(squared, nearest[..., None], axis=2)[..., 0]
    assigned = np.where(least <= GATE, nearest, UNMATCHED)
    # Where two rods want one spot, the nearer has it.
    for line in range(len(frame)):
        rival = (assigned == assigned[:, line : line + 1]) & (assigned != UNMATCHED)
        rival[:, line] = False
        loses = (rival & (least < least[:, line : line + 1])).any(axis=1)
        loses |= (rival[:, :line] & (least[:, :line] == least[:, line : line + 1])).any(axis=1)
        assigned[loses, line] = UNMATCHED
    return assigned
