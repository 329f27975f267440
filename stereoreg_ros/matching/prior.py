"""What is known of the pose before the slice is looked at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array, rotation_angle

# Angle beyond the allowed rotation at which a seed, which is not yet refined, is dropped.
_SEED_SLACK = float(np.radians(10.0))


@dataclass(frozen=True, eq=False)
class Prior:
    """Poses that are sought.

    rotation: (3, 3), slice_from_frame as it roughly is; max_rotation: greatest angle from it, rad. spots_of_line:
    (n, s), the spots that each rod may have; None: any.
    """

    rotation: Array
    max_rotation: float
    spots_of_line: NDArray[np.bool_] | None = None

    @property
    def normal(self) -> Array:
        """The slice's normal in the frame, (3,), at the rough rotation."""
        normal: Array = self.rotation[2]
        return normal

    @property
    def seed_angle(self) -> float:
        """Greatest angle of a seed, which is not yet refined, rad."""
        return self.max_rotation + _SEED_SLACK

    def only(self, rows: NDArray[np.intp]) -> Prior:
        """The same for some of the spots."""
        allowed = None if self.spots_of_line is None else self.spots_of_line[:, rows]
        return replace(self, spots_of_line=allowed)

    def angles(self, rotations: Array) -> Array:
        """Angles (...) in rad of rotations (..., 3, 3) from the rough one."""
        return rotation_angle(rotations @ self.rotation.T)
