"""Frame files."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import numpy as np

from fuzzing.kind import Kind
from fuzzing.mutation import mutate_text
from stereoreg_ros.geometry.frame_file import FrameFileError, frame_text, load_frame, shipped_frames


@functools.cache
def _file() -> Path:
    return Path(tempfile.mkdtemp(prefix="fuzzing-")) / "frame.yaml"


def _attempt(data: bytes) -> None:
    _file().write_bytes(data)
    frame = load_frame(_file())
    for text in (frame.name, *frame.line_names):
        assert text.isprintable()
        assert text.strip()
    assert np.isfinite(frame.directions).all()
    assert np.isfinite(frame.moments).all()
    _file().write_text(frame_text(frame, "written again"), encoding="utf-8")
    try:
        again = load_frame(_file())
    except FrameFileError:
        # Written to a thousandth of a millimetre, a rod may be too short.
        lengths = np.linalg.norm(frame.ends - frame.starts, axis=1)
        assert min(lengths.min(), frame.diameters.min()) < 2e-3
    else:
        assert again.name == frame.name
        assert again.line_names == frame.line_names
        assert np.array_equal(again.tolerances_or(-1.0), frame.tolerances_or(-1.0))
        assert again.orientation_required == frame.orientation_required


def _seeds() -> list[bytes]:
    # Short ones: a large frame says no more, and takes longer.
    shipped = shipped_frames()["cube5"].read_bytes()
    block = (
        b"name: block\nlines:\n  - {name: a, from: [0, 0, 0], to: [0, 0, 9], diameter: 1}\n  - name: b\n"
        b'    from: &from [1e1, -2.5, +3]\n    to: [1, 2, 3]\n    diameter: 0.5\n  - name: "c d"\n'
        b"    from: *from\n    to: [1, -2, 3]\n    diameter: 2\n"
    )
    tolerant = (
        b"name: tolerant\ntolerance_mm: 0.2\norientation_required: true\nlines:\n"
        b"  - {name: a, from: [0, 0, 0], to: [0, 0, 90], diameter: 1}\n"
        b"  - {name: b, from: [40, 0, 0], to: [60, 0, 90], diameter: 1, tolerance_mm: 1e-1}\n"
        b"  - {name: c, from: [0, 40, 0], to: [0, 60, 90], diameter: 1, tolerance_mm: 0}\n"
    )
    return [block, tolerant, shipped]


FRAME = Kind(
    name="frame",
    ending=".yaml",
    attempt=_attempt,
    refusals=(FrameFileError,),
    names=lambda text: text.startswith(str(_file())),
    seeds=_seeds,
    mutate=mutate_text,
)
