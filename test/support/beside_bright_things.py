"""Rods beside other bright things: how many a fixed threshold and `auto` find."""

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
from support.spot_accuracy import CLIPPED_HU, HALF_LENGTH_MM


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


_SIDE = 256
_SCALE = PixelScale(0.5, 0.5)
_SAME_PX = 1.5


def compare(beside: Beside, slices: int, seed: int = 0) -> Found:
    """What a fixed threshold and `auto` find in a number of slices."""
    rng = np.random.default_rng(seed)
    counts = np.zeros(6, dtype=int)
    for _ in range(slices):
        hu, rods = beside.draw(rng)
        ct_slice = Slice(np.clip(np.rint(hu), -1000, CLIPPED_HU).astype(np.float32), _SCALE)
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
    noise = rng.standard_normal((_SIDE, _SIDE))
    if grain_px > 0:
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), grain_px))
    return np.asarray(hu / noise.std() * noise)


def _round(centre_px: Array, radius_mm: float) -> Array:
    """Share (rows, columns) of each pixel that a disc with a soft edge covers."""
    v, u = np.indices((_SIDE, _SIDE))
    off_mm = np.hypot(u - centre_px[0], v - centre_px[1]) * _SCALE.sx
    return np.asarray(np.clip(0.5 + (radius_mm - off_mm) / 1.2, 0.0, 1.0))


def _add_rod(image: Array, at_px: Array, diameter_mm: float, hu: float, tilt_deg: float, turn: float) -> None:
    """Add a rod to a slice of 2 mm, leaning in the direction `turn`."""
    tilt = math.radians(tilt_deg)
    direction = np.array([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)])
    middle = np.array([*_SCALE.to_mm(at_px), 0.0])
    reach = HALF_LENGTH_MM * direction
    add_metal(image, Cylinder(middle - reach, middle + reach, diameter_mm), _SCALE, 2.0, 0.45, hu)


def _on_a_circle(rng: np.random.Generator, count: int, radius_mm: float) -> Array:
    """Places (count, 2) at even angles around the middle, pixel, turned at random."""
    turn = rng.uniform(0, 2 * math.pi) + 2 * math.pi * np.arange(count) / count
    around = radius_mm / _SCALE.sx * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.asarray((_SIDE - 1) / 2 + around + rng.uniform(-2, 2, (count, 2)))


def _phantom_with_rim(rng: np.random.Generator) -> tuple[Array, Array]:
    """As a CatPhan in a cone-beam CT: thin leaning wires and a thicker rod in a disc with a bright and grainy rim, with
    inserts too large for spots; nothing outside, where the range ends.
    """
    middle = np.full(2, (_SIDE - 1) / 2) + rng.uniform(-3, 3, 2)
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
    image = np.full((_SIDE, _SIDE), -1000.0)
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
