"""Layouts of rods with the least target error, by scipy's differential evolution."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from joblib import Parallel, delayed
from scipy.optimize import differential_evolution

from stereoreg_ros.design.expected_error import Imaging, expected, point_covariances, pooled_error_95
from stereoreg_ros.design.layouts import Envelope, Layouts, least_gaps
from stereoreg_ros.design.meeting import Meetings, meetings
from stereoreg_ros.geometry.pose import Array

# mm of target error for each mm that two rods are too near: more than any layout gains by it.
_TOO_NEAR = 100.0
# Layouts of a batch that one core evaluates at a time, small enough for its cache.
_BATCH = 32
_POSES = 64
# Ends are rounded to a tenth of a millimetre, which can bring two rods this much nearer.
_ROUNDING_MM = 0.15


@dataclass(frozen=True, eq=False)
class Wish:
    """What a frame shall do.

    diameters_mm: (n,), one a rod; target_mm: (3,), the point in the frame's axes whose 95 % error shall be small;
    largest_tilt_deg, largest_height_mm: of the slices, against the frame's upright middle.
    Raises ValueError, naming the field, what was found and what was expected.
    """

    envelope: Envelope
    diameters_mm: tuple[float, ...]
    imaging: Imaging
    target_mm: tuple[float, float, float]
    largest_tilt_deg: float
    largest_height_mm: float
    poses: Meetings = field(init=False)

    def __post_init__(self) -> None:
        if not 4 <= len(self.diameters_mm) <= 20:
            raise ValueError(f"lines is {len(self.diameters_mm)}, expected 4 to 20 rods")
        if not all(0.1 <= diameter <= min(self.envelope.size_mm) / 4 for diameter in self.diameters_mm):
            raise ValueError(
                f"diameter is {self.diameters_mm!r}, expected from 0.1 mm to a quarter of the envelope's shortest side"
            )
        if not 0 <= self.largest_tilt_deg <= 60:
            raise ValueError(f"tilt is {self.largest_tilt_deg!r}, expected from 0 to 60 degrees")
        if not 0 <= self.largest_height_mm <= self.envelope.size_mm[2] / 2:
            raise ValueError(
                f"height is {self.largest_height_mm!r}, expected from 0 mm to half of the envelope's height"
            )
        if not (len(self.target_mm) == 3 and np.isfinite(self.target_mm).all()):
            raise ValueError(f"target is {self.target_mm!r}, expected three numbers in mm")
        heights = np.array([-self.largest_height_mm, self.largest_height_mm])
        # The same poses for all layouts, so that the error is a smooth function of the layout.
        object.__setattr__(self, "poses", meetings(_POSES, 0, np.zeros(3), heights, self.largest_tilt_deg))

    def target_errors(self, layouts: Layouts) -> Array:
        """Radius (s,) in mm of the 95 % target error over all poses, for each layout."""
        covariances = expected(layouts, self.poses, self.imaging).covariances
        return pooled_error_95(point_covariances(covariances, self.poses.rotations, np.array(self.target_mm)))

    def costs(self, corners: Array) -> Array:
        """Target error (s,) of layouts (s, 4 n), raised where rods are nearer than the envelope's gap."""
        layouts = self.envelope.layouts(corners, self.diameters_mm)
        return self.target_errors(layouts) + _TOO_NEAR * self.shortfalls_mm(corners)

    def shortfalls_mm(self, corners: Array) -> Array:
        """By how much (s,) the rods are nearer than the envelope's gap, and what rounding may take of it."""
        gaps = least_gaps(self.envelope.layouts(corners, self.diameters_mm))
        return np.maximum(self.envelope.gap_mm + _ROUNDING_MM - gaps, 0.0)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A layout that can be built.

    corners: (4 n,) as in `Envelope.layouts`; target_error_95_mm: what it lets expect; interrupted: whether the search
    ended before its time.
    """

    corners: Array
    target_error_95_mm: float
    interrupted: bool


def random_layouts(wish: Wish, count: int, rng: np.random.Generator) -> Iterator[Array]:
    """`count` layouts (4 n,) that can be built, their rods' ends drawn evenly over the faces."""
    found = 0
    while found < count:
        corners = rng.uniform(size=(256, 4 * len(wish.diameters_mm)))
        gaps = least_gaps(wish.envelope.layouts(corners, wish.diameters_mm))
        for row in np.flatnonzero(gaps >= wish.envelope.gap_mm)[: count - found]:
            found += 1
            yield corners[row]


def search(
    wish: Wish, seed: int, generations: int, progress: Callable[[float, float], bool] | None = None
) -> Candidate:
    """The best layout of one run; progress: told the share done and the least error so far, says whether to go on.

    Where that ends it, or an interruption (KeyboardInterrupt) does, the best layout so far is returned. The batches of
    a generation are spread over the cores by joblib, in whatever backend its `parallel_config` has chosen.
    Raises ValueError where no layout that can be built was found.
    """
    with Parallel(n_jobs=-1) as parallel:
        evaluated = _Evaluated(wish, parallel)
        done = 0

        def after_generation(*_: object) -> bool:
            nonlocal done
            done += 1
            return progress is not None and not progress(min(1.0, done / generations), evaluated.least)

        interrupted = False
        try:
            differential_evolution(
                lambda columns: evaluated(columns.T),
                [(0.0, 1.0)] * (4 * len(wish.diameters_mm)),
                strategy="currenttobest1bin",
                maxiter=generations,
                popsize=4,
                tol=1e-4,
                mutation=(0.3, 0.8),
                recombination=0.8,
                polish=False,
                init="sobol",
                updating="deferred",
                vectorized=True,
                callback=after_generation,
                seed=np.random.default_rng(seed),
            )
        except KeyboardInterrupt:
            interrupted = True
    if evaluated.best is None or wish.shortfalls_mm(evaluated.best[None])[0] > _ROUNDING_MM:
        size = " x ".join(f"{length:g}" for length in wish.envelope.size_mm)
        raise ValueError(
            f"no layout of {len(wish.diameters_mm)} rods with {wish.envelope.gap_mm:g} mm between them was found in "
            f"{size} mm; fewer rods, a smaller gap, a larger envelope or more generations are needed"
        )
    return Candidate(evaluated.best, evaluated.least, interrupted)


class _Evaluated:
    """Costs of layouts, and the best one met."""

    def __init__(self, wish: Wish, parallel: Parallel) -> None:
        self.wish = wish
        self.best: Array | None = None
        self.least = np.inf
        self._parallel = parallel

    def __call__(self, corners: Array) -> Array:
        corners = np.clip(corners, 0.0, 1.0)
        batches = np.array_split(corners, max(1, len(corners) // _BATCH))
        costs = np.concatenate(self._parallel(delayed(self.wish.costs)(batch) for batch in batches))
        row = int(costs.argmin())
        if costs[row] < self.least:
            self.least, self.best = float(costs[row]), corners[row].copy()
        return costs
