"""What error of the pose a frame lets expect: the Cramer-Rao bound, for many layouts and poses at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf, gammainc

from stereoreg_ros.frames.layouts import Layouts
from stereoreg_ros.frames.slice_poses import SlicePoses
from stereoreg_ros.geometry.pose import Array, skew
from stereoreg_ros.geometry.projection import Cuts, cut, cut_jacobian, rod_covariances
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import RegistrationOptions

# Standard deviation of a scanner's point spread in the plane, mm: that of a usual body kernel, 1.1 mm wide.
POINT_SPREAD_MM: Final = 0.45
# Variance that a direction gets which nothing determines, mm^2 or rad^2.
_UNKNOWN: Final = 1e12


@dataclass(frozen=True)
class Imaging:
    """How the slices are taken, and how well is known what the errors rest on.

    scale: mm/pixel; noise_px: standard deviation per axis of an upright rod's centre; thickness_mm: of the slice, 0
    where it is not known and leaning rods shall count like upright ones; frame_tolerance_mm: standard deviation per
    axis of the ends of rods of unknown tolerance; scale_tolerance: standard deviation of sx and of sy, as a fraction.
    By default rods and scale are perfect.
    """

    scale: PixelScale
    noise_px: float
    thickness_mm: float
    frame_tolerance_mm: float = 0.0
    scale_tolerance: float = 0.0

    @classmethod
    def of(cls, scale: PixelScale, options: RegistrationOptions) -> Imaging:
        """As the registration assumes it."""
        return cls(
            scale,
            options.spot_noise_px,
            options.slice_thickness_mm,
            options.frame_tolerance_mm,
            options.scale_tolerance,
        )


@dataclass(frozen=True, eq=False)
class Expected:
    """For s layouts and p poses slice_from_frame.

    visible: (s, p, n), the rods that the slice cuts; covariances: (s, p, 6, 6) of the pose from these, mm and rad, in
    slice axes, as in `Pose.perturbed`; information: (s, p, 8, 8), of the pose and of the shares by which sx and sy are
    off, where nothing is known of the scale beforehand; cuts.
    """

    visible: NDArray[np.bool_]
    covariances: Array
    information: Array
    cuts: Cuts


def expected(layouts: Layouts, poses: SlicePoses, imaging: Imaging, left_out: int | None = None) -> Expected:
    """Cramer-Rao bound of the pose from the visible rods; left_out: one that is taken for missing.

    Noise and the errors of the rods are independent from spot to spot. That of the scale is common to all: it stretches
    the slice about the centre of pixel (0, 0).
    """
    cuts = cut(layouts, poses.rotations, poses.translations)
    visible = cuts.inside.copy()
    if left_out is not None:
        visible[..., left_out] = False
    covariances = spot_covariances(cuts, layouts.diameters, imaging)
    tolerances = layouts.tolerances_or(imaging.frame_tolerance_mm)
    shown = visible[..., None, None]
    covariances = covariances + np.where(shown, rod_covariances(layouts, tolerances, cuts), 0.0)
    weights = np.where(shown, np.linalg.inv(covariances), 0.0)
    # A scale that is off by a share moves a spot by that share of its coordinates.
    by_scale = cuts.points_mm[..., None] * np.eye(2)
    jacobian = np.where(shown, np.concatenate([cut_jacobian(cuts, poses.translations), by_scale], axis=-1), 0.0)
    information = np.einsum("spnki,spnkj->spij", jacobian, weights @ jacobian)
    # With a prior on the scale, it is integrated out; in a form that holds where the scale is known exactly, too.
    variance = imaging.scale_tolerance**2
    cross = information[..., 6:, :6]
    inner = np.linalg.inv(np.eye(2) + variance * information[..., 6:, 6:])
    taken = variance * np.swapaxes(cross, -1, -2) @ inner @ cross
    return Expected(visible, _inverse(information[..., :6, :6] - taken), information, cuts)


def spot_covariances(cuts: Cuts, diameters: Array, imaging: Imaging) -> Array:
    """Covariances (..., n, 2, 2) in mm^2 of the spots' centres, from the imaging and how much each rod leans.

    A leaning rod smears its spot over L = thickness tan(lean). A uniform streak, blurred by the rod's oblique section
    and the point spread to standard deviations a along it and b across it, has with q = L^2 / (4 a^2) the Fisher
    information (b/a)^3 (1 - e^-q) / q of its place along, and 2 sqrt(pi) b times the integral of its squared profile
    across, as a share of what an upright rod's spot of the same mass has; its mass grows by 1 / cos(lean). No spot
    counts as better than an upright one: the rods are known no better.
    """
    cosine = np.clip(np.abs(np.where(cuts.inside, cuts.directions[..., 2], 1.0)), 1e-3, 1.0)
    in_plane = cuts.directions[..., :2]
    sine = np.linalg.norm(in_plane, axis=-1)
    along = np.where(sine[..., None] > 1e-9, in_plane / np.maximum(sine, 1e-9)[..., None], np.array([1.0, 0.0]))
    across_mm = np.sqrt(diameters**2 / 16 + POINT_SPREAD_MM**2)
    along_mm = np.sqrt((diameters / cosine) ** 2 / 16 + POINT_SPREAD_MM**2)
    length = np.maximum(imaging.thickness_mm * sine / cosine, 1e-6 * along_mm)
    q = (length / (2 * along_mm)) ** 2
    falls = -np.expm1(-q)
    profile = erf(length / (2 * along_mm)) / length - 2 * along_mm / (math.sqrt(math.pi) * length**2) * falls
    # For short streaks the profile is a difference of nearly equal numbers: 1 / (2 sqrt(pi) a) (1 - q/6) by its series.
    profile = np.where(q < 1e-4, (1 - q / 6) / (2 * math.sqrt(math.pi) * along_mm), profile)
    worse_along = np.maximum(cosine**2 * (along_mm / across_mm) ** 3 * q / falls, 1.0)
    worse_across = np.maximum(cosine**2 / (2 * math.sqrt(math.pi) * across_mm * profile), 1.0)
    outer = along[..., :, None] * along[..., None, :]
    worse = worse_along[..., None, None] * outer + worse_across[..., None, None] * (np.eye(2) - outer)
    noise = imaging.noise_px * math.sqrt(imaging.scale.sx * imaging.scale.sy)
    covariances: Array = noise**2 * worse
    return covariances


def scale_information(found: Expected) -> Array:
    """Inverse covariances (s, p, 2, 2) of the shares by which sx and sy are off, from one slice of unknown pose."""
    by_pose, by_scale = found.information[..., :6, :6], found.information[..., 6:, :6]
    # The pose is eliminated (Schur complement).
    left: Array = found.information[..., 6:, 6:] - by_scale @ _inverse(by_pose) @ np.swapaxes(by_scale, -1, -2)
    return 0.5 * (left + np.swapaxes(left, -1, -2))


def point_covariances(covariances: Array, rotations: Array, point_in_frame: Array) -> Array:
    """Covariances (s, p, 3, 3) mm^2, in slice axes, of where poses with rotations (p, 3, 3) put a point (3,) mm."""
    arms = rotations @ point_in_frame
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape[:-1], 3, 3)), -skew(arms)], axis=-1)
    moved: Array = jacobian @ covariances @ np.swapaxes(jacobian, -1, -2)
    return moved


def pooled_error_95(covariances: Array) -> Array:
    """Radius (s,) in mm that 95 % of the errors stay within, over all p poses together; covariances (s, p, 3, 3).

    Each pose's squared error is a weighted sum of chi-squares, for which the chi-square of the same mean, variance and
    skewness stands (Imhof 1961).
    """
    first, second, third = (np.trace(power, axis1=-2, axis2=-1) for power in _powers(covariances))
    freedom = second**3 / third**2
    spread = np.sqrt(second / freedom)
    low, high = np.zeros(len(first)), 10 * np.sqrt(first.max(axis=1))
    for _ in range(40):
        radius = 0.5 * (low + high)
        scaled = np.maximum((radius[:, None] ** 2 - first) / spread + freedom, 0.0)
        short = gammainc(freedom / 2, scaled / 2).mean(axis=1) < 0.95
        low, high = np.where(short, radius, low), np.where(short, high, radius)
    middle: Array = 0.5 * (low + high)
    return middle


def _powers(covariances: Array) -> tuple[Array, Array, Array]:
    squared = covariances @ covariances
    return covariances, squared, squared @ covariances


def _inverse(information: Array) -> Array:
    """A direction that nothing determines gets a huge variance."""
    values, vectors = np.linalg.eigh(information)
    inverse: Array = (vectors / np.maximum(values, 1 / _UNKNOWN)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return inverse
