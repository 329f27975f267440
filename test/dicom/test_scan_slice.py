"""What is no slice of a scan is refused whoever reads it, unless the slice's own axes are asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom.uid import (
    UID,
    ComputedRadiographyImageStorage,
    CTImageStorage,
    DigitalXRayImageStorageForPresentation,
    EnhancedCTImageStorage,
    MRImageStorage,
    PositronEmissionTomographyImageStorage,
    SecondaryCaptureImageStorage,
    XRayAngiographicImageStorage,
)

from stereoreg_ros.dicom import DicomError, DicomSlice, read_frames, read_series, read_slice
from stereoreg_ros.geometry.pose import Pose
from support.dicom_files import write_slice

IMAGE = np.arange(6 * 8, dtype=np.uint16).reshape(6, 8)
NO_PLANE: dict[str, Any] = {"ImagePositionPatient": None, "ImageOrientationPatient": None}
NO_RESCALE: dict[str, Any] = {"RescaleSlope": None, "RescaleIntercept": None}
AXIAL = {"ImageType": ["ORIGINAL", "PRIMARY", "AXIAL"]}
OWN_AXES = "or ask for poses in the slice's own axes: --slice-axes of stereoreg, slice_axes of play_dicom_node"
CLASSES = f"expected a class of slices (CT, Enhanced CT, MR or PET): export the original slices, {OWN_AXES}"

REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no plane": (
        NO_PLANE,
        "Image Position (Patient) (0020,0032) is missing, expected the position of the slice: export the original "
        f"slices, {OWN_AXES}",
    ),
    "DX": (
        NO_PLANE | {"SOPClassUID": DigitalXRayImageStorageForPresentation},
        f"SOP Class UID (0008,0016) is Digital X-Ray Image Storage - For Presentation, {CLASSES}",
    ),
    "CR": (
        {"SOPClassUID": ComputedRadiographyImageStorage},
        f"SOP Class UID (0008,0016) is Computed Radiography Image Storage, {CLASSES}",
    ),
    "XA": (
        {"SOPClassUID": XRayAngiographicImageStorage},
        f"SOP Class UID (0008,0016) is X-Ray Angiographic Image Storage, {CLASSES}",
    ),
    "secondary capture": (
        {"SOPClassUID": SecondaryCaptureImageStorage},
        f"SOP Class UID (0008,0016) is Secondary Capture Image Storage, {CLASSES}",
    ),
    "localizer": (
        {"ImageType": ["ORIGINAL", "PRIMARY", "LOCALIZER"]},
        "Image Type (0008,0008) is ['ORIGINAL', 'PRIMARY', 'LOCALIZER'], expected a slice, not a projection: "
        "leave the image out, or export the original slices",
    ),
    "MR projection": (
        {"SOPClassUID": MRImageStorage, "ImageType": ["DERIVED", "SECONDARY", "PROJECTION IMAGE"]},
        "Image Type (0008,0008) is ['DERIVED', 'SECONDARY', 'PROJECTION IMAGE'], expected a slice, not a projection: "
        "leave the image out, or export the original slices",
    ),
    "mixed": (
        {"VolumetricProperties": "MIXED"},
        "Volumetric Properties (0008,9206) is 'MIXED', expected VOLUME, as of a slice: leave the image out, or export "
        "the original slices",
    ),
    "distorted": (
        {"VolumetricProperties": "DISTORTED"},
        "Volumetric Properties (0008,9206) is 'DISTORTED', expected VOLUME, as of a slice: leave the image out, or "
        "export the original slices",
    ),
    "CT without rescale": (
        NO_RESCALE,
        "Rescale Slope (0028,1053) is missing, expected that of a CT image, by which its values become HU: export the "
        "original slices",
    ),
}
TAKEN: dict[str, dict[str, Any]] = {
    "CT": {"SOPClassUID": CTImageStorage} | AXIAL,
    "CT of one type": {"ImageType": "ORIGINAL"},
    "volume": {"VolumetricProperties": "VOLUME"},
    "MR without rescale": {"SOPClassUID": MRImageStorage} | NO_RESCALE,
    "PET": {"SOPClassUID": PositronEmissionTomographyImageStorage},
    # By a writer who knows no better, or knows of a newer class: it says where it lies.
    "no class": {"SOPClassUID": None},
    "an unknown class": {"SOPClassUID": UID("1.2.840.10008.5.1.4.1.1.2.999")},
}


def one(path: Path) -> DicomSlice:
    return read_slice(path)


def of_a_series(path: Path) -> DicomSlice:
    return next(iter(read_series(path)))


def of_a_folder(path: Path) -> DicomSlice:
    return next(iter(read_series(path.parent)))


def received(path: Path) -> DicomSlice:
    (frame,) = read_frames(path, path.read_bytes(), 2**20)
    return frame


@pytest.mark.parametrize("read", [one, of_a_series, of_a_folder, received])
@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_slice_of_a_scan_is_refused_in_the_same_words_whoever_reads_it(
    tmp_path: Path, name: str, read: Any
) -> None:
    elements, sentence = REFUSED[name]
    path = write_slice(tmp_path / "a.dcm", IMAGE, 3.0, **elements)
    with pytest.raises(DicomError) as refused:
        read(path)
    assert str(refused.value) == f"{path}: {sentence}"


@pytest.mark.parametrize("read", [one, of_a_series, of_a_folder, received])
@pytest.mark.parametrize("name", TAKEN)
def test_a_slice_of_a_scan_is_read_with_its_plane(tmp_path: Path, name: str, read: Any) -> None:
    found = read(write_slice(tmp_path / "a.dcm", IMAGE, 3.0, **TAKEN[name]))
    assert found.header.has_plane
    assert found.ct_slice.scanner_from_slice.translation.tolist() == [-10.0, -20.0, 3.0]


@pytest.mark.parametrize("name", [*REFUSED, *TAKEN])
def test_in_its_own_axes_any_image_is_a_slice(tmp_path: Path, name: str) -> None:
    elements = REFUSED[name][0] if name in REFUSED else TAKEN[name]
    path = write_slice(tmp_path / "a.dcm", IMAGE, 3.0, **elements)
    for found in (read_slice(path, slice_axes=True), next(iter(read_series(path, slice_axes=True)))):
        pose = found.ct_slice.scanner_from_slice
        assert not found.header.has_plane
        np.testing.assert_array_equal(pose.rotation, Pose.identity().rotation)
        np.testing.assert_array_equal(pose.translation, np.zeros(3))


@pytest.mark.parametrize("elements", [NO_PLANE, {}])
def test_a_folder_in_the_slices_own_axes_is_in_the_order_of_the_instance_numbers_then_of_the_names(
    tmp_path: Path, elements: dict[str, Any]
) -> None:
    for name, number, z in [("a", 3, 0.0), ("b", 1, 5.0), ("c", 2, 5.0), ("d", 2, 5.0), ("e", None, 9.0)]:
        write_slice(tmp_path / f"{name}.dcm", IMAGE, z, InstanceNumber=number, **elements)
    series = read_series(tmp_path, slice_axes=True)
    assert [header.path.stem for header in series.headers] == ["e", "b", "c", "d", "a"]
    assert [found.header.has_plane for found in series] == [False] * 5


def test_of_several_frames_the_number_counts_before_their_planes(tmp_path: Path) -> None:
    """An Enhanced CT has its planes elsewhere: to ask for its own axes would not help."""
    path = write_slice(tmp_path / "a.dcm", IMAGE, SOPClassUID=EnhancedCTImageStorage, NumberOfFrames=2, **NO_PLANE)
    with pytest.raises(DicomError, match=r"Number of Frames \(0028,0008\) is"):
        read_slice(path)
