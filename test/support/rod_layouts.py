"""Frames for measurements: rods drawn at random in a cube, the layout kept in which the pose is best determined."""

from __future__ import annotations

import math

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.simulation import ScannerSettings, random_pose
from stereoreg_ros.uncertainty import cramer_rao_pose

_HALF_MM = 30.0
_LEAST_GAP_MM, _LEAST_ANGLE_DEG = 8.0, 12.0
_POSES = 12


def well_conditioned_frame(rods: int, layouts: int = 60, seed: int = 0) -> Frame:
    """The best of `layouts` random ones: `rods` rods from the lower to the upper face of a cube of 60 mm.

    Judged by the largest standard deviation of a point 100 mm from the origin over a dozen random poses, 1 pixel noise.
    """
    rng = np.random.default_rng(seed)
    drawn = (_draw(rng, rods) for _ in range(layouts))
    return min((frame for frame in drawn if frame is not None), key=weakness)


def random_rods(rng: np.random.Generator, lines: int) -> Frame:
    """Rods from the lower to the upper face of a cube of 60 mm, no two within 8 mm at an end."""
    ends: list[Array] = []
    while len(ends) < lines:
        drawn = rng.uniform(-30, 30, (2, 2))
        if all((np.linalg.norm(drawn - other, axis=1) > 8.0).all() for other in ends):
            ends.append(drawn)
    both = np.array(ends)
    low, high = np.full((lines, 1), -30.0), np.full((lines, 1), 30.0)
    names = tuple(f"r{k}" for k in range(lines))
    return Frame("random", names, np.hstack([both[:, 0], low]), np.hstack([both[:, 1], high]), np.ones(lines))


def best_subset(frame: Frame, subsets: list[tuple[int, ...]]) -> Frame:
    """The frame with only those of its rods, of the subsets given, that determine the pose best."""
    return min((subset(frame, rods) for rods in subsets), key=weakness)


def subset(frame: Frame, rods: tuple[int, ...]) -> Frame:
    """The frame with the given rods (rows) only."""
    rows = list(rods)
    names = tuple(frame.line_names[row] for row in rows)
    return Frame(f"{frame.name}, {len(rows)} rods", names, frame.starts[rows], frame.ends[rows], frame.diameters[rows])


def weakness(frame: Frame) -> float:
    """Largest standard deviation in mm, over random poses, of a point 100 mm from the origin, for 1 pixel of noise."""
    rng, scanner = np.random.default_rng(1), ScannerSettings()
    largest = 0.0
    for _ in range(_POSES):
        try:
            pose = random_pose(rng, frame, scanner)
        except ValueError:
            return math.inf
        covariance = cramer_rao_pose(frame, np.arange(len(frame)), pose, scanner.scale, 1.0)
        position, turn = np.linalg.eigvalsh(covariance[:3, :3])[-1], np.linalg.eigvalsh(covariance[3:, 3:])[-1]
        largest = max(largest, math.sqrt(position + 100.0**2 * turn))
    return largest


def _draw(rng: np.random.Generator, rods: int) -> Frame | None:
    """One layout; None where the rods cannot be placed apart."""
    starts: list[Array] = []
    ends: list[Array] = []
    for _ in range(400):
        start, end = (np.array([*rng.uniform(-_HALF_MM, _HALF_MM, 2), z]) for z in (-_HALF_MM, _HALF_MM))
        if all(_apart(start, end, a, b) for a, b in zip(starts, ends, strict=True)):
            starts.append(start)
            ends.append(end)
        if len(starts) == rods:
            names = tuple(f"rod{number}" for number in range(rods))
            return Frame(f"{rods} rods", names, np.array(starts), np.array(ends), np.ones(rods))
    return None


def _apart(start: Array, end: Array, other_start: Array, other_end: Array) -> bool:
    """Whether two rods are far enough from each other at every height, and lean in different ways."""
    heights = np.linspace(0.0, 1.0, 25)[:, None]
    gap = np.linalg.norm(
        (start + heights * (end - start)) - (other_start + heights * (other_end - other_start)), axis=1
    )
    a, b = end - start, other_end - other_start
    cosine = abs(float(a @ b)) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return bool(gap.min() >= _LEAST_GAP_MM and cosine <= math.cos(math.radians(_LEAST_ANGLE_DEG)))
