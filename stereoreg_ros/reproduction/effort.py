"""How much is measured: the full report, or one that is done within two minutes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Effort:
    """Sizes of the experiments.

    levels_px: amplitudes of the uniform noise (figs 6 to 9); poses: random poses per level; efficiency_poses: the same
    for the efficiency of maximum likelihood; sequence_slices: slices of fig 10; rail_slices: slices of table 1;
    registrations: runs per row of table 2; clutter: numbers of false spots, its rows; cell_budget_s: seconds that
    the runs of the paper's matching in one cell of table 2 may take together.
    """

    name: str
    levels_px: tuple[float, ...]
    poses: int
    efficiency_poses: int
    sequence_slices: int
    rail_slices: int
    registrations: int
    clutter: tuple[int, ...]
    cell_budget_s: float


# 0.5 pixel is no step of the paper's axis, but the level at which its text gives figures.
_LEVELS_PX: Final = (0.0, 0.2, 0.4, 0.5, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0)

FULL: Final = Effort("full", _LEVELS_PX, 100, 3000, 43, 31, 15, (0, 1, 4, 8, 24), 60.0)
QUICK: Final = Effort("quick", (0.0, 0.5, 1.5), 100, 150, 9, 7, 3, (0, 4), 0.5)
