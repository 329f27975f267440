"""Rotations and poses, near the angles 0 and pi too."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.pose import (
    Array,
    Pose,
    nearest_rotation,
    rotation_angle,
    rotation_exp,
    rotation_from_quaternion,
    skew,
)

SEEDED = settings(derandomize=True, deadline=None)

vectors = arrays(np.float64, 3, elements=st.floats(-50, 50))
quaternions = arrays(np.float64, 4, elements=st.floats(-5, 5)).filter(lambda q: bool(np.linalg.norm(q) > 1e-3))
poses = st.builds(Pose.from_quaternion, quaternions, vectors)

AXES = [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], np.array([0.6, -0.8, 0.0]), np.array([2.0, -1.0, 2.0]) / 3]
ANGLES = [0.0, 1e-100, 1e-12, 1e-8, 1e-4, 0.3, np.pi / 2, 3.0, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi]


def homogeneous(pose: Pose) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
    return matrix


class TestRotations:
    @SEEDED
    @given(vectors, vectors)
    def test_skew_is_the_cross_product(self, a: Array, b: Array) -> None:
        np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)

    @SEEDED
    @given(vectors)
    def test_exp_agrees_with_scipy(self, vector: Array) -> None:
        np.testing.assert_allclose(rotation_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)

    @pytest.mark.parametrize("axis", AXES, ids=str)
    @pytest.mark.parametrize("angle", ANGLES)
    def test_exp_is_a_rotation_about_its_axis_by_its_angle(self, axis: Array, angle: float) -> None:
        rotation = rotation_exp(angle * axis)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-14)
        np.testing.assert_allclose(rotation @ axis, axis, atol=1e-15)
        # A relative bound: arccos of the trace would know a small angle, or one near pi, only to 1e-8.
        assert float(rotation_angle(rotation)) == pytest.approx(angle, rel=1e-14, abs=0)
        assert np.pi - float(rotation_angle(rotation)) == pytest.approx(np.pi - angle, abs=1e-15)

    def test_exp_of_a_tiny_vector_is_its_cross_product(self) -> None:
        vector = np.array([3e-9, -2e-9, 1e-9])
        np.testing.assert_allclose(rotation_exp(vector) - np.eye(3), skew(vector), atol=3e-16)

    def test_batches_are_loops(self) -> None:
        rotation_vectors = np.random.default_rng(0).normal(size=(4, 5, 3))
        rotations = rotation_exp(rotation_vectors)
        angles = rotation_angle(rotations)
        nearest = nearest_rotation(2 * rotations)
        assert rotations.shape == (4, 5, 3, 3)
        assert angles.shape == (4, 5)
        for i, j in np.ndindex(4, 5):
            np.testing.assert_array_equal(rotations[i, j], rotation_exp(rotation_vectors[i, j]))
            assert angles[i, j] == rotation_angle(rotations[i, j])
            np.testing.assert_allclose(nearest[i, j], rotations[i, j], atol=1e-14)
        assert rotation_exp(np.empty((0, 3))).shape == (0, 3, 3)
        assert rotation_angle(np.empty((0, 3, 3))).shape == (0,)

    @SEEDED
    @given(arrays(np.float64, (3, 3), elements=st.floats(-3, 3)))
    def test_nearest_rotation_is_a_rotation_and_none_is_nearer(self, matrix: Array) -> None:
        nearest = nearest_rotation(matrix)
        np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(nearest) == pytest.approx(1)
        others = Rotation.random(200, random_state=1).as_matrix()
        others = np.concatenate([others, rotation_exp(1e-3 * np.vstack([np.eye(3), -np.eye(3)])) @ nearest])
        distances = np.linalg.norm(others - matrix, axis=(1, 2))
        assert np.linalg.norm(nearest - matrix) <= distances.min() + 1e-12

    def test_nearest_rotation_to_a_reflection_has_determinant_plus_one(self) -> None:
        nearest = nearest_rotation(np.diag([1.0, 2.0, -0.5]))
        np.testing.assert_allclose(nearest, np.eye(3), atol=1e-15)


class TestQuaternion:
    @pytest.mark.parametrize(
        ("rotation", "quaternion"),
        [
            (np.eye(3), [0, 0, 0, 1]),
            ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]),
            ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)]),
        ],
    )
    def test_scalar_comes_last(self, rotation: Array, quaternion: list[float]) -> None:
        pose = Pose(np.array(rotation, dtype=float), np.zeros(3))
        np.testing.assert_allclose(pose.quaternion_xyzw, quaternion, atol=1e-15)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation, atol=1e-15)

    @SEEDED
    @given(quaternions)
    def test_round_trip_up_to_length_and_sign(self, quaternion: Array) -> None:
        unit = quaternion / np.linalg.norm(quaternion)
        found = Pose.from_quaternion(quaternion, np.zeros(3)).quaternion_xyzw
        assert found[3] >= 0
        assert np.linalg.norm(found) == pytest.approx(1)
        assert abs(found @ unit) == pytest.approx(1)
        np.testing.assert_allclose(
            rotation_from_quaternion(-3 * quaternion), rotation_from_quaternion(quaternion), atol=1e-12
        )

    @pytest.mark.parametrize("axis", AXES, ids=str)
    def test_scalar_is_not_negative_on_either_side_of_pi(self, axis: Array) -> None:
        for angle in (np.pi - 1e-3, np.pi + 1e-3):
            quaternion = Pose(rotation_exp(angle * axis), np.zeros(3)).quaternion_xyzw
            assert quaternion[3] == pytest.approx(np.sin(5e-4))
            np.testing.assert_allclose(quaternion[:3], np.sign(np.pi - angle) * axis * np.cos(5e-4), atol=1e-12)


class TestPose:
    @SEEDED
    @given(poses, poses, vectors)
    def test_composition(self, a_from_b: Pose, b_from_c: Pose, p_c: Array) -> None:
        a_from_c = a_from_b @ b_from_c
        np.testing.assert_allclose(homogeneous(a_from_c), homogeneous(a_from_b) @ homogeneous(b_from_c), atol=1e-10)
        np.testing.assert_allclose(a_from_c @ p_c, a_from_b @ (b_from_c @ p_c), atol=1e-10)

    @SEEDED
    @given(poses, vectors)
    def test_inverse(self, a_from_b: Pose, p_b: Array) -> None:
        np.testing.assert_allclose(homogeneous(a_from_b.inverse() @ a_from_b), np.eye(4), atol=1e-10)
        np.testing.assert_allclose(a_from_b.inverse() @ (a_from_b @ p_b), p_b, atol=1e-10)

    def test_moves_points_one_by_one_or_together(self) -> None:
        pose = Pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [10, 20, 30])  # type: ignore[arg-type]
        np.testing.assert_allclose(pose @ np.array([1.0, 2.0, 3.0]), [8, 21, 33])
        np.testing.assert_allclose(pose @ np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]), [[8, 21, 33], [10, 20, 30]])
        assert (pose @ np.empty((0, 3))).shape == (0, 3)

    def test_identity_changes_nothing(self) -> None:
        points = np.random.default_rng(0).normal(size=(5, 3))
        np.testing.assert_array_equal(Pose.identity() @ points, points)

    @SEEDED
    @given(poses, vectors, vectors, vectors)
    def test_perturbed_turns_about_its_own_origin_in_the_left_axes(
        self, a_from_b: Pose, position: Array, rotation_vector: Array, p_b: Array
    ) -> None:
        moved = a_from_b.perturbed(position, rotation_vector)
        np.testing.assert_allclose(moved @ np.zeros(3), a_from_b @ np.zeros(3) + position, atol=1e-9)
        arm = a_from_b @ p_b - a_from_b.translation
        turned = Rotation.from_rotvec(rotation_vector).apply(arm)
        np.testing.assert_allclose(moved @ p_b, a_from_b.translation + position + turned, atol=1e-9)

    @pytest.mark.parametrize(
        ("rotation", "translation", "told"),
        [
            (np.eye(4), np.zeros(3), r"rotation has shape \(4, 4\), expected \(3, 3\)"),
            (np.eye(3).ravel(), np.zeros(3), r"rotation has shape \(9,\), expected \(3, 3\)"),
            (np.eye(3), np.zeros((3, 1)), r"translation has shape \(3, 1\), expected \(3,\)"),
            (np.eye(3), np.zeros(2), r"translation has shape \(2,\), expected \(3,\)"),
            (np.diag([1, 1, np.nan]), np.zeros(3), "finite"),
            (np.eye(3), np.array([0, np.inf, 0]), "finite"),
            (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "proper rotation"),
            (1.001 * np.eye(3), np.zeros(3), "proper rotation"),
            (np.eye(3) + 1e-3 * np.eye(3, k=1), np.zeros(3), "proper rotation"),
            (np.zeros((3, 3)), np.zeros(3), "proper rotation"),
        ],
    )
    def test_what_is_no_pose(self, rotation: Array, translation: Array, told: str) -> None:
        with pytest.raises(ValueError, match=told):
            Pose(rotation, translation)

    @pytest.mark.parametrize("length", [1e-8, 1e-3, 1e200, 1e308])
    def test_length_of_a_quaternion_does_not_matter(self, length: float) -> None:
        found = rotation_from_quaternion([0.0, 0.6 * length, 0.0, 0.8 * length])
        np.testing.assert_allclose(found, rotation_from_quaternion([0.0, 0.6, 0.0, 0.8]), atol=1e-15)

    @pytest.mark.parametrize(
        ("quaternion", "told"),
        [
            ([0, 0, 1], r"shape \(3,\), expected \(4,\) in the order x, y, z, w"),
            ([[0, 0, 0, 1]], r"shape \(1, 4\)"),
            ([0, 0, 0, 0], "no length"),
            ([0, 0, np.nan, 1], "not finite"),
            ([0, 0, -np.inf, 1], "not finite"),
        ],
    )
    def test_what_is_no_quaternion(self, quaternion: list[float], told: str) -> None:
        with pytest.raises(ValueError, match=told):
            rotation_from_quaternion(quaternion)
        with pytest.raises(ValueError, match=told):
            Pose.from_quaternion(quaternion, np.zeros(3))
