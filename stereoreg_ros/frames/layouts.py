"""Many layouts of rods at once, and whether they can be built."""

from __future__ import annotations

import string
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array


@dataclass(frozen=True, eq=False)
class Layouts:
    """s layouts of n rods, for `cut` with p poses: the derived arrays have an axis of length one for the poses.

    starts, ends: (s, n, 3) mm; diameters: (n,) mm; tolerances_mm: (n,), NaN where not known, as of a drawing.
    directions, origins: (s, 1, n, 3); lambda_min, lambda_max: (s, 1, n); all as in `Frame`.
    """

    starts: Array
    ends: Array
    diameters: Array
    tolerances_mm: Array | None = None
    directions: Array = field(init=False)
    origins: Array = field(init=False)
    lambda_min: Array = field(init=False)
    lambda_max: Array = field(init=False)

    def __post_init__(self) -> None:
        span = self.ends - self.starts
        length = np.linalg.norm(span, axis=-1)
        directions = span / length[..., None]
        lambda_min = np.einsum("sni,sni->sn", directions, self.starts)
        unknown = np.full(len(self.diameters), np.nan)
        derived = {
            "tolerances_mm": unknown if self.tolerances_mm is None else self.tolerances_mm,
            "directions": directions[:, None],
            "origins": (self.starts - lambda_min[..., None] * directions)[:, None],
            "lambda_min": lambda_min[:, None],
            "lambda_max": (lambda_min + length)[:, None],
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.starts)

    def tolerances_or(self, default_mm: float) -> Array:
        """Standard deviations (n,) per axis of the rods' ends, mm; `default_mm` for rods of unknown tolerance."""
        tolerances = np.asarray(self.tolerances_mm, dtype=np.float64)
        known: Array = np.where(np.isnan(tolerances), default_mm, tolerances)
        return known

    @classmethod
    def of(cls, frame: Frame) -> Layouts:
        """The one layout of a frame."""
        return cls(frame.starts[None], frame.ends[None], frame.diameters, frame.tolerances_mm)

    def frame(self, row: int, name: str) -> Frame:
        """One of the layouts as a frame; its rods are called a, b, c, ..."""
        n = len(self.diameters)
        names = string.ascii_lowercase[:n] if n <= len(string.ascii_lowercase) else [f"r{i}" for i in range(n)]
        return Frame(name, tuple(names), self.starts[row], self.ends[row], self.diameters, self.tolerances_mm)


@dataclass(frozen=True)
class Envelope:
    """The box that the rods run through from the lower face to the upper one, centred at the frame's origin.

    size_mm: along x, y, z; gap_mm: least distance between the surfaces of two rods.
    Raises ValueError, naming the field, what was found and what was expected.
    """

    size_mm: tuple[float, float, float]
    gap_mm: float = 3.0

    def __post_init__(self) -> None:
        size = tuple(float(length) for length in self.size_mm)
        if len(size) != 3 or not all(np.isfinite(length) and 1.0 <= length <= 2000.0 for length in size):
            raise ValueError(f"envelope is {self.size_mm!r}, expected three lengths from 1 to 2000 mm")
        if not (np.isfinite(self.gap_mm) and 0 <= self.gap_mm <= min(size)):
            raise ValueError(f"gap is {self.gap_mm!r}, expected from 0 mm to the envelope's shortest side")
        object.__setattr__(self, "size_mm", size)

    def layouts(self, corners: Array, diameters: ArrayLike) -> Layouts:
        """Layouts whose rods end inside the envelope's faces, from numbers (s, 4 n) between 0 and 1.

        Four numbers a rod: x, y on the lower face, x, y on the upper one, as a share of what the rod's radius leaves.
        """
        diameters = np.asarray(diameters, dtype=np.float64)
        n = len(diameters)
        size = np.array(self.size_mm)
        share = corners.reshape(len(corners), n, 2, 2) - 0.5
        in_plane = share * (size[:2] - diameters[:, None, None])
        z = np.broadcast_to(0.5 * size[2], in_plane.shape[:2])[..., None]
        return Layouts(
            np.concatenate([in_plane[:, :, 0], -z], axis=-1), np.concatenate([in_plane[:, :, 1], z], axis=-1), diameters
        )


def gaps(layouts: Layouts) -> Array:
    """Distances (s, n (n - 1) / 2) in mm between the surfaces of every two rods; negative where they cross."""
    first, second = np.triu_indices(len(layouts.diameters), 1)
    axes = _distances(
        layouts.starts[:, first], layouts.ends[:, first], layouts.starts[:, second], layouts.ends[:, second]
    )
    surfaces: Array = axes - 0.5 * (layouts.diameters[first] + layouts.diameters[second])
    return surfaces


def _distances(start_a: Array, end_a: Array, start_b: Array, end_b: Array) -> Array:
    """Between segments (..., 3): where the nearest points of the lines are not on both, one of the four ends is it."""
    along_a, along_b, between = end_a - start_a, end_b - start_b, start_b - start_a
    aa, bb, ab = _dot(along_a, along_a), _dot(along_b, along_b), _dot(along_a, along_b)
    da, db = _dot(along_a, between), _dot(along_b, between)
    cross = aa * bb - ab**2
    skew = cross > 1e-12 * aa * bb
    safe = np.where(skew, cross, 1.0)
    on_a, on_b = (da * bb - db * ab) / safe, (da * ab - db * aa) / safe
    both = skew & (on_a >= 0) & (on_a <= 1) & (on_b >= 0) & (on_b <= 1)
    lines = np.linalg.norm(between + on_b[..., None] * along_b - on_a[..., None] * along_a, axis=-1)
    ends = np.min(
        [
            _to_segment(start_a, start_b, along_b, bb),
            _to_segment(end_a, start_b, along_b, bb),
            _to_segment(start_b, start_a, along_a, aa),
            _to_segment(end_b, start_a, along_a, aa),
        ],
        axis=0,
    )
    distances: Array = np.where(both, lines, ends)
    return distances


def _to_segment(point: Array, start: Array, along: Array, squared: Array) -> Array:
    share = np.clip(_dot(point - start, along) / squared, 0.0, 1.0)
    distances: Array = np.linalg.norm(point - start - share[..., None] * along, axis=-1)
    return distances


def _dot(a: Array, b: Array) -> Array:
    products: Array = np.einsum("...i,...i->...", a, b)
    return products
