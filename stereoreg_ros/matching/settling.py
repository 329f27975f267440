"""From a start to a settled match: refined, all rods matched to the spots they predict, until nothing changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.geometry.visibility import may_show
from stereoreg_ros.matching.consensus import GATE, count_missing
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine

_ROUNDS = 4
# Steps of a first refinement: most starts that lead anywhere are at rest by then.
_FIRST_STEPS, _STEPS = 8, 30
# Variance of a prediction, in units of a spot's, beyond which it says nothing about where the spot should be.
_VAGUE = 1e6


def settle(spots: Spots, frame: Frame, start: Starts, min_inliers: int) -> list[Hypothesis]:
    """Refine, match all rods to the spots they predict, and repeat until the matches no longer change."""
    settled: list[Hypothesis] = []
    spot_of_line, origin = start.spot_of_line, start.origin
    refined = refine_matches(spots, frame, (start.rotations, start.translations), spot_of_line, _FIRST_STEPS)
    for number in range(_ROUNDS):
        assigned = _assign(spots, frame, refined)
        enough = (assigned != UNMATCHED).sum(axis=1) >= min_inliers
        same = (assigned == spot_of_line).all(axis=1)
        at_rest = same & (refined.converged | (number > 0))
        settled += _polished(spots, frame, refined.take(enough & at_rest), assigned[enough & at_rest])
        # What another start from the same seed has come to is not sought again.
        known = {(origin[i], assigned[i].tobytes()) for i in np.flatnonzero(at_rest)}
        rows = np.array(
            [i for i in np.flatnonzero(enough & ~at_rest) if (origin[i], assigned[i].tobytes()) not in known],
            dtype=np.intp,
        )
        if not rows.size:
            break
        if rows.size > 1:
            # The same matches from many seeds: one start is enough for each place the pose can be.
            place = np.column_stack([10 * refined.rotations[rows].reshape(-1, 9), refined.translations[rows] / 5])
            rows = rows[np.unique(np.column_stack([assigned[rows], np.round(place)]), axis=0, return_index=True)[1]]
        spot_of_line, origin = assigned[rows], origin[rows]
        poses = refined.rotations[rows], refined.translations[rows]
        refined = refine_matches(spots, frame, poses, spot_of_line)
    return settled


def settle_as_matched(spots: Spots, frame: Frame, start: Starts) -> list[Hypothesis]:
    """Explanations of these very matches: refined, but no rod is matched anew.

    Where few matches leave the pose open, a rod without a spot takes that of another rod, however far off; what
    `settle` comes to then is another explanation.
    """
    refined = refine_matches(spots, frame, (start.rotations, start.translations), start.spot_of_line)
    polished = _polished(spots, frame, refined, start.spot_of_line)
    unmatched = start.spot_of_line == UNMATCHED
    shown = (may_show(frame, refined.cuts) | unmatched).all(axis=1)
    return [one for one, is_shown in zip(polished, shown, strict=True) if is_shown]


def _polished(spots: Spots, frame: Frame, refined: Refined, spot_of_line: NDArray[np.intp]) -> list[Hypothesis]:
    """Explanations of settled matches, with the errors of rods and scale as they are at these poses.

    A start may be far from where it leads: a rod's error counts by how the rod leans there.
    """
    if not len(spot_of_line):
        return []
    poses = refined.rotations, refined.translations
    return hypotheses_of(spots, frame, refine_matches(spots, frame, poses, spot_of_line, _FIRST_STEPS), spot_of_line)


def hypotheses_of(spots: Spots, frame: Frame, refined: Refined, spot_of_line: NDArray[np.intp]) -> list[Hypothesis]:
    """One explanation for each of m refined poses with their matches (m, n)."""
    missing = count_missing(spots, frame, refined.cuts, spot_of_line)
    return [
        Hypothesis(
            refined.rotations[i],
            refined.translations[i],
            spot_of_line[i],
            float(refined.chi_square[i]),
            refined.information[i],
            int(missing[i]),
        )
        for i in range(len(spot_of_line))
    ]


def refine_matches(
    spots: Spots, frame: Frame, poses: tuple[Array, Array], spot_of_line: NDArray[np.intp], steps: int = _STEPS
) -> Refined:
    """Refine poses slice_from_frame (m, 3, 3), (m, 3) mm to matches (m, n), weighed as they are where they start."""
    used = spot_of_line != UNMATCHED
    cuts = cut(frame, *poses)
    common = spots.common(frame, cuts, spot_of_line, used)
    whitening = spots.whitening(frame, cuts, spot_of_line)
    return refine(frame, *poses, spots.mm[spot_of_line], used, whitening, steps, common)


def _assign(spots: Spots, frame: Frame, refined: Refined) -> NDArray[np.intp]:
    """For each pose and rod the nearest spot that the pose's uncertainty and the noise allow; one rod, one spot."""
    regular = refined.information + 1e-9 * np.eye(6) * np.trace(refined.information, axis1=1, axis2=2)[:, None, None]
    covariance = np.linalg.inv(regular)
    with np.errstate(invalid="ignore", divide="ignore"):
        jacobian = cut_jacobian(refined.cuts, refined.translations)
        # Of a spot used for the pose the residual varies less than this, of another one just as much: a gate for both.
        predicted = jacobian @ covariance[:, None] @ np.swapaxes(jacobian, -1, -2)
        known = predicted[..., 0, 0] + predicted[..., 1, 1] < _VAGUE * spots.sigma_mm**2  # false for NaN too
    predicted = predicted + spots.tolerances.rod_covariances(frame, refined.cuts)
    noise = spots.covariances_mm2
    xx, yy, xy = (predicted[..., i, j, None] + noise[:, i, j] for i, j in ((0, 0), (1, 1), (0, 1)))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        offset_x = spots.mm[:, 0] - refined.cuts.points_mm[..., 0, None]
        offset_y = spots.mm[:, 1] - refined.cuts.points_mm[..., 1, None]
        squared = yy * offset_x**2 + xx * offset_y**2 - 2 * xy * offset_x * offset_y
        squared /= xx * yy - xy**2
    possible = (may_show(frame, refined.cuts) & known)[..., None]
    if spots.streaks is not None:
        possible = possible & spots.streaks.allow(frame, refined.cuts)
    squared = np.where(possible, squared, np.inf)
    nearest = squared.argmin(axis=2)
    least = np.take_along_axis(squared, nearest[..., None], axis=2)[..., 0]
    assigned = np.where(least <= GATE, nearest, UNMATCHED)
    # Where two rods want one spot, the nearer has it.
    wanted = np.sort(assigned, axis=1)
    contested = ((wanted[:, 1:] == wanted[:, :-1]) & (wanted[:, 1:] != UNMATCHED)).any(axis=1)
    for row in np.flatnonzero(contested):
        taken: set[int] = set()
        for line in np.argsort(least[row], kind="stable"):
            if assigned[row, line] in taken:
                assigned[row, line] = UNMATCHED
            taken.add(int(assigned[row, line]))
    return assigned
