"""What a slice may be and what not, a step on either side of each limit, with no two numbers alike."""

from __future__ import annotations

import itertools
import math
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pydicom
import pytest
from pydicom.uid import MRImageStorage

from stereoreg_ros.dicom import DicomError, read_frames, read_series, read_slice
from stereoreg_ros.dicom.codestream import CodestreamSize, require_rle_size, size_of
from stereoreg_ros.reception.intake import OUT_OF_RESOURCES, Intake, ObjectRefusedError
from stereoreg_ros.reception.kept_objects import KeptObjects
from stereoreg_ros.reception.slice_queue import SliceQueue
from support.dicom_files import write_enhanced_ct, write_slice

IMAGE = np.arange(6 * 8, dtype=np.uint16).reshape(6, 8)
MAX_BYTES = 2**20


def received(path: Path, max_bytes: int = MAX_BYTES) -> list[float]:
    """First pixels of the slices of an object that arrives; DicomError where it is none."""
    return [float(one.ct_slice.hu[0, 0]) for one in read_frames(Path("it"), path.read_bytes(), max_bytes)]


class TestPixels:
    @pytest.mark.parametrize(("value", "limit"), [(0, None), (0, 3), (3, 0), (2, 0)])
    def test_padding_becomes_the_darkest_of_the_others_with_both_ends_of_its_range(
        self, tmp_path: Path, value: int, limit: int | None
    ) -> None:
        path = write_slice(tmp_path / "a.dcm", IMAGE, PixelPaddingValue=value, PixelPaddingRangeLimit=limit)
        padding = max(value, limit or 0) >= IMAGE
        hu = read_slice(path).ct_slice.hu
        assert (hu[padding] == IMAGE[~padding].min() - 1024.0).all()
        np.testing.assert_array_equal(hu[~padding], IMAGE[~padding] - 1024.0)

    @pytest.mark.parametrize("slope", [-1.0, -1e-6])
    def test_a_slope_that_turns_bright_to_dark_is_refused(self, tmp_path: Path, slope: float) -> None:
        path = write_slice(tmp_path / "a.dcm", IMAGE, RescaleSlope=slope)
        with pytest.raises(DicomError, match=r"Rescale Slope \(0028,1053\) is -.*, expected a positive number"):
            read_slice(path)

    @pytest.mark.parametrize("missing", ["RescaleSlope", "RescaleIntercept"])
    def test_one_of_slope_and_intercept_does_not_do(self, tmp_path: Path, missing: str) -> None:
        elements: dict[str, Any] = {missing: None, "SOPClassUID": MRImageStorage}
        with pytest.raises(DicomError, match="is missing, expected a finite number"):
            read_slice(write_slice(tmp_path / "a.dcm", IMAGE, **elements))


class TestAxes:
    @pytest.mark.parametrize("off", [9e-4, 1.1e-3])
    @pytest.mark.parametrize("which", ["length of x", "length of y", "angle"])
    def test_are_unit_vectors_at_a_right_angle_to_a_thousandth(self, tmp_path: Path, which: str, off: float) -> None:
        cosines = {
            "length of x": [0.0, 1.0 + off, 0.0, 0.0, 0.0, -1.0],
            "length of y": [0.0, 1.0, 0.0, 0.0, 0.0, -1.0 - off],
            "angle": [0.0, 1.0, 0.0, 0.0, -off, -math.sqrt(1 - off**2)],
        }[which]
        path = write_slice(tmp_path / "a.dcm", IMAGE, ImageOrientationPatient=cosines)
        if off > 1e-3:
            with pytest.raises(DicomError, match="expected two unit vectors at a right angle"):
                read_slice(path)
            return
        rotation = read_slice(path).ct_slice.scanner_from_slice.rotation
        np.testing.assert_allclose(rotation, [[0, 0, -1], [1, 0, 0], [0, -1, 0]], atol=1e-3)


class TestCompressedSize:
    """What a compressed image says of its size, byte by byte."""

    JPEG_FRAME = struct.pack(">BBHBHHB", 0xFF, 0xC3, 11, 16, 60, 70, 1) + bytes(3)
    JPEG_TABLE = b"\xff\xc4" + struct.pack(">H", 6) + b"\x10\xff\xc0\x00"

    def test_of_jpeg_2000_without_the_offset_of_the_image_and_whatever_its_tiles(self) -> None:
        image = struct.pack(">HH8IH", 41, 0, 100, 80, 30, 20, 64, 48, 5, 6, 1)
        assert size_of(b"\xff\x4f\xff\x51" + image) == CodestreamSize(60, 70, 1)

    @pytest.mark.parametrize(
        "before",
        [b"", JPEG_TABLE, b"\xff\xff\xff", b"\xff\xd0\xff\x01", b"\xff\xcc\x00\x02", b"\xff\xc8\x00\x02"],
        ids=["nothing", "a table with a marker in it", "fill bytes", "markers alone", "arithmetic coding", "reserved"],
    )
    def test_of_jpeg_behind_other_segments(self, before: bytes) -> None:
        assert size_of(b"\xff\xd8" + before + self.JPEG_FRAME) == CodestreamSize(60, 70, 1)

    @pytest.mark.parametrize(
        ("packets", "is_taken"),
        [
            # Beyond twice the pixels and 256 bytes nothing more may come. A run is of 128.
            (b"\x81\x00" * 4, True),
            (b"\x81\x00" * 5, False),
            (bytes([127]) + bytes(128), True),
            (b"\x80" * 511, True),
            (b"\x80" * 512, False),
        ],
        ids=["runs", "too many runs", "as it is", "nothing", "too much nothing"],
    )
    def test_of_an_rle_segment_by_what_it_unpacks_to(self, packets: bytes, is_taken: bool) -> None:
        codestream = struct.pack("<16I", 1, 64, *[0] * 14) + packets
        if is_taken:
            require_rle_size(codestream, 127)
        else:
            with pytest.raises(ValueError, match="unpacks to more than twice the 127 bytes of 127 pixels"):
                require_rle_size(codestream, 127)

    @pytest.mark.parametrize("count", [0, 16])
    def test_of_an_rle_image_with_as_many_segments_as_it_cannot_have(self, count: int) -> None:
        with pytest.raises(ValueError, match=f"has {count} segments, expected 1 to 15"):
            require_rle_size(struct.pack("<16I", count, *[64] * 15), 100)


class TestSeries:
    @pytest.mark.parametrize("spacing", [[0.5, 0.50006], [0.50006, 0.5]])
    def test_has_one_spacing_along_either_side(self, tmp_path: Path, spacing: list[float]) -> None:
        write_slice(tmp_path / "0.dcm", IMAGE, 0.0)
        write_slice(tmp_path / "1.dcm", IMAGE, 1.0, PixelSpacing=spacing)
        with pytest.raises(DicomError, match=r"1\.dcm: Pixel Spacing"):
            read_series(tmp_path)

    def test_is_in_table_order_whatever_the_numbers_of_the_slices(self, tmp_path: Path) -> None:
        """Along the normal of tilted slices, which is not the order of their z alone."""
        cosine, sine = math.cos(math.radians(60)), math.sin(math.radians(60))
        tilted = [1.0, 0.0, 0.0, 0.0, cosine, sine]
        normal = np.array([0.0, -sine, cosine])
        aside = np.array([0.0, cosine, sine])
        for number, (along, across) in enumerate([(3.0, 0.0), (1.0, 40.0), (2.0, -40.0)]):
            position = (along * normal + across * aside).tolist()
            elements = {"ImageOrientationPatient": tilted, "ImagePositionPatient": position, "InstanceNumber": number}
            write_slice(tmp_path / f"{number}.dcm", IMAGE, **elements)
        headers = read_series(tmp_path).headers
        assert [header.instance_number for header in headers] == [1, 2, 0]
        assert [header.table_position_mm for header in headers] == pytest.approx([1.0, 2.0, 3.0])


class TestReceived:
    def test_of_an_enhanced_image_each_frame_has_its_own_pixels_plane_and_rescale(self, tmp_path: Path) -> None:
        path = write_enhanced_ct(tmp_path / "a.dcm", [IMAGE, IMAGE + 100, IMAGE + 200], [5.0, -7.0, 2.0])
        dataset = pydicom.dcmread(path)
        # What a frame says of itself counts, not what all are said to have.
        item = dataset.PerFrameFunctionalGroupsSequence[1]
        item.PixelMeasuresSequence = [pydicom.Dataset()]
        item.PixelMeasuresSequence[0].PixelSpacing = [0.9, 0.3]
        item.PixelValueTransformationSequence[0].RescaleIntercept = -1000.0
        dataset.save_as(path)
        frames = read_frames(Path("it"), path.read_bytes(), MAX_BYTES)
        assert [float(one.ct_slice.hu[0, 0]) for one in frames] == [-1024.0, -900.0, -824.0]
        assert [(one.header.scale.sx, one.header.scale.sy) for one in frames] == [(0.4, 0.7), (0.3, 0.9), (0.4, 0.7)]
        positions = [one.ct_slice.scanner_from_slice.translation.tolist() for one in frames]
        assert positions == [[-10.0, -20.0, 5.0], [-10.0, -20.0, -7.0], [-10.0, -20.0, 2.0]]

    def test_all_frames_together_may_take_as_much_as_is_allowed(self, tmp_path: Path) -> None:
        path = write_enhanced_ct(tmp_path / "a.dcm", [IMAGE, IMAGE, IMAGE], [0.0, 1.0, 2.0])
        size = 3 * 6 * 8 * 2
        assert len(received(path, size)) == 3
        with pytest.raises(DicomError, match=f"its pixels take {size} bytes, expected {size - 1} at most"):
            received(path, size - 1)

    def test_every_frame_of_an_enhanced_ct_says_how_its_values_become_hu(self, tmp_path: Path) -> None:
        path = write_enhanced_ct(tmp_path / "a.dcm", [IMAGE, IMAGE], [5.0, -7.0])
        dataset = pydicom.dcmread(path)
        del dataset.PerFrameFunctionalGroupsSequence[1].PixelValueTransformationSequence
        dataset.save_as(path)
        with pytest.raises(DicomError, match=r"Rescale Slope \(0028,1053\) is missing, expected that of a CT image"):
            received(path)

    def test_it_bears_the_uid_that_it_was_announced_with(self, tmp_path: Path) -> None:
        content = write_slice(tmp_path / "a.dcm", IMAGE, SOPInstanceUID="1.2.3").read_bytes()
        for announced in ("1.2.3", ""):
            assert len(read_frames(Path("it"), content, MAX_BYTES, announced)) == 1
        with pytest.raises(DicomError, match=r"SOP Instance UID .* is '1.2.3', expected 1.2.30, as announced"):
            read_frames(Path("it"), content, MAX_BYTES, "1.2.30")

    @pytest.mark.parametrize("which", ["SharedFunctionalGroupsSequence", "PlaneOrientationSequence"])
    def test_of_a_group_that_stands_there_twice_none_is_taken(self, tmp_path: Path, which: str) -> None:
        path = write_enhanced_ct(tmp_path / "a.dcm", [IMAGE, IMAGE], [5.0, -7.0])
        dataset = pydicom.dcmread(path)
        shared = dataset.SharedFunctionalGroupsSequence
        holder = dataset if which == "SharedFunctionalGroupsSequence" else shared[0]
        holder[which].value.append(holder[which].value[0])
        dataset.save_as(path)
        with pytest.raises(DicomError, match=f"found 2 items in {which}, expected one"):
            received(path)

    @pytest.mark.parametrize("count", [1, 3])
    def test_an_enhanced_image_has_a_group_for_each_frame(self, tmp_path: Path, count: int) -> None:
        frames = [IMAGE, IMAGE + 1, IMAGE + 2][: max(count, 2)]
        path = write_enhanced_ct(tmp_path / "a.dcm", frames, [5.0, -7.0], NumberOfFrames=count)
        with pytest.raises(DicomError, match=rf"found 2 items in \(5200,9230\), expected one for each of {count} fram"):
            received(path)

    def test_what_an_enhanced_image_says_of_itself_outside_its_groups_does_not_count(self, tmp_path: Path) -> None:
        elements = {"PixelSpacing": [0.9, 0.9], "RescaleSlope": 3.0, "RescaleIntercept": 5.0}
        path = write_enhanced_ct(tmp_path / "a.dcm", [IMAGE], [5.0], **elements)
        assert received(path) == [-1024.0]
        dataset = pydicom.dcmread(path)
        del dataset.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence
        dataset.save_as(path)
        with pytest.raises(DicomError, match=r"Pixel Spacing \(0028,0030\) is missing"):
            received(path)


class TestIntake:
    """An object of the very size that is allowed, and one of a byte more; each side of a pixel by itself."""

    def test_of_the_size_that_is_allowed(self, tmp_path: Path) -> None:
        content = write_slice(tmp_path / "a.dcm", IMAGE).read_bytes()
        queue = SliceQueue(10)
        assert Intake(queue, len(content)).take(Path("it"), content) == 1
        with pytest.raises(ObjectRefusedError, match=f"has {len(content)} bytes, expected {len(content) - 1} at most"):
            Intake(queue, len(content) - 1).take(Path("it"), content)
        assert len(queue) == 1

    def test_a_slice_has_arrived_when_it_was_there_not_when_it_was_read(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        clock = itertools.count(100.0)
        monkeypatch.setattr("stereoreg_ros.reception.intake.time", SimpleNamespace(monotonic=lambda: next(clock)))
        queue = SliceQueue(10)
        Intake(queue, MAX_BYTES).take(Path("it"), write_slice(tmp_path / "a.dcm", IMAGE).read_bytes())
        first = queue.first()
        assert first is not None
        assert first.arrival_s == 100.0

    @pytest.mark.parametrize(
        ("spacing", "is_taken"),
        [
            ([0.5, 100.0], True),
            ([100.0, 0.5], True),
            ([0.5, 100.1], False),
            ([100.1, 0.5], False),
            ([0.5, 0.001], True),
            ([0.0009, 0.5], False),
            ([0.5, 0.0009], False),
        ],
    )
    def test_the_spacing_is_one_that_register_node_takes(
        self, tmp_path: Path, spacing: list[float], is_taken: bool
    ) -> None:
        content = write_slice(tmp_path / "a.dcm", IMAGE, PixelSpacing=spacing).read_bytes()
        queue = SliceQueue(10)
        if is_taken:
            Intake(queue, MAX_BYTES).take(Path("it"), content)
        else:
            with pytest.raises(ObjectRefusedError, match=r"Pixel Spacing \(0028,0030\) is .*, expected 0.001 to 100"):
                Intake(queue, MAX_BYTES).take(Path("it"), content)
        assert len(queue) == int(is_taken)

    def test_what_is_to_be_kept_is_kept_before_anybody_gets_it_and_not_given_where_it_cannot_be(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        content = write_slice(tmp_path / "a.dcm", IMAGE, SOPInstanceUID="1.2.3").read_bytes()
        queue = SliceQueue(10)
        folder = tmp_path / "kept"
        kept = KeptObjects(folder)
        with pytest.raises(ObjectRefusedError, match="cannot be kept: No such file or directory") as refused:
            Intake(queue, MAX_BYTES).take(Path("it"), content, "1.2.3", kept)
        assert refused.value.status == OUT_OF_RESOURCES
        assert queue.first() is None
        folder.mkdir()
        real_keep = KeptObjects.keep

        def keep(self: KeptObjects, uid: str, given: bytes) -> Path:
            assert queue.first() is None
            return real_keep(self, uid, given)

        monkeypatch.setattr(KeptObjects, "keep", keep)
        assert Intake(queue, MAX_BYTES).take(Path("it"), content, "1.2.3", kept) == 1
        assert (folder / "1.2.3.dcm").read_bytes() == content
        assert queue.first() is not None

    def test_of_many_frames_every_spacing_is_looked_at(self, tmp_path: Path) -> None:
        path = write_enhanced_ct(tmp_path / "a.dcm", [IMAGE, IMAGE], [5.0, -7.0])
        dataset = pydicom.dcmread(path)
        item = dataset.PerFrameFunctionalGroupsSequence[1]
        item.PixelMeasuresSequence = [pydicom.Dataset()]
        item.PixelMeasuresSequence[0].PixelSpacing = [0.7, 400.0]
        dataset.save_as(path)
        queue = SliceQueue(10)
        with pytest.raises(ObjectRefusedError, match=r"is \[0.7, 400.0\], expected"):
            Intake(queue, MAX_BYTES).take(Path("it"), path.read_bytes())
        assert len(queue) == 0
