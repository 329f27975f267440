"""Spots that are all false: how many sets are taken for a frame, and how many have explanations at all."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from stereoreg_ros import RegistrationOptions, load_frame, register_spots
from stereoreg_ros.simulation import ScannerSettings

THRESHOLDS = (0.0, -0.5, -1.0, -1.5, -2.0, -3.0, -4.0)


@dataclass(frozen=True)
class Clutter:
    """Sets of nothing but false spots, uniform over a square of `side_mm`, from `fewest` to `most` of them.

    noise_px: stated to the matcher; max_log10: how many false alarms it may let pass, as log10; tolerance_mm,
    scale_tolerance: of the frame and the scale, as stated to the matcher.
    """

    frame: str
    fewest: int
    most: int
    side_mm: float
    noise_px: float
    max_log10: float
    tolerance_mm: float = 0.0
    scale_tolerance: float = 0.0


@dataclass
class Count:
    """What came of a number of sets: accepted ones, and how many explanations there were below each threshold."""

    sets: int
    accepted: int
    below: dict[float, int]
    reasons: dict[str, int]


def count(clutter: Clutter, sets: int, seed: int) -> Count:
    """Draw a number of sets and register them."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(seed)
    frame, scale = load_frame(clutter.frame), ScannerSettings().scale
    # The theory counts what chance brings however weak the pose.
    options = RegistrationOptions(
        spot_noise_px=clutter.noise_px,
        frame_tolerance_mm=clutter.tolerance_mm,
        scale_tolerance=clutter.scale_tolerance,
        max_log10_false_alarms=clutter.max_log10,
        max_target_error_mm=1000.0,
    )
    accepted = 0
    below = dict.fromkeys(THRESHOLDS, 0)
    reasons: Counter[str] = Counter()
    for _ in range(sets):
        spots_mm = rng.uniform(0, clutter.side_mm, (rng.integers(clutter.fewest, clutter.most + 1), 2))
        result = register_spots(scale.to_px(spots_mm), frame, scale, options, slice_area_mm2=clutter.side_mm**2)
        estimates = (result.estimate,) if result else result.estimates
        accepted += bool(result)
        if not result:
            reasons[result.reason] += 1
        for threshold in THRESHOLDS:
            below[threshold] += any(estimate.log10_false_alarms <= threshold for estimate in estimates)
    return Count(sets, accepted, below, dict(reasons))
