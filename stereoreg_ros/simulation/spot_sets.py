"""Sets of spots with a known answer: what tests and benchmarks give to the matching."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.simulation.motion import random_pose
from stereoreg_ros.simulation.scene import ScannerSettings


@dataclass(frozen=True)
class SpotSetSettings:
    """How spot sets are drawn.

    scanner: image size and pixel scale; visible_rods: how many rods show a spot; false_spots: how many others there are
    (uniform over the image); noise_px: of each coordinate, uniform in [-noise_px, noise_px] as in Maurin 2009, or
    normal with that standard deviation if `gaussian`; max_tilt_deg, max_depth_mm: see `random_pose`.
    """

    scanner: ScannerSettings
    visible_rods: int
    false_spots: int = 0
    noise_px: float = 0.5
    gaussian: bool = False
    max_tilt_deg: float = 20.0
    max_depth_mm: float = 10.0

    @property
    def noise_std_px(self) -> float:
        """Standard deviation of the noise per axis, pixel."""
        return self.noise_px if self.gaussian else self.noise_px / 3**0.5


@dataclass(frozen=True, eq=False)
class SpotSet:
    """Spots (s, 2) in pixel, in random order, and the true slice_from_frame."""

    spots_px: Array
    slice_from_frame: Pose


def random_spot_set(
    rng: np.random.Generator, frame: Frame, settings: SpotSetSettings, nominal: Pose | None = None
) -> SpotSet:
    """A random pose with at least `visible_rods` rods through the slice, of which that many are seen; the same for the
    same generator state. nominal: see `random_pose`.
    """
    # Spots have no extent here: a thin slice keeps every rod whose axis is cut.
    thin = replace(settings.scanner, slice_thickness_mm=0.05)
    pose = random_pose(
        rng,
        frame,
        thin,
        max_tilt_deg=settings.max_tilt_deg,
        max_depth_mm=settings.max_depth_mm,
        min_rods=settings.visible_rods,
        nominal=nominal,
    )
    predicted, cuts = project(frame, pose, settings.scanner.scale)
    seen = rng.permutation(np.flatnonzero(cuts.inside))[: settings.visible_rods]
    if settings.gaussian:
        noise = rng.normal(0.0, settings.noise_px, (len(seen), 2))
    else:
        noise = rng.uniform(-settings.noise_px, settings.noise_px, (len(seen), 2))
    false = rng.uniform(0, settings.scanner.shape[::-1], (settings.false_spots, 2))
    spots = np.concatenate([predicted[seen] + noise, false])
    return SpotSet(spots[rng.permutation(len(spots))], pose)
