"""Where bright things of rod size are in a slice: above a threshold, or by their contrast to their surroundings."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

# Of more things that stand out than this the strongest are looked at, so many at once.
_MOST_PEAKS: Final = 96
_AT_ONCE: Final = 32
# Directions in which the surroundings of a peak are sampled.
_DIRECTIONS: Final = 16
# Standard deviations of the noise by which a peak must stand out.
_STANDS_OUT: Final = 8.0
# Median absolute difference of two normal variables, of their standard deviation.
_MEDIAN_OF_DIFFERENCES: Final = 0.954
# Smaller regions are one spot, pixels.
_LEAST_TO_PART: Final = 5
# The rods of a frame are alike; one that leans is spread over more pixels, and fainter, but not below this share.
_FAINTEST: Final = 0.3
# The mean brightness around is taken on a coarser grid, of so many pixels.
_COARSE: Final = 4


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
    return _parted(hu, np.full(len(label), threshold), fewest, regions)


def _parted(hu: NDArray[np.float32], floors: Array, fewest: float, regions: Regions) -> Regions:
    """The regions, those that fall apart in their parts; floors: (n,), above which each region is."""
    labels, highest = regions.labels, int(regions.labels.max(initial=0))
    whole = np.ones(len(regions.label), dtype=bool)
    parts: list[tuple[int, list[int], list[int]]] = []
    for row in np.flatnonzero((regions.extent >= _LEAST_TO_PART).any(axis=1)):
        (left, top), (width, height) = regions.first[row].tolist(), regions.extent[row].tolist()
        box = np.s_[top : top + height, left : left + width]
        value = np.where(labels[box] == regions.label[row], hu[box] - floors[row], 0.0)
        half = 0.5 * float(value.max())
        count, inner, stats, _ = cv2.connectedComponentsWithStats((value > half).view(np.uint8), connectivity=8)
        if count <= 2:
            continue
        # Noise makes parts too, but hardly so high ones.
        least = max(half / 2, _STANDS_OUT * _noise(hu))
        high = [one for one in range(1, count) if float(value[inner == one].max()) - half >= least]
        high = [one for one in high if stats[one, cv2.CC_STAT_AREA] >= min(fewest, 3)]
        if len(high) < 2:
            continue
        whole[row] = False
        labels[box][labels[box] == regions.label[row]] = 0  # what lies between the parts is no other thing
        for one in high:
            highest += 1
            labels[box][inner == one] = highest
            inner_left, inner_top, inner_width, inner_height = stats[one, :4].tolist()
            parts.append((highest, [left + inner_left, top + inner_top], [inner_width, inner_height]))
    if not parts:
        return regions
    label, first, extent = (np.array(column, dtype=np.intp) for column in zip(*parts, strict=True))
    kept = regions.take(whole)
    return Regions(
        labels,
        np.concatenate([kept.label, label]),
        np.concatenate([kept.first, first]),
        np.concatenate([kept.extent, extent]),
    )


def regions_by_contrast(hu: NDArray[np.float32], fewest: float, most: float, least_rods: int) -> Regions:
    """Regions around peaks, above half of each peak's height over its surroundings.

    They have `fewest` to `most` pixels and do not touch the image's edge. Where a frame shows, the `least_rods`
    strongest are rods or brighter: those that are far fainter are left out.
    """
    radius = int(np.sqrt(most / np.pi)) + 4
    reach = radius + 3
    u, v, level, height = _peaks(hu, radius)
    labels = np.zeros(hu.shape, dtype=np.int32)
    heights: list[float] = []
    floors: list[float] = []
    firsts, extents = [np.empty((0, 2), dtype=np.intp)], [np.empty((0, 2), dtype=np.intp)]
    for start in range(0, len(u), _AT_ONCE):
        if len(heights) >= least_rods and height[start] < _FAINTEST * heights[least_rods - 1]:
            break
        part = slice(start, start + _AT_ONCE)
        first, extent, area, own = _half_height(hu, u[part], v[part], (level + 0.5 * height)[part], reach)
        fits = (area >= fewest) & (area <= most) & _is_whole(first, extent, hu.shape)
        for row in np.flatnonzero(fits):
            peak = start + row
            if len(heights) >= least_rods and height[peak] < _FAINTEST * heights[least_rods - 1]:
                break  # and so are all that follow
            inside_v, inside_u = np.nonzero(own[row])
            inside = inside_v + v[peak] - reach, inside_u + u[peak] - reach
            if labels[inside].any():
                continue  # another peak of the same region
            heights.append(float(height[peak]))
            floors.append(float(level[peak] + 0.5 * height[peak]))
            labels[inside] = len(heights)
            firsts.append(first[row : row + 1])
            extents.append(extent[row : row + 1])
    regions = Regions(labels, np.arange(1, len(heights) + 1), np.concatenate(firsts), np.concatenate(extents))
    return _parted(hu, np.array(floors), fewest, regions)


def _noise(hu: NDArray[np.float32]) -> float:
    """Standard deviation of the noise, HU: by neighbouring pixels' differences, of which most have no other reason."""
    return float(np.median(np.abs(np.diff(hu[::16], axis=1)))) / _MEDIAN_OF_DIFFERENCES if hu.shape[1] > 1 else 0.0


def _is_whole(first: NDArray[np.intp], extent: NDArray[np.intp], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which regions do not touch the image's edge."""
    return np.asarray((first > 0).all(axis=1) & (first + extent < shape[::-1]).all(axis=1))


def _peaks(hu: NDArray[np.float32], radius: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """Columns, rows, surroundings and heights (n,) of the peaks that stand out, the highest first.

    radius: where the surroundings are.
    """
    smooth = np.asarray(cv2.GaussianBlur(hu, (3, 3), 0.8))
    highest = cv2.dilate(smooth, np.ones((5, 5), np.uint8))
    v, u = np.divmod(np.flatnonzero(smooth == highest), hu.shape[1])
    coarse_size = -(-hu.shape[1] // _COARSE), -(-hu.shape[0] // _COARSE)
    coarse = np.asarray(cv2.resize(hu, coarse_size, interpolation=cv2.INTER_AREA))
    coarse = cv2.blur(coarse, (2 * radius // _COARSE + 1, 2 * radius // _COARSE + 1))
    contrast = smooth[v, u] - coarse[v // _COARSE, u // _COARSE]
    least = max(_STANDS_OUT * _noise(hu), 1.0)
    rows = np.flatnonzero(contrast > least)
    if len(rows) > _MOST_PEAKS:
        rows = rows[np.argpartition(-contrast[rows], _MOST_PEAKS)[:_MOST_PEAKS]]
    u, v = u[rows], v[rows]
    turn = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    around_u = np.clip(u[:, None] + np.rint(radius * np.cos(turn)).astype(np.intp), 0, hu.shape[1] - 1)
    around_v = np.clip(v[:, None] + np.rint(radius * np.sin(turn)).astype(np.intp), 0, hu.shape[0] - 1)
    # Along an edge or a bar the surroundings are as bright as it is, on both sides: what stands out of these counts.
    around = smooth[around_v, around_u].astype(np.float64)
    level = np.minimum(around[:, : _DIRECTIONS // 2], around[:, _DIRECTIONS // 2 :]).max(axis=1)
    height = smooth[v, u] - level
    order = np.argsort(-height, kind="stable")
    order = order[height[order] > least]
    return u[order], v[order], level[order], height[order]


def _half_height(
    hu: NDArray[np.float32], u: NDArray[np.intp], v: NDArray[np.intp], half: Array, reach: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """First pixels (n, 2), extents (n, 2) and areas (n,) of the regions above `half` (n,) around peaks (u, v), and
    masks (n, p, p) of them, the peak in the middle; the area is 0 of what reaches farther than `reach`.
    """
    side = 2 * reach + 1
    place = np.arange(-reach, reach + 1)
    at_u, at_v = u[:, None] + place, v[:, None] + place
    outside = ((at_u < 0) | (at_u >= hu.shape[1]))[:, None, :] | ((at_v < 0) | (at_v >= hu.shape[0]))[:, :, None]
    at = np.clip(at_v, 0, hu.shape[0] - 1)[:, :, None], np.clip(at_u, 0, hu.shape[1] - 1)[:, None, :]
    # One below the other, a line apart, the patches are one picture to OpenCV.
    picture = np.zeros((len(u), side + 1, side), dtype=np.uint8)
    picture[:, :side] = (hu[at] > half[:, None, None].astype(np.float32)) & ~outside
    _, labels, stats, _ = cv2.connectedComponentsWithStats(picture.reshape(-1, side), connectivity=8)
    labels = np.asarray(labels).reshape(picture.shape)
    label = labels[:, reach, reach]
    own = labels[:, :side] == label[:, None, None]
    chosen = np.asarray(stats)[label].astype(np.intp)
    top = chosen[:, cv2.CC_STAT_TOP] - np.arange(len(u)) * (side + 1)
    first = np.stack([chosen[:, cv2.CC_STAT_LEFT], top], axis=1)
    extent = chosen[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    whole = (label > 0) & _is_whole(first, extent, (side, side))
    return first + np.stack([u, v], axis=1) - reach, extent, np.where(whole, chosen[:, cv2.CC_STAT_AREA], 0), own
