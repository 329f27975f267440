"""Whether slices of a frame have twins, as a rule: a second pose that explains all their spots as well."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from threading import Lock
from typing import Final

import numpy as np

from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.consensus import distinct
from stereoreg_ros.matching.level_search import LevelSearch, SearchGivenUpError
from stereoreg_ros.matching.pose_volume import typical_slices
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tables import SeedTables
from stereoreg_ros.matching.tolerances import Tolerances

# How many typical slices are looked at. A twin is a pose of no more than this chi-square, with spots known to
# _LEAST_SIGMA_MM or worse.
_TYPICAL_SLICES: Final = 32
_NEAR_TWIN: Final = 20.0
_LEAST_SIGMA_MM: Final = 0.25
# What a sample is searched with; of exact spots nothing is by chance.
_MIN_INLIERS, _MAX_LOG10_FALSE_ALARMS = 4, -6.0
_KEPT: Final = 64


class TwinSample:
    """Typical slices that show a given number of rods, and whether any of them has a second explanation of them all."""

    def __init__(self, tables: SeedTables, rods: int, sigma_mm: float) -> None:
        self._tables, self._rods, self._sigma_mm = tables, rods, sigma_mm
        self._left = zip(*typical_slices(tables.frame, rods, _TYPICAL_SLICES), strict=True)
        self._rng = np.random.default_rng(0)
        self._looked_at = self._twins = 0
        # One thread may prepare while another one registers.
        self._looking = Lock()

    def any(self) -> bool:
        """Whether a slice was found that has twins; true too where no slice shows that many rods."""
        while not self._twins and self.look_at_next():
            pass
        return self._twins > 0 or not self._looked_at

    def look_at_next(self) -> bool:
        """Look at one more slice; False where none is left."""
        with self._looking:
            try:
                rotation, translation, seen = next(self._left)
            except StopIteration:
                return False
            frame = self._tables.frame
            shown = self._rng.permutation(np.flatnonzero(seen))[: self._rods]
            points_mm = cut(frame, rotation, translation).points_mm[shown]
            noise_mm2 = np.tile(self._sigma_mm**2 * np.eye(2), (self._rods, 1, 1))
            spots = Spots.of(points_mm, noise_mm2, None, Tolerances.none(frame))
            prior = Prior(np.eye(3), math.pi)
            search = LevelSearch(Problem(spots, frame, prior, _MIN_INLIERS, _MAX_LOG10_FALSE_ALARMS), self._tables)
            self._looked_at += 1
            try:
                near = [one for one in search.level(self._rods, math.inf, []) if one.chi_square < _NEAR_TWIN]
                self._twins += len(distinct(near, spots.gains(frame))) > 1
            except SearchGivenUpError:
                self._twins += 1  # For all that is known.
            return True


class Twins:
    """What is known of a frame's twins, by the number of rods that a slice shows and how well its spots are known."""

    def __init__(self, tables: SeedTables) -> None:
        self._samples = lru_cache(maxsize=_KEPT)(partial(TwinSample, tables))

    def exist(self, rods: int, sigma_mm: float) -> bool:
        """Whether any of a sample of slices that show `rods` rods has a twin, with spots known to sigma_mm.

        The distances between k spots set 2k - 3 conditions to the six numbers of two slices that show the same: four
        spots have twins, and five near ones. From six on few slices have them, unless the frame is nearly symmetric.
        """
        return self.sample(rods, sigma_mm).any()

    def sample(self, rods: int, sigma_mm: float) -> TwinSample:
        """That of spots known so well or less; in steps, so that few are made."""
        return self._samples(rods, max(2.0 ** math.ceil(math.log2(sigma_mm)), _LEAST_SIGMA_MM))
