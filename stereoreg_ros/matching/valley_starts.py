"""Where a second pose with the same spots may be that the seeds missed: along the directions that are hardly known.

Of few rods, the likelihood has several lowest points in one valley. Three spots with noise may have no pose at all near
one of them, and the seeds of a triple of rods then miss it.
"""

from __future__ import annotations

import numpy as np

from stereoreg_ros.geometry.pose import rotation_exp
from stereoreg_ros.matching.hypothesis import Hypothesis
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.solvers.likelihood_valley import ARM_MM, UNITS

# Directions, and the distances from the pose at which to start: to both sides, as far as it can turn and be met.
_DIRECTIONS, _DISTANCES_MM = 2, np.arange(8.0, 49.0, 8.0)
# Of a pose that is known better in every direction, no second one is in the same valley.
_WEAK_MM = 0.5


def starts_along_valley(hypothesis: Hypothesis) -> Starts:
    """Starts away from a pose along its weakest directions, with its spots; none where it has no weak one."""
    values, vectors = np.linalg.eigh(hypothesis.information / np.outer(UNITS, UNITS))
    weak = np.flatnonzero(values[:_DIRECTIONS] < 1 / _WEAK_MM**2)
    distances = np.concatenate([_DISTANCES_MM, -_DISTANCES_MM])
    steps = (distances[:, None] * vectors.T[weak, None]).reshape(-1, 6)
    return Starts(
        rotation_exp(steps[:, 3:] / ARM_MM) @ hypothesis.rotation,
        hypothesis.translation + steps[:, :3],
        np.tile(hypothesis.spot_of_line, (len(steps), 1)),
        np.arange(len(steps)),
    )
