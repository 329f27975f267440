"""Objects that arrive unasked: how much memory they may take, whatever they claim."""

from __future__ import annotations

import contextlib
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom import uid
from pydicom.encaps import encapsulate

from stereoreg_ros.dicom import DicomError, read_frames, read_slice
from stereoreg_ros.dicom import dataset as dicom_dataset
from stereoreg_ros.dicom.codestream import CodestreamSize, size_of
from stereoreg_ros.dicom.multiframe import single_frame
from support.compressed_files import Syntax, convert
from support.dicom_files import write_enhanced_ct, write_slice

MAX_BYTES = 2**20
STORED = (1000 + np.arange(40 * 56).reshape(40, 56) % 777).astype(np.uint16)
JPEG_FAMILY = [
    Syntax(uid.JPEG2000Lossless),
    Syntax(uid.JPEGLSLossless),
    Syntax(uid.JPEGLosslessSV1, maker=("dcmcjpeg", "+e1")),
]


@pytest.mark.parametrize("syntax", JPEG_FAMILY, ids=str)
def test_a_compressed_image_says_its_size(tmp_path, syntax):
    path = convert(write_slice(tmp_path / "a.dcm", STORED), syntax)
    codestream = single_frame(pydicom.dcmread(path))
    assert size_of(codestream) == CodestreamSize(40, 56, 1)
    for length in range(min(len(codestream), 60)):
        with contextlib.suppress(ValueError):
            assert size_of(codestream[:length]) == CodestreamSize(40, 56, 1)


@pytest.mark.parametrize("syntax", JPEG_FAMILY, ids=str)
def test_a_compressed_image_that_claims_to_be_huge_is_not_decoded(tmp_path, syntax):
    path = convert(write_slice(tmp_path / "a.dcm", STORED), syntax)
    dataset = pydicom.dcmread(path)
    codestream = single_frame(dataset)
    if syntax.uid == uid.JPEG2000Lossless:
        old, new = struct.pack(">II", 56, 40), struct.pack(">II", 56, 0x7FFFFFF0)
    else:
        old, new = struct.pack(">HH", 40, 56), struct.pack(">HH", 0xFFF0, 56)
    place = codestream.index(old)
    huge = codestream[:place] + new + codestream[place + len(old) :]
    dataset.PixelData = encapsulate([huge])
    dataset["PixelData"].is_undefined_length = True
    dataset.save_as(path)
    with pytest.raises(DicomError, match=r"holds an image of \d+ rows, 56 columns, .*expected 40 rows, 56 columns"):
        read_frames(Path("huge"), path.read_bytes(), MAX_BYTES)


def test_a_deflated_object_is_inflated_within_bounds():
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID = uid.CTImageStorage
    meta.MediaStorageSOPInstanceUID = uid.generate_uid()
    meta.TransferSyntaxUID = uid.DeflatedExplicitVRLittleEndian
    encoded = pydicom.filebase.DicomBytesIO()
    encoded.is_little_endian, encoded.is_implicit_VR = True, False
    pydicom.filewriter.write_file_meta_info(encoded, meta)
    start = bytes(128) + b"DICM" + encoded.getvalue()
    deflater = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    bomb = b"".join(deflater.compress(bytes(2**20)) for _ in range(512)) + deflater.flush()
    assert len(bomb) < MAX_BYTES
    tracemalloc.start()
    try:
        with pytest.raises(DicomError, match="its deflated data inflate to more than 1048576 bytes"):
            read_frames(Path("bomb"), start + bomb, MAX_BYTES)
        assert tracemalloc.get_traced_memory()[1] < 8 * MAX_BYTES
    finally:
        tracemalloc.stop()
    with pytest.raises(DicomError, match="its deflated data end too soon"):
        read_frames(Path("bomb"), start + bomb[:100], 2**30)
    with pytest.raises(DicomError, match="its deflated data cannot be inflated"):
        read_frames(Path("bomb"), start + b"\xff" * 100, 2**30)


def test_an_rle_image_is_unpacked_within_bounds(tmp_path):
    path = write_slice(tmp_path / "a.dcm", np.zeros((64, 64), np.uint16))
    dataset = pydicom.dcmread(convert(path, Syntax(uid.RLELossless)))
    # Runs of 128 bytes, each in two: 32 times what two bytes a pixel take.
    runs = b"\x81\0" * (64 * 64)
    header = struct.pack("<16I", 2, 64, 64 + len(runs), *[0] * 13)
    dataset.PixelData = encapsulate([header + 2 * runs])
    dataset["PixelData"].is_undefined_length = True
    dataset.save_as(path)
    with pytest.raises(DicomError, match="an RLE segment unpacks to more than twice the 4096 bytes of 4096 pixels"):
        read_frames(Path("bomb"), path.read_bytes(), MAX_BYTES)
    with pytest.raises(DicomError, match="an RLE segment unpacks to more than twice"):
        read_slice(path)


def test_of_a_jpeg_2000_file_the_image_in_its_box_counts(tmp_path):
    path = convert(write_slice(tmp_path / "a.dcm", np.zeros((40, 48), np.uint16)), Syntax(uid.JPEG2000Lossless))
    dataset = pydicom.dcmread(path)
    small = single_frame(dataset)
    place = small.index(b"\xff\x51") + 6
    large = small[:place] + struct.pack(">2I", 60_000, 60_000) + small[place + 8 :]
    # A reader that looks for the first size anywhere would find that of the box in front.
    boxes = b"\0\0\0\x0cjP  \r\n\x87\n" + struct.pack(">I4s", 8 + len(small), b"free") + small
    for inner, outcome in (
        (large, "holds an image of 60000 rows, 60000 columns"),
        (None, "a JPEG 2000 file holds no image"),
    ):
        file = boxes + (struct.pack(">I4s", 8 + len(inner), b"jp2c") + inner if inner else b"")
        dataset.PixelData = encapsulate([file])
        dataset["PixelData"].is_undefined_length = True
        dataset.save_as(path)
        with pytest.raises(DicomError, match=outcome):
            read_frames(Path("hidden"), path.read_bytes(), MAX_BYTES)


def test_files_are_bounded_as_well(tmp_path, monkeypatch):
    monkeypatch.setattr(dicom_dataset, "_MAX_INFLATED_BYTES", 2**16)
    small, large = (write_slice(tmp_path / f"{side}.dcm", np.zeros((side, side), np.uint16)) for side in (64, 256))
    for path in (small, large):
        dataset = pydicom.dcmread(path)
        dataset.file_meta.TransferSyntaxUID = uid.DeflatedExplicitVRLittleEndian
        dataset.save_as(path)
    assert read_slice(small).header.rows == 64
    with pytest.raises(DicomError, match="its deflated data inflate to more than 65536 bytes, expected fewer"):
        read_slice(large)


def test_what_a_refusal_repeats_is_bounded(tmp_path):
    path = write_slice(tmp_path / "a.dcm", STORED, PixelSpacing=["0.5"] * 5000)
    with pytest.raises(DicomError, match=r"Pixel Spacing .* expected 2 finite numbers") as caught:
        read_slice(path)
    assert len(str(caught.value)) < 1000


def test_pixels_that_would_take_too_much_are_not_decoded(tmp_path):
    content = write_slice(tmp_path / "a.dcm", np.zeros((800, 800), np.uint16)).read_bytes()
    with pytest.raises(DicomError, match="its pixels take 1280000 bytes, expected 1048576 at most"):
        read_frames(Path("a"), content, MAX_BYTES)
    assert len(read_frames(Path("a"), content, 2 * MAX_BYTES)) == 1


def test_every_truncation_and_many_flips_are_refused_by_name_or_harmless(tmp_path):
    contents = [
        write_slice(tmp_path / "a.dcm", STORED).read_bytes(),
        write_enhanced_ct(tmp_path / "b.dcm", [STORED, STORED], [0.0, 1.0]).read_bytes(),
        convert(tmp_path / "a.dcm", Syntax(uid.RLELossless)).read_bytes(),
        convert(tmp_path / "a.dcm", Syntax(uid.JPEG2000Lossless)).read_bytes(),
    ]
    rng = np.random.default_rng(11)
    outcomes = {"slices": 0, "refused": 0}
    for content in contents:
        spoilt = [content[:length] for length in range(0, len(content), max(len(content) // 60, 1))]
        for _ in range(150):
            bytes_ = np.frombuffer(content, np.uint8).copy()
            bytes_[rng.integers(0, min(len(content), 2500), rng.integers(1, 6))] = rng.integers(0, 256)
            spoilt.append(bytes_.tobytes())
        for one in spoilt:
            frames = None
            with contextlib.suppress(DicomError):
                frames = read_frames(Path("spoilt"), one, MAX_BYTES)
                assert all(np.isfinite(frame.ct_slice.hu).all() for frame in frames)
            outcomes["slices" if frames else "refused"] += 1
    assert min(outcomes.values()) > 50, outcomes
