"""Figs 6 and 7: scale and pose from eight rods, against noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.reproduction import paper
from stereoreg_ros.reproduction.effort import Effort
from stereoreg_ros.reproduction.poses_and_noise import (
    SCALE,
    all_lines,
    bound_of_frame_from_slice,
    level_seed,
    mean_length,
    position_error,
    random_problem,
    reprojection_error,
    rotation_error,
    uniform_std,
)
from stereoreg_ros.reproduction.rods import EIGHT_RODS
from stereoreg_ros.reproduction.table import Cell, Comparison, Section, Table
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import (
    ScaleSolution,
    calibrate_linear,
    calibrate_maximum_likelihood,
    calibrate_newton_raphson,
    calibration_covariance,
)

CalibrationMethod: TypeAlias = Callable[[Frame, NDArray[np.intp], Array], ScaleSolution]

METHODS: Final[dict[str, CalibrationMethod]] = {
    "LS": calibrate_linear,
    "N-R": calibrate_newton_raphson,
    "ML": calibrate_maximum_likelihood,
}
# Of each method and pose, in this order.
ERRORS: Final = ("rotation / deg", "position / mm", "scale / (mm/pixel)", "reprojection / pixel")


@dataclass(frozen=True, eq=False)
class CalibrationAccuracy:
    """What figs 6 and 7 show, at k levels of noise.

    levels_px: (k,); mean: by method (k, 4), the errors in the order of ERRORS, without the failed; failures: by method
    (k,), of `poses`; bound: (k, 3), mean errors (rotation, position, scale) of a Gaussian estimate at the Cramer-Rao
    bound.
    """

    levels_px: Array
    poses: int
    mean: dict[str, Array]
    failures: dict[str, NDArray[np.intp]]
    bound: Array


def measure(effort: Effort, seed: int) -> CalibrationAccuracy:
    """Calibrate from `effort.poses` random poses per level of noise, new ones at each level."""
    frame, lines = EIGHT_RODS, all_lines(EIGHT_RODS)
    levels = effort.levels_px
    errors = {name: np.full((len(levels), effort.poses, len(ERRORS)), np.nan) for name in METHODS}
    bound = np.zeros((len(levels), effort.poses, 3))
    bar = tqdm(total=len(levels) * effort.poses, desc="figs 6, 7: calibration", disable=None, leave=False)
    for row, amplitude in enumerate(levels):
        rng = np.random.default_rng(level_seed(seed, 6, len(frame), amplitude))
        for trial in range(effort.poses):
            problem = random_problem(rng, frame, amplitude)
            truth = problem.frame_from_slice
            for name, method in METHODS.items():
                try:
                    found = method(frame, lines, problem.spots_px)
                except DegenerateArrangementError:
                    continue
                if found.converged:
                    errors[name][row, trial] = (
                        rotation_error(found.frame_from_slice, truth),
                        position_error(found.frame_from_slice, truth),
                        float(np.linalg.norm(found.scale.matrix - SCALE.matrix)),
                        reprojection_error(frame, found.frame_from_slice, found.scale, problem.exact_px),
                    )
            covariance = calibration_covariance(frame, lines, truth.inverse(), SCALE, uniform_std(amplitude))
            of_position, of_rotation = bound_of_frame_from_slice(covariance[2:, 2:], truth)
            bound[row, trial] = mean_length(of_rotation), mean_length(of_position), mean_length(covariance[:2, :2])
            bar.update()
    bar.close()
    failures = {name: np.isnan(all_errors[..., 0]).sum(axis=1) for name, all_errors in errors.items()}
    mean = {name: np.nanmean(all_errors, axis=1) for name, all_errors in errors.items()}
    return CalibrationAccuracy(np.array(levels), effort.poses, mean, failures, bound.mean(axis=1))


def section(result: CalibrationAccuracy) -> Section:
    """The part of the report."""
    rows: list[tuple[Cell, ...]] = []
    for row, level in enumerate(result.levels_px):
        for name in METHODS:
            rows.append((float(level), name, *map(float, result.mean[name][row]), int(result.failures[name][row])))
        rows.append((float(level), "Cramer-Rao", *map(float, result.bound[row]), None, None))
    table = Table("figures_6_7_calibration", ("noise / pixel", "method", *ERRORS, "failures"), rows)
    noisy = result.levels_px > 0
    shares = [result.mean["N-R"][noisy, column] / result.mean["LS"][noisy, column] for column in range(len(ERRORS))]
    better = [int((share < 1).sum()) for share in shares]
    levels = int(noisy.sum())
    at = int(np.flatnonzero(result.levels_px == paper.NOISE_PX)[0])
    named = ("rotation", "position", "scale", "reprojection")
    comparisons = [
        Comparison(
            f"N-R better than LS in {what} (figs 6, 7)",
            "at every level",
            f"at {count} of {levels} levels; mean error {share.mean():.2f} of that of LS",
            count == levels,
        )
        for what, count, share in zip(named, better, shares, strict=True)
    ]
    scale_error = float(result.mean["N-R"][at, 2])
    comparisons.append(
        Comparison(
            f"mean scale error, {paper.NOISE_PX:g} pixel, N-R (fig. 7)",
            f"~{paper.SCALE_ERROR:.0e} mm/pixel",
            f"{scale_error:.1e} mm/pixel (ML {result.mean['ML'][at, 2]:.1e}, bound {result.bound[at, 2]:.1e})",
            scale_error <= paper.SCALE_ERROR,
        )
    )
    text = f"""Eight rods (`{EIGHT_RODS.name}`, coordinates below), scale 0.5 mm/pixel; scale and pose are both
unknown. There are {result.poses} random poses per noise level, drawn anew at each level. LS is the linear solution
(eq. 10-12), N-R adds l1 . l2 = 0 (eq. 17-23), ML is the least-squares fit in the image. N-R adds one constraint to
nine unknowns, so its gain over LS is small. How well the scale is determined depends on how far apart the rods are:
the bound shows what this 60 mm frame allows; the paper's frame was perhaps wider."""
    return Section(
        "Calibration with eight rods: figs 6 and 7",
        text,
        comparisons,
        (table,),
        figures=(("figures_6_7_calibration.png", "Mean errors of the calibration against the amplitude of the noise"),),
    )
