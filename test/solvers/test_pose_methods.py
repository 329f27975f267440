"""Pose with known scale, every method of the paper and ours: exact on exact data, in order on noisy data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, islice, pairwise

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation, rotation_angle, rotation_exp, skew
from stereoreg_ros.geometry.projection import point_line_distances, project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.linear_system import (
    MAX_CONDITION,
    POSE_RANK,
    LinearSystem,
    assemble,
    condition_number,
    linear_system,
)
from stereoreg_ros.solvers.ls_svd import solve_ls_svd, solve_ls_svd_dr
from stereoreg_ros.solvers.ls_tz import solve_ls_tz, solve_system
from stereoreg_ros.solvers.maximum_likelihood import refine, solve_maximum_likelihood
from stereoreg_ros.solvers.methods import POSE_METHODS
from stereoreg_ros.solvers.newton_raphson import minimise, pose_constraints, solve_newton_raphson
from stereoreg_ros.solvers.one_parameter import orthogonality_roots, poses, unit_length_violation
from stereoreg_ros.solvers.pose_solution import PoseSolution, PoseSolver
from stereoreg_ros.uncertainty import cramer_rao_pose
from support.frames import random_frame, random_slice_from_frame

SCALE = PixelScale(0.48, 0.52)
OBLONG = PixelScale(0.4, 0.9, 0.05)
PAPER_SCALE = PixelScale(0.5, 0.5)

# Least discriminant of eq. 31, as a share of its terms, at which its roots count as two: at a double root a closed form
# cannot but lose half the digits.
GENERIC = 1e-3

# Rods between the lower and the upper face of a cube of 60 mm: diagonals of its four side faces, then four more between
# them, drawn until no three were near one plane. The paper gives no layout for its figures 8 and 9.
EIGHT_ENDS = np.array(
    [
        [30, -26, -30, 30, 24, 30],
        [-26, 30, -30, 22, 30, 30],
        [-30, 26, -30, -30, -24, 30],
        [24, -30, -30, -26, -30, 30],
        [-30, -2, -30, 27, -30, 30],
        [29, -11, -30, -7, 14, 30],
        [20, 10, -30, 30, -25, 30],
        [23, 25, -30, 20, -6, 30],
    ],
    dtype=np.float64,
)


def first_rods(n: int, size: float = 1.0) -> Frame:
    """The first `n` of the eight rods, in a cube of `size` times 60 mm."""
    ends = size * EIGHT_ENDS[:n]
    return Frame(f"{n} rods", tuple("abcdefgh"[:n]), ends[:, :3], ends[:, 3:], np.ones(n))


def pose_of_the_paper(rng: np.random.Generator, frame: Frame) -> Pose:
    """slice_from_frame as in section 6 of the paper, with every rod cut."""
    while True:
        rotation = Rotation.from_euler("xyz", rng.uniform(-20, 20, 3), degrees=True).as_matrix()
        pose = Pose(rotation, np.append(rng.uniform(-50, 50, 2), rng.uniform(-10, 10)))
        if project(frame, pose, PAPER_SCALE)[1].inside.all():
            return pose


def scene(seed: int, n: int, scale: PixelScale = SCALE) -> tuple[Frame, Pose, Array]:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, n)
    pose = random_slice_from_frame(rng, frame)
    return frame, pose, project(frame, pose, scale)[0]


def stacked(frame: Frame, spots_mm: Array) -> tuple[Array, Array]:
    """A S9 (3n, 9) and w (3n,) of eq. 24, for spots (n, 2) mm: built here anew, point by point."""
    rows = [
        np.hstack([x * cross, y * cross, cross]) for (x, y), cross in zip(spots_mm, skew(frame.directions), strict=True)
    ]
    return np.vstack(rows), np.concatenate(
        [np.cross(y, o) for y, o in zip(frame.directions, frame.origins, strict=True)]
    )


def open_family(frame: Frame, spots_mm: Array) -> tuple[Array, Array]:
    """a, b (9,) of the solutions a + c b of rank eight."""
    matrix, right_side = stacked(frame, spots_mm)
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    return right[:8].T @ ((left.T @ right_side)[:8] / values[:8]), right[8]


def discriminant(frame: Frame, spots_mm: Array) -> float:
    """Of eq. 31, over the size of its terms; in the unknowns that the solvers use."""
    system = assemble(frame, np.arange(len(frame)), spots_mm)
    left, values, right = np.linalg.svd(system.matrix, full_matrices=False)
    a, b = right[:8].T @ ((left.T @ system.right_side)[:8] / values[:8]), right[8]
    quadratic, linear, constant = b[:3] @ b[3:6], a[:3] @ b[3:6] + a[3:6] @ b[:3], a[:3] @ a[3:6]
    return float((linear**2 - 4 * quadratic * constant) / (linear**2 + 4 * abs(quadratic * constant)))


def is_sound(frame: Frame, spots_mm: Array) -> bool:
    """Whether eq. 31 has two roots well apart, and the system a condition that the solvers accept."""
    sound = condition_number(frame, np.arange(len(frame)), spots_mm, POSE_RANK) < MAX_CONDITION
    return sound and discriminant(frame, spots_mm) > GENERIC


def errors(solution: PoseSolution, slice_from_frame: Pose) -> tuple[float, float]:
    """|t - t_est| in mm and the angle between R and its estimate in rad, as the paper measures them."""
    true, found = slice_from_frame.inverse(), solution.frame_from_slice
    turn = float(rotation_angle(found.rotation @ true.rotation.T))
    return float(np.linalg.norm(found.translation - true.translation)), turn


def is_exact(solution: PoseSolution, slice_from_frame: Pose) -> bool:
    return max(errors(solution, slice_from_frame)) < 1e-9


@pytest.mark.parametrize("solve", POSE_METHODS.values(), ids=POSE_METHODS)
class TestEveryMethod:
    @pytest.mark.parametrize("scale", [SCALE, OBLONG], ids=["square", "oblong and sheared"])
    @pytest.mark.parametrize("n", [4, 5, 6, 8, 12])
    def test_recovers_exact_data(self, n: int, scale: PixelScale, solve: PoseSolver) -> None:
        tried = 0
        for seed in range(8):
            frame, true, spots = scene(1000 * n + seed, n, scale)
            if discriminant(frame, scale.to_mm(spots)) < GENERIC:
                continue
            tried += 1
            found = solve(frame, np.arange(n), spots, scale)
            # With four rods a twin may satisfy everything that the method looks at.
            assert any(is_exact(one, true) for one in (found if n == 4 else found[:1]))
            for one in found:
                assert one.converged
                rotation = one.frame_from_slice.rotation
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
                assert np.linalg.det(rotation) == pytest.approx(1)
            residuals = [
                point_line_distances(frame, np.arange(n), one.frame_from_slice.inverse(), scale.to_mm(spots)).max()
                for one in found
            ]
            assert min(residuals) < 1e-9
        assert tried >= 6

    def test_rods_by_their_rows_in_any_order(self, solve: PoseSolver) -> None:
        frame, true, spots = scene(1, 9)
        lines = np.array([8, 1, 3, 0, 6, 5])
        assert is_exact(solve(frame, lines, spots[lines], SCALE)[0], true)

    def test_wrong_shapes_and_values(self, solve: PoseSolver) -> None:
        frame, _, spots = scene(4, 6)
        with pytest.raises(ValueError, match=r"spots have shape \(5, 2\), expected \(6, 2\)"):
            solve(frame, np.arange(6), spots[:5], SCALE)
        spots[2, 1] = np.nan
        with pytest.raises(ValueError, match="spots must be finite"):
            solve(frame, np.arange(6), spots, SCALE)


@pytest.mark.parametrize("solve", [solve_newton_raphson, solve_maximum_likelihood])
def test_the_frame_s_own_axes_do_not_matter(solve: PoseSolver) -> None:
    """Turned and moved axes of the frame: the same pose of the same rods from noisy spots, for they weigh distances."""
    frame, _, exact = scene(2, 6)
    spots = exact + np.random.default_rng(3).normal(0, 0.2, exact.shape)
    new_from_old = Pose(rotation_exp(np.array([0.4, -1.1, 2.0])), np.array([15.0, -25.0, 40.0]))
    moved = Frame("moved", frame.line_names, new_from_old @ frame.starts, new_from_old @ frame.ends, frame.diameters)
    one, other = (solve(given, np.arange(6), spots, SCALE)[0].frame_from_slice for given in (frame, moved))
    expected = new_from_old @ one
    np.testing.assert_allclose(other.translation, expected.translation, atol=1e-3)
    np.testing.assert_allclose(other.rotation, expected.rotation, atol=1e-5)


class TestClosedForms:
    @pytest.mark.parametrize("noise_px", [0.0, 0.5])
    def test_ls_svd_gives_both_candidates_for_four_rods(self, noise_px: float) -> None:
        """Found here anew: the solutions of eq. 24 form a line, eq. 31 picks two of them, if any."""
        pairs = 0
        for seed in range(40):
            frame, _, exact = scene(seed, 4)
            spots = exact + np.random.default_rng(seed).normal(0, noise_px, (4, 2))
            spots_mm = SCALE.to_mm(spots)
            matrix, right_side = stacked(frame, spots_mm)
            a, b = open_family(frame, spots_mm)
            roots = np.roots([b[:3] @ b[3:6], a[:3] @ b[3:6] + a[3:6] @ b[:3], a[:3] @ a[3:6]])
            found = solve_ls_svd(frame, np.arange(4), spots, SCALE)
            if np.iscomplex(roots).any() or discriminant(frame, spots_mm) < GENERIC:
                assert len(found) in (1, 2)
                continue
            pairs += 1
            assert len(found) == 2
            for c in np.real(roots):
                xi = a + c * b
                # Four rods leave nothing to misfit: noise or not, both satisfy eq. 24 and are at right angles,
                np.testing.assert_allclose(matrix @ xi, right_side, atol=1e-8)
                assert xi[:3] @ xi[3:6] == pytest.approx(0, abs=1e-9 * (1 + xi[:3] @ xi[:3] + xi[3:6] @ xi[3:6]))
                # and each of them, its axes made unit, is one of those returned.
                rotation = nearest_rotation(np.column_stack([xi[:3], xi[3:6], np.cross(xi[:3], xi[3:6])]))
                size = 1 + np.linalg.norm(xi[6:])
                assert any(
                    np.abs(one.frame_from_slice.rotation - rotation).max() < 1e-6
                    and np.abs(one.frame_from_slice.translation - xi[6:]).max() < 1e-6 * size
                    for one in found
                )
        assert pairs >= 25

    def test_the_better_candidate_comes_first(self) -> None:
        """The one whose axes are nearer to unit length is the true one on exact data."""
        for solve in (solve_ls_svd, solve_ls_tz):
            firsts = 0
            for seed in range(30):
                frame, true, spots = scene(100 + seed, 4)
                if not is_sound(frame, SCALE.to_mm(spots)):
                    continue
                found = solve(frame, np.arange(4), spots, SCALE)
                assert len(found) == 2
                firsts += is_exact(found[0], true)
                assert not is_exact(found[1], true)
            assert firsts >= 25

    def test_four_rods_leave_ls_svd_and_ls_tz_the_same(self) -> None:
        """With four rods both solve eq. 24 exactly, and differ but in how they name the line of solutions."""
        for seed in range(10):
            frame, _, exact = scene(200 + seed, 4)
            spots = exact + np.random.default_rng(seed).normal(0, 0.3, (4, 2))
            if discriminant(frame, SCALE.to_mm(spots)) < GENERIC:
                continue
            by_svd, by_tz = (solve(frame, np.arange(4), spots, SCALE) for solve in (solve_ls_svd, solve_ls_tz))
            for one, other in zip(by_svd, by_tz, strict=True):
                difference = one.frame_from_slice.translation - other.frame_from_slice.translation
                assert np.linalg.norm(difference) < 1e-6 * (1 + np.linalg.norm(one.frame_from_slice.translation))

    def test_data_redundancy_gives_one(self) -> None:
        for n in (4, 6):
            frame, _, exact = scene(5, n)
            spots = exact + np.random.default_rng(6).normal(0, 0.3, exact.shape)
            assert len(solve_ls_svd_dr(frame, np.arange(n), spots, SCALE)) == 1

    def test_half_the_digits_are_lost_at_a_double_root(self) -> None:
        """Where the true c is a double root of eq. 31, rounding of 1e-16 moves it by 1e-8: of LS-SVD and LS-TZ alone.

        (Rounding to the other side leaves no real root but the vertex, and that is right.) LS-SVD (DR), Newton-Raphson
        and maximum likelihood know the length of the axes, which has no double root there.
        """
        worst = dict.fromkeys(POSE_METHODS, 0.0)
        for frame, pose in islice(self.double_roots(), 12):
            spots = project(frame, pose, SCALE)[0]
            assert abs(discriminant(frame, SCALE.to_mm(spots))) < 1e-10
            for name, solve in POSE_METHODS.items():
                error = min(max(errors(one, pose)) for one in solve(frame, np.arange(4), spots, SCALE))
                worst[name] = max(worst[name], error)
        for name in ("ls_svd", "ls_tz"):
            assert 1e-9 < worst[name] < 1e-3
        for name in ("ls_svd_dr", "newton_raphson", "maximum_likelihood"):
            assert worst[name] < 1e-9

    @staticmethod
    def double_roots() -> Iterator[tuple[Frame, Pose]]:
        """Scenes of four rods that, moved along z, come to a pose at which eq. 31 has a double root."""
        for seed in range(1000):
            rng = np.random.default_rng(seed)
            frame = random_frame(rng, 4)
            pose = random_slice_from_frame(rng, frame)

            def slope(z: float, frame: Frame = frame, pose: Pose = pose) -> float:
                """Of r1 . r2 in c at the true root."""
                moved = Pose(pose.rotation, pose.translation + np.array([0, 0, z]))
                _, b = open_family(frame, SCALE.to_mm(project(frame, moved, SCALE)[0]))
                r = moved.inverse().rotation
                return float(np.copysign(1.0, b[8]) * (r[:, 0] @ b[3:6] + r[:, 1] @ b[:3]))

            for low, high in pairwise(np.linspace(-10, 10, 11)):
                if slope(low) * slope(high) < 0:
                    z = brentq(slope, low, high, xtol=1e-14)
                    found = Pose(pose.rotation, pose.translation + np.array([0, 0, z]))
                    spots_mm = SCALE.to_mm(project(frame, found, SCALE)[0])
                    condition = condition_number(frame, np.arange(4), spots_mm, POSE_RANK)
                    # Of a small condition, and not where b[8] changes its sign.
                    if condition < 100 and abs(discriminant(frame, spots_mm)) < 1e-10:
                        yield frame, found

    @pytest.mark.parametrize("n", [4, 6])
    def test_ls_tz_takes_another_pivot_where_tz_is_badly_placed(self, n: int) -> None:
        """Turn the frame's axes until the open direction has nothing of tz: dividing by that share would be garbage."""
        for seed in range(10):
            frame, pose, spots = scene(300 + seed, n)
            if discriminant(frame, SCALE.to_mm(spots)) < GENERIC:
                continue
            # Of the normalised unknowns, in which the pivot is chosen.
            system = linear_system(frame, np.arange(n), SCALE.to_mm(spots), POSE_RANK)
            along = np.linalg.svd(system.matrix)[2][8, 6:]
            turn = np.linalg.svd(along[None])[2]  # its first row lies along the open direction: that becomes x
            turn[2] *= np.linalg.det(turn)
            turned = Frame("turned", frame.line_names, frame.starts @ turn.T, frame.ends @ turn.T, frame.diameters)
            true = pose @ Pose(turn.T, np.zeros(3))
            system = linear_system(turned, np.arange(n), SCALE.to_mm(spots), POSE_RANK)
            assert abs(np.linalg.svd(system.matrix)[2][8, 8]) < 1e-9
            found = solve_ls_tz(turned, np.arange(n), spots, SCALE)
            assert any(is_exact(one, true) for one in found)

    @pytest.mark.parametrize("n", [4, 6])
    @pytest.mark.parametrize("solve", POSE_METHODS.values(), ids=POSE_METHODS)
    def test_the_signs_of_singular_vectors_mean_nothing(
        self, n: int, solve: PoseSolver, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Which of the two signs a library gives is by chance."""
        svd = np.linalg.svd

        def other_signs(matrix: Array, *given, **named):
            found = svd(matrix, *given, **named)
            return (-found[0], found[1], -found[2]) if isinstance(found, tuple) else found

        solutions = 0
        for seed in range(8):
            frame, _, spots = scene(320 + seed, n)
            spots = spots + np.random.default_rng(seed).normal(0, 0.3, spots.shape)
            # With tz in the open direction, and with next to nothing of it.
            for turn in (np.eye(3), rotation_exp(np.array([0.4, -1.2, 0.3]))):
                turned = replace(frame, starts=frame.starts @ turn.T, ends=frame.ends @ turn.T)
                there = solve(turned, np.arange(n), spots, SCALE)
                with monkeypatch.context() as patch:
                    patch.setattr(np.linalg, "svd", other_signs)
                    back = solve(turned, np.arange(n), spots, SCALE)
                assert len(there) == len(back)
                solutions += len(there)
                for one, other in zip(there, back, strict=True):
                    assert max(errors(one, other.frame_from_slice.inverse())) < 1e-7
        assert solutions >= 8

    def test_of_the_redundant_candidates_the_one_of_least_violation_is_taken(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """c by each of two ratios of the singular vector, and their mean: one is least off the three constraints."""
        kept = []

        def recorded(system: LinearSystem, a: Array, b: Array, roots: list[float]) -> list[PoseSolution]:
            kept.append((system.spread**2, a, b, roots))
            return poses(system, a, b, roots)

        monkeypatch.setattr("stereoreg_ros.solvers.ls_svd.poses", recorded)
        for seed in range(20):
            frame, _, spots = scene(340 + seed, 5)
            noisy = spots + np.random.default_rng(seed).normal(0, 0.5, spots.shape)
            assert len(solve_ls_svd_dr(frame, np.arange(5), noisy, SCALE)) == 1
            unit, a, b, (chosen,) = kept.pop()
            (a1, a2), (b1, b2) = a[:6].reshape(2, 3), b[:6].reshape(2, 3)
            size = np.linalg.norm(a[:6]) / np.linalg.norm(b[:6])
            rows = [(a1 @ a1 - unit, 2 * a1 @ b1, b1 @ b1), (a2 @ a2 - unit, 2 * a2 @ b2, b2 @ b2)]
            rows.append((a1 @ a2, a1 @ b2 + a2 @ b1, b1 @ b2))
            x, y, z = np.linalg.svd(np.array(rows) * size ** np.arange(3))[2][2]

            def violation(c: float, a1=a1, a2=a2, b1=b1, b2=b2, unit=unit) -> float:
                r1, r2 = a1 + c * b1, a2 + c * b2
                return float((r1 @ r1 - unit) ** 2 + (r2 @ r2 - unit) ** 2 + (r1 @ r2) ** 2)

            candidates = size * np.array([y / x, z / y, (y / x + z / y) / 2])
            best = min(candidates, key=violation)
            assert chosen == pytest.approx(best, rel=1e-6, abs=1e-9)


class TestOrthogonalityRoots:
    """Of eq. 31, b1.b2 c^2 + (a1.b2 + a2.b1) c + a1.a2 = 0."""

    @staticmethod
    def roots(quadratic: float, linear: float, constant: float) -> list[float]:
        a, b = np.zeros(9), np.zeros(9)
        # a1 = (constant, 0, 0) and a2 = (1, 0, 0); b2 = (0, 1, 0) and b1 = (linear, quadratic, 0).
        a[:3], a[3:6], b[:3], b[3:6] = [constant, 0, 0], [1, 0, 0], [linear, quadratic, 0], [0, 1, 0]
        return orthogonality_roots(a, b)

    def test_two(self) -> None:
        assert sorted(self.roots(2.0, -6.0, 4.0)) == pytest.approx([1, 2])
        assert sorted(self.roots(-1.0, 0.0, 9.0)) == pytest.approx([-3, 3])
        assert sorted(self.roots(1.0, 3.0, 0.0)) == pytest.approx([-3, 0])
        assert sorted(self.roots(1.0, -3.0, 0.0)) == pytest.approx([0, 3])

    def test_one_where_it_is_linear(self) -> None:
        assert self.roots(0.0, 2.0, -3.0) == pytest.approx([1.5])
        assert self.roots(1e-16, 2.0, -3.0) == pytest.approx([1.5])

    def test_none_where_nothing_depends_on_c(self) -> None:
        assert self.roots(0.0, 0.0, 1.0) == []
        assert self.roots(0.0, 0.0, 0.0) == []

    def test_a_double_root(self) -> None:
        assert self.roots(1.0, -4.0, 4.0) == pytest.approx([2])
        assert self.roots(3.0, 0.0, 0.0) == pytest.approx([0])

    def test_a_double_root_off_the_real_axis_gives_the_vertex(self) -> None:
        assert self.roots(1.0, -4.0, 4.001) == pytest.approx([2])
        assert self.roots(-2.0, 4.0, -5.0) == pytest.approx([1])

    @pytest.mark.parametrize("size", [1e-60, 1e-12, 1.0, 1e12, 1e60])
    def test_small_and_large_coefficients(self, size: float) -> None:
        # a and b themselves stay near one: a2 and b2 have the size.
        a, b = np.zeros(9), np.zeros(9)
        a[:3], a[3:6], b[:3], b[3:6] = [4, 0, 0], [size, 0, 0], [-6, 2, 0], [0, size, 0]
        assert sorted(orthogonality_roots(a, b)) == pytest.approx([1, 2], rel=1e-14)

    @pytest.mark.parametrize("far", [1e4, 1e8, 1e12])
    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    def test_no_cancellation_where_one_root_is_far_away(self, sign: float, far: float) -> None:
        """(c - 1)(c / far - sign): the school formula gives the near one to 1e-16 far only."""
        near, other = sorted(self.roots(1 / far, -sign - 1 / far, sign), key=abs)
        assert near == pytest.approx(1, rel=1e-14)
        assert other == pytest.approx(sign * far, rel=1e-14)

    def test_is_the_same_as_numpy_s(self) -> None:
        rng = np.random.default_rng(1)
        for _ in range(300):
            a, b = rng.normal(size=(2, 9))
            expected = np.roots([b[:3] @ b[3:6], a[:3] @ b[3:6] + a[3:6] @ b[:3], a[:3] @ a[3:6]])
            if np.iscomplex(expected).any():
                assert orthogonality_roots(a, b) == pytest.approx([float(expected[0].real)])
            else:
                assert sorted(orthogonality_roots(a, b)) == pytest.approx(sorted(expected), rel=1e-9)


def test_lengths_that_make_up_for_each_other_are_off_all_the_same() -> None:
    """Squared lengths of 1.5 and 0.5 are off by a half each."""
    system = LinearSystem(np.eye(9), np.zeros(9), np.zeros(2), 1.0)
    assert unit_length_violation(system, np.array([np.sqrt(1.5), 0, 0, 0, np.sqrt(0.5), 0, 7, 8, 9])) == pytest.approx(
        0.5
    )
    assert unit_length_violation(system, np.array([0, 0, 1.0, 0.6, 0.8, 0, 7, 8, 9])) == pytest.approx(0.0)


class TestNewtonRaphson:
    def test_without_a_step_there_is_no_solution(self) -> None:
        """A system that says nothing, at a start where no constraint has a slope: the matrix has no inverse."""
        nothing = LinearSystem(np.zeros((9, 9)), np.zeros(9), np.zeros(2), 1.0)
        x, _, converged, iterations = minimise(nothing, pose_constraints(nothing), np.zeros(9))
        np.testing.assert_array_equal(x, np.zeros(9))
        assert not converged
        assert iterations == 1

    @pytest.mark.parametrize("n", [4, 5, 8])
    def test_is_a_stationary_point_on_the_constraints(self, n: int) -> None:
        for seed in range(4):
            frame, _, exact = scene(400 + 10 * n + seed, n)
            spots = exact + np.random.default_rng(seed).normal(0, 0.3, exact.shape)
            matrix, right_side = stacked(frame, SCALE.to_mm(spots))
            found = solve_newton_raphson(frame, np.arange(n), spots, SCALE)
            assert found
            for one in found:
                assert one.converged
                assert 1 <= one.iterations < 50
                pose = one.frame_from_slice
                xi = np.concatenate([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation])
                # A step in mm at a point of the frame: columns of the rotation in 1/30.
                units = np.array([1 / 30] * 6 + [1.0] * 3)

                def cost(
                    move: Array,
                    xi: Array = xi,
                    units: Array = units,
                    matrix: Array = matrix,
                    right_side: Array = right_side,
                ) -> float:
                    return float(((matrix @ (xi + units * move) - right_side) ** 2).sum())

                slope = np.array([(cost(1e-3 * row) - cost(-1e-3 * row)) / 2e-3 for row in np.eye(9)])
                normals = units[:, None] * np.stack(
                    [
                        np.concatenate([xi[:3], np.zeros(6)]),
                        np.concatenate([np.zeros(3), xi[3:6], np.zeros(3)]),
                        np.concatenate([xi[3:6], xi[:3], np.zeros(3)]),
                    ],
                    axis=1,
                )
                multipliers = np.linalg.lstsq(normals, slope, rcond=None)[0]
                np.testing.assert_allclose(slope - normals @ multipliers, 0, atol=1e-6)
                # Without the constraints it could do better: they are what holds it.
                assert np.abs(slope).max() > 1e-4

    @pytest.mark.parametrize("n", [4, 5, 8])
    def test_constraints_hold_before_any_rounding_to_a_rotation(self, n: int) -> None:
        frame, _, exact = scene(500 + n, n)
        spots = exact + np.random.default_rng(n).normal(0, 0.3, exact.shape)
        system = linear_system(frame, np.arange(n), SCALE.to_mm(spots), POSE_RANK)
        start = solve_system(system)[0].frame_from_slice
        guess = system.normalised(start.rotation[:, 0], start.rotation[:, 1], start.translation)
        x, _, converged, iterations = minimise(system, pose_constraints(system), guess)
        r1, r2, _ = system.affine(x)
        assert converged
        assert iterations < 20
        np.testing.assert_allclose([r1 @ r1, r2 @ r2, r1 @ r2], [1, 1, 0], atol=1e-12)

    def test_least_residual_first(self) -> None:
        several = 0
        for seed in range(60):
            frame, _, exact = scene(600 + seed, 4)
            spots = exact + np.random.default_rng(seed).normal(0, 0.5, exact.shape)
            if condition_number(frame, np.arange(4), SCALE.to_mm(spots), POSE_RANK) > MAX_CONDITION:
                continue
            matrix, right_side = stacked(frame, SCALE.to_mm(spots))
            residuals = []
            for one in solve_newton_raphson(frame, np.arange(4), spots, SCALE):
                pose = one.frame_from_slice
                xi = np.concatenate([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation])
                residuals.append(((matrix @ xi - right_side) ** 2).sum())
            assert residuals == sorted(residuals)
            several += len(residuals) > 1
        assert several >= 5


class TestMaximumLikelihood:
    def test_what_has_not_converged_is_no_solution(self, monkeypatch: pytest.MonkeyPatch) -> None:
        frame, _, spots = scene(360, 6)
        spots = spots + np.random.default_rng(0).normal(0, 1.0, spots.shape)
        assert solve_maximum_likelihood(frame, np.arange(6), spots, SCALE)
        monkeypatch.setattr("stereoreg_ros.solvers.maximum_likelihood._PATIENCE", 1)
        assert solve_maximum_likelihood(frame, np.arange(6), spots, SCALE) == []

    @pytest.mark.parametrize("scale", [SCALE, OBLONG], ids=["square", "oblong and sheared"])
    @pytest.mark.parametrize("n", [4, 5, 8])
    def test_gradient_in_the_image_is_zero(self, n: int, scale: PixelScale) -> None:
        for seed in range(4):
            frame, true, exact = scene(700 + 10 * n + seed, n, scale)
            spots = exact + np.random.default_rng(seed).normal(0, 0.3, exact.shape)

            def cost(pose: Pose, frame: Frame = frame, spots: Array = spots) -> float:
                """In pixel, squared."""
                return float(((project(frame, pose, scale)[0] - spots) ** 2).sum())

            def gradient(pose: Pose, cost=cost) -> Array:
                """Per mm, and per 1/50 rad, in which about as much moves."""
                moves = 1e-4 * np.diag([1, 1, 1, 0.02, 0.02, 0.02])
                return np.array(
                    [(cost(pose.perturbed(d[:3], d[3:])) - cost(pose.perturbed(-d[:3], -d[3:]))) / 2e-4 for d in moves]
                )

            found = [
                one.frame_from_slice.inverse() for one in solve_maximum_likelihood(frame, np.arange(n), spots, scale)
            ]
            assert found
            assert [cost(one) for one in found] == sorted(cost(one) for one in found)
            assert cost(found[0]) < cost(true)
            for one in found:
                assert np.abs(gradient(one)).max() < 1e-2
            assert np.abs(gradient(true)).max() > 0.1

    @pytest.mark.parametrize("n", [4, 6])
    def test_each_optimum_is_told_once_and_one_is_always_told(self, n: int) -> None:
        """Also where four rods are weakly arranged, and the way to the optimum is long."""
        frame = random_frame(np.random.default_rng(1), n)
        rng = np.random.default_rng(0)
        for _ in range(60):
            exact = project(frame, random_slice_from_frame(rng, frame), PAPER_SCALE)[0]
            spots = exact + rng.uniform(-0.5, 0.5, (n, 2))
            found = [one.frame_from_slice for one in solve_maximum_likelihood(frame, np.arange(n), spots, PAPER_SCALE)]
            assert found
            for one, other in combinations(found, 2):
                assert np.linalg.norm(one.translation - other.translation) > 0.5

    @pytest.mark.parametrize("n", [4, 5, 6, 8])
    def test_is_as_good_as_the_bound_allows(self, n: int) -> None:
        """Bound variance over measured variance about the truth, in position and rotation: 0.95 at least.

        Four poses of 4000 trials, Gaussian noise of 0.1 pixel, in which the bound is exact; an efficient estimate gives
        1 +- 0.01 to 0.02 here.
        """
        rng, trials, noise_px = np.random.default_rng(n), 4000, 0.1
        frame = first_rods(n)
        bound, measured = np.zeros(2), np.zeros(2)
        for _ in range(4):
            true = pose_of_the_paper(rng, frame)
            exact = project(frame, true, PAPER_SCALE)[0]
            spots_mm = PAPER_SCALE.to_mm(exact + rng.normal(0, noise_px, (trials, n, 2)))
            found = refine(
                frame,
                np.tile(true.rotation, (trials, 1, 1)),
                np.tile(true.translation, (trials, 1)),
                spots_mm,
                np.ones((trials, n), dtype=bool),
                PAPER_SCALE.inverse_matrix / noise_px,
            )
            assert found.converged.all()
            turns = Rotation.from_matrix(found.rotations @ true.rotation.T).as_rotvec()
            variances = np.diag(cramer_rao_pose(frame, np.arange(n), true, PAPER_SCALE, noise_px)).reshape(2, 3)
            bound += variances.sum(axis=1)
            off = found.translations - true.translation
            measured += [(off**2).sum(axis=1).mean(), (turns**2).sum(axis=1).mean()]
        efficiency = bound / measured
        print(f"{n} rods: efficiency {efficiency[0]:.3f} in position, {efficiency[1]:.3f} in rotation")
        assert (efficiency >= 0.95).all()
        # More than the bound allows would be a wrong bound.
        assert (efficiency <= 1.05).all()

    @pytest.mark.parametrize("n", [4, 6])
    def test_the_solver_itself_reaches_the_bound(self, n: int) -> None:
        rng, trials, noise_px = np.random.default_rng(40 + n), 120, 0.1
        frame, true = first_rods(n), Pose(rotation_exp(np.array([0.1, -0.2, 0.25])), np.array([20.0, -35.0, 4.0]))
        exact = project(frame, true, PAPER_SCALE)[0]
        off = np.empty((trials, 6))
        for row in range(trials):
            spots = exact + rng.normal(0, noise_px, exact.shape)
            found = solve_maximum_likelihood(frame, np.arange(n), spots, PAPER_SCALE)[0].frame_from_slice.inverse()
            off[row, :3] = found.translation - true.translation
            off[row, 3:] = Rotation.from_matrix(found.rotation @ true.rotation.T).as_rotvec()
        covariance = cramer_rao_pose(frame, np.arange(n), true, PAPER_SCALE, noise_px)
        squared = np.einsum("mi,ij,mj->m", off, np.linalg.inv(covariance), off)
        # 99.9 %, two sides.
        assert squared.mean() == pytest.approx(6, abs=3.29 * np.sqrt(12 / trials))


class TestFigures8And9:
    """Mean errors over 200 poses at a uniform noise of 0.5 pixel; the same spots for every method."""

    @staticmethod
    def means(frame: Frame) -> dict[str, Array]:
        """Position in mm and rotation in degrees (2,) of every method's first solution."""
        rng, lines = np.random.default_rng(89), np.arange(len(frame))
        found: dict[str, list[tuple[float, float]]] = {name: [] for name in POSE_METHODS}
        for _ in range(200):
            pose = pose_of_the_paper(rng, frame)
            spots = project(frame, pose, PAPER_SCALE)[0] + rng.uniform(-0.5, 0.5, (len(frame), 2))
            for name, solve in POSE_METHODS.items():
                found[name].append(errors(solve(frame, lines, spots, PAPER_SCALE)[0], pose))
        return {name: np.mean(listed, axis=0) * [1, 180 / np.pi] for name, listed in found.items()}

    @pytest.mark.parametrize(
        ("frame", "paper_mm", "paper_deg"),
        [
            # Diagonals of the four side faces of a cube of 60 mm.
            (first_rods(4), 0.5, 1.5),
            # Eight rods spread over a cube of 120 mm: in one of 60 mm it is 0.18 mm and 0.29 degrees.
            (first_rods(8, 2.0), 0.2, 0.3),
        ],
        ids=["4 rods", "8 rods"],
    )
    def test_order_and_size(self, frame: Frame, paper_mm: float, paper_deg: float) -> None:
        means = self.means(frame)
        newton = means["newton_raphson"]
        for name in ("ls_svd", "ls_svd_dr", "ls_tz"):
            assert newton[0] < means[name][0]
            assert newton[1] < means[name][1]
        assert newton[0] <= paper_mm
        assert newton[1] <= paper_deg
        # Ours weighs the spots as their noise does.
        assert (means["maximum_likelihood"] < 1.01 * newton).all()
