"""DICOM slices: pixels in HU, pixel scale, and where the plane lies in the patient axes (LPS, mm)."""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.datadict import dictionary_description, tag_for_keyword
from pydicom.dataset import FileMetaDataset
from pydicom.filereader import read_dataset, read_file_meta_info
from pydicom.filewriter import write_file_meta_info
from pydicom.uid import (
    UID,
    CTImageStorage,
    DeflatedExplicitVRLittleEndian,
    EnhancedCTImageStorage,
    ExplicitVRLittleEndian,
    RLELossless,
)

from stereoreg_ros.codestream import CodestreamSize, require_rle_size, size_of
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation
from stereoreg_ros.geometry.slice import LARGEST_HU, PixelScale, Slice
from stereoreg_ros.multiframe import single_frame, single_frames
from stereoreg_ros.whole_file import read_whole

MAX_SIDE_PX: Final = 8192
# Of a file on the disk. What comes over the network has a bound of its own.
_MAX_INFLATED_BYTES: Final = 2**30

_FOLDER: Final = "a folder"
_NO_LETTERS: Final = "not a DICOM file: found no letters DICM at byte 128"
_AXES_TOLERANCE: Final = 1e-3
_SAME_POSITION_MM: Final = 1e-3
_SAME_SPACING: Final = 1e-4
_MONOCHROME: Final = ("MONOCHROME2", "MONOCHROME1")
_LONGEST_TEXT: Final = 500
# Preamble and letters; then the length of the file meta information, itself an element of twelve bytes.
_META_START: Final = 132
_META_LENGTH: Final = struct.Struct("<8sI")
_META_LENGTH_TAG: Final = b"\x02\x00\x00\x00UL\x04\x00"


class DicomError(ValueError):
    """A DICOM file or folder that cannot be used; the text names it, what was found and what was expected.

    path: the file or folder.
    """

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path


@dataclass(frozen=True, eq=False)
class SliceHeader:
    """What a DICOM image says besides its pixels.

    path: the file. scale: mm/pixel. scanner_from_slice: plane of the slice in patient axes (LPS), mm; has_plane:
    false where the file gives neither position nor orientation, and the pose is the identity.
    rescale_slope, rescale_intercept: HU = stored value * slope + intercept.
    """

    path: Path
    series_uid: str
    instance_number: int | None
    rows: int
    columns: int
    scale: PixelScale
    scanner_from_slice: Pose
    has_plane: bool
    rescale_slope: float
    rescale_intercept: float

    @property
    def table_position_mm(self) -> float:
        """Position of the slice along its normal, mm; 0 without a plane."""
        return float(self.scanner_from_slice.rotation[:, 2] @ self.scanner_from_slice.translation)


@dataclass(frozen=True, eq=False)
class DicomSlice:
    """A DICOM image: its header, and its pixels in HU with scale and plane."""

    header: SliceHeader
    ct_slice: Slice


@dataclass(frozen=True)
class Skipped:
    """A file in a folder that is no DICOM image, and what it is instead."""

    path: Path
    what: str


@dataclass(frozen=True, eq=False)
class DicomSeries:
    """The slices of one series in table order, which is along the normal of the slices.

    headers: of every slice; skipped: what else lies in the folder. Iteration reads the pixels, slice by slice.
    """

    headers: tuple[SliceHeader, ...]
    skipped: tuple[Skipped, ...] = ()

    def __len__(self) -> int:
        return len(self.headers)

    def __iter__(self) -> Iterator[DicomSlice]:
        return (read_slice(header.path) for header in self.headers)


def read_slice(path: str | os.PathLike[str]) -> DicomSlice:
    """Read one DICOM image with its pixels; DicomError where that is not possible."""
    file = Path(path)
    dataset = _read_dataset(file, stop_before_pixels=False)
    header = _read_header(file, dataset)
    return DicomSlice(header, Slice(_read_hu(header, dataset), header.scale, header.scanner_from_slice))


def read_series(path: str | os.PathLike[str], on_fault: Callable[[DicomError], None] | None = None) -> DicomSeries:
    """Read the headers of one series: a DICOM file, or a folder (without its subfolders).

    What is no image (structure sets, plans, files that are not DICOM) is skipped and listed in the result.
    on_fault: called for an image with a fault, which is then left out; by default the fault is raised.
    Raises DicomError for a faulty image, and where the images are not one series of parallel slices.
    """
    folder = Path(path)
    if _not_dicom(folder) != _FOLDER:
        return DicomSeries((_read_header(folder, _read_dataset(folder, stop_before_pixels=True)),))
    headers: list[SliceHeader] = []
    skipped: list[Skipped] = []
    faults = 0
    for file in _listed(folder):
        try:
            what = _not_dicom(file)
            if what is None:
                dataset = _read_dataset(file, stop_before_pixels=True)
                what = _not_image(file, dataset)
                if what is None:
                    headers.append(_read_header(file, dataset))
        except DicomError as fault:
            if on_fault is None:
                raise
            on_fault(fault)
            faults += 1
        else:
            if what is not None:
                skipped.append(Skipped(file, what))
    if not headers and not faults:
        raise DicomError(folder, f"holds no DICOM image among {len(skipped)} entries, expected a DICOM file or folder")
    _require_one_series(folder, headers)
    headers.sort(key=_order)
    _require_distinct(folder, headers)
    return DicomSeries(tuple(headers), tuple(skipped))


def read_frames(name: Path, content: bytes, max_bytes: int, uid: str = "") -> tuple[DicomSlice, ...]:
    """The slices of a DICOM object in memory, in the form of a file: one, or every frame of an Enhanced CT image.

    Meant for what arrives unasked, and stricter than `read_slice`: every slice must say where it lies, CT must say how
    values become HU, and projections (localizers) are no slices. name: stands for the object in errors.
    max_bytes: most that its data or its pixels may take when unpacked. uid: the SOP Instance UID that it was announced
    with; empty: none. Raises DicomError.
    """
    if content[128:_META_START] != b"DICM":
        raise DicomError(name, f"{_NO_LETTERS}, expected a DICOM file")
    dataset = _parse(name, BytesIO(_inflated(name, content, max_bytes)), stop_before_pixels=False)
    if uid and str(_value(name, dataset, "SOPInstanceUID")) != uid:
        raise _fault(name, "SOPInstanceUID", _value(name, dataset, "SOPInstanceUID"), f"{uid}, as announced")
    _require_decoded_size(name, dataset, max_bytes)
    _require_no_projection(name, dataset)
    frames = [dataset]
    if _value(name, dataset, "SOPClassUID") == EnhancedCTImageStorage:
        with _pydicom(name, "the frames of the Enhanced CT image cannot be told apart"):
            frames = single_frames(dataset)
    return tuple(_read_placed(name, frame) for frame in frames)


def _read_placed(name: Path, dataset: pydicom.Dataset) -> DicomSlice:
    header = _read_header(name, dataset)
    if not header.has_plane:
        raise _fault(name, "ImagePositionPatient", None, "the position of the slice")
    is_ct = _value(name, dataset, "SOPClassUID") in (CTImageStorage, EnhancedCTImageStorage)
    if is_ct and _value(name, dataset, "RescaleSlope") is None:
        raise _fault(name, "RescaleSlope", None, "that of a CT image")
    return DicomSlice(header, Slice(_read_hu(header, dataset), header.scale, header.scanner_from_slice))


def _require_codestream_size(header: SliceHeader, dataset: pydicom.Dataset, syntax: UID) -> None:
    """A decoder goes by what the compressed image says, whatever the object says."""
    with _pydicom(header.path, f"{_tag('TransferSyntaxUID')} is {syntax}, expected one of images"):
        if not syntax.is_encapsulated:
            return
    with _pydicom(header.path, f"{_tag('PixelData')} cannot be decoded"):
        codestream = single_frame(dataset)
        if syntax == RLELossless:
            return require_rle_size(codestream, header.rows * header.columns)
        size = size_of(codestream)
    if size != CodestreamSize(header.rows, header.columns, 1):
        raise DicomError(
            header.path,
            f"{_tag('PixelData')} holds an image of {size}, expected {header.rows} rows, "
            f"{header.columns} columns and one component",
        )


def _require_decoded_size(name: Path, dataset: pydicom.Dataset, max_bytes: int) -> None:
    """Before anything is decoded: a small object may claim, and fill, a very large image."""
    rows, columns = (_integer(name, dataset, keyword, 1, MAX_SIDE_PX) for keyword in ("Rows", "Columns"))
    allocated = _integer(name, dataset, "BitsAllocated", 8, 32)
    frames = 1
    if _value(name, dataset, "NumberOfFrames") is not None:
        frames = _integer(name, dataset, "NumberOfFrames", 1, 2**31 - 1)
    size = rows * columns * frames * allocated // 8
    if size > max_bytes:
        raise DicomError(name, f"its pixels take {size} bytes, expected {max_bytes} at most")


def _require_no_projection(name: Path, dataset: pydicom.Dataset) -> None:
    image_type = _value(name, dataset, "ImageType") or ()
    if "LOCALIZER" in image_type:
        raise _fault(name, "ImageType", list(image_type), "a slice")
    volume = _value(name, dataset, "VolumetricProperties")
    if volume not in (None, "VOLUME"):
        raise _fault(name, "VolumetricProperties", volume, "VOLUME")


def _inflated(name: Path, content: bytes, max_bytes: int) -> bytes:
    """The file with its data set as it is without the deflated transfer syntax.

    pydicom itself would inflate without a bound.
    """
    if len(content) < _META_START + _META_LENGTH.size:
        raise DicomError(name, f"is damaged: has {len(content)} bytes, expected a whole DICOM file")
    tag, length = _META_LENGTH.unpack_from(content, _META_START)
    if tag != _META_LENGTH_TAG:
        raise DicomError(name, "is damaged: found no length of the file meta information (0002,0000) at byte 132")
    start = _META_START + _META_LENGTH.size + length
    with _pydicom(name, "is damaged, expected file meta information (group 0002)"):
        meta = FileMetaDataset(read_dataset(BytesIO(content[_META_START:start]), False, True))
        syntax = meta.TransferSyntaxUID
    if syntax != DeflatedExplicitVRLittleEndian:
        return content
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        data = inflater.decompress(content[start:], max_bytes)
    except zlib.error as error:
        raise DicomError(name, f"is damaged: its deflated data cannot be inflated: {error}") from None
    if inflater.unconsumed_tail:
        raise DicomError(name, f"its deflated data inflate to more than {max_bytes} bytes, expected fewer")
    if not inflater.eof:
        raise DicomError(name, "is damaged: its deflated data end too soon")
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    inflated = BytesIO()
    with _pydicom(name, "is damaged, expected file meta information (group 0002)"):
        write_file_meta_info(inflated, meta, enforce_standard=False)  # type: ignore[arg-type]
    return content[:_META_START] + inflated.getvalue() + data


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise DicomError(folder, f"cannot be listed: {error.strerror}") from error


def _not_dicom(file: Path) -> str | None:
    """What the file is if it is no DICOM file, else None; by the four letters that every DICOM file bears."""
    try:
        # Opening a pipe or a device would wait for ever.
        if file.is_dir():
            return _FOLDER
        if not file.exists():
            return "no such file"
        if not file.is_file():
            return "not a regular file"
        with file.open("rb") as stream:
            start = stream.read(132)
    except OSError as error:
        raise DicomError(file, f"cannot be read: {error.strerror}") from error
    return None if start[128:] == b"DICM" else _NO_LETTERS


def _not_image(file: Path, dataset: pydicom.Dataset) -> str | None:
    """The name of the object's class where that is no class of images, else None."""
    uid = _value(file, dataset, "SOPClassUID")
    if uid is None:
        # DICOMDIR and objects of careless writers: they are images where they have rows and columns.
        return None if "Rows" in dataset and "Columns" in dataset else "no image, and no SOP Class UID (0008,0016)"
    with _pydicom(file, f"{_tag('SOPClassUID')} cannot be read"):
        name = UID(str(uid)).name
    known = name != str(uid)
    if "Image Storage" in name or (not known and "Rows" in dataset and "Columns" in dataset):
        return None
    return name


def _read_dataset(file: Path, *, stop_before_pixels: bool) -> pydicom.Dataset:
    what = _not_dicom(file)
    if what is not None:
        raise DicomError(file, f"{what}, expected a DICOM file")
    with _pydicom(file, "is damaged, expected file meta information (group 0002)"):
        deflated = read_file_meta_info(file).get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian
    if not deflated:
        return _parse(file, file, stop_before_pixels=stop_before_pixels)
    try:
        content = read_whole(file, _MAX_INFLATED_BYTES)
    except OSError as error:
        raise DicomError(file, f"cannot be read: {error.strerror}") from error
    return _parse(file, BytesIO(_inflated(file, content, _MAX_INFLATED_BYTES)), stop_before_pixels=stop_before_pixels)


def _parse(file: Path, source: Path | BytesIO, *, stop_before_pixels: bool) -> pydicom.Dataset:
    with _pydicom(file, "is damaged, expected a whole DICOM file"):
        dataset: pydicom.Dataset = pydicom.dcmread(source, stop_before_pixels=stop_before_pixels)
    return dataset


def _read_header(file: Path, dataset: pydicom.Dataset) -> SliceHeader:
    what = _not_image(file, dataset)
    if what is not None:
        raise DicomError(file, f"SOP Class UID (0008,0016) is {what}, expected a class of images")
    _require_one_grey_frame(file, dataset)
    rows, columns = (_integer(file, dataset, keyword, 1, MAX_SIDE_PX) for keyword in ("Rows", "Columns"))
    scanner_from_slice = _read_plane(file, dataset)
    series_uid = _value(file, dataset, "SeriesInstanceUID")
    if series_uid is None:
        raise _fault(file, "SeriesInstanceUID", None, "the UID of the series")
    slope, intercept = _read_rescale(file, dataset)
    number = None
    if _value(file, dataset, "InstanceNumber") is not None:
        number = _integer(file, dataset, "InstanceNumber", -(2**31), 2**31 - 1)
    return SliceHeader(
        path=file,
        series_uid=str(series_uid),
        instance_number=number,
        rows=rows,
        columns=columns,
        scale=_read_scale(file, dataset),
        scanner_from_slice=scanner_from_slice or Pose.identity(),
        has_plane=scanner_from_slice is not None,
        rescale_slope=slope,
        rescale_intercept=intercept,
    )


def _require_one_grey_frame(file: Path, dataset: pydicom.Dataset) -> None:
    _integer(file, dataset, "SamplesPerPixel", 1, 1)
    if _value(file, dataset, "NumberOfFrames") is not None:
        _integer(file, dataset, "NumberOfFrames", 1, 1)
    photometric = _value(file, dataset, "PhotometricInterpretation")
    if photometric not in _MONOCHROME:
        raise _fault(file, "PhotometricInterpretation", photometric, " or ".join(_MONOCHROME))


def _read_scale(file: Path, dataset: pydicom.Dataset) -> PixelScale:
    between_rows, between_columns = _numbers(file, dataset, "PixelSpacing", 2)
    try:
        return PixelScale(sx=between_columns, sy=between_rows)
    except ValueError:
        raise _fault(file, "PixelSpacing", [between_rows, between_columns], "two positive numbers of mm") from None


def _read_plane(file: Path, dataset: pydicom.Dataset) -> Pose | None:
    """scanner_from_slice, or None where the object gives neither position nor orientation."""
    keywords = ("ImagePositionPatient", "ImageOrientationPatient")
    if all(_value(file, dataset, keyword) is None for keyword in keywords):
        return None
    position = np.array(_numbers(file, dataset, "ImagePositionPatient", 3))
    cosines = _numbers(file, dataset, "ImageOrientationPatient", 6)
    x, y = np.array(cosines).reshape(2, 3)
    faults = [abs(np.linalg.norm(x) - 1), abs(np.linalg.norm(y) - 1), abs(x @ y)]
    if max(faults) > _AXES_TOLERANCE:
        raise _fault(file, "ImageOrientationPatient", cosines, "two unit vectors at a right angle")
    return Pose(nearest_rotation(np.column_stack([x, y, np.cross(x, y)])), position)


def _read_rescale(file: Path, dataset: pydicom.Dataset) -> tuple[float, float]:
    """Slope and intercept of HU; 1 and 0 where the object has neither, as in MR."""
    if "ModalityLUTSequence" in dataset:
        raise DicomError(
            file, f"{_tag('ModalityLUTSequence')} is a table, expected {_tag('RescaleSlope')} and intercept"
        )
    keywords = ("RescaleSlope", "RescaleIntercept")
    if all(_value(file, dataset, keyword) is None for keyword in keywords):
        return 1.0, 0.0
    slope, intercept = (_numbers(file, dataset, keyword, 1)[0] for keyword in keywords)
    if slope <= 0:
        raise _fault(file, "RescaleSlope", slope, "a positive number")
    return slope, intercept


def _read_hu(header: SliceHeader, dataset: pydicom.Dataset) -> NDArray[np.float32]:
    file = header.path
    stored = _read_stored(header, dataset)
    hu = stored.astype(np.float64) * header.rescale_slope + header.rescale_intercept
    padding = _padding(file, dataset, stored)
    if padding is not None:
        if padding.all():
            raise DicomError(file, f"every pixel has a {_tag('PixelPaddingValue')}, expected an image")
        # Padding may stand for any HU, also for one above the threshold: it must not look like metal.
        hu[padding] = hu[~padding].min()
    if not np.abs(hu).max() <= LARGEST_HU:
        raise DicomError(file, f"HU reach {np.abs(hu).max():g}, expected {LARGEST_HU:g} at most")
    return hu.astype(np.float32)


def _read_stored(header: SliceHeader, dataset: pydicom.Dataset) -> NDArray[Any]:
    """Stored values (rows, columns), as integers."""
    file = header.path
    allocated = _integer(file, dataset, "BitsAllocated", 8, 32)
    if allocated not in (8, 16, 32):
        raise _fault(file, "BitsAllocated", allocated, "8, 16 or 32")
    bits = _integer(file, dataset, "BitsStored", 1, allocated)
    _integer(file, dataset, "HighBit", bits - 1, bits - 1)
    signed = _integer(file, dataset, "PixelRepresentation", 0, 1) == 1
    expected = header.rows * header.columns * allocated // 8
    expectation = f"{expected} bytes for {header.rows} rows, {header.columns} columns and {allocated} bits a pixel"
    data = _value(file, dataset, "PixelData")
    if not isinstance(data, bytes):
        raise _fault(file, "PixelData", None, expectation)
    if not dataset["PixelData"].is_undefined_length and len(data) < expected:
        raise DicomError(file, f"{_tag('PixelData')} has {len(data)} bytes, expected {expectation}")
    syntax = getattr(getattr(dataset, "file_meta", None), "TransferSyntaxUID", None)
    if syntax is None:
        raise _fault(file, "TransferSyntaxUID", None, "that of the pixel data")
    with _pydicom(file, "Transfer Syntax UID (0002,0010) cannot be read"):
        uid = UID(str(syntax))
        name = uid.name
    _require_codestream_size(header, dataset, uid)
    with _pydicom(
        file,
        f"{_tag('PixelData')} cannot be decoded: {len(data)} bytes in transfer syntax {name} (0002,0010), "
        "expected a whole image in one that can be decoded here",
    ):
        stored = np.asarray(dataset.pixel_array)
    if stored.shape != (header.rows, header.columns):
        raise DicomError(
            file,
            f"{_tag('PixelData')} decodes to an image of shape {stored.shape}, "
            f"expected {(header.rows, header.columns)}",
        )
    return _without_unused_bits(stored, bits, signed)


def _without_unused_bits(stored: NDArray[Any], bits: int, signed: bool) -> NDArray[Any]:
    """Values of `bits` bits: what lies above them (overlays, in old files) removed, the sign carried upwards."""
    unused = 8 * stored.dtype.itemsize - bits
    if unused <= 0:
        return stored
    # Values of a big-endian file keep that order; looked at as other integers, they would be other values.
    stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
    integer = stored.view(np.dtype(f"{'i' if signed else 'u'}{stored.dtype.itemsize}"))
    clean: NDArray[Any] = (integer << unused) >> unused
    return clean


def _padding(file: Path, dataset: pydicom.Dataset, stored: NDArray[Any]) -> NDArray[np.bool_] | None:
    """Which pixels are padding (PixelPaddingValue, with its range limit), or None where none can be."""
    if _value(file, dataset, "PixelPaddingValue") is None:
        return None
    limits = [_padding_value(file, dataset, "PixelPaddingValue")]
    if _value(file, dataset, "PixelPaddingRangeLimit") is not None:
        limits.append(_padding_value(file, dataset, "PixelPaddingRangeLimit"))
    return (stored >= min(limits)) & (stored <= max(limits))


def _padding_value(file: Path, dataset: pydicom.Dataset, keyword: str) -> int:
    value = _integer(file, dataset, keyword, -(2**31), 2**32 - 1)
    bits = int(dataset.BitsStored)
    # Many scanners write the padding of signed pixels as an unsigned number.
    return value - 2**bits if int(dataset.PixelRepresentation) == 1 and value >= 2 ** (bits - 1) else value


def _require_one_series(folder: Path, headers: list[SliceHeader]) -> None:
    counts = Counter(header.series_uid for header in headers)
    if len(counts) > 1:
        series = ", ".join(f"{uid} ({count} slices)" for uid, count in counts.most_common())
        raise DicomError(folder, f"holds {len(counts)} series, expected one (0020,000E): {series}")
    for header in headers:
        first = headers[0]
        if len(headers) > 1 and not header.has_plane:
            raise _fault(header.path, "ImagePositionPatient", None, f"one for each of the {len(headers)} slices")
        turned = header.scanner_from_slice.rotation - first.scanner_from_slice.rotation
        if np.abs(turned).max() > _AXES_TOLERANCE:
            raise _differs(header, first, "ImageOrientationPatient", _axes(header), _axes(first))
        spacing, first_spacing = ((h.scale.sy, h.scale.sx) for h in (header, first))
        if not np.allclose(spacing, first_spacing, rtol=_SAME_SPACING, atol=0.0):
            raise _differs(header, first, "PixelSpacing", np.array(spacing), np.array(first_spacing))


def _axes(header: SliceHeader) -> Array:
    return header.scanner_from_slice.rotation[:, :2].T.ravel()


def _differs(header: SliceHeader, first: SliceHeader, keyword: str, found: Array, expected: Array) -> DicomError:
    return _fault(header.path, keyword, found.tolist(), f"{expected.tolist()} as in {first.path}, of the same series")


def _order(header: SliceHeader) -> tuple[int, int]:
    """Table order; slices taken at one table position, as in CT fluoroscopy, in the order of their numbers."""
    return round(header.table_position_mm / _SAME_POSITION_MM), header.instance_number or 0


def _require_distinct(folder: Path, headers: list[SliceHeader]) -> None:
    for header, following in pairwise(headers):
        if _order(header) == _order(following):
            raise DicomError(
                folder,
                f"{header.path.name} and {following.path.name} lie at the same position, "
                f"{header.table_position_mm:.3f} mm along their normal, and have the same instance number, "
                f"expected them to differ in one (0020,0032; 0020,0013)",
            )


def _tag(keyword: str) -> str:
    tag = tag_for_keyword(keyword) or 0
    return f"{dictionary_description(tag)} ({tag >> 16:04X},{tag & 0xFFFF:04X})"


def _fault(file: Path, keyword: str, found: object, expected: str) -> DicomError:
    state = "is missing" if found is None else f"is {_shortened(repr(found))}"
    return DicomError(file, f"{_tag(keyword)} {state}, expected {expected}")


def _shortened(text: str) -> str:
    """Text that may repeat what an object holds, however long that is."""
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."


@contextmanager
def _pydicom(file: Path, problem: str) -> Iterator[None]:
    """Run pydicom on what may be damaged: no warnings, and nothing raised but a DicomError that says `problem`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        # It raises nearly anything then, struct.error and AttributeError among it.
        except Exception as error:
            cause = _shortened(" ".join(str(error).split())) or type(error).__name__
            raise DicomError(file, f"{problem}: {cause}") from error


def _value(file: Path, dataset: pydicom.Dataset, keyword: str) -> Any:
    """The element's value, or None where it is missing or empty."""
    # Elements are converted when they are asked for, so this is where their faults show.
    with _pydicom(file, f"{_tag(keyword)} cannot be read"):
        value = dataset.get(keyword)
    return None if value is None or value == "" or value == [] else value


def _numbers(file: Path, dataset: pydicom.Dataset, keyword: str, count: int) -> list[float]:
    expected = "a finite number" if count == 1 else f"{count} finite numbers"
    value = _value(file, dataset, keyword)
    if value is None:
        raise _fault(file, keyword, None, expected)
    try:
        numbers = [float(number) for number in np.atleast_1d(np.asarray(value, dtype=np.float64))]
    except (TypeError, ValueError):
        raise _fault(file, keyword, value, expected) from None
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise _fault(file, keyword, numbers if count > 1 else numbers[0], expected)
    return numbers


def _integer(file: Path, dataset: pydicom.Dataset, keyword: str, low: int, high: int) -> int:
    expected = f"{low}" if low == high else f"a whole number from {low} to {high}"
    value = _value(file, dataset, keyword)
    if value is None:
        raise _fault(file, keyword, None, expected)
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        raise _fault(file, keyword, value, expected) from None
    if number != value or not low <= number <= high:
        raise _fault(file, keyword, value, expected)
    return number
