"""Rigid poses, named by both of their ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_ORTHONORMAL_TOLERANCE = 1e-6
# [v]x, row by row, is v @ _SKEW.
_SKEW = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], dtype=float
)


def skew(vectors: Array) -> Array:
    """Cross-product matrices [v]x of vectors (..., 3), so that skew(v) @ p = v x p; shape (..., 3, 3)."""
    matrices: Array = vectors @ _SKEW
    return matrices.reshape(*vectors.shape, 3)


def cross(a: Array, b: Array) -> Array:
    """Cross products a x b of vectors (..., 3); numpy's own takes several times as long for few vectors."""
    products: Array = (skew(a) @ b[..., None])[..., 0]
    return products


def rotation_exp(rotation_vectors: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians."""
    if not rotation_vectors.size:
        return np.empty((*rotation_vectors.shape, 3))
    rotations: Array = Rotation.from_rotvec(rotation_vectors.reshape(-1, 3)).as_matrix()
    return rotations.reshape(*rotation_vectors.shape, 3)


def rotation_angle(rotations: Array) -> Array:
    """Angles (...) in radians, 0 to pi, by which rotation matrices (..., 3, 3) turn."""
    axis = np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    # atan2 keeps full precision at small and at straight angles, arccos of the trace does not.
    sine_twice = np.linalg.norm(axis, axis=-1)
    cosine_twice = np.trace(rotations, axis1=-2, axis2=-1) - 1
    angles: Array = np.arctan2(sine_twice, cosine_twice)
    return angles


def nearest_rotation(matrices: Array) -> Array:
    """Rotations (..., 3, 3) nearest in the Frobenius norm to matrices (..., 3, 3) (Maurin 2009, section 4.1)."""
    left, _, right = np.linalg.svd(matrices)
    left = left.copy()
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    nearest: Array = left @ right
    return nearest


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid transform `a_from_b`: p_a = rotation @ p_b + translation.

    rotation: (3, 3), orthonormal with determinant +1; translation: (3,) in mm.
    Raises ValueError where the shapes, the finiteness or the orthonormality are wrong.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3):
            raise ValueError(f"rotation has shape {rotation.shape}, expected (3, 3)")
        if translation.shape != (3,):
            raise ValueError(f"translation has shape {translation.shape}, expected (3,)")
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ValueError("rotation and translation must be finite")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ValueError("rotation is not a proper rotation matrix (orthonormal, determinant +1)")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls) -> Pose:
        """The pose that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, quaternion_xyzw: ArrayLike, translation: ArrayLike) -> Pose:
        """Pose from a quaternion (4,), scalar last, of any length but zero, and a translation (3,) in mm."""
        return cls(rotation_from_quaternion(quaternion_xyzw), np.asarray(translation, dtype=np.float64))

    @property
    def quaternion_xyzw(self) -> Array:
        """Unit quaternion (4,), scalar last and not negative."""
        quaternion: Array = Rotation.from_matrix(self.rotation).as_quat()
        return -quaternion if quaternion[3] < 0 else quaternion

    def inverse(self) -> Pose:
        """`b_from_a` of an `a_from_b`."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def perturbed(self, position: Array, rotation_vector: Array) -> Pose:
        """The pose moved by `position` (3,) mm and turned by `rotation_vector` (3,) rad about its own origin.

        Both are in the axes of the pose's left end. This is the perturbation of every covariance in this package.
        """
        return Pose(rotation_exp(rotation_vector) @ self.rotation, self.translation + position)

    @overload
    def __matmul__(self, other: Pose) -> Pose: ...
    @overload
    def __matmul__(self, other: Array) -> Array: ...
    def __matmul__(self, other: Pose | Array) -> Pose | Array:
        """`a_from_b @ b_from_c`, or `a_from_b @ p_b` for points (3,) or (n, 3) in mm."""
        if isinstance(other, Pose):
            return Pose(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)
        moved: Array = np.asarray(other, dtype=np.float64) @ self.rotation.T + self.translation
        return moved


def rotation_from_quaternion(quaternion_xyzw: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,), scalar last; ValueError where it is not finite or is zero."""
    quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
    if quaternion.shape != (4,):
        raise ValueError(f"quaternion has shape {quaternion.shape}, expected (4,) in the order x, y, z, w")
    largest = np.abs(quaternion).max()
    if not np.isfinite(largest) or largest < 1e-9:
        raise ValueError(f"quaternion {quaternion.tolist()} is not finite or has no length")
    # The squares of very large numbers would be no numbers.
    rotation: Array = Rotation.from_quat(quaternion / largest).as_matrix()
    return rotation
