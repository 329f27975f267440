"""When a pose counts as wrong, and when its error is within what it states."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stereoreg_ros import Pose, Registration
from stereoreg_ros.geometry.pose import rotation_angle

WRONG_MM, WRONG_DEG = 2.0, 3.0
# Squared Mahalanobis distance of six degrees of freedom that chance exceeds once in 1e5.
STATED = 34.0


def is_wrong(found: Pose, truth: Pose) -> bool:
    """Whether a pose is off by more than WRONG_MM or WRONG_DEG."""
    turn = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
    return bool(np.linalg.norm(found.translation - truth.translation) > WRONG_MM or turn > WRONG_DEG)


def is_covered(result: Registration, truth: Pose) -> bool:
    """Whether the error is within what the registration states: chance alone exceeds it once in 1e5."""
    error = np.append(
        result.scanner_from_frame.translation - truth.translation,
        Rotation.from_matrix(result.scanner_from_frame.rotation @ truth.rotation.T).as_rotvec(),
    )
    return float(error @ np.linalg.solve(result.covariance, error)) < STATED
