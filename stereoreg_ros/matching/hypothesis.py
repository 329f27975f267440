"""What a matcher returns: a pose with the spots it gives to rods."""

from __future__ import annotations

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
    covariance of the pose (see `solvers.maximum_likelihood.Refined`); log10_false_alarms: see `matching.significance`.
    """

    rotation: Array
    translation: Array
    spot_of_line: NDArray[np.intp]
    chi_square: float
    information: Array
    log10_false_alarms: float

    @property
    def inliers(self) -> int:
        """Number of rods with a spot."""
        return int((self.spot_of_line != UNMATCHED).sum())
