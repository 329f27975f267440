"""One CT slice: its pixels in HU, its pixel scale, and where its plane lies."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array, Pose

# No scanner's values are larger, whatever they stand for; the squares of larger ones would not fit float32.
LARGEST_HU: Final = 1e9
# mm/pixel, smallest and largest that can be meant.
SPACING_RANGE_MM: Final = (0.001, 100.0)


@dataclass(frozen=True)
class PixelScale:
    """S = [[sx, shear], [0, sy]] in mm/pixel: the slice point of pixel Q = (u, v) is S Q (Maurin 2009, eq. 1).

    sx: between columns (along a row); sy: between rows; shear: g of eq. 1, normally 0.
    DICOM's PixelSpacing is the other way round: (sy, sx).
    Raises ValueError where a scale is not finite and positive, or the shear is not finite.
    """

    sx: float
    sy: float
    shear: float = 0.0

    def __post_init__(self) -> None:
        for name in ("sx", "sy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"pixel spacing {name} is {value}, expected a positive number of mm/pixel")
        if not np.isfinite(self.shear):
            raise ValueError(f"pixel shear is {self.shear}, expected a finite number of mm/pixel")

    @property
    def matrix(self) -> Array:
        """S, (2, 2) in mm/pixel."""
        return np.array([[self.sx, self.shear], [0.0, self.sy]])

    @property
    def inverse_matrix(self) -> Array:
        """S^-1, (2, 2) in pixel/mm."""
        return np.array([[1 / self.sx, -self.shear / (self.sx * self.sy)], [0.0, 1 / self.sy]])

    def to_mm(self, points_px: Array) -> Array:
        """Slice points (..., 2) in mm of pixels (..., 2)."""
        points: Array = points_px @ self.matrix.T
        return points

    def to_px(self, points_mm: Array) -> Array:
        """Pixels (..., 2) of slice points (..., 2) in mm."""
        points: Array = points_mm @ self.inverse_matrix.T
        return points


@dataclass(frozen=True, eq=False)
class Slice:
    """A CT slice.

    hu: (rows, columns) float32 in HU; pixel (u, v) is hu[v, u] and integer at the pixel's centre.
    scale: mm/pixel. scanner_from_slice: the slice's plane in the scanner; by default the scanner is the slice,
    as in the paper.
    Raises ValueError where the image is not two-dimensional, is empty, or holds anything that is not finite or beyond
    LARGEST_HU.
    """

    hu: NDArray[np.float32]
    scale: PixelScale
    scanner_from_slice: Pose = field(default_factory=Pose.identity)

    def __post_init__(self) -> None:
        hu = np.asarray(self.hu)
        if hu.ndim != 2:
            raise ValueError(f"image has shape {hu.shape}, expected (rows, columns)")
        if hu.size == 0:
            raise ValueError(f"image is empty: {hu.shape[0]} rows, {hu.shape[1]} columns")
        with np.errstate(over="ignore", invalid="ignore"):
            hu = np.ascontiguousarray(hu, dtype=np.float32)
            # Neither is finite as soon as one pixel is no number.
            least, most = float(hu.min()), float(hu.max())
        if not (math.isfinite(least) and math.isfinite(most)):
            raise ValueError(f"image holds {int((~np.isfinite(hu)).sum())} pixels that are not finite")
        if max(-least, most) > LARGEST_HU:
            raise ValueError(f"image holds values from {least:g} to {most:g}, expected at most {LARGEST_HU:g} HU")
        object.__setattr__(self, "hu", hu)
