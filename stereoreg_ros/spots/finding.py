"""Slice -> spots: bright regions of rod size (`regions`), each with its centre (`symmetry`) and covariance."""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import AUTO, RegistrationOptions
from stereoreg_ros.spots.choice import worth_matching
from stereoreg_ros.spots.contrast import Standing, regions_by_contrast
from stereoreg_ros.spots.regions import Regions, regions_above
from stereoreg_ros.spots.symmetry import centres_of_symmetry

# A spot's outline lies at this height between its surroundings and its peak: what is above it gives the first centre.
_OUTLINE: Final = 1 / 3
# Median absolute deviation of a normal variable, of its standard deviation.
_MAD_OF_NORMAL: Final = 0.6745
# A region that ends above this share of its height is cut short by its threshold.
_CUT_SHORT: Final = 0.6
# In pixels around a region: how far its spot may reach, and the ring of its surroundings.
_REACH, _RING_INNER, _RING_OUTER = 2, 3, 5
# Patches are square, of one of these sides, so that spots of about one size are centred at once.
_SIDES: Final = (13, 19, 27, 39, 55, 101)
_MARGIN: Final = 4
# A spot whose centre is not known to a pixel is left out: it looks little like a rod.
_LARGEST_STD_PX: Final = 0.8
_ROUNDING_PX2: Final = 1e-9
# How often the choice is repeated where things without a centre were among the chosen.
_CHOICES: Final = 4


class _Measured(NamedTuple):
    """Spots of a picture, n of them: the fields of `SliceSpots` that are measured in it, with its names and shapes.

    extents_px2: second moments of what is above a third of the spot's height; cut_short: whether the region ends above
    0.6 of that height.
    """

    centres_px: Array
    covariances_px2: Array
    extents_px2: Array
    cut_short: NDArray[np.bool_]

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> _Measured:
        """Only the given spots."""
        return _Measured(
            self.centres_px[rows], self.covariances_px2[rows], self.extents_px2[rows], self.cut_short[rows]
        )


def find_spots(ct_slice: Slice, options: RegistrationOptions) -> SliceSpots:
    """The bright spots of a slice that may be rods, from top to bottom: of an area within
    [min_spot_area_mm2, max_spot_area_mm2], and whole in the image.

    A spot is a region above the threshold (Maurin 2009, section 6.3), or with the threshold `auto` what stands out from
    its surroundings. Its centre is the centre of its symmetry.
    """
    scale = ct_slice.scale
    pixel_mm2 = scale.sx * scale.sy
    fewest, most = options.min_spot_area_mm2 / pixel_mm2, options.max_spot_area_mm2 / pixel_mm2
    if options.threshold == AUTO:
        found = _standing_out(ct_slice.hu, regions_by_contrast(ct_slice.hu, fewest, most), options.min_inliers)
    else:
        regions = regions_above(ct_slice.hu, float(options.threshold), fewest, most)
        found, _ = _centred(ct_slice.hu, regions)
    found = found.take(np.lexsort((found.centres_px[:, 0], found.centres_px[:, 1])))
    return SliceSpots(
        **found._asdict(),
        scale=scale,
        scanner_from_slice=ct_slice.scanner_from_slice,
        area_mm2=ct_slice.hu.size * scale.sx * scale.sy,
    )


def _standing_out(hu: NDArray[np.float32], standing: Standing, least_rods: int) -> _Measured:
    """The spots of those regions that are worth matching."""
    left = np.arange(len(standing.height))
    for _ in range(_CHOICES):
        chosen = left[worth_matching(standing.height[left], standing.noise[left], least_rods)]
        found, known = _centred(hu, standing.regions.take(chosen))
        if known.all():
            break
        # What has no centre is no rod, and says nothing of how bright they are.
        left = np.setdiff1d(left, chosen[~known])
    return found


def _centred(hu: NDArray[np.float32], regions: Regions) -> tuple[_Measured, NDArray[np.bool_]]:
    """The spots of regions, those that have a centre, and which of the regions (n,) do."""
    width, height = regions.extent.T
    wanted = np.maximum(width, height) + 2 * _MARGIN
    which = np.zeros(len(wanted), dtype=bool)
    groups = [np.flatnonzero(np.searchsorted(_SIDES, wanted) == group) for group in range(len(_SIDES))]
    parts = [_measured(hu, regions.take(rows), side) for rows, side in zip(groups, _SIDES, strict=True) if len(rows)]
    if not parts:
        return _Measured(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty((0, 2, 2)), which[:0]), which
    found = _Measured(*(np.concatenate(of_parts) for of_parts in zip(*parts, strict=True)))
    known = np.linalg.eigvalsh(found.covariances_px2)[:, -1] <= _LARGEST_STD_PX**2
    # Of a centre of which rounding has made a variance negative, nothing is known in one direction.
    known &= np.linalg.eigvalsh(found.covariances_px2)[:, 0] > -_ROUNDING_PX2
    which[np.concatenate(groups)[known]] = True
    return found.take(known), which


def _measured(hu: NDArray[np.float32], regions: Regions, side: int) -> _Measured:
    """Spots of the given regions, each looked at in a patch of side x side pixels around it."""
    rows, columns = hu.shape
    corner = regions.first + regions.extent // 2 - side // 2  # (n, 2), u and v of the patch's first pixel
    u, v = corner[:, 0, None] + np.arange(side), corner[:, 1, None] + np.arange(side)
    outside = ((u < 0) | (u >= columns))[:, None, :] | ((v < 0) | (v >= rows))[:, :, None]
    at = np.clip(v, 0, rows - 1)[:, :, None], np.clip(u, 0, columns - 1)[:, None, :]
    patch, labels = hu[at], regions.labels[at]
    own = (labels == regions.label[:, None, None]) & ~outside
    other = (labels != 0) & ~own
    near, clear, far = (_dilated(own, reach) for reach in (_REACH, _RING_INNER, _RING_OUTER))
    shut = _dilated(other, 1) | outside
    level, noise = _surroundings(patch, far & ~clear & ~shut)
    value = patch - level[:, None, None]
    height = np.where(own, value, -np.inf).max(axis=(1, 2))
    # Of the region itself each pixel counts, however low.
    weight = np.where(near & ~other & ~outside, np.maximum(value - _OUTLINE * height[:, None, None], 0.0), 0.0)
    weight += 1e-6 * own
    centre, extent = _moments(weight)
    clipped = own & (patch >= hu.max())
    clipped &= clipped.sum(axis=(1, 2), keepdims=True) >= 3
    found, covariance = centres_of_symmetry(value, centre, extent, shut & ~own, clipped, noise)
    lowest = np.where(own, value, np.inf).min(axis=(1, 2))
    return _Measured(corner + found, covariance, extent, lowest > _CUT_SHORT * height)


def _dilated(masks: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Masks (n, p, p) grown by `reach` pixels; stacked, they are one picture to OpenCV."""
    count, side = masks.shape[:2]
    picture = np.zeros((count, side + reach, side), dtype=np.uint8)
    picture[:, :side] = masks
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    grown = cv2.dilate(picture.reshape(-1, side), kernel).reshape(picture.shape)[:, :side]
    return np.asarray(grown > 0)


def _surroundings(patch: NDArray[np.float32], ring: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Level (n,) HU and noise variance (n,) HU^2 of what is around each spot, both robust; of a spot with nothing
    around it the patch's least value, and no noise.
    """
    count = ring.sum(axis=(1, 2))
    rows, middle = np.arange(len(patch)), np.maximum(count - 1, 0) // 2
    ordered = np.sort(np.where(ring, patch, np.inf).reshape(len(patch), -1), axis=1)
    level = np.where(count > 0, ordered[rows, middle], patch.min(axis=(1, 2)))
    off = np.sort(np.abs(ordered - level[:, None]), axis=1)  # infinite where there is no ring
    noise = np.where(count > 0, off[rows, middle] / _MAD_OF_NORMAL, 0.0)
    return level.astype(np.float64), noise.astype(np.float64) ** 2


def _moments(weight: Array) -> tuple[Array, Array]:
    """Centroids (n, 2) and second moments (n, 2, 2) of weights (n, p, p), in pixel (u, v) of the patch."""
    place = np.arange(weight.shape[1])
    total = weight.sum(axis=(1, 2))
    by_u, by_v = weight.sum(axis=1), weight.sum(axis=2)
    centre = np.stack([by_u @ place, by_v @ place], axis=-1) / total[:, None]
    off_u, off_v = place - centre[:, 0, None], place - centre[:, 1, None]
    moments = np.empty((len(weight), 2, 2))
    moments[:, 0, 0], moments[:, 1, 1] = (by_u * off_u**2).sum(axis=1), (by_v * off_v**2).sum(axis=1)
    moments[:, 0, 1] = moments[:, 1, 0] = ((weight @ off_u[..., None])[..., 0] * off_v).sum(axis=1)
    return centre, moments / total[:, None, None]
