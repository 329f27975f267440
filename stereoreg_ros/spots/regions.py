"""Bright regions of rod size in a slice: those above a threshold, and how regions of several spots fall apart."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

# Standard deviations of the noise by which a part must stand out.
_STANDS_OUT: Final = 8.0
# Median absolute difference of two normal variables, of their standard deviation.
_MEDIAN_OF_DIFFERENCES: Final = 0.954
# Smaller regions are one spot, pixels.
_LEAST_TO_PART: Final = 5


class Regions(NamedTuple):
    """Regions of a slice, n of them.

    labels: (rows, columns), 0 where there is none; other things than the n regions may have numbers too. label: (n,),
    the number of each; first: (n, 2), its leftmost column and topmost row; extent: (n, 2), columns and rows that it
    spans.
    """

    labels: NDArray[np.int32]
    label: NDArray[np.intp]
    first: NDArray[np.intp]
    extent: NDArray[np.intp]

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Regions:
        """Only the given regions."""
        return self._replace(label=self.label[rows], first=self.first[rows], extent=self.extent[rows])


def regions_above(hu: NDArray[np.float32], threshold: float, fewest: float, most: float) -> Regions:
    """8-connected regions above a threshold, of `fewest` to `most` pixels, that do not touch the image's edge.

    A region of two spots that touch falls apart at half its height above the threshold: each part is a region then.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats((hu > threshold).view(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA]
    first = stats[:, [cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP]].astype(np.intp)
    extent = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].astype(np.intp)
    fits = (area >= fewest) & (area <= most) & _is_whole(first, extent, hu.shape)
    fits[0] = False  # label 0 is the background
    label = np.flatnonzero(fits)
    regions = Regions(np.asarray(labels), label, first[label], extent[label])
    return parted(hu, np.full(len(label), threshold), np.zeros(len(label)), fewest, regions)[0]


def parted(
    hu: NDArray[np.float32], floors: Array, noise: Array, fewest: float, regions: Regions
) -> tuple[Regions, NDArray[np.intp]]:
    """The regions, those that fall apart in their parts, m in all, and of which (m,) of the given ones each is a part.

    floors: (n,), HU above which each region is; noise: (n,), HU, standard deviation of the noise where it is, as far as
    it is known to be more than is usual in the slice.
    """
    labels, highest = regions.labels, 0
    whole = np.ones(len(regions.label), dtype=bool)
    parts: list[tuple[int, list[int], list[int], int]] = []
    usual: float | None = None
    for row in np.flatnonzero((regions.extent >= _LEAST_TO_PART).any(axis=1)):
        (left, top), (width, height) = regions.first[row].tolist(), regions.extent[row].tolist()
        box = np.s_[top : top + height, left : left + width]
        value = np.where(labels[box] == regions.label[row], hu[box] - floors[row], 0.0)
        half = 0.5 * float(value.max())
        count, inner, stats, _ = cv2.connectedComponentsWithStats((value > half).view(np.uint8), connectivity=8)
        if count <= 2:
            continue
        # Noise makes parts too, but hardly so high ones.
        usual = _noise(hu) if usual is None else usual
        least = max(half / 2, _STANDS_OUT * max(usual, float(noise[row])))
        high = [one for one in range(1, count) if float(value[inner == one].max()) - half >= least]
        high = [one for one in high if stats[one, cv2.CC_STAT_AREA] >= min(fewest, 3)]
        if len(high) < 2:
            continue
        whole[row] = False
        highest = highest or int(labels.max())
        labels[box][labels[box] == regions.label[row]] = 0  # what lies between the parts is no other thing
        for one in high:
            highest += 1
            labels[box][inner == one] = highest
            inner_left, inner_top, inner_width, inner_height = stats[one, :4].tolist()
            parts.append((highest, [left + inner_left, top + inner_top], [inner_width, inner_height], int(row)))
    if not parts:
        return regions, np.arange(len(regions.label))
    label, first, extent, whose = (np.array(column, dtype=np.intp) for column in zip(*parts, strict=True))
    kept = regions.take(whole)
    regions = Regions(
        labels,
        np.concatenate([kept.label, label]),
        np.concatenate([kept.first, first]),
        np.concatenate([kept.extent, extent]),
    )
    return regions, np.concatenate([np.flatnonzero(whole), whose])


def _noise(hu: NDArray[np.float32]) -> float:
    """Standard deviation of the noise, HU: by neighbouring pixels' differences, of which most have no other reason."""
    return float(np.median(np.abs(np.diff(hu[::16], axis=1)))) / _MEDIAN_OF_DIFFERENCES if hu.shape[1] > 1 else 0.0


def _is_whole(first: NDArray[np.intp], extent: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which regions do not touch the image's edge."""
    return np.asarray((first > 0).all(axis=1) & (first + extent < shape[::-1]).all(axis=1))
