"""The file that keeps a measured pixel scale over a restart: written atomically, used only if complete and valid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from stereoreg_ros.calibration.calibrate import Calibration
from stereoreg_ros.files.bounded_yaml import MOST_BYTES, UnusableYamlError, shown
from stereoreg_ros.files.whole_file import read_whole, sync_folder, write_whole
from stereoreg_ros.files.yaml_values import values_of
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.uncertainty import checked_scale_covariance

_KIND: Final = "stereoreg_ros pixel scale"
_MOST_COUNTED: Final = 10**9
# Of a pixel; also of a standard error, whose square is then finite.
_LARGEST_MM: Final = 100.0
# Recalibration changes a spacing by half at most.
_LARGEST_FACTOR: Final = 2.0
# Two spacings that differ by less are the same one, as a share.
_SAME: Final = 1e-6


class CalibrationFileError(ValueError):
    """A calibration file that cannot be used; the text names the file, what was found and what was expected."""


@dataclass(frozen=True)
class CalibrationRecord:
    """What a calibration file states.

    scale: as measured, mm/pixel; configured: the scale that it replaces; covariance: (2, 2) of (sx,
    sy) or (3, 3) with the shear, mm^2/pixel^2, row by row; frame: name of the frame; slices, rods: from how many; date:
    ISO 8601; software: version.
    """

    scale: PixelScale
    configured: PixelScale
    covariance: tuple[tuple[float, ...], ...]
    frame: str
    slices: int
    rods: int
    date: str
    software: str

    @classmethod
    def of(cls, calibration: Calibration, configured: PixelScale, frame: str) -> CalibrationRecord:
        """The record of a calibration of now."""
        try:
            software = version("stereoreg_ros")
        except PackageNotFoundError:
            software = "not installed"
        return cls(
            calibration.scale,
            configured,
            tuple(tuple(float(value) for value in row) for row in calibration.covariance),
            frame,
            calibration.slices,
            calibration.rods,
            datetime.now(timezone.utc).isoformat(timespec="seconds"),
            software,
        )

    @property
    def standard_errors(self) -> tuple[float, ...]:
        """Of (sx, sy) and perhaps the shear, mm/pixel."""
        return tuple(math.sqrt(row[k]) for k, row in enumerate(self.covariance))

    def replaces(self, configured: PixelScale) -> bool:
        """Whether it was measured for this configured scale, not for that of another scanner or zoom."""
        pairs = ((self.configured.sx, configured.sx), (self.configured.sy, configured.sy))
        same = all(abs(ours / theirs - 1) <= _SAME for ours, theirs in pairs)
        return same and abs(self.configured.shear - configured.shear) <= _SAME * configured.sx


def save_calibration(path: Path, record: CalibrationRecord) -> None:
    """Write the file atomically: a reader finds the old or the new one, complete, even after a crash.

    Raises OSError where it cannot be written; the old one then stays.
    """
    content = {
        "kind": _KIND,
        "pixel_spacing": [record.scale.sx, record.scale.sy],
        "pixel_shear": record.scale.shear,
        "standard_errors": list(record.standard_errors),
        "covariance": [list(row) for row in record.covariance],
        "configured_pixel_spacing": [record.configured.sx, record.configured.sy],
        "configured_pixel_shear": record.configured.shear,
        "frame": record.frame,
        "slices": record.slices,
        "rods": record.rods,
        "date": record.date,
        "software": record.software,
    }
    text = yaml.safe_dump(content, sort_keys=False)
    write_whole(path, text)


def remove_calibration(path: Path) -> None:
    """Remove the file, if there is one, for good. Raises OSError where that fails."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def load_calibration(path: Path) -> CalibrationRecord | None:
    """The record in the file; None where there is no file. Raises CalibrationFileError where it cannot be used."""
    try:
        content = values_of(read_whole(path, MOST_BYTES))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: cannot be read: {error.strerror or error}, expected a calibration file"
        ) from None
    except UnusableYamlError as error:
        where = f"line {error.line}: " if error.line else ""
        raise CalibrationFileError(f"{path}: not YAML: {where}{error.problem}") from None
    if not isinstance(content, dict) or content.get("kind") != _KIND:
        found = content.get("kind") if isinstance(content, dict) else type(content).__name__
        raise CalibrationFileError(f"{path}: kind is {shown(repr(found))}, expected {_KIND!r}")
    scale, old = _scale(path, content, "pixel"), _scale(path, content, "configured_pixel")
    for new, before in ((scale.sx, old.sx), (scale.sy, old.sy)):
        if not 1 / _LARGEST_FACTOR <= new / before <= _LARGEST_FACTOR:
            raise CalibrationFileError(
                f"{path}: pixel_spacing is {[scale.sx, scale.sy]}, expected {[old.sx, old.sy]}, the "
                f"configured_pixel_spacing, changed by a factor of {_LARGEST_FACTOR:g} at most"
            )
    covariance = _covariance(path, content)
    texts = {key: content.get(key) for key in ("frame", "date", "software")}
    counts = {key: content.get(key) for key in ("slices", "rods")}
    for key, value in texts.items():
        # Names and dates go into messages, which take no half of a surrogate pair.
        if not isinstance(value, str) or not value.isprintable():
            raise CalibrationFileError(f"{path}: {key} is {shown(repr(value))}, expected a text in one line")
    for key, value in counts.items():
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _MOST_COUNTED:
            raise CalibrationFileError(f"{path}: {key} is {shown(repr(value))}, expected a number of 1 or more")
    return CalibrationRecord(scale, old, covariance, **counts, **texts)  # type: ignore[arg-type]


def _scale(path: Path, content: dict[str, Any], which: str) -> PixelScale:
    sx, sy = _numbers(path, content, f"{which}_spacing", 2)
    (shear,) = _numbers(path, {f"{which}_shear": [content.get(f"{which}_shear")]}, f"{which}_shear", 1)
    try:
        return PixelScale(sx, sy, shear)
    except ValueError as error:
        raise CalibrationFileError(f"{path}: {which}_spacing: {error}") from None


def _covariance(path: Path, content: dict[str, Any]) -> tuple[tuple[float, ...], ...]:
    errors = _numbers(path, content, "standard_errors", 2, 3)
    if not all(0 <= error <= _LARGEST_MM for error in errors):
        raise CalibrationFileError(
            f"{path}: standard_errors is {list(errors)}, expected numbers of mm/pixel from 0 to {_LARGEST_MM:g}"
        )
    size = len(errors)
    if "covariance" not in content:
        # Older files have the standard errors alone. Whatever the correlations of k numbers are, their covariance is in
        # no direction larger than k times that of independent ones.
        variances = size * np.square(errors)
        return tuple(tuple(float(value) for value in row) for row in np.diag(variances))
    rows = content["covariance"]
    if not isinstance(rows, list) or len(rows) != size:
        raise CalibrationFileError(
            f"{path}: covariance is {shown(repr(rows))}, expected {size} rows of {size} finite numbers"
        )
    covariance = tuple(_numbers(path, {"covariance": row}, "covariance", size) for row in rows)
    try:
        checked_scale_covariance(covariance)
    except ValueError as error:
        raise CalibrationFileError(f"{path}: covariance: {error}") from None
    if not np.allclose(np.diag(covariance), np.square(errors), rtol=1e-3, atol=0.0):
        raise CalibrationFileError(
            f"{path}: covariance has the variances {np.diag(covariance).tolist()}, expected the squares of the "
            f"standard_errors {list(errors)}"
        )
    return covariance


def _numbers(path: Path, content: dict[str, Any], key: str, *counts: int) -> tuple[float, ...]:
    values = content.get(key)
    numbers = isinstance(values, list) and all(
        isinstance(one, (int, float)) and not isinstance(one, bool) and math.isfinite(one) for one in values
    )
    if not isinstance(values, list) or not numbers or len(values) not in counts:
        expected = " or ".join(str(count) for count in counts)
        raise CalibrationFileError(f"{path}: {key} is {shown(repr(values))}, expected {expected} finite numbers")
    return tuple(float(one) for one in values)
