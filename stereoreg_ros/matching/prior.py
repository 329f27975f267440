"""What is known of the pose before the slice is looked at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array, rotation_angle

# Angle beyond the allowed rotation at which a seed, which is not yet refined, is dropped.
_SEED_SLACK = float(np.radians(10.0))


@dataclass(frozen=True, eq=False)
class Near:
    """Where the frame roughly is.

    translation: (3,) mm, of slice_from_frame; reach_mm: how far from where this has a rod cut the slice its spot may
    be; spots_of_line: (n, s), the spots within reach of each rod.
    """

    translation: Array
    reach_mm: float
    spots_of_line: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Prior:
    """Poses that are sought.

    rotation: (3, 3), slice_from_frame as it roughly is; max_rotation: greatest angle from it, rad. near: None, or where
    the frame roughly is.
    """

    rotation: Array
    max_rotation: float
    near: Near | None = None

    @property
    def normal(self) -> Array:
        """The slice's normal in the frame, (3,), at the rough rotation."""
        normal: Array = self.rotation[2]
        return normal

    @property
    def seed_angle(self) -> float:
        """Greatest angle of a seed, which is not yet refined, rad."""
        return self.max_rotation + _SEED_SLACK

    def turns(self, normals: Array) -> Array:
        """Room (p,), in rad, for a slice to turn about its normal, where that is one of these (p, 3) in the frame."""
        if self.max_rotation >= np.pi:
            return np.full(len(normals), 2 * np.pi)
        # Of all rotations to that normal the nearest one is a pure tilt; one that is turned on by psi is at an angle
        # whose half has the cosine cos(tilt / 2) cos(psi / 2).
        half_tilt = np.cos(np.arccos(np.clip(normals @ self.normal, -1.0, 1.0)) / 2)
        ratio = np.cos(self.max_rotation / 2) / np.maximum(half_tilt, 1e-12)
        turns: Array = 4 * np.arccos(np.minimum(ratio, 1.0))
        return turns

    def only(self, rows: NDArray[np.intp]) -> Prior:
        """The same for some of the spots."""
        if self.near is None:
            return self
        return replace(self, near=replace(self.near, spots_of_line=self.near.spots_of_line[:, rows]))

    def angles(self, rotations: Array) -> Array:
        """Angles (...) in rad of rotations (..., 3, 3) from the rough one."""
        return rotation_angle(rotations @ self.rotation.T)
