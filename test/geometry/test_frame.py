"""Rods as bounded Pluecker lines."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.projection import cut
from support.frames import random_frame, random_slice_from_frame

STARTS = np.array([[0, 0, -5], [10, 0, -5], [0, 10, -5]], dtype=float)
ENDS = np.array([[0, 0, 5], [10, 3, 5], [2, 10, 5]], dtype=float)


def frame_with(**changes: Any) -> Frame:
    whole = {"name": "block", "line_names": ("a", "b", "c"), "starts": STARTS, "ends": ENDS, "diameters": np.ones(3)}
    return Frame(**{**whole, **changes})


@pytest.fixture
def frame() -> Frame:
    return random_frame(np.random.default_rng(3), 7)


class TestDerived:
    def test_moment_is_y_cross_p_for_every_point_of_the_line(self, frame: Frame) -> None:
        for share in (-2.0, 0.0, 0.3, 1.0, 5.0):
            points = frame.starts + share * (frame.ends - frame.starts)
            np.testing.assert_allclose(np.cross(frame.directions, points), frame.moments, atol=1e-11)

    def test_moment_differs_off_the_line(self, frame: Frame) -> None:
        aside = frame.starts + np.array([0.5, 0.0, 0.0])
        assert (np.linalg.norm(np.cross(frame.directions, aside) - frame.moments, axis=1) > 0.1).all()

    def test_origins_are_the_points_nearest_the_frames_origin(self, frame: Frame) -> None:
        np.testing.assert_allclose(np.einsum("ij,ij->i", frame.origins, frame.directions), 0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(frame.directions, axis=1), 1)
        np.testing.assert_allclose(
            np.linalg.norm(frame.moments, axis=1), np.linalg.norm(frame.origins, axis=1), atol=1e-12
        )

    def test_lambdas_reach_from_end_to_end(self, frame: Frame) -> None:
        every = np.arange(len(frame))
        np.testing.assert_allclose(frame.points(every, frame.lambda_min), frame.starts, atol=1e-12)
        np.testing.assert_allclose(frame.points(every, frame.lambda_max), frame.ends, atol=1e-12)
        np.testing.assert_allclose(
            frame.lambda_max - frame.lambda_min, np.linalg.norm(frame.ends - frame.starts, axis=1)
        )

    def test_points_of_chosen_lines(self, frame: Frame) -> None:
        lambdas = np.array([[1.0, -2.0], [3.0, 4.0], [0.0, 0.5]])
        points = frame.points([4, 1], lambdas)
        assert points.shape == (3, 2, 3)
        for i, (j, line) in itertools.product(range(3), enumerate((4, 1))):
            np.testing.assert_allclose(points[i, j], frame.origins[line] + lambdas[i, j] * frame.directions[line])

    def test_length_is_the_number_of_rods(self, frame: Frame) -> None:
        assert len(frame) == 7

    def test_tolerances_are_unknown_unless_they_are_given(self, frame: Frame) -> None:
        np.testing.assert_array_equal(frame.tolerances_or(0.3), np.full(7, 0.3))
        assert not frame.orientation_required
        some = frame_with(tolerances_mm=np.array([0.1, np.nan, 0.0]), orientation_required=True)
        np.testing.assert_array_equal(some.tolerances_or(0.3), [0.1, 0.3, 0.0])
        assert some.orientation_required

    def test_keeps_its_own_copy_that_cannot_be_written(self) -> None:
        starts = STARTS.copy()
        frame = frame_with(starts=starts)
        starts[0, 0] = 99.0
        assert frame.starts[0, 0] == 0.0
        tolerances = np.full(3, 0.2)
        frame = frame_with(starts=starts, tolerances_mm=tolerances)
        tolerances[0] = 9.0
        np.testing.assert_array_equal(frame.tolerances_or(0.0), [0.2, 0.2, 0.2])
        known = np.asarray(frame.tolerances_mm)
        for array in (frame.starts, frame.directions, frame.origins, frame.moments, frame.lambda_max, known):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0.0


def test_a_mirrored_frame_is_cut_at_the_same_points() -> None:
    """Why one slice cannot show that a file's axes are left-handed: the mirror image has a pose of its own for it."""
    rng = np.random.default_rng(5)
    frame = random_frame(rng, 6)
    pose = random_slice_from_frame(rng, frame)
    x_mirrored, plane = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, 1.0, -1.0])
    mirrored = replace(frame, starts=frame.starts @ x_mirrored, ends=frame.ends @ x_mirrored)
    other = Pose(plane @ pose.rotation @ x_mirrored, plane @ pose.translation)
    cuts = cut(frame, pose.rotation, pose.translation)
    found = cut(mirrored, other.rotation, other.translation)
    np.testing.assert_allclose(found.points_mm, cuts.points_mm, atol=1e-9)
    np.testing.assert_array_equal(found.inside, cuts.inside)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"line_names": ("a", "b"), "starts": STARTS[:2], "ends": ENDS[:2], "diameters": np.ones(2)},
            "frame 'block' has 2 lines, expected at least 3",
        ),
        ({"line_names": ("a", "b", "a")}, "frame 'block' names lines twice: a$"),
        ({"line_names": ("a", "b", "c", "d")}, r"starts has shape \(3, 3\), expected \(4, 3\)"),
        ({"starts": STARTS[:, :2]}, r"starts has shape \(3, 2\), expected \(3, 3\)"),
        ({"ends": ENDS[:2]}, r"ends has shape \(2, 3\), expected \(3, 3\)"),
        ({"diameters": np.ones((3, 1))}, r"diameters has shape \(3, 1\), expected \(3,\)"),
        ({"diameters": np.array([1, 0, 1])}, "diameters must be positive, found 0"),
        ({"diameters": np.array([1, 2, -0.5])}, "diameters must be positive, found -0.5"),
        ({"diameters": np.array([1, 2, np.nan])}, "diameters must be finite"),
        ({"starts": STARTS * [1, 1, np.inf]}, "starts must be finite"),
        ({"ends": np.where(ENDS == 3, np.nan, ENDS)}, "ends must be finite"),
        ({"ends": np.array([ENDS[0], STARTS[1], ENDS[2]])}, "line 'b' has no length"),
        ({"tolerances_mm": np.array([0.1, -0.1, 0.1])}, "line 'b' has tolerance -0.1, expected 0 mm or more"),
        ({"tolerances_mm": np.array([0.1, 0.1, np.inf])}, "line 'c' has tolerance inf, expected 0 mm or more"),
        ({"tolerances_mm": np.ones((3, 1))}, r"tolerances_mm has shape \(3, 1\), expected \(3,\)"),
    ],
)
def test_what_is_no_frame(changes: dict[str, Any], told: str) -> None:
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=told):
        frame_with(**changes)


def test_frames_that_say_the_same_are_equal() -> None:
    """So that a frame which is loaded again finds its tables."""
    one, again = load_frame("cube6"), load_frame("cube6")
    assert one is not again
    assert one == again
    assert hash(one) == hash(again)
    assert one != "cube6"


@pytest.mark.parametrize(
    "change",
    [
        {"name": "another"},
        {"line_names": tuple("bacdef")},
        {"starts": np.add(load_frame("cube6").starts, [0.0, 0.0, 1e-9])},
        {"ends": np.add(load_frame("cube6").ends, [0.0, 0.0, 1e-9])},
        {"diameters": np.full(6, 1.5)},
        {"tolerances_mm": np.full(6, 0.1)},
        {"orientation_required": True},
    ],
    ids=lambda change: next(iter(change)),
)
def test_frames_that_differ_in_anything_are_not_equal(change: dict[str, Any]) -> None:
    frame = load_frame("cube6")
    assert replace(frame, **change) != frame
