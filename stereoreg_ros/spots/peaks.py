"""Local maxima of a slice that stand out of the places around them: where it is worth looking for a spot."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

# A peak is the highest within this many pixels to each side.
_SIDE: Final = 5
# What varies by less is flat, HU.
_FLAT_HU: Final = 1.0
# In how many directions, of half a turn, its surroundings are sampled: few first, as most peaks are noise.
_FEW_AXES, _AXES = 2, 16
# How many straight paths from a peak are followed: first some, and not far, pixel.
_FEW_PATHS, _SHORT, _PATHS = 8, 8, 16
# So many times the peaks that are wanted are followed along paths.
_FOLLOWED: Final = 8


class Peaks(NamedTuple):
    """Peaks of a slice, n of them.

    u, v: (n,), column and row; top: (n,), HU in the smoothed slice; rough_height: (n,), HU above the brightest of what
    lies on both sides of it.
    """

    u: NDArray[np.intp]
    v: NDArray[np.intp]
    top: NDArray[np.float32]
    rough_height: NDArray[np.float32]

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Peaks:
        """Only the given peaks."""
        return Peaks(self.u[rows], self.v[rows], self.top[rows], self.rough_height[rows])


def find_peaks(smooth: NDArray[np.float32], margin: int, radius: int, least: float, most_peaks: int) -> Peaks:
    """The peaks of a smoothed slice that stand out by more than `least` HU, save those seen at a glance to be joined to
    something higher; of more than `most_peaks` the highest. In no order.

    smooth: (rows + 2 margin, columns + 2 margin), the slice with a margin of no less than `radius` around it. radius:
    pixel, where the surroundings of the widest spot are; those of a narrow one are looked at half as far off, and the
    lower of both counts.
    """
    flat, columns = smooth.ravel(), smooth.shape[1]
    highest = cv2.dilate(smooth, np.ones((_SIDE, _SIDE), np.uint8))
    inner = np.s_[margin : smooth.shape[0] - margin, margin : columns - margin]
    v, u = np.divmod(np.flatnonzero(smooth[inner] == highest[inner]), columns - 2 * margin)
    at = (v + margin) * columns + u + margin  # a pixel's number, counted along the rows
    beside = [flat.take(at + step) for step in _steps(np.pi * np.arange(4) / 2, _SIDE // 2, columns)]
    at = at[flat.take(at) - np.minimum.reduce(beside) > _FLAT_HU]
    height = np.zeros(len(at), dtype=np.float32)
    for axes in (_FEW_AXES, _AXES):
        level = [_level_around(flat, columns, at, distance, axes) for distance in (radius, -(-radius // 2))]
        height = flat.take(at) - np.minimum(*level)
        at, height = at[height > least], height[height > least]
    at, height = _one_of_each_plateau(smooth, at, height)
    rows = _highest(height, _FOLLOWED * most_peaks)
    for paths, distance in ((_FEW_PATHS, min(_SHORT, radius)), (_PATHS, radius)):
        rows = rows[~_joined(flat, columns, at[rows], np.float32(least), paths, distance)]
    rows = rows[_highest(height[rows], most_peaks)]
    v, u = np.divmod(at[rows], columns)
    return Peaks(u - margin, v - margin, flat.take(at[rows]), height[rows])


def _highest(height: NDArray[np.float32], most: int) -> NDArray[np.intp]:
    """Rows of the highest, `most` at most."""
    return np.argpartition(-height, most)[:most] if len(height) > most else np.arange(len(height))


def _one_of_each_plateau(
    picture: NDArray[np.float32], at: NDArray[np.intp], height: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Of peaks that touch, as where the range of the image ends, the highest; moved to the middle of them where the
    picture is as bright there. The peaks are in the order of their numbers.
    """
    columns = picture.shape[1]
    beside = at + np.array([[1], [columns - 1], [columns], [columns + 1]])
    row = np.minimum(np.searchsorted(at, beside), len(at) - 1) if len(at) else beside
    _, one = np.nonzero(at[row] == beside)
    if not one.size:
        return at, height
    touching = coo_array((np.ones(len(one)), (one, row[at[row] == beside])), shape=(len(at), len(at)))
    _, label = connected_components(touching, directed=False)
    v, u = np.divmod(at, columns)
    count = np.bincount(label)
    middle_v, middle_u = (np.rint(np.bincount(label, place) / count).astype(np.intp) for place in (v, u))
    rows = np.lexsort((-height, label))
    rows = rows[np.diff(label[rows], prepend=-1) > 0]
    middle = (middle_v * columns + middle_u)[label[rows]]
    flat = picture.ravel()
    return np.where(flat.take(middle) == flat.take(at[rows]), middle, at[rows]), height[rows]


def _level_around(
    flat: NDArray[np.float32], columns: int, at: NDArray[np.intp], radius: int, axes: int
) -> NDArray[np.float32]:
    """The brightest pair (n,) of opposite places on a circle around pixels, in so many directions: by the darker of the
    two.

    Along an edge or a bar both are as bright as the bar is, so that its own pixels stand out of nothing.
    """
    level = np.full(len(at), -np.inf, dtype=np.float32)
    for step in _steps(np.pi * np.arange(axes) / axes, radius, columns):
        np.maximum(level, np.minimum(flat.take(at + step), flat.take(at - step)), out=level)
    return level


def _joined(
    flat: NDArray[np.float32], columns: int, at: NDArray[np.intp], depth: np.float32, paths: int, reach: int
) -> NDArray[np.bool_]:
    """From which pixels (n,) one of so many straight paths leads to a higher one within reach, nowhere deeper than
    `depth` below them.
    """
    turn = 2 * np.pi * np.arange(paths) / paths
    steps = np.stack([_steps(turn, distance, columns) for distance in range(1, reach + 1)], axis=-1)
    rise = flat.take(at[:, None, None] + steps) - flat.take(at)[:, None, None]
    reached = np.logical_and.accumulate(rise >= -depth, axis=2)
    return np.asarray((reached & (rise > 0)).any(axis=(1, 2)))


def _steps(turn: NDArray[np.float64], distance: int, columns: int) -> NDArray[np.intp]:
    """By how much the numbers (n,) of the pixels at a distance differ, in the directions `turn` (n,)."""
    to_u, to_v = (np.rint(distance * part(turn)).astype(np.intp) for part in (np.cos, np.sin))
    return np.asarray(to_v * columns + to_u)
