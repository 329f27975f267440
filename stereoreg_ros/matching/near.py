"""Matching near a known pose: where slices stream in, the frame is mostly where it was in the slice before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.consensus import judged
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found, Hypothesis
from stereoreg_ros.matching.prior import Near, Prior
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.matching.settling import settle

# How far a spot may lie from where the known pose has its rod cut the slice, and the frame may have turned. What moved
# farther is found by the search without a guess.
_REACH_MM = 10.0
_MAX_ROTATION = float(np.radians(5.0))


class Anywhere(Protocol):
    """A matcher that searches all poses."""

    def match_most(self, problem: Problem) -> list[Hypothesis]: ...
    def match_anywhere(self, problem: Problem, known: Sequence[Hypothesis] = ()) -> Found: ...


def match_near(problem: Problem, matcher: Anywhere) -> Found | None:
    """The one explanation near a guess, or None where a search without the guess has to decide.

    It is only returned where it may be accepted, and where its spots have no other explanation within the prior, near
    the guess or not. What is far from the guess and made of other spots is not sought: it is not the frame that was
    seen before.
    """
    spots, frame, prior, guess = problem.spots, problem.frame, problem.prior, problem.guess
    assert guess is not None
    cuts = cut(frame, guess.rotation, guess.translation)
    offset = spots.mm[None] - cuts.points_mm[:, None]
    with np.errstate(invalid="ignore"):
        offset[~np.isfinite(offset)] = np.inf  # of a rod that runs within the slice
        within_reach = (offset**2).sum(axis=-1) <= _REACH_MM**2
    reach = Near(guess.translation, _REACH_MM, within_reach)
    near = Prior(guess.rotation, _MAX_ROTATION, reach)
    # Most often each rod's spot is the nearest one; where that leads to no explanation of all rods, seeds are sought.
    nearest = np.where(within_reach.any(axis=1), (offset**2).sum(axis=-1).argmin(axis=1), UNMATCHED)
    taken = nearest[nearest != UNMATCHED]
    found: list[Hypothesis] = []
    if len(taken) >= problem.min_inliers and len(np.unique(taken)) == len(taken):
        start = Starts(near.rotation[None], reach.translation[None], nearest[None], np.zeros(1, dtype=np.intp))
        found = [one for one in settle(spots, frame, start, problem.min_inliers) if one.missing == 0]
        found = judged(found, spots, frame, near, problem.decades_apart)
    if not found:
        found = matcher.match_most(replace(problem, prior=near))
    if len(found) != 1:
        return None
    best = found[0]
    is_near = near.angles(best.rotation) <= near.max_rotation
    allowed = prior.angles(best.rotation) <= prior.max_rotation
    if not (is_near and allowed) or best.log10_false_alarms > problem.max_log10_false_alarms:
        return None
    matched = best.spot_of_line != UNMATCHED
    rows = np.sort(best.spot_of_line[matched])
    own = replace(best, spot_of_line=np.where(matched, np.searchsorted(rows, best.spot_of_line), UNMATCHED))
    twins = matcher.match_anywhere(problem.only(rows), known=[own])
    if twins.given_up or len(twins.hypotheses) != 1:
        return None
    (looked_at,) = twins.hypotheses
    if (looked_at.spot_of_line != own.spot_of_line).any():
        return None
    # Other matches of the same pose have widened it.
    widened = replace(best, information=looked_at.information, is_widened=looked_at.is_widened)
    return Found([widened], best.inliers, is_near=True)
