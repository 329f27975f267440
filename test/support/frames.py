"""Frames and poses drawn at random, shared by the tests of the core."""

from __future__ import annotations

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import cut

# Sine of the least angle between two rods, and the least distance in mm between two rods' ends in one face.
_LEAST_SINE = 0.08
_LEAST_DISTANCE = 8.0


def cube_by_hand() -> Frame:
    """Six rods in a cube of 60 mm, all from the lower face to the upper one; no three coplanar, no two parallel."""
    lower = np.array([[5, 10], [30, -30], [-20, 20], [25, -25], [-30, 30], [30, 30]])
    upper = np.array([[30, 30], [30, 20], [-30, -30], [-25, -25], [0, 10], [-20, 25]])
    starts, ends = (np.column_stack([face, np.full(6, z)]).astype(float) for face, z in ((lower, -30), (upper, 30)))
    return Frame("by_hand", tuple("abcdef"), starts, ends, np.ones(6))


def random_frame(rng: np.random.Generator, n: int) -> Frame:
    """A frame of `n` rods from the lower to the upper face of a cube of 60 mm about its origin, no two parallel."""
    starts: list[Array] = []
    ends: list[Array] = []
    directions: list[Array] = []
    while len(starts) < n:
        start, end = np.append(rng.uniform(-30, 30, 2), -30.0), np.append(rng.uniform(-30, 30, 2), 30.0)
        direction = (end - start) / np.linalg.norm(end - start)
        apart = all(np.linalg.norm(np.cross(direction, other)) > _LEAST_SINE for other in directions)
        apart = apart and all(np.linalg.norm(start - other) > _LEAST_DISTANCE for other in starts)
        if apart and all(np.linalg.norm(end - other) > _LEAST_DISTANCE for other in ends):
            starts.append(start)
            ends.append(end)
            directions.append(direction)
    return Frame("random", tuple(f"rod{i}" for i in range(n)), np.array(starts), np.array(ends), np.ones(n))


def random_slice_from_frame(rng: np.random.Generator, frame: Frame, max_tilt_deg: float = 20.0) -> Pose:
    """A pose in which the slice cuts every rod of a frame about its origin, turned at will about the slice's normal."""
    for _ in range(1000):
        axis = rng.normal(size=3)
        tilt = rotation_exp(np.radians(rng.uniform(0, max_tilt_deg)) * axis / np.linalg.norm(axis))
        turn = rotation_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        pose = Pose(tilt @ turn, np.array([*rng.uniform(80, 160, 2), rng.uniform(-10, 10)]))
        if cut(frame, pose.rotation, pose.translation).inside.all():
            return pose
    raise AssertionError(f"no slice found that cuts every rod of frame '{frame.name}'")
