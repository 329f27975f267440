"""DICOM files in the transfer syntaxes that scanners use, made from plain ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydicom
import pytest
from pydicom import uid

from stereoreg_ros.reception.transfer_syntaxes import JPEG_LOSSLESS
from support.dicom_clients import run_dcmtk


@dataclass(frozen=True)
class Syntax:
    """A transfer syntax; loss: how far a stored value may be off; maker: a program and option of dcmtk, or none."""

    uid: uid.UID
    loss: int = 0
    maker: tuple[str, ...] = ()

    def __str__(self) -> str:
        return str(self.uid.name).replace(" ", "_")


SYNTAXES = [
    Syntax(uid.ImplicitVRLittleEndian, maker=("dcmconv", "+ti")),
    Syntax(uid.ExplicitVRLittleEndian, maker=("dcmconv", "+te")),
    Syntax(uid.ExplicitVRBigEndian, maker=("dcmconv", "+tb")),
    Syntax(uid.DeflatedExplicitVRLittleEndian, maker=("dcmconv", "+td")),
    Syntax(uid.RLELossless),
    Syntax(uid.JPEGLosslessSV1, maker=("dcmcjpeg", "+e1")),
    Syntax(JPEG_LOSSLESS, maker=("dcmcjpeg", "+el")),
    Syntax(uid.JPEGLSLossless),
    Syntax(uid.JPEG2000Lossless),
    Syntax(uid.JPEGLSNearLossless, loss=2, maker=("dcmcjpls", "+en", "+md", "2")),
    Syntax(uid.JPEGExtended12Bit, loss=40, maker=("dcmcjpeg", "+ee", "+q", "100")),
]


def convert(path: Path, syntax: Syntax) -> Path:
    """The file in another transfer syntax, beside the first; the test is skipped where that cannot be made here."""
    converted = path.with_name(f"{path.stem}-{syntax}.dcm")
    if syntax.maker:
        tool, *options = syntax.maker
        made = run_dcmtk(tool, *options, path, converted)
        assert made.returncode == 0, made.stderr
        return converted
    dataset = pydicom.dcmread(path)
    # pydicom 2 has no such argument, and knows fewer encoders.
    named: dict[str, Any] = {"generate_instance_uid": False} if int(pydicom.__version__.split(".")[0]) >= 3 else {}
    try:
        dataset.compress(syntax.uid, **named)
    except NotImplementedError as error:
        pytest.skip(f"pydicom {pydicom.__version__} cannot write {syntax.uid.name}: {error}")
    dataset.save_as(converted)
    return converted
