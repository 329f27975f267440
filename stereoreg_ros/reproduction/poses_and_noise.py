"""The simulated problems of section 6: random poses, noisy spots, and the errors and bounds of what is estimated."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, skew
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale

SCALE: Final = PixelScale(0.5, 0.5)
MAX_ROTATION_DEG: Final = 20.0
MIDDLE_MM: Final = (0.0, 0.0, 30.0)
REACH_MM: Final = (50.0, 50.0, 10.0)
_TRIES = 10000


class Problem(NamedTuple):
    """Spots whose rods are known. frame_from_slice: the truth, the paper's (R, t); exact_px, spots_px: (n, 2) without
    and with noise."""

    frame_from_slice: Pose
    exact_px: Array
    spots_px: Array


def random_problem(rng: np.random.Generator, frame: Frame, amplitude_px: float) -> Problem:
    """A pose of section 6 at which the slice cuts every rod, with noise uniform in +-amplitude_px on each coordinate.

    The rotation is made of angles within 20 degrees about each axis; t, which is where pixel (0, 0) lies in the frame,
    within (+-50, +-50, 30+-10) mm. A pose that misses a rod is drawn again.
    """
    for _ in range(_TRIES):
        angles = rng.uniform(-MAX_ROTATION_DEG, MAX_ROTATION_DEG, 3)
        rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        reach = np.array(REACH_MM)
        frame_from_slice = Pose(rotation, np.array(MIDDLE_MM) + rng.uniform(-reach, reach))
        exact_px, cuts = project(frame, frame_from_slice.inverse(), SCALE)
        if cuts.inside.all():
            noise = rng.uniform(-amplitude_px, amplitude_px, exact_px.shape)
            return Problem(frame_from_slice, exact_px, exact_px + noise)
    raise ValueError(f"frame '{frame.name}': no pose found at which the slice cuts all {len(frame)} rods")


def uniform_std(amplitude: float) -> float:
    """Standard deviation of noise that is uniform in +-amplitude."""
    return amplitude / 3**0.5


def position_error(estimate: Pose, truth: Pose) -> float:
    """|t - t_est| of two frame_from_slice, mm."""
    return float(np.linalg.norm(estimate.translation - truth.translation))


def rotation_error(estimate: Pose, truth: Pose) -> float:
    """Norm of the rotation vector between two frame_from_slice, degrees."""
    return float(np.degrees(rotation_angle(estimate.rotation @ truth.rotation.T)))


def reprojection_error(frame: Frame, estimate: Pose, scale: PixelScale, exact_px: Array) -> float:
    """Mean distance in pixel from where the estimated frame_from_slice and scale put the spots to where they are
    without noise.
    """
    predicted_px, _ = project(frame, estimate.inverse(), scale)
    return float(np.linalg.norm(predicted_px - exact_px, axis=1).mean())


def bound_of_frame_from_slice(covariance: Array, frame_from_slice: Pose) -> tuple[Array, Array]:
    """Covariances (3, 3) mm^2 of t and (3, 3) deg^2 of the rotation vector of frame_from_slice.

    covariance: (6, 6) of slice_from_frame, as in `Pose.perturbed`.
    """
    slice_from_frame = frame_from_slice.inverse()
    arm = skew(slice_from_frame.translation)
    # t = -R' t_s, and R' exp(-w) (t_s + p) = R' (t_s + p - w x t_s) to first order.
    jacobian = -slice_from_frame.rotation.T @ np.hstack([np.eye(3), arm])
    return jacobian @ covariance @ jacobian.T, np.degrees(np.degrees(covariance[3:, 3:]))


def mean_length(covariance: Array) -> float:
    """Mean length of a Gaussian vector with covariance (k, k): what a mean error is to be compared with.

    E|e| = pi^-1/2 int_0^inf (1 - prod (1 + 2 w_i u^2)^-1/2) u^-2 du over the eigenvalues w, with u = tan(angle).
    """
    weights = np.clip(np.linalg.eigvalsh(covariance), 0.0, None)
    total = float(weights.sum())
    if total == 0:
        return 0.0
    nodes, node_weights = np.polynomial.legendre.leggauss(80)
    angle = np.pi / 4 * (nodes + 1)
    missing = 1 - np.prod(1 / np.sqrt(1 + 2 * weights[:, None] / total * np.tan(angle) ** 2), axis=0)
    return float(np.sqrt(total / np.pi) * np.pi / 4 * (node_weights @ (missing / np.sin(angle) ** 2)))


def level_seed(seed: int, figure: int, lines: int, amplitude_px: float) -> list[int]:
    """Seed of the poses and the noise at one level: the same whichever other levels are measured."""
    return [seed, figure, lines, round(1000 * amplitude_px)]


def all_lines(frame: Frame) -> NDArray[np.intp]:
    """Rows (n,) of all rods."""
    return np.arange(len(frame))
