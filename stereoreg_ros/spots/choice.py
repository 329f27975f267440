"""Which of the things that stand out of a slice are worth matching, where no threshold says so."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

# Standard deviations of the smoothed noise from which on a spot is sure. A fixed threshold half way up to one that is
# fainter shows noise, too.
_SURE: Final = 15.0
# The rods of a frame are alike; one that leans is spread over more pixels, and fainter, but not below this share.
_FAINTEST: Final = 0.3
# So many spots are matched at ease.
_FEW: Final = 32
# Of more, what is fainter by this factor than the next brighter one is another kind of thing.
_GAP: Final = 1.5


def worth_matching(height: Array, noise: Array, least_rods: int) -> NDArray[np.bool_]:
    """Which spots (n,) to match, by the heights (n,) at which they stand out and the noise (n,) around them, HU.

    All that are sure, and of the others those about as bright as the `least_rods` brightest. Where these are more than
    a few: of the sure ones whole kinds, the brightest first, as many as make a few, or the first kind where that alone
    is more; of all, the few brightest where fewer than `least_rods` are sure.
    """
    chosen = np.zeros(len(height), dtype=bool)
    if not len(height):
        return chosen
    order = np.argsort(-height, kind="stable")
    ranked, sure = height[order], (height >= _SURE * noise)[order]
    keep = sure | (ranked >= _FAINTEST * ranked[min(least_rods, len(ranked)) - 1])
    if keep.sum() > _FEW:
        if sure.sum() >= least_rods:
            keep = sure & (ranked >= _faintest_kind(ranked[sure], least_rods))
        else:
            keep = np.arange(len(ranked)) < _FEW
    chosen[order[keep]] = True
    return chosen


def _faintest_kind(bright: Array, least_rods: int) -> float:
    """The faintest height that is kept of such (n,), the brightest first."""
    if len(bright) <= _FEW:
        return 0.0
    ends = np.flatnonzero(bright[least_rods - 1 : _FEW] >= _GAP * bright[least_rods : _FEW + 1]) + least_rods
    return float(bright[ends[-1] - 1] if len(ends) else _FAINTEST * bright[min(least_rods, len(bright)) - 1])
