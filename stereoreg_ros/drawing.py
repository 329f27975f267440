"""A registered slice as a picture: what was found, which rod of which frame it is, and how well it fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.result import PoseEstimate, Refusal, Registration

Picture = NDArray[np.uint8]

# BGR
_GREEN: Final = (80, 220, 80)
_YELLOW: Final = (60, 210, 255)
_RED: Final = (70, 70, 255)
_BLUE: Final = (255, 170, 60)
_WHITE: Final = (240, 240, 240)
_LEAST_WIDTH = 1024
_MOST_ROWS = 4096
# For each frame two lines of text, above and below them a margin.
_LINE = 26
_MARGIN = 12
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
# Residuals are drawn this many times longer: in a good registration they are a fraction of a pixel.
_RESIDUAL_MAGNIFICATION = 10


def draw_overlay(ct_slice: Slice, results: Registration | Refusal | Sequence[Registration | Refusal]) -> Picture:
    """The slice in BGR (rows, columns, 3), enlarged to 1024 columns unless it is very tall, under the outcome in words.

    results: one, or those of several frames that were sought in the slice: each has two lines of words, and the labels
    name the frame. Spots that are no frame's rod: yellow circles. Rods with a spot: green, with the rod's name and
    distance; the red stroke is the residual, ten times enlarged. Rods that should be seen and have no spot: blue
    crosses. A refusal shows its best explanation. Raises ValueError where there is no result.
    """
    shown = [results] if isinstance(results, (Registration, Refusal)) else list(results)
    if not shown:
        raise ValueError("found no result to draw, expected one at least")
    grey = _grey(ct_slice)
    # Wide enough to read, but a tall narrow image must not grow beyond bounds.
    zoom = max(1, min(-(-_LEAST_WIDTH // grey.shape[1]), _MOST_ROWS // grey.shape[0]))
    large = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    body = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
    for spot in np.concatenate([result.spots_px for result in shown]):
        cv2.circle(body, _at(spot, zoom), _radius(zoom), _YELLOW, 1, cv2.LINE_AA)
    # Over the spots that are rods; and what was accepted over what was not.
    for result in sorted(shown, key=bool):
        _mark_rods(body, zoom, ct_slice, result, f"{result.frame.name} " if len(shown) > 1 else "")
    headlines = [_headline(result) for result in shown]
    header = _MARGIN + 2 * _LINE * len(headlines)
    picture = np.zeros((body.shape[0] + header, body.shape[1], 3), dtype=np.uint8)
    picture[header:] = body
    for number, headline in enumerate(headlines):
        for row, (text, colour) in enumerate(headline, 2 * number):
            cv2.putText(picture, text, (_MARGIN, _LINE + _LINE * row), _FONT, 0.6, colour, 1, cv2.LINE_AA)
    return picture


def _best(result: Registration | Refusal) -> PoseEstimate | None:
    """The estimate that is shown."""
    return result.estimate if result else next(iter(result.estimates), None)


def _grey(ct_slice: Slice) -> Picture:
    low, high = np.percentile(ct_slice.hu, (1.0, 99.5))
    high = max(high, low + 1.0)
    scaled = np.clip((ct_slice.hu - low) * (200.0 / (high - low)), 0, 255)
    grey: Picture = scaled.astype(np.uint8)
    return grey


def _headline(result: Registration | Refusal) -> list[tuple[str, tuple[int, int, int]]]:
    """One or two lines of words with their colours."""
    best = _best(result)
    lines = len(result.frame)
    if result:
        first = (
            f"accepted: {result.frame.name}, {result.estimate.inliers} of {lines} rods, {len(result.spots_px)} spots"
        )
        colour = _YELLOW if result.caution else _GREEN
    else:
        first = f"refused ({result.reason}): {result.frame.name}, {len(result.spots_px)} spots"
        colour = _RED
    if best is None:
        return [(first, colour)]
    x, y, z = best.scanner_from_frame.translation
    second = (
        f"residual {best.residual_rms_mm:.2f} mm   false alarms 10^{best.log10_false_alarms:.1f}   position "
        f"({x:.2f}, {y:.2f}, {z:.2f}) mm +- {best.position_std_mm:.2f}   rotation +- {best.rotation_std_deg:.2f} deg"
    )
    return [(first, colour), (second, _WHITE)]


def _at(point_px: Array, zoom: int) -> tuple[int, int]:
    """Where a point of the slice lies in the enlarged one."""
    # Pixel centres are integers; the enlarged pixel (0, 0) has its centre at (zoom - 1) / 2.
    u, v = point_px * zoom + (zoom - 1) / 2
    return round(float(np.clip(u, -1e4, 1e4))), round(float(np.clip(v, -1e4, 1e4)))


def _radius(zoom: int) -> int:
    return max(4, round(3.5 * zoom))


def _mark_rods(
    picture: cv2.typing.MatLike, zoom: int, ct_slice: Slice, result: Registration | Refusal, prefix: str
) -> None:
    best, radius = _best(result), _radius(zoom)
    if best is None:
        return
    predicted, cuts = project(result.frame, best.slice_from_frame, ct_slice.scale)
    by_line = {match.line_index: match for match in best.matches}
    for line, name in enumerate(result.frame.line_names):
        match = by_line.get(line)
        if match is None:
            if cuts.inside[line]:
                place = _at(predicted[line], zoom)
                cv2.drawMarker(picture, place, _BLUE, cv2.MARKER_TILTED_CROSS, 2 * radius, 1, cv2.LINE_AA)
                _label(picture, place, radius, f"{prefix}{name} missing", _BLUE)
            continue
        spot, predicted_spot = _at(match.spot_px, zoom), _at(match.predicted_px, zoom)
        cv2.circle(picture, spot, radius, _GREEN, 1, cv2.LINE_AA)
        cv2.drawMarker(picture, predicted_spot, _GREEN, cv2.MARKER_CROSS, radius, 1, cv2.LINE_AA)
        stroke = match.predicted_px + _RESIDUAL_MAGNIFICATION * (match.spot_px - match.predicted_px)
        cv2.line(picture, predicted_spot, _at(stroke, zoom), _RED, 2, cv2.LINE_AA)
        _label(picture, spot, radius, f"{prefix}{name} {match.residual_mm:.2f} mm", _GREEN)


def _label(
    picture: cv2.typing.MatLike, point: tuple[int, int], radius: int, text: str, colour: tuple[int, int, int]
) -> None:
    (width, _), _ = cv2.getTextSize(text, _FONT, 0.45, 1)
    left = min(point[0] + radius + 3, picture.shape[1] - width - 2)
    cv2.putText(picture, text, (left, point[1] - radius // 2), _FONT, 0.45, colour, 1, cv2.LINE_AA)
