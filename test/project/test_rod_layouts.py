"""Layouts of rods: inside their envelope, and no nearer to each other than they are said to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from stereoreg_ros import load_frame
from stereoreg_ros.frames.layouts import Envelope, Layouts, gaps
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.simulation import ScannerSettings, random_pose

UP = np.array([0.0, 0.0, 10.0])


def gap_by_search(start_a, end_a, start_b, end_b) -> float:
    """Distance of two segments by a minimiser that knows nothing of them."""

    def squared(shares):
        offset = start_a + shares[0] * (end_a - start_a) - start_b - shares[1] * (end_b - start_b)
        return float(offset @ offset)

    starts = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0), (0.5, 0.5)]
    return min(float(np.sqrt(minimize(squared, s, bounds=[(0, 1)] * 2, tol=1e-14).fun)) for s in starts)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000))
def test_gaps_against_a_minimiser(seed: int) -> None:
    rng = np.random.default_rng(seed)
    starts, ends = rng.uniform(-30, 30, (2, 1, 2, 3))
    expected = gap_by_search(starts[0, 0], ends[0, 0], starts[0, 1], ends[0, 1]) - 1.5
    assert gaps(Layouts(starts, ends, np.array([1.0, 2.0])))[0, 0] == pytest.approx(expected, abs=1e-4)


def test_parallel_rods() -> None:
    starts = np.array([[[0.0, 0, 0], [3, 4, 5]]])
    ends = starts + UP
    assert gaps(Layouts(starts, ends, np.ones(2)))[0, 0] == pytest.approx(4.0)
    apart = starts + np.array([[[0, 0, 0], [0, 0, 20]]])
    assert gaps(Layouts(apart, apart + UP, np.ones(2)))[0, 0] == pytest.approx(np.hypot(5, 15) - 1)


def test_all_inside_the_envelope() -> None:
    rng = np.random.default_rng(0)
    envelope = Envelope((60.0, 40.0, 80.0), 2.0)
    diameters = np.array([1.0, 2.0, 3.0, 1.0])
    corners = rng.uniform(size=(50, 16))
    corners[0], corners[1] = 0.0, 1.0
    layouts = envelope.layouts(corners, diameters)
    for points in (layouts.starts, layouts.ends):
        assert (np.abs(points[..., 0]) <= 30 - diameters / 2 + 1e-12).all()
        assert (np.abs(points[..., 1]) <= 20 - diameters / 2 + 1e-12).all()
    assert (layouts.starts[..., 2] == -40).all()
    assert (layouts.ends[..., 2] == 40).all()


def test_cut_many_layouts_at_once() -> None:
    """The same as one frame and one pose after the other."""
    rng = np.random.default_rng(1)
    layouts = Envelope((60.0, 60.0, 60.0)).layouts(rng.uniform(size=(5, 24)), np.ones(6))
    poses = [random_pose(rng, load_frame("cube6"), ScannerSettings()) for _ in range(4)]
    rotations, translations = np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])
    many = cut(layouts, rotations, translations)
    for row in range(5):
        for column, pose in enumerate(poses):
            one = cut(layouts.frame(row, "one"), pose.rotation, pose.translation)
            np.testing.assert_allclose(many.points_mm[row, column], one.points_mm, atol=1e-9)
            np.testing.assert_array_equal(many.inside[row, column], one.inside)


@pytest.mark.parametrize(
    ("size", "gap", "what"),
    [
        ((60, 60), 3, "envelope is"),
        ((60, 60, 0), 3, "envelope is"),
        ((60, 60, 60), -1, "gap is"),
        ((9, 9, 9), 10, "gap is"),
    ],
)
def test_wrong_envelopes(size, gap, what) -> None:
    with pytest.raises(ValueError, match=what):
        Envelope(size, gap)


def test_a_frame_as_a_layout_and_back_keeps_its_tolerances() -> None:
    frame = load_frame("cube6")
    own = np.array([0.1, 0.2, 0.3, np.nan, 0.5, 0.0])
    layouts = Layouts.of(replace(frame, tolerances_mm=own))
    np.testing.assert_array_equal(layouts.tolerances_or(9.0), [0.1, 0.2, 0.3, 9.0, 0.5, 0.0])
    again = layouts.frame(0, "again")
    np.testing.assert_array_equal(again.tolerances_or(9.0), [0.1, 0.2, 0.3, 9.0, 0.5, 0.0])
    np.testing.assert_array_equal(again.starts, frame.starts)
    np.testing.assert_array_equal(again.ends, frame.ends)
