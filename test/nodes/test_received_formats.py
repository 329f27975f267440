"""What scanners send, in every transfer syntax that can be made here: through the network, to the very pixel."""

from __future__ import annotations

import numpy as np
import pydicom
import pytest
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    MRImageStorage,
    RLELossless,
)

from support.compressed_files import SYNTAXES, Syntax, convert
from support.dicom_clients import send
from support.dicom_files import write_enhanced_ct, write_slice

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.reception import transfer_syntaxes
from stereoreg_ros.reception.transfer_syntaxes import readable
from support.ros_process import RosClient
from support.scanner_nodes import CANNOT_UNDERSTAND, SUCCESS, pixels, receiver

# Smooth with an edge and a little noise, as a slice is: 12 bits, and not so flat that a codec has nothing to do.
V, U = np.mgrid[:40, :56]
STORED = (1000 + 20 * U + 10 * V + 900 * (U > 30) + np.random.default_rng(1).integers(0, 8, U.shape)).astype(np.uint16)


@pytest.fixture(scope="module")
def received():
    with RosClient() as client, receiver(client) as running:
        yield running


def last_image(received, count):
    return pixels(received.wait(count)[-1]).astype(int)


# The encoders here write lossy images of unsigned values only.
VARIANTS = [(syntax, signed) for syntax in SYNTAXES for signed in (False, True) if not (signed and syntax.loss)]


@pytest.mark.parametrize(("syntax", "signed"), VARIANTS, ids=str)
def test_every_transfer_syntax(tmp_path, received, syntax, signed):
    assert syntax.uid in readable()
    stored = STORED.astype(np.int16) - 1500 if signed else STORED
    bits = {} if signed else {"BitsStored": 12, "HighBit": 11}
    path = convert(write_slice(tmp_path / "a.dcm", stored, **bits), syntax)
    assert pydicom.dcmread(path).file_meta.TransferSyntaxUID == syntax.uid
    before = len(received.images)
    assert send(received.port, path)[0].Status == SUCCESS
    off = np.abs(last_image(received, before + 1) - (stored.astype(int) - 1024))
    assert off.max() <= syntax.loss


def test_without_decoders_only_what_is_not_compressed_is_announced(monkeypatch):
    monkeypatch.setattr(transfer_syntaxes, "_has_decoder", lambda syntax: syntax == RLELossless)
    assert set(readable()) == {
        ExplicitVRLittleEndian,
        ImplicitVRLittleEndian,
        DeflatedExplicitVRLittleEndian,
        ExplicitVRBigEndian,
        RLELossless,
    }


def test_mr(tmp_path, received):
    path = write_slice(tmp_path / "a.dcm", STORED, SOPClassUID=MRImageStorage, RescaleSlope=None, RescaleIntercept=None)
    before = len(received.images)
    assert send(received.port, path)[0].Status == SUCCESS
    np.testing.assert_array_equal(last_image(received, before + 1), STORED)


@pytest.mark.parametrize("syntax", [None, RLELossless, JPEG2000Lossless], ids=["plain", "RLE", "JPEG 2000"])
def test_every_frame_of_an_enhanced_ct_image(tmp_path, received, syntax):
    heights = [3.0, 5.5, 1.0, 8.0]
    path = write_enhanced_ct(tmp_path / "a.dcm", [STORED + n for n in range(4)], heights)
    if syntax is not None:
        path = convert(path, Syntax(syntax))
    before = len(received.images)
    assert send(received.port, path)[0].Status == SUCCESS
    images = received.wait(before + 4)[before:]
    for number, (image, pose) in enumerate(zip(images, received.poses[before:], strict=True)):
        np.testing.assert_array_equal(pixels(image), STORED.astype(int) + number - 1024)
        position, turn = pose.pose.position, pose.pose.orientation
        np.testing.assert_allclose(
            [position.x, position.y, position.z], [-0.010, -0.020, 1e-3 * heights[number]], atol=1e-12
        )
        # Turned about x so that y becomes (0, 0.8, -0.6).
        half = np.arctan2(-0.6, 0.8) / 2
        np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], [np.sin(half), 0, 0, np.cos(half)], atol=1e-9)


def enhanced_without(path, *keywords):
    dataset = pydicom.dcmread(path)
    for keyword in keywords:
        for groups in (*dataset.SharedFunctionalGroupsSequence, *dataset.PerFrameFunctionalGroupsSequence):
            if keyword in groups:
                del groups[keyword]
    dataset.save_as(path)


@pytest.mark.parametrize(
    ("keyword", "comment"),
    [
        ("PixelMeasuresSequence", "Pixel Spacing (0028,0030) is missing"),
        ("PlanePositionSequence", "Image Position (Patient) (0020,0032) is missing"),
        ("PlaneOrientationSequence", "Image Orientation (Patient) (0020,0037) is missing"),
        ("PixelValueTransformationSequence", "Rescale Slope (0028,1053) is missing"),
    ],
)
def test_enhanced_ct_image_that_lacks_a_group(tmp_path, received, keyword, comment):
    path = write_enhanced_ct(tmp_path / "a.dcm", [STORED, STORED], [0.0, 1.0])
    enhanced_without(path, keyword)
    (response,) = send(received.port, path)
    assert response.Status == CANNOT_UNDERSTAND
    assert response.ErrorComment.startswith(comment)


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ({"NumberOfFrames": 3}, "the frames of the Enhanced CT image cannot be separated"),
        ({"PixelData": STORED.tobytes()}, "the frames of the Enhanced CT image cannot be separated"),
        ({"VolumetricProperties": "DISTORTED"}, "Volumetric Properties (0008,9206) is 'DISTORTED'"),
        ({"NumberOfFrames": 100_000}, "its pixels take 448000000 bytes"),
    ],
)
def test_enhanced_ct_image_with_a_fault(tmp_path, received, elements, words):
    path = write_enhanced_ct(tmp_path / "a.dcm", [STORED, STORED], [0.0, 1.0], **elements)
    (response,) = send(received.port, path)
    assert response.Status == CANNOT_UNDERSTAND
    assert response.ErrorComment.startswith(words)
