"""The spots of a slice as the matcher sees them: where, how well known, how long."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts
from stereoreg_ros.matching.significance import area_of_uniform_mm2

# A spot may be longer or shorter than its rod has it, by a share and a slack, mm, as the slice's profile is not a box
# and the point spread is not known; from a length on, mm, it must lie along the rod (cosine).
_LENGTH_SHARE, _LENGTH_SLACK_MM = 0.5, 1.5
_LONG_MM, _LEAST_ALIGNED = 3.0, 0.8


class Streaks(NamedTuple):
    """How long the spots are, and how long they have to be.

    along_mm: (s, 2), from one end of each to the other; cut_short: (s,), whether it may be longer than was seen;
    thickness_mm: of the slice, through which a leaning rod is seen from one side to the other.
    """

    along_mm: Array
    cut_short: NDArray[np.bool_]
    thickness_mm: float

    def allow(self, cuts: Cuts) -> NDArray[np.bool_]:
        """Whether each spot (..., n, s) may be that of each rod, by its length and, of long ones, its direction."""
        with np.errstate(invalid="ignore", divide="ignore"):
            wanted = self.thickness_mm * cuts.directions[..., :2] / cuts.directions[..., 2:]
            wanted_length = np.linalg.norm(wanted, axis=-1)[..., None]
            length = np.linalg.norm(self.along_mm, axis=-1)
            allowed = length <= (1 + _LENGTH_SHARE) * wanted_length + _LENGTH_SLACK_MM
            allowed &= self.cut_short | (length >= (1 - _LENGTH_SHARE) * wanted_length - _LENGTH_SLACK_MM)
            aligned = np.abs(wanted @ self.along_mm.T) >= _LEAST_ALIGNED * wanted_length * length
        return np.asarray(allowed & (aligned | (np.minimum(wanted_length, length) < _LONG_MM)))

    def only(self, rows: NDArray[np.intp]) -> Streaks:
        """Those of some of the spots."""
        return self._replace(along_mm=self.along_mm[rows], cut_short=self.cut_short[rows])


class Spots(NamedTuple):
    """Spots as the matcher sees them.

    mm: (s, 2) in the slice; covariances_mm2: (s, 2, 2), of the centres; slice_area_mm2: over which spots could lie,
    None where not known. whitening: (s, 2, 2) 1/mm, turns a residual in mm into one of unit variance; variances_mm2:
    (s,), product of the standard deviations along the two axes of each; sigma_mm: the largest of all. streaks: None
    where the slice's thickness or the spots' lengths are not known.
    """

    mm: Array
    covariances_mm2: Array
    slice_area_mm2: float | None
    whitening: Array
    variances_mm2: Array
    sigma_mm: float
    streaks: Streaks | None

    @classmethod
    def of(
        cls, mm: Array, covariances_mm2: Array, slice_area_mm2: float | None, streaks: Streaks | None = None
    ) -> Spots:
        """Spots (s, 2) mm with the covariances (s, 2, 2) mm^2 of their centres."""
        whitening = np.linalg.inv(np.linalg.cholesky(covariances_mm2))
        variances = np.sqrt(np.linalg.det(covariances_mm2))
        largest = float(np.linalg.eigvalsh(covariances_mm2).max()) if len(mm) else 0.0
        return cls(mm, covariances_mm2, slice_area_mm2, whitening, variances, math.sqrt(largest), streaks)

    def gains(self, frame: Frame) -> Array:
        """Log-likelihood ratios (s,) of each spot right where a rod is predicted, to its being one of the clutter.

        The clutter is taken to be as dense as if every rod had a spot.
        """
        clutter = max(len(self.mm) - len(frame), 0) + 1
        area_mm2 = area_of_uniform_mm2(self.mm, self.slice_area_mm2)
        return np.asarray(np.log(area_mm2 / (clutter * 2 * math.pi * self.variances_mm2)))

    def only(self, rows: NDArray[np.intp]) -> Spots:
        """Some of the spots."""
        streaks = None if self.streaks is None else self.streaks.only(rows)
        return Spots.of(self.mm[rows], self.covariances_mm2[rows], self.slice_area_mm2, streaks)

    def surround(self, points_mm: Array) -> NDArray[np.bool_]:
        """Which points (..., 2) mm lie within the box around the spots: there a rod would have been seen."""
        inside = (points_mm >= self.mm.min(axis=0)) & (points_mm <= self.mm.max(axis=0))
        return np.asarray(inside.all(axis=-1))
