"""Layouts of rods with the least target error, by scipy's basin hopping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from numpy.typing import NDArray
from scipy.optimize import basinhopping

from stereoreg_ros.frames.expected_error import Imaging, expected, point_covariances, pooled_error_95
from stereoreg_ros.frames.layouts import Envelope, Layouts, gaps
from stereoreg_ros.frames.slice_poses import SlicePoses, slice_poses
from stereoreg_ros.geometry.pose import Array

_POSES = 64
# Ends are rounded to a tenth of a millimetre, which can bring two rods so much nearer; the descent, which weighs a gap
# against an error, may fall short by the rest of the margin.
_ROUNDING_MM, _MARGIN_MM = 0.15, 0.2
# Random layouts of which the best is a start, hops of a chain, steps of a descent, and the error by which a hop may be
# worse and still be taken, now and then.
_DRAWN, _HOPS, _DESCENT, _TEMPERATURE_MM = 50, 10, 80, 0.02
# Of the differences that the slope is made of, as a share of the envelope.
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Requirements:
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
    poses: SlicePoses = field(init=False)

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
        object.__setattr__(self, "poses", slice_poses(_POSES, 0, np.zeros(3), heights, self.largest_tilt_deg))

    def target_errors(self, layouts: Layouts) -> Array:
        """Radius (s,) in mm of the 95 % target error over all poses, for each layout."""
        covariances = expected(layouts, self.poses, self.imaging).covariances
        return pooled_error_95(point_covariances(covariances, self.poses.rotations, np.array(self.target_mm)))

    def costs(self, corners: Array) -> Array:
        """Target error (s,) of layouts (s, 4 n), raised by the square of what rods are too near, mm."""
        layouts = self.envelope.layouts(corners, self.diameters_mm)
        short_mm = np.maximum(self.envelope.gap_mm + _MARGIN_MM - gaps(layouts), 0.0)
        costs: Array = self.target_errors(layouts) + (short_mm**2).sum(axis=1)
        return costs

    def can_be_built(self, corners: Array) -> NDArray[np.bool_]:
        """Whether the rods of layouts (s, 4 n) keep the envelope's gap, also when their ends are rounded."""
        layouts = self.envelope.layouts(corners, self.diameters_mm)
        return np.asarray(gaps(layouts).min(axis=1) >= self.envelope.gap_mm + _ROUNDING_MM)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A layout that can be built.

    corners: (4 n,) as in `Envelope.layouts`; target_error_95_mm: what it lets expect; interrupted: whether the search
    ended before its time.
    """

    corners: Array
    target_error_95_mm: float
    interrupted: bool


def random_layouts(requirements: Requirements, count: int, rng: np.random.Generator) -> Array:
    """`count` layouts (count, 4 n) that can be built, their rods' ends drawn evenly over the faces.

    Raises ValueError where hardly any layout drawn so can be built.
    """
    found: list[Array] = []
    for _ in range(max(100, 4 * count)):
        corners = rng.uniform(size=(256, 4 * len(requirements.diameters_mm)))
        found.extend(corners[requirements.can_be_built(corners)])
        if len(found) >= count:
            return np.array(found[:count])
    size = " x ".join(f"{length:g}" for length in requirements.envelope.size_mm)
    raise ValueError(
        f"of random layouts of {len(requirements.diameters_mm)} rods with {requirements.envelope.gap_mm:g} mm between "
        f"them hardly any fits into {size} mm; fewer rods, a smaller gap or a larger envelope is needed"
    )


def search(
    requirements: Requirements, seed: int, chains: int, progress: Callable[[float, float], bool] | None = None
) -> list[Candidate]:
    """The layouts that several chains of hops have found, the best first; progress: called with the share done and the
    least error so far, mm, says whether to go on.

    Where it says not to, or an interruption (KeyboardInterrupt) comes, what was found so far is returned, at least the
    best of some random layouts. The chains are spread over the cores by joblib, in whatever backend its
    `parallel_config` has chosen. Raises ValueError where no layout that can be built was found.
    """
    seeds = np.random.SeedSequence(seed).spawn(chains + 1)
    drawn = random_layouts(requirements, _DRAWN, np.random.default_rng(seeds[-1]))
    costs = requirements.costs(drawn)
    found = [(drawn[costs.argmin()], float(costs.min()))]
    done, interrupted, together = 0, False, effective_n_jobs(-1)
    try:
        while done < chains and not interrupted:
            # As many at a time as there are cores, so that progress is reported in between.
            batch = seeds[done : min(done + together, chains)]
            made = Parallel(n_jobs=-1)(delayed(_chain)(requirements, one) for one in batch)
            found += [(corners, cost) for corners, cost in made if requirements.can_be_built(corners[None])[0]]
            done += len(batch)
            least = min(cost for _, cost in found)
            interrupted = progress is not None and not progress(done / chains, least) and done < chains
    except KeyboardInterrupt:
        interrupted = True
    layouts = requirements.envelope.layouts(np.array([corners for corners, _ in found]), requirements.diameters_mm)
    errors = requirements.target_errors(layouts)
    return [Candidate(found[row][0], float(errors[row]), interrupted) for row in np.argsort(errors)]


def _chain(requirements: Requirements, seed: np.random.SeedSequence) -> tuple[Array, float]:
    """From the best of some random layouts: one rod is drawn anew, all descend together, the better layout stays."""
    rng = np.random.default_rng(seed)
    start = random_layouts(requirements, _DRAWN, rng)

    def redraw(corners: Array) -> Array:
        moved = corners.copy()
        rod = int(rng.integers(len(requirements.diameters_mm)))
        moved[4 * rod : 4 * rod + 4] = rng.uniform(size=4)
        return moved

    def cost_and_slope(corners: Array) -> tuple[float, Array]:
        inward = np.where(corners > 0.5, -_STEP, _STEP)
        costs = requirements.costs(np.concatenate([corners[None], corners + np.diag(inward)]))
        return float(costs[0]), (costs[1:] - costs[0]) / inward

    found = basinhopping(
        cost_and_slope,
        start[requirements.costs(start).argmin()],
        niter=_HOPS,
        T=_TEMPERATURE_MM,
        take_step=redraw,
        minimizer_kwargs={
            "method": "L-BFGS-B",
            "jac": True,
            "bounds": [(0.0, 1.0)] * start.shape[1],
            "options": {"maxiter": _DESCENT},
        },
        seed=rng,
    )
    return np.clip(found.x, 0.0, 1.0), float(found.fun)
