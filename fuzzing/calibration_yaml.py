"""Files that keep a measured pixel scale."""

from __future__ import annotations

import functools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from fuzzing.kind import Kind
from fuzzing.mutation import mutate_text
from stereoreg_ros.calibration.file import CalibrationFileError, CalibrationRecord, load_calibration, save_calibration
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.uncertainty import checked_scale_covariance

_RECORD = CalibrationRecord(
    PixelScale(0.5012, 0.4987, 0.001),
    PixelScale(0.5, 0.5),
    ((1.6e-7, -1e-8, 1e-9), (-1e-8, 2.5e-7, 0.0), (1e-9, 0.0, 4e-8)),
    "cube6",
    10,
    60,
    "2026-11-24T12:00:00+00:00",
    "1.0",
)


@functools.cache
def _file() -> Path:
    return Path(tempfile.mkdtemp(prefix="fuzzing-")) / "scale.yaml"


def _attempt(data: bytes) -> None:
    _file().write_bytes(data)
    record = load_calibration(_file())
    assert record is not None
    for new, before in ((record.scale.sx, record.configured.sx), (record.scale.sy, record.configured.sy)):
        assert 0.499 < new / before < 2.001
    checked_scale_covariance(record.covariance)
    assert np.isfinite(record.standard_errors).all()
    assert record.replaces(record.configured)
    for text in (record.frame, record.date, record.software):
        assert text.isprintable()


def _seeds() -> list[bytes]:
    seeds = []
    for record in (_RECORD, replace(_RECORD, covariance=((1e-6, 5e-7), (5e-7, 1e-6)))):
        save_calibration(_file(), record)
        seeds.append(_file().read_bytes())
    lines = seeds[1].splitlines(keepends=True)
    start = next(number for number, line in enumerate(lines) if line.startswith(b"covariance"))
    end = next(number for number, line in enumerate(lines) if line.startswith(b"configured_pixel_spacing"))
    # As older versions wrote it.
    return [*seeds, b"".join(lines[:start] + lines[end:])]


CALIBRATION = Kind(
    name="calibration",
    ending=".yaml",
    attempt=_attempt,
    refusals=(CalibrationFileError,),
    names=lambda text: text.startswith(str(_file())),
    seeds=_seeds,
    mutate=mutate_text,
)
