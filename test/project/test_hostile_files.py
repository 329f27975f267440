"""Hostile files, by hypothesis: each is read, or refused by its reader's own error, which names it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stereoreg_ros.calibration.file import CalibrationFileError, load_calibration
from stereoreg_ros.dicom import DicomError, read_frames
from stereoreg_ros.dicom.codestream import require_rle_size, size_of
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.registration import register_spots
from stereoreg_ros.result import REASONS
from support.calibration_records import content as calibration_content
from support.dicom_files import write_slice

QUICK = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-(10**300), 10**300),
    st.floats(),
    st.text(max_size=20),
    st.dates(),
    st.binary(max_size=8),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=8,
)
RODS = [
    {"name": name, "from": [x, y, -20.0], "to": [y, -x, 20.0], "diameter": 1.0}
    for name, x, y in (("a", 0, 10), ("b", 10, 3), ("c", -8, -9), ("d", 20, -4))
]


def told_of(path: Path, error: ValueError) -> None:
    text = str(error)
    assert text.startswith(str(path))
    assert len(text) < 2000
    text.encode()


@QUICK
@given(content=st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)))
def test_any_bytes_are_no_frame_and_no_calibration(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "any.yaml"
    path.write_bytes(content)
    with pytest.raises(FrameFileError) as of_frame:
        load_frame(path)
    told_of(path, of_frame.value)
    with pytest.raises(CalibrationFileError) as of_calibration:
        load_calibration(path)
    told_of(path, of_calibration.value)


@QUICK
@given(data=st.data())
def test_any_value_in_a_place_of_a_frame(tmp_path: Path, data: st.DataObject) -> None:
    rods: list[dict[str, Any]] = [dict(rod) for rod in RODS]
    root: dict[str, Any] = {"name": "block", "tolerance_mm": 0.2, "orientation_required": False, "lines": rods}
    rods[1]["tolerance_mm"] = 0.1
    target = data.draw(st.sampled_from([root, rods[1]]))
    target[data.draw(st.sampled_from(sorted(target)))] = data.draw(VALUES)
    path = tmp_path / "frame.yaml"
    path.write_text(yaml.safe_dump(root), encoding="utf-8")
    try:
        frame = load_frame(path)
    except FrameFileError as error:
        told_of(path, error)
    else:
        assert np.isfinite(frame.moments).all()
        assert np.isfinite(frame.tolerances_or(0.2)).all()
        assert all(name.isprintable() for name in (frame.name, *frame.line_names))


@QUICK
@given(data=st.data())
def test_any_value_in_a_place_of_a_calibration(tmp_path: Path, data: st.DataObject) -> None:
    content = calibration_content()
    content[data.draw(st.sampled_from(sorted(content)))] = data.draw(VALUES)
    path = tmp_path / "scale.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    try:
        record = load_calibration(path)
    except CalibrationFileError as error:
        told_of(path, error)
    else:
        assert record is not None
        assert 0.25 <= record.scale.sx <= 1.0
        assert np.isfinite(record.covariance).all()


COORDINATES = st.one_of(st.sampled_from([0.0, 1.0, -20.0, 20.0, 1e5, -1e5, 1e-3]), st.floats(-40, 40))
ENDS = st.lists(st.tuples(COORDINATES, COORDINATES, COORDINATES), min_size=8, max_size=8)


@settings(max_examples=25, deadline=None)
@given(ends=ENDS, seed=st.integers(0, 1000))
def test_any_frame_that_can_be_had_is_registered_or_refused(ends: list[tuple[float, ...]], seed: int) -> None:
    """Parallel rods, rods in one plane, rods of a kilometre: none makes the search fail."""
    starts, stops = np.array(ends[:4]), np.array(ends[4:])
    stops[np.linalg.norm(stops - starts, axis=1) < 1e-6] += 1.0
    frame = Frame("any", ("a", "b", "c", "d"), starts, stops, np.ones(4))
    spots = np.random.default_rng(seed).uniform(0, 200, (6, 2))
    # Numbers that are none, of rods that meet or are a hundred metres away, may come up, but must not get out.
    with np.errstate(all="ignore"):
        result = register_spots(spots, frame, PixelScale(0.5, 0.5), slice_area_mm2=1e4)
    if result:
        assert np.isfinite(result.covariance).all()
    else:
        assert result.reason in REASONS


@QUICK
@given(start=st.sampled_from([b"", b"\xff\xd8", b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP  \r\n\x87\n"]), rest=st.binary())
def test_any_codestream_says_its_size_or_is_refused(start: bytes, rest: bytes) -> None:
    for call, word in ((lambda: size_of(start + rest), "JPEG"), (lambda: require_rle_size(rest, 64), "RLE")):
        told = word
        try:
            call()
        except ValueError as error:
            told = str(error)
        assert word in told


@QUICK
@given(data=st.data())
def test_any_value_in_an_element_of_a_dicom_object(tmp_path: Path, data: st.DataObject) -> None:
    numbers = st.integers(0, 65535)
    texts = st.one_of(st.just(None), st.sampled_from(["", "RGB", "MONOCHROME1"]))
    decimals = st.one_of(st.just(None), st.lists(st.sampled_from([0.0, -1.0, 1.0, 0.5, 1e15, -1e-15]), max_size=7))
    elements: dict[str, Any] = data.draw(
        st.fixed_dictionaries(
            {},
            optional={
                **dict.fromkeys(
                    ("Rows", "Columns", "BitsAllocated", "BitsStored", "HighBit", "SamplesPerPixel"), numbers
                ),
                **dict.fromkeys(("PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient"), decimals),
                "PhotometricInterpretation": texts,
                "PixelRepresentation": numbers,
                "PixelData": st.one_of(
                    st.just(None), st.binary(max_size=40).map(lambda raw: raw + b"\0" * (len(raw) % 2))
                ),
            },
        )
    )
    path = write_slice(tmp_path / "a.dcm", np.arange(20, dtype=np.uint16).reshape(4, 5), **elements)
    try:
        (frame,) = read_frames(path, path.read_bytes(), 2**18)
    except DicomError as error:
        told_of(path, error)
    else:
        assert np.isfinite(frame.ct_slice.hu).all()
        assert frame.ct_slice.hu.shape == (frame.header.rows, frame.header.columns)


def test_no_link_is_followed_where_objects_are_kept(tmp_path: Path) -> None:
    """The name of a kept file comes from outside; whatever lies under it already is left as it is."""
    from stereoreg_ros.reception.kept_objects import KeptObjects

    folder, outside = tmp_path / "kept", tmp_path / "outside"
    folder.mkdir()
    outside.write_bytes(b"not mine")
    os.symlink(outside, folder / "1.2.dcm")
    os.symlink(tmp_path / "nowhere", folder / "1.2_2.dcm")
    assert KeptObjects(folder).keep("1.2", b"object") == folder / "1.2_3.dcm"
    assert outside.read_bytes() == b"not mine"
    assert not (tmp_path / "nowhere").exists()
