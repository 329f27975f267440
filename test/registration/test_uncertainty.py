"""Covariances and error balls against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2, kstest

from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.uncertainty import (
    ScaleMisfit,
    Whitened,
    checked_scale_covariance,
    cramer_rao_pose,
    enclosing_covariance,
    error_ball_95,
    in_scanner_axes,
    point_covariance,
)
from support.frames import cube_by_hand


def random_covariance(rng: np.random.Generator, position: float, rotation: float) -> Array:
    root = rng.normal(size=(6, 6)) * np.array([position] * 3 + [rotation] * 3)[:, None]
    covariance: Array = root @ root.T
    return covariance


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(rotation_exp(rng.normal(size=3)), rng.normal(0, 100, 3))


class TestEnclosingCovariance:
    def test_is_nowhere_smaller_than_either_and_no_larger_than_it_has_to_be(self) -> None:
        rng = np.random.default_rng(9)
        for _ in range(20):
            one, other = random_covariance(rng, 2.0, 0.01), random_covariance(rng, 1.0, 0.02)
            both = enclosing_covariance(one, other)
            # In units in which the enclosing one is the identity.
            back = np.linalg.inv(np.linalg.cholesky(both))
            within = [np.linalg.eigvalsh(back @ inner @ back.T) for inner in (one, other)]
            assert max(part.max() for part in within) == pytest.approx(1.0, abs=1e-6)
            assert sum((part > 1 - 1e-6).sum() for part in within) == 6, "each axis touches one of the two"

    def test_of_one_within_the_other_is_the_other(self) -> None:
        large = random_covariance(np.random.default_rng(10), 1.0, 0.01)
        np.testing.assert_allclose(enclosing_covariance(0.3 * large, large), large, rtol=1e-6)
        np.testing.assert_allclose(enclosing_covariance(large, 0.3 * large), large, rtol=1e-6)


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


class TestCramerRao:
    def test_is_that_of_the_given_rods_in_oblong_pixels(self) -> None:
        frame, scale = cube_by_hand(), PixelScale(0.4, 0.7, 0.05)
        pose = Pose(rotation_exp(np.array([0.1, -0.2, 0.7])), np.array([60.0, 80.0, 5.0]))
        lines = np.array([5, 1, 3, 4])
        columns = []
        for axis in range(6):
            step = 1e-5 * np.eye(6)[axis]
            there, back = (project(frame, pose.perturbed(s * step[:3], s * step[3:]), scale)[0] for s in (1, -1))
            columns.append((there - back)[lines].ravel() / 2e-5)
        jacobian = np.stack(columns, axis=-1)
        expected = 0.3**2 * np.linalg.inv(jacobian.T @ jacobian)
        np.testing.assert_allclose(cramer_rao_pose(frame, lines, pose, scale, 0.3), expected, rtol=1e-4, atol=1e-9)


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


def whitened(rng: np.random.Generator, rods: int, scales: int = 2, others: int = 1) -> Whitened:
    """Residuals of so many rods with Jacobians drawn at random, at the pose at which they fit best."""
    count, errors = 2 * rods, scales + others
    by_pose, by_common = rng.normal(size=(count, 6)), 0.7 * rng.normal(size=(count, errors))
    residual = rng.normal(size=count) + by_common @ rng.normal(size=errors)
    joint = np.vstack([np.hstack([by_pose, by_common]), np.eye(6 + errors)[6:]])
    best = np.linalg.lstsq(joint, np.append(residual, np.zeros(errors)), rcond=None)[0]
    shifts = np.zeros((6, errors))
    shifts[:2, :scales] = rng.normal(size=(2, scales))
    return Whitened(by_pose, by_common, residual - by_pose @ best[:6], shifts, np.arange(errors) < scales)


def chi_square(given: Whitened, free: NDArray[np.bool_]) -> float:
    """Least sum of squares over the pose and the shared errors, of which those that are `free` may be of any size."""
    errors = given.by_common.shape[1]
    joint = np.vstack([np.hstack([given.by_pose, given.by_common]), np.eye(6 + errors)[6:][~free]])
    wanted = np.append(given.residual, np.zeros((~free).sum()))
    best = np.linalg.lstsq(joint, wanted, rcond=None)[0]
    return float(((joint @ best - wanted) ** 2).sum())


class TestWhitened:
    def test_shifts_add_to_the_covariance_what_errors_that_move_all_spots_do(self) -> None:
        """Of the errors of poses that weigh their spots by what is known of them, drawn at random."""
        rng = np.random.default_rng(6)
        given = whitened(rng, 6)
        count = 400_000
        errors = rng.standard_normal((count, 3))
        residuals = rng.standard_normal((count, 12)) + errors @ given.by_common.T
        weights = np.linalg.inv(np.eye(12) + given.by_common @ given.by_common.T)
        information = given.by_pose.T @ weights @ given.by_pose
        fitted = residuals @ np.linalg.solve(information, given.by_pose.T @ weights).T
        off = fitted + errors @ given.shifts.T
        stated = np.linalg.inv(information) + given.covariance_by_shifts()
        whitening = np.linalg.inv(np.linalg.cholesky(stated))
        sample = whitening @ (off.T @ off / count) @ whitening.T
        np.testing.assert_allclose(sample, np.eye(6), atol=4.5 * np.sqrt(2 / count))
        # Which the square of the shifts alone would not be.
        assert np.abs(given.covariance_by_shifts() - given.shifts @ given.shifts.T).max() > 0.01

    def test_without_shifts_nothing_is_added(self) -> None:
        given = whitened(np.random.default_rng(7), 5)
        assert not given._replace(shifts=np.zeros((6, 3))).covariance_by_shifts().any()

    @pytest.mark.parametrize("rods", [5, 6, 9])
    def test_scale_misfit_is_what_chi_square_falls_by(self, rods: int) -> None:
        rng = np.random.default_rng(8)
        for _ in range(20):
            given = whitened(rng, rods)
            fall = chi_square(given, np.zeros(3, dtype=bool)) - chi_square(given, given.scale)
            assert given.scale_misfit().fall == pytest.approx(fall, rel=1e-7)

    @pytest.mark.parametrize("scales", [2, 3])
    def test_scale_misfit_of_stated_errors_is_chi_square_distributed(self, scales: int) -> None:
        rng = np.random.default_rng(9)
        misfits = [whitened(rng, 7, scales).scale_misfit() for _ in range(1500)]
        assert kstest([one.fall for one in misfits], chi2(scales).cdf).pvalue > 1e-3
        assert kstest([one.probability for one in misfits], "uniform").pvalue > 1e-3

    def test_a_scale_that_nothing_shows_is_not_judged(self) -> None:
        """Three rods fit any scale: what they say of it is rounding."""
        rng = np.random.default_rng(10)
        values = [whitened(rng, 3).scale_misfit().fall for _ in range(50)]
        assert max(values) < 1e-3

    def test_scale_misfit_says_how_well_the_scale_was_stated(self) -> None:
        given = whitened(np.random.default_rng(13), 6)
        assert given._replace(scale_std=0.004).scale_misfit()[1:] == (2, 0.004)

    def test_a_scale_without_an_error_has_no_misfit(self) -> None:
        given = whitened(np.random.default_rng(11), 6, scales=0, others=2)
        assert given.scale_misfit() == ScaleMisfit()
        none = whitened(np.random.default_rng(12), 6, scales=0, others=0)
        assert none.scale_misfit().probability == 1.0
        assert none.covariance_by_shifts().shape == (6, 6)


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
