"""Whether poses are as far off as they say: errors in terms of the covariance, and how often a ball holds them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.result import Refusal, Registration

# Targets 100 mm from the frame's origin, in its axes.
_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, -1], [0, -1, 1], [-1, 1, 1]], dtype=float)
TARGETS_MM = 100.0 * _AXES / np.linalg.norm(_AXES, axis=1, keepdims=True)


@dataclass
class PoseStatistics:
    """What came of many slices with known poses.

    squared: the NEES of each accepted pose, chi-square of six degrees of freedom where the covariance is right; held:
    for each of them which targets' errors (7,) were within their ball; refused: how often for what reason.
    """

    squared: list[float] = field(default_factory=list)
    held: list[Array] = field(default_factory=list)
    radii_mm: list[Array] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)

    def add(self, result: Registration | Refusal, scanner_from_frame: Pose) -> None:
        """Count one slice with its true pose."""
        if not result:
            self.refused[result.reason] += 1
            return
        stated = result.scanner_from_frame
        error = pose_error(stated, scanner_from_frame)
        self.squared.append(float(error @ np.linalg.solve(result.covariance, error)))
        radii = np.array([result.estimate.target_error_95_mm(target) for target in TARGETS_MM])
        off = np.linalg.norm(stated @ TARGETS_MM - scanner_from_frame @ TARGETS_MM, axis=1)
        self.held.append(off <= radii)
        self.radii_mm.append(radii)

    def join(self, other: PoseStatistics) -> None:
        """Add the slices of another count."""
        self.squared += other.squared
        self.held += other.held
        self.radii_mm += other.radii_mm
        self.refused += other.refused

    @property
    def accepted(self) -> int:
        """How many slices were accepted."""
        return len(self.squared)

    @property
    def nees(self) -> float:
        """Mean squared error in terms of the stated covariance; 6 where that is right."""
        return float(np.mean(self.squared))

    @property
    def nees_limit(self) -> float:
        """How far from 6 the mean may be by chance, in 95 of 100 such measurements."""
        return 1.96 * math.sqrt(12 / self.accepted)

    @property
    def coverage(self) -> Array:
        """Share of the slices in which the 95 % ball at each target (7,) held the error."""
        return np.asarray(np.mean(self.held, axis=0), dtype=np.float64)


def pose_error(stated: Pose, true: Pose) -> Array:
    """The perturbation (6,) of `Pose.perturbed` that takes the stated pose to the true one, mm and rad."""
    turn = Rotation.from_matrix(true.rotation @ stated.rotation.T).as_rotvec()
    return np.concatenate([true.translation - stated.translation, turn])
