"""Arrangements that fix nothing: told by their names, refused by every solver, and never answered with garbage."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.arrangement import (
    COLLINEAR,
    COPLANAR,
    DIRECTIONS,
    DegenerateArrangementError,
    fewer_than_three_directions,
    three_collinear_spots,
    three_coplanar_lines,
)
from stereoreg_ros.solvers.calibration import (
    ScaleSolution,
    calibrate_linear,
    calibrate_maximum_likelihood,
    calibrate_newton_raphson,
)
from stereoreg_ros.solvers.error_bounds import CalibrationErrorModel
from stereoreg_ros.solvers.linear_system import MAX_CONDITION
from stereoreg_ros.solvers.methods import POSE_METHODS
from stereoreg_ros.solvers.pose_solution import PoseSolver
from support.frames import random_frame, random_slice_from_frame

SCALE = PixelScale(0.5, 0.5)
SLANTED = Pose(rotation_exp(np.array([0.15, -0.2, 0.4])), np.array([110.0, 95.0, 2.0]))

Solve = Callable[[Frame, Any, Array], Any]


def at_known_scale(solve: PoseSolver) -> Solve:
    return lambda frame, lines, spots: solve(frame, lines, spots, SCALE)


POSE = {name: at_known_scale(solve) for name, solve in POSE_METHODS.items()}
CALIBRATION: dict[str, Solve] = {
    "linear": calibrate_linear,
    "scale by newton_raphson": calibrate_newton_raphson,
    "scale by maximum_likelihood": calibrate_maximum_likelihood,
    "error model": CalibrationErrorModel,
}
ALL = POSE | CALIBRATION


def rods(starts: Any, ends: Any) -> Frame:
    starts, ends = np.array(starts, dtype=np.float64), np.array(ends, dtype=np.float64)
    n = len(starts)
    return Frame("rods", tuple(f"rod{i}" for i in range(n)), starts, ends, np.ones(n))


def one_plane_and_one_rod(lift: float = 0.0) -> Frame:
    """Three rods in the plane y = 0, but for the end of the third that is `lift` mm off it, and a fourth aside."""
    return rods(
        [[-25, 0, -30], [0, 0, -30], [25, 0, -30], [5, 20, -30]],
        [[-15, 0, 30], [-5, 0, 30], [10, lift, 30], [-10, -25, 30]],
    )


def flat_frame(n: int) -> Frame:
    rng = np.random.default_rng(3)
    starts = np.column_stack([np.linspace(-30, 30, n), np.full(n, 5.0), np.full(n, -30.0)])
    return rods(starts, starts + np.column_stack([rng.uniform(-12, 12, n), np.zeros(n), np.full(n, 60.0)]))


def parallel_frame(n: int) -> Frame:
    starts = np.column_stack([np.random.default_rng(4).uniform(-30, 30, (n, 2)), np.full(n, -30.0)])
    return rods(starts, starts + np.array([10.0, -5.0, 60.0]))


def cuts(frame: Frame, noise_px: float = 0.0, seed: int = 0) -> Array:
    spots = project(frame, SLANTED, SCALE)[0]
    return spots + np.random.default_rng(seed).normal(0, noise_px, spots.shape)


class TestThreeCoplanarLines:
    def test_exact(self) -> None:
        (found,) = three_coplanar_lines(one_plane_and_one_rod(), np.arange(4))
        assert found.name == "three_coplanar_lines"
        assert found.members == (0, 1, 2)
        assert found.condition > 1e12
        assert "three_coplanar_lines [0, 1, 2] (condition number " in str(found)

    def test_members_are_the_frame_s_rods(self) -> None:
        (found,) = three_coplanar_lines(one_plane_and_one_rod(), np.array([3, 2, 1, 0]))
        assert sorted(found.members) == [0, 1, 2]
        assert three_coplanar_lines(one_plane_and_one_rod(), np.array([3, 1, 0])) == []

    @pytest.mark.parametrize(("lift", "is_flat"), [(0.01, True), (0.1, True), (2.0, False), (20.0, False)])
    def test_nearly_and_soundly(self, lift: float, is_flat: bool) -> None:
        """Within a tenth of a millimetre over 60 it is a plane, as rods are made; two millimetres are none."""
        found = three_coplanar_lines(one_plane_and_one_rod(lift), np.arange(4))
        assert bool(found) == is_flat
        ends = np.concatenate([one_plane_and_one_rod(lift).starts[:3], one_plane_and_one_rod(lift).ends[:3]])
        expected = np.linalg.cond(ends - ends.mean(axis=0))
        assert (expected > COPLANAR) == is_flat
        if found:
            assert found[0].condition == pytest.approx(expected, rel=1e-6)

    def test_two_parallel_rods_and_any_third_parallel_to_their_plane_are_not_in_one(self) -> None:
        frame = rods([[0, 0, 0], [20, 0, 0], [0, 20, 0]], [[0, 0, 60], [20, 0, 60], [20, 20, 60]])
        assert three_coplanar_lines(frame, np.arange(3)) == []

    def test_shipped_frames(self) -> None:
        assert three_coplanar_lines(load_frame("cube6"), np.arange(6)) == []
        # An N-shaped plate is three rods of one plane; the Z frame has them on three sides.
        assert len(three_coplanar_lines(load_frame("leksell_ct"), np.arange(6))) == 2
        assert three_coplanar_lines(load_frame("zframe"), np.arange(7))


class TestThreeCollinearSpots:
    def test_exact(self) -> None:
        (found,) = three_collinear_spots(np.array([[0.0, 0.0], [7.0, 1.0], [30.0, 40.0], [60.0, 80.0]]))
        assert found.name == "three_collinear_spots"
        assert found.members == (0, 2, 3)
        assert found.condition > 1e12

    @pytest.mark.parametrize(("aside", "is_line"), [(0.1, True), (5.0, False), (50.0, False)])
    def test_nearly_and_soundly(self, aside: float, is_line: bool) -> None:
        spots = np.array([[0.0, 0.0], [50.0, aside], [100.0, 0.0]])
        found = three_collinear_spots(spots)
        expected = np.linalg.cond(spots - spots.mean(axis=0))
        assert bool(found) == is_line == (expected > COLLINEAR)
        if found:
            assert found[0].condition == pytest.approx(expected, rel=1e-9)

    def test_spots_in_one_place(self) -> None:
        (found,) = three_collinear_spots(np.full((3, 2), 9.0))
        assert found.condition == np.inf

    def test_of_many(self) -> None:
        assert len(three_collinear_spots(np.outer(np.arange(5.0), [3.0, 4.0]))) == 10


class TestFewerThanThreeDirections:
    @pytest.mark.parametrize("make", [flat_frame, parallel_frame])
    def test_exact(self, make: Callable[[int], Frame]) -> None:
        (found,) = fewer_than_three_directions(make(6), np.arange(6))
        assert found.name == "fewer_than_three_directions"
        assert found.members == (0, 1, 2, 3, 4, 5)
        assert found.condition > 1e12

    @pytest.mark.parametrize(("lean", "is_few"), [(0.1, True), (6.0, False)])
    def test_nearly_and_soundly(self, lean: float, is_few: bool) -> None:
        ends = np.array([[0, 0, 60], [30, 10, 60], [0, 30 + lean, 60], [30, 40, 60]])
        frame = rods([[0, 0, 0], [20, 10, 0], [0, 30, 0], [30, 40, 0]], ends)
        found = fewer_than_three_directions(frame, np.arange(4))
        expected = np.linalg.cond(frame.directions)
        assert bool(found) == is_few == (expected > DIRECTIONS)
        if found:
            assert found[0].condition == pytest.approx(expected, rel=1e-6)

    def test_two_rods_have_two_directions(self) -> None:
        assert fewer_than_three_directions(load_frame("cube6"), np.array([0, 3]))[0].condition == np.inf
        assert fewer_than_three_directions(load_frame("cube6"), np.array([0, 3, 4])) == []


def refusal(solve: Solve, frame: Frame, spots: Array, lines: Any = None) -> DegenerateArrangementError:
    with pytest.raises(DegenerateArrangementError) as caught:
        solve(frame, np.arange(len(spots)) if lines is None else lines, spots)
    assert caught.value.condition > MAX_CONDITION
    assert f"condition number {caught.value.condition:.3g}" in str(caught.value)
    for name in caught.value.names:
        assert name == "too_few_lines" or name in str(caught.value)
    return caught.value


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
class TestRefusedByName:
    """Noise of 0.3 pixel hides none of these: the rods themselves are arranged so."""

    @pytest.mark.parametrize("solve", POSE.values(), ids=POSE)
    def test_three_of_four_rods_in_one_plane(self, solve: Solve, noise_px: float) -> None:
        frame = one_plane_and_one_rod()
        for seed in range(10):
            assert "three_coplanar_lines" in refusal(solve, frame, cuts(frame, noise_px, seed)).names

    @pytest.mark.parametrize("solve", ALL.values(), ids=ALL)
    def test_all_rods_in_one_plane(self, solve: Solve, noise_px: float) -> None:
        frame = flat_frame(6)
        for seed in range(10):
            names = refusal(solve, frame, cuts(frame, noise_px, seed)).names
            assert {"three_coplanar_lines", "fewer_than_three_directions"} <= set(names)

    @pytest.mark.parametrize("solve", ALL.values(), ids=ALL)
    def test_all_rods_parallel(self, solve: Solve, noise_px: float) -> None:
        frame = parallel_frame(6)
        for seed in range(10):
            assert "fewer_than_three_directions" in refusal(solve, frame, cuts(frame, noise_px, seed)).names

    @pytest.mark.parametrize("solve", ALL.values(), ids=ALL)
    def test_too_few_rods(self, solve: Solve, noise_px: float) -> None:
        frame = load_frame("cube6")
        few = 3 if solve in POSE.values() else 4
        refused = refusal(solve, frame, cuts(frame, noise_px)[:few])
        assert refused.names == ("too_few_lines",)
        assert refused.condition == np.inf

    @pytest.mark.parametrize("solve", POSE.values(), ids=POSE)
    def test_four_rods_of_two_plates(self, solve: Solve, noise_px: float) -> None:
        """Four rods of a Leksell frame, three of them of one N-shaped plate."""
        frame = load_frame("leksell_ct")
        middle = frame.starts.mean(axis=0) / 2 + frame.ends.mean(axis=0) / 2
        pose = Pose(SLANTED.rotation, np.array([100.0, 90.0, 0.0]) - SLANTED.rotation @ middle)
        spots = project(frame, pose, SCALE)[0] + np.random.default_rng(1).normal(0, noise_px, (6, 2))
        assert "three_coplanar_lines" in refusal(solve, frame, spots[:4]).names


class TestSpots:
    @pytest.mark.parametrize("solve", ALL.values(), ids=ALL)
    def test_all_in_one_place(self, solve: Solve) -> None:
        assert refusal(solve, load_frame("cube6"), np.full((6, 2), 100.0)).names == ("three_collinear_spots",)

    @pytest.mark.parametrize("solve", ALL.values(), ids=ALL)
    def test_all_on_one_line(self, solve: Solve) -> None:
        spots = 100 + np.outer([0.0, 7, 20, 31, 50, 64], [0.6, 0.8])
        assert refusal(solve, load_frame("cube6"), spots).names == ("three_collinear_spots",)

    @pytest.mark.parametrize("solve", POSE.values(), ids=POSE)
    def test_three_of_four_on_one_line(self, solve: Solve) -> None:
        """Of rods that lie in no plane, but whose directions do: any such line slides along them."""
        frame, spots = self.three_on_one_line()
        assert three_coplanar_lines(frame, np.arange(4)) == []
        assert refusal(solve, frame, spots).names == ("three_collinear_spots",)

    @staticmethod
    def three_on_one_line() -> tuple[Frame, Array]:
        """Rods a, b, c in the planes y = -20, 0, 20, aimed so that the slice z = 0 cuts them on one line."""
        middles = np.array([[-20.0, -20, 0], [0, 0, 0], [20, 20, 0], [25, -20, 0]])
        leans = np.array([[12.0, 0, 30], [-9, 0, 30], [4, 0, 30], [3, 15, 30]])
        frame = rods(middles - leans, middles + leans)
        return frame, SCALE.to_px(middles[:, :2] + 100)

    @pytest.mark.parametrize("solve", POSE.values(), ids=POSE)
    def test_three_on_one_line_by_chance_are_no_hindrance(self, solve: Solve) -> None:
        """The paper asks for no three collinear spots. Where the directions of the three rods span space, the line
        through the spots is fixed, and the fourth spot fixes the rest: the system has rank eight, and is solved.
        """
        middles = np.array([[-20.0, -20, 0], [0, 0, 0], [20, 20, 0], [25, -20, 0]])
        leans = np.array([[12.0, 0, 30], [-9, 14, 30], [4, -15, 30], [3, 15, 30]])
        frame = rods(middles - leans, middles + leans)
        true = Pose(np.eye(3), np.array([100.0, 100.0, 0.0]))
        spots = project(frame, true, SCALE)[0]
        assert [one.members for one in three_collinear_spots(spots)] == [(0, 1, 2)]
        found = solve(frame, np.arange(4), spots)
        errors = [np.linalg.norm(one.frame_from_slice.translation - true.inverse().translation) for one in found]
        # A double root may stand here, at the normal pose of all frames: half the digits.
        assert min(errors) < 1e-4


class TestSolvedNevertheless:
    @pytest.mark.parametrize("noise_px", [0.0, 0.3])
    @pytest.mark.parametrize("solve", POSE.values(), ids=POSE)
    def test_the_z_frame_s_seven_rods(self, solve: Solve, noise_px: float) -> None:
        """Three of them lie in one plane, more than once; seven fix the pose all the same."""
        frame = load_frame("zframe")
        assert len(three_coplanar_lines(frame, np.arange(7))) >= 3
        middle = frame.starts.mean(axis=0) / 2 + frame.ends.mean(axis=0) / 2
        turn = rotation_exp(np.array([0.08, -0.06, 0.2]))
        true = Pose(turn, np.array([120.0, 110.0, 0.0]) - turn @ middle)
        spots = project(frame, true, SCALE)[0] + np.random.default_rng(2).normal(0, noise_px, (7, 2))
        found = solve(frame, np.arange(7), spots)[0].frame_from_slice.inverse()
        off = np.linalg.norm(found @ middle - true @ middle)
        assert off < (1e-9 if noise_px == 0 else 5.0)


def near_degenerate(kind: str, n: int, off_mm: float, rng: np.random.Generator) -> tuple[Frame, Array]:
    """A frame that is `off_mm` from degenerate, and the spots where a random slice cuts it."""
    if kind == "one plane":
        starts = np.column_stack([rng.uniform(-30, 30, n), np.full(n, 5.0), np.full(n, -30.0)])
        ends = starts + np.column_stack([rng.uniform(-20, 20, n), np.zeros(n), np.full(n, 60.0)])
    elif kind == "parallel":
        starts = np.column_stack([rng.uniform(-30, 30, (n, 2)), np.full(n, -30.0)])
        ends = starts + np.append(rng.uniform(-20, 20, 2), 60.0)
    elif kind == "one bundle":
        starts = np.column_stack([rng.uniform(-30, 30, (n, 2)), np.full(n, -30.0)])
        ends = -starts
    else:
        frame = random_frame(rng, n)
        starts, ends = frame.starts.copy(), frame.ends.copy()
        if kind == "three in one plane":
            starts[:3, 1] = ends[:3, 1] = 5.0
        elif kind == "one rod twice":
            starts[1], ends[1] = starts[0], ends[0]
    move = rng.normal(0, off_mm, (2, n, 3))
    frame = rods(starts + move[0], ends + move[1])
    pose = Pose(rotation_exp(rng.normal(0, 0.2, 3)), np.array([100.0, 90.0, rng.uniform(-10, 10)]))
    spots = project(frame, pose, SCALE)[0]
    if kind == "spots on one line":
        along = rng.normal(size=2)
        spots = 200 + np.outer((spots - 200) @ along, along) + rng.normal(0, off_mm, spots.shape)
    elif kind == "spots in one place":
        spots = 200 + rng.normal(0, off_mm, spots.shape)
    return frame, spots


KINDS = ("one plane", "parallel", "one bundle", "three in one plane", "one rod twice", "sound", "spots on one line",
         "spots in one place")  # fmt: skip


def answer(solve: Solve, frame: Frame, spots: Array) -> tuple[Any, DegenerateArrangementError | None]:
    try:
        return solve(frame, np.arange(len(spots)), spots), None
    except DegenerateArrangementError as refused:
        return None, refused


@settings(max_examples=700, deadline=None, derandomize=True, database=None)
@given(
    kind=st.sampled_from(KINDS),
    n=st.integers(3, 8),
    exponent=st.one_of(st.just(-np.inf), st.floats(-12, 1)),
    noise_px=st.sampled_from([0.0, 1e-6, 0.3, 5.0]),
    method=st.sampled_from(sorted(ALL)),
    seed=st.integers(0, 2**32 - 1),
)
def test_nothing_but_finite_answers_and_refusals(
    kind: str, n: int, exponent: float, noise_px: float, method: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    frame, spots = near_degenerate(kind, n, 10.0**exponent, rng)
    spots = spots + rng.normal(0, noise_px, spots.shape)
    found, refused = answer(ALL[method], frame, spots)
    if refused is not None:
        assert refused.names
        assert refused.condition > MAX_CONDITION
    elif method in POSE:
        assert isinstance(found, list)
        for one in found:
            assert np.isfinite(one.frame_from_slice.translation).all()
            assert np.linalg.det(one.frame_from_slice.rotation) == pytest.approx(1)
    elif isinstance(found, ScaleSolution):
        assert np.isfinite(found.unknowns).all()
        assert np.isfinite([found.scale.sx, found.scale.sy, found.scale.shear]).all()
    else:
        assert np.isfinite(found.sensitivity).all()


def test_a_sound_arrangement_is_not_refused() -> None:
    for seed in range(100):
        rng = np.random.default_rng(seed)
        frame = random_frame(rng, 6)
        spots = project(frame, random_slice_from_frame(rng, frame), SCALE)[0]
        for solve in (POSE["ls_tz"], CALIBRATION["linear"]):
            found, refused = answer(solve, frame, spots)
            assert refused is None
            assert found
