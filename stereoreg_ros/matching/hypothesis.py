"""What a matcher returns: a pose with the spots it gives to rods."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

UNMATCHED = -1


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation of the spots.

    rotation (3, 3), translation (3,) mm: slice_from_frame, refined by maximum likelihood; spot_of_line (n,): for each
    rod the row of its spot, or UNMATCHED; chi_square: squared residuals over the noise; information (6, 6): inverse
    covariance of the pose (see `solvers.maximum_likelihood.Refined`); missing: number of rods that the slice must cut
    among the spots, and that have none; near_misses: by how much (log-likelihood) those of them that have an unmatched
    spot close by speak against the explanation; pieces: by how much (log-likelihood) the unmatched spots look like
    pieces of the matched ones; is_widened: whether the information is less than these matches give, as others explain
    the slice too; log10_false_alarms: see `matching.significance`.
    """

    rotation: Array
    translation: Array
    spot_of_line: NDArray[np.intp]
    chi_square: float
    information: Array
    missing: int
    near_misses: float = 0.0
    pieces: float = 0.0
    is_widened: bool = False
    log10_false_alarms: float = math.nan

    @property
    def inliers(self) -> int:
        """Number of rods with a spot."""
        return int((self.spot_of_line != UNMATCHED).sum())


@dataclass(frozen=True)
class Found:
    """What a search came to.

    hypotheses: the explanations that the best one does not rule out, best first; empty where nothing was found.
    least_rods: explanations of fewer rods were not sought. given_up: why the search was ended early, else empty.
    is_near: whether only poses near the guess were sought.
    """

    hypotheses: list[Hypothesis]
    least_rods: int
    given_up: str = ""
    is_near: bool = False
