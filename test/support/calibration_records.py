"""A calibration record, and the same as a file's content."""

from __future__ import annotations

from stereoreg_ros.calibration.file import CalibrationRecord
from stereoreg_ros.geometry.slice import PixelScale

RECORD = CalibrationRecord(
    PixelScale(0.5012, 0.4987, 0.001),
    PixelScale(0.5, 0.5),
    ((1.6e-7, -1e-8, 1e-9), (-1e-8, 2.5e-7, 0.0), (1e-9, 0.0, 4e-8)),
    "cube6",
    10,
    60,
    "2026-11-24T12:00:00+00:00",
    "1.0",
)


def content() -> dict[str, object]:
    return {
        "kind": "stereoreg_ros pixel scale",
        "pixel_spacing": [0.5, 0.5],
        "pixel_shear": 0.0,
        "standard_errors": [0.001, 0.001],
        "covariance": [[1e-6, 5e-7], [5e-7, 1e-6]],
        "configured_pixel_spacing": [0.5, 0.5],
        "configured_pixel_shear": 0.0,
        "frame": "cube6",
        "slices": 3,
        "rods": 18,
        "date": "2026-11-24T12:00:00+00:00",
        "software": "1.0",
    }
