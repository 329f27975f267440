"""What every pose solver returns, and how every one is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle
from stereoreg_ros.geometry.slice import PixelScale


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """One pose: frame_from_slice in mm, the paper's (R, t).

    converged, iterations: of the iterative methods; true and 0 for the closed forms.
    """

    frame_from_slice: Pose
    converged: bool = True
    iterations: int = 0


def is_same(one: PoseSolution, other: PoseSolution, within_mm: float = 1e-6, within_rad: float = 1e-6) -> bool:
    """Whether two solutions are one, found from different starts: no further apart than the solver's precision."""
    p, q = one.frame_from_slice, other.frame_from_slice
    near = np.linalg.norm(p.translation - q.translation) < within_mm
    return bool(near and rotation_angle(p.rotation @ q.rotation.T) < within_rad)


# (frame, lines (n,), spots (n, 2) in pixel, scale) -> solutions, best first, maybe none.
PoseSolver: TypeAlias = Callable[[Frame, NDArray[np.intp], Array, PixelScale], list[PoseSolution]]
