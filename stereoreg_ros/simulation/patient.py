"""What is in the image before any metal: air, and a patient lying on the back, cut through the upper abdomen."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.slice import PixelScale

AIR_HU: Final = -1000.0

# Centre x, y and half axes as shares of the image's width and height, the tilt in degrees, HU.
_Ellipse: TypeAlias = tuple[float, float, float, float, float, float]
# The patient, painted in this order.
_BODY: Final[tuple[_Ellipse, ...]] = (
    (0.500, 0.715, 0.455, 0.275, 0, -95),  # skin and fat
    (0.500, 0.720, 0.425, 0.248, 0, 55),  # muscle
    (0.500, 0.705, 0.375, 0.205, 0, -80),  # fat of the abdomen
    (0.345, 0.660, 0.210, 0.140, -20, 105),  # liver
    (0.330, 0.625, 0.022, 0.030, 25, 15),  # gall bladder
    (0.690, 0.640, 0.115, 0.095, 20, 50),  # stomach
    (0.680, 0.595, 0.060, 0.035, 8, -850),  # its gas
    (0.800, 0.720, 0.050, 0.085, 10, 120),  # spleen
    (0.335, 0.820, 0.050, 0.062, 20, 170),  # kidneys
    (0.330, 0.820, 0.018, 0.030, 20, 60),
    (0.665, 0.820, 0.050, 0.062, -20, 170),
    (0.670, 0.820, 0.018, 0.030, -20, 60),
    (0.535, 0.735, 0.024, 0.024, 0, 210),  # aorta
    (0.462, 0.740, 0.028, 0.020, 0, 160),  # vena cava
    (0.410, 0.885, 0.070, 0.035, 10, 60),  # muscles of the back
    (0.590, 0.885, 0.070, 0.035, -10, 60),
    (0.430, 0.868, 0.065, 0.012, 12, 750),  # vertebra: transverse processes
    (0.570, 0.868, 0.065, 0.012, -12, 750),
    (0.500, 0.925, 0.013, 0.042, 0, 850),  # spinous process
    (0.500, 0.865, 0.040, 0.034, 0, 950),  # arch
    (0.500, 0.806, 0.066, 0.048, 0, 1150),  # body: cortex
    (0.500, 0.806, 0.058, 0.041, 0, 720),
    (0.500, 0.865, 0.024, 0.019, 0, 30),  # canal
)
_RIBS_DEG: Final = (-62, -30, 2, 28, 152, 178, 210, 242)


@lru_cache(maxsize=4)
def background(shape: tuple[int, int], scale: PixelScale, body: bool) -> NDArray[np.float32]:
    """Air (rows, columns), with the patient in it where `body`."""
    image = np.full(shape, AIR_HU, dtype=np.float32)
    if body:
        for ellipse in (*_BODY, *_ribs()):
            _paint_ellipse(image, ellipse, scale)
    image.setflags(write=False)
    return image


def _ribs() -> list[_Ellipse]:
    """Ribs in the muscle, cortex and marrow, in the form of _BODY."""
    _, _, width, height, _, _ = _BODY[1]
    ribs = []
    for degrees in _RIBS_DEG:
        angle = math.radians(degrees)
        x, y = 0.5 + 0.94 * width * math.cos(angle), _BODY[1][1] - 0.92 * height * math.sin(angle)
        tangent = math.degrees(math.atan2(height * math.cos(angle), width * math.sin(angle)))
        ribs += [(x, y, 0.032, 0.011, tangent, 900.0), (x, y, 0.026, 0.006, tangent, 400.0)]
    return ribs


def _paint_ellipse(image: NDArray[np.float32], ellipse: _Ellipse, scale: PixelScale) -> None:
    x, y, half_x, half_y, tilt_deg, hu = ellipse
    rows, columns = image.shape
    width, height = columns * scale.sx, rows * scale.sy
    a, b = half_x * width, half_y * height
    reach = max(a, b) + 2 * max(scale.sx, scale.sy)
    left, right = (int(np.clip((x * width + side * reach) / scale.sx, 0, columns)) for side in (-1, 1))
    top, bottom = (int(np.clip((y * height + side * reach) / scale.sy, 0, rows)) for side in (-1, 1))
    dx = np.arange(left, right) * scale.sx - x * width
    dy = (np.arange(top, bottom) * scale.sy - y * height)[:, None]
    cosine, sine = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    along, across = (dx * cosine + dy * sine) / a, (dy * cosine - dx * sine) / b
    radius = np.hypot(along, across)
    # Distance to the edge to first order: the level's value over the length of its gradient.
    gradient = np.hypot(along / a, across / b) / np.maximum(radius, 1e-9)
    share = np.clip(0.5 + (1 - radius) / np.maximum(gradient, 1e-9) / 1.5, 0.0, 1.0)
    patch = image[top:bottom, left:right]
    patch += (share * (hu - patch)).astype(np.float32)
