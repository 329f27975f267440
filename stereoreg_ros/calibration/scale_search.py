"""Other scales than the one in use, where that one leaves slices unexplained."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from stereoreg_ros.calibration.matching import match_slice, recognise_slice
from stereoreg_ros.calibration.measured import MIN_LINES, measured_scale
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions

# Steps in which scales are tried, and with how many slices at most.
_STEP, _SEARCHED = 0.05, 3
# Standard deviation of what is left of a scale's error, which is half a step at most. A spot at the frame's edge is off
# by that share of the frame's radius.
_OFF = _STEP / 4
# False alarms with which a slice is looked at closer, log10: what it shows is then measured and matched anew.
_LOOK_CLOSER = -1.0


def search_scales(
    slices: Sequence[SliceSpots],
    frame: Frame,
    scale: PixelScale,
    options: RegistrationOptions,
    max_change: float,
    progress: Callable[[float], bool] | None,
) -> Iterator[PixelScale | None]:
    """Scales with which one of the slices is accepted, at most one for each slice; None where it is given up.

    With a scale that is a little off, a slice is recognised at a noise that allows for that; the scale is then measured
    from it, and the slice must be accepted with it at the noise that is stated, as rarely by chance as all scales tried
    require. The scales nearest to the one in use come first.
    """
    waiting = list(slices[-_SEARCHED:])
    factors = _factors(max_change)
    ends = np.concatenate([frame.starts, frame.ends])
    off_mm = _OFF * float(np.linalg.norm(np.ptp(ends, axis=0))) / 2
    loose = replace(
        options,
        max_log10_false_alarms=max(_LOOK_CLOSER, options.max_log10_false_alarms),
        scale_tolerance=max(_OFF, options.scale_tolerance),
        min_inliers=max(MIN_LINES, options.min_inliers),
    )
    tried = len(factors) * max(len(waiting), 1)
    strict = replace(options, max_log10_false_alarms=options.max_log10_false_alarms - math.log10(tried))
    for number, (by_x, by_y) in enumerate(factors):
        start = replace(scale, sx=by_x * scale.sx, sy=by_y * scale.sy)
        # The same in mm for all scales, as the matcher keeps a table for each noise.
        noise_px = min(max(options.spot_noise_px, off_mm / max(start.sx, start.sy)), 10.0)
        loose = replace(loose, spot_noise_px=noise_px)
        for spots in list(waiting):
            if progress is not None and not progress(number / len(factors)):
                yield None
            seen = recognise_slice(spots, frame, start, loose)
            if seen is None:
                continue
            measured = measured_scale(frame, [seen], with_shear=False).scale
            if match_slice(spots, frame, measured, strict):
                waiting = [one for one in waiting if one is not spots]
                yield measured
        if not waiting:
            return


def _factors(max_change: float) -> list[tuple[float, float]]:
    """Factors of (sx, sy) in steps within the allowed change, the smallest change first."""
    count = math.ceil(max_change / _STEP - 1e-9)
    steps = [_STEP * step for step in range(-count, count + 1)]
    both = [(x, y) for x, y in product(steps, steps) if max(abs(x), abs(y)) <= max_change + _STEP / 2]
    return [(1 + x, 1 + y) for x, y in sorted(both, key=lambda pair: (max(map(abs, pair)), sum(map(abs, pair)), pair))]
