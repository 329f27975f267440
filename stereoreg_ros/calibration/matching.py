"""Which slices are accepted with a scale, or look like the frame with it."""

from __future__ import annotations

from dataclasses import replace

from stereoreg_ros.calibration.measured import MIN_LINES, why_degenerate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.registration import recognise, register_slice_spots
from stereoreg_ros.result import Recognition, Refusal, Registration

# The largest that a limit of a registration can be.
_ANY_MM = 1000.0


def match_slice(
    spots: SliceSpots, frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> Registration | Refusal:
    """Register the frame from the spots of a slice with this scale, mm/pixel, however weakly its pose is known."""
    # Which spot is which rod is all that is asked.
    options = replace(options, max_position_std_mm=_ANY_MM, max_target_error_mm=_ANY_MM)
    return register_slice_spots(spots.with_scale(scale), frame, options)


def recognise_slice(
    spots: SliceSpots, frame: Frame, scale: PixelScale, options: RegistrationOptions
) -> Recognition | None:
    """What the spots of a slice look most like with this scale, where that says something of the scale."""
    seen = recognise(spots.with_scale(scale), frame, options)
    return None if seen is None or len(seen.matches) < MIN_LINES or why_degenerate(frame, [seen]) else seen
