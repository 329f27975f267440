"""Covariances and error balls against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from frames import random_frame, random_slice_from_frame
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.maximum_likelihood import refine
from stereoreg_ros.uncertainty import (
    checked_scale_covariance,
    error_ball_95,
    in_scanner_axes,
    point_covariance,
    scale_sensitivity,
)


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


def exact_probability(radius: float, variances: Array) -> float:
    """That a Gaussian error of the given variances lies within the radius, by integration over its directions."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    height, height_weights = 0.5 * (nodes + 1), 0.5 * weights
    turn, turn_weights = np.pi / 4 * (nodes + 1), 0.5 * weights
    # In axes in which the error is round, a direction's length is chi distributed with three degrees of freedom.
    first, second, third = np.sort(variances)[::-1]
    across = second * np.cos(turn) ** 2 + third * np.sin(turn) ** 2
    along = first * height[:, None] ** 2 + (1 - height[:, None] ** 2) * across
    return float(height_weights @ chi2.cdf(radius**2 / along, 3) @ turn_weights)


def test_the_ball_is_within_0_3_percent_of_exact_over_every_covariance() -> None:
    held = [
        exact_probability(
            error_ball_95(np.diag([1.0, second, second * third])), np.array([1.0, second, second * third])
        )
        for second in (1e-3, 0.01, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.85, 1.0)
        for third in (1e-3, 0.03, 0.1, 0.25, 0.5, 0.75, 1.0)
    ]
    print(f"the ball holds {100 * min(held):.2f} to {100 * max(held):.2f} %")
    assert min(held) > 0.9499
    assert max(held) < 0.953


class TestScaleSensitivity:
    @pytest.mark.parametrize("shear", [0.0, 0.02])
    def test_is_how_the_maximum_likelihood_pose_follows_the_scale(self, shear: float) -> None:
        rng = np.random.default_rng(6)
        frame = random_frame(rng, 7)
        lines = np.array([0, 2, 3, 4, 6])
        truth = random_slice_from_frame(rng, frame)
        scale = PixelScale(0.45, 0.6, shear)
        spots = project(frame, truth, scale)[0][lines] + rng.normal(0, 0.02, (5, 2))
        root = rng.normal(size=(5, 2, 2))
        covariances = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2)

        def pose_at(changed: PixelScale, start: Pose) -> Pose:
            # The weights stay those of the told scale: that they follow it matters only where there are residuals.
            spots_mm, used = np.zeros((1, 7, 2)), np.zeros((1, 7), dtype=bool)
            whitening = np.tile(np.eye(2), (1, 7, 1, 1))
            spots_mm[0, lines], used[0, lines] = changed.to_mm(spots), True
            whitening[0, lines] = np.linalg.inv(np.linalg.cholesky(scale.matrix @ covariances @ scale.matrix.T))
            found = refine(frame, start.rotation[None], start.translation[None], spots_mm, used, whitening, 100)
            return Pose(nearest_rotation(found.rotations[0]), found.translations[0])

        rest = pose_at(scale, truth)
        stated = scale_sensitivity(frame, lines, rest, spots, covariances, scale)
        step = 1e-4
        for column, name in enumerate(("sx", "sy", "shear")):
            more = pose_at(replace(scale, **{name: getattr(scale, name) + step}), rest)
            less = pose_at(replace(scale, **{name: getattr(scale, name) - step}), rest)
            turn = Rotation.from_matrix(more.rotation @ less.rotation.T).as_rotvec()
            moved = np.concatenate([more.translation - less.translation, turn]) / (2 * step)
            size = np.array([np.abs(stated[:3]).max()] * 3 + [np.abs(stated[3:]).max()] * 3)
            np.testing.assert_allclose(moved / size, stated[:, column] / size, atol=5e-3, err_msg=name)

    def test_a_shift_by_the_spacing_is_a_shift_of_the_pose(self) -> None:
        """All spots in one place but for the frame's size: far from the pixels' origin, a scale is a shift."""
        rng = np.random.default_rng(7)
        frame = random_frame(rng, 6)
        pose = Pose(np.eye(3), np.array([1e5, 0.0, 0.0]))
        scale = PixelScale(0.5, 0.5)
        spots = project(frame, pose, scale)[0]
        stated = scale_sensitivity(frame, np.arange(6), pose, spots, np.tile(np.eye(2), (6, 1, 1)), scale)
        assert stated[0, 0] == pytest.approx(2e5, rel=0.01)


class TestScaleCovariance:
    def test_two_numbers_say_nothing_of_the_shear(self) -> None:
        whole = checked_scale_covariance([[4.0, 1.0], [1.0, 9.0]])
        np.testing.assert_array_equal(whole, [[4, 1, 0], [1, 9, 0], [0, 0, 0]])
        np.testing.assert_array_equal(checked_scale_covariance(np.diag([1.0, 2.0, 3.0])), np.diag([1.0, 2.0, 3.0]))

    @pytest.mark.parametrize(
        ("given", "sentence"),
        [
            ([1.0, 2.0], r"scale_covariance has shape \(2,\), expected \(2, 2\) or \(3, 3\)"),
            (np.eye(4), r"scale_covariance has shape \(4, 4\)"),
            ([[1.0, np.nan], [np.nan, 1.0]], "scale_covariance is .*, expected a finite and symmetric matrix"),
            ([[1.0, np.inf], [np.inf, 1.0]], "expected a finite and symmetric matrix"),
            ([[1.0, 0.5], [0.4, 1.0]], "expected a finite and symmetric matrix"),
            ([[1.0, 2.0], [2.0, 1.0]], "expected no negative variance"),
            (np.diag([1e-8, -1e-9]), "expected no negative variance"),
        ],
        ids=str,
    )
    def test_what_is_none_is_named(self, given: object, sentence: str) -> None:
        with pytest.raises(ValueError, match=sentence):
            checked_scale_covariance(given)  # type: ignore[arg-type]
