"""Figs 8 and 9: pose from four and from eight rods at known scale, against noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.reproduction import paper
from stereoreg_ros.reproduction.effort import Effort
from stereoreg_ros.reproduction.poses_and_noise import (
    SCALE,
    Problem,
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
from stereoreg_ros.reproduction.rods import EIGHT_RODS, first_rods
from stereoreg_ros.reproduction.table import Cell, Comparison, Section, Table
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.methods import POSE_METHODS
from stereoreg_ros.solvers.pose_solution import PoseSolution, PoseSolver
from stereoreg_ros.uncertainty import cramer_rao_pose

# The names in the paper's figures, and of the methods here.
METHODS: Final = {
    "LS-SVD": "ls_svd",
    "LS-SVD (DR)": "ls_svd_dr",
    "LS-TZ": "ls_tz",
    "N-R": "newton_raphson",
    "ML": "maximum_likelihood",
}
CLOSED_FORMS: Final = ("LS-SVD", "LS-SVD (DR)", "LS-TZ")
ERRORS: Final = ("position / mm", "rotation / deg", "reprojection / pixel")


@dataclass(frozen=True, eq=False)
class PoseAccuracy:
    """What fig. 8 or 9 shows, at k levels of noise.

    lines: how many rods; levels_px: (k,); mean, median: by method (k, 3), the errors in the order of ERRORS, without
    the failed; failures: by method (k,), of `poses`; bound: (k, 2), mean errors (position, rotation) of a Gaussian
    estimate at the Cramer-Rao bound.
    """

    lines: int
    levels_px: Array
    poses: int
    mean: dict[str, Array]
    median: dict[str, Array]
    failures: dict[str, NDArray[np.intp]]
    bound: Array

    def at(self, amplitude_px: float) -> int:
        """Row of a level."""
        return int(np.flatnonzero(self.levels_px == amplitude_px)[0])


def first_solution(method: PoseSolver, frame: Frame, problem: Problem) -> PoseSolution | None:
    """What the method itself ranks first, whether or not another of its solutions is nearer to the truth."""
    try:
        found = method(frame, all_lines(frame), problem.spots_px, SCALE)
    except DegenerateArrangementError:
        return None
    return found[0] if found and found[0].converged else None


def measure(effort: Effort, seed: int, lines: int) -> PoseAccuracy:
    """Find `effort.poses` random poses per level of noise from the first `lines` rods, new poses at each level."""
    frame = first_rods(EIGHT_RODS, lines)
    levels = effort.levels_px
    errors = {name: np.full((len(levels), effort.poses, len(ERRORS)), np.nan) for name in METHODS}
    bound = np.zeros((len(levels), effort.poses, 2))
    bar = tqdm(total=len(levels) * effort.poses, desc=f"figs 8, 9: pose, {lines} lines", disable=None, leave=False)
    for row, amplitude in enumerate(levels):
        rng = np.random.default_rng(level_seed(seed, 8, lines, amplitude))
        for trial in range(effort.poses):
            problem = random_problem(rng, frame, amplitude)
            truth = problem.frame_from_slice
            for name, key in METHODS.items():
                found = first_solution(POSE_METHODS[key], frame, problem)
                if found is not None:
                    errors[name][row, trial] = (
                        position_error(found.frame_from_slice, truth),
                        rotation_error(found.frame_from_slice, truth),
                        reprojection_error(frame, found.frame_from_slice, SCALE, problem.exact_px),
                    )
            covariance = cramer_rao_pose(frame, all_lines(frame), truth.inverse(), SCALE, uniform_std(amplitude))
            of_position, of_rotation = bound_of_frame_from_slice(covariance, truth)
            bound[row, trial] = mean_length(of_position), mean_length(of_rotation)
            bar.update()
    bar.close()
    return PoseAccuracy(
        lines,
        np.array(levels),
        effort.poses,
        {name: np.nanmean(one, axis=1) for name, one in errors.items()},
        {name: np.nanmedian(one, axis=1) for name, one in errors.items()},
        {name: np.isnan(one[..., 0]).sum(axis=1) for name, one in errors.items()},
        bound.mean(axis=1),
    )


def section(results: list[PoseAccuracy]) -> Section:
    """The part of the report for both figures."""
    tables, shown, figures = [], [], []
    comparisons: list[Comparison] = []
    for result in results:
        figure = {4: 8, 8: 9}[result.lines]
        rows: list[tuple[Cell, ...]] = []
        for row, level in enumerate(result.levels_px):
            for name in METHODS:
                values = [float(value) for value in (*result.mean[name][row], *result.median[name][row])]
                rows.append((float(level), name, *values, int(result.failures[name][row])))
            rows.append((float(level), "Cramer-Rao", *map(float, result.bound[row]), None, None, None, None, None))
        columns = (*(f"mean {error}" for error in ERRORS), *(f"median {error}" for error in ERRORS))
        table = Table(
            f"figure_{figure}_pose_{result.lines}_lines", ("noise / pixel", "method", *columns, "failures"), rows
        )
        tables.append(table)
        at_paper_level = [one for one in rows if one[0] == paper.NOISE_PX]
        shown.append(Table(f"{result.lines} lines at {paper.NOISE_PX:g} pixel", table.columns, at_paper_level))
        comparisons += _compare(result, figure)
        name = f"figure_{figure}_pose_{result.lines}_lines.png"
        figures.append((name, f"Mean errors of the pose from {result.lines} rods against the amplitude of the noise"))
    text = f"""The first four and all eight rods of `{EIGHT_RODS.name}` (coordinates below), {results[0].poses}
random poses per level. If a method returns several solutions, the one it ranks first counts. A failure is no
solution, or one that did not converge; failures are excluded from the means. The closed forms occasionally go far
wrong at a pose where their constraints hardly depend on the remaining unknown, LS-SVD (DR) because it divides by
numbers near zero: compare the medians. With four rods LS-SVD and LS-TZ are the same solution."""
    return Section(
        "Pose with known scale: figs 8 and 9", text, comparisons, tuple(tables), tuple(shown), tuple(figures)
    )


def _compare(result: PoseAccuracy, figure: int) -> list[Comparison]:
    at = result.at(paper.NOISE_PX)
    where = f"{result.lines} lines, {paper.NOISE_PX:g} pixel (fig. {figure})"
    paper_mm, paper_deg = paper.POSE_CLOSED_FORM[result.lines]
    comparisons = []
    for name in CLOSED_FORMS:
        mm, deg, _ = result.mean[name][at]
        median_mm, median_deg, _ = result.median[name][at]
        comparisons.append(
            Comparison(
                f"{name}, {where}",
                f"~{paper_mm:g} mm / {paper_deg:g} deg",
                f"{mm:.2f} mm / {deg:.2f} deg (medians {median_mm:.2f} / {median_deg:.2f})",
                bool(mm <= paper_mm and deg <= paper_deg),
            )
        )
    paper_mm, paper_deg = paper.POSE_NEWTON_RAPHSON[result.lines]
    mm, deg, _ = result.mean["N-R"][at]
    bound_mm, bound_deg = result.bound[at]
    comparisons.append(
        Comparison(
            f"N-R, {where}",
            f"~{paper_mm:g} mm / {paper_deg:g} deg",
            f"{mm:.2f} mm / {deg:.2f} deg",
            bool(mm <= paper_mm and deg <= paper_deg),
        )
    )
    mm, deg, _ = result.mean["ML"][at]
    comparisons.append(
        Comparison(f"ML, {where}", "-", f"{mm:.3f} mm / {deg:.3f} deg (bound {bound_mm:.3f} / {bound_deg:.3f})")
    )
    noisy = result.levels_px > 0
    best = np.all([(result.mean["N-R"] <= result.mean[name])[noisy, :2] for name in CLOSED_FORMS], axis=(0, 2))
    comparisons.append(
        Comparison(
            f"N-R best of the paper's methods, {result.lines} lines (fig. {figure})",
            "at every level",
            f"at {int(best.sum())} of {len(best)} levels",
            bool(best.all()),
        )
    )
    return comparisons
