"""From three distances between spots to the cells of three rods' positions that can have them."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

# Bins of the table along each of the three distances.
_BINS: Final = 40


class DistanceTable(NamedTuple):
    """Bins over three distances, each with the cells that can have them.

    low, high (3,): outside of which no cell has a distance, mm; size (3,): of a bin, mm; start: where each bin's cells
    start in `cell`, and where the last one's end.
    """

    low: Array
    high: Array
    size: Array
    start: NDArray[np.intp]
    cell: NDArray[np.intp]

    @classmethod
    def of(cls, cells: NDArray[np.intp], nearest: Array, farthest: Array) -> DistanceTable:
        """The table of cells (c,) with the least and greatest of their three distances (c, 3) mm."""
        if not cells.size:
            return cls(np.full(3, np.inf), np.full(3, -np.inf), np.ones(3), np.zeros(1, dtype=np.intp), cells)
        low, high = nearest.min(axis=0), farthest.max(axis=0)
        size = np.maximum((high - low) / (_BINS - 1), 1e-6)
        first, last = ((nearest - low) / size).astype(np.intp), ((farthest - low) / size).astype(np.intp)
        extent = last - first + 1
        count = extent.prod(axis=1)
        row, rank = _enumerated(count)
        x = first[row, 0] + rank % extent[row, 0]
        y = first[row, 1] + rank // extent[row, 0] % extent[row, 1]
        z = first[row, 2] + rank // (extent[row, 0] * extent[row, 1])
        flat = (x * _BINS + y) * _BINS + z
        order = np.argsort(flat, kind="stable")
        return cls(low, high, size, np.searchsorted(flat[order], np.arange(_BINS**3 + 1)), cells[row[order]])

    def look_up(self, distances: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows of triples and of cells that share a bin; distances: (3, t) mm."""
        possible = np.ones(len(distances[0]), dtype=bool)
        for distance, low, high in zip(distances, self.low.tolist(), self.high.tolist(), strict=True):
            possible &= (distance >= low) & (distance <= high)
        rows = np.flatnonzero(possible)
        x, y, z = (
            ((distance[rows] - low) / size).astype(np.intp)
            for distance, low, size in zip(distances, self.low.tolist(), self.size.tolist(), strict=True)
        )
        flat = (x * _BINS + y) * _BINS + z
        start = self.start[flat]
        row, rank = _enumerated(self.start[flat + 1] - start)
        return rows[row], self.cell[start[row] + rank]


def _enumerated(count: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For counts 2, 0, 3: rows 0 0 2 2 2 and ranks 0 1 0 1 2."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) - (np.cumsum(count) - count)[row]
