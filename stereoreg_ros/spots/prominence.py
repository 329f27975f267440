"""How far a peak stands out of its surroundings, as a thing by itself, and how much noise there is."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.spots.peaks import Peaks

# Standard deviations of the smoothed noise by which a spot must stand out, and HU at least. Of noise alone, not one
# peak in a hundred thousand does so by five.
_STANDS_OUT, _LEAST_HU = 6.0, 1.0
# Heights are sought up to this many times the rough height; the factor between that and the least is halved so often.
_HIGHEST, _STEPS = 4 / 3, 6
# Where a square shows less of a height than this share of the rough one, it may have hidden the rest.
_LITTLE: Final = 1 / 2
# Pixels so far apart along a row or a column, and along a diagonal, do not share their noise.
_LAG, _DIAGONAL_LAG = 3, 2
# Differences are taken of every n-th row of the slice, and of every n-th row and column of a square.
_ROWS, _EVERY = 32, 3
# Median absolute difference of two normal variables, of their standard deviation.
_MEDIAN_OF_DIFFERENCES: Final = 0.954
# Differences no larger than this are rounding, HU.
_ROUNDING_HU: Final = 0.01


class Prominence(NamedTuple):
    """How far peaks stand out, n of them.

    height: (n,) HU, 0 of those that do not; noise: (n,) HU, its standard deviation around them; cut: (n,), whether the
    thing leaves the square in which it was looked at, so that more of it may be seen from its middle.
    """

    height: NDArray[np.float32]
    noise: Array
    cut: NDArray[np.bool_]


class SmoothSlice(NamedTuple):
    """A smoothed slice.

    hu: (rows + 2 margin, columns + 2 margin); margin: pixel, on all sides; noise: HU, the standard deviation that is
    usual in it.
    """

    hu: NDArray[np.float32]
    margin: int
    noise: float


def smoothed(wide: NDArray[np.float32], margin: int) -> SmoothSlice:
    """A slice with a margin, smoothed; where all is flat, as around one that was masked or clipped, there is nothing to
    learn of its noise.
    """
    smooth = np.asarray(cv2.GaussianBlur(wide, (3, 3), 0.8), dtype=np.float32)
    off = np.abs(smooth[::_ROWS, _LAG:] - smooth[::_ROWS, :-_LAG])
    off = off[off > _ROUNDING_HU]
    return SmoothSlice(smooth, margin, float(np.median(off)) / _MEDIAN_OF_DIFFERENCES if off.size else 0.0)


def least_height(noise: float) -> float:
    """By how much a spot must stand out, HU, where the smoothed noise has this standard deviation, HU."""
    return max(_STANDS_OUT * noise, _LEAST_HU)


def prominences(smooth: SmoothSlice, peaks: Peaks, reach: int, most: float) -> Prominence:
    """How far peaks stand out: down to the lowest level at which each is a thing by itself.

    That is, the region around it has at most `most` pixels, all within `reach` columns and rows and none at the edge
    of the slice, and nothing in it is higher.
    """
    squares = _squares(smooth, peaks, reach)
    rows = np.arange(len(peaks.u))
    height, noise = np.zeros(len(rows), dtype=np.float32), np.zeros(len(rows))
    alone, cut = _is_alone(squares, np.full(len(rows), np.float32(least_height(smooth.noise))), most)
    rows, squares = rows[alone], squares.take(alone)
    noise[rows] = np.maximum(_noise(squares.hu), smooth.noise)
    least = np.maximum(_STANDS_OUT * noise[rows], _LEAST_HU).astype(np.float32)
    alone, cut[rows] = _is_alone(squares, least, most)
    rows, squares, least = rows[alone], squares.take(alone), least[alone]
    joined = np.maximum(np.float32(_HIGHEST) * peaks.rough_height[rows], least)
    ends_cut = np.zeros(len(rows), dtype=bool)
    for _ in range(_STEPS):
        middle = np.sqrt(least * joined)
        alone, leaves = _is_alone(squares, middle, most)
        least, joined = np.where(alone, middle, least), np.where(alone, joined, middle)
        ends_cut = np.where(alone, ends_cut, leaves)
    height[rows] = np.sqrt(least * joined)
    cut[rows] = ends_cut & (least < _LITTLE * peaks.rough_height[rows])
    return Prominence(height, noise, cut)


def centred(smooth: SmoothSlice, peaks: Peaks, reach: int) -> Peaks:
    """The peaks, each moved to the middle of what is at least half as high around it: along a long streak any place
    may be the brightest. None of them may be at the edge of the slice.
    """
    squares = _squares(smooth, peaks, reach)
    own = around_middle(squares.hu >= (peaks.top - 0.5 * peaks.rough_height)[:, None, None])
    own &= ~at_the_edge(smooth.hu.shape, smooth.margin, peaks, reach)
    place, area = np.arange(2 * reach + 1), own.sum(axis=(1, 2))
    middle_u, middle_v = (own.sum(axis=axis) @ place / area for axis in (1, 2))
    off_u, off_v = place - middle_u[:, None], place - middle_v[:, None]
    far = np.where(own, off_u[:, None, :] ** 2 + off_v[:, :, None] ** 2, np.inf)
    to_v, to_u = np.divmod(far.reshape(len(far), -1).argmin(axis=1), len(place))
    return peaks._replace(u=peaks.u + to_u - reach, v=peaks.v + to_v - reach)


def squares_around(wide: NDArray[np.float32], margin: int, peaks: Peaks, reach: int) -> NDArray[np.float32]:
    """Squares (n, 2 reach + 1, 2 reach + 1) of an image with a margin of no less than `reach`, around peaks."""
    side = 2 * reach + 1
    return np.asarray(sliding_window_view(wide, (side, side))[peaks.v + margin - reach, peaks.u + margin - reach])


def at_the_edge(shape: tuple[int, ...], margin: int, peaks: Peaks, reach: int) -> NDArray[np.bool_]:
    """Which pixels of such squares are at the edge of the slice or beyond; shape: of the image with its margin."""
    off = np.arange(-reach, reach + 1)
    out = [
        (place[:, None] + off <= 0) | (place[:, None] + off >= size - 2 * margin - 1)
        for place, size in ((peaks.v, shape[0]), (peaks.u, shape[1]))
    ]
    return np.asarray(out[0][:, :, None] | out[1][:, None, :])


def around_middle(above: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of masks (n, p, p) the 8-connected region that holds the middle pixel; empty where that is not set."""
    count, side = above.shape[:2]
    if not count:
        return above  # OpenCV does not survive an empty picture
    # One below the other, a line apart, they are one picture to OpenCV.
    picture = np.zeros((count, side + 1, side), dtype=np.uint8)
    picture[:, :side] = above
    _, labels = cv2.connectedComponents(picture.reshape(-1, side), connectivity=8)
    labels = np.asarray(labels).reshape(picture.shape)[:, :side]
    return np.asarray((labels == labels[:, side // 2, side // 2, None, None]) & above)


def leaves_square(own: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of masks (n, p, p) have pixels at the rim."""
    return np.asarray(own[:, [0, -1]].any(axis=(1, 2)) | own[:, :, [0, -1]].any(axis=(1, 2)))


class _Squares(NamedTuple):
    """Squares around peaks, n of them.

    hu: (n, p, p); top: (n,) HU, of the peak; shut: (n, p, p), what is no part of it, being higher, or at the edge of
    the slice or beyond.
    """

    hu: NDArray[np.float32]
    top: NDArray[np.float32]
    shut: NDArray[np.bool_]

    def take(self, rows: NDArray[np.bool_]) -> _Squares:
        """Only the given squares."""
        return _Squares(self.hu[rows], self.top[rows], self.shut[rows])


def _squares(smooth: SmoothSlice, peaks: Peaks, reach: int) -> _Squares:
    hu = squares_around(smooth.hu, smooth.margin, peaks, reach)
    shut = at_the_edge(smooth.hu.shape, smooth.margin, peaks, reach) | (hu > peaks.top[:, None, None])
    return _Squares(hu, peaks.top, shut)


def _is_alone(
    squares: _Squares, depth: NDArray[np.float32], most: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether each peak is a thing by itself down to a depth (n,) below its top, HU, and whether it would be but for
    leaving its square.
    """
    own = around_middle(squares.hu >= (squares.top - depth)[:, None, None])
    fits = (own.sum(axis=(1, 2)) <= most) & ~(own & squares.shut).any(axis=(1, 2))
    leaves = leaves_square(own)
    return np.asarray(fits & ~leaves), np.asarray(fits & leaves)


def _noise(squares: NDArray[np.float32]) -> Array:
    """Standard deviation (n,) of the noise in squares (n, p, p), HU: by the differences of pixels, of which most have
    no other reason, in the direction in which they are least. Beside a wall, in a plate or along a streak that is its
    own.
    """
    if not len(squares):
        return np.zeros(0)
    lag, diagonal = _LAG, _DIAGONAL_LAG
    pairs = (
        (squares[:, ::_EVERY, lag::_EVERY], squares[:, ::_EVERY, :-lag:_EVERY]),
        (squares[:, lag::_EVERY, ::_EVERY], squares[:, :-lag:_EVERY, ::_EVERY]),
        (squares[:, diagonal::_EVERY, diagonal::_EVERY], squares[:, :-diagonal:_EVERY, :-diagonal:_EVERY]),
        (squares[:, diagonal::_EVERY, :-diagonal:_EVERY], squares[:, :-diagonal:_EVERY, diagonal::_EVERY]),
    )
    least = np.full(len(squares), np.inf)
    for one, other in pairs:
        off = np.abs(one - other).reshape(len(squares), -1)
        middle = off.shape[1] // 2
        np.minimum(least, np.partition(off, middle, axis=1)[:, middle], out=least)
    return least / _MEDIAN_OF_DIFFERENCES
