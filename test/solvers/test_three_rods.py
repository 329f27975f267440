"""Poses from three rods and three spots: the true one is among them, none is wrong, double roots are not lost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.distance_equations import PAIRS
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine
from stereoreg_ros.solvers.three_rods import ThreeRodSolver
from support.frames import random_frame, random_slice_from_frame

TOLERANCE = 0.3
SLACK = 1.0
ALL = (0, 1, 2)


def distances(points: Array) -> Array:
    """Of the pairs of points (..., 3, k), in the order of PAIRS."""
    between: Array = np.stack([np.linalg.norm(points[..., a, :] - points[..., b, :], axis=-1) for a, b in PAIRS], -1)
    return between


@dataclass(frozen=True)
class Solved:
    """Seeds of triples of spots, with their poses."""

    triples: NDArray[np.intp]
    lambdas: Array
    lambda_covariance: Array
    rotations: Array
    translations: Array


def solve(frame: Frame, spots_mm: Array, tolerance: float = TOLERANCE, lines: tuple[int, int, int] = ALL) -> Solved:
    """All poses for triples of spots (t, 3, 2)."""
    return solved(ThreeRodSolver(frame, lines, tolerance, SLACK), spots_mm)


@cache
def leksell_solver(lines: tuple[int, int, int]) -> ThreeRodSolver:
    """Made once for all slices of the plates: its table takes longer than they do."""
    return ThreeRodSolver(load_frame("leksell_ct"), lines, 0.95, SLACK)


def solved(solver: ThreeRodSolver, spots_mm: Array) -> Solved:
    seeds = solver.solve(distances(spots_mm).T, solver.table(0, int(solver.rods_cut.max())))
    poses = solver.poses(seeds.lambdas, spots_mm[seeds.triples])
    return Solved(seeds.triples, seeds.lambdas, seeds.lambda_covariance, *poses)


def conditioning(frame: Frame, lambdas: Array) -> float:
    """Smallest singular value of the distances' derivatives by the positions: nothing at a double root."""
    columns = []
    for k in range(3):
        step = 1e-5 * np.eye(3)[k]
        ahead, behind = (distances(frame.points(list(ALL), lambdas + sign * step)) for sign in (1, -1))
        columns.append((ahead - behind) / 2e-5)
    return float(np.linalg.svd(np.stack(columns, axis=1), compute_uv=False)[-1])


def scenes(seed: int, count: int) -> list[tuple[Frame, Pose, Array, Array]]:
    """Random frames of three rods, with slice_from_frame, the exact spots (3, 2) mm and the positions (3,) mm."""
    rng = np.random.default_rng(seed)
    drawn = []
    for _ in range(count):
        frame = random_frame(rng, 3)
        pose = random_slice_from_frame(rng, frame)
        cuts = cut(frame, pose.rotation, pose.translation)
        drawn.append((frame, pose, cuts.points_mm, cuts.lambdas))
    return drawn


def polished(frame: Frame, seeds: Solved, spots_mm: Array) -> Refined:
    m = len(seeds.triples)
    used = np.ones((m, 3), dtype=bool)
    found = refine(frame, seeds.rotations, seeds.translations, np.tile(spots_mm, (m, 1, 1)), used, 100 * np.eye(2), 60)
    return found.take(found.chi_square < 1e-8)


def flatness(spots: Array) -> float:
    """Height over longest side of the triangle of three spots (3, 2)."""
    first, second = spots[1] - spots[0], spots[2] - spots[0]
    longest = max(np.linalg.norm(first), np.linalg.norm(second), np.linalg.norm(second - first))
    return float(abs(first[0] * second[1] - first[1] * second[0]) / longest**2)


class TestExactSpots:
    def test_the_true_pose_is_among_the_solutions(self) -> None:
        found = []
        for frame, true, spots, lambdas in scenes(1, 250):
            if conditioning(frame, lambdas) < 0.1:
                continue
            seeds = solve(frame, spots[None])
            apart = np.linalg.norm(seeds.translations - true.translation, axis=1)
            apart += 30 * rotation_angle(seeds.rotations @ true.rotation.T)
            best = int(apart.argmin())
            found.append(bool(apart[best] < 1e-3 and np.abs(seeds.lambdas[best] - lambdas).max() < 1e-3))
        assert len(found) > 50
        # One in a few hundred is lost where rods all but meet and the steps do not settle from any cell nearby.
        assert np.mean(found) >= 0.98

    def test_near_double_roots_it_is_within_reach_of_the_refinement(self) -> None:
        reached = []
        for frame, true, spots, _ in scenes(2, 40):
            found = polished(frame, solve(frame, spots[None]), spots)
            apart = np.linalg.norm(found.translations - true.translation, axis=1)
            reached.append(bool((apart < 1e-2).any()))
        assert np.mean(reached) >= 0.95

    def test_every_solution_puts_the_rods_on_the_spots(self) -> None:
        found = 0
        for frame, _, spots, _ in scenes(3, 40):
            if flatness(spots) < 0.1:
                continue  # a side that is wrong by the tolerance bends a flat triangle by far more
            seeds = solve(frame, spots[None])
            found += len(seeds.triples)
            points = frame.points(list(ALL), seeds.lambdas)
            # The distances' error to first order is held against the tolerance, so a little over it is right.
            np.testing.assert_allclose(distances(points), np.tile(distances(spots), (len(points), 1)), atol=0.31)
            on_spots = np.einsum("mij,mkj->mki", seeds.rotations, points) + seeds.translations[:, None]
            np.testing.assert_allclose(on_spots[..., 2], 0, atol=1e-9)
            # Triangles whose sides agree to 0.3 mm, laid with their centres and first sides together.
            assert np.linalg.norm(on_spots[..., :2] - spots, axis=-1).max(initial=0) < 12 * TOLERANCE
            np.testing.assert_allclose(
                seeds.rotations @ np.swapaxes(seeds.rotations, 1, 2), np.tile(np.eye(3), (len(points), 1, 1)), atol=1e-9
            )
            assert (np.linalg.det(seeds.rotations) > 0).all()
            assert (seeds.lambdas >= frame.lambda_min - SLACK).all()
            assert (seeds.lambdas <= frame.lambda_max + SLACK).all()
            assert (np.linalg.eigvalsh(seeds.lambda_covariance) > 0).all()
        assert found > 100

    def test_no_more_than_eight_distinct_solutions(self) -> None:
        most = 0
        for frame, _, spots, _ in scenes(4, 30):
            found = polished(frame, solve(frame, spots[None]), spots)
            distinct: list[Array] = []
            for pose in np.hstack([found.translations, 20 * found.rotations.reshape(-1, 9)]):
                if all(np.linalg.norm(pose - other) > 0.05 for other in distinct):
                    distinct.append(pose)
            assert len(distinct) <= 8
            most = max(most, len(distinct))
        assert most >= 4

    def test_each_triple_is_solved_by_itself(self) -> None:
        (frame, _, first, _), *_ = scenes(5, 1)
        rng = np.random.default_rng(6)
        spots = np.stack([first, first + rng.normal(0, 3, (3, 2)), first + 500.0, first * 30])
        together = solve(frame, spots)
        assert set(together.triples.tolist()) >= {0, 2}
        assert 3 not in together.triples
        for k in range(len(spots)):
            alone = solve(frame, spots[k : k + 1])
            np.testing.assert_allclose(together.lambdas[together.triples == k], alone.lambdas, atol=1e-12)

    def test_rods_by_their_rows(self) -> None:
        rng = np.random.default_rng(7)
        frame = random_frame(rng, 6)
        true = random_slice_from_frame(rng, frame)
        lines = (4, 0, 5)
        spots = cut(frame, true.rotation, true.translation).points_mm[list(lines)]
        seeds = solve(frame, spots[None], lines=lines)
        assert np.linalg.norm(seeds.translations - true.translation, axis=1).min() < 0.05


class TestParallelPairs:
    """Leksell's plates: rods in parallel pairs, and a slice at right angles to them, which is a double root."""

    @pytest.mark.parametrize("lines", [(0, 1, 3), (0, 1, 5), (1, 2, 4), (0, 2, 4), (1, 4, 5)])
    @pytest.mark.parametrize("tilt_deg", [0.0, 0.5, 5.0])
    def test_a_seed_from_which_the_truth_is_refined_is_returned(
        self, lines: tuple[int, int, int], tilt_deg: float
    ) -> None:
        frame = load_frame("leksell_ct")
        rng = np.random.default_rng(8)
        scale = PixelScale(0.5, 0.5)
        whitening = scale.inverse_matrix / 0.3
        reached = []
        for _ in range(20):
            axis = rng.normal(size=3)
            tilt = rotation_exp(np.radians(tilt_deg) * axis / np.linalg.norm(axis))
            true = Pose(tilt, tilt @ np.array([-95.0, 60.0, rng.uniform(30, 90)]) + [120.0, 120.0, 0.0])
            spots = cut(frame, true.rotation, true.translation).points_mm + scale.to_mm(rng.normal(0, 0.3, (6, 2)))
            seeds = solved(leksell_solver(lines), spots[None, list(lines)])
            m = len(seeds.triples)
            tiled, used = np.tile(spots, (m + 1, 1, 1)), np.ones((m + 1, 6), dtype=bool)
            rotations = np.concatenate([seeds.rotations, true.rotation[None]])
            translations = np.concatenate([seeds.translations, true.translation[None]])
            found = refine(frame, rotations, translations, tiled, used, whitening)
            reached.append(bool(np.nanmin(found.chi_square[:-1], initial=np.inf) < found.chi_square[-1] + 1e-3))
        assert np.mean(reached) >= 0.95

    def test_the_stated_uncertainty_is_finite_at_a_double_root(self) -> None:
        frame = load_frame("leksell_ct")
        true = Pose(np.eye(3), np.array([20.0, 180.0, 60.0]))
        lines = [0, 1, 3]
        spots = cut(frame, true.rotation, true.translation).points_mm[lines]
        seeds = solve(frame, spots[None], 0.8, (0, 1, 3))
        deviation = np.sqrt(np.linalg.eigvalsh(seeds.lambda_covariance)[:, -1])
        sigma = 0.8 / 4
        longest = distances(spots).max()
        assert len(deviation) > 0
        assert (deviation <= np.sqrt(2 * longest * sigma) * (1 + 1e-9)).all()
        assert (deviation > 1.0).all()


class TestNothing:
    def test_impossible_distances(self) -> None:
        (frame, _, spots, _), *_ = scenes(9, 1)
        middle = spots.mean(axis=0)
        for factor in (20.0, 1e-3):
            assert len(solve(frame, (middle + factor * (spots - middle))[None]).triples) == 0

    def test_no_triples(self) -> None:
        (frame, _, _, _), *_ = scenes(10, 1)
        seeds = solve(frame, np.empty((0, 3, 2)))
        assert seeds.triples.shape == (0,)
        assert seeds.rotations.shape == (0, 3, 3)
        assert seeds.translations.shape == (0, 3)
        assert seeds.lambdas.shape == (0, 3)
        assert seeds.lambda_covariance.shape == (0, 3, 3)

    def test_possible_distances_are_within_the_stated_bounds(self) -> None:
        for frame, _, spots, _ in scenes(11, 20):
            table = ThreeRodSolver(frame, ALL, TOLERANCE, SLACK).table(0, 3)
            between = distances(spots)
            assert (between >= table.low).all()
            assert (between <= table.high).all()


class TestCells:
    """What is said of a cell holds for the slices through it."""

    def test_the_table_of_the_rods_cut_holds_the_solution(self) -> None:
        rng = np.random.default_rng(12)
        found = []
        for _ in range(50):
            frame = random_frame(rng, 6)
            true = random_slice_from_frame(rng, frame, max_tilt_deg=40.0)
            cuts = cut(frame, true.rotation, true.translation)
            assert cuts.inside.all()
            solver = ThreeRodSolver(frame, (0, 2, 5), TOLERANCE, SLACK, 0.2)
            spots = cuts.points_mm[[0, 2, 5]]
            # All six rods are cut, and the slice is not among those that cut fewer.
            seeds = solver.solve(distances(spots)[:, None], solver.table(6, 6))
            found.append(bool((np.abs(seeds.lambdas - cuts.lambdas[[0, 2, 5]]).max(axis=1) < 0.5).any()))
            near = solver.cells_near(true.rotation[2], np.radians(5.0))
            prior = solver.solve(distances(spots)[:, None], solver.table(6, 6), near)
            kept = bool((np.abs(prior.lambdas - cuts.lambdas[[0, 2, 5]]).max(axis=1) < 0.5).any())
            assert kept == found[-1]
            assert near.mean() < 0.5
        assert np.mean(found) >= 0.98

    def test_cells_of_leaning_rods_are_in_no_table_of_three(self) -> None:
        frame = random_frame(np.random.default_rng(13), 4)
        loose, strict = (ThreeRodSolver(frame, ALL, TOLERANCE, SLACK, least) for least in (0.0, 0.9))
        assert (strict.rods_cut == 0).sum() > (loose.rods_cut == 0).sum()
        assert (strict.rods_cut <= loose.rods_cut).all()
