"""Whether one rod more has its spot if the spacing of the pixels, or the size of the frame, is another.

A spacing that is a few per cent off may move the pose by centimetres and still leave most rods on their spots: what is
left over is a rod without a spot and a spot without a rod, which may be far from each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts, cut
from stereoreg_ros.geometry.visibility import may_show
from stereoreg_ros.matching.consensus import IMPLAUSIBLE, MISSING_COST, SHARED_SPOT_MM, count_missing
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.settling import refine_matches
from stereoreg_ros.matching.spots import Spots

# Standard deviation of a mistaken spacing along each axis, as a share of it, and the largest that is believed.
_MISTAKEN, _MOST_MISTAKEN = 0.05, 0.15
# A rod's error counts by how the rod leans at the pose, which a start may be far from: as often it is taken anew.
_ROUNDS = 3
# So many starts are refined at once.
_CHUNK = 1000


class OtherScale(NamedTuple):
    """What another scale explains.

    inliers: number of rods with a spot; too_large: (2,), by what share of it the spacing along x and along y is too
    large; evidence: by how much (log-likelihood) it explains the spots better.
    """

    inliers: int
    too_large: Array
    evidence: float


def with_other_scale(best: Hypothesis, spots: Spots, frame: Frame, prior: Prior) -> OtherScale | None:
    """The best explanation of one rod more than `best` has, within the prior, with the scale free; None if none fits.

    Every rod without a spot is tried with every spot without a rod. The likelihoods are integrated over poses and
    scales, so that a scale which is free is paid for.
    """
    completions = _with_one_more(best, spots, frame)
    if not len(completions):
        return None
    free = spots._replace(tolerances=spots.tolerances.with_scale_known_to(_MISTAKEN))
    found = None
    for first in range(0, len(completions), _CHUNK):
        one = _best_of(completions[first : first + _CHUNK], best, free, frame, prior)
        if one is not None and (found is None or one.evidence > found.evidence):
            found = one
    if found is None:
        return None
    cuts = cut(frame, best.rotation[None], best.translation[None])
    information, chi_square = best.information[None], np.array([best.chi_square])
    known = float(_evidence(spots, frame, cuts, best.spot_of_line[None], chi_square, information)[0])
    return found._replace(evidence=found.evidence - known)


def _with_one_more(best: Hypothesis, spots: Spots, frame: Frame) -> NDArray[np.intp]:
    """Matches (m, n) of one rod more.

    A rod without a spot that is cut beside the spot of another one may also have that one, and the other rod the spot
    that was left over.
    """
    cuts = cut(frame, best.rotation, best.translation)
    matched = np.flatnonzero(best.spot_of_line != UNMATCHED)
    left_over = np.setdiff1d(np.arange(len(spots.mm)), best.spot_of_line)
    completions = []
    for rod in np.flatnonzero(best.spot_of_line == UNMATCHED):
        apart = np.linalg.norm(spots.mm[best.spot_of_line[matched]] - cuts.points_mm[rod], axis=1)
        for other in (rod, *matched[apart <= SHARED_SPOT_MM]):
            taken = best.spot_of_line.copy()
            taken[rod] = taken[other]
            several = np.tile(taken, (len(left_over), 1))
            several[:, other] = left_over
            completions.append(several)
    return np.concatenate(completions) if completions else np.empty((0, len(frame)), np.intp)


def _best_of(
    spot_of_line: NDArray[np.intp], best: Hypothesis, free: Spots, frame: Frame, prior: Prior
) -> OtherScale | None:
    """The likeliest of matches (m, n), refined from the best pose with the scale free."""
    used = spot_of_line != UNMATCHED
    rotations = np.tile(best.rotation, (len(used), 1, 1))
    translations = np.tile(best.translation, (len(used), 1))
    for _ in range(_ROUNDS):
        refined = refine_matches(free, frame, (rotations, translations), spot_of_line)
        rotations, translations = refined.rotations, refined.translations
    fits = (may_show(frame, refined.cuts) | ~used).all(axis=1) & (
        refined.chi_square <= chdtri(2 * used.sum(axis=1) - 6, IMPLAUSIBLE)
    )
    fits &= prior.angles(rotations) <= prior.max_rotation
    rows = np.flatnonzero(fits & refined.converged)
    if not rows.size:
        return None
    refined, spot_of_line = refined.take(rows), spot_of_line[rows]
    too_large = _scale_errors(free, frame, refined.cuts, spot_of_line)
    evidence = _evidence(free, frame, refined.cuts, spot_of_line, refined.chi_square, refined.information)
    evidence[np.abs(too_large).max(axis=1) > _MOST_MISTAKEN] = -math.inf
    row = int(evidence.argmax())
    return OtherScale(int((spot_of_line[row] != UNMATCHED).sum()), too_large[row], float(evidence[row]))


def _evidence(
    spots: Spots, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp], chi_square: Array, information: Array
) -> Array:
    """Log-likelihoods (m,) of explanations over all spots being clutter, integrated over poses and shared errors."""
    used = spot_of_line != UNMATCHED
    covariances = spots.match_covariances(frame, cuts, spot_of_line)
    shared = _shared(spots, frame, cuts, spot_of_line)
    of_a_spot = -math.log(2 * math.pi * spots.clutter_density(frame)) - 0.5 * np.linalg.slogdet(covariances)[1]
    of_spots = np.where(used, of_a_spot, 0.0).sum(axis=1) - chi_square / 2
    of_missing = MISSING_COST * count_missing(spots, frame, cuts, spot_of_line)
    inner = np.eye(shared.shape[-1]) + np.swapaxes(shared, 1, 2) @ shared
    paid = 0.5 * (np.linalg.slogdet(information)[1] + np.linalg.slogdet(inner)[1])
    return np.asarray(of_spots - of_missing - paid)


def _scale_errors(spots: Spots, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp]) -> Array:
    """The likeliest errors (m, 2) of the scale along x and y, as shares of it, at the likeliest poses."""
    used = (spot_of_line != UNMATCHED)[..., None, None]
    residual = spots.whitening(frame, cuts, spot_of_line) @ np.where(
        used, (spots.mm[spot_of_line] - cuts.points_mm)[..., None], 0.0
    )
    shared = _shared(spots, frame, cuts, spot_of_line)
    turned = np.swapaxes(shared, 1, 2)
    errors = np.linalg.solve(np.eye(shared.shape[-1]) + turned @ shared, turned @ residual.reshape(len(used), -1, 1))
    stretches = np.einsum("kii->ki", spots.tolerances.stretches)
    return np.asarray(errors[:, : len(stretches), 0] @ stretches)


def _shared(spots: Spots, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp]) -> Array:
    """Errors that spots share (m, 2n, c) in standard deviations of each spot, see `Tolerances.common`."""
    used = spot_of_line != UNMATCHED
    moved = spots.tolerances.common(frame, cuts, spots.mm[spot_of_line], used)
    whitened = spots.whitening(frame, cuts, spot_of_line) @ moved
    return np.asarray(np.where(used[..., None, None], whitened, 0.0).reshape(len(used), -1, moved.shape[-1]))
