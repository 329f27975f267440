"""Error bounds of the linear calibration: true to first order, tight, and the same by both ways of computing them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.arrangement import DegenerateArrangementError
from stereoreg_ros.solvers.calibration import calibrate_linear
from stereoreg_ros.solvers.error_bounds import CalibrationErrorModel
from support.frames import random_frame, random_slice_from_frame

SCALE = PixelScale(0.48, 0.52)


@dataclass(frozen=True, eq=False)
class Scene:
    frame: Frame
    lines: np.ndarray
    spots: Array

    @property
    def model(self) -> CalibrationErrorModel:
        return CalibrationErrorModel(self.frame, self.lines, self.spots)

    def unknowns(self, errors: Array) -> Array:
        """x (9,) for errors (2n,) of the spots, in the model's order: all of u, then all of v."""
        return calibrate_linear(self.frame, self.lines, self.spots + errors.reshape(2, -1).T).unknowns


def scene(seed: int, n: int, noise_px: float) -> Scene:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, n)
    spots = project(frame, random_slice_from_frame(rng, frame), SCALE)[0]
    return Scene(frame, np.arange(n), spots + rng.normal(0, noise_px, (n, 2)))


# Noise of 3 pixels makes the residual large: the part of eq. 15 that comes from dA'(b - A x) would be missed.
@pytest.mark.parametrize("noise_px", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("n", [5, 6, 8])
def test_sensitivity_is_the_derivative_of_the_linear_solution(n: int, noise_px: float) -> None:
    for seed in range(3):
        given = scene(10 * n + seed, n, noise_px)
        found = given.model.sensitivity
        assert found.shape == (9, 2 * n)
        step = 1e-3
        expected = np.stack(
            [(given.unknowns(step * row) - given.unknowns(-step * row)) / (2 * step) for row in np.eye(2 * n)], axis=1
        )
        size = np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(found / size, expected / size, atol=1e-5)


def test_rods_by_their_rows_in_any_order() -> None:
    given = scene(7, 9, 0.2)
    lines = np.array([8, 1, 3, 0, 6, 5])
    part = CalibrationErrorModel(given.frame, lines, given.spots[lines])
    order = np.argsort(lines)
    in_order = CalibrationErrorModel(given.frame, lines[order], given.spots[lines[order]])
    both = np.concatenate([order, 6 + order])
    np.testing.assert_allclose(part.sensitivity[:, both], in_order.sensitivity, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("n", [5, 8])
def test_linear_programme_and_closed_form_agree_over_a_box(n: int) -> None:
    rng = np.random.default_rng(3)
    model = scene(20 + n, n, 0.3).model
    for limits in (np.full(2 * n, 0.5), rng.uniform(0, 2, 2 * n), np.eye(2 * n)[3]):
        low, high = model.bounds_box(limits)
        for row in range(9):
            least, greatest = model.bound_in_direction(np.eye(9)[row], -limits, limits)
            assert least == pytest.approx(low[row], rel=1e-9)
            assert greatest == pytest.approx(high[row], rel=1e-9)
        for direction in rng.normal(size=(6, 9)):
            reach = np.abs(direction @ model.sensitivity) @ limits
            least, greatest = model.bound_in_direction(direction, -limits, limits)
            assert least == pytest.approx(-reach, rel=1e-9)
            assert greatest == pytest.approx(reach, rel=1e-9)


def test_one_number_stands_for_every_coordinate() -> None:
    model = scene(30, 6, 0.3).model
    for told, expected in zip(model.bounds_box(0.5), model.bounds_box(np.full(12, 0.5)), strict=True):
        np.testing.assert_allclose(told, expected, rtol=1e-12)
    direction = np.arange(9.0)
    assert model.bound_in_direction(direction, -0.5, 0.5) == pytest.approx(
        model.bound_in_direction(direction, np.full(12, -0.5), np.full(12, 0.5))
    )


@pytest.mark.parametrize("n", [5, 6])
def test_limits_that_are_not_symmetric(n: int) -> None:
    rng = np.random.default_rng(4)
    model = scene(40 + n, n, 0.3).model
    low, high = rng.uniform(-1, 0.2, 2 * n), rng.uniform(0.2, 0.4, 2 * n)
    for direction in [*np.eye(9), *rng.normal(size=(6, 9))]:
        slope = direction @ model.sensitivity
        least, greatest = model.bound_in_direction(direction, low, high)
        assert least == pytest.approx(np.where(slope > 0, slope * low, slope * high).sum(), rel=1e-9)
        assert greatest == pytest.approx(np.where(slope > 0, slope * high, slope * low).sum(), rel=1e-9)
        assert least < greatest
    # Errors that are known are no uncertainty.
    fixed = model.bound_in_direction(np.eye(9)[0], high, high)
    assert fixed == pytest.approx((model.sensitivity[0] @ high,) * 2)


@pytest.mark.parametrize("n", [5, 6, 8])
def test_no_small_error_goes_beyond_the_bounds_and_the_worst_one_reaches_them(n: int) -> None:
    rng = np.random.default_rng(5)
    given = scene(50 + n, n, 0.3)
    model, limit = given.model, 1e-3
    low, high = model.bounds_box(limit)
    middle = given.unknowns(np.zeros(2 * n))
    # Corners of the box, which go farthest, and points within.
    errors = limit * np.concatenate([rng.choice([-1.0, 1.0], (150, 2 * n)), rng.uniform(-1, 1, (50, 2 * n))])
    moved = np.array([given.unknowns(one) for one in errors]) - middle
    slack = 1e-3 * high  # second order in errors of a thousandth of a pixel
    assert (moved <= high + slack).all()
    assert (moved >= low - slack).all()
    for row in range(9):
        worst = limit * np.sign(model.sensitivity[row])
        assert given.unknowns(worst)[row] - middle[row] == pytest.approx(high[row], rel=1e-3)
        assert given.unknowns(-worst)[row] - middle[row] == pytest.approx(low[row], rel=1e-3)


def test_bounds_grow_with_the_errors_and_are_zero_without() -> None:
    model = scene(60, 6, 0.3).model
    np.testing.assert_allclose(model.bounds_box(2.0)[1], 4 * model.bounds_box(0.5)[1])
    np.testing.assert_array_equal(model.bounds_box(0.0), np.zeros((2, 9)))
    assert model.bound_in_direction(np.ones(9), 0.0, 0.0) == (0.0, 0.0)
    assert (model.bounds_box(0.5)[1] > 0).all()


def test_limits_that_make_no_box() -> None:
    model = scene(61, 6, 0.3).model
    with pytest.raises(ValueError, match="max_error_px must not be negative"):
        model.bounds_box(-0.1)
    with pytest.raises(ValueError, match="max_error_px must not be negative"):
        model.bounds_box(np.array([*[0.1] * 11, -0.1]))
    with pytest.raises(ValueError, match="low_errors_px must not exceed high_errors_px"):
        model.bound_in_direction(np.ones(9), 0.5, -0.5)


def test_a_degenerate_arrangement_is_refused_by_name() -> None:
    frame = load_frame("leksell_ct")
    turn = rotation_exp(np.array([0.1, 0.2, 0.3]))
    middle = frame.starts.mean(axis=0) / 2 + frame.ends.mean(axis=0) / 2
    spots = project(frame, Pose(turn, [100, 90, 0] - turn @ middle), SCALE)[0]
    with pytest.raises(DegenerateArrangementError) as caught:
        CalibrationErrorModel(frame, np.arange(len(frame)), spots)
    assert "three_coplanar_lines" in caught.value.names
    with pytest.raises(DegenerateArrangementError, match="too_few_lines"):
        CalibrationErrorModel(frame, np.arange(4), spots[:4])
