"""Scale and pose from five or more rods: exact on exact data, at the constrained minimum on noisy data."""

from __future__ import annotations

import numpy as np
import pytest
from frames import random_frame, random_slice_from_frame

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.calibration import (
    DegenerateCalibrationError,
    solve_linear,
    solve_newton_raphson,
)

SCALE = PixelScale(0.48, 0.52)
SOLVERS = (solve_linear, solve_newton_raphson)


def scene(seed: int, n: int) -> tuple[Frame, Pose, Array]:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, n)
    pose = random_slice_from_frame(rng, frame)
    return frame, pose, project(frame, pose, SCALE)[0]


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
            np.testing.assert_allclose(found.frame_from_slice.translation, pose.inverse().translation, atol=1e-6)
            assert rotation_angle(found.frame_from_slice.rotation @ pose.rotation) < 1e-8
            assert found.converged
            np.testing.assert_allclose(residual(frame, spots, found.unknowns), 0, atol=1e-9)

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_rods_by_their_rows_in_any_order(self, solve: type) -> None:
        frame, pose, spots = scene(7, 9)
        lines = np.array([8, 1, 3, 0, 6, 5])
        found = solve(frame, lines, spots[lines])
        assert found.scale.sx == pytest.approx(SCALE.sx, abs=1e-9)
        np.testing.assert_allclose(found.frame_from_slice.translation, pose.inverse().translation, atol=1e-6)

    def test_counts_its_steps(self) -> None:
        frame, _, spots = scene(8, 6)
        assert solve_linear(frame, np.arange(6), spots).iterations == 0
        assert 1 <= solve_newton_raphson(frame, np.arange(6), spots).iterations <= 5


class TestNoisy:
    @pytest.mark.parametrize("n", [5, 6, 8])
    def test_newton_raphson_is_at_the_constrained_minimum(self, n: int) -> None:
        rng = np.random.default_rng(11)
        frame, _, exact = scene(10 + n, n)
        spots = exact + rng.normal(0, 0.3, (n, 2))
        linear, found = (solve(frame, np.arange(n), spots) for solve in SOLVERS)
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

    @pytest.mark.parametrize("noise_px", [0.2, 0.5])
    def test_newton_raphson_has_the_smaller_scale_error(self, noise_px: float) -> None:
        rng = np.random.default_rng(12)
        errors = np.zeros((2, 2))
        for seed in range(6):
            frame, _, exact = scene(200 + seed, 8)
            for _ in range(40):
                spots = exact + rng.uniform(-noise_px, noise_px, (8, 2))
                for row, solve in enumerate(SOLVERS):
                    scale = solve(frame, np.arange(8), spots).scale
                    errors[row] += np.abs([scale.sx - SCALE.sx, scale.sy - SCALE.sy])
        linear, newton = errors.sum(axis=1) / (2 * 240)
        assert newton < linear
        assert newton < 0.02 * noise_px


class TestDegenerate:
    @pytest.mark.parametrize("solve", SOLVERS)
    def test_fewer_than_five_rods(self, solve: type) -> None:
        frame, _, spots = scene(20, 6)
        with pytest.raises(DegenerateCalibrationError, match="4 rods are identified, the scale needs at least 5"):
            solve(frame, np.arange(4), spots[:4])

    @pytest.mark.parametrize("solve", SOLVERS)
    @pytest.mark.parametrize(
        ("case", "noise_px"),
        [
            ("parallel", 0.0),
            ("parallel", 0.3),
            ("leksell", 0.0),
            ("leksell", 0.3),
            ("two inclined", 0.3),
            ("flat", 0.0),
        ],
    )
    def test_rods_that_fix_no_scale(self, case: str, noise_px: float, solve: type) -> None:
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
        with pytest.raises(DegenerateCalibrationError, match="do not fix the scale: singular values down to"):
            solve(frame, np.arange(6), spots + rng.normal(0, noise_px, (6, 2)))

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_spots_in_one_place(self, solve: type) -> None:
        frame, _, _ = scene(22, 6)
        with pytest.raises(DegenerateCalibrationError, match="all spots are in one place"):
            solve(frame, np.arange(6), np.full((6, 2), 7.0))

    @pytest.mark.parametrize("solve", SOLVERS)
    def test_spots_on_one_line(self, solve: type) -> None:
        frame, _, _ = scene(22, 6)
        with pytest.raises(DegenerateCalibrationError, match="do not fix the scale"):
            solve(frame, np.arange(6), np.outer(np.arange(6.0), [3.0, 4.0]))

    @pytest.mark.parametrize("solve", SOLVERS)
    @pytest.mark.parametrize("shape", [(5, 2), (6, 3), (6,), (2, 6)])
    def test_wrong_shapes(self, shape: tuple[int, ...], solve: type) -> None:
        frame, _, _ = scene(23, 6)
        with pytest.raises(ValueError, match=r"spots_px has shape .*, expected \(6, 2\), a spot for each line"):
            solve(frame, np.arange(6), np.ones(shape))
