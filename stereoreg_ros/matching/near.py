"""Matching near a known pose: where slices stream in, the frame is mostly where it was in the slice before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching import by_levels
from stereoreg_ros.matching.consensus import decades_apart, judged
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found, Hypothesis
from stereoreg_ros.matching.prior import Near, Prior
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.matching.settling import settle
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.options import RegistrationOptions

# How far a spot may lie from where the known pose has its rod cut the slice, and the frame may have turned. What moved
# farther is found by the search without a guess.
_REACH_MM = 10.0
_MAX_ROTATION = float(np.radians(5.0))


def match_near(
    spots: Spots, frame: Frame, prior: Prior, options: RegistrationOptions, guess_slice_from_frame: Pose
) -> Found | None:
    """The one explanation near a guess, or None where a search without the guess has to decide.

    It is only returned where it may be accepted, and where its spots have no other explanation within the prior, near
    the guess or not. What is far from the guess and made of other spots is not sought: it is not the frame that was
    seen before.
    """
    cuts = cut(frame, guess_slice_from_frame.rotation, guess_slice_from_frame.translation)
    offset = spots.mm[None] - cuts.points_mm[:, None]
    with np.errstate(invalid="ignore"):
        offset[~np.isfinite(offset)] = np.inf  # of a rod that runs within the slice
        within_reach = (offset**2).sum(axis=-1) <= _REACH_MM**2
    reach = Near(guess_slice_from_frame.translation, _REACH_MM, within_reach)
    near = Prior(guess_slice_from_frame.rotation, _MAX_ROTATION, reach)
    # Most often each rod's spot is the nearest one; where that leads to no explanation of all rods, seeds are sought.
    nearest = np.where(within_reach.any(axis=1), (offset**2).sum(axis=-1).argmin(axis=1), UNMATCHED)
    taken = nearest[nearest != UNMATCHED]
    found: list[Hypothesis] = []
    if len(taken) >= options.min_inliers and len(np.unique(taken)) == len(taken):
        start = Starts(near.rotation[None], reach.translation[None], nearest[None], np.zeros(1, dtype=np.intp))
        found = [one for one in settle(spots, frame, start, options.min_inliers) if one.missing == 0]
        found = judged(found, spots, frame, near, decades_apart(options))
    if not found:
        found = by_levels.match_most(spots, frame, near, options)
    if len(found) != 1:
        return None
    best = found[0]
    is_near = near.angles(best.rotation) <= near.max_rotation
    allowed = prior.angles(best.rotation) <= prior.max_rotation
    if not (is_near and allowed) or best.log10_false_alarms > options.max_log10_false_alarms:
        return None
    matched = best.spot_of_line != UNMATCHED
    rows = np.sort(best.spot_of_line[matched])
    own = replace(best, spot_of_line=np.where(matched, np.searchsorted(rows, best.spot_of_line), UNMATCHED))
    twins = by_levels.match(spots.only(rows), frame, prior, options, known=[own])
    if twins.given_up or len(twins.hypotheses) != 1:
        return None
    (looked_at,) = twins.hypotheses
    if (looked_at.spot_of_line != own.spot_of_line).any():
        return None
    # Other matches of the same pose have widened it.
    widened = replace(best, information=looked_at.information, is_widened=looked_at.is_widened)
    return Found([widened], best.inliers)
