"""How the frame and the scale may be off: errors of a rod and of all spots together, not of one spot.

A spot's centre has noise of its own. Besides, each rod is not quite where the frame file has it, the pixel spacing is
not quite what it is said to be, and the spot of a rod that ends within the slice is pulled towards what is left of it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import Cuts, rod_covariances
from stereoreg_ros.geometry.slice import PixelScale

# Half the thickness, mm, of a slice of unknown thickness.
_HALF_UNKNOWN_MM: Final = 1.25
# Root mean square over a rod's length of its error, and over a frame's area of the distance from its middle, as shares
# of what they are at the rod's ends and at the frame's rim.
_OF_ROD, _OF_RADIUS = (2 / 3) ** 0.5, 0.5**0.5


class Tolerances(NamedTuple):
    """Standard deviations of what is taken for known.

    rod_mm: (n,), per axis of each rod's ends; stretches: (k, 2, 2), by how much the slice is stretched about any point
    by one standard deviation of each of k independent errors of the scale; half_slice_mm: half the slice's thickness;
    extent_mm: per axis, by which a rod's spot is typically off for all this, as a search has it that knows no pose yet.
    """

    rod_mm: Array
    stretches: Array
    half_slice_mm: float
    extent_mm: float

    @classmethod
    def of(
        cls,
        frame: Frame,
        rod_mm: Array,
        scale: PixelScale,
        scale_tolerance: float,
        scale_covariance: Array | None,
        thickness_mm: float,
    ) -> Tolerances:
        """scale_tolerance: standard deviation of sx and of sy, as a fraction; scale_covariance: (3, 3) of (sx, sy,
        shear), mm^2/pixel^2, in addition where the scale was measured; thickness_mm: of the slice, 0 where not known.
        """
        covariance = np.diag([(scale_tolerance * scale.sx) ** 2, (scale_tolerance * scale.sy) ** 2, 0.0])
        if scale_covariance is not None:
            covariance = covariance + scale_covariance
        values, vectors = np.linalg.eigh(covariance)
        modes = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 1e-12 * scale.sx * scale.sy]
        matrices = np.zeros((modes.shape[1], 2, 2))
        matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 0, 1] = modes
        stretches = matrices @ scale.inverse_matrix
        radius = float(np.linalg.norm(np.ptp(np.concatenate([frame.starts, frame.ends]), axis=0))) / 2
        half_mm = thickness_mm / 2 if thickness_mm > 0 else _HALF_UNKNOWN_MM
        off_mm = _OF_RADIUS * _largest(stretches) * radius
        extent_mm = float(np.hypot(_OF_ROD * rod_mm.max(initial=0.0), off_mm))
        return cls(rod_mm, stretches, half_mm, extent_mm)

    @classmethod
    def none(cls, frame: Frame) -> Tolerances:
        """Everything is as the frame file and the scale have it, in a slice without thickness."""
        return cls(np.zeros(len(frame)), np.zeros((0, 2, 2)), 0.0, 0.0)

    def with_scale_known_to(self, share: float) -> Tolerances:
        """The same, with the spacing along x and that along y known to this share of it (standard deviation)."""
        return self._replace(stretches=share * np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]]))

    @property
    def scale_std(self) -> float:
        """Standard deviation of the scale, as a share of it, in the direction in which it is largest."""
        return _largest(self.stretches)

    def rod_covariances(self, frame: Frame, cuts: Cuts) -> Array:
        """Covariances (..., n, 2, 2) mm^2 of where the rods are cut; zero where a rod runs within the slice."""
        if not self.rod_mm.any():
            return np.zeros((*cuts.lambdas.shape, 2, 2))
        return np.nan_to_num(rod_covariances(frame, self.rod_mm, cuts))

    def common(self, frame: Frame, cuts: Cuts, spots_mm: Array, used: NDArray[np.bool_]) -> Array:
        """Errors that spots share (..., n, 2, k + 1) mm: how far one standard deviation of each moves each rod's spot.

        spots_mm: (..., n, 2), anything where used (..., n) is false. The scale's errors are about the middle of the
        spots used; the last error is that of rods which end within the slice: all by the same thickness.
        """
        count = np.maximum(used.sum(axis=-1), 1)[..., None]
        centre = np.where(used[..., None], spots_mm, 0.0).sum(axis=-2) / count
        off = np.where(used[..., None], spots_mm - centre[..., None, :], 0.0)
        moved = np.einsum("kij,...nj->...nik", self.stretches, off)
        return np.concatenate([moved, self.end_shifts(frame, cuts)[..., None]], axis=-1)

    def end_shifts(self, frame: Frame, cuts: Cuts) -> Array:
        """By how much (..., n, 2) mm the spot of a rod that ends within the slice is off the rod's axis at most."""
        cosine = cuts.directions[..., 2]
        shift = np.zeros(cosine.shape)
        with np.errstate(invalid="ignore", divide="ignore"):
            slope = cuts.directions[..., :2] / cosine[..., None]
            for end, sign in ((frame.lambda_max, 1.0), (frame.lambda_min, -1.0)):
                # Height of the rod's end over the slice's middle, away from the rod: where it is less than half the
                # thickness, what is left of the rod has its middle below the slice's.
                height = sign * (end - cuts.lambdas) * np.abs(cosine)
                missing = np.clip((self.half_slice_mm - height) / 2, 0.0, self.half_slice_mm)
                shift -= sign * np.copysign(missing, cosine)
            shifts = shift[..., None] * slope
        return np.nan_to_num(shifts, posinf=0.0, neginf=0.0)


def _largest(stretches: Array) -> float:
    """By how much the largest of stretches (k, 2, 2) stretches."""
    return float(np.linalg.norm(stretches, ord=2, axis=(1, 2)).max(initial=0.0))
