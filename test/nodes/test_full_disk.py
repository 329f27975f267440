"""A disk that is really full: a small file system of its own, where this process may mount one."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom
import pytest

from stereoreg_ros.calibration.file import load_calibration, save_calibration
from stereoreg_ros.files.whole_file import write_whole
from support.calibration_records import RECORD
from support.dicom_files import write_slice

_SIZE = 2**20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """An empty disk of one MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={_SIZE}", "tmpfs", str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(disk: Path) -> Path:
    """Take all that is free."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as stream, suppress(OSError):
        while True:
            stream.write(bytes(4096))
    # An empty file has no need of room.
    with pytest.raises(OSError, match="No space left"):
        (disk / "more").write_bytes(b"more")
    (disk / "more").unlink()
    return filler


def test_a_file_stays_whole_and_the_next_can_be_written_once_there_is_room(disk: Path) -> None:
    path = disk / "file"
    write_whole(path, "old")
    filler = fill(disk)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, "new" * 10_000)
    assert path.read_text() == "old"
    assert {one.name for one in disk.iterdir()} == {"file", "filler"}
    filler.unlink()
    write_whole(path, "new")
    assert path.read_text() == "new"


def test_a_calibration_stays_what_it_was(disk: Path) -> None:
    path = disk / "scale.yaml"
    save_calibration(path, RECORD)
    fill(disk)
    with pytest.raises(OSError, match="No space left"):
        save_calibration(path, replace(RECORD, slices=3))
    assert load_calibration(path) == RECORD


def test_slices_are_refused_until_there_is_room_and_none_is_kept_in_part(disk: Path, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not there")
    from support.dicom_clients import send
    from support.ros_process import RosClient
    from support.scanner_nodes import OUT_OF_RESOURCES, SUCCESS, receiver

    # Three of these have room.
    stored = np.arange(400 * 400, dtype=np.uint16).reshape(400, 400)
    paths = [write_slice(tmp_path / f"{z}.dcm", stored + z, float(z)) for z in range(5)]
    with RosClient() as client, receiver(client, keep_folder=str(disk)) as received:
        responses = send(received.port, *paths)
        assert [one.Status for one in responses] == [SUCCESS] * 3 + [OUT_OF_RESOURCES] * 2
        assert responses[-1].ErrorComment == "cannot be kept: No space left on device"
        assert len(list(disk.iterdir())) == 3
        for file, path in zip(sorted(disk.iterdir(), key=lambda one: one.stat().st_mtime_ns), paths[:3], strict=True):
            assert pydicom.dcmread(file).PixelData == pydicom.dcmread(path).PixelData
        next(disk.iterdir()).unlink()
        assert [one.Status for one in send(received.port, paths[3])] == [SUCCESS]
        # What was refused is not published either.
        received.wait(4)
        assert len(received.images) == 4
