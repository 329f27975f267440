"""What is said of cells and of further rods before a pose is known: bounds hold, predictions have their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.prior import Near, Prior
from stereoreg_ros.matching.seeds import _predict, spot_triples
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.solvers.distance_equations import PAIRS
from stereoreg_ros.solvers.three_rods import Seeds, ThreeRodSolver
from support.frames import random_frame, random_slice_from_frame

TOLERANCE_MM, SLACK_MM = 0.3, 1.0
LINES = (4, 0, 2)
OTHERS = np.array([1, 3, 5])


def solver_of(frame: Frame, tolerance_mm: float = TOLERANCE_MM) -> ThreeRodSolver:
    return ThreeRodSolver(frame, LINES, tolerance_mm, SLACK_MM, 0.2)


def distances(points: Array) -> Array:
    """Of the pairs of points (..., 3, k), in the order of PAIRS."""
    between: Array = np.stack([np.linalg.norm(points[..., a, :] - points[..., b, :], axis=-1) for a, b in PAIRS], -1)
    return between


class TestCells:
    """Positions all over the cells of the rods, their corners among them."""

    @staticmethod
    def positions(solver: ThreeRodSolver, rng: np.random.Generator, count: int) -> Array:
        """(cells, count, 3) mm."""
        shares = rng.uniform(-0.5, 0.5, (count, 3))
        shares[: count // 2] = np.sign(shares[: count // 2]) / 2
        found: Array = solver._centres[:, None] + shares * solver._cell
        return found

    def test_distances_are_within_the_bounds_of_their_cell(self) -> None:
        rng = np.random.default_rng(1)
        reached = []
        for _ in range(4):
            solver = solver_of(random_frame(rng, 6))
            found = distances(solver.points(self.positions(solver, rng, 40)))
            nearest, farthest = solver._distance_bounds()
            assert (found >= nearest[:, None] - 1e-9).all()
            assert (found <= farthest[:, None] + 1e-9).all()
            # Corners have the greatest, and in cells whose rods are far apart nearly the least.
            np.testing.assert_allclose(found.max(axis=1), farthest, atol=1e-9)
            reached.append(np.median(found.min(axis=1) - nearest))
            np.testing.assert_allclose(solver._nearest, nearest - TOLERANCE_MM)
            np.testing.assert_allclose(solver._farthest, farthest + TOLERANCE_MM)
        assert max(reached) < 0.3

    def test_the_skewed_box_of_a_cell_holds_its_distances_with_their_noise(self) -> None:
        rng = np.random.default_rng(2)
        outside = 0
        for _ in range(4):
            solver = solver_of(random_frame(rng, 6))
            found = distances(solver.points(self.positions(solver, rng, 40)))
            noise = rng.normal(size=found.shape)
            noise *= TOLERANCE_MM / np.linalg.norm(noise, axis=-1, keepdims=True)
            factors, constants = solver._box[:, :9].reshape(-1, 3, 3).astype(np.float64), solver._box[:, 9:]

            def held(measured: Array, factors: Array = factors, constants: Array = constants) -> Array:
                values = np.einsum("cij,csj->csi", factors, measured) + constants[:, None]
                return np.asarray(np.abs(values).max(axis=-1) <= 1.0 + 1e-4)

            # Between the points that were tried distances may be a little farther: seldom.
            assert held(found + noise).mean() > 0.999
            assert held(found).all()
            outside += int(np.logical_not(held(found + 30 * noise)).sum())
        # It is no larger than need be: what is 9 mm off hardly ever fits.
        assert outside > 0.9 * 4 * found.shape[0] * found.shape[1]

    def test_the_normals_of_a_cell_are_within_its_spread(self) -> None:
        rng = np.random.default_rng(3)
        solver = solver_of(random_frame(rng, 6))
        points = solver.points(self.positions(solver, rng, 40))
        normals = np.cross(points[..., 1, :] - points[..., 0, :], points[..., 2, :] - points[..., 0, :])
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        apart = np.arccos(np.minimum(np.abs(np.einsum("csi,ci->cs", normals, solver._normals)), 1.0))
        well_shaped = solver._normal_spread < 0.5
        assert well_shaped.mean() > 0.3
        assert (apart.max(axis=1) <= 1.1 * solver._normal_spread + 1e-6)[well_shaped].all()
        # And a slice of such a normal is sought in these cells, however little is allowed.
        for cell in np.flatnonzero(well_shaped)[::50]:
            for normal in (normals[cell, 0], -normals[cell, 0]):
                assert solver.cells_near(normal, 1e-3)[cell]
        assert solver.cells_near(np.array([0.0, 0.0, 1.0]), 0.05).mean() < 0.7


class Scene:
    """Six rods in a slice, the seed of three of them, and spots of all."""

    def __init__(self, seed: int, rod_mm: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.frame = random_frame(rng, 6)
        self.pose: Pose = random_slice_from_frame(rng, self.frame)
        self.cuts = cut(self.frame, self.pose.rotation, self.pose.translation)
        tolerances = Tolerances.none(self.frame)._replace(rod_mm=np.linspace(0.5, 1.0, 6) * rod_mm)
        covariances = np.tile(0.04 * np.eye(2), (6, 1, 1))
        self.spots = Spots.of(self.cuts.points_mm, covariances, None, tolerances)
        self.solver = solver_of(self.frame)
        root = rng.normal(size=(3, 3))
        self.lambda_covariance = 0.01 * (root @ root.T + 0.2 * np.eye(3))

    def predicted(self, shift: Array | None = None, covariance: Array | None = None) -> tuple[Array, Array]:
        """Places (k, 2) mm of the further rods, and covariances (k, 2, 2), for the true positions or others."""
        lambdas = self.cuts.lambdas[list(LINES)] + (0.0 if shift is None else shift)
        given = np.zeros((3, 3)) if covariance is None else covariance
        seeds = Seeds(np.zeros(1, dtype=np.intp), lambdas[None], given[None])
        found = _predict(self.spots, self.frame, self.solver, OTHERS, np.array(LINES)[:, None], seeds)
        xx, yy, xy = (part[:, 0] for part in (found.xx, found.yy, found.xy))
        assert found.on_rod.all()
        return np.stack([found.x[:, 0], found.y[:, 0]], axis=1), np.moveaxis(np.array([[xx, xy], [xy, yy]]), 2, 0)


class TestPrediction:
    @pytest.mark.parametrize("seed", range(5))
    def test_further_rods_are_where_the_slice_cuts_them(self, seed: int) -> None:
        scene = Scene(seed)
        np.testing.assert_allclose(scene.predicted()[0], scene.cuts.points_mm[OTHERS], atol=1e-8)

    @pytest.mark.parametrize("seed", range(5))
    def test_spots_that_err_carry_them_by_their_share(self, seed: int) -> None:
        """As a point of the triangle's plane moves with its corners; and the spot that is looked for errs as well."""
        scene = Scene(seed)
        corners = np.vstack([scene.cuts.points_mm[list(LINES)].T, np.ones(3)])
        for place, covariance in zip(*scene.predicted(), strict=True):
            shares = np.linalg.solve(corners, np.append(place, 1.0))
            np.testing.assert_allclose(covariance, 0.04 * (1 + shares @ shares) * np.eye(2), rtol=1e-9, atol=1e-12)

    @pytest.mark.parametrize("seed", range(5))
    def test_positions_along_the_seeds_rods_that_err_move_them(self, seed: int) -> None:
        """By the derivative of the place by each position, here by differences."""
        scene = Scene(seed)
        plain = scene.predicted()[1]
        step = 1e-4
        jacobian = np.stack(
            [(scene.predicted(step * axis)[0] - scene.predicted(-step * axis)[0]) / (2 * step) for axis in np.eye(3)],
            axis=2,
        )
        expected = plain + jacobian @ scene.lambda_covariance @ np.swapaxes(jacobian, 1, 2)
        found = scene.predicted(covariance=scene.lambda_covariance)[1]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
        assert np.abs(found - plain).max() > 1e-3

    @pytest.mark.parametrize("seed", range(5))
    def test_a_rod_that_is_off_is_cut_elsewhere_along_its_lean(self, seed: int) -> None:
        scene, with_rods = Scene(seed), Scene(seed, rod_mm=0.5)
        added = with_rods.predicted()[1] - scene.predicted()[1]
        slopes = scene.cuts.directions[OTHERS, :2] / scene.cuts.directions[OTHERS, 2:]
        rods_mm2 = with_rods.spots.tolerances.rod_mm[OTHERS] ** 2
        # What a rod is off by in the slice is part of what is said of the spots.
        expected = rods_mm2[:, None, None] * (slopes[:, :, None] * slopes[:, None])
        np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-9)


class TestTriples:
    """Of four spots at 3, 4 and 5 mm and one far off, those whose sides are as long as is allowed."""

    MM = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0], [100.0, 100.0]])

    def triples(self, low: list[float], high: list[float], prior: Prior) -> list[tuple[int, ...]]:
        rows, lengths = spot_triples(self.MM, [0, 1, 2], np.array(low), np.array(high), prior)
        expected = distances(self.MM[rows.T])
        np.testing.assert_allclose(lengths.T, expected, rtol=1e-6)
        return [tuple(one) for one in rows.T.tolist()]

    OPEN = Prior(np.eye(3), np.pi)

    def test_each_pair_has_bounds_of_its_own(self) -> None:
        """First and second spot 3 mm apart, first and third 5 mm, second and third 4 mm."""
        assert self.triples([2.9, 4.9, 3.9], [3.1, 5.1, 4.1], self.OPEN) == [(0, 1, 2)]
        assert self.triples([3.9, 4.9, 2.9], [4.1, 5.1, 3.1], self.OPEN) == [(2, 1, 0)]
        assert self.triples([2.9, 2.9, 2.9], [5.1, 5.1, 5.1], self.OPEN) == [
            (0, 1, 2),
            (0, 2, 1),
            (1, 0, 2),
            (1, 2, 0),
            (2, 0, 1),
            (2, 1, 0),
        ]

    def test_near_a_guess_each_rod_has_spots_of_its_own(self) -> None:
        of_line = np.array([[True, True, False, True], [True, True, False, True], [False, False, True, True]])
        near = Prior(np.eye(3), 0.1, Near(np.zeros(3), 10.0, of_line))
        assert self.triples([2.9, 2.9, 2.9], [5.1, 5.1, 5.1], near) == [(0, 1, 2), (1, 0, 2)]

    def test_a_spot_is_given_to_one_rod_only(self) -> None:
        assert self.triples([0.0, 0.0, 0.0], [4.5, 4.5, 4.5], self.OPEN) == []


class TestPrior:
    def test_seeds_may_be_ten_degrees_farther_off_than_poses(self) -> None:
        assert Prior(np.eye(3), np.radians(30.0)).seed_angle == pytest.approx(np.radians(40.0))

    def test_of_some_spots_each_rod_keeps_those_within_its_reach(self) -> None:
        reach = np.array([[True, False, False, True], [False, True, False, False], [True, True, False, False]])
        prior = Prior(np.eye(3), 0.5, Near(np.zeros(3), 10.0, reach))
        some = prior.only(np.array([1, 3])).near
        assert some is not None
        np.testing.assert_array_equal(some.spots_of_line, reach[:, [1, 3]])
        everywhere = Prior(np.eye(3), 0.5)
        assert everywhere.only(np.array([1])) is everywhere
