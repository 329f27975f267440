"""What lies in a simulated slice: frames in their plastic, a patient, a needle, bright things that are no rods."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.simulation.patient import background
from stereoreg_ros.simulation.rendering import Cylinder, add_metal

BLOCK_HU: Final = 100.0
SCANNER_RANGE_HU: Final = (-1024.0, 3071.0)
CLEARANCE_MM: Final = 4.0
_BLOCK_MARGIN_MM = 4.0
_TRIES = 2000


def _setting(default: Any, description: str, low: float, high: float) -> Any:
    return field(default=default, metadata={"description": description, "low": low, "high": high})


@dataclass(frozen=True)
class ScannerSettings:
    """The simulated scanner and what it sees besides the frames.

    shape: (rows, columns); scale: mm/pixel; block: each frame sits in a block of plastic; body: a patient;
    needle: a needle of steel near the slice's plane. The rest is described in the fields' metadata.
    Raises ValueError, naming the field, what was found and what was expected.
    """

    shape: tuple[int, int] = (512, 512)
    scale: PixelScale = field(default_factory=lambda: PixelScale(0.5, 0.5))
    slice_thickness_mm: float = _setting(1.0, "thickness of the slice, mm", 0.05, 50.0)
    psf_sigma_mm: float = _setting(0.45, "standard deviation of the point spread in the plane, mm", 0.1, 5.0)
    noise_hu: float = _setting(20.0, "standard deviation of the noise, HU", 0.0, 1000.0)
    rod_hu: float = _setting(8000.0, "HU by which a pixel full of metal is above its surroundings", 1.0, 30000.0)
    false_spots: int = _setting(0, "number of bright spots that are no rods", 0, 200)
    block: bool = True
    body: bool = True
    needle: bool = False

    def __post_init__(self) -> None:
        shape: tuple[object, ...] = tuple(self.shape)
        whole = [n for n in shape if isinstance(n, (int, np.integer)) and 16 <= n <= 4096]
        if len(shape) != 2 or len(whole) != 2:
            raise ValueError(f"shape is {self.shape!r}, expected (rows, columns), each from 16 to 4096")
        object.__setattr__(self, "shape", (int(whole[0]), int(whole[1])))
        if not isinstance(self.scale, PixelScale):
            raise ValueError(f"scale is {self.scale!r}, expected a PixelScale")
        for entry in fields(self):
            if "low" not in entry.metadata:
                continue
            low, high, value = entry.metadata["low"], entry.metadata["high"], getattr(self, entry.name)
            number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
            if not number or not low <= value <= high:
                raise ValueError(f"{entry.name} is {value!r}, expected a number from {low:g} to {high:g}")
        if int(self.false_spots) != self.false_spots:
            raise ValueError(f"false_spots is {self.false_spots!r}, expected a whole number")

    @property
    def size_mm(self) -> Array:
        """Width and height (2,) of the image in mm."""
        return np.array([self.shape[1] * self.scale.sx, self.shape[0] * self.scale.sy])


@dataclass(frozen=True, eq=False)
class PlacedFrame:
    """A frame in the slice. slice_from_frame: its pose, mm; hidden_lines: names of rods that are left out.

    Raises ValueError where a hidden line is not one of the frame's.
    """

    frame: Frame
    slice_from_frame: Pose
    hidden_lines: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        unknown = [name for name in self.hidden_lines if name not in self.frame.line_names]
        if unknown:
            raise ValueError(
                f"hidden_lines names {unknown[0]!r}, expected names of frame '{self.frame.name}': "
                f"{', '.join(self.frame.line_names)}"
            )

    def rods(self) -> list[Cylinder]:
        """The rods that are not hidden, in slice axes."""
        starts = self.slice_from_frame @ self.frame.starts
        ends = self.slice_from_frame @ self.frame.ends
        return [
            Cylinder(start, end, float(diameter))
            for name, start, end, diameter in zip(
                self.frame.line_names, starts, ends, self.frame.diameters, strict=True
            )
            if name not in self.hidden_lines
        ]


def metal_fraction(placed: Sequence[PlacedFrame], settings: ScannerSettings) -> Array:
    """Fraction (rows, columns) of each pixel that the rods fill: no noise, no background, no clipping."""
    image = np.zeros(settings.shape)
    for rod in _rods(placed):
        add_metal(image, rod, settings.scale, settings.slice_thickness_mm, settings.psf_sigma_mm)
    return image


def render_slice(
    placed: Sequence[PlacedFrame],
    settings: ScannerSettings,
    rng: np.random.Generator,
    scanner_from_slice: Pose | None = None,
) -> Slice:
    """The slice of the plane z = 0 with the frames in it, in whole HU; the same for the same generator state.

    The needle and the false spots are drawn at random, clear of the rods' spots and of each other by CLEARANCE_MM.
    Raises ValueError where the image has no room for them.
    """
    image = background(settings.shape, settings.scale, settings.body).copy()
    if settings.block:
        for one in placed:
            _paint_block(image, one, settings)
    rods = _rods(placed)
    occupied = [_outline(rod, settings) for rod in rods]
    metal = [(rod, settings.rod_hu) for rod in rods]
    if settings.needle:
        needle = _clear_of(occupied, settings, lambda: _random_needle(settings, rng), "needle")
        metal.append((needle, settings.rod_hu))
    for _ in range(int(settings.false_spots)):
        spot = _clear_of(occupied, settings, lambda: _random_spot(settings, rng), "false_spots")
        metal.append((spot, settings.rod_hu * rng.uniform(0.6, 1.0)))
    for cylinder, hu in metal:
        add_metal(image, cylinder, settings.scale, settings.slice_thickness_mm, settings.psf_sigma_mm, hu)
    if settings.noise_hu > 0:
        image += np.float32(settings.noise_hu) * rng.standard_normal(settings.shape, dtype=np.float32)
    np.clip(np.rint(image, out=image), *SCANNER_RANGE_HU, out=image)
    return Slice(image, settings.scale, scanner_from_slice or Pose.identity())


def _rods(placed: Sequence[PlacedFrame]) -> list[Cylinder]:
    return [rod for one in placed for rod in one.rods()]


def _outline(cylinder: Cylinder, settings: ScannerSettings) -> Array:
    """Discs (n, 3), x, y and radius in mm, that cover the cylinder's spot; none where it has no spot."""
    shadow = cylinder.shadow(settings.slice_thickness_mm)
    if shadow is None:
        return np.empty((0, 3))
    start, end = shadow
    count = 2 + math.ceil(float(np.linalg.norm(end - start)) / 0.5)
    centres = start + np.linspace(0, 1, count)[:, None] * (end - start)
    return np.column_stack([centres, np.full(count, 0.5 * cylinder.diameter)])


def _clear_of(occupied: list[Array], settings: ScannerSettings, draw: Callable[[], Cylinder], what: str) -> Cylinder:
    """The first cylinder drawn that is clear of everything in `occupied`, to which its outline is added."""
    taken = np.concatenate([np.empty((0, 3)), *occupied])
    for _ in range(_TRIES):
        cylinder = draw()
        outline = _outline(cylinder, settings)
        gaps = np.linalg.norm(outline[:, None, :2] - taken[:, :2], axis=-1) - outline[:, None, 2] - taken[:, 2]
        if (gaps >= CLEARANCE_MM).all():
            occupied.append(outline)
            return cylinder
    raise ValueError(f"{what}: no place found that is {CLEARANCE_MM:g} mm clear of everything else in the image")


def _random_spot(settings: ScannerSettings, rng: np.random.Generator) -> Cylinder:
    """Something like a rod, 0.8 to 2 mm thick, upright or leaning: a round or a longish spot, whole in the image."""
    leaning, azimuth = rng.uniform(0, math.radians(50)), rng.uniform(0, 2 * math.pi)
    direction = np.array(
        [math.sin(leaning) * math.cos(azimuth), math.sin(leaning) * math.sin(azimuth), math.cos(leaning)]
    )
    diameter = float(rng.uniform(0.8, 2.0))
    half_length = settings.slice_thickness_mm / math.cos(leaning) + diameter
    size_px = np.array(settings.shape[::-1]) - 1.0
    margin_px = (half_length * math.sin(leaning) + diameter + 2.0) / np.array([settings.scale.sx, settings.scale.sy])
    margin_px = np.minimum(margin_px, 0.4 * size_px)
    centre = np.append(settings.scale.to_mm(margin_px + rng.uniform(size=2) * (size_px - 2 * margin_px)), 0.0)
    return Cylinder(centre - half_length * direction, centre + half_length * direction, diameter)


def _random_needle(settings: ScannerSettings, rng: np.random.Generator) -> Cylinder:
    """A needle, 1.2 mm thick, from above the patient towards the liver, up to 1.5 degrees out of the plane."""
    share = settings.size_mm
    tip = rng.uniform([0.28, 0.62], [0.42, 0.70]) * share
    lean = math.radians(rng.uniform(5, 60))
    rise = math.radians(rng.uniform(-1.5, 1.5))
    direction = np.array([-math.sin(lean) * math.cos(rise), -math.cos(lean) * math.cos(rise), math.sin(rise)])
    length = 0.55 * share[1]
    # The plane meets it half way: its visible stretch is as long as thickness and lean out of the plane allow.
    middle = np.append(tip, 0.0) + 0.4 * length * direction * [1, 1, 0]
    return Cylinder(middle - 0.4 * length * direction, middle + 0.6 * length * direction, 1.2)


def _paint_block(image: NDArray[np.float32], placed: PlacedFrame, settings: ScannerSettings) -> None:
    """Replace what is there by the plastic around the rods: a box in the frame's axes, averaged over the slice."""
    frame, pose, scale = placed.frame, placed.slice_from_frame, settings.scale
    ends = np.concatenate([frame.starts, frame.ends])
    low, high = ends.min(axis=0) - _BLOCK_MARGIN_MM, ends.max(axis=0) + _BLOCK_MARGIN_MM
    corners = pose @ np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    pixels = scale.to_px(corners[:, :2])
    first = np.maximum(np.floor(pixels.min(axis=0)) - 2, 0).astype(int)
    last = np.minimum(np.ceil(pixels.max(axis=0)) + 3, settings.shape[::-1]).astype(int)
    half = 0.5 * settings.slice_thickness_mm
    if (last <= first).any() or corners[:, 2].min() > half or corners[:, 2].max() < -half:
        return
    u, v = np.arange(first[0], last[0]), np.arange(first[1], last[1])[:, None]
    soft = 2.5 * settings.psf_sigma_mm
    layers = np.array([-0.8, -0.4, 0.0, 0.4, 0.8]) * half
    outside = np.full((len(layers), len(v), len(u)), -np.inf)
    # p_frame = R' (p_slice - t), one axis of the frame at a time; over the thickness it changes by R's third row.
    for by_mm, by_z, middle, reach in zip(
        pose.rotation[:2].T,
        pose.rotation[2],
        pose.inverse().translation - 0.5 * (low + high),
        0.5 * (high - low),
        strict=True,
    ):
        by_px = by_mm @ scale.matrix
        along = middle + by_px[0] * u + by_px[1] * v
        np.maximum(outside, np.abs(along + by_z * layers[:, None, None]) - reach, out=outside)
    share = np.clip(0.5 - outside / soft, 0.0, 1.0).mean(axis=0)
    patch = image[first[1] : last[1], first[0] : last[0]]
    patch += (share * (BLOCK_HU - patch)).astype(np.float32)
