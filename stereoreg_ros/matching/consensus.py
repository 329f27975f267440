"""What all matchers share: the spots as they see them, and how an explanation is scored and judged."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.significance import (
    LEAST_COSINE,
    area_of_uniform_mm2,
    choices_of_rods,
    clutter_area_mm2,
    log10_false_alarms,
    share_of,
)

# Squared distance in standard deviations, two degrees of freedom, beyond which a spot is not the predicted one: 1e-4.
GATE = 18.4
# Height in chi-square of the ridge between two optima below which they are one valley; and its largest extent, rad.
_RIDGE = 4.0
_LARGEST_VALLEY = 0.5
# A likelihood ratio, as log, by which explanations count as told apart; a thousand to one.
TOLD_APART = 6.9


# What a rod that the slice must cut, and that has no spot, costs an explanation: one in twenty rods shows none.
MISSING_COST = 3.0
# A rod is surely cut only so far from its ends, mm.
SURE_MM = 2.0


class Spots(NamedTuple):
    """Spots as the matcher sees them.

    mm: (s, 2) in the slice; whitening: (2, 2) 1/mm, to unit variance; sigma_mm: the larger standard deviation of a
    spot's centre along x or y; variance_mm2: product of both; slice_area_mm2: over which spots could lie, None where
    not known.
    """

    mm: Array
    whitening: Array
    sigma_mm: float
    variance_mm2: float
    slice_area_mm2: float | None

    def gain(self, frame: Frame) -> float:
        """Log-likelihood ratio of a spot right where a rod is predicted, to its being one of the clutter.

        The clutter is taken to be as dense as if every rod had a spot.
        """
        clutter = max(len(self.mm) - len(frame), 0) + 1
        area_mm2 = area_of_uniform_mm2(self.mm, self.slice_area_mm2)
        return math.log(area_mm2 / (clutter * 2 * math.pi * self.variance_mm2))

    def only(self, rows: NDArray[np.intp]) -> Spots:
        """Some of the spots."""
        return self._replace(mm=self.mm[rows])

    def surround(self, points_mm: Array) -> NDArray[np.bool_]:
        """Which points (..., 2) mm lie within the box around the spots: there a rod would have been seen."""
        inside = (points_mm >= self.mm.min(axis=0)) & (points_mm <= self.mm.max(axis=0))
        return np.asarray(inside.all(axis=-1))


def count_missing(spots: Spots, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers (m,) of rods without a spot that the slice must cut, well within their ends and among the spots."""
    with np.errstate(invalid="ignore"):
        sure = (cuts.lambdas >= frame.lambda_min + SURE_MM) & (cuts.lambdas <= frame.lambda_max - SURE_MM)
        sure &= (np.abs(cuts.directions[..., 2]) >= LEAST_COSINE) & spots.surround(cuts.points_mm)
    return np.asarray((sure & (spot_of_line == UNMATCHED)).sum(axis=1))


def score(hypothesis: Hypothesis, gain: float) -> float:
    """Log-likelihood of an explanation over all spots being clutter: what explanations are ranked by."""
    return hypothesis.inliers * gain - hypothesis.chi_square / 2 - MISSING_COST * hypothesis.missing


def distinct(found: list[Hypothesis], gain: float) -> list[Hypothesis]:
    """The explanations best first, without those that say the same as a better one.

    Two optima of one flat valley are one explanation, whose covariance holds both: near a double root the tilt's sign
    is not known, and the better optimum's own curvature does not say so.
    """
    scores = {id(hypothesis): score(hypothesis, gain) for hypothesis in found}
    found = sorted(found, key=lambda h: -scores[id(h)])
    kept: list[Hypothesis] = []
    for hypothesis in found:
        if scores[id(found[0])] - scores[id(hypothesis)] > 2 * TOLD_APART:
            break
        for row, other in enumerate(kept):
            difference = _difference(hypothesis, other)
            if _is_same(difference, hypothesis, other):
                kept[row] = _widened(other, difference, score(other, gain) - score(hypothesis, gain))
                break
        else:
            kept.append(hypothesis)
    return kept


def _difference(a: Hypothesis, b: Hypothesis) -> Array:
    """Perturbation (6,) of `Pose.perturbed` that leads from b to a."""
    turn = Rotation.from_matrix(a.rotation @ b.rotation.T).as_rotvec()
    return np.concatenate([a.translation - b.translation, turn])


def _is_same(difference: Array, a: Hypothesis, b: Hypothesis) -> bool:
    """Whether two poses belong to one valley: between them chi-square hardly rises over its values at both.

    Two optima at distance d (Mahalanobis, by the curvature at either) of a double well are parted by a ridge of d^2/16.
    """
    if np.linalg.norm(difference[3:]) > _LARGEST_VALLEY:
        return False
    return max(float(difference @ h.information @ difference) for h in (a, b)) < 16 * _RIDGE


def _widened(hypothesis: Hypothesis, difference: Array, behind: float) -> Hypothesis:
    """The hypothesis with a covariance that holds another optimum too, less likely by `behind` (log)."""
    share = 1.0 / (1.0 + np.exp(min(behind, 50.0)))
    if share * float(difference @ hypothesis.information @ difference) < 1e-3:
        return hypothesis
    covariance = np.linalg.pinv(hypothesis.information) + share * np.outer(difference, difference)
    return replace(hypothesis, information=np.linalg.pinv(covariance))


def judged(
    found: list[Hypothesis], spots: Spots, frame: Frame, seeds_by_visible: Callable[[int], NDArray[np.int64]]
) -> list[Hypothesis]:
    """Of distinct explanations, best first, those that the best one does not rule out, with their false alarms.

    seeds_by_visible: for so many inliers, at v, how many seeds were found that have the slice cut v rods besides their
    own three.
    """
    gain = spots.gain(frame)
    return [
        _with_significance(hypothesis, spots, frame, seeds_by_visible(hypothesis.inliers))
        for hypothesis in found
        if score(found[0], gain) - score(hypothesis, gain) < TOLD_APART
    ]


def _with_significance(
    hypothesis: Hypothesis, spots: Spots, frame: Frame, seeds_by_visible: NDArray[np.int64]
) -> Hypothesis:
    value = log10_by_chance(hypothesis, spots, frame, seeds_by_visible, hypothesis.inliers, hypothesis.chi_square)
    return replace(hypothesis, log10_false_alarms=value - math.log10(share_of(hypothesis.inliers, len(frame))))


def log10_by_chance(
    hypothesis: Hypothesis,
    spots: Spots,
    frame: Frame,
    seeds_by_visible: NDArray[np.int64],
    inliers: int,
    chi_square: float,
) -> float:
    """log10 of the expected number of explanations that chance brings of so many rods, with a chi-square this low.

    Poses are taken to be determined as well as by the hypothesis.
    """
    used = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    cuts = cut(frame, hypothesis.rotation[None], hypothesis.translation[None])
    jacobian = (spots.whitening @ cut_jacobian(cuts, hypothesis.translation[None]))[0]
    by_line = np.swapaxes(jacobian, 1, 2) @ jacobian
    # Any three of the rods could have been the seed; the one that fixes the pose best predicts the sharpest.
    triples = np.array(list(combinations(used, 3)))
    seeds = by_line[triples].sum(axis=1)
    best = seeds[np.argmax(np.linalg.slogdet(seeds)[1])]
    return log10_false_alarms(
        inliers=inliers,
        spots=len(spots.mm),
        choices_of_rods=choices_of_rods(seeds_by_visible, inliers),
        chi_square=chi_square,
        information=by_line[used].sum(axis=0),
        seed_information=best,
        spot_variance_mm2=spots.variance_mm2,
        area_mm2=clutter_area_mm2(spots.mm, hypothesis.spot_of_line[used], spots.slice_area_mm2),
        share=1.0,
    )
