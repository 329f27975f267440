"""What the contract fixes, written out: the code must not be compared with itself."""

from __future__ import annotations

DIAGNOSTIC_KEYS = [
    "outcome",
    "reason",
    "frame",
    "spots",
    "lines",
    "inliers",
    "residual_rms_mm",
    "residual_rms_px",
    "log10_false_alarms",
    "ambiguous_poses",
    "position_std_mm",
    "rotation_std_deg",
    "target_error_95_mm",
    "pixel_spacing_x_mm",
    "pixel_spacing_y_mm",
    "calibration",
    "duration_ms",
]
