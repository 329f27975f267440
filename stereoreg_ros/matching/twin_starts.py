"""Where a second explanation by the same spots may be that the seeds missed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_exp
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.visibility import may_show
from stereoreg_ros.matching.consensus import SHARED_SPOT_MM
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.solvers.likelihood_valley import ARM_MM, UNITS

# Directions, and the distances from the pose at which to start: to both sides, as far as it can turn and be met.
_DIRECTIONS, _DISTANCES_MM = 2, np.arange(8.0, 49.0, 8.0)
# Of a pose that is known better in every direction, no second one is in the same valley.
_WEAK_MM = 0.5


def starts_along_valley(hypothesis: Hypothesis) -> Starts:
    """Starts away from a pose along its weakest directions, with its spots; none where it has no weak one.

    Of few rods, the likelihood has several lowest points in one valley. Three spots with noise may have no pose at all
    near one of them, and the seeds of a triple of rods then miss it.
    """
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


def starts_without_one(hypothesis: Hypothesis) -> Starts:
    """Starts at a pose with each of its rods left out in turn.

    A false spot may draw the pose to itself; from every seed, and with all its rods, the search then ends there.
    """
    lines = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    spot_of_line = np.tile(hypothesis.spot_of_line, (len(lines), 1))
    spot_of_line[np.arange(len(lines)), lines] = UNMATCHED
    return _at(hypothesis, spot_of_line)


def starts_with_spots_exchanged(hypothesis: Hypothesis, spots: Spots, frame: Frame) -> Starts:
    """Starts at a pose with the spot of a rod given to another one, which has none and is cut beside it.

    Where two rods meet and one of them does not show, nothing but the other matches says which one does.
    """
    cuts = cut(frame, hypothesis.rotation, hypothesis.translation)
    without = np.flatnonzero((hypothesis.spot_of_line == UNMATCHED) & may_show(frame, cuts))
    having = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    apart = np.linalg.norm(cuts.points_mm[without, None] - spots.mm[hypothesis.spot_of_line[having]], axis=2)
    rows = np.argwhere(apart <= SHARED_SPOT_MM)
    spot_of_line = np.tile(hypothesis.spot_of_line, (len(rows), 1))
    for matches, (row, column) in zip(spot_of_line, rows, strict=True):
        matches[without[row]], matches[having[column]] = matches[having[column]], UNMATCHED
    return _at(hypothesis, spot_of_line)


def _at(hypothesis: Hypothesis, spot_of_line: NDArray[np.intp]) -> Starts:
    """Starts at its pose with the given matches (m, n)."""
    count = len(spot_of_line)
    rotations = np.tile(hypothesis.rotation, (count, 1, 1))
    return Starts(rotations, np.tile(hypothesis.translation, (count, 1)), spot_of_line, np.arange(count))
