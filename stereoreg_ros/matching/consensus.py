"""What all matchers share: the spots as they see them, and how an explanation is scored and judged."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut, cut_jacobian
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.significance import clutter_area_mm2, log10_false_alarms, share_of

# Squared distance in standard deviations, two degrees of freedom, beyond which a spot is not the predicted one: 1e-4.
GATE = 18.4
# Height in chi-square of the ridge between two optima below which they are one valley; and its largest extent, rad.
_RIDGE = 4.0
_LARGEST_VALLEY = 0.5
# A likelihood ratio, as log, by which explanations count as told apart; a thousand to one.
TOLD_APART = 6.9


class Spots(NamedTuple):
    """Spots as the matcher sees them.

    mm: (s, 2) in the slice; whitening: (2, 2) 1/mm, to unit variance; sigma_mm: the larger standard deviation of a
    spot's centre along x or y; variance_mm2: product of both; hull_area_mm2: over which spots lie; slice_area_mm2: over
    which they could, None where not known.
    """

    mm: Array
    whitening: Array
    sigma_mm: float
    variance_mm2: float
    hull_area_mm2: float
    slice_area_mm2: float | None


def score(hypothesis: Hypothesis, spots: Spots) -> float:
    """Log-likelihood of the matches over their being uniform clutter: what explanations are ranked by."""
    gain = np.log(spots.hull_area_mm2 / (2 * np.pi * spots.variance_mm2))
    return float(hypothesis.inliers * gain - hypothesis.chi_square / 2)


def distinct(found: list[Hypothesis], spots: Spots) -> list[Hypothesis]:
    """The explanations best first, without those that say the same as a better one.

    Two optima of one flat valley are one explanation, whose covariance holds both: near a double root the tilt's sign
    is not known, and the better optimum's own curvature does not say so.
    """
    found = sorted(found, key=lambda h: -score(h, spots))
    kept: list[Hypothesis] = []
    for hypothesis in found:
        if score(kept[0] if kept else hypothesis, spots) - score(hypothesis, spots) > 2 * TOLD_APART:
            break
        for row, other in enumerate(kept):
            difference = _difference(hypothesis, other)
            if _is_same(difference, hypothesis, other):
                kept[row] = _widened(other, difference, score(other, spots) - score(hypothesis, spots))
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
    found: list[Hypothesis], spots: Spots, frame: Frame, seeds_by_visible: NDArray[np.int64]
) -> list[Hypothesis]:
    """Of distinct explanations, best first, those that the best one does not rule out, with their false alarms.

    seeds_by_visible: at v, how many seeds were found that have the slice cut v rods besides their own three.
    """
    return [
        _with_significance(hypothesis, spots, frame, seeds_by_visible)
        for hypothesis in found
        if score(found[0], spots) - score(hypothesis, spots) < TOLD_APART
    ]


def _with_significance(
    hypothesis: Hypothesis, spots: Spots, frame: Frame, seeds_by_visible: NDArray[np.int64]
) -> Hypothesis:
    used = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    cuts = cut(frame, hypothesis.rotation[None], hypothesis.translation[None])
    jacobian = (spots.whitening @ cut_jacobian(cuts, hypothesis.translation[None]))[0]
    by_line = np.swapaxes(jacobian, 1, 2) @ jacobian
    # Any three of the rods could have been the seed; the one that fixes the pose best predicts the sharpest.
    triples = np.array(list(combinations(used, 3)))
    seeds = by_line[triples].sum(axis=1)
    best = seeds[np.argmax(np.linalg.slogdet(seeds)[1])]
    choices = (int(seeds) * comb(visible, len(used) - 3) for visible, seeds in enumerate(seeds_by_visible))
    value = log10_false_alarms(
        inliers=len(used),
        spots=len(spots.mm),
        choices_of_rods=sum(choices),
        chi_square=hypothesis.chi_square,
        information=by_line[used].sum(axis=0),
        seed_information=best,
        spot_variance_mm2=spots.variance_mm2,
        area_mm2=clutter_area_mm2(spots.mm, hypothesis.spot_of_line[used], spots.slice_area_mm2),
        share=share_of(len(used), len(frame)),
    )
    return replace(hypothesis, log10_false_alarms=value)
