"""The tables of a frame's triples of rods that seeds are looked up in: slow to make, and kept by whoever matches."""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Final

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.visibility import END_SLACK_MM, LEAST_COSINE
from stereoreg_ros.solvers.three_rods import ThreeRodSolver

# How many triples have their tables kept, of a few megabytes each.
KEPT_TRIPLES: Final = 64


class SeedTables:
    """The tables of one frame, made when they are first asked for; several threads may share them.

    The ones that were used last are kept, of KEPT_TRIPLES triples.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self._solvers = lru_cache(maxsize=KEPT_TRIPLES)(partial(_made, frame))

    def solver(self, rods: tuple[int, int, int], sigma_mm: float) -> ThreeRodSolver:
        """That of three rods, for spots known to sigma_mm."""
        return self._solvers(rods, tolerance_mm(sigma_mm))

    def __len__(self) -> int:
        """For how many triples and tolerances there are tables."""
        return self._solvers.cache_info().currsize


def _made(frame: Frame, rods: tuple[int, int, int], tolerance_mm: float) -> ThreeRodSolver:
    return ThreeRodSolver(frame, rods, tolerance_mm, END_SLACK_MM, LEAST_COSINE)


def tolerance_mm(sigma_mm: float) -> float:
    """How far noise may change a distance between two spots; in steps, so that few tables serve all noises.

    Upwards: spots are known as well as the options say or a little less well, and the tables prepared serve both.
    """
    return math.ceil(10 * (6.0 * sigma_mm + 0.05)) / 10
