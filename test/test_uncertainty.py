"""Covariances and error balls against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.uncertainty import error_ball_95, in_scanner_axes, point_covariance


def random_covariance(rng: np.random.Generator, position: float, rotation: float) -> Array:
    root = rng.normal(size=(6, 6)) * np.array([position] * 3 + [rotation] * 3)[:, None]
    covariance: Array = root @ root.T
    return covariance


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(rotation_exp(rng.normal(size=3)), rng.normal(0, 100, 3))


class TestErrorBall:
    @pytest.mark.parametrize(
        "spectrum",
        [(1, 1, 0), (1, 0.5, 0.2), (1, 0.1, 0.1), (1, 0.9, 0.01), (9, 1, 1), (4, 4, 1), (1, 0.3, 0)],
        ids=str,
    )
    def test_holds_95_percent(self, spectrum: tuple[float, ...]) -> None:
        rng = np.random.default_rng(1)
        turn = rotation_exp(np.array([0.3, -1.0, 0.7]))
        radius = error_ball_95(turn @ np.diag(spectrum) @ turn.T)
        errors = rng.normal(size=(400_000, 3)) * np.sqrt(spectrum)
        assert radius == pytest.approx(np.quantile(np.linalg.norm(errors, axis=1), 0.95), rel=0.01)

    @pytest.mark.parametrize("variance", [1e-8, 0.25, 1e6])
    def test_exact_for_one_direction_and_for_three_equal_ones(self, variance: float) -> None:
        direction = np.array([2.0, -1.0, 2.0]) / 3
        assert error_ball_95(variance * np.outer(direction, direction)) == pytest.approx(
            np.sqrt(variance * chi2.ppf(0.95, 1))
        )
        assert error_ball_95(variance * np.eye(3)) == pytest.approx(np.sqrt(variance * chi2.ppf(0.95, 3)))

    def test_scales_with_the_error(self) -> None:
        covariance = np.diag([1.0, 0.5, 0.2])
        assert error_ball_95(9 * covariance) == pytest.approx(3 * error_ball_95(covariance))

    def test_no_error(self) -> None:
        assert error_ball_95(np.zeros((3, 3))) == 0.0

    def test_a_variance_below_zero_by_rounding(self) -> None:
        assert error_ball_95(np.diag([1.0, -1e-17, 0.0])) == pytest.approx(np.sqrt(chi2.ppf(0.95, 1)))


class TestPointCovariance:
    def test_against_perturbed_poses(self) -> None:
        rng = np.random.default_rng(2)
        covariance = random_covariance(rng, 0.5, 0.002)
        pose, point = random_pose(rng), np.array([120.0, -40.0, 60.0])
        count = 20_000
        moves = rng.multivariate_normal(np.zeros(6), covariance, count)
        moved = np.array([pose.perturbed(move[:3], move[3:]) @ point for move in moves])
        sample = np.cov(moved.T)
        stated = point_covariance(covariance, pose, point)
        # In axes in which the stated covariance is the unit matrix, the sample's entries have known errors.
        whitening = np.linalg.inv(np.linalg.cholesky(stated))
        np.testing.assert_allclose(whitening @ sample @ whitening.T, np.eye(3), atol=4.5 * np.sqrt(2 / count))

    def test_at_the_origin_it_is_the_position_alone(self) -> None:
        rng = np.random.default_rng(3)
        covariance = random_covariance(rng, 1.0, 0.01)
        np.testing.assert_allclose(point_covariance(covariance, random_pose(rng), np.zeros(3)), covariance[:3, :3])

    def test_rotation_alone_moves_across_the_arm(self) -> None:
        covariance = np.diag([0.0, 0, 0, 0, 0, 0.01**2])
        pose = Pose(rotation_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([5.0, 6.0, 7.0]))
        moved = point_covariance(covariance, pose, np.array([100.0, 0.0, 0.0]))
        np.testing.assert_allclose(moved, np.diag([1.0, 0.0, 0.0]), atol=1e-12)


class TestScannerAxes:
    def test_is_the_perturbation_of_scanner_from_frame(self) -> None:
        rng = np.random.default_rng(4)
        scanner_from_slice, slice_from_frame = random_pose(rng), random_pose(rng)
        directions = np.eye(6)
        for k in range(6):
            step = 1e-3 * directions[k]
            moved = scanner_from_slice @ slice_from_frame.perturbed(step[:3], step[3:])
            rest = scanner_from_slice @ slice_from_frame
            # The same step told in scanner axes, from the covariance that knows this direction alone.
            told = in_scanner_axes(np.outer(step, step), scanner_from_slice)
            values, vectors = np.linalg.eigh(told)
            turned = vectors[:, -1] * np.sqrt(values[-1])
            candidates = [rest.perturbed(sign * turned[:3], sign * turned[3:]) for sign in (1, -1)]
            errors = [
                np.abs(c.rotation - moved.rotation).max() + np.abs(c.translation - moved.translation).max()
                for c in candidates
            ]
            assert min(errors) < 1e-9
            assert max(errors) > 1e-4

    def test_couples_position_and_rotation_as_before(self) -> None:
        rng = np.random.default_rng(5)
        covariance, pose = random_covariance(rng, 1.0, 0.1), random_pose(rng)
        turned = in_scanner_axes(covariance, pose)
        r = pose.rotation
        np.testing.assert_allclose(turned[:3, 3:], r @ covariance[:3, 3:] @ r.T, atol=1e-12)
        np.testing.assert_allclose(in_scanner_axes(turned, pose.inverse()), covariance, atol=1e-12)
        np.testing.assert_allclose(in_scanner_axes(covariance, Pose.identity()), covariance)
