"""Metal in a slice: how much of each pixel's volume a cylinder fills, seen through the point spread.

A cylinder is a bundle of parallel fibres. A fibre is a straight segment, so the slab of the slice and the cylinder's
ends cut it exactly; what is left is spread evenly over its shadow in the image. The fibres are the nodes of a
quadrature over the cylinder's cross-section, and the point spread makes everything smooth: a few dozen fibres are
exact to about 1e-4 of the peak, and since they lie in point symmetry no spot is pulled off its centre.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import PixelScale

_PIECE_MM = 8.0
_REACH_SIGMA = 5.0


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A straight cylinder in slice axes. start, end: (3,) mm, the centres of its ends; diameter: mm."""

    start: Array
    end: Array
    diameter: float

    @property
    def length(self) -> float:
        """Length, mm."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def direction(self) -> Array:
        """Unit vector (3,) from start to end."""
        direction: Array = (self.end - self.start) / self.length
        return direction

    def shadow(self, slice_thickness_mm: float) -> Array | None:
        """Ends (2, 2) in mm of the axis of that part of the cylinder which lies in the slice; None where none does."""
        sine = float(np.hypot(*self.direction[:2]))
        reach = 0.5 * slice_thickness_mm + 0.5 * self.diameter * sine
        low, high = _clip(self, np.zeros((1, 3)), reach)
        if high[0] <= low[0]:
            return None
        return self.start[:2] + np.array([low[0], high[0]])[:, None] * self.direction[:2]


def add_metal(
    image: NDArray[np.floating[Any]],
    cylinder: Cylinder,
    scale: PixelScale,
    slice_thickness_mm: float,
    psf_sigma_mm: float,
    hu: float = 1.0,
) -> None:
    """Add to `image` (rows, columns), in place, `hu` times the fraction of each pixel that `cylinder` fills.

    A pixel's volume is its area times the slice's thickness (a box profile about the plane z = 0), blurred by a
    Gaussian of `psf_sigma_mm` in the plane. Under a pixel shear the point spread is sheared with the pixels.
    """
    offsets, areas = _fibres(cylinder, psf_sigma_mm)
    low, high = _clip(cylinder, offsets, 0.5 * slice_thickness_mm)
    if not (high > low).any():
        return
    first, last = float(low[high > low].min()), float(high[high > low].max())
    direction = cylinder.direction
    shadow = (last - first) * float(np.hypot(direction[0], direction[1]))
    # Long shadows go in pieces: the cost of one is its points times its patch of the image.
    pieces = max(1, math.ceil(shadow / _PIECE_MM))
    nodes, node_weights = _gauss_legendre(math.ceil(1.5 * shadow / pieces / psf_sigma_mm) + 3)
    borders = np.linspace(first, last, pieces + 1)
    voxel = scale.sx * scale.sy * slice_thickness_mm
    for begin, end in pairwise(borders):
        a, b = np.clip(low, begin, end), np.clip(high, begin, end)
        some = b > a
        half = 0.5 * (b - a)[some, None]
        along = 0.5 * (a + b)[some, None] + half * nodes
        points = (cylinder.start[:2] + offsets[some, None, :2]) + along[..., None] * direction[:2]
        volumes = areas[some, None] * half * node_weights
        _splat(image, scale.to_px(points.reshape(-1, 2)), volumes.ravel() * (hu / voxel), scale, psf_sigma_mm)


def _splat(
    image: NDArray[np.floating[Any]], points_px: Array, weights: Array, scale: PixelScale, psf_sigma_mm: float
) -> None:
    """Add points (n, 2), each blurred by the point spread and averaged over the pixels, to `image`."""
    sigma = psf_sigma_mm / np.array([scale.sx, scale.sy])
    reach = _REACH_SIGMA * sigma + 1
    low = np.maximum(np.floor(points_px.min(axis=0) - reach), 0).astype(int)
    high = np.minimum(np.ceil(points_px.max(axis=0) + reach) + 1, image.shape[::-1]).astype(int)
    if (high <= low).any():
        return
    by_column, by_row = (
        np.diff(ndtr((np.arange(low[k], high[k] + 1)[:, None] - 0.5 - points_px[:, k]) / sigma[k]), axis=0)
        for k in range(2)
    )
    image[low[1] : high[1], low[0] : high[0]] += (by_row * weights) @ by_column.T


def _fibres(cylinder: Cylinder, psf_sigma_mm: float) -> tuple[Array, Array]:
    """Offsets (n, 3) mm of the fibres from the axis, and their cross-sections (n,) in mm^2, which sum to the disc."""
    radius = 0.5 * cylinder.diameter
    discs, shares = _disc(2 + math.ceil(1.5 * radius / psf_sigma_mm), 4 + 2 * math.ceil(2 * radius / psf_sigma_mm))
    direction = cylinder.direction
    across = np.cross(direction, np.eye(3)[int(np.abs(direction).argmin())])
    across /= np.linalg.norm(across)
    offsets: Array = radius * discs @ np.stack([across, np.cross(direction, across)])
    return offsets, shares * (math.pi * radius**2)


def _clip(cylinder: Cylinder, offsets: Array, half_thickness: float) -> tuple[Array, Array]:
    """From where to where (n,) mm along the cylinder its fibres lie in |z| <= half_thickness; equal where nowhere."""
    z = cylinder.start[2] + offsets[:, 2]
    length = cylinder.length
    slope = float(cylinder.direction[2])
    if abs(slope) * length < 1e-9:
        return np.zeros(len(z)), np.where(np.abs(z) <= half_thickness, length, 0.0)
    enter, leave = (
        (-math.copysign(half_thickness, slope) - z) / slope,
        (math.copysign(half_thickness, slope) - z) / slope,
    )
    low = np.clip(enter, 0.0, length)
    return low, np.maximum(low, np.minimum(leave, length))


@lru_cache(maxsize=64)
def _gauss_legendre(count: int) -> tuple[Array, Array]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


@lru_cache(maxsize=64)
def _disc(rings: int, spokes: int) -> tuple[Array, Array]:
    """Nodes (n, 2) in the unit disc and weights (n,) of sum 1; `spokes` is even, so that they lie in point symmetry."""
    nodes, weights = _gauss_legendre(rings)
    radii = np.sqrt(0.5 * (nodes + 1))
    turn = 2 * np.pi / spokes
    angles = turn * (np.arange(spokes) + 0.5 * (np.arange(rings)[:, None] % 2))
    points = radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return points.reshape(-1, 2), np.repeat(0.5 * weights / spokes, spokes)
