"""Slice -> spots: bright components of rod size and their centres."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.options import RegistrationOptions

# A spot's outline lies at this height between its surroundings and its peak. Lower would take in more of the spot, and
# more of what stands beside it; in rendered slices the centre is then good to 0.02 pixel, against 0.08 for the centroid
# above a threshold of 2000 HU.
_OUTLINE: Final = 1 / 3


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), dtype=np.uint8)


# In pixels around a component above the threshold: how far its spot may reach, and the ring of its surroundings.
_REACH: Final = 2
_SPOT, _RING_INNER, _RING_OUTER = _disc(_REACH), _disc(_REACH + 1), _disc(_REACH + 3)
_MARGIN: Final = _REACH + 4


def find_spots(ct_slice: Slice, options: RegistrationOptions) -> Array:
    """Centres (n, 2) in pixel (u, v) of the bright spots, from top to bottom of the slice.

    Pixels above `threshold` form 8-connected components (Maurin 2009, section 6.3); those of an area within
    [min_spot_area_mm2, max_spot_area_mm2] that do not touch the image's edge are spots. A centre is the centroid
    weighted by what each pixel has above the spot's outline, which follows the spot's own contrast, not the threshold.
    """
    hu = ct_slice.hu
    above = hu > options.threshold
    _, labels, stats, _ = cv2.connectedComponentsWithStats(above.view(np.uint8), connectivity=8)
    area_mm2 = stats[:, cv2.CC_STAT_AREA] * (ct_slice.scale.sx * ct_slice.scale.sy)
    keep = (area_mm2 >= options.min_spot_area_mm2) & (area_mm2 <= options.max_spot_area_mm2)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    keep &= (left > 0) & (top > 0) & (right < hu.shape[1]) & (bottom < hu.shape[0])
    keep[0] = False  # label 0 is the background
    centres = np.empty((int(keep.sum()), 2))
    for row, label in enumerate(np.flatnonzero(keep)):
        first = np.array([max(left[label] - _MARGIN, 0), max(top[label] - _MARGIN, 0)])
        patch = np.s_[first[1] : bottom[label] + _MARGIN, first[0] : right[label] + _MARGIN]
        centres[row] = first + _centre(hu[patch], labels[patch], int(label), options.threshold)
    return centres


def _centre(hu: NDArray[np.float32], labels: NDArray[np.generic], label: int, threshold: float) -> Array:
    """Centre (2,) in pixel (u, v) of one component within a patch of the slice."""
    component = (labels == label).astype(np.uint8)
    ring = cv2.dilate(component, _RING_OUTER) > cv2.dilate(component, _RING_INNER)
    surroundings = float(np.median(hu[ring])) if ring.any() else threshold
    peak = float(hu[component > 0].max())
    # Never above the threshold, or pixels that are part of the component would count for nothing.
    outline = min(surroundings + _OUTLINE * (peak - surroundings), threshold)
    own = (cv2.dilate(component, _SPOT) > 0) & ((labels == label) | (labels == 0))
    weight = np.where(own, np.maximum(hu - outline, 0.0), 0.0).astype(np.float64)
    total = weight.sum()
    columns, rows = weight.sum(axis=0), weight.sum(axis=1)
    centre: Array = np.array([columns @ np.arange(len(columns)), rows @ np.arange(len(rows))]) / total
    return centre
