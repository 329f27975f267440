"""Metal in a real reconstruction: a phantom is scanned and reconstructed, with the streaks that metal makes.

A disc of water with upright rods of steel is projected (scikit-image's radon), a beam of several energies is weakened
along each ray, photons are counted, and the picture is reconstructed by filtered back-projection after the correction
that scanners make for water. Between the rods run dark and bright streaks.
"""

from __future__ import annotations

import math

import numpy as np
from skimage.transform import iradon, radon

from stereoreg_ros import PixelScale, RegistrationOptions
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.spots import find_spots

# Of a tube with 120 kV: share of the photons, and how water and steel weaken them, 1/mm.
_SHARE = np.array([0.3, 0.45, 0.25])
_WATER_PER_MM = np.array([0.0227, 0.0193, 0.0171])
_STEEL_PER_MM = np.array([0.95, 0.40, 0.21])
_PHOTONS = 2e6
_FINE = 2  # so many pixels of the phantom to one of the picture
_SUPERSAMPLED = 8
_POST_MM = 12.0


def scanned_rods(
    rng: np.random.Generator,
    rods: int,
    diameter_mm: float,
    posts: int = 0,
    side: int = 192,
    spacing_mm: float = 0.5,
) -> tuple[Slice, Array]:
    """A slice in HU, and the true centres (rods, 2) in pixel: rods of steel at random places, and so many posts of
    steel, too thick for spots, all with 7 mm or more between them.
    """
    fine, pixel_mm = side * _FINE, spacing_mm / _FINE
    radius_mm = 0.45 * side * spacing_mm
    placed: list[Array] = []
    thickness_mm = posts * [_POST_MM] + rods * [diameter_mm]
    while len(placed) < posts + rods:
        place = rng.uniform(-0.75 * radius_mm, 0.75 * radius_mm, 2)
        least = [7.0 + 0.5 * (thickness_mm[len(placed)] + other) for other in thickness_mm[: len(placed)]]
        apart = all(np.linalg.norm(place - other) >= gap for other, gap in zip(placed, least, strict=True))
        if apart and np.linalg.norm(place) <= 0.8 * radius_mm:
            placed.append(place)
    discs = (_disc(fine, pixel_mm, place, thick / 2) for place, thick in zip(placed, thickness_mm, strict=True))
    steel = sum(discs, np.zeros((fine, fine)))
    centres_mm = placed[posts:]
    water = _disc(fine, pixel_mm, np.zeros(2), radius_mm) - steel
    angles = np.linspace(0.0, 180.0, 720, endpoint=False)
    through_water, through_steel = (radon(part, angles, circle=True) * pixel_mm for part in (water, steel))
    passing = sum(
        share * np.exp(-by_water * through_water - by_steel * through_steel)
        for share, by_water, by_steel in zip(_SHARE, _WATER_PER_MM, _STEEL_PER_MM, strict=True)
    )
    counted = np.maximum(rng.poisson(_PHOTONS * passing), 1)
    weakened = -np.log(counted / _PHOTONS)
    # What water of any thickness would do is undone: beam hardening is left of the steel only.
    thickness = np.linspace(0.0, 4 * radius_mm, 400)
    by_thickness = -np.log((_SHARE * np.exp(-np.outer(thickness, _WATER_PER_MM))).sum(axis=1))
    water_mm = np.interp(weakened, by_thickness, thickness, right=None)
    beyond = weakened > by_thickness[-1]
    water_mm[beyond] = weakened[beyond] / _WATER_PER_MM[-1]
    picture = iradon(water_mm / pixel_mm, angles, filter_name="hann", circle=True)
    coarse = picture.reshape(side, _FINE, side, _FINE).mean(axis=(1, 3))
    hu = np.clip(np.rint(1000.0 * (coarse - 1.0)), -1024, 3071).astype(np.float32)
    # radon turns about pixel fine // 2.
    middle = (fine // 2 + 0.5) / _FINE - 0.5
    return Slice(hu, PixelScale(spacing_mm, spacing_mm)), middle + np.array(centres_mm) / spacing_mm


def _disc(side: int, pixel_mm: float, centre_mm: Array, radius_mm: float) -> Array:
    """Share of each pixel (side, side) that a disc covers; centre_mm: (x, y) from the middle of pixel side // 2."""
    place = (np.arange(side * _SUPERSAMPLED) + 0.5) / _SUPERSAMPLED - 0.5 - side // 2
    x, y = place * pixel_mm - centre_mm[0], place * pixel_mm - centre_mm[1]
    inside = np.zeros((side, side))
    rows = np.flatnonzero((np.abs(y) <= radius_mm).reshape(side, -1).any(axis=1))
    columns = np.flatnonzero((np.abs(x) <= radius_mm).reshape(side, -1).any(axis=1))
    if rows.size and columns.size:
        top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        fine_y = y[top * _SUPERSAMPLED : bottom * _SUPERSAMPLED]
        fine_x = x[left * _SUPERSAMPLED : right * _SUPERSAMPLED]
        covered = fine_x[None] ** 2 + fine_y[:, None] ** 2 <= radius_mm**2
        shape = (bottom - top, _SUPERSAMPLED, right - left, _SUPERSAMPLED)
        inside[top:bottom, left:right] = covered.reshape(shape).mean(axis=(1, 3))
    return inside


def measure(
    slices: int, rods: int, diameter_mm: float, threshold: float | str, posts: int = 0
) -> tuple[int, int, float, float]:
    """Rods found, rods there, and root mean square and largest error of their centres per axis, pixel."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(slices):
        ct_slice, centres = scanned_rods(rng, rods, diameter_mm, posts)
        found = find_spots(ct_slice, RegistrationOptions(threshold=threshold)).centres_px
        for centre in centres:
            off = found - centre
            nearest = np.linalg.norm(off, axis=1).argmin() if len(off) else None
            if nearest is not None and np.linalg.norm(off[nearest]) < 2.0:
                errors.append(off[nearest])
    squared = np.square(errors) if errors else np.full((1, 2), math.nan)
    return len(errors), slices * rods, math.sqrt(float(squared.mean())), math.sqrt(float(squared.max()))
