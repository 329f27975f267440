"""Worst cases of the maximum-likelihood pose: never exceeded, nearly reached, none where nothing can be proven."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoreg_ros import RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.simulation import ScannerSettings, random_pose
from stereoreg_ros.solvers.error_bounds import LinearErrorModel
from stereoreg_ros.solvers.maximum_likelihood import refine
from stereoreg_ros.solvers.pose_error_bounds import PoseErrorModel
from stereoreg_ros.worst_case import worst_case
from support.frames import random_frame, random_slice_from_frame

SCALE = PixelScale(0.45, 0.55, 0.01)
TARGET_MM = np.array([20.0, -30.0, 90.0])


@dataclass(frozen=True, eq=False)
class Scene:
    """Spots with errors, and the pose of maximum likelihood for them."""

    frame: Frame
    spots: Array
    covariances: Array
    truth: Pose
    pose: Pose

    @property
    def model(self) -> PoseErrorModel:
        n = len(self.frame)
        return PoseErrorModel(self.frame, np.arange(n), self.pose, self.spots, self.covariances, SCALE)

    def errors(self, errors_px: Array) -> tuple[Array, Array]:
        """Of poses for spots moved by (m, 2n): as in `Pose.perturbed` (m, 6), and at the target (m,) mm."""
        rotations, translations = solved(self.frame, self.pose, self.spots, self.covariances, errors_px)
        turns = Rotation.from_matrix(rotations @ self.pose.rotation.T).as_rotvec()
        moved = rotations @ TARGET_MM + translations - self.pose @ TARGET_MM
        return np.hstack([translations - self.pose.translation, turns]), np.linalg.norm(moved, axis=1)


def solved(frame: Frame, start: Pose, spots: Array, covariances: Array, errors_px: Array) -> tuple[Array, Array]:
    m, n = len(errors_px), len(frame)
    moved = spots + np.stack([errors_px[:, :n], errors_px[:, n:]], axis=-1)
    whitening = np.linalg.inv(np.linalg.cholesky(SCALE.matrix @ covariances @ SCALE.matrix.T))
    rotations, translations = (np.tile(part, (m, *(1,) * part.ndim)) for part in (start.rotation, start.translation))
    used = np.ones((m, n), dtype=bool)
    found = refine(frame, rotations, translations, SCALE.to_mm(moved), used, np.tile(whitening, (m, 1, 1, 1)), 200)
    return found.rotations, found.translations


def scene(seed: int, n: int, error_px: float) -> Scene:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, n)
    truth = random_slice_from_frame(rng, frame)
    spots = project(frame, truth, SCALE)[0] + rng.uniform(-error_px, error_px, (n, 2))
    root = rng.normal(size=(n, 2, 2))
    covariances = 0.01 * (root @ np.swapaxes(root, 1, 2) + 0.5 * np.eye(2))
    pose = truth
    for _ in range(3):
        rotations, translations = solved(frame, pose, spots, covariances, np.zeros((1, 2 * n)))
        pose = Pose(nearest_rotation(rotations[0]), translations[0])
    return Scene(frame, spots, covariances, truth, pose)


@pytest.mark.parametrize("n", [4, 6])
def test_sensitivity_is_the_derivative_of_the_pose(n: int) -> None:
    given = scene(n, n, 0.0)
    step = 0.005
    both = np.concatenate([step * np.eye(2 * n), -step * np.eye(2 * n)])
    errors = given.errors(both)[0]
    expected = (errors[: 2 * n] - errors[2 * n :]).T / (2 * step)
    size = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(given.model.sensitivity / size, expected / size, atol=2e-3)


@pytest.mark.parametrize(("n", "error_px"), [(5, 0.001), (6, 0.001), (6, 0.02), (8, 0.03)])
def test_is_never_exceeded_and_nearly_reached(n: int, error_px: float) -> None:
    rng = np.random.default_rng(100 * n)
    proven, reached = 0, []
    for seed in range(12):
        given = scene(1000 * n + seed, n, error_px)
        model = given.model
        reach = model.reach(error_px)
        if reach is None:
            continue
        proven += 1
        functionals = [*np.eye(6), model.displacement(TARGET_MM)]
        corners = np.array([model.worst_corner(one, error_px) for one in functionals])
        inside = rng.uniform(-error_px, error_px, (150, 2 * n))
        errors, at_target = given.errors(
            np.concatenate([corners, -corners, inside, np.where(inside < 0, -1, 1) * error_px])
        )
        bounds = np.array([reach.bound(one) for one in np.eye(6)])
        limit = reach.point_mm(TARGET_MM)
        assert (np.abs(errors) <= bounds).all()
        assert (at_target <= limit).all()
        # The true pose is that of spots whose errors are taken back.
        assert np.linalg.norm(given.truth @ TARGET_MM - given.pose @ TARGET_MM) <= limit
        reached.append(np.append(np.abs(np.diag(errors)[:6]) / bounds, at_target[6] / limit).min())
        for direction in rng.normal(size=(3, 6)):
            assert (np.abs(errors @ direction) <= reach.bound(direction)).all()
    print(f"{proven} of 12 proven, {np.round(reached, 2).tolist()} of the bounds reached")
    # Frames drawn at random are ill conditioned: already 0.02 pixel is beyond the range in which they are linear.
    assert proven >= 6
    if error_px < 0.01:
        assert proven == 12
        assert min(reached) >= 0.9


def test_grows_with_the_error_until_nothing_can_be_proven() -> None:
    model = scene(7, 6, 0.0).model
    found = [model.reach(error_px) for error_px in (0.0, 1e-3, 0.01, 0.02, 30.0)]
    assert found[-1] is None
    sizes = [reach.point_mm(TARGET_MM) for reach in found[:-1] if reach is not None]
    assert len(sizes) == 4
    assert sizes[0] == 0.0
    assert np.diff(sizes).min() > 0
    # To first order twice the error is twice as far; the rest is of second order.
    assert sizes[3] > 2 * sizes[2]
    assert sizes[2] / 0.01 == pytest.approx(sizes[1] / 1e-3, rel=0.2)


@pytest.mark.parametrize("error", [-0.1, np.nan, np.inf])
def test_error_that_is_none(error: float) -> None:
    with pytest.raises(ValueError, match=r"max_error_px is .*, expected a finite number that is not negative"):
        scene(7, 6, 0.0).model.reach(error)


class TestGreatestLength:
    @staticmethod
    def by_all_corners(sensitivity: Array, limits: Array) -> float:
        corners = np.array(list(product([-1.0, 1.0], repeat=sensitivity.shape[1]))) * limits
        return float(np.linalg.norm(corners @ sensitivity.T, axis=1).max())

    def check(self, sensitivity: Array, limits: Array) -> None:
        length, corner = LinearErrorModel(sensitivity).greatest_length(limits)
        assert length == pytest.approx(self.by_all_corners(sensitivity, limits), rel=1e-9)
        np.testing.assert_allclose(np.abs(corner), np.broadcast_to(limits, corner.shape))
        assert np.linalg.norm(sensitivity @ corner) == pytest.approx(length)

    def test_against_all_corners(self) -> None:
        rng = np.random.default_rng(1)
        for m in range(1, 12):
            for _ in range(4):
                self.check(rng.normal(size=(3, m)) * rng.uniform(0.01, 3, (3, 1)), rng.uniform(0, 1, m))

    def test_against_all_corners_where_many_directions_are_alike(self) -> None:
        """Small whole numbers: many in one plane, many parallel, some zero."""
        rng = np.random.default_rng(2)
        for _ in range(150):
            self.check(rng.integers(-1, 2, (3, int(rng.integers(1, 11)))).astype(float), np.ones(1))

    @pytest.mark.parametrize("rank", [0, 1, 2])
    def test_against_all_corners_of_a_flat_one(self, rank: int) -> None:
        rng = np.random.default_rng(3)
        for _ in range(20):
            self.check(rng.normal(size=(3, rank)) @ rng.normal(size=(rank, 9)), np.ones(9))


class TestWorstCase:
    SCANNER = ScannerSettings()
    ERROR_PX = 0.05

    def test_of_a_registration_in_scanner_axes(self) -> None:
        frame, rng = load_frame("cube6"), np.random.default_rng(5)
        plane = Pose(Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix(), np.array([50.0, 60.0, 70.0]))
        options = RegistrationOptions(spot_noise_px=0.05, target_in_frame_mm=(0.0, 0.0, 100.0))
        nearest = np.zeros(7)
        for _ in range(10):
            truth = random_pose(rng, frame, self.SCANNER)
            off = self.ERROR_PX * np.where(rng.uniform(size=(6, 2)) < 0.5, -1, 1)
            spots = project(frame, truth, self.SCANNER.scale)[0] + off
            result = register_spots(spots, frame, self.SCANNER.scale, options, scanner_from_slice=plane)
            assert result
            bounds = worst_case(result, self.ERROR_PX)
            assert bounds is not None
            true, stated = plane @ truth, result.scanner_from_frame
            turn = np.degrees(Rotation.from_matrix(true.rotation @ stated.rotation.T).as_rotvec())
            target = np.array(options.target_in_frame_mm)
            shares = np.concatenate(
                [
                    np.abs(true.translation - stated.translation) / bounds.position_mm,
                    np.abs(turn) / bounds.rotation_deg,
                    [np.linalg.norm(true @ target - stated @ target) / bounds.target_error_mm],
                ]
            )
            assert (shares <= 1).all()
            nearest = np.maximum(nearest, shares)
        # Axes that were mixed up would be exceeded, or nowhere near.
        assert nearest.min() > 0.3

    def test_along_the_axes_of_the_scanner(self) -> None:
        """A quarter turn of the slice about z has x and y, and the rotations about them, change places."""
        frame = load_frame("cube6")
        truth = random_pose(np.random.default_rng(6), frame, self.SCANNER)
        spots = project(frame, truth, self.SCANNER.scale)[0]
        turned = Pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.zeros(3))
        found = []
        for plane in (Pose.identity(), turned):
            result = register_spots(spots, frame, self.SCANNER.scale, scanner_from_slice=plane)
            assert result
            bounds = worst_case(result, self.ERROR_PX)
            assert bounds is not None
            found.append(bounds)
        np.testing.assert_allclose(found[1].position_mm, found[0].position_mm[[1, 0, 2]], rtol=1e-6)
        np.testing.assert_allclose(found[1].rotation_deg, found[0].rotation_deg[[1, 0, 2]], rtol=1e-6)
        assert abs(found[0].position_mm[0] / found[0].position_mm[1] - 1) > 0.02
