"""Matching near a known pose: where slices stream in, the frame is mostly where it was in the slice before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching import three_line
from stereoreg_ros.matching.consensus import Spots
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found
from stereoreg_ros.matching.prior import Near, Prior
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
        within_reach = (offset**2).sum(axis=-1) <= _REACH_MM**2
    reach = Near(guess_slice_from_frame.translation, _REACH_MM, within_reach)
    near = Prior(guess_slice_from_frame.rotation, _MAX_ROTATION, reach)
    found = three_line.match(spots, frame, near, options)
    if found.given_up or len(found.hypotheses) != 1:
        return None
    best = found.hypotheses[0]
    allowed = prior.angles(best.rotation) <= prior.max_rotation
    if not allowed or best.log10_false_alarms > options.max_log10_false_alarms:
        return None
    rows = np.sort(best.spot_of_line[best.spot_of_line != UNMATCHED])
    own = np.where(best.spot_of_line != UNMATCHED, np.searchsorted(rows, best.spot_of_line), UNMATCHED)
    twins = three_line.match(spots.only(rows), frame, prior, options, known=[replace(best, spot_of_line=own)])
    return None if twins.given_up or len(twins.hypotheses) != 1 else found
