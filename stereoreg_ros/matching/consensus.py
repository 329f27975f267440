"""What all matchers share: the spots as they see them, and how an explanation is scored and judged."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian
from stereoreg_ros.geometry.visibility import may_show, must_show
from stereoreg_ros.matching.clutter import likeness_to_pieces, matched_densities
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.pose_volume import low_stretch, plane_sample, pose_volume, stretch
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.significance import (
    Chance,
    area_of_uniform_mm2,
    log10_expected,
    lucky_chi_square,
    share_of,
)
from stereoreg_ros.matching.spots import Spots, whitening_of

# Squared distance in standard deviations, of two degrees of freedom, beyond which a spot is not the predicted one: once
# in ten thousand.
GATE: Final = float(chdtri(2, 1e-4))
# Probability below which a chi-square is not by the stated errors.
IMPLAUSIBLE = 0.01
# Height in chi-square of the ridge between two optima below which they are one valley; and its largest extent, rad.
_RIDGE = 4.0
_LARGEST_VALLEY = 0.5
# Squared distance, in standard deviations, below which two optima are one.
_SAME_OPTIMUM = 0.1
# An explanation of less than this share of the likelihood widens no other.
_LEAST_SHARE = 1e-3
# So far behind the best one (log-likelihood) an explanation is forgotten.
_FAR_BEHIND = 30.0
# By how much (log-likelihood) `evidence` may prefer an explanation of fewer rods more than `score` does: where the pose
# adapts to a spot in one direction, by ten times the spot's uncertainty.
EVIDENCE_SLACK = 2.5
# How far a rod's own spot lies from where a wrong pose has the rod: Student's distribution of two degrees of freedom in
# the plane, of this scale per axis, as most mistakes move it by a few millimetres and some by a centimetre.
_NEAR_MISS_MM = 2.0
# So near to a spot of another rod a rod without one may be taken for it.
SHARED_SPOT_MM = 5.0
# By how much, rad, a wrong pose turns the way that a leaning rod's spot takes; what leans less than this has none.
_WAY_TURNED, _UPRIGHT = 0.2, 1e-6
# What a rod that the slice must cut, and that has no spot, costs an explanation: one in twenty rods shows none.
MISSING_COST = 3.0


def count_missing(spots: Spots, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers (m,) of rods without a spot that the slice must cut, well within their ends and among the spots."""
    with np.errstate(invalid="ignore"):
        expected = must_show(frame, cuts) & spots.surround(cuts.points_mm)
    return np.asarray((expected & (spot_of_line == UNMATCHED)).sum(axis=-1))


def near_misses(hypothesis: Hypothesis, spots: Spots, frame: Frame) -> float:
    """By how much (log-likelihood) unmatched spots beside the places of rods without a spot speak against a pose.

    A rod may fail to show, and a false spot may lie anywhere; that it lies just beside the place of such a rod is much
    likelier where it is the rod's own, and the pose, the frame file or the pixel spacing is wrong by a few millimetres.
    Where a rod without a spot is cut beside the spot of another one, as where two of them meet, that spot may be its
    own, and the unmatched one that of the other rod.
    """
    others = np.setdiff1d(np.arange(len(spots.mm)), hypothesis.spot_of_line)
    cuts = cut(frame, hypothesis.rotation, hypothesis.translation)
    matched = hypothesis.spot_of_line != UNMATCHED
    possible = may_show(frame, cuts) & ~matched
    if not possible.any() or not len(others):
        return 0.0
    rods = np.flatnonzero(possible | matched)
    evidence = np.log(_near_miss_densities(spots.mm[others], frame, cuts, rods) / spots.clutter_density(frame))
    best = np.full(len(frame), -np.inf)
    best[rods] = evidence.max(axis=1)
    apart = np.linalg.norm(cuts.points_mm[possible, None] - spots.mm[hypothesis.spot_of_line], axis=2)
    shares = (apart <= SHARED_SPOT_MM) & matched
    best_of_possible = np.maximum(best[possible], np.where(shares, best, -np.inf).max(axis=1))
    # That the image reaches there, the spot shows; and two rods are seldom cut at one place.
    cost = MISSING_COST * (must_show(frame, cuts)[possible] | shares.any(axis=1))
    return float(np.maximum(best_of_possible + cost, 0.0).sum())


def _near_miss_densities(spots_mm: Array, frame: Frame, cuts: Cuts, rods: NDArray[np.intp]) -> Array:
    """Densities (k, s) per mm^2 with which a wrong pose has the spots of rods (k,) at (s, 2) mm.

    A few millimetres off, in any direction; or, where a tilt is wrong, anywhere along the way that a leaning rod's spot
    takes through the slice when the frame is moved.
    """
    off = spots_mm - cuts.points_mm[rods][:, None]
    squared = (off**2).sum(axis=2)
    anywhere = (1.0 + squared / (2 * _NEAR_MISS_MM**2)) ** -2 / (2 * math.pi * _NEAR_MISS_MM**2)
    directions = cuts.directions[rods, :2]
    run = np.linalg.norm(directions, axis=1)
    length_mm = run * (frame.lambda_max - frame.lambda_min)[rods]
    unit = directions / np.maximum(run, 1e-9)[:, None]
    along = np.einsum("ksi,ki->ks", off, unit)
    across = np.einsum("ksi,ki->ks", off, np.stack([-unit[:, 1], unit[:, 0]], axis=1))
    reach = run[:, None] * np.stack([frame.lambda_min - cuts.lambdas, frame.lambda_max - cuts.lambdas], axis=1)[rods]
    on_way = (along >= reach[:, :1]) & (along <= reach[:, 1:]) & (run > _UPRIGHT)[:, None]
    # Where the pose is wrong, so is the direction of that way.
    scale = np.hypot(math.sqrt(2.0) * _NEAR_MISS_MM, _WAY_TURNED * along)
    beside = (1.0 + (across / scale) ** 2) ** -1.5 / (2 * scale)
    on_its_way = np.where(on_way, beside / np.maximum(length_mm[:, None], scale), 0.0)
    return np.asarray(0.5 * (anywhere + on_its_way))


def score(hypothesis: Hypothesis, gains: Array) -> float:
    """Log-likelihood of an explanation over all spots being clutter: what explanations are ranked by.

    gains: see `Spots.gains`.
    """
    matched = hypothesis.spot_of_line[hypothesis.spot_of_line != UNMATCHED]
    return float(gains[matched].sum()) - hypothesis.chi_square / 2 - MISSING_COST * hypothesis.missing


def evidence(hypothesis: Hypothesis, gains: Array) -> float:
    """The same with the likelihood integrated over the pose: one spot more that the pose adapts to says less.

    Of explanations with the same rods it orders as `score` does, but for how well these fix the pose.
    """
    return score(hypothesis, gains) - 0.5 * float(np.linalg.slogdet(hypothesis.information)[1])


def distinct(found: list[Hypothesis], gains: Array) -> list[Hypothesis]:
    """The explanations best first, without those that say the same as a better one; gains: see `Spots.gains`.

    Two optima of one flat valley are one explanation, whose covariance holds both: near a double root the tilt's sign
    is not known, and the better optimum's own curvature does not say so. The same goes for two matches of one pose.
    """
    scores = {id(hypothesis): score(hypothesis, gains) for hypothesis in found}
    found = sorted(found, key=lambda h: -scores[id(h)])
    kept: list[Hypothesis] = []
    # What each of these stands for: itself and the other optima of its valley.
    optima: list[list[Hypothesis]] = []
    for hypothesis in found:
        if scores[id(found[0])] - scores[id(hypothesis)] > _FAR_BEHIND:
            break
        differences = _differences(hypothesis, kept)
        row = _row_of_same(differences, hypothesis, kept)
        if row is None:
            kept.append(hypothesis)
            optima.append([hypothesis])
        elif not _is_known(hypothesis, optima[row]):
            kept[row] = _widened(kept[row], hypothesis, differences[row], gains)
            optima[row].append(hypothesis)
    return kept


def _is_known(hypothesis: Hypothesis, optima: list[Hypothesis]) -> bool:
    """Whether one of these optima is the same, but for where a search ended: within a fraction of its uncertainty."""
    same = [one for one in optima if (one.spot_of_line == hypothesis.spot_of_line).all()]
    if not same:
        return False
    differences = _differences(hypothesis, same)
    squared = np.einsum("ki,kij,kj->k", differences, np.array([one.information for one in same]), differences)
    return bool((squared < _SAME_OPTIMUM).any())


def _differences(hypothesis: Hypothesis, others: list[Hypothesis]) -> Array:
    """Perturbations (k, 6) of `Pose.perturbed` that lead from each of the others to the hypothesis."""
    if not others:
        return np.empty((0, 6))
    turns = Rotation.from_matrix(hypothesis.rotation @ np.array([one.rotation.T for one in others])).as_rotvec()
    return np.hstack([hypothesis.translation - np.array([one.translation for one in others]), turns])


def _row_of_same(differences: Array, hypothesis: Hypothesis, others: list[Hypothesis]) -> int | None:
    """The first of others in whose valley a pose lies: between them chi-square hardly rises over its values at both.

    Two optima at distance d (Mahalanobis, by the curvature at either) of a double well are parted by a ridge of d^2/16.
    differences: (k, 6), see `_differences`.
    """
    for row in np.flatnonzero(np.linalg.norm(differences[:, 3:], axis=1) <= _LARGEST_VALLEY):
        informations = (hypothesis.information, others[row].information)
        if max(float(differences[row] @ one @ differences[row]) for one in informations) < 16 * _RIDGE:
            return int(row)
    return None


def _widened(hypothesis: Hypothesis, other: Hypothesis, difference: Array, gains: Array) -> Hypothesis:
    """The hypothesis with a covariance that holds another optimum of its valley, or that of as many other matches.

    Two rods meet and one of them does not show: either may have the spot, and only with the one is the tilt known.
    """
    of_others = other.inliers >= hypothesis.inliers and (other.spot_of_line != hypothesis.spot_of_line).any()
    weight = evidence if of_others else score
    share = 1.0 / (1.0 + math.exp(min(weight(hypothesis, gains) - weight(other, gains), 50.0)))
    if share < _LEAST_SHARE:
        return hypothesis
    covariance = np.linalg.pinv(hypothesis.information)
    added = share * np.outer(difference, difference)
    if of_others:
        added += share * (np.linalg.pinv(other.information) - covariance)
    elif float(difference @ hypothesis.information @ difference) * share < _LEAST_SHARE:
        return hypothesis
    information = np.linalg.pinv(np.asarray(covariance + added, dtype=np.float64))
    return replace(hypothesis, information=information, is_widened=True)


def judged(found: list[Hypothesis], spots: Spots, frame: Frame, prior: Prior, apart: float) -> list[Hypothesis]:
    """Of distinct explanations, best first, those that the best one does not rule out, with their false alarms.

    apart: see `Problem.decades_apart`.

    They must come near the best one in evidence; of fewer rods, also in how rare they are by chance: from a few spots
    of the frame's own, chance soon makes a match of one or two rods less. Of as many rods they are rivals however lucky
    the residuals of the best one are.
    """
    if not found:
        return []
    matched = found[0].spot_of_line[found[0].spot_of_line != UNMATCHED]
    best = replace(
        found[0],
        log10_false_alarms=log10_false_alarms(found[0], spots, frame, prior),
        near_misses=near_misses(found[0], spots, frame),
        pieces=likeness_to_pieces(spots.mm, matched, area_of_uniform_mm2(spots.mm, spots.slice_area_mm2)),
    )
    # A spot in line with false ones, or on a lattice of them, may well be one of them: it says less.
    gains = spots.gains(frame)
    gains[matched] -= np.log(_densities(best, spots) / _densities(best, spots, in_order=False))
    rivals = [
        replace(one, log10_false_alarms=log10_false_alarms(one, spots, frame, prior, in_order=False))
        for one in found[1:]
        if evidence(best, gains) - evidence(one, gains) < apart * math.log(10)
    ]
    most = best.log10_false_alarms + apart
    return [best, *(one for one in rivals if one.inliers >= best.inliers or one.log10_false_alarms <= most)]


def _densities(hypothesis: Hypothesis, spots: Spots, in_order: bool = True) -> Array:
    """Densities (k,) per mm^2 of false spots where the matched ones lie; see `clutter.matched_densities`."""
    matched = hypothesis.spot_of_line[hypothesis.spot_of_line != UNMATCHED]
    area_mm2 = area_of_uniform_mm2(spots.mm, spots.slice_area_mm2)
    return matched_densities(spots.mm, matched, area_mm2, in_order)


def log10_false_alarms(
    hypothesis: Hypothesis, spots: Spots, frame: Frame, prior: Prior, in_order: bool = True
) -> float:
    """log10 of how many explanations as good as this one chance brings, over its share of those that are allowed.

    in_order: whether to look for order in the clutter too, which takes longer.
    """
    lines = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    cuts = cut(frame, hypothesis.rotation, hypothesis.translation)
    covariances = spots.match_covariances(frame, cuts, hypothesis.spot_of_line)[lines]
    whitening = whitening_of(covariances)
    jacobian = (whitening @ cut_jacobian(cuts, hypothesis.translation)[lines]).reshape(-1, 6)
    # Errors that spots share enlarge the ball around the spots of a pose, and stretch the surface of the poses less.
    used = hypothesis.spot_of_line != UNMATCHED
    shared = spots.tolerances.common(frame, cuts, spots.mm[hypothesis.spot_of_line], used)[lines]
    moved = (whitening @ shared).reshape(len(jacobian), -1)
    inner = np.eye(moved.shape[1]) + moved.T @ moved
    crossed = moved.T @ jacobian
    information = jacobian.T @ jacobian - crossed.T @ np.linalg.solve(inner, crossed)
    enlarged = 0.5 * float(np.linalg.slogdet(inner)[1]) / math.log(10)
    variance_mm2 = _typical(np.sqrt(np.linalg.det(covariances)))
    ratio = float(stretch(information, variance_mm2))
    area_mm2 = area_of_uniform_mm2(spots.mm, spots.slice_area_mm2)
    # Clutter that is denser where the matched spots lie is as if all were spread over less.
    density = math.exp(float(np.log(_densities(hypothesis, spots, in_order)).mean()))
    dense_mm2 = len(spots.mm) / density
    volume = pose_volume(frame, len(lines), prior, min(area_mm2, dense_mm2))
    chance = Chance(len(spots.mm), dense_mm2, variance_mm2, ratio * volume)
    expected = log10_expected(len(lines), hypothesis.chi_square, chance) + enlarged
    return expected - math.log10(share_of(len(lines), len(frame)))


def least_log10_false_alarms(inliers: int, spots: Spots, frame: Frame, prior: Prior) -> float:
    """What `log10_false_alarms` of a true explanation of `inliers` rods is hardly ever below."""
    variance_mm2 = _in_steps(_typical(np.sort(spots.variances_mm2)[:inliers]))
    ratio = low_stretch(frame, inliers, variance_mm2)
    chance = _chance(inliers, ratio, variance_mm2, spots, frame, prior)
    return log10_expected(inliers, lucky_chi_square(inliers), chance) - math.log10(share_of(inliers, len(frame)))


def log10_by_chance(inliers: int, chi_square: float, spots: Spots, frame: Frame, prior: Prior) -> float:
    """log10 of how many explanations of `inliers` rods, with a chi-square this low, chance brings within the prior."""
    ratio = plane_sample(frame, inliers).mean_ratio
    variance_mm2 = _typical(np.sort(spots.variances_mm2)[-inliers:])
    return log10_expected(inliers, chi_square, _chance(inliers, ratio, variance_mm2, spots, frame, prior))


def _typical(variances_mm2: Array) -> float:
    """The one variance that spots could all have instead of these, for chance to bring as many explanations."""
    return math.exp(float(np.log(variances_mm2).mean()))


def _in_steps(variance_mm2: float) -> float:
    """A variance rounded down in steps of one in fifty, so that few are looked up."""
    return float(1.02 ** math.floor(math.log(variance_mm2) / math.log(1.02) + 1e-6))


def _chance(inliers: int, ratio: float, variance_mm2: float, spots: Spots, frame: Frame, prior: Prior) -> Chance:
    area_mm2 = area_of_uniform_mm2(spots.mm, spots.slice_area_mm2)
    volume = pose_volume(frame, inliers, prior, area_mm2)
    return Chance(len(spots.mm), area_mm2, variance_mm2, ratio * volume)
