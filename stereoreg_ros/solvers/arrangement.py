"""Arrangements of rods and spots that fix no pose or no scale (Maurin 2009, section 3.1), by their names."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array

# Condition numbers from which three rods count as coplanar, three spots as collinear, directions as fewer than three.
COPLANAR, COLLINEAR, DIRECTIONS = 200.0, 200.0, 200.0


@dataclass(frozen=True)
class Arrangement:
    """A degenerate arrangement: its name, who is in it (rows of lines or spots), the condition number that decided."""

    name: str
    members: tuple[int, ...]
    condition: float

    def __str__(self) -> str:
        return f"{self.name} {list(self.members)} (condition number {self.condition:.3g})"


class DegenerateArrangementError(ValueError):
    """Rods and spots from which nothing follows.

    names: which arrangements of section 3.1 were found, or `too_few_lines`, or `ill_conditioned` where it is none of
    these; condition: condition number of the system that was to be solved.
    """

    def __init__(self, arrangements: list[Arrangement], condition: float) -> None:
        by_name: dict[str, list[Arrangement]] = {}
        for one in arrangements:
            by_name.setdefault(one.name, []).append(one)
        self.names = tuple(by_name) or ("ill_conditioned",)
        self.condition = condition
        listed = [
            str(alike[0]) + (f" and {len(alike) - 1} more" if len(alike) > 1 else "") for alike in by_name.values()
        ]
        found = "; ".join(listed) or "no arrangement of section 3.1"
        super().__init__(f"degenerate: {found}; the system has condition number {condition:.3g}")


def three_coplanar_lines(frame: Frame, lines: NDArray[np.intp]) -> list[Arrangement]:
    """Triples of the given rods that lie in one plane: their three spots are collinear in every slice.

    The condition number is that of the six ends about their centroid: longest over shortest extent.
    """
    found = []
    for triple in combinations(range(len(lines)), 3):
        rows = lines[list(triple)]
        condition = _condition(np.concatenate([frame.starts[rows], frame.ends[rows]]), 3)
        if condition > COPLANAR:
            found.append(Arrangement("three_coplanar_lines", tuple(int(row) for row in rows), condition))
    return found


def three_collinear_spots(spots: Array) -> list[Arrangement]:
    """Triples of spots (n, 2) on one line; the condition number is that of the three about their centroid."""
    found = []
    for triple in combinations(range(len(spots)), 3):
        condition = _condition(spots[list(triple)], 2)
        if condition > COLLINEAR:
            found.append(Arrangement("three_collinear_spots", triple, condition))
    return found


def fewer_than_three_directions(frame: Frame, lines: NDArray[np.intp]) -> list[Arrangement]:
    """All the given rods, where their directions do not span space: the matrices [y]x are linearly dependent.

    The condition number is that of the matrix of directions.
    """
    values = np.linalg.svd(frame.directions[lines], compute_uv=False)
    condition = _ratio(values[0], values[2] if len(values) > 2 else 0.0)
    if condition > DIRECTIONS:
        return [Arrangement("fewer_than_three_directions", tuple(int(row) for row in lines), condition)]
    return []


def degenerate_arrangements(frame: Frame, lines: NDArray[np.intp], spots: Array) -> list[Arrangement]:
    """Every arrangement of section 3.1 found among the given rods and their spots."""
    return [
        *three_coplanar_lines(frame, lines),
        *three_collinear_spots(spots),
        *fewer_than_three_directions(frame, lines),
    ]


def _condition(points: Array, dimensions: int) -> float:
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return _ratio(values[0], values[dimensions - 1])


def _ratio(largest: float, smallest: float) -> float:
    return float(largest / smallest) if smallest > 1e-300 else float("inf")
