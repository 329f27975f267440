"""Centres of rendered spots: how far from the truth, beside the Cramer-Rao bound and what is claimed of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereoreg_ros import PixelScale, RegistrationOptions
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.simulation import Cylinder, add_metal
from stereoreg_ros.spots import find_spots

CLIPPED_HU = 3071.0
_SURROUNDINGS_HU = 40.0
HALF_LENGTH_MM = 60.0
_STEP_PX = 0.02


@dataclass(frozen=True)
class Case:
    """One rod through a slice, at an angle to its normal and at any turn about it."""

    name: str
    tilt_deg: float = 0.0
    thickness_mm: float = 1.0
    psf_sigma_mm: float = 0.45
    diameter_mm: float = 1.0
    spacing_mm: tuple[float, float] = (0.5, 0.5)
    metal_hu: float = 8000.0
    noise_hu: float = 20.0
    threshold: float | str = "auto"


CASES = (
    Case("upright"),
    Case("upright, 2000 HU", threshold=2000.0),
    Case("upright, not clipped", metal_hu=6000.0),
    Case("30 degrees", 30.0),
    Case("45 degrees", 45.0),
    Case("45 degrees, not clipped", 45.0, metal_hu=5000.0),
    Case("two pixels wide", psf_sigma_mm=0.25, diameter_mm=0.6, metal_hu=6000.0),
    Case("pixels of 0.4 x 0.7 mm", 30.0, spacing_mm=(0.4, 0.7)),
    Case("5 mm slice, 45 degrees", 45.0, 5.0),
    Case("5 mm slice, 67 degrees", 67.0, 5.0),
    Case("faint, 100 HU noise", 20.0, metal_hu=4000.0, noise_hu=100.0),
)


@dataclass(frozen=True)
class Row:
    """What a case gave, pixel: root mean squares over both axes, and along and across a leaning rod's spot.

    ratio: of the root mean square error to the Cramer-Rao bound; nees: mean squared error in terms of the covariance
    that is claimed, 2 where that is right.
    """

    case: Case
    found: int
    wrong: int
    rms_px: float
    bias_px: float
    along_px: float
    across_px: float
    ratio: float
    nees: float


def measure(case: Case, trials: int, seed: int = 0) -> Row:
    """Draw `trials` slices with one rod each and find it; wrong: slices with no spot or more than one."""
    rng = np.random.default_rng(seed)
    scale = PixelScale(*case.spacing_mm)
    options = RegistrationOptions(threshold=case.threshold)
    side = 2 * math.ceil((case.thickness_mm * math.tan(math.radians(case.tilt_deg)) + 24.0) / 2 / min(case.spacing_mm))
    errors, bounds, claims, directions = [], [], [], []
    wrong = 0
    for _ in range(trials):
        centre = (side - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        tilt, turn = math.radians(case.tilt_deg), rng.uniform(0, 2 * math.pi)
        along = np.array([math.cos(turn), math.sin(turn)])
        direction = np.array([*(math.sin(tilt) * along), math.cos(tilt)])
        clean = _SURROUNDINGS_HU + _rod(case, scale, side, centre, direction)
        noisy = clean + case.noise_hu * rng.standard_normal(clean.shape)
        found = find_spots(Slice(np.clip(np.rint(noisy), -1024, CLIPPED_HU).astype(np.float32), scale), options)
        if len(found) != 1:
            wrong += 1
            continue
        errors.append(found.centres_px[0] - centre)
        claims.append(found.covariances_px2[0])
        bounds.append(_bound(case, scale, clean, centre, direction))
        in_pixels = scale.inverse_matrix @ along
        directions.append(in_pixels / np.linalg.norm(in_pixels))
    error, claim, bound, axis = (np.array(one) for one in (errors, claims, bounds, directions))
    along_px = np.einsum("ni,ni->n", error, axis)
    across_px = error[:, 0] * axis[:, 1] - error[:, 1] * axis[:, 0]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(claim, error[..., None])[..., 0])
    mean_square = float((error**2).mean())
    return Row(
        case,
        len(error),
        wrong,
        math.sqrt(mean_square),
        float(np.abs(error.mean(axis=0)).max()),
        math.sqrt(float((along_px**2).mean())),
        math.sqrt(float((across_px**2).mean())),
        math.sqrt(mean_square / (float(np.trace(bound, axis1=1, axis2=2).mean()) / 2)),
        float(nees.mean()),
    )


def _rod(case: Case, scale: PixelScale, side: int, centre_px: Array, direction: Array) -> Array:
    image = np.zeros((side, side))
    middle = np.array([*scale.to_mm(centre_px), 0.0])
    ends = middle - HALF_LENGTH_MM * direction, middle + HALF_LENGTH_MM * direction
    add_metal(image, Cylinder(*ends, case.diameter_mm), scale, case.thickness_mm, case.psf_sigma_mm, case.metal_hu)
    return image


def _bound(case: Case, scale: PixelScale, clean: Array, centre_px: Array, direction: Array) -> Array:
    """Cramer-Rao bound (2, 2) of the centre, pixel^2: all else known, and clipped pixels of no use."""
    side = len(clean)
    slopes = [
        (
            _rod(case, scale, side, centre_px + step, direction)[clean < CLIPPED_HU]
            - _rod(case, scale, side, centre_px - step, direction)[clean < CLIPPED_HU]
        )
        / (2 * _STEP_PX)
        for step in _STEP_PX * np.eye(2)
    ]
    jacobian = np.stack(slopes, axis=-1)
    return np.asarray(case.noise_hu**2 * np.linalg.inv(jacobian.T @ jacobian))
