"""DICOM files for the tests: where the real ones lie, and small ones of our own, right or wrong on purpose."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, ExplicitVRLittleEndian, generate_uid

ROOT = Path(__file__).resolve().parents[2]
SHARED_DATA = ROOT.parent / "shared" / "data"
CATPHAN = ROOT / ".cache" / "catphan"
SERIES_UID = generate_uid(entropy_srcs=["stereoreg_ros", "series"])


def real(path: Path) -> Path:
    """The path, or the test is skipped with the reason."""
    if not path.exists():
        pytest.skip(f"real images are not there: {path.relative_to(ROOT.parent)}")
    return path


def write_slice(path: Path, stored: ArrayLike, z: float = 0.0, **elements: Any) -> Path:
    """Write a CT slice with `stored` (rows, columns) values, HU = stored - 1024, at height z in mm; returns the path.

    elements: DICOM elements by keyword in place of the usual ones; None leaves one out.
    """
    pixels = np.asarray(stored)
    if pixels.dtype.kind not in "iu" or pixels.dtype.itemsize > 4:
        pixels = pixels.astype(np.uint16)
    bits = 8 * pixels.dtype.itemsize
    usual: dict[str, Any] = {
        "SOPClassUID": CTImageStorage,
        "SOPInstanceUID": generate_uid(),
        "Modality": "CT",
        "SeriesInstanceUID": SERIES_UID,
        "StudyInstanceUID": generate_uid(entropy_srcs=["stereoreg_ros", "study"]),
        "InstanceNumber": 1,
        "ImagePositionPatient": [-10.0, -20.0, float(z)],
        "ImageOrientationPatient": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "Rows": pixels.shape[0],
        "Columns": pixels.shape[1],
        "PixelSpacing": [0.5, 0.5],
        "BitsAllocated": bits,
        "BitsStored": bits,
        "HighBit": bits - 1,
        "PixelRepresentation": int(pixels.dtype.kind == "i"),
        "RescaleIntercept": -1024.0,
        "RescaleSlope": 1.0,
        "PixelData": pixels.tobytes(),
    }
    meta = FileMetaDataset()
    values = {keyword: value for keyword, value in {**usual, **elements}.items() if value is not None}
    meta.MediaStorageSOPClassUID = values.get("SOPClassUID", CTImageStorage)
    meta.MediaStorageSOPInstanceUID = values["SOPInstanceUID"]
    meta.TransferSyntaxUID = values.pop("TransferSyntaxUID", ExplicitVRLittleEndian)
    little_endian = meta.TransferSyntaxUID.is_little_endian
    dataset = FileDataset(
        str(path), {}, file_meta=meta, preamble=b"\0" * 128, is_implicit_VR=False, is_little_endian=little_endian
    )
    for keyword, value in values.items():
        setattr(dataset, keyword, value)
    _save(dataset, path)
    return path


def _save(dataset: FileDataset, path: Path) -> None:
    # pydicom 3 renamed the argument.
    if "enforce_file_format" in inspect.signature(dataset.save_as).parameters:
        dataset.save_as(path, enforce_file_format=True)
    else:
        dataset.save_as(path, write_like_original=False)


def write_enhanced_ct(path: Path, frames: ArrayLike, heights: list[float], **elements: Any) -> Path:
    """Write an Enhanced CT image of `frames` (frame, rows, columns), HU = stored - 1024, at heights in mm.

    Spacing [0.7, 0.4] and orientation are shared by the frames, position and rescale are each frame's own.
    elements: of the object itself, as in write_slice.
    """
    pixels = np.asarray(frames, np.uint16)

    def item(**values: Any) -> Dataset:
        one = Dataset()
        for keyword, value in values.items():
            setattr(one, keyword, value)
        return one

    shared = item(
        PixelMeasuresSequence=[item(PixelSpacing=[0.7, 0.4])],
        PlaneOrientationSequence=[item(ImageOrientationPatient=[1.0, 0.0, 0.0, 0.0, 0.8, -0.6])],
    )
    per_frame = [
        item(
            PlanePositionSequence=[item(ImagePositionPatient=[-10.0, -20.0, z])],
            PixelValueTransformationSequence=[item(RescaleSlope=1.0, RescaleIntercept=-1024.0)],
        )
        for z in heights
    ]
    usual: dict[str, Any] = {
        "SOPClassUID": EnhancedCTImageStorage,
        "NumberOfFrames": len(pixels),
        "Rows": pixels.shape[1],
        "Columns": pixels.shape[2],
        "SharedFunctionalGroupsSequence": [shared],
        "PerFrameFunctionalGroupsSequence": per_frame,
        "PixelData": pixels.tobytes(),
        **dict.fromkeys(
            ("PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient", "RescaleSlope", "RescaleIntercept")
        ),
    }
    return write_slice(path, pixels[0], **{**usual, **elements})
