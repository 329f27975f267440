"""The spots of a slice as the matcher sees them: where, how well known, how long."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.matching.significance import area_of_uniform_mm2
from stereoreg_ros.matching.tolerances import Tolerances

# A spot may be longer or shorter than its rod has it, by a share and a slack, mm, as the slice's profile is not a box
# and the point spread is not known; from a length on, mm, it must lie along the rod (cosine).
_LENGTH_SHARE, _LENGTH_SLACK_MM = 0.5, 1.5
_LONG_MM, _LEAST_ALIGNED = 3.0, 0.8
# Of a solid rod cut at an angle, the spot is an ellipse: its squared length, as `Streaks` has it, is that share of
# (diameter * slope) squared. A tube that is bright in its wall only is longer by the square root of two.
_OF_DIAMETER, _HOLLOW = 0.75, 2.0
# So far beyond the outermost spots, along each axis, a slice goes on at least.
_BESIDE_MM = 3.0
# Length, as a share of the diameter, of a thick rod's spot that is not round, its axes a fifth apart.
_UNEVEN = 0.55


class Streaks(NamedTuple):
    """How long the spots are, and how long they have to be.

    along_mm: (s, 2), from one end of each to the other; cut_short: (s,), whether it may be longer than was seen;
    thickness_mm: of the slice, through which a leaning rod is seen from one side to the other.
    """

    along_mm: Array
    cut_short: NDArray[np.bool_]
    thickness_mm: float

    @classmethod
    def of(cls, spots: SliceSpots, thickness_mm: float) -> Streaks | None:
        """Those of the spots of a slice so thick; None where thickness or extents are not known.

        A uniform streak has a twelfth of its squared length as second moment.
        """
        if thickness_mm <= 0 or np.isnan(spots.extents_px2).any():
            return None
        values, vectors = np.linalg.eigh(spots.scale.matrix @ spots.extents_px2 @ spots.scale.matrix.T)
        length_mm = np.sqrt(12 * np.maximum(values[:, 1] - values[:, 0], 0.0))
        return cls(length_mm[:, None] * vectors[:, :, 1], spots.cut_short, thickness_mm)

    def allow(self, frame: Frame, cuts: Cuts) -> NDArray[np.bool_]:
        """Whether each spot (..., n, s) may be that of each rod, by its length and, of long ones, its direction.

        A thick rod's spot is longer than the slice's thickness makes it, and one of a rod that ends within the slice
        may be shorter.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            slope = cuts.directions[..., :2] / cuts.directions[..., 2:]
            steepness = np.linalg.norm(slope, axis=-1)
            half = self.thickness_mm / 2 / np.abs(cuts.directions[..., 2])
            whole = (cuts.lambdas >= frame.lambda_min + half) & (cuts.lambdas <= frame.lambda_max - half)
            least = np.where(whole, self.thickness_mm * steepness, 0.0)[..., None]
            most = steepness * np.hypot(self.thickness_mm, math.sqrt(_HOLLOW * _OF_DIAMETER) * frame.diameters)
            length = np.linalg.norm(self.along_mm, axis=-1)
            slack_mm = np.hypot(_LENGTH_SLACK_MM, _UNEVEN * frame.diameters)[:, None]
            allowed = length <= (1 + _LENGTH_SHARE) * most[..., None] + slack_mm
            allowed &= self.cut_short | (length >= (1 - _LENGTH_SHARE) * least - _LENGTH_SLACK_MM)
            aligned = np.abs(slope @ self.along_mm.T) >= _LEAST_ALIGNED * steepness[..., None] * length
        return np.asarray(allowed & (aligned | (np.minimum(most[..., None], length) < _LONG_MM)))

    def only(self, rows: NDArray[np.intp]) -> Streaks:
        """Those of some of the spots."""
        return self._replace(along_mm=self.along_mm[rows], cut_short=self.cut_short[rows])


def whitening_of(covariances: Array) -> Array:
    """Inverse Cholesky factors (..., 2, 2) of covariances: what turns a residual into one of unit variance."""
    whitening: Array = np.zeros(covariances.shape)
    xx, xy, yy = covariances[..., 0, 0], covariances[..., 0, 1], covariances[..., 1, 1]
    first = 1.0 / np.sqrt(xx)
    second = 1.0 / np.sqrt(yy - xy * xy / xx)
    whitening[..., 0, 0], whitening[..., 1, 1] = first, second
    whitening[..., 1, 0] = -xy / xx * second
    return whitening


class Spots(NamedTuple):
    """Spots as the matcher sees them.

    mm: (s, 2) in the slice; covariances_mm2: (s, 2, 2), of the centres; slice_area_mm2: over which spots could lie,
    None where not known. tolerances: how the frame and the scale may be off. variances_mm2: (s,), product of the
    standard deviations along the two axes of each centre, a rod's error included where that is least; sigma_mm: the
    largest per axis of any, with all that can be off before a pose is known. streaks: None where the slice's thickness
    or the spots' lengths are not known.
    """

    mm: Array
    covariances_mm2: Array
    slice_area_mm2: float | None
    tolerances: Tolerances
    variances_mm2: Array
    sigma_mm: float
    streaks: Streaks | None

    @classmethod
    def of(
        cls,
        mm: Array,
        covariances_mm2: Array,
        slice_area_mm2: float | None,
        tolerances: Tolerances,
        streaks: Streaks | None = None,
    ) -> Spots:
        """Spots (s, 2) mm with the covariances (s, 2, 2) mm^2 of their centres."""
        # In the middle of a rod its variance is half of that of its ends, and nowhere less.
        rod_mm2 = 0.5 * float((tolerances.rod_mm**2).mean())
        variances = np.sqrt(np.linalg.det(covariances_mm2 + rod_mm2 * np.eye(2)))
        largest = float(np.linalg.eigvalsh(covariances_mm2).max()) if len(mm) else 0.0
        sigma_mm = math.hypot(math.sqrt(largest), tolerances.extent_mm)
        return cls(mm, covariances_mm2, slice_area_mm2, tolerances, variances, sigma_mm, streaks)

    def gains(self, frame: Frame) -> Array:
        """Log-likelihood ratios (s,) of each spot right where a rod is predicted, to its being one of the clutter.

        The clutter is taken to be as dense as if every rod had a spot.
        """
        return np.asarray(-np.log(self.clutter_density(frame) * 2 * math.pi * self.variances_mm2))

    def clutter_density(self, frame: Frame) -> float:
        """False spots per mm^2, if every rod has a spot; at least one false spot is reckoned with."""
        clutter = max(len(self.mm) - len(frame), 0) + 1
        return clutter / area_of_uniform_mm2(self.mm, self.slice_area_mm2)

    def match_covariances(self, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp]) -> Array:
        """Covariances (..., n, 2, 2) mm^2 of each rod's residual: of its spot's centre and of where the rod is cut.

        spot_of_line: (..., n), rows of the spots; anything may stand where a rod has none.
        """
        covariances: Array = self.covariances_mm2[spot_of_line] + self.tolerances.rod_covariances(frame, cuts)
        return covariances

    def whitening(self, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp]) -> Array:
        """What turns each rod's residual in mm into one of unit variance, (..., n, 2, 2) 1/mm."""
        return whitening_of(self.match_covariances(frame, cuts, spot_of_line))

    def common(self, frame: Frame, cuts: Cuts, spot_of_line: NDArray[np.intp], used: NDArray[np.bool_]) -> Array | None:
        """Errors that spots share, as `solvers.maximum_likelihood.refine` takes them; None where all are zero."""
        shared = self.tolerances.common(frame, cuts, self.mm[spot_of_line], used)
        return shared if shared.any() else None

    def only(self, rows: NDArray[np.intp]) -> Spots:
        """Some of the spots."""
        streaks = None if self.streaks is None else self.streaks.only(rows)
        return Spots.of(self.mm[rows], self.covariances_mm2[rows], self.slice_area_mm2, self.tolerances, streaks)

    def surround(self, points_mm: Array) -> NDArray[np.bool_]:
        """Which points (..., 2) mm lie in the box around the spots or just beyond: there a rod would have been seen."""
        inside = (points_mm >= self.mm.min(axis=0) - _BESIDE_MM) & (points_mm <= self.mm.max(axis=0) + _BESIDE_MM)
        return np.asarray(inside.all(axis=-1))
