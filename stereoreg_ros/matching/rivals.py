"""What else a slice may show that speaks against its best explanation; sought only when it is asked for."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from stereoreg_ros.matching.by_levels import ByLevels
from stereoreg_ros.matching.consensus import score
from stereoreg_ros.matching.hypothesis import Found, Hypothesis
from stereoreg_ros.matching.other_scale import OtherScale, with_other_scale
from stereoreg_ros.matching.problem import Problem

# An explanation that chance brings more often (log10) speaks against no other.
_LOG10_RIVAL: Final = -3.0
# A second frame of the same kind is looked for that shows as many rods as the first one, or one less.
_FEWER_RODS = 1


class Rivals:
    """Rivals of the best of what was found for a problem, whichever matcher found it."""

    def __init__(self, problem: Problem, found: Found, matcher: ByLevels) -> None:
        self._problem, self._found, self._matcher = problem, found, matcher

    @property
    def _best(self) -> Hypothesis:
        return self._found.hypotheses[0]

    def other_scale(self) -> OtherScale | None:
        """One rod more with another pixel spacing; None where no spot is left for any."""
        problem = self._problem
        return with_other_scale(self._best, problem.spots, problem.frame, problem.prior)

    def beyond_prior(self) -> Hypothesis | None:
        """A clearly better explanation with the frame standing as it may not.

        Raises SearchGivenUpError where it would take too long to say.
        """
        problem = self._problem
        if problem.prior.max_rotation >= math.pi:
            return None
        anywhere = replace(problem, prior=replace(problem.prior, max_rotation=math.pi))
        least = score(self._best, problem.gains) + problem.decades_apart * math.log(10)
        return self._matcher.find_better(anywhere, _LOG10_RIVAL, least)

    def second_frame(self) -> Hypothesis | None:
        """The frame once more among the spots that are left; not sought where the frame is where it was before.

        Raises SearchGivenUpError where it would take too long to say.
        """
        problem = self._problem
        rest = np.setdiff1d(np.arange(len(problem.spots.mm)), self._best.spot_of_line)
        if self._found.is_near or len(rest) < problem.min_inliers:
            return None
        fewest = self._best.inliers - _FEWER_RODS
        return self._matcher.find_better(problem.only(rest), _LOG10_RIVAL, fewest=fewest)
