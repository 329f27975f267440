"""From an explanation of the matcher to a pose with its covariance and its residuals."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.projection import Cuts, cut_jacobian, point_line_distances, project
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.judgement import DEGENERATE_ROTATION_DEG, WEAK_POSITION_MM, WEAK_ROTATION_DEG
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.result import Match, PoseEstimate
from stereoreg_ros.solvers.likelihood_valley import covariance_along_valley
from stereoreg_ros.uncertainty import Whitened, enclosing_covariance, in_scanner_axes


class _Weighed(NamedTuple):
    """The k rods that have a spot, at a pose. lines (k,), rows (k,) of their spots; whitening (k, 2, 2) 1/mm; common
    (k, 2, c) mm: how far each spot moves by one standard deviation of each error that all of them share.
    """

    lines: NDArray[np.intp]
    rows: NDArray[np.intp]
    whitening: Array
    common: Array


def estimate(hypothesis: Hypothesis, problem: Problem, seen: SliceSpots, is_best: bool) -> PoseEstimate:
    """The pose of an explanation, in the scanner, with all that supports it.

    is_best: whether its covariance is followed along the valley of the likelihood where the pose is weak, which takes
    long: of explanations that are only listed it does not matter.
    """
    frame, spots = problem.frame, problem.spots
    slice_from_frame = Pose(hypothesis.rotation, hypothesis.translation)
    predicted_px, cuts = project(frame, slice_from_frame, seen.scale)
    weighed = _weighed(hypothesis, problem, cuts)
    lines, rows, whitening, common = weighed
    distances = point_line_distances(frame, lines, slice_from_frame, spots.mm[rows])
    whitened = _whitened(slice_from_frame, cuts, weighed, spots, seen.scanner_from_slice)
    covariance = _covariance(hypothesis.information)
    if is_best and _is_weak(covariance):
        along = covariance_along_valley(frame, slice_from_frame, lines, spots.mm[rows], whitening, common)
        # The valley is that of these matches; what others have widened it by stays.
        covariance = enclosing_covariance(covariance, along) if hypothesis.is_widened else along
    return PoseEstimate(
        slice_from_frame=slice_from_frame,
        scanner_from_frame=seen.scanner_from_slice @ slice_from_frame,
        covariance=in_scanner_axes(covariance + whitened.covariance_by_shifts(), seen.scanner_from_slice),
        matches=tuple(
            Match(
                frame.line_names[line], int(line), int(spot), seen.centres_px[spot], predicted_px[line], float(distance)
            )
            for line, spot, distance in zip(lines, rows, distances, strict=True)
        ),
        chi_square=hypothesis.chi_square,
        log10_false_alarms=hypothesis.log10_false_alarms,
        scale_misfit=whitened.scale_misfit(),
    )


def _weighed(hypothesis: Hypothesis, problem: Problem, cuts: Cuts) -> _Weighed:
    frame, spots, spot_of_line = problem.frame, problem.spots, hypothesis.spot_of_line
    used = spot_of_line != UNMATCHED
    lines = np.flatnonzero(used)
    common = spots.tolerances.common(frame, cuts, spots.mm[spot_of_line], used)[lines]
    return _Weighed(lines, spot_of_line[lines], spots.whitening(frame, cuts, spot_of_line)[lines], common)


def _whitened(
    slice_from_frame: Pose, cuts: Cuts, weighed: _Weighed, spots: Spots, scanner_from_slice: Pose
) -> Whitened:
    """The residuals of the matched rods at a pose.

    A scale that is off moves all spots away from the point that the scanner's origin has in the slice: pixel (0, 0)
    where the scanner is the slice, else the point nearest to the scanner's origin, as a scanner's images are
    reconstructed about its axis.
    """
    lines, rows, whitening, common = weighed
    residual = spots.mm[rows] - cuts.points_mm[lines]
    jacobian = cut_jacobian(cuts, slice_from_frame.translation)[lines]
    origin_mm = scanner_from_slice.inverse().translation[:2]
    stretches = spots.tolerances.stretches
    is_scale = np.arange(common.shape[-1]) < len(stretches)
    shifts = np.zeros((6, common.shape[-1]))
    shifts[:2, is_scale] = (stretches @ (spots.mm[rows].mean(axis=0) - origin_mm)).T
    count = 2 * len(lines)
    return Whitened(
        (whitening @ jacobian).reshape(count, 6),
        (whitening @ common).reshape(count, -1),
        (whitening @ residual[..., None]).reshape(count),
        shifts,
        is_scale,
        spots.tolerances.scale_std,
    )


def _is_weak(covariance: Array) -> bool:
    """Whether the pose is determined so weakly that the curvature at the solution does not tell how weakly."""
    position = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    rotation_deg = math.degrees(math.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    # What is not determined at all has no end to walk to, and is refused.
    return rotation_deg < DEGENERATE_ROTATION_DEG and (position > WEAK_POSITION_MM or rotation_deg > WEAK_ROTATION_DEG)


def _covariance(information: Array) -> Array:
    """Inverse of an information matrix (6, 6); a direction that nothing determines gets a huge variance."""
    values, vectors = np.linalg.eigh(information)
    covariance: Array = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return covariance
