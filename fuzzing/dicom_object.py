"""DICOM objects, as the receiver gets them and as files."""

from __future__ import annotations

import functools
import tempfile
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from fuzzing.dicom_elements import mutate_dicom
from fuzzing.kind import CORPUS, Kind
from stereoreg_ros.dicom import DicomError, DicomSlice, read_slice
from stereoreg_ros.reception.intake import Intake, ObjectRefusedError
from stereoreg_ros.reception.slice_queue import SliceQueue

# Sixty times the seeds.
_MOST_BYTES: Final = 2**18
_MOST_FRAMES: Final = 8
# One in this many is read as a file as well.
_READ_ONCE_IN: Final = 4


@functools.cache
def _file() -> Path:
    return Path(tempfile.mkdtemp(prefix="fuzzing-")) / "object.dcm"


def _attempt(data: bytes) -> None:
    if zlib.crc32(data) % _READ_ONCE_IN == 0:
        _read_as_file(data)
    queue = SliceQueue(_MOST_FRAMES)
    count = Intake(queue, _MOST_BYTES).take(_file(), data)
    assert 1 <= count == len(queue) <= _MOST_FRAMES
    total = 0
    while (received := queue.first()) is not None:
        _check(received.dicom_slice)
        assert received.dicom_slice.header.has_plane
        total += received.dicom_slice.ct_slice.hu.nbytes
        queue.remove_first()
    # Stored as a byte a pixel at least, and kept as four.
    assert total <= 4 * _MOST_BYTES


def _read_as_file(data: bytes) -> None:
    _file().write_bytes(data)
    # One of the two ways, as an image over which its decoder hangs takes its time each time.
    slice_axes = zlib.crc32(data) // _READ_ONCE_IN % 2 == 1
    try:
        _check(read_slice(_file(), slice_axes=slice_axes))
    except DicomError as error:
        if not str(error).startswith(str(_file())):
            raise AssertionError("a refusal does not name the file") from error


def _check(dicom_slice: DicomSlice) -> None:
    header, hu = dicom_slice.header, dicom_slice.ct_slice.hu
    assert hu.dtype == np.float32
    assert hu.shape == (header.rows, header.columns)
    assert np.isfinite(hu).all()
    assert np.isfinite(header.scanner_from_slice.translation).all()
    rotation = header.scanner_from_slice.rotation
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def _seeds() -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / "dicom").glob("valid-*.dcm"))]


DICOM = Kind(
    name="dicom",
    ending=".dcm",
    attempt=_attempt,
    refusals=(ObjectRefusedError,),
    names=lambda text: text.startswith(str(_file())),
    seeds=_seeds,
    mutate=mutate_dicom,
)
