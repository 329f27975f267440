"""The maximum likelihood pose: at rest at the truth, found from afar, and as uncertain as it says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.solvers.maximum_likelihood import Refined, refine
from support.frames import random_frame, random_slice_from_frame

SCALE = PixelScale(0.5, 0.5)
OBLONG = PixelScale(0.4, 0.9, 0.05)


def scene(seed: int, n: int) -> tuple[Frame, Pose, Array]:
    """A random frame, its true slice_from_frame, and the exact cuts (n, 2) mm."""
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, n)
    pose = random_slice_from_frame(rng, frame)
    return frame, pose, cut(frame, pose.rotation, pose.translation).points_mm


def refined(frame: Frame, start: Pose, spots_mm: Array, whitening: Array, used: Array | None = None) -> Refined:
    """`refine` for spots (m, n, 2), all from one start."""
    m, n = spots_mm.shape[:2]
    mask = np.ones((m, n), dtype=bool) if used is None else np.broadcast_to(used, (m, n)).astype(bool)
    rotations, translations = np.tile(start.rotation, (m, 1, 1)), np.tile(start.translation, (m, 1))
    return refine(frame, rotations, translations, spots_mm, mask, whitening)


def pose_errors(found: Refined, true: Pose) -> Array:
    """(m, 6) in the perturbation of `Pose.perturbed`."""
    turns = Rotation.from_matrix(found.rotations @ true.rotation.T).as_rotvec()
    return np.hstack([found.translations - true.translation, turns])


def chi_square(frame: Frame, pose: Pose, spots_mm: Array, whitening: Array) -> float:
    residual = (spots_mm - cut(frame, pose.rotation, pose.translation).points_mm) @ whitening.T
    return float((residual**2).sum())


def steps(pose: Pose, size: float) -> list[tuple[Pose, Pose]]:
    """The pose a step ahead and a step behind in each of its six directions, mm and 1/50 rad."""
    moves = size * np.diag([1, 1, 1, 0.02, 0.02, 0.02])
    return [(pose.perturbed(d[:3], d[3:]), pose.perturbed(-d[:3], -d[3:])) for d in moves]


class TestMinimum:
    @pytest.mark.parametrize("n", [3, 4, 6])
    def test_stays_at_the_truth(self, n: int) -> None:
        frame, true, spots = scene(n, n)
        found = refined(frame, true, spots[None], SCALE.inverse_matrix / 0.1)
        assert found.chi_square[0] == pytest.approx(0, abs=1e-20)
        assert found.converged[0]
        np.testing.assert_allclose(pose_errors(found, true), 0, atol=1e-9)

    @pytest.mark.parametrize("n", [4, 5, 6, 8])
    def test_converges_from_5_mm_and_5_degrees(self, n: int) -> None:
        rng = np.random.default_rng(100 + n)
        for seed in range(12):
            frame, true, spots = scene(1000 * n + seed, n)
            aside = rng.normal(size=(2, 3))
            aside /= np.linalg.norm(aside, axis=1, keepdims=True)
            start = true.perturbed(5.0 * aside[0], np.radians(5.0) * aside[1])
            found = refined(frame, start, spots[None], SCALE.inverse_matrix / 0.1)
            assert found.converged[0]
            assert np.linalg.norm(found.translations[0] - true.translation) < 1e-9
            assert rotation_angle(found.rotations[0] @ true.rotation.T) < 1e-10
            assert found.chi_square[0] < 1e-16

    @pytest.mark.parametrize("scale", [SCALE, OBLONG], ids=str)
    @pytest.mark.parametrize("n", [4, 6])
    def test_is_the_minimum_that_scipy_finds(self, n: int, scale: PixelScale) -> None:
        rng = np.random.default_rng(7)
        whitening = scale.inverse_matrix / 0.3
        for seed in range(3):
            frame, true, exact = scene(seed, n)
            spots = exact + scale.to_mm(rng.normal(0, 0.3, (n, 2)))

            def residual(
                move: Array, frame: Frame = frame, true: Pose = true, spots: Array = spots, whitening: Array = whitening
            ) -> Array:
                pose = true.perturbed(move[:3], move[3:])
                rest: Array = (spots - cut(frame, pose.rotation, pose.translation).points_mm) @ whitening.T
                return rest.ravel()

            found = refined(frame, true, spots[None], whitening)
            other = least_squares(residual, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14, x_scale="jac")
            expected = true.perturbed(other.x[:3], other.x[3:])
            assert found.converged[0]
            assert found.chi_square[0] == pytest.approx(2 * other.cost, rel=1e-7)
            np.testing.assert_allclose(found.translations[0], expected.translation, atol=2e-4)
            np.testing.assert_allclose(found.rotations[0], expected.rotation, atol=1e-5)

    def test_gradient_vanishes_at_the_minimum(self) -> None:
        frame, true, exact = scene(5, 6)
        spots = exact + np.random.default_rng(1).normal(0, 0.1, exact.shape)
        whitening = SCALE.inverse_matrix / 0.2
        found = refined(frame, true, spots[None], whitening)
        pose = Pose(found.rotations[0], found.translations[0])
        assert chi_square(frame, pose, spots, whitening) == pytest.approx(float(found.chi_square[0]), rel=1e-12)

        def gradient(at: Pose) -> Array:
            return np.array(
                [
                    chi_square(frame, ahead, spots, whitening) - chi_square(frame, behind, spots, whitening)
                    for ahead, behind in steps(at, 1e-3)
                ]
            ) / (2e-3)

        assert np.abs(gradient(true)).max() > 1
        assert np.abs(gradient(pose)).max() < 1e-2

    def test_information_is_the_square_of_the_jacobian(self) -> None:
        frame, true, spots = scene(6, 5)
        whitening = OBLONG.inverse_matrix / 0.2
        found = refined(frame, true, spots[None], whitening)
        columns = []
        for k, (ahead, behind) in enumerate(steps(true, 1e-4)):
            difference = cut(frame, ahead.rotation, ahead.translation).points_mm
            difference = difference - cut(frame, behind.rotation, behind.translation).points_mm
            columns.append((difference @ whitening.T).ravel() / (2e-4 * (1 if k < 3 else 0.02)))
        jacobian = np.stack(columns, axis=1)
        np.testing.assert_allclose(found.information[0], jacobian.T @ jacobian, rtol=1e-5, atol=1e-3)

    def test_only_the_used_spots_count(self) -> None:
        frame, true, spots = scene(8, 7)
        used = np.array([1, 1, 0, 1, 0, 1, 1])
        wild = np.where(used[:, None] == 1, spots, np.nan)
        start = true.perturbed(np.array([1.0, -1.0, 2.0]), np.array([0.02, 0.0, -0.03]))
        found = refined(frame, start, wild[None], SCALE.inverse_matrix / 0.1, used)
        np.testing.assert_allclose(pose_errors(found, true), 0, atol=1e-9)
        assert found.cuts.points_mm.shape == (1, 7, 2)
        np.testing.assert_allclose(found.cuts.points_mm[0], spots, atol=1e-8)

    def test_many_at_once_are_one_by_one(self) -> None:
        frame, true, exact = scene(9, 5)
        rng = np.random.default_rng(2)
        spots = exact + rng.normal(0, 0.2, (8, 5, 2))
        used = np.ones((8, 5), dtype=bool)
        used[::2, 1] = False
        starts = [true.perturbed(rng.normal(0, 1, 3), rng.normal(0, 0.03, 3)) for _ in range(8)]
        rotations, translations = np.stack([s.rotation for s in starts]), np.stack([s.translation for s in starts])
        kept = rotations.copy(), translations.copy()
        together = refine(frame, rotations, translations, spots, used, SCALE.inverse_matrix / 0.3)
        for i in range(8):
            row = slice(i, i + 1)
            alone = refine(frame, rotations[row], translations[row], spots[row], used[row], SCALE.inverse_matrix / 0.3)
            np.testing.assert_allclose(together.translations[i], alone.translations[0], atol=1e-9)
            np.testing.assert_allclose(together.take(np.array([i])).chi_square, alone.chi_square, rtol=1e-9)
        np.testing.assert_array_equal(rotations, kept[0])
        np.testing.assert_array_equal(translations, kept[1])

    def test_nothing_to_refine(self) -> None:
        frame, _, _ = scene(9, 5)
        found = refine(
            frame, np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 5, 2)), np.empty((0, 5), dtype=bool), np.eye(2)
        )
        assert found.rotations.shape == (0, 3, 3)
        assert found.information.shape == (0, 6, 6)


class TestStatistics:
    """Limits at 99.9 %, two sides, for the seed as it is."""

    COUNT = 2000

    @pytest.mark.parametrize(("scale", "n", "noise_px"), [(SCALE, 6, 0.3), (OBLONG, 6, 0.1), (SCALE, 4, 0.05)])
    def test_errors_are_as_large_as_the_information_says(self, scale: PixelScale, n: int, noise_px: float) -> None:
        frame, true, exact = scene(21, n)
        rng = np.random.default_rng(3)
        whitening = scale.inverse_matrix / noise_px
        found = refined(frame, true, exact + scale.to_mm(rng.normal(0, noise_px, (self.COUNT, n, 2))), whitening)
        assert found.converged.all()
        errors = pose_errors(found, true)
        squared = np.einsum("mi,mij,mj->m", errors, found.information, errors)
        assert squared.mean() == pytest.approx(6, abs=3.29 * np.sqrt(12 / self.COUNT))
        freedom = 2 * n - 6
        assert found.chi_square.mean() == pytest.approx(freedom, abs=3.29 * np.sqrt(2 * freedom / self.COUNT))
        # The sample covariance in the axes in which the stated one is the unit matrix: its entries' errors are known.
        at_truth = refined(frame, true, exact[None], whitening).information[0]
        unit = errors @ np.linalg.cholesky(at_truth)
        sample = unit.T @ unit / self.COUNT
        np.testing.assert_allclose(np.diag(sample), 1, atol=4.5 * np.sqrt(2 / self.COUNT))
        np.testing.assert_allclose(sample - np.diag(np.diag(sample)), 0, atol=4.5 / np.sqrt(self.COUNT))

    def test_whitening_weighs_the_axes(self) -> None:
        # Noise in x alone is ten times that in y: told so, the pose is much surer than with equal weights.
        frame, true, exact = scene(22, 6)
        noise = np.random.default_rng(4).normal(0, 1, (self.COUNT, 6, 2)) * [0.5, 0.05]
        told = refined(frame, true, exact + noise, np.diag([1 / 0.5, 1 / 0.05]))
        untold = refined(frame, true, exact + noise, np.eye(2) / 0.5)
        errors = pose_errors(told, true)
        squared = np.einsum("mi,mij,mj->m", errors, told.information, errors)
        assert squared.mean() == pytest.approx(6, abs=3.29 * np.sqrt(12 / self.COUNT))
        assert np.linalg.norm(errors, axis=1).mean() < 0.8 * np.linalg.norm(pose_errors(untold, true), axis=1).mean()


class TestSharedErrors:
    """Errors that all spots share, integrated out, against the same as parameters of unit variance to be estimated."""

    MODES = 3

    def drawn(self, seed: int, n: int) -> tuple[Frame, Pose, Array, Array, Array]:
        """A frame, its pose, spots (n, 2) mm, a whitening (n, 2, 2) of each spot's own, and shared errors."""
        frame, true, exact = scene(seed, n)
        rng = np.random.default_rng(seed)
        root = rng.normal(0, 0.1, (n, 2, 2))
        covariances = root @ np.swapaxes(root, 1, 2) + 0.1**2 * np.eye(2)
        common = rng.normal(0, 0.5, (n, 2, self.MODES))
        noise = (np.linalg.cholesky(covariances) @ rng.standard_normal((n, 2, 1)))[..., 0]
        spots = exact + noise + common @ rng.standard_normal(self.MODES)
        return frame, true, spots, np.linalg.inv(np.linalg.cholesky(covariances)), common

    def solved(self, frame: Frame, start: Pose, spots: Array, whitening: Array, common: Array | None) -> Refined:
        used = np.ones((1, len(frame)), dtype=bool)
        shared = None if common is None else common[None]
        rotations, translations = start.rotation[None], start.translation[None]
        return refine(frame, rotations, translations, spots[None], used, whitening[None], 100, shared)

    def residual(self, given: Array, frame: Frame, pose: Pose, spots: Array, whitening: Array, common: Array) -> Array:
        """Whitened residuals and the errors themselves, at a perturbation (6,) of the pose and errors (k,)."""
        moved = pose.perturbed(given[:3], given[3:6])
        rest = spots - common @ given[6:] - cut(frame, moved.rotation, moved.translation).points_mm
        return np.append((whitening @ rest[..., None]).ravel(), given[6:])

    @pytest.mark.parametrize("n", [4, 5, 8])
    def test_joint_least_squares_has_the_same_optimum_and_information(self, n: int) -> None:
        for seed in range(4):
            frame, true, spots, whitening, common = self.drawn(40 + seed, n)
            found = self.solved(frame, true, spots, whitening, common)
            assert found.converged[0]
            arguments = (frame, true, spots, whitening, common)
            joint = least_squares(
                self.residual,
                np.zeros(6 + self.MODES),
                args=arguments,
                xtol=1e-14,
                ftol=1e-14,
                gtol=1e-14,
                x_scale="jac",
            )
            pose = true.perturbed(joint.x[:3], joint.x[3:6])
            assert found.chi_square[0] == pytest.approx(2 * joint.cost, rel=1e-6)
            np.testing.assert_allclose(found.translations[0], pose.translation, atol=5e-4)
            np.testing.assert_allclose(found.rotations[0], pose.rotation, atol=2e-5)
            # The Jacobian by finite differences, and of its square what is left of the pose: Schur's complement.
            here = (frame, Pose(found.rotations[0], found.translations[0]), spots, whitening, common)
            steps = 1e-5 * np.diag([*[1.0] * 3, *[0.02] * 3, *[1.0] * self.MODES])
            at = np.append(np.zeros(6), joint.x[6:])
            columns = [self.residual(at + step, *here) - self.residual(at - step, *here) for step in steps]
            jacobian = np.stack(columns, axis=1) / (2 * np.diag(steps))
            square = jacobian.T @ jacobian
            schur = square[:6, :6] - square[:6, 6:] @ np.linalg.solve(square[6:, 6:], square[6:, :6])
            size = np.sqrt(np.diag(schur))
            np.testing.assert_allclose(
                found.information[0] / np.outer(size, size), schur / np.outer(size, size), atol=1e-6
            )

    def test_none_of_no_size_change_nothing(self) -> None:
        frame, true, spots, whitening, common = self.drawn(50, 6)
        without = self.solved(frame, true, spots, whitening, None)
        nothing = self.solved(frame, true, spots, whitening, 0 * common)
        assert nothing.chi_square[0] == pytest.approx(without.chi_square[0], rel=1e-12)
        np.testing.assert_allclose(nothing.information, without.information, rtol=1e-9)
        with_them = self.solved(frame, true, spots, whitening, common)
        assert with_them.chi_square[0] < 0.9 * without.chi_square[0]

    def test_those_of_unused_rods_do_not_count(self) -> None:
        frame, true, spots, whitening, common = self.drawn(51, 7)
        used = np.array([[True, True, False, True, True, True, True]])
        found = []
        for wild in (0.0, np.nan, 1e6):
            shared = np.where(used[0][:, None, None], common, wild)
            one = refine(
                frame,
                true.rotation[None],
                true.translation[None],
                spots[None],
                used,
                whitening[None],
                100,
                shared[None],
            )
            found.append(one)
        for other in found[1:]:
            assert other.chi_square[0] == found[0].chi_square[0]
            np.testing.assert_array_equal(other.information, found[0].information)

    def test_many_at_once_are_one_by_one(self) -> None:
        """Poses come to rest at different times; each has shared errors of its own."""
        frame, true, spots, whitening, common = self.drawn(52, 6)
        rng = np.random.default_rng(1)
        sizes = np.array([0.0, 0.1, 1.0, 3.0, 10.0])
        shared = sizes[:, None, None, None] * common
        starts = [true.perturbed(size * rng.normal(0, 0.3, 3), rng.normal(0, 0.02, 3)) for size in sizes]
        together = refine(
            frame,
            np.stack([start.rotation for start in starts]),
            np.stack([start.translation for start in starts]),
            np.tile(spots, (5, 1, 1)),
            np.ones((5, 6), dtype=bool),
            np.tile(whitening, (5, 1, 1, 1)),
            100,
            shared,
        )
        for row, start in enumerate(starts):
            alone = self.solved(frame, start, spots, whitening, shared[row])
            assert together.chi_square[row] == pytest.approx(alone.chi_square[0], rel=1e-8)
            np.testing.assert_allclose(together.translations[row], alone.translations[0], atol=1e-6)

    def test_those_that_go_on_keep_their_own_spots_weights_and_errors(self) -> None:
        """Of eight poses every other one starts where it ends, and rests long before its neighbours."""
        frame, true, spots, whitening, common = self.drawn(54, 6)
        rng = np.random.default_rng(2)
        weights = rng.uniform(0.5, 2.0, (8, 6, 1, 1)) * whitening
        shared = rng.uniform(0.2, 5.0, (8, 1, 1, 1)) * common
        targets = spots + rng.normal(0, 0.3, (8, 6, 2))
        used = rng.random((8, 6)) > 0.1
        far = [true.perturbed(rng.normal(0, 3.0, 3), rng.normal(0, 0.1, 3)) for _ in range(8)]

        def from_poses(rotations: Array, translations: Array, rows: slice) -> Refined:
            return refine(frame, rotations, translations, targets[rows], used[rows], weights[rows], 100, shared[rows])

        def alone(row: int) -> Refined:
            return from_poses(far[row].rotation[None], far[row].translation[None], slice(row, row + 1))

        each = [alone(row) for row in range(8)]
        rotations = np.stack([each[row].rotations[0] if row % 2 == 0 else far[row].rotation for row in range(8)])
        translations = np.stack(
            [each[row].translations[0] if row % 2 == 0 else far[row].translation for row in range(8)]
        )
        together = from_poses(rotations, translations, slice(None))
        for row in range(8):
            assert together.chi_square[row] == pytest.approx(each[row].chi_square[0], rel=1e-7)
            np.testing.assert_allclose(together.translations[row], each[row].translations[0], atol=1e-4)
            np.testing.assert_allclose(together.information[row], each[row].information[0], rtol=1e-3)

    def test_errors_are_as_large_as_the_information_says(self) -> None:
        count, n = 1000, 6
        frame, true, exact = scene(53, n)
        rng = np.random.default_rng(5)
        common = rng.normal(0, 0.3, (n, 2, self.MODES))
        spots = (
            exact + rng.normal(0, 0.1, (count, n, 2)) + np.einsum("nik,mk->mni", common, rng.normal(size=(count, 3)))
        )
        rotations, translations = np.tile(true.rotation, (count, 1, 1)), np.tile(true.translation, (count, 1))
        used, shared = np.ones((count, n), dtype=bool), np.tile(common, (count, 1, 1, 1))
        found = refine(frame, rotations, translations, spots, used, np.eye(2) / 0.1, 100, shared)
        errors = pose_errors(found, true)
        squared = np.einsum("mi,mij,mj->m", errors, found.information, errors)
        assert squared.mean() == pytest.approx(6, abs=3.29 * np.sqrt(12 / count))
        assert found.chi_square.mean() == pytest.approx(6, abs=3.29 * np.sqrt(12 / count))
        untold = refine(frame, rotations, translations, spots, used, np.eye(2) / 0.1, 100)
        wrong = np.einsum("mi,mij,mj->m", pose_errors(untold, true), untold.information, pose_errors(untold, true))
        assert wrong.mean() > 20


class TestSingular:
    def test_three_parallel_rods(self) -> None:
        n = 5
        starts = np.array([[0, 0, -30], [40, 0, -30], [0, 30, -30], [-30, -30, -30], [20, 20, -30]], dtype=float)
        ends = starts + np.array([0.0, 0.0, 60.0])
        ends[3:, 0] += 15.0
        frame = Frame("parallel", tuple("abcde"), starts, ends, np.ones(n))
        true = Pose(rotation_exp(np.array([0.1, -0.15, 0.4])), np.array([100.0, 90.0, 2.0]))
        spots = cut(frame, true.rotation, true.translation).points_mm
        start = true.perturbed(np.array([0.5, 0.5, 1.0]), np.array([0.01, -0.02, 0.01]))
        found = refined(frame, start, spots[None], SCALE.inverse_matrix / 0.1, np.array([1, 1, 1, 0, 0]))
        assert np.isfinite(found.translations).all()
        assert np.linalg.det(found.rotations[0]) == pytest.approx(1)
        assert found.chi_square[0] < 1e-6
        # The position along the rods is what three parallel ones do not tell.
        values, vectors = np.linalg.eigh(found.information[0])
        assert values[0] < 1e-9 * values[-1]
        np.testing.assert_allclose(np.abs(vectors[:3, 0]), np.abs(found.rotations[0][:, 2]), atol=1e-4)

    def test_no_spot_and_one_spot(self) -> None:
        frame, true, spots = scene(30, 4)
        used = np.array([[0, 0, 0, 0], [0, 1, 0, 0]])
        found = refined(frame, true, np.stack([spots, spots + 1.0]), SCALE.inverse_matrix / 0.1, used)
        assert found.chi_square[0] == 0
        np.testing.assert_array_equal(found.translations[0], true.translation)
        assert found.chi_square[1] < 1e-6
        assert np.isfinite(found.rotations).all()

    def test_a_rod_within_the_slice_is_left_where_it_is(self) -> None:
        starts = np.array([[0, 0, -30], [40, 0, -30], [0, 30, -30], [-30, 10, 0]], dtype=float)
        ends = np.array([[5, 0, 30], [40, 9, 30], [-7, 30, 30], [30, 10, 0]], dtype=float)
        frame = Frame("flat", tuple("abcd"), starts, ends, np.ones(4))
        spots = np.zeros((1, 4, 2))
        found = refined(frame, Pose.identity(), spots, np.eye(2))
        assert not found.converged[0]
        assert np.isnan(found.chi_square[0])
        np.testing.assert_array_equal(found.translations[0], 0)
        without = refined(frame, Pose.identity(), spots, np.eye(2), np.array([1, 1, 1, 0]))
        assert np.isfinite(without.chi_square[0])
