"""Compressed images are decoded by a process that may hang or die without taking the reader with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from io import BytesIO
from pathlib import Path

import numpy as np
import pydicom
import pytest

pytest.importorskip("jpeg_ls", reason="pylibjpeg's JPEG-LS decoder is not there")

from stereoreg_ros.dicom import DicomError, decoding, read_slice
from stereoreg_ros.dicom.decoding import _decoders

CORPUS = Path(__file__).parents[1] / "corpus" / "dicom"
WHOLE = CORPUS / "valid-jpeg-ls_lossless_image_compression.dcm"
# Some of its pixel data stand twice: over that, CharLS 2 counts for ten seconds or so.
ENDLESS = CORPUS / "816aeaad279b.dcm"
DEADLINE_S = 20.0
READER = f"""
import os, sys, time
from stereoreg_ros.dicom import read_slice
from stereoreg_ros.dicom.decoding import _decoders
read_slice({str(WHOLE)!r})
print(_decoders[os.getpid()]._process.pid, flush=True)
if sys.argv[1:]:
    time.sleep(60)
"""


def is_there(pid: int) -> bool:
    """Whether the process runs; one that has ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def assert_ends(pid: int) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while is_there(pid):
        assert time.monotonic() < deadline_s, "the decoder outlives its user"
        time.sleep(0.02)


def decoder_pid() -> int:
    read_slice(WHOLE)
    return _decoders[os.getpid()]._process.pid


def test_values_are_those_that_pydicom_decodes():
    dataset = pydicom.dcmread(WHOLE)
    expected = dataset.pixel_array * float(dataset.RescaleSlope) + float(dataset.RescaleIntercept)
    np.testing.assert_array_equal(read_slice(WHOLE).ct_slice.hu, expected.astype(np.float32))


def test_an_image_over_which_the_decoder_hangs_is_refused_and_the_next_is_read():
    before = decoder_pid()
    with pytest.raises(DicomError, match=r"Pixel Data .* cannot be decoded: .* the decoder took more than 1\.5 s"):
        read_slice(ENDLESS)
    assert_ends(before)
    assert decoder_pid() != before


def test_a_decoder_that_dies_over_an_image_is_told_and_the_next_image_is_read(tmp_path, monkeypatch):
    before = decoder_pid()
    mortal = tmp_path / "mortal.py"
    mortal.write_text("import os; os.write(1, bytes(8)); os.read(0, 1); os.abort()")
    monkeypatch.setattr(decoding, "_PROGRAM", mortal)
    os.kill(before, signal.SIGKILL)
    with pytest.raises(DicomError, match="the decoder's process ended with status -6"):
        read_slice(WHOLE)
    monkeypatch.undo()
    assert decoder_pid() != before


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_an_image_is_not_blamed_for_another_end_of_the_decoder(seconds: float):
    before = decoder_pid()
    killer = threading.Timer(seconds, os.kill, (before, signal.SIGKILL))
    killer.start()
    with pytest.raises(DicomError, match="the decoder took more than"):
        read_slice(ENDLESS)
    killer.join()
    assert decoder_pid() != before


@pytest.mark.parametrize(("rows", "columns"), [(300, 200), (8192, 8192)])
def test_an_image_has_the_more_time_the_more_pixels_it_has(monkeypatch, rows: int, columns: int):
    asked: list[float] = []

    class Refusing:
        def ask(self, _messages: tuple[bytes, ...], limit_s: float) -> bytes:
            asked.append(limit_s)
            return b"eno image"

    monkeypatch.setattr(decoding, "_decoder", Refusing)
    dataset = pydicom.dcmread(WHOLE)
    dataset.Rows, dataset.Columns = rows, columns
    with pytest.raises(decoding.DecodingError, match=r"^no image$"):
        decoding.decoded(dataset)
    assert asked == [pytest.approx(1.5 + 1e-6 * rows * columns)]


def test_what_a_decoder_prints_does_not_come_between_the_answers():
    program = f"""
import os, runpy, sys
sys.argv[0] = {str(decoding._PROGRAM)!r}
import pydicom.dataset
pydicom.dataset.Dataset.pixel_array = property(lambda self: (print("noise", flush=True), os.write(1, b"noise"), [7])[2])
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    elements = b'{"TransferSyntaxUID": "1.2.840.10008.1.2.5", "undefined_length": true, "Rows": 1}'
    messages = b"".join(len(one).to_bytes(8, "big") + one for one in (elements, b"pixels"))
    done = subprocess.run([sys.executable, "-c", program], input=messages, capture_output=True, timeout=60, check=True)
    assert done.stdout[:8] == bytes(8)
    length = int.from_bytes(done.stdout[8:16], "big")
    assert len(done.stdout) == 16 + length
    assert done.stdout[16:17] == b"a"
    assert np.load(BytesIO(done.stdout[17:])).tolist() == [7]


@pytest.mark.parametrize("kill", [False, True])
def test_the_decoder_ends_with_the_process_that_started_it(kill: bool):
    command = [sys.executable, "-W", "error", "-c", READER, *(["wait"] if kill else [])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stderr is not None
        pid = int(reader.stdout.readline())
        if kill:
            reader.kill()
        assert reader.wait(DEADLINE_S) == (-signal.SIGKILL if kill else 0)
        assert reader.stderr.read() == ""
    assert_ends(pid)
