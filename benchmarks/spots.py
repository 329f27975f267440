"""Centres of spots: how far from the truth, against the Cramer-Rao bound and against what is claimed of them; and how
many rods are found beside bright things. `python -m benchmarks.spots` prints the latter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros import PixelScale, RegistrationOptions
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.simulation import Cylinder, add_metal
from stereoreg_ros.spots import find_spots

_CLIPPED_HU = 3071.0
_SURROUNDINGS_HU = 40.0
_HALF_LENGTH_MM = 60.0
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
    """Draw so many slices with one rod each and find it; wrong: slices with no spot or more than one."""
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
        found = find_spots(Slice(np.clip(np.rint(noisy), -1024, _CLIPPED_HU).astype(np.float32), scale), options)
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
    ends = middle - _HALF_LENGTH_MM * direction, middle + _HALF_LENGTH_MM * direction
    add_metal(image, Cylinder(*ends, case.diameter_mm), scale, case.thickness_mm, case.psf_sigma_mm, case.metal_hu)
    return image


def _bound(case: Case, scale: PixelScale, clean: Array, centre_px: Array, direction: Array) -> Array:
    """Cramer-Rao bound (2, 2) of the centre, pixel^2: all else known, and clipped pixels of no use."""
    side = len(clean)
    slopes = [
        (
            _rod(case, scale, side, centre_px + step, direction)[clean < _CLIPPED_HU]
            - _rod(case, scale, side, centre_px - step, direction)[clean < _CLIPPED_HU]
        )
        / (2 * _STEP_PX)
        for step in _STEP_PX * np.eye(2)
    ]
    jacobian = np.stack(slopes, axis=-1)
    return np.asarray(case.noise_hu**2 * np.linalg.inv(jacobian.T @ jacobian))


@dataclass(frozen=True)
class Beside:
    """Rods beside other bright things.

    threshold: HU, one at which the rods are regions of their own; draw: makes a slice (rows, columns) of HU, and the
    places (rods, 2) of the rods in it, pixel.
    """

    name: str
    threshold: float
    draw: Callable[[np.random.Generator], tuple[Array, Array]]


@dataclass(frozen=True)
class Found:
    """Rods there, and of them those found by a fixed threshold, by `auto`, and by the former alone; and other spots."""

    rods: int
    fixed: int
    auto: int
    lost: int
    others_fixed: int
    others_auto: int


_BESIDE_SIDE = 256
_BESIDE_SCALE = PixelScale(0.5, 0.5)
_SAME_PX = 1.5


def compare(beside: Beside, slices: int, seed: int = 0) -> Found:
    """What a fixed threshold and `auto` find in so many slices."""
    rng = np.random.default_rng(seed)
    counts = np.zeros(6, dtype=int)
    for _ in range(slices):
        hu, rods = beside.draw(rng)
        ct_slice = Slice(np.clip(np.rint(hu), -1000, _CLIPPED_HU).astype(np.float32), _BESIDE_SCALE)
        fixed, auto = (
            find_spots(ct_slice, RegistrationOptions(threshold=threshold)).centres_px
            for threshold in (beside.threshold, "auto")
        )
        by_fixed, by_auto = (_near(rods, spots) for spots in (fixed, auto))
        counts += [
            len(rods),
            by_fixed.sum(),
            by_auto.sum(),
            (by_fixed & ~by_auto).sum(),
            len(fixed) - by_fixed.sum(),
            len(auto) - by_auto.sum(),
        ]
    return Found(*counts.tolist())


def _near(rods: Array, spots: Array) -> NDArray[np.bool_]:
    """Which of the rods (n,) have a spot where they are."""
    return np.asarray((np.linalg.norm(rods[:, None] - spots, axis=-1) < _SAME_PX).any(axis=1))


def _noise(rng: np.random.Generator, hu: float, grain_px: float) -> Array:
    """Noise of a standard deviation of `hu`, smoothed as by a soft kernel where it has a grain."""
    noise = rng.standard_normal((_BESIDE_SIDE, _BESIDE_SIDE))
    if grain_px > 0:
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), grain_px))
    return np.asarray(hu / noise.std() * noise)


def _round(centre_px: Array, radius_mm: float) -> Array:
    """Share (rows, columns) of each pixel that a disc with a soft edge covers."""
    v, u = np.indices((_BESIDE_SIDE, _BESIDE_SIDE))
    off_mm = np.hypot(u - centre_px[0], v - centre_px[1]) * _BESIDE_SCALE.sx
    return np.asarray(np.clip(0.5 + (radius_mm - off_mm) / 1.2, 0.0, 1.0))


def _add_rod(image: Array, at_px: Array, diameter_mm: float, hu: float, tilt_deg: float, turn: float) -> None:
    """Add a rod to a slice of 2 mm, leaning in the direction `turn`."""
    tilt = math.radians(tilt_deg)
    direction = np.array([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)])
    middle = np.array([*_BESIDE_SCALE.to_mm(at_px), 0.0])
    reach = _HALF_LENGTH_MM * direction
    add_metal(image, Cylinder(middle - reach, middle + reach, diameter_mm), _BESIDE_SCALE, 2.0, 0.45, hu)


def _on_a_circle(rng: np.random.Generator, count: int, radius_mm: float) -> Array:
    """Places (count, 2) at even angles around the middle, pixel, turned at random."""
    turn = rng.uniform(0, 2 * math.pi) + 2 * math.pi * np.arange(count) / count
    around = radius_mm / _BESIDE_SCALE.sx * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.asarray((_BESIDE_SIDE - 1) / 2 + around + rng.uniform(-2, 2, (count, 2)))


def _phantom_with_rim(rng: np.random.Generator) -> tuple[Array, Array]:
    """As a CatPhan in a cone-beam CT: thin leaning wires and a thicker rod in a disc with a bright and grainy rim, with
    inserts too large for spots; nothing outside, where the range ends.
    """
    middle = np.full(2, (_BESIDE_SIDE - 1) / 2) + rng.uniform(-3, 3, 2)
    rim = _round(middle, 56.0) - _round(middle, 53.0)
    image = -1000 + 1080 * _round(middle, 56.0) + 250 * rim
    for place in _on_a_circle(rng, 4, 44.0):
        image += rng.uniform(500, 1000) * _round(place, 6.0)
    wires, rod = _on_a_circle(rng, 4, 25.0), _on_a_circle(rng, 1, 10.0)
    for place in wires:
        _add_rod(image, place, 0.7, 1500.0, 60.0, rng.uniform(0, 2 * math.pi))
    _add_rod(image, rod[0], 3.6, 900.0, 0.0, 0.0)
    inside = 0.5 * (1 + np.tanh(image + 500.0))
    return image + inside * (_noise(rng, 12.0, 1.0) + rim * _noise(rng, 40.0, 1.0)), np.concatenate([wires, rod])


def _posts(rng: np.random.Generator) -> tuple[Array, Array]:
    """Rods in plates, and between them posts that are clipped, with bright and dark bands from one to the other."""
    image = np.full((_BESIDE_SIDE, _BESIDE_SIDE), -1000.0)
    image[20:236, 20:30] = image[20:236, 226:236] = 100.0
    heights = 50 * np.arange(1, 4) + rng.uniform(-10, 10, (2, 3)) + 25
    rods = np.array([[u, v] for u, column in zip((25.0, 231.0), heights, strict=True) for v in column])
    posts = np.array([[80.0, 128.0], [176.0, 128.0]]) + rng.uniform(-8, 8, (2, 2))
    v = np.indices(image.shape)[0]
    for place in posts:
        image -= 350 * np.exp(-(((v - place[1]) / 8.0) ** 2)) - 250 * np.exp(-(((v - place[1] - 14.0) / 4.0) ** 2))
    for place in rods:
        _add_rod(image, place + rng.uniform(-0.5, 0.5, 2), 2.0, 3000.0, rng.uniform(0, 40), math.pi / 2)
    for place in posts:
        image += 9000 * _round(place, rng.uniform(6.0, 9.0))
    return image + _noise(rng, 15.0, 0.0), rods


def _pins(rng: np.random.Generator) -> tuple[Array, Array]:
    """Faint rods beside more bright pins than a frame has rods: both are of rod size."""
    image = 40.0 + _noise(rng, 10.0, 0.0)
    rods = _on_a_circle(rng, 5, 45.0)
    for place in rods:
        _add_rod(image, place, 1.0, 500.0, rng.uniform(0, 30), rng.uniform(0, 2 * math.pi))
    for place in _on_a_circle(rng, 8, 25.0):
        _add_rod(image, place, 1.5, 9000.0, rng.uniform(0, 30), rng.uniform(0, 2 * math.pi))
    return image, rods


def _lattice(rng: np.random.Generator) -> tuple[Array, Array]:
    """Rods around a phantom that is full of fainter balls."""
    image = 40.0 + _noise(rng, 10.0, 0.0)
    first = rng.uniform(70, 76, 2)
    for row in range(10):
        for column in range(10):
            _add_rod(image, first + 12 * np.array([column, row]), 3.0, rng.uniform(100, 500), 0.0, 0.0)
    rods = _on_a_circle(rng, 6, 56.0)
    for place in rods:
        _add_rod(image, place, 2.0, rng.uniform(1200, 1600), rng.uniform(0, 40), rng.uniform(0, 2 * math.pi))
    return image, rods


BESIDE = (
    Beside("wires, bright rim", 200.0, _phantom_with_rim),
    Beside("metal posts", 1000.0, _posts),
    Beside("faint rods, bright pins", 200.0, _pins),
    Beside("a hundred fainter balls", 800.0, _lattice),
)


def main() -> None:
    """Print the table of rods found beside bright things."""
    print("beside                    rods  fixed  auto  lost by auto  other spots: fixed  auto")
    for beside in BESIDE:
        found = compare(beside, 20)
        print(
            f"{beside.name:24s} {found.rods:5d}  {found.fixed:5d} {found.auto:5d}  {found.lost:12d}  "
            f"{found.others_fixed:18d} {found.others_auto:5d}"
        )


if __name__ == "__main__":
    main()
