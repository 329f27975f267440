"""Where rods cut the slice, against the literal equation of the paper, finite differences and brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp, skew
from stereoreg_ros.geometry.projection import (
    cut,
    cut_jacobian,
    point_line_distances,
    project,
    projection_jacobian,
    rod_covariances,
)
from stereoreg_ros.geometry.slice import PixelScale
from support.frames import random_frame, random_slice_from_frame

SCALES = [PixelScale(0.5, 0.5), PixelScale(0.45, 0.8), PixelScale(0.5, 0.6, -0.07)]
UPRIGHT = Frame(
    "upright",
    ("z", "leaning", "within"),
    np.array([[5, 7, -10], [-10, 0, -10], [-20, 4, 0]], dtype=float),
    np.array([[5, 7, 10], [10, 0, 10], [20, 4, 0]], dtype=float),
    np.ones(3),
)


def maurin_28(frame: Frame, slice_from_frame: Pose, scale: PixelScale) -> Array:
    """Eq. 28 of Maurin 2009, rod by rod: Q = S^-1 (F'F)^-1 F' (w - [y]x t), F = [y]x [r1 r2]."""
    frame_from_slice = slice_from_frame.inverse()
    pixels = []
    for y, w in zip(frame.directions, frame.moments, strict=True):
        f = skew(y) @ frame_from_slice.rotation[:, :2]
        right = f.T @ (w - skew(y) @ frame_from_slice.translation)
        pixels.append(np.linalg.inv(scale.matrix) @ np.linalg.inv(f.T @ f) @ right)
    return np.array(pixels)


class TestCut:
    @pytest.mark.parametrize("scale", SCALES, ids=str)
    def test_is_equation_28(self, scale: PixelScale) -> None:
        rng = np.random.default_rng(11)
        for _ in range(20):
            frame = random_frame(rng, 6)
            pose = random_slice_from_frame(rng, frame, max_tilt_deg=40)
            pixels, _ = project(frame, pose, scale)
            np.testing.assert_allclose(pixels, maurin_28(frame, pose, scale), atol=1e-8)

    def test_cuts_lie_on_the_rod_and_in_the_slice(self) -> None:
        rng = np.random.default_rng(12)
        frame = random_frame(rng, 8)
        pose = random_slice_from_frame(rng, frame)
        cuts = cut(frame, pose.rotation, pose.translation)
        in_slice = pose @ frame.points(np.arange(8), cuts.lambdas)
        np.testing.assert_allclose(in_slice[:, 2], 0, atol=1e-11)
        np.testing.assert_allclose(in_slice[:, :2], cuts.points_mm, atol=1e-11)
        np.testing.assert_allclose(cuts.directions, frame.directions @ pose.rotation.T, atol=1e-14)

    def test_batch_is_a_loop(self) -> None:
        rng = np.random.default_rng(13)
        frame = random_frame(rng, 5)
        rotations = rotation_exp(rng.normal(scale=0.5, size=(3, 4, 3)))
        translations = rng.normal(scale=20, size=(3, 4, 3))
        cuts = cut(frame, rotations, translations)
        jacobian = cut_jacobian(cuts, translations)
        assert cuts.points_mm.shape == (3, 4, 5, 2)
        assert jacobian.shape == (3, 4, 5, 2, 6)
        assert 0 < cuts.inside.mean() < 1
        for i, j in np.ndindex(3, 4):
            one = cut(frame, rotations[i, j], translations[i, j])
            np.testing.assert_array_equal(cuts.inside[i, j], one.inside)
            for name in ("points_mm", "lambdas", "directions"):
                together, alone = getattr(cuts, name)[i, j], getattr(one, name)
                np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(jacobian[i, j], cut_jacobian(one, translations[i, j]), rtol=1e-11, atol=1e-11)

    def test_take_chooses_poses(self) -> None:
        rng = np.random.default_rng(14)
        cuts = cut(random_frame(rng, 4), rotation_exp(rng.normal(size=(5, 3))), np.zeros((5, 3)))
        for chosen in (np.array([False, True, False, False, True]), np.array([1, 4])):
            for whole, part in zip(cuts, cuts.take(chosen), strict=True):
                np.testing.assert_array_equal(part, whole[[1, 4]])

    def test_which_end_is_called_the_first_does_not_matter(self) -> None:
        rng = np.random.default_rng(19)
        frame = random_frame(rng, 6)
        pose = random_slice_from_frame(rng, frame)
        turned = replace(frame, starts=frame.ends, ends=frame.starts)
        there, back = (cut(one, pose.rotation, pose.translation) for one in (frame, turned))
        np.testing.assert_allclose(back.points_mm, there.points_mm, atol=1e-10)
        np.testing.assert_allclose(back.lambdas, -there.lambdas, atol=1e-10)
        assert back.inside.all()
        jacobians = [cut_jacobian(one, pose.translation) for one in (there, back)]
        np.testing.assert_allclose(jacobians[1], jacobians[0], atol=1e-9)
        tolerances = np.linspace(0.1, 0.3, 6)
        covariances = [rod_covariances(*given) for given in ((frame, tolerances, there), (turned, tolerances, back))]
        np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-9)

    @pytest.mark.parametrize(("depth", "inside"), [(-10.5, False), (-9.5, True), (9.5, True), (10.5, False)])
    def test_a_cut_beyond_the_ends_is_flagged(self, depth: float, inside: bool) -> None:
        pose = Pose(np.eye(3), np.array([0.0, 0.0, -depth]))
        cuts = cut(UPRIGHT, pose.rotation, pose.translation)
        assert cuts.inside.tolist() == [inside, inside, False]
        # The cut is still told, as where the prolonged rod meets the plane.
        np.testing.assert_allclose(cuts.points_mm[:2], np.array([[5.0, 7.0], [depth, 0.0]]), atol=1e-12)
        assert cuts.lambdas[0] == pytest.approx(depth)

    @pytest.mark.parametrize("depth", [0.0, 3.0])
    @pytest.mark.parametrize("tilt", [0.0, 1e-9])
    def test_a_line_within_the_slice_has_no_cut_and_gives_no_warning(self, depth: float, tilt: float) -> None:
        pose = Pose(rotation_exp(np.array([0.0, tilt, 0.0])), np.array([0.0, 0.0, depth]))
        pixels, cuts = project(UPRIGHT, pose, SCALES[2])
        by_pose, by_scale = projection_jacobian(cuts, pose, SCALES[2])
        assert not cuts.inside[2]
        for array in (cuts.points_mm, cuts.lambdas, pixels, by_pose, by_scale):
            assert np.isnan(array[2]).any()
            assert np.isfinite(array[:2]).all()


class TestJacobians:
    @pytest.mark.parametrize("scale", SCALES, ids=str)
    def test_by_pose(self, scale: PixelScale) -> None:
        rng = np.random.default_rng(15)
        frame = random_frame(rng, 6)
        pose = random_slice_from_frame(rng, frame, max_tilt_deg=40)
        _, cuts = project(frame, pose, scale)
        by_pose, _ = projection_jacobian(cuts, pose, scale)
        assert by_pose.shape == (6, 2, 6)
        for k in range(6):
            step = np.eye(6)[k] * (1e-4 if k < 3 else 1e-6)
            ahead, _ = project(frame, pose.perturbed(step[:3], step[3:]), scale)
            behind, _ = project(frame, pose.perturbed(-step[:3], -step[3:]), scale)
            np.testing.assert_allclose(by_pose[..., k], (ahead - behind) / (2 * step[k]), rtol=1e-6, atol=1e-6)

    @pytest.mark.parametrize("scale", SCALES, ids=str)
    def test_by_scale_and_shear(self, scale: PixelScale) -> None:
        rng = np.random.default_rng(16)
        frame = random_frame(rng, 6)
        pose = random_slice_from_frame(rng, frame)
        _, cuts = project(frame, pose, scale)
        _, by_scale = projection_jacobian(cuts, pose, scale)
        assert by_scale.shape == (6, 2, 3)
        values = np.array([scale.sx, scale.sy, scale.shear])
        for k in range(3):
            step = np.eye(3)[k] * 1e-6
            ahead, _ = project(frame, pose, PixelScale(*(values + step)))
            behind, _ = project(frame, pose, PixelScale(*(values - step)))
            np.testing.assert_allclose(by_scale[..., k], (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-5)


class TestRodCovariances:
    @pytest.mark.parametrize("tilt_deg", [10.0, 45.0])
    def test_are_those_of_rods_with_their_ends_off(self, tilt_deg: float) -> None:
        """Of cuts along the whole length of rods, near their ends and in their middles."""
        rng = np.random.default_rng(21)
        frame = random_frame(rng, 6)
        tolerances = np.array([0.05, 0.1, 0.2, 0.3, 0.1, 0.2])
        count = 20_000
        for height in (-25.0, 0.0, 28.0):
            tilt = rotation_exp(np.radians(tilt_deg) * np.array([0.6, -0.8, 0.0]))
            pose = Pose(tilt, np.array([5.0, -7.0, height]))
            cuts = cut(frame, pose.rotation, pose.translation)
            stated = rod_covariances(frame, tolerances, cuts)
            off = rng.normal(size=(2, count, 6, 3)) * tolerances[:, None]
            starts, ends = pose @ (frame.starts + off[0]).reshape(-1, 3), pose @ (frame.ends + off[1]).reshape(-1, 3)
            share = (-starts[:, 2] / (ends - starts)[:, 2])[:, None]
            points = (starts + share * (ends - starts))[:, :2].reshape(count, 6, 2) - cuts.points_mm
            sample = np.einsum("mni,mnj->nij", points, points) / count
            whitening = np.linalg.inv(np.linalg.cholesky(stated))
            unit = whitening @ sample @ np.swapaxes(whitening, 1, 2)
            # Beyond chance only by the second order of a rod that turns.
            np.testing.assert_allclose(unit, np.tile(np.eye(2), (6, 1, 1)), atol=4.5 * np.sqrt(2 / count) + 0.005)

    def test_middle_of_an_upright_rod(self) -> None:
        cuts = cut(UPRIGHT, np.eye(3), np.zeros(3))
        found = rod_covariances(UPRIGHT, np.array([0.2, 0.4, 0.1]), cuts)
        np.testing.assert_allclose(found[0], 0.5 * 0.2**2 * np.eye(2))
        assert np.isnan(found[2]).all()

    def test_batch_is_a_loop(self) -> None:
        rng = np.random.default_rng(22)
        frame = random_frame(rng, 4)
        rotations, translations = rotation_exp(rng.normal(0, 0.3, (5, 3))), rng.normal(0, 10, (5, 3))
        together = rod_covariances(frame, np.full(4, 0.2), cut(frame, rotations, translations))
        assert together.shape == (5, 4, 2, 2)
        for row in range(5):
            alone = cut(frame, rotations[row], translations[row])
            np.testing.assert_allclose(together[row], rod_covariances(frame, np.full(4, 0.2), alone), rtol=1e-9)


class TestDistances:
    def test_zero_on_the_line(self) -> None:
        rng = np.random.default_rng(17)
        frame = random_frame(rng, 6)
        pose = random_slice_from_frame(rng, frame)
        cuts = cut(frame, pose.rotation, pose.translation)
        chosen = np.array([5, 0, 3])
        np.testing.assert_allclose(point_line_distances(frame, chosen, pose, cuts.points_mm[chosen]), 0, atol=1e-11)

    def test_brute_force_elsewhere(self) -> None:
        rng = np.random.default_rng(18)
        frame = random_frame(rng, 6)
        pose = random_slice_from_frame(rng, frame)
        lines = rng.integers(0, 6, 40)
        points = rng.uniform(60, 180, (40, 2))
        # Densely along each line: the least distance is missed by less than 0.025^2 / 2 d.
        along = np.arange(-400, 400, 0.05)
        dense = pose @ frame.points(np.arange(6)[:, None], along).reshape(-1, 3)
        offset = dense.reshape(6, -1, 3)[lines] - np.column_stack([points, np.zeros(40)])[:, None]
        least = np.linalg.norm(offset, axis=-1).min(axis=1)
        found = point_line_distances(frame, lines, pose, points)
        np.testing.assert_allclose(found, least, atol=1e-3)
        assert found.max() > 20

    def test_nothing_asked(self) -> None:
        found = point_line_distances(UPRIGHT, np.empty(0, dtype=np.intp), Pose.identity(), np.empty((0, 2)))
        assert found.shape == (0,)
