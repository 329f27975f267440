"""The stereotactic frame: straight rods of finite length, as bounded Pluecker lines.

Axes are right-handed. That they are not cannot be seen from one slice, which fits a mirrored frame just as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array

MIN_LINES = 3


@dataclass(frozen=True, eq=False)
class Frame:
    """Rods of a stereotactic frame, in the frame's own axes (Maurin 2009, section 2.2).

    name: the frame's name; line_names: n distinct names; starts, ends: (n, 3) in mm, the rods' ends;
    diameters: (n,) in mm. tolerances_mm: (n,), standard deviation per axis of each rod's ends, NaN where it is not
    known, which is the default. orientation_required: whether the frame must not be registered without a nominal
    orientation, as symmetric ones.

    Derived, each with one row a rod: directions y (n, 3), unit; origins o (n, 3) mm, the line's point nearest
    the frame's origin; moments w = y x o (n, 3) mm, the Pluecker moment in the paper's order, so that
    y x p = w for every p on the line; lambda_min, lambda_max (n,) mm, the rod's ends as positions along y from o.

    Frames that say the same are equal, also where they were loaded twice.

    Raises ValueError on fewer than three rods, names that repeat, ends that coincide or are not finite, and tolerances
    that are negative or infinite.
    """

    name: str
    line_names: tuple[str, ...]
    starts: Array
    ends: Array
    diameters: Array
    tolerances_mm: Array | None = None
    orientation_required: bool = False
    directions: Array = field(init=False)
    origins: Array = field(init=False)
    moments: Array = field(init=False)
    lambda_min: Array = field(init=False)
    lambda_max: Array = field(init=False)
    _said: tuple[object, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names = tuple(self.line_names)
        starts = np.array(self.starts, dtype=np.float64)
        ends = np.array(self.ends, dtype=np.float64)
        diameters = np.array(self.diameters, dtype=np.float64)
        n = len(names)
        given = self.tolerances_mm
        tolerances = np.full(n, np.nan) if given is None else np.array(given, dtype=np.float64)
        if n < MIN_LINES:
            raise ValueError(f"frame '{self.name}' has {n} lines, expected at least {MIN_LINES}")
        for label, array, shape in (
            ("starts", starts, (n, 3)),
            ("ends", ends, (n, 3)),
            ("diameters", diameters, (n,)),
            ("tolerances_mm", tolerances, (n,)),
        ):
            if array.shape != shape:
                raise ValueError(f"frame '{self.name}': {label} has shape {array.shape}, expected {shape}")
            if array is not tolerances and not np.isfinite(array).all():
                raise ValueError(f"frame '{self.name}': {label} must be finite")
        if len(set(names)) != n:
            repeated = sorted({name for name in names if names.count(name) > 1})
            raise ValueError(f"frame '{self.name}' names lines twice: {', '.join(repeated)}")
        if (diameters <= 0).any():
            raise ValueError(f"frame '{self.name}': diameters must be positive, found {diameters.min():g}")
        unusable = np.flatnonzero((tolerances < 0) | np.isinf(tolerances))
        if unusable.size:
            line, found = names[int(unusable[0])], tolerances[unusable[0]]
            raise ValueError(
                f"frame '{self.name}': line '{line}' has tolerance {found:g}, expected 0 mm or more, finite, or NaN"
            )
        span = ends - starts
        length = np.linalg.norm(span, axis=1)
        if (length < 1e-6).any():
            raise ValueError(f"frame '{self.name}': line '{names[int(length.argmin())]}' has no length")
        directions = span / length[:, None]
        lambda_min = np.einsum("ij,ij->i", directions, starts)
        origins = starts - lambda_min[:, None] * directions
        derived = {
            "line_names": names,
            "starts": starts,
            "ends": ends,
            "diameters": diameters,
            "tolerances_mm": tolerances,
            "directions": directions,
            "origins": origins,
            "moments": np.cross(directions, origins),
            "lambda_min": lambda_min,
            "lambda_max": lambda_min + length,
        }
        for key, value in derived.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, key, value)
        arrays = (starts, ends, diameters, tolerances)
        said = (self.name, names, *(array.tobytes() for array in arrays), self.orientation_required)
        object.__setattr__(self, "_said", said)

    def __eq__(self, other: object) -> bool:
        return self._said == other._said if isinstance(other, Frame) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._said)

    def __len__(self) -> int:
        return len(self.line_names)

    def tolerances_or(self, default_mm: float) -> Array:
        """Standard deviations (n,) per axis of the rods' ends, mm; `default_mm` for rods of unknown tolerance."""
        known: Array = np.where(np.isnan(self._tolerances), default_mm, self._tolerances)
        return known

    @property
    def _tolerances(self) -> Array:
        return np.asarray(self.tolerances_mm, dtype=np.float64)

    def points(self, lines: NDArray[np.intp] | Sequence[int] | slice, lambdas: Array) -> Array:
        """Points (..., 3) in mm at positions `lambdas` (...) along the chosen lines."""
        points: Array = self.origins[lines] + np.asarray(lambdas)[..., None] * self.directions[lines]
        return points
