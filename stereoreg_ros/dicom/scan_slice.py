"""Whether an image is a slice of a scan: a plane with a stated position in the scanner, and values that map to HU."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pydicom
from pydicom.uid import (
    UID,
    CTImageStorage,
    EnhancedCTImageStorage,
    MRImageStorage,
    PositronEmissionTomographyImageStorage,
)

from stereoreg_ros.dicom.elements import element_fault, element_value, reading, tag_text

_CT: Final = (CTImageStorage, EnhancedCTImageStorage)
_SLICES: Final = (*_CT, MRImageStorage, PositronEmissionTomographyImageStorage)
# Values of Image Type with which classes of slices mark what is no slice (PS3.3 C.8.2.1.1.1 and C.8.3.1.1.1).
_PROJECTIONS: Final = ("LOCALIZER", "PROJECTION IMAGE")
_EXPORT: Final = "export the original slices"
_OWN_AXES: Final = (
    f"{_EXPORT}, or ask for poses in the slice's own axes: --slice-axes of stereoreg, slice_axes of play_dicom_node"
)


def require_scan_slice(file: Path, dataset: pydicom.Dataset) -> None:
    """DicomError where an image is a projection or a secondary capture, has no plane, or is CT without rescale.

    A pose found in such an image would be taken for one in the scanner, which it is not. An object without a class, or
    with one that the DICOM dictionary does not know, is judged by the rest.
    """
    uid = element_value(file, dataset, "SOPClassUID")
    with reading(file, f"{tag_text('SOPClassUID')} cannot be read"):
        name = UID(str(uid)).name
    if uid is not None and uid not in _SLICES and name != str(uid):
        raise element_fault(
            file, "SOPClassUID", name, f"a class of slices (CT, Enhanced CT, MR or PET): {_OWN_AXES}", quoted=False
        )
    image_type = element_value(file, dataset, "ImageType") or ()
    values = [image_type] if isinstance(image_type, str) else list(image_type)
    if any(value in _PROJECTIONS for value in values):
        raise element_fault(file, "ImageType", values, f"a slice, not a projection: leave the image out, or {_EXPORT}")
    volume = element_value(file, dataset, "VolumetricProperties")
    if volume not in (None, "VOLUME"):
        raise element_fault(
            file, "VolumetricProperties", volume, f"VOLUME, as of a slice: leave the image out, or {_EXPORT}"
        )
    plane = ("ImagePositionPatient", "ImageOrientationPatient")
    if all(element_value(file, dataset, keyword) is None for keyword in plane):
        raise element_fault(file, plane[0], None, f"the position of the slice: {_OWN_AXES}")
    rescale = ("RescaleSlope", "RescaleIntercept")
    if uid in _CT and all(element_value(file, dataset, keyword) is None for keyword in rescale):
        raise element_fault(file, rescale[0], None, f"that of a CT image, by which its values become HU: {_EXPORT}")
