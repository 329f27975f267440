"""How the paper's simulated and rendered slices are registered: their rods and pixel spacing are exactly as stated."""

from __future__ import annotations

from typing import Final

from stereoreg_ros.options import RegistrationOptions

# As open as it can be: the paper looks at every pose that is found, however large its error.
_MAX_TARGET_ERROR_MM: Final = 1000.0
_THRESHOLD_HU: Final = 2000.0


def exact_options(spot_noise_px: float) -> RegistrationOptions:
    """Options for slices whose spots have this noise (standard deviation per axis, pixel) and nothing else is off."""
    return RegistrationOptions(
        threshold=_THRESHOLD_HU,
        spot_noise_px=spot_noise_px,
        frame_tolerance_mm=0.0,
        scale_tolerance=0.0,
        max_target_error_mm=_MAX_TARGET_ERROR_MM,
    )
