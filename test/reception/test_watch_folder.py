"""A folder to which scanners export: what is complete is taken once, and nothing else."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from pydicom.uid import JPEG2000Lossless, JPEGLSLossless, RLELossless

from stereoreg_ros.reception.intake import Intake
from stereoreg_ros.reception.slice_queue import SliceQueue
from stereoreg_ros.reception.watched_folder import WatchedFolder
from support.compressed_files import Syntax, convert
from support.dicom_files import write_slice

IMAGE = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)
MAX_BYTES = 2**20


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "export"
    path.mkdir()
    return path


class Watch:
    """A watched folder that is looked into by hand."""

    def __init__(self, folder: Path, max_slices: int = 100) -> None:
        self.queue = SliceQueue(max_slices)
        self._watched = WatchedFolder(folder, 1.0, MAX_BYTES, Intake(self.queue, MAX_BYTES))

    def look(self) -> list[int]:
        """Look once; what was taken, by the first pixel, which is let go of."""
        self._watched.look()
        taken = []
        while (received := self.queue.first()) is not None:
            taken.append(int(received.dicom_slice.ct_slice.hu[0, 0]) + 1024)
            self.queue.remove_first()
        return taken


def test_a_file_is_taken_when_it_has_stayed_the_same_for_a_look_and_only_once(folder):
    watch = Watch(folder)
    write_slice(folder / "a.dcm", IMAGE + 7)
    assert watch.look() == []
    assert watch.look() == [7]
    assert watch.look() == []


def test_what_was_there_before_is_left_alone_until_it_changes(folder):
    path = write_slice(folder / "a.dcm", IMAGE)
    watch = Watch(folder)
    assert watch.look() == watch.look() == []
    write_slice(path, IMAGE + 5)
    os.utime(path, ns=(1, 1))
    assert watch.look() == []
    assert watch.look() == [5]


def test_a_file_that_grows_is_not_read_before_it_is_whole(folder, tmp_path, caplog):
    content = write_slice(tmp_path / "a.dcm", IMAGE + 3).read_bytes()
    watch = Watch(folder)
    path = folder / "a.dcm"
    for length in range(100, len(content), 100):
        path.write_bytes(content[:length])
        assert watch.look() == []
    assert not caplog.records
    # It rests for a while, and is taken for complete: it is not, and no slice comes of it.
    assert watch.look() == watch.look() == []
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    path.write_bytes(content)
    assert watch.look() == []
    assert watch.look() == [3]


def test_a_file_that_is_renamed_into_place(folder, tmp_path):
    watch = Watch(folder)
    write_slice(folder / ".a.dcm.tmp", IMAGE + 9)
    assert watch.look() == watch.look() == []
    (folder / ".a.dcm.tmp").rename(folder / "a.dcm")
    assert watch.look() + watch.look() == [9]


def test_a_broken_file_is_warned_of_once(folder, caplog):
    watch = Watch(folder)
    write_slice(folder / "broken.dcm", IMAGE, PixelSpacing=None)
    (folder / "note.txt").write_text("no image")
    for _ in range(4):
        assert watch.look() == []
    assert len(caplog.records) == 2
    assert "broken.dcm: Pixel Spacing (0028,0030) is missing" in caplog.text
    assert "note.txt: not a DICOM file" in caplog.text


def test_they_come_in_the_order_of_their_time(folder):
    watch = Watch(folder)
    for name, number in (("b", 1), ("c", 2), ("a", 3)):
        path = write_slice(folder / f"{name}.dcm", IMAGE + number)
        os.utime(path, ns=(number * 10**9, number * 10**9))
    watch.look()
    assert watch.look() == [1, 2, 3]


def test_subfolders_are_looked_into_and_links_are_not(folder, tmp_path, caplog):
    outside = tmp_path / "outside"
    outside.mkdir()
    write_slice(outside / "a.dcm", IMAGE)
    watch = Watch(folder)
    (folder / "patient" / "series").mkdir(parents=True)
    write_slice(folder / "patient" / "series" / "a.dcm", IMAGE + 4)
    (folder / "link").symlink_to(outside)
    (folder / "link.dcm").symlink_to(outside / "a.dcm")
    os.mkfifo(folder / "pipe.dcm")
    watch.look()
    assert watch.look() == [4]
    assert not caplog.records


def test_a_folder_that_becomes_a_link_is_not_followed(folder, tmp_path, caplog):
    """Between the look at a file and its being read."""
    outside = tmp_path / "outside"
    (folder / "series").mkdir()
    path = write_slice(folder / "series" / "a.dcm", IMAGE + 4)
    os.utime(path, ns=(1, 1))
    watch = Watch(folder)
    os.utime(path, ns=(2, 2))
    watch.look()
    walk = os.walk

    def walk_and_exchange(*arguments, **named):
        found = list(walk(*arguments, **named))
        shutil.move(folder / "series", outside)
        (folder / "series").symlink_to(outside)
        return iter(found)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "walk", walk_and_exchange)
        patch.setattr(Path, "lstat", lambda path: os.lstat(outside / path.name if outside.exists() else path))
        assert watch.look() == []
    assert "Not a directory" in caplog.text or "Too many levels of symbolic links" in caplog.text


def test_a_share_that_goes_and_comes_back_brings_nothing_old(folder, tmp_path):
    watch = Watch(folder)
    write_slice(folder / "a.dcm", IMAGE + 1)
    watch.look()
    assert watch.look() == [1]
    away = tmp_path / "away"
    shutil.move(folder, away)
    assert watch.look() == watch.look() == []
    shutil.move(away, folder)
    assert watch.look() == watch.look() == []


def test_no_room_means_later_and_in_order(folder, caplog):
    caplog.set_level(logging.INFO)
    watch = Watch(folder, max_slices=2)
    for number in range(5):
        path = write_slice(folder / f"{number}.dcm", IMAGE + number)
        os.utime(path, ns=(number, number))
    assert watch.look() == []
    assert [watch.look() for _ in range(4)] == [[0, 1], [2, 3], [4], []]
    waits = [record for record in caplog.records if record.message.startswith("has to wait")]
    assert len(waits) == 2


def test_a_large_file_is_not_read(folder, caplog):
    watch = Watch(folder)
    with (folder / "large.dcm").open("wb") as stream:
        stream.truncate(10 * 2**30)
    watch.look()
    assert watch.look() == []
    assert f"large.dcm: has {10 * 2**30} bytes, expected {MAX_BYTES} at most" in caplog.text


@pytest.mark.parametrize("syntax", [RLELossless, JPEG2000Lossless, JPEGLSLossless], ids=lambda one: one.name)
def test_compressed_files_that_are_cut_short_are_never_taken(folder, tmp_path, syntax):
    """A decoder may make an image of half a file, with nothing where its end would be."""
    stored = (1000 + np.arange(64 * 64).reshape(64, 64) % 977).astype(np.uint16)
    content = convert(write_slice(tmp_path / "a.dcm", stored), Syntax(syntax)).read_bytes()
    watch = Watch(folder)
    cut = folder / "a.dcm"
    # The last eight bytes say that the pixels are at an end.
    for length in [*range(len(content) // 2, len(content) - 8, 37), len(content) - 8]:
        cut.write_bytes(content[:length])
        watch.look()
        assert watch.look() == [], f"{length} of {len(content)} bytes"
    cut.write_bytes(content)
    watch.look()
    assert watch.look() == [1000]


def test_a_file_as_large_as_is_allowed_is_taken_and_a_byte_more_is_not(folder, caplog):
    for spare, expected in ((0, 1), (-1, 0)):
        queue = SliceQueue(10)
        name = folder / f"{spare}.dcm"
        size = write_slice(folder.parent / "a.dcm", IMAGE).stat().st_size
        watched = WatchedFolder(folder, 1.0, size + spare, Intake(queue, MAX_BYTES))
        write_slice(name, IMAGE)
        watched.look()
        watched.look()
        assert len(queue) == expected
    assert f"left out {name}: has {size} bytes, expected {size - 1} at most" in caplog.text


def test_a_file_that_is_replaced_as_it_is_opened_is_left_until_it_has_stayed(folder, monkeypatch):
    """Of the same size, but not the one that was seen to be complete."""
    watch = Watch(folder)
    path = write_slice(folder / "a.dcm", IMAGE + 3, SOPInstanceUID="1.2.3")
    real_opened = WatchedFolder._opened
    replaced: list[Path] = []

    def opened(self: WatchedFolder, name: Path) -> int:
        if not replaced:
            before = path.stat()
            replaced.append(write_slice(path, IMAGE + 4, SOPInstanceUID="1.2.3"))
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 10**9))
            assert path.stat().st_size == before.st_size
        return real_opened(self, name)

    monkeypatch.setattr(WatchedFolder, "_opened", opened)
    assert watch.look() == []
    assert watch.look() == []
    assert replaced
    assert watch.look() == []
    assert watch.look() == [4]


def test_folders_that_are_not_finished_are_left_alone(folder):
    watch = Watch(folder)
    for name in (".incoming", "done"):
        (folder / name).mkdir()
        write_slice(folder / name / "a.dcm", IMAGE + len(name))
    assert watch.look() == []
    assert watch.look() == [len("done")]
    # Once it has its name, it is.
    (folder / ".incoming").rename(folder / "incoming")
    assert watch.look() == []
    assert watch.look() == [len(".incoming")]
