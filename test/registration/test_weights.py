"""Each spot weighs by its own covariance, whatever its row, with a rod missing and false spots between."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, register_spots
from stereoreg_ros.calibration.calibrate import Calibration, calibrate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.registration import recognise
from stereoreg_ros.solvers.identified import IdentifiedSpots, ScaleAndPoses
from stereoreg_ros.solvers.tolerant_calibration import calibrate_tolerantly
from support.frames import cube_by_hand

SCALE = PixelScale(0.45, 0.6, 0.12)
PLANE = Pose(rotation_exp(np.array([0.3, -0.8, 0.5])), np.array([5.0, 60.0, 70.0]))
TRUTH = Pose(rotation_exp(np.array([0.1, -0.15, 0.8])), np.array([70.0, 120.0, 3.0]))
MISSING = 1
# Of (sx, sy, shear), no two alike.
SCALE_COVARIANCE = np.array([[4.0, 1.0, 0.6], [1.0, 9.0, -0.8], [0.6, -0.8, 2.0]]) * 1e-7
OPTIONS = RegistrationOptions(
    spot_noise_px=0.005, scale_tolerance=0.0015, max_log10_false_alarms=-1.0, max_target_error_mm=100.0
)


def the_frame() -> Frame:
    """With a rod more, and no two known alike."""
    cube = cube_by_hand()
    return Frame(
        "unequal",
        (*cube.line_names, "g"),
        np.vstack([cube.starts, [-30, -10, -30]]),
        np.vstack([cube.ends, [10, -30, 30]]),
        np.ones(7),
        np.array([0.05, 0.1, 0.2, 0.02, 0.12, 0.08, 0.15]),
    )


def unequal(count: int, seed: int) -> Array:
    """Covariances (count, 2, 2), pixel^2: each long in a direction of its own."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(0, np.pi, count)
    axes = np.stack([np.stack([np.cos(turns), np.sin(turns)], -1), np.stack([-np.sin(turns), np.cos(turns)], -1)], -1)
    longs = np.geomspace(0.05, 0.3, count)
    return np.asarray((axes * np.stack([longs**2, (0.2 * longs) ** 2], -1)[:, None]) @ np.swapaxes(axes, 1, 2))


def offered(frame: Frame, pose: Pose, seed: int) -> tuple[Array, Array, Array]:
    """Spots (8, 2) in an order of their own, two of them false, one rod without; their covariances; each rod's row."""
    rng = np.random.default_rng(seed)
    predicted, cuts = project(frame, pose, SCALE)
    assert cuts.inside.all()
    lines = np.delete(np.arange(len(frame)), MISSING)
    covariances = unequal(8, seed)
    order = rng.permutation(8)
    spots = np.empty((8, 2))
    spots[order[:6]] = predicted[lines]
    spots[order[6:]] = [[20.0, 20.0], [280.0, 30.0]]
    spots += 0.5 * np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.standard_normal((8, 2)))
    rows = np.full(len(frame), -1)
    rows[lines] = order[:6]
    return spots, covariances, rows


def cut_mm(frame: Frame, pose: Pose) -> Array:
    return project(frame, pose, PixelScale(1.0, 1.0))[0]


def by_differences(frame: Frame, pose: Pose) -> Array:
    """d cut / d pose (n, 2, 6), by differences."""
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-5
        there, back = (cut_mm(frame, pose.perturbed(sign * step[:3], sign * step[3:])) for sign in (1, -1))
        columns.append((there - back) / 2e-5)
    return np.stack(columns, axis=-1)


def by_ends(frame: Frame, pose: Pose, line: int) -> Array:
    """d cut / d (start, end) (2, 6) of a rod, by differences."""
    columns = []
    for axis in range(6):
        step = np.zeros((2, len(frame), 3))
        step[axis // 3, line, axis % 3] = 1e-4
        there, back = (
            cut_mm(replace(frame, starts=frame.starts + sign * step[0], ends=frame.ends + sign * step[1]), pose)[line]
            for sign in (1, -1)
        )
        columns.append((there - back) / 2e-4)
    return np.stack(columns, axis=-1)


def blocks(parts: Array) -> Array:
    whole = np.zeros((2 * len(parts), 2 * len(parts)))
    for k, part in enumerate(parts):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = part
    return whole


def test_pose_and_covariance_are_those_of_generalised_least_squares() -> None:
    """All that makes spots uncertain at once: their centres, rods that are off, a scale that was measured."""
    frame = the_frame()
    spots, covariances, rows = offered(frame, TRUTH, 1)
    result = register_spots(
        spots, frame, SCALE, OPTIONS, PLANE, covariances_px2=covariances, scale_covariance=SCALE_COVARIANCE
    )
    assert result, result.message
    lines = [line for line in range(len(frame)) if line != MISSING]
    assert [match.line_index for match in result.matches] == lines
    assert [match.spot for match in result.matches] == rows[lines].tolist()

    pose = result.estimate.slice_from_frame
    predicted, _ = project(frame, pose, SCALE)
    for match in result.matches:
        np.testing.assert_array_equal(match.spot_px, spots[match.spot])
        np.testing.assert_allclose(match.predicted_px, predicted[match.line_index], atol=1e-9)
        # From the spot to the rod in space, not in the slice.
        spot = pose.inverse() @ np.append(SCALE.to_mm(match.spot_px), 0.0)
        start, end = frame.starts[match.line_index], frame.ends[match.line_index]
        away = np.linalg.norm(np.cross(spot - start, end - start)) / np.linalg.norm(end - start)
        assert match.residual_mm == pytest.approx(away, rel=1e-9)
    jacobian = by_differences(frame, pose)[lines].reshape(-1, 6)
    ends = [by_ends(frame, pose, line) * frame.tolerances_or(np.nan)[line] for line in lines]
    matrix = SCALE.matrix
    own = blocks(np.array([matrix @ covariances[rows[line]] @ matrix.T for line in lines]))
    own += blocks(np.array([end @ end.T for end in ends]))
    # By how much a scale that is off moves each spot, away from the point nearest to the scanner's origin.
    points_mm = spots[rows[lines]] @ matrix.T
    off_px = (points_mm - PLANE.inverse().translation[:2]) @ np.linalg.inv(matrix).T
    moved = np.zeros((len(lines), 2, 3))
    moved[:, 0, 0], moved[:, 1, 1], moved[:, 0, 2] = off_px[:, 0], off_px[:, 1], off_px[:, 1]
    of_scale = SCALE_COVARIANCE + np.diag([(0.0015 * SCALE.sx) ** 2, (0.0015 * SCALE.sy) ** 2, 0.0])
    apart = (moved - moved.mean(axis=0)).reshape(-1, 3)
    weights = np.linalg.inv(own + apart @ of_scale @ apart.T)
    follows = np.linalg.solve(jacobian.T @ weights @ jacobian, jacobian.T @ weights)

    # At the optimum nothing is left to follow: of a standard deviation, hardly anything.
    left = follows @ (points_mm - cut_mm(frame, pose)[lines]).ravel()
    stds = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ weights @ jacobian)))
    np.testing.assert_allclose(left / stds, 0.0, atol=0.01)
    whole = moved.reshape(-1, 3)
    expected = follows @ (own + whole @ of_scale @ whole.T) @ follows.T
    turn = np.kron(np.eye(2), PLANE.rotation)
    expected = turn @ expected @ turn.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(result.covariance / scale, expected / scale, atol=0.01)


def test_what_is_recognised_is_weighed_alike() -> None:
    frame = the_frame()
    spots, covariances, rows = offered(frame, TRUTH, 4)
    judged = register_spots(spots, frame, SCALE, OPTIONS, PLANE, covariances_px2=covariances)
    seen = recognise(SliceSpots(spots, SCALE, covariances, scanner_from_slice=PLANE), frame, OPTIONS)
    assert judged
    assert seen
    assert [match.spot for match in seen.matches] == rows[rows >= 0].tolist()
    np.testing.assert_allclose(seen.covariances_px2, covariances, rtol=1e-12)
    np.testing.assert_allclose(seen.estimate.covariance, judged.covariance, rtol=0.02, atol=1e-6)
    found, expected = seen.estimate.scanner_from_frame, judged.scanner_from_frame
    np.testing.assert_allclose(found.translation, expected.translation, atol=0.01)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-4)


def test_the_measured_scale_is_that_of_the_same_spots_in_the_rods_order() -> None:
    frame = the_frame()
    poses = [
        TRUTH,
        Pose(rotation_exp(np.array([-0.2, 0.1, 0.5])), np.array([60.0, 130.0, -6.0])),
        Pose(rotation_exp(np.array([0.2, 0.2, 1.2])), np.array([75.0, 110.0, 5.0])),
    ]
    slices, spots_px, used = [], np.zeros((3, 7, 2)), np.zeros((3, 7), dtype=bool)
    covariances = np.tile(np.eye(2), (3, 7, 1, 1))
    for number, pose in enumerate(poses):
        spots, own, rows = offered(frame, pose, 10 + number)
        slices.append(SliceSpots(spots, SCALE, own))
        lines = np.flatnonzero(rows >= 0)
        spots_px[number, lines], used[number, lines] = spots[rows[lines]], True
        covariances[number, lines] = own[rows[lines]]
    found = calibrate(slices, frame, SCALE, OPTIONS)
    assert isinstance(found, Calibration), found.message
    assert (found.slices, found.rods) == (3, 18)
    by_hand = calibrate_tolerantly(
        frame,
        frame.tolerances_or(np.nan),
        IdentifiedSpots(spots_px, used, covariances),
        ScaleAndPoses(
            SCALE, np.array([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses])
        ),
    )
    assert by_hand.converged
    # The shear was not to be measured.
    assert found.scale.shear == SCALE.shear
    assert (found.scale.sx, found.scale.sy) == pytest.approx((by_hand.scale.sx, by_hand.scale.sy), rel=1e-8)
    excess = max(by_hand.chi_square / by_hand.degrees_of_freedom, 1.0)
    np.testing.assert_allclose(found.covariance, excess * by_hand.covariance, rtol=1e-5)
