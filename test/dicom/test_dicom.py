"""Reading DICOM: what is right comes out right, what is wrong is refused by name."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from pydicom import dcmread
from pydicom.encaps import encapsulate
from pydicom.uid import (
    EnhancedCTImageStorage,
    ExplicitVRBigEndian,
    JPEG2000Lossless,
    MRImageStorage,
    RTStructureSetStorage,
    generate_uid,
)

from stereoreg_ros.dicom import DicomError, read_series, read_slice
from stereoreg_ros.geometry.slice import PixelScale
from support.dicom_files import CATPHAN, SHARED_DATA, real, write_slice

IMAGE = np.arange(6 * 8, dtype=np.uint16).reshape(6, 8)


def test_pixels_become_hu(tmp_path):
    header, ct_slice = _read(write_slice(tmp_path / "a.dcm", IMAGE, RescaleSlope=2.0, RescaleIntercept=-100.5))
    assert ct_slice.hu.dtype == np.float32
    np.testing.assert_array_equal(ct_slice.hu, IMAGE * 2.0 - 100.5)
    assert (header.rescale_slope, header.rescale_intercept) == (2.0, -100.5)
    assert (header.rows, header.columns) == (6, 8)
    assert header.instance_number == 1


def test_spacing_is_between_rows_first(tmp_path):
    _, ct_slice = _read(write_slice(tmp_path / "a.dcm", IMAGE, PixelSpacing=[0.7, 0.4]))
    assert ct_slice.scale == PixelScale(sx=0.4, sy=0.7)


def test_mr_without_rescale_keeps_its_values(tmp_path):
    path = write_slice(tmp_path / "a.dcm", IMAGE, SOPClassUID=MRImageStorage, RescaleSlope=None, RescaleIntercept=None)
    header, ct_slice = _read(path)
    np.testing.assert_array_equal(ct_slice.hu, IMAGE)
    assert (header.rescale_slope, header.rescale_intercept) == (1.0, 0.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint16, np.int16, np.int32])
def test_stored_types(tmp_path, dtype):
    stored = IMAGE.astype(dtype)
    if np.dtype(dtype).kind == "i":
        stored -= 20
    _, ct_slice = _read(write_slice(tmp_path / "a.dcm", stored))
    np.testing.assert_array_equal(ct_slice.hu, stored.astype(float) - 1024)


@pytest.mark.parametrize("signed", [0, 1])
def test_bits_above_the_stored_ones_do_not_count(tmp_path, signed):
    wanted = IMAGE.astype(np.int16) - (20 if signed else 0)
    stored = (wanted.astype(np.uint16) & 0x0FFF) | 0xA000
    path = write_slice(tmp_path / "a.dcm", stored, BitsStored=12, HighBit=11, PixelRepresentation=signed)
    np.testing.assert_array_equal(read_slice(path).ct_slice.hu, wanted - 1024.0)


def test_bits_above_the_stored_ones_do_not_count_in_a_big_endian_file_either(tmp_path):
    stored = (IMAGE | 0xA000).astype(">u2")
    elements = {"TransferSyntaxUID": ExplicitVRBigEndian, "PixelData": stored.tobytes(), "BitsStored": 12}
    path = write_slice(tmp_path / "a.dcm", IMAGE, 0.0, **elements, HighBit=11)
    np.testing.assert_array_equal(read_slice(path).ct_slice.hu, IMAGE - 1024.0)


def test_padding_never_looks_like_metal(tmp_path):
    stored = IMAGE.astype(np.uint16) + 1000
    stored[0], stored[1] = 63536, 63530
    path = write_slice(tmp_path / "a.dcm", stored, PixelPaddingValue=63536)
    hu = read_slice(path).ct_slice.hu
    assert (hu[0] == hu[2:].min()).all()
    assert (hu[1] == 63530 - 1024).all()
    path = write_slice(tmp_path / "b.dcm", stored, PixelPaddingValue=63536, PixelPaddingRangeLimit=63000)
    assert read_slice(path).ct_slice.hu.max() == stored[2:].max() - 1024


@pytest.mark.parametrize(
    ("bits", "written", "padding"),
    [
        # 0x8000, the least of all values, is the usual one; half of the range is no unsigned number yet.
        (16, 0x8000, -32768),
        (16, 0xF830, -2000),
        (16, 2000, 2000),
        (16, 0x7FFF, 32767),
        # Written in 16 bits, with the sign carried upwards or not, whichever of them the pixels use.
        (12, 0xF830, -2000),
        (12, 0x0830, -2000),
        (12, 2000, 2000),
        (8, 0xFFFF, -1),
    ],
)
def test_padding_of_signed_pixels_may_be_written_as_an_unsigned_number(tmp_path, bits, written, padding):
    stored = IMAGE.astype(np.int8 if bits == 8 else np.int16)
    stored[0] = padding
    path = write_slice(tmp_path / "a.dcm", stored, PixelPaddingValue=padding, BitsStored=bits, HighBit=bits - 1)
    # pydicom itself writes a signed number where the pixels are signed.
    content = path.read_bytes()
    start = content.index(b"\x28\x00\x20\x01SS\x02\x00")
    unsigned = b"\x28\x00\x20\x01US\x02\x00" + written.to_bytes(2, "little")
    path.write_bytes(content[:start] + unsigned + content[start + len(unsigned) :])
    assert dcmread(path)["PixelPaddingValue"].value == written
    hu = read_slice(path).ct_slice.hu
    np.testing.assert_array_equal(hu[1:], IMAGE[1:] - 1024.0)
    np.testing.assert_array_equal(hu[0], IMAGE[1:].min() - 1024.0)


def test_padding_that_no_pixel_can_have_darkens_none(tmp_path):
    """Its lowest eight bits are 0x30, which a pixel has."""
    path = write_slice(tmp_path / "a.dcm", IMAGE.astype(np.uint8) + 20, PixelPaddingValue=0xF830)
    np.testing.assert_array_equal(read_slice(path).ct_slice.hu, IMAGE + 20 - 1024.0)


def test_plane_of_an_oblique_slice(tmp_path):
    tilt = math.radians(25)
    x, y = [1.0, 0.0, 0.0], [0.0, math.cos(tilt), -math.sin(tilt)]
    path = write_slice(tmp_path / "a.dcm", IMAGE, ImageOrientationPatient=x + y, ImagePositionPatient=[1.0, 2.0, 3.0])
    header, ct_slice = _read(path)
    pose = ct_slice.scanner_from_slice
    np.testing.assert_allclose(pose.rotation, np.column_stack([x, y, np.cross(x, y)]), atol=1e-9)
    np.testing.assert_allclose(pose @ np.zeros(3), [1.0, 2.0, 3.0])
    assert header.has_plane
    assert header.table_position_mm == pytest.approx(np.cross(x, y) @ [1.0, 2.0, 3.0])


def test_rounded_orientation_is_made_orthonormal(tmp_path):
    path = write_slice(tmp_path / "a.dcm", IMAGE, ImageOrientationPatient=[0.9998, 0.0002, 0.0, -0.0003, 1.0, 0.0])
    rotation = read_slice(path).ct_slice.scanner_from_slice.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-3)


FAULTS = [
    ({"PixelData": None}, r"Pixel Data \(7FE0,0010\) is missing, expected 96 bytes for 6 rows"),
    ({"PixelData": IMAGE.tobytes()[:90]}, r"Pixel Data \(7FE0,0010\) has 90 bytes, expected 96 bytes"),
    ({"PixelSpacing": None}, r"Pixel Spacing \(0028,0030\) is missing, expected 2 finite numbers"),
    ({"PixelSpacing": [0.5, 0.0]}, r"Pixel Spacing \(0028,0030\) is \[0.5, 0.0\], expected two positive"),
    ({"PixelSpacing": [-0.5, 0.5]}, r"Pixel Spacing \(0028,0030\) is \[-0.5, 0.5\], expected two positive"),
    ({"PixelSpacing": 0.5}, r"Pixel Spacing \(0028,0030\) is \[0.5\], expected 2 finite numbers"),
    ({"SamplesPerPixel": 3, "PhotometricInterpretation": "RGB"}, r"Samples per Pixel \(0028,0002\) is 3, expected 1"),
    ({"PhotometricInterpretation": "PALETTE COLOR"}, r"\(0028,0004\) is 'PALETTE COLOR', expected MONOCHROME2"),
    ({"NumberOfFrames": 2}, r"Number of Frames \(0028,0008\) is '?2'?, expected 1"),
    ({"SOPClassUID": EnhancedCTImageStorage, "PixelSpacing": None, "NumberOfFrames": 9}, r"\(0028,0008\) is"),
    ({"SOPClassUID": RTStructureSetStorage}, r"\(0008,0016\) is RT Structure Set Storage, expected a class of images"),
    ({"ImagePositionPatient": None}, r"Image Position \(Patient\) \(0020,0032\) is missing, expected 3"),
    ({"ImageOrientationPatient": None}, r"\(0020,0037\) is missing, expected 6 finite numbers"),
    ({"ImageOrientationPatient": [1, 0, 0, 0.1, 1, 0]}, r"\(0020,0037\) is .*expected two unit vectors at a right"),
    ({"ImageOrientationPatient": [2, 0, 0, 0, 1, 0]}, r"\(0020,0037\) is .*expected two unit vectors at a right"),
    ({"Rows": None}, r"Rows \(0028,0010\) is missing, expected a whole number from 1 to 8192"),
    ({"Columns": 60000}, r"Columns \(0028,0011\) is 60000, expected a whole number from 1 to 8192"),
    ({"RescaleSlope": 0.0}, r"Rescale Slope \(0028,1053\) is 0.0, expected a positive number"),
    ({"RescaleSlope": None}, r"Rescale Slope \(0028,1053\) is missing, expected a finite number"),
    ({"SeriesInstanceUID": None}, r"Series Instance UID \(0020,000E\) is missing"),
    ({"HighBit": 11}, r"High Bit \(0028,0102\) is 11, expected 15"),
    ({"BitsAllocated": 12}, r"Bits Allocated \(0028,0100\) is 12, expected 8, 16 or 32"),
    ({"BitsStored": 17}, r"Bits Stored \(0028,0101\) is 17, expected a whole number from 1 to 16"),
    ({"PixelPaddingValue": 0, "PixelPaddingRangeLimit": 65535}, r"every pixel has a Pixel Padding Value"),
]


@pytest.mark.parametrize(("elements", "message"), FAULTS)
def test_faults_are_named(tmp_path, elements, message):
    path = write_slice(tmp_path / "bad.dcm", IMAGE, **elements)
    with pytest.raises(DicomError, match=message) as caught:
        read_slice(path)
    assert str(caught.value).startswith(str(path))
    assert caught.value.path == path


@pytest.mark.parametrize(("text", "message"), [(b"NaN", "nan"), (b"1E999", "inf"), (b"abc", "abc")])
def test_spacing_that_is_no_number(tmp_path, text, message):
    path = write_slice(tmp_path / "bad.dcm", IMAGE, PixelSpacing=["0.515625", "0.515625"])
    content = path.read_bytes()
    assert content.count(b"0.515625") == 2
    path.write_bytes(content.replace(b"0.515625", text.ljust(8), 1))
    with pytest.raises(DicomError, match=rf"Pixel Spacing \(0028,0030\).*{message}"):
        read_slice(path)


def test_transfer_syntax_that_cannot_be_decoded(tmp_path):
    path = write_slice(tmp_path / "bad.dcm", IMAGE)
    uid = b"1.2.840.10008.1.2.1\0"
    private = b"1.2.840.99999.1.2.1\0"
    path.write_bytes(path.read_bytes().replace(uid, private))
    with pytest.raises(DicomError, match=r"bad.dcm: .*1\.2\.840\.99999\.1\.2\.1"):
        read_slice(path)


def test_garbage_in_compressed_data(tmp_path):
    path = write_slice(
        tmp_path / "bad.dcm", IMAGE, TransferSyntaxUID=JPEG2000Lossless, PixelData=encapsulate([b"abcd"])
    )
    with pytest.raises(DicomError, match=r"cannot be decoded: .*JPEG 2000"):
        read_slice(path)


def test_every_truncation_is_refused_or_harmless(tmp_path):
    content = write_slice(tmp_path / "whole.dcm", IMAGE).read_bytes()
    cut = tmp_path / "cut.dcm"
    for length in [*range(0, len(content), 7), len(content) - 1]:
        cut.write_bytes(content[:length])
        with pytest.raises(DicomError, match=r"cut.dcm: "):
            read_slice(cut)


def test_flipped_bytes_never_raise_anything_else(tmp_path):
    rng = np.random.default_rng(5)
    content = np.frombuffer(write_slice(tmp_path / "whole.dcm", IMAGE).read_bytes(), np.uint8)
    damaged = tmp_path / "damaged.dcm"
    for _ in range(400):
        spoilt = content.copy()
        spoilt[rng.integers(132, len(content), rng.integers(1, 6))] = rng.integers(0, 256)
        damaged.write_bytes(spoilt.tobytes())
        with contextlib.suppress(DicomError):
            assert np.isfinite(read_slice(damaged).ct_slice.hu).all()


def test_what_lacks_the_letters_is_no_dicom_however_long_it_is(tmp_path):
    content = bytearray(write_slice(tmp_path / "a.dcm", IMAGE).read_bytes())
    content[128:132] = b"DICN"
    (tmp_path / "a.dcm").write_bytes(content)
    with pytest.raises(DicomError, match="not a DICOM file: found no letters DICM at byte 128, expected a DICOM file"):
        read_slice(tmp_path / "a.dcm")


def test_no_such_file_and_not_dicom(tmp_path):
    with pytest.raises(DicomError, match=r"nowhere.dcm: no such file"):
        read_slice(tmp_path / "nowhere.dcm")
    note = tmp_path / "note.txt"
    note.write_text("no image")
    for read in (read_slice, read_series):
        with pytest.raises(DicomError, match=r"note.txt: not a DICOM file: found no letters DICM"):
            read(note)
    with pytest.raises(DicomError, match=r"holds no DICOM image among 1 entries"):
        read_series(tmp_path)


def test_folder_is_in_table_order_and_lists_what_it_skips(tmp_path):
    for number, z in enumerate([4.0, -2.5, 1.5]):
        write_slice(tmp_path / f"{number}.dcm", IMAGE + number, z, InstanceNumber=number)
    write_slice(tmp_path / "plan.dcm", IMAGE, SOPClassUID=RTStructureSetStorage, SeriesInstanceUID=generate_uid())
    (tmp_path / "note.txt").write_text("no image")
    (tmp_path / "deeper").mkdir()
    os.mkfifo(tmp_path / "pipe")
    series = read_series(tmp_path)
    assert [header.table_position_mm for header in series.headers] == [-2.5, 1.5, 4.0]
    assert [one.ct_slice.hu[0, 0] for one in series] == [1 - 1024, 2 - 1024, 0 - 1024]
    skipped = {one.path.name: one.what for one in series.skipped}
    assert skipped.pop("note.txt").startswith("not a DICOM file")
    assert skipped == {"plan.dcm": "RT Structure Set Storage", "deeper": "a folder", "pipe": "not a regular file"}


def test_pixels_are_read_one_by_one(tmp_path):
    for number in range(3):
        write_slice(tmp_path / f"{number}.dcm", IMAGE, number)
    series = read_series(tmp_path)
    slices = iter(series)
    next(slices)
    (tmp_path / "2.dcm").unlink()
    next(slices)
    with pytest.raises(DicomError, match=r"2.dcm: no such file"):
        next(slices)


def test_mixed_series_are_refused_with_their_counts(tmp_path):
    other = generate_uid()
    for number in range(3):
        write_slice(tmp_path / f"{number}.dcm", IMAGE, number)
    write_slice(tmp_path / "other.dcm", IMAGE, 7.0, SeriesInstanceUID=other)
    with pytest.raises(DicomError, match=r"holds 2 series, expected one .*\(3 slices\).*\(1 slices\)") as caught:
        read_series(tmp_path)
    assert other in str(caught.value)


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ({"PixelSpacing": [0.5, 0.6]}, r"1.dcm: Pixel Spacing .* is \[0.5, 0.6\], expected \[0.5, 0.5\] as in .*0.dcm"),
        ({"ImageOrientationPatient": [1, 0, 0, 0, 0, -1]}, r"1.dcm: Image Orientation .* as in .*0.dcm"),
        ({"ImagePositionPatient": [0.0, 0.0, 0.0]}, r"0.dcm and 1.dcm lie at the same position"),
    ],
)
def test_slices_that_do_not_belong_together(tmp_path, elements, message):
    write_slice(tmp_path / "0.dcm", IMAGE, 0.0)
    write_slice(tmp_path / "1.dcm", IMAGE, 1.0, **elements)
    with pytest.raises(DicomError, match=message):
        read_series(tmp_path)


def test_faulty_slice_in_a_folder(tmp_path):
    write_slice(tmp_path / "0.dcm", IMAGE, 0.0)
    write_slice(tmp_path / "1.dcm", IMAGE, 1.0, PixelSpacing=None)
    with pytest.raises(DicomError, match=r"1.dcm: Pixel Spacing"):
        read_series(tmp_path)
    faults: list[DicomError] = []
    series = read_series(tmp_path, faults.append)
    assert [header.path.name for header in series.headers] == ["0.dcm"]
    assert [fault.path.name for fault in faults] == ["1.dcm"]


def test_leksell_slice():
    header, ct_slice = _read(real(SHARED_DATA / "leksell_ct" / "slice.dcm"))
    assert ct_slice.hu.shape == (512, 512)
    assert ct_slice.scale == PixelScale(0.625, 0.625)
    assert (ct_slice.hu.min(), ct_slice.hu.max()) == (-2048, 3981)
    assert header.has_plane


def test_zframe_series():
    series = read_series(real(SHARED_DATA / "zframe_mr"))
    assert [header.path.name for header in series.headers] == [f"slice_{number:02}.dcm" for number in range(20)]
    positions = [header.table_position_mm for header in series.headers]
    np.testing.assert_allclose(np.diff(positions), 2.4, atol=1e-4)
    assert max(one.ct_slice.hu.max() for one in series) == 678


def test_catphan_series(tmp_path):
    folder = real(CATPHAN)
    series = read_series(folder)
    assert len(series) == 64
    np.testing.assert_allclose(np.diff([header.table_position_mm for header in series.headers]), 2.5, atol=1e-6)
    first = next(iter(series))
    assert first.ct_slice.hu.min() == -1000
    shutil.copy(series.headers[3].path, tmp_path / "again.dcm")
    shutil.copy(series.headers[3].path, tmp_path / "once.dcm")
    with pytest.raises(DicomError, match=r"again.dcm and once.dcm lie at the same position"):
        read_series(tmp_path)


def _read(path: Path):
    dicom_slice = read_slice(path)
    return dicom_slice.header, dicom_slice.ct_slice


def test_slices_at_one_table_position_come_in_the_order_of_their_numbers(tmp_path):
    """CT fluoroscopy: the table stands still while slice after slice is taken."""
    for name, number in (("a", 3), ("b", 1), ("c", 2)):
        write_slice(tmp_path / f"{name}.dcm", np.zeros((4, 4)), z=5.0, InstanceNumber=number)
    assert [header.instance_number for header in read_series(tmp_path).headers] == [1, 2, 3]
