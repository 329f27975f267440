"""How near maximum likelihood comes to the Cramer-Rao bound: bound variance over measured variance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from tqdm import tqdm

from stereoreg_ros.reproduction import paper
from stereoreg_ros.reproduction.effort import Effort
from stereoreg_ros.reproduction.pose_accuracy import first_solution
from stereoreg_ros.reproduction.poses_and_noise import (
    SCALE,
    all_lines,
    bound_of_frame_from_slice,
    position_error,
    random_problem,
    rotation_error,
    uniform_std,
)
from stereoreg_ros.reproduction.rods import EIGHT_RODS, first_rods
from stereoreg_ros.reproduction.table import Comparison, Section, Table
from stereoreg_ros.solvers.methods import POSE_METHODS
from stereoreg_ros.uncertainty import cramer_rao_pose

LINES: Final = (4, 5, 6, 8)
METHODS: Final = {"N-R": "newton_raphson", "ML": "maximum_likelihood"}
# What the package asks of its maximum likelihood.
WANTED: Final = 0.95


@dataclass(frozen=True)
class Efficiency:
    """Of one method and number of rods: bound variance / measured variance in position and rotation, with the standard
    errors; failures: poses without a solution.
    """

    method: str
    lines: int
    position: float
    position_error: float
    rotation: float
    rotation_error: float
    failures: int


def measure(effort: Effort, seed: int, lines: int) -> list[Efficiency]:
    """Estimate `effort.efficiency_poses` random poses at the paper's noise of 0.5 pixel."""
    frame = first_rods(EIGHT_RODS, lines)
    rng = np.random.default_rng([seed, 95, lines])
    bound = np.zeros((effort.efficiency_poses, 2))
    squared = {name: np.full((effort.efficiency_poses, 2), np.nan) for name in METHODS}
    for trial in tqdm(range(effort.efficiency_poses), desc=f"efficiency, {lines} lines", disable=None, leave=False):
        problem = random_problem(rng, frame, paper.NOISE_PX)
        truth = problem.frame_from_slice
        covariance = cramer_rao_pose(frame, all_lines(frame), truth.inverse(), SCALE, uniform_std(paper.NOISE_PX))
        bound[trial] = [np.trace(one) for one in bound_of_frame_from_slice(covariance, truth)]
        for name, key in METHODS.items():
            found = first_solution(POSE_METHODS[key], frame, problem)
            if found is not None:
                squared[name][trial] = (
                    position_error(found.frame_from_slice, truth) ** 2,
                    rotation_error(found.frame_from_slice, truth) ** 2,
                )
    results = []
    for name, errors in squared.items():
        solved = ~np.isnan(errors[:, 0])
        # Each pose has a bound of its own: over it, every pose counts alike.
        ratio = errors[solved] / bound[solved]
        mean = ratio.mean(axis=0)
        spread = ratio.std(axis=0, ddof=1) / np.sqrt(len(ratio)) / mean**2
        results.append(
            Efficiency(
                name,
                lines,
                float(1 / mean[0]),
                float(spread[0]),
                float(1 / mean[1]),
                float(spread[1]),
                int((~solved).sum()),
            )
        )
    return results


def section(results: list[Efficiency], poses: int) -> Section:
    """The part of the report."""
    columns = ("method", "lines", "position", "standard error", "rotation", "standard error", "failures")
    table = Table(
        "efficiency",
        columns,
        [
            (
                one.method,
                one.lines,
                one.position,
                one.position_error,
                one.rotation,
                one.rotation_error,
                one.failures,
            )
            for one in results
        ],
    )
    comparisons = [
        Comparison(
            f"efficiency of ML, {one.lines} lines: position, rotation",
            f"- (wanted here: {WANTED:g})",
            f"{one.position:.3f} +- {one.position_error:.3f}, {one.rotation:.3f} +- {one.rotation_error:.3f}",
            min(one.position + 2 * one.position_error, one.rotation + 2 * one.rotation_error) >= WANTED,
        )
        for one in results
        if one.method == "ML"
    ]
    text = f"""Not in the paper. {poses} random poses with noise uniform in +-{paper.NOISE_PX:g} pixel, the first 4,
5, 6, 8 rods of `{EIGHT_RODS.name}`. Efficiency is bound variance / measured variance: one over the mean of
|error|^2 / trace(bound), with the bound of each pose taken at its true value. The Cramer-Rao bound here and in the
plots is that of Gaussian noise with the variance of the uniform noise. It is a first-order bound, so at finite
noise a value slightly off 1 indicates curvature."""
    return Section("Efficiency at 0.5 pixel", text, comparisons, (table,), (table,))
