"""Scale and pose from five or more rods: exact on exact data, at the constrained minimum on noisy data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers import joint_calibration, tolerant_calibration
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import (
    ScaleSolution,
    calibrate_linear,
    calibrate_maximum_likelihood,
    calibrate_newton_raphson,
    calibration_covariance,
)
from stereoreg_ros.solvers.identified import IdentifiedSpots, ScaleAndPoses
from stereoreg_ros.solvers.joint_calibration import JointScale, calibrate_jointly
from stereoreg_ros.solvers.linear_system import MAX_CONDITION
from stereoreg_ros.solvers.tolerant_calibration import TolerantScale, calibrate_tolerantly
from support.frames import random_frame, random_slice_from_frame

SCALE = PixelScale(0.48, 0.52)
SHEARED = PixelScale(0.48, 0.52, 0.03)
LINEAR_AND_NEWTON = (calibrate_linear, calibrate_newton_raphson)
SOLVERS = (*LINEAR_AND_NEWTON, calibrate_maximum_likelihood)

# Eight rods between the lower and the upper face of a cube of 60 mm, drawn for this test: no three in one plane, no two
# parallel. Figures 6 and 7 of the paper are for eight lines, whose layout it does not give.
EIGHT_RODS = Frame(
    "eight rods",
    tuple("abcdefgh"),
    np.array(
        [
            [30.0, -26, -30],
            [-26, 30, -30],
            [-30, 26, -30],
            [24, -30, -30],
            [-10, -8, -30],
            [12, 6, -30],
            [-4, 20, -30],
            [16, -16, -30],
        ]
    ),
    np.array(
        [
            [30.0, 24, 30],
            [22, 30, 30],
            [-30, -24, 30],
            [-26, -30, 30],
            [14, 8, 30],
            [-18, 10, 30],
            [8, -14, 30],
            [2, 20, 30],
        ]
    ),
    np.ones(8),
)


def scene(seed: int, n: int, scale: PixelScale = SCALE) -> tuple[Frame, Pose, Array]:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, n)
    pose = random_slice_from_frame(rng, frame)
    return frame, pose, project(frame, pose, scale)[0]


def residual(frame: Frame, spots_px: Array, x: Array) -> Array:
    """Eq. 8 of Maurin 2009, point by point: y x (l1 u + l2 v + t) - w, (3 n,) mm."""
    points = spots_px @ np.stack([x[:3], x[3:6]]) + x[6:]
    misfit: Array = np.cross(frame.directions, points) - frame.moments
    return misfit.ravel()


class TestExact:
    @pytest.mark.parametrize("solve", SOLVERS)
    @pytest.mark.parametrize("n", [5, 6, 8, 12])
    def test_is_recovered(self, n: int, solve: type) -> None:
        for seed in range(4):
            frame, pose, spots = scene(100 * n + seed, n)
            found = solve(frame, np.arange(n), spots)
            assert found.scale.sx == pytest.approx(SCALE.sx, abs=1e-9)
            assert found.scale.sy == pytest.approx(SCALE.sy, abs=1e-9)
            assert found.scale.shear == 0
            np.testing.assert_allclose(found.frame_from_slice.translation, pose.inverse().translation, atol=1e-9)
            assert rotation_angle(found.frame_from_slice.rotation @ pose.rotation) < 1e-9
            assert found.converged
            np.testing.assert_allclose(residual(frame, spots, found.unknowns), 0, atol=1e-9)

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_rods_by_their_rows_in_any_order(self, solve: type) -> None:
        frame, pose, spots = scene(7, 9)
        lines = np.array([8, 1, 3, 0, 6, 5])
        found = solve(frame, lines, spots[lines])
        assert found.scale.sx == pytest.approx(SCALE.sx, abs=1e-9)
        np.testing.assert_allclose(found.frame_from_slice.translation, pose.inverse().translation, atol=1e-9)

    def test_steps_that_do_not_end_have_not_converged(self, monkeypatch: pytest.MonkeyPatch) -> None:
        series = Series(np.random.default_rng(78), EIGHT_RODS, 1, np.zeros(8))
        assert calibrate_newton_raphson(EIGHT_RODS, np.arange(8), series.spots_px[0]).converged
        monkeypatch.setattr("stereoreg_ros.solvers.newton_raphson._MAX_ITERATIONS", 1)
        assert not calibrate_newton_raphson(EIGHT_RODS, np.arange(8), series.spots_px[0]).converged

    def test_counts_its_steps(self) -> None:
        frame, _, spots = scene(8, 6)
        assert calibrate_linear(frame, np.arange(6), spots).iterations == 0
        assert 1 <= calibrate_newton_raphson(frame, np.arange(6), spots).iterations <= 5


class TestNoisy:
    @pytest.mark.parametrize("n", [5, 6, 8])
    def test_newton_raphson_is_at_the_constrained_minimum(self, n: int) -> None:
        rng = np.random.default_rng(11)
        frame, _, exact = scene(10 + n, n)
        spots = exact + rng.normal(0, 0.3, (n, 2))
        linear, found = (solve(frame, np.arange(n), spots) for solve in LINEAR_AND_NEWTON)
        x = found.unknowns
        assert found.converged
        assert abs(linear.unknowns[:3] @ linear.unknowns[3:6]) > 1e-6
        assert x[:3] @ x[3:6] == pytest.approx(0, abs=1e-14)
        # Gradient of the Lagrangian by finite differences, pixels to millimetres weighed alike.
        units = np.array([1e-2] * 6 + [1.0] * 3)

        def gradient(at: Array) -> Array:
            cost = [
                (residual(frame, spots, at + sign * 1e-3 * units * row) ** 2).sum()
                for row in np.eye(9)
                for sign in (1, -1)
            ]
            return np.diff(np.reshape(cost, (9, 2))[:, ::-1], axis=1)[:, 0] / 2e-3

        constraint = units * np.concatenate([x[3:6], x[:3], np.zeros(3)])
        slope = gradient(x)
        multiplier = -(slope @ constraint) / (constraint @ constraint)
        np.testing.assert_allclose(slope + multiplier * constraint, 0, atol=1e-6)
        assert np.abs(slope).max() > 1e-4
        # The linear solution is the minimum without the constraint.
        np.testing.assert_allclose(gradient(linear.unknowns), 0, atol=1e-6)
        assert (residual(frame, spots, x) ** 2).sum() >= (residual(frame, spots, linear.unknowns) ** 2).sum()

    @pytest.mark.parametrize("noise_px", [0.0, 0.5, 1.0, 1.5, 2.0])
    def test_errors_of_figures_6_and_7(self, noise_px: float) -> None:
        """Newton-Raphson better than the linear solution at every level; maximum likelihood no worse than that.

        60 random poses that have every rod cut, on the paper's scale of 0.5 mm/pixel.
        """
        rng = np.random.default_rng(12)
        lines, scale = np.arange(8), PixelScale(0.5, 0.5)
        errors = np.zeros((3, 60))
        for trial in range(60):
            spots = project(EIGHT_RODS, random_slice_from_frame(rng, EIGHT_RODS), scale)[0]
            spots += rng.uniform(-noise_px, noise_px, (8, 2))
            for row, solve in enumerate(SOLVERS):
                found = solve(EIGHT_RODS, lines, spots).scale
                errors[row, trial] = (abs(found.sx - scale.sx) + abs(found.sy - scale.sy)) / 2
        linear, newton, likelihood = errors.mean(axis=1)
        if noise_px == 0:
            assert errors.max() < 1e-12
        else:
            assert newton < linear
            assert likelihood < 1.02 * newton
            assert 1e-3 * noise_px < newton < 0.02 * noise_px


class TestShear:
    @pytest.mark.parametrize("solve", [calibrate_linear, calibrate_maximum_likelihood])
    @pytest.mark.parametrize("n", [5, 6, 8])
    def test_is_recovered_where_asked_for(self, n: int, solve: type) -> None:
        for seed in range(4):
            frame, pose, spots = scene(300 * n + seed, n, SHEARED)
            found = solve(frame, np.arange(n), spots, with_shear=True)
            for name in ("sx", "sy", "shear"):
                assert getattr(found.scale, name) == pytest.approx(getattr(SHEARED, name), abs=1e-9)
            np.testing.assert_allclose(found.frame_from_slice.translation, pose.inverse().translation, atol=1e-9)
            assert rotation_angle(found.frame_from_slice.rotation @ pose.rotation) < 1e-9
            # Eq. 4: |l1| = sx, |l2|^2 = sy^2 + g^2, l1 . l2 = sx g.
            l1, l2 = found.unknowns[:3], found.unknowns[3:6]
            assert l1 @ l2 == pytest.approx(SHEARED.sx * SHEARED.shear, abs=1e-10)
            assert l2 @ l2 == pytest.approx(SHEARED.sy**2 + SHEARED.shear**2, abs=1e-10)

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_is_neglected_otherwise(self, solve: type) -> None:
        """Eq. 5 says g = 0: then |l2| is taken for sy, and Newton-Raphson forces the axes to a right angle."""
        frame, _, spots = scene(30, 8, SHEARED)
        found = solve(frame, np.arange(8), spots)
        assert found.scale.shear == 0
        assert abs(found.scale.sx - SHEARED.sx) + abs(found.scale.sy - SHEARED.sy) > 1e-4
        if solve is not calibrate_linear:
            assert found.unknowns[:3] @ found.unknowns[3:6] == pytest.approx(0, abs=1e-14)
        assert found.converged

    def test_that_is_not_there_is_not_found(self) -> None:
        frame, _, spots = scene(31, 8)
        for solve in (calibrate_linear, calibrate_maximum_likelihood):
            assert solve(frame, np.arange(8), spots, with_shear=True).scale.shear == pytest.approx(0, abs=1e-10)


class TestMaximumLikelihood:
    NOISE_PX = 0.3

    @staticmethod
    def cost(frame: Frame, spots: Array, pose: Pose, scale: PixelScale) -> float:
        """Sum of the squared residuals in the image, px^2."""
        return float(((project(frame, pose, scale)[0] - spots) ** 2).sum())

    def moved(self, found: ScaleSolution, step: Array) -> tuple[Pose, PixelScale]:
        """Steps in (sx, sy, shear) 1e-3 mm/pixel, position mm, rotation 1/50 rad."""
        scale = found.scale
        pose = found.frame_from_slice.inverse().perturbed(step[3:6], step[6:] / 50)
        return pose, PixelScale(*np.array([scale.sx, scale.sy, scale.shear]) + 1e-3 * step[:3])

    @pytest.mark.parametrize("with_shear", [False, True])
    @pytest.mark.parametrize("n", [5, 6, 8])
    def test_is_a_minimum_in_the_image(self, n: int, with_shear: bool) -> None:
        frame, _, exact = scene(40 + n, n, SHEARED if with_shear else SCALE)
        spots = exact + np.random.default_rng(41).normal(0, self.NOISE_PX, exact.shape)
        linear = calibrate_linear(frame, np.arange(n), spots, with_shear)
        found = calibrate_maximum_likelihood(frame, np.arange(n), spots, with_shear=with_shear)
        assert found.converged
        unknowns = [row for row in range(9) if with_shear or row != 2]

        def gradient(at: ScaleSolution) -> Array:
            ahead, behind = (
                [self.cost(frame, spots, *self.moved(at, step * np.eye(9)[row])) for row in unknowns]
                for step in (1e-3, -1e-3)
            )
            return np.subtract(ahead, behind, dtype=np.float64) / 2e-3

        assert np.abs(gradient(found)).max() < 1e-4
        assert np.abs(gradient(linear)).max() > 1e-2
        # Its unknowns are those of its scale and pose.
        columns = found.frame_from_slice.rotation[:, :2] @ found.scale.matrix
        np.testing.assert_allclose(found.unknowns[:6], columns.T.ravel(), atol=1e-15)
        np.testing.assert_array_equal(found.unknowns[6:], found.frame_from_slice.translation)

    def test_does_not_depend_on_the_start(self) -> None:
        frame, _, exact = scene(50, 6)
        spots = exact + np.random.default_rng(51).normal(0, self.NOISE_PX, exact.shape)
        lines = np.arange(6)
        by_linear = calibrate_maximum_likelihood(frame, lines, spots)
        by_newton = calibrate_maximum_likelihood(frame, lines, spots, calibrate_newton_raphson(frame, lines, spots))
        np.testing.assert_allclose(by_linear.unknowns, by_newton.unknowns, atol=1e-6)
        assert self.cost(frame, spots, by_newton.frame_from_slice.inverse(), by_newton.scale) < self.cost(
            frame, spots, calibrate_newton_raphson(frame, lines, spots).frame_from_slice.inverse(), by_newton.scale
        )

    @pytest.mark.parametrize("n", [5, 8])
    def test_errors_are_as_large_as_the_bound_says(self, n: int) -> None:
        """Limits at 99.9 %, two sides, for the seed as it is; noise small enough for the bound to be exact."""
        frame, true, exact = scene(60 + n, n)
        rng, lines, noise_px, count = np.random.default_rng(61), np.arange(n), 0.05, 100
        covariance = calibration_covariance(frame, lines, true, SCALE, noise_px)
        errors = np.empty((count, 8))
        for row in range(count):
            found = calibrate_maximum_likelihood(frame, lines, exact + rng.normal(0, noise_px, (n, 2)))
            pose = found.frame_from_slice.inverse()
            errors[row, :2] = found.scale.sx - SCALE.sx, found.scale.sy - SCALE.sy
            errors[row, 2:5] = pose.translation - true.translation
            errors[row, 5:] = Rotation.from_matrix(pose.rotation @ true.rotation.T).as_rotvec()
        squared = np.einsum("mi,ij,mj->m", errors, np.linalg.inv(covariance), errors)
        assert squared.mean() == pytest.approx(8, abs=3.29 * np.sqrt(16 / count))
        ratio = (errors**2).mean(axis=0) / np.diag(covariance)
        np.testing.assert_allclose(ratio, 1, atol=4.5 * np.sqrt(2 / count))


class Series:
    """Slices of a frame whose rods are not quite where `frame` has them, for the solvers that take several slices.

    poses: the true slice_from_frame; spots_px (m, n, 2); used (m, n); as_built: the rods as they truly are.
    """

    NOISE_PX = 0.25

    def __init__(
        self, rng: np.random.Generator, frame: Frame, slices: int, tolerances_mm: Array, scale: PixelScale = SCALE
    ) -> None:
        def off(points: Array) -> Array:
            return np.asarray(points + tolerances_mm[:, None] * rng.standard_normal(points.shape))

        self.frame, self.tolerances_mm, self.scale = frame, tolerances_mm, scale
        self.as_built = replace(frame, starts=off(frame.starts), ends=off(frame.ends))
        self.poses = [random_slice_from_frame(rng, frame) for _ in range(slices)]
        exact = np.array([project(self.as_built, pose, scale)[0] for pose in self.poses])
        self.spots_px = exact + rng.normal(0, self.NOISE_PX, exact.shape)
        self.used = np.ones(exact.shape[:2], dtype=bool)
        self.covariances_px2 = np.tile(self.NOISE_PX**2 * np.eye(2), (*self.used.shape, 1, 1))
        self._rotations = np.array([pose.rotation for pose in self.poses])
        self._translations = np.array([pose.translation for pose in self.poses])

    def exact_frame(self, with_shear: bool = False) -> JointScale:
        """The scale as if the rods were where the frame has them."""
        start = ScaleAndPoses(self.scale, self._rotations, self._translations)
        return calibrate_jointly(self.frame, self.identified, start, with_shear)

    @property
    def identified(self) -> IdentifiedSpots:
        return IdentifiedSpots(self.spots_px, self.used, self.covariances_px2)

    def tolerant(self, measured: int = 2) -> TolerantScale:
        """The scale with the rods' tolerances."""
        start = self.exact_frame(measured == 3).at
        start = start if measured else replace(start, scale=self.scale)
        found = calibrate_tolerantly(self.frame, self.tolerances_mm, self.identified, start, measured)
        assert found.converged
        return found


class TestToleranceOfTheFrame:
    """Rods that are off by the same in every slice."""

    @pytest.mark.parametrize("measured", [2, 3])
    def test_of_an_exact_frame_all_is_as_without(self, measured: int) -> None:
        series = Series(np.random.default_rng(70), EIGHT_RODS, 4, np.zeros(8))
        with_none, tolerant = series.exact_frame(measured == 3), series.tolerant(measured)
        for name in ("sx", "sy", "shear"):
            assert getattr(tolerant.scale, name) == pytest.approx(getattr(with_none.scale, name), abs=1e-9)
        np.testing.assert_allclose(tolerant.covariance, with_none.covariance, rtol=1e-6, atol=1e-15)
        assert (tolerant.frame_covariance == 0).all()
        np.testing.assert_allclose(tolerant.residuals_px, with_none.residuals_px, atol=1e-6)
        assert tolerant.chi_square == pytest.approx(with_none.chi_square, rel=1e-9)
        assert tolerant.degrees_of_freedom == with_none.degrees_of_freedom
        np.testing.assert_array_equal(tolerant.frame.starts, EIGHT_RODS.starts)

    @pytest.mark.parametrize("measured", [0, 2, 3])
    def test_is_the_minimum_over_scale_poses_and_rods(self, measured: int) -> None:
        rng = np.random.default_rng(71)
        series = Series(rng, EIGHT_RODS, 3, rng.uniform(0.1, 0.4, 8), SHEARED if measured == 3 else SCALE)
        found = series.tolerant(measured)

        def cost(step: Array) -> float:
            scale = PixelScale(*np.array([found.scale.sx, found.scale.sy, found.scale.shear]) + 1e-3 * step[:3])
            ends = 0.1 * step[21:].reshape(2, 8, 3)
            frame = replace(found.frame, starts=found.frame.starts + ends[0], ends=found.frame.ends + ends[1])
            total = 0.0
            for row, part in enumerate(step[3:21].reshape(3, 6)):
                pose = Pose(found.at.rotations[row], found.at.translations[row]).perturbed(part[:3], part[3:] / 50)
                total += float(((project(frame, pose, scale)[0] - series.spots_px[row]) ** 2).sum())
            total /= series.NOISE_PX**2
            for points, true in ((frame.starts, EIGHT_RODS.starts), (frame.ends, EIGHT_RODS.ends)):
                total += float((((points - true) / series.tolerances_mm[:, None]) ** 2).sum())
            return total

        assert cost(np.zeros(69)) == pytest.approx(found.chi_square, rel=1e-9)
        free = [row for row in range(69) if row < measured or row >= 3]
        slope = [(cost(1e-3 * np.eye(69)[row]) - cost(-1e-3 * np.eye(69)[row])) / 2e-3 for row in free]
        np.testing.assert_allclose(slope, 0, atol=2e-3)
        assert found.degrees_of_freedom == 3 * 16 - 18 - measured

    def test_covariance_is_the_inverse_of_the_whole_information(self) -> None:
        """Held against one matrix of all unknowns, its derivatives by differences."""
        rng = np.random.default_rng(72)
        tolerances_mm = rng.uniform(0.1, 0.4, 8)
        series = Series(rng, EIGHT_RODS, 3, tolerances_mm)
        found = series.tolerant()

        def predicted(step: Array) -> Array:
            scale = PixelScale(found.scale.sx + step[0], found.scale.sy + step[1])
            ends = tolerances_mm[None, :, None] * step[20:].reshape(2, 8, 3)
            frame = replace(found.frame, starts=found.frame.starts + ends[0], ends=found.frame.ends + ends[1])
            poses = [
                Pose(found.at.rotations[row], found.at.translations[row]).perturbed(part[:3], part[3:])
                for row, part in enumerate(step[2:20].reshape(3, 6))
            ]
            return np.concatenate([project(frame, pose, scale)[0].ravel() for pose in poses]) / series.NOISE_PX

        steps = 1e-5 * np.eye(68)
        jacobian = np.array([(predicted(step) - predicted(-step)) / 2e-5 for step in steps]).T
        known = np.diag(np.repeat([0.0, 1.0], [20, 48]))
        whole = np.linalg.inv(jacobian.T @ jacobian + known)
        np.testing.assert_allclose(found.covariance, whole[:2, :2], rtol=1e-4)
        np.testing.assert_allclose(found.frame_covariance, whole[:2, 20:] @ whole[20:, :2], rtol=1e-4)

    @pytest.mark.parametrize("slices", [1, 8])
    def test_errors_are_as_stated(self, slices: int) -> None:
        """Limits at 99.9 %, two sides, for the seed as it is."""
        rng, count = np.random.default_rng(73 + slices), 120
        squared, chi_squares = np.empty(count), np.empty(count)
        freedom = slices * 10 - 2
        for row in range(count):
            found = Series(rng, EIGHT_RODS, slices, np.full(8, 0.2)).tolerant()
            error = np.array([found.scale.sx - SCALE.sx, found.scale.sy - SCALE.sy])
            squared[row] = error @ np.linalg.solve(found.covariance, error)
            chi_squares[row] = found.chi_square
        assert squared.mean() == pytest.approx(2, abs=3.29 * np.sqrt(4 / count))
        assert chi_squares.mean() == pytest.approx(freedom, abs=3.29 * np.sqrt(2 * freedom / count))

    def test_more_slices_do_not_average_the_frame_away(self) -> None:
        """Of 60 slices the noise is all but gone, and what 0.2 mm in 60 mm do stays: about 0.2 %."""
        rng = np.random.default_rng(75)
        few, many = (Series(rng, EIGHT_RODS, slices, np.full(8, 0.2)) for slices in (3, 60))
        noise = [np.sqrt(one.exact_frame().covariance[0, 0]) / SCALE.sx for one in (few, many)]
        stated = [np.sqrt(one.tolerant().covariance[0, 0]) / SCALE.sx for one in (few, many)]
        of_frame = np.sqrt(many.tolerant().frame_covariance[0, 0]) / SCALE.sx
        assert noise[1] < noise[0] / 3
        assert noise[1] < 0.0005
        assert 0.001 < of_frame < stated[1] < stated[0] < 0.005
        assert of_frame > 0.9 * stated[1]


def with_tolerances(series: Series) -> TolerantScale:
    return series.tolerant()


@pytest.mark.parametrize("calibrated", [Series.exact_frame, with_tolerances])
class TestSeries:
    """The same of both solvers that take several slices."""

    def test_a_rod_without_a_spot_counts_for_nothing(self, calibrated: Callable[[Series], Any]) -> None:
        series = Series(np.random.default_rng(75), EIGHT_RODS, 3, np.full(8, 0.1))
        series.used[1, 2] = series.used[2, 7] = False
        found = calibrated(series)
        assert found.degrees_of_freedom == 2 * (3 * 8 - 2) - 6 * 3 - 2
        series.spots_px[~series.used] = [[-1e4, 3.0], [7.0, 1e5]]
        again = calibrated(series)
        assert again.chi_square == pytest.approx(found.chi_square, rel=1e-9)
        assert (again.scale.sx, again.scale.sy) == pytest.approx((found.scale.sx, found.scale.sy), rel=1e-9)
        np.testing.assert_array_equal(again.residuals_px[~series.used], 0.0)

    def test_a_step_that_goes_too_far_is_not_taken(
        self, calibrated: Callable[[Series], Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        series = Series(np.random.default_rng(76), EIGHT_RODS, 3, np.full(8, 0.1))
        expected = calibrated(series)
        for module in (joint_calibration, tolerant_calibration):
            stepped = module._State.step
            scales = iter([5.0])

            def too_far(self, damping: float, stepped=stepped, scales=scales):
                scale = next(scales, 1.0)
                return tuple(scale * part for part in stepped(self, damping))

            monkeypatch.setattr(module._State, "step", too_far)
        found = calibrated(series)
        assert found.converged
        assert found.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
        assert (found.scale.sx, found.scale.sy) == pytest.approx((expected.scale.sx, expected.scale.sy), rel=1e-7)

    def test_what_has_not_come_to_rest_has_not_converged(
        self, calibrated: Callable[[Series], Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        series = Series(np.random.default_rng(77), EIGHT_RODS, 3, np.full(8, 0.1))
        start = series.exact_frame()
        for module in (joint_calibration, tolerant_calibration):
            monkeypatch.setattr(module, "_ITERATIONS", 1)
        if calibrated is Series.exact_frame:
            assert not calibrated(series).converged
            return
        found = calibrate_tolerantly(series.frame, series.tolerances_mm, series.identified, start.at)
        assert not found.converged


class TestDegenerate:
    @pytest.mark.parametrize("solve", SOLVERS)
    def test_fewer_than_five_rods(self, solve: type) -> None:
        frame, _, spots = scene(20, 6)
        with pytest.raises(DegenerateArrangementError) as caught:
            solve(frame, np.arange(4), spots[:4])
        assert caught.value.names == ("too_few_lines",)

    @pytest.mark.parametrize("solve", SOLVERS)
    @pytest.mark.parametrize(
        ("case", "noise_px", "name"),
        [
            ("parallel", 0.0, "fewer_than_three_directions"),
            ("parallel", 0.3, "fewer_than_three_directions"),
            ("leksell", 0.0, "three_coplanar_lines"),
            ("leksell", 0.3, "three_coplanar_lines"),
            ("two inclined", 0.3, "fewer_than_three_directions"),
            ("flat", 0.0, "three_coplanar_lines"),
            ("flat", 0.3, "three_coplanar_lines"),
        ],
    )
    def test_rods_that_fix_no_scale(self, case: str, noise_px: float, name: str, solve: type) -> None:
        rng = np.random.default_rng(21)
        starts = np.column_stack([rng.uniform(-30, 30, (6, 2)), np.full(6, -30.0)])
        ends = starts + np.array([0.0, 0.0, 60.0])
        if case == "flat":
            starts[:, 1] = ends[:, 1] = 5.0
            ends[:, 0] += rng.uniform(-10, 10, 6)
        if case == "two inclined":
            ends[:2, 0] += 20
        frame = Frame(case, tuple("abcdef"), starts, ends, np.ones(6))
        if case == "leksell":
            frame = load_frame("leksell_ct")
        middle = frame.starts.mean(axis=0) / 2 + frame.ends.mean(axis=0) / 2
        turn = rotation_exp(np.array([0.1, 0.2, 0.3]))
        spots = project(frame, Pose(turn, -turn @ middle + [100, 90, 0]), SCALE)[0]
        with pytest.raises(DegenerateArrangementError, match=name) as caught:
            solve(frame, np.arange(6), spots + rng.normal(0, noise_px, (6, 2)))
        assert name in caught.value.names
        assert caught.value.condition > MAX_CONDITION

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_spots_in_one_place(self, solve: type) -> None:
        frame, _, _ = scene(22, 6)
        with pytest.raises(DegenerateArrangementError) as caught:
            solve(frame, np.arange(6), np.full((6, 2), 7.0))
        assert caught.value.names == ("three_collinear_spots",)

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_spots_on_one_line(self, solve: type) -> None:
        frame, _, _ = scene(22, 6)
        with pytest.raises(DegenerateArrangementError) as caught:
            solve(frame, np.arange(6), np.outer(np.arange(6.0), [3.0, 4.0]))
        assert caught.value.names == ("three_collinear_spots",)

    @pytest.mark.parametrize("solve", SOLVERS)
    @pytest.mark.parametrize("shape", [(5, 2), (6, 3), (6,), (2, 6)])
    def test_wrong_shapes(self, shape: tuple[int, ...], solve: type) -> None:
        frame, _, _ = scene(23, 6)
        with pytest.raises(ValueError, match=r"spots have shape .*, expected \(6, 2\), a spot for each line"):
            solve(frame, np.arange(6), np.ones(shape))
