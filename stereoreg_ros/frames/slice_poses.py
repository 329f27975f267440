"""The poses in which a slice can meet a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp

# Where the frame's middle is in the slice, mm. It matters only to the error of the scale, which moves the frame as a
# whole by its share of the distance from pixel (0, 0).
MIDDLE_MM = (120.0, 120.0)


@dataclass(frozen=True, eq=False)
class SlicePoses:
    """p poses slice_from_frame: rotations (p, 3, 3), translations (p, 3) mm; and how they came about.

    tilts_deg: (p,), between the slice's normal and the frame's z axis as it nominally stands; heights_mm: (p,), of the
    slice above the frame's middle, along the slice's normal.
    """

    rotations: Array
    translations: Array
    tilts_deg: Array
    heights_mm: Array

    def __len__(self) -> int:
        return len(self.rotations)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> SlicePoses:
        """Some of them."""
        return SlicePoses(self.rotations[rows], self.translations[rows], self.tilts_deg[rows], self.heights_mm[rows])

    def pose(self, row: int) -> Pose:
        """slice_from_frame of one of them."""
        return Pose(self.rotations[row], self.translations[row])


def slice_poses(
    count: int,
    seed: int,
    middle_mm: Array,
    heights_mm: Array,
    largest_tilt_deg: float,
    nominal: Array | None = None,
    max_rotation_deg: float = 180.0,
) -> SlicePoses:
    """`count` poses spread evenly (Sobol) over tilts up to `largest_tilt_deg`, turns about the normal, and heights.

    middle_mm: (3,), the frame's middle; heights_mm: (2,), from where to where the slice lies above it; nominal:
    slice_from_frame's nominal rotation (3, 3), by default the identity; max_rotation_deg: largest angle between the
    rotation and the nominal one, which limits tilt and turn.
    """
    from scipy.stats import qmc  # takes 0.4 s, which whoever asks for help need not wait

    exponent = max(0, math.ceil(math.log2(count)))
    shares = qmc.Sobol(4, seed=np.random.default_rng(seed)).random_base2(exponent)[:count]
    # Tilts spread over the sphere's cap, so that no direction of the normal is met more often than another.
    cap = math.cos(math.radians(min(largest_tilt_deg, max_rotation_deg, 180.0)))
    tilt = np.arccos(1 - shares[:, 0] * (1 - cap))
    azimuth = 2 * np.pi * shares[:, 1]
    # A tilt and a turn about the normal make cos(angle / 2) = cos(tilt / 2) cos(turn / 2) together.
    cosine = math.cos(math.radians(min(max_rotation_deg, 180.0)) / 2) / np.maximum(np.cos(tilt / 2), 1e-9)
    turn = (2 * shares[:, 2] - 1) * 2 * np.arccos(np.clip(cosine, 0.0, 1.0))
    tilted = rotation_exp(tilt[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)]))
    turned = rotation_exp(turn[:, None] * np.array([0.0, 0.0, 1.0]))
    rotations = turned @ tilted @ (np.eye(3) if nominal is None else nominal)
    heights = heights_mm[0] + shares[:, 3] * (heights_mm[1] - heights_mm[0])
    translations = np.column_stack([np.tile(MIDDLE_MM, (count, 1)), -heights]) - rotations @ middle_mm
    return SlicePoses(rotations, translations, np.degrees(tilt), heights)
