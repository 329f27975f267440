"""Regions of things of rod size that stand out of their surroundings: no threshold is asked for."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.spots.peaks import Peaks, find_peaks
from stereoreg_ros.spots.prominence import (
    SmoothSlice,
    around_middle,
    at_the_edge,
    centred,
    least_height,
    leaves_square,
    prominences,
    smoothed,
    squares_around,
)
from stereoreg_ros.spots.regions import Regions, parted

# Of more peaks than this the highest are looked at, and of fewer where their squares would have more pixels than that.
_MOST_PEAKS, _MOST_PIXELS, _LEAST_PEAKS = 512, 2_000_000, 32
# So many pixels of squares are looked at together.
_AT_ONCE: Final = 1_000_000
# What a square cuts off is looked at in one that reaches this many radii to each side.
_LONGER: Final = 1.5
# What stands out by less than this share of its rough height, and is larger than this share of the largest spot, is the
# top of something larger.
_TOP, _LARGE = 1 / 3, 1 / 4
# Smoothing leaves 0.27 of the height of a pixel that stands by itself, and more of all that a point spread has widened.
_SHARPEST: Final = 0.3


class Standing(NamedTuple):
    """What stands out: regions, n of them, and height (n,) and standard deviation of the noise (n,) of each, HU in the
    smoothed slice.
    """

    regions: Regions
    height: Array
    noise: Array


class _Candidate(NamedTuple):
    """A peak's region: rows and columns of its pixels, all above `floor`; heights, noise and floor in HU."""

    height: float
    noise: float
    floor: float
    pixels: tuple[NDArray[np.intp], NDArray[np.intp]]


def regions_by_contrast(hu: NDArray[np.float32], fewest: float, most: float) -> Standing:
    """Regions around peaks, above half of each peak's height: of `fewest` to `most` pixels, whole in the image.

    The height is that above the lowest level at which the peak is a thing by itself: of no more than `most` pixels,
    whole, and without anything higher in it. Every threshold that would show it as a region of its own lies between
    that level and the peak. So nothing else in the slice, however bright, decides whether it is found: it must stand
    out of the noise around it.
    """
    radius = int(np.sqrt(most / np.pi)) + 4
    reach = radius + 3
    margin = max(reach, int(_LONGER * radius))
    wide = np.asarray(cv2.copyMakeBorder(hu, margin, margin, margin, margin, cv2.BORDER_REPLICATE), dtype=np.float32)
    smooth = smoothed(wide, margin)
    most_peaks = int(np.clip(_MOST_PIXELS // (2 * reach + 1) ** 2, _LEAST_PEAKS, _MOST_PEAKS))
    peaks = find_peaks(smooth.hu, margin, radius, least_height(smooth.noise), most_peaks)
    candidates, cut = _candidates(wide, smooth, peaks, reach, fewest, most)
    if cut.any():
        candidates += _candidates(wide, smooth, centred(smooth, peaks.take(cut), reach), margin, fewest, most)[0]
    labels = np.zeros(hu.shape, dtype=np.int32)
    kept: list[_Candidate] = []
    for one in sorted(candidates, key=lambda one: -one.height):
        # What lies in the region of a higher peak is part of it, or falls off it below.
        if not labels[one.pixels].any():
            kept.append(one)
            labels[one.pixels] = len(kept)
    first = np.array([[one.pixels[1].min(), one.pixels[0].min()] for one in kept], dtype=np.intp).reshape(-1, 2)
    last = np.array([[one.pixels[1].max(), one.pixels[0].max()] for one in kept], dtype=np.intp).reshape(-1, 2)
    regions = Regions(labels, np.arange(1, len(kept) + 1), first, last - first + 1)
    height, noise, floor = (np.array([getattr(one, name) for one in kept]) for name in ("height", "noise", "floor"))
    regions, whose = parted(hu, floor, noise, fewest, regions)
    return Standing(regions, height[whose], noise[whose])


def _candidates(
    wide: NDArray[np.float32], smooth: SmoothSlice, peaks: Peaks, reach: int, fewest: float, most: float
) -> tuple[list[_Candidate], NDArray[np.bool_]]:
    """The regions of those peaks that stand out, and which of the peaks (n,) are cut off by the square around them."""
    at_once = max(_AT_ONCE // (2 * reach + 1) ** 2, 1)
    found: list[_Candidate] = []
    cut = np.zeros(len(peaks.u), dtype=bool)
    for start in range(0, len(peaks.u), at_once):
        part = np.s_[start : start + at_once]
        height, noise, cut[part] = prominences(smooth, peaks.take(part), reach, most)
        rows = np.flatnonzero(height)
        prominent = _Prominent(peaks.take(part).take(rows), height[rows], noise[rows])
        found += _regions(wide, smooth.margin, prominent, reach, (fewest, most))
    return found, cut


class _Prominent(NamedTuple):
    """Peaks that stand out, n of them: height (n,) HU and the noise (n,) HU around them."""

    peaks: Peaks
    height: NDArray[np.float32]
    noise: Array


def _regions(
    wide: NDArray[np.float32], margin: int, prominent: _Prominent, reach: int, pixels_allowed: tuple[float, float]
) -> list[_Candidate]:
    """Those of the regions above half of the peaks' heights, in a slice with a margin, that look like a rod's."""
    peaks, height, noise = prominent
    fewest, most = pixels_allowed
    hu = squares_around(wide, margin, peaks, reach)
    floor = peaks.top - 0.5 * height
    own = around_middle(hu > floor[:, None, None])
    area = own.sum(axis=(1, 2))
    whole = ~leaves_square(own) & ~(own & at_the_edge(wide.shape, margin, peaks, reach)).any(axis=(1, 2))
    highest = np.where(own, hu, -np.inf).max(axis=(1, 2), initial=-np.inf)
    blurred = height >= _SHARPEST * (highest - peaks.top + height)
    top_of_larger = (height < _TOP * peaks.rough_height) & (area > _LARGE * most)
    fits = (area >= max(fewest, 1)) & (area <= most) & whole & blurred & ~top_of_larger
    found = []
    for row in np.flatnonzero(fits):
        inside_v, inside_u = np.nonzero(own[row])
        pixels = inside_v + peaks.v[row] - reach, inside_u + peaks.u[row] - reach
        found.append(_Candidate(float(height[row]), float(noise[row]), float(floor[row]), pixels))
    return found
