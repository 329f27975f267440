"""Objects that are kept: on the disk before they are acknowledged, whatever happens next."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pydicom
import pytest
from pydicom.uid import CTImageStorage, generate_uid

from support.dicom_clients import association, send
from support.dicom_files import write_slice

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.dicom import read_slice
from stereoreg_ros.nodes.scanner.receive_dicom_node import ReceiveDicomNode
from stereoreg_ros.nodes.scanner.reception_parameters import ReceptionSettings
from stereoreg_ros.reception.intake import Intake, ObjectRefusedError
from stereoreg_ros.reception.kept_objects import KeptObjects, is_uid
from stereoreg_ros.reception.slice_queue import SliceQueue
from support.ros_process import RosClient
from support.scanner_nodes import CANNOT_UNDERSTAND, OUT_OF_RESOURCES, SUCCESS, port_of, receiver, receiving_process

IMAGE = np.arange(512 * 512, dtype=np.uint16).reshape(512, 512)


@pytest.fixture
def client():
    with RosClient() as ros:
        yield ros


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "kept"
    path.mkdir()
    return path


def uid_of(path: Path) -> str:
    return str(pydicom.dcmread(path, stop_before_pixels=True).SOPInstanceUID)


def test_what_was_acknowledged_outlives_a_kill(client, tmp_path, folder):
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE + z, float(z)) for z in range(3)]
    with receiving_process(keep_folder=str(folder)) as process:
        port = port_of(process, client)
        with association(port, [(CTImageStorage, pydicom.dcmread(paths[0]).file_meta.TransferSyntaxUID)]) as opened:
            for number, path in enumerate(paths):
                assert opened.send_c_store(pydicom.dcmread(path)).Status == SUCCESS
                assert len(list(folder.iterdir())) == number + 1
            process.kill()
    assert {one.name for one in folder.iterdir()} == {f"{uid_of(path)}.dcm" for path in paths}
    for path in paths:
        kept = read_slice(folder / f"{uid_of(path)}.dcm")
        np.testing.assert_array_equal(kept.ct_slice.hu, read_slice(path).ct_slice.hu)


def test_what_is_refused_is_not_kept(client, tmp_path, folder):
    bad = write_slice(tmp_path / "bad.dcm", IMAGE, PixelSpacing=None)
    with receiver(client, keep_folder=str(folder)) as received:
        assert send(received.port, bad)[0].Status == CANNOT_UNDERSTAND
    assert not list(folder.iterdir())


def test_an_object_that_is_not_what_it_was_announced_as_is_refused_and_not_kept(tmp_path, folder):
    content = write_slice(tmp_path / "a.dcm", IMAGE, SOPInstanceUID="1.2.3").read_bytes()
    queue = SliceQueue(10)
    intake = Intake(queue, 2**20)
    with pytest.raises(
        ObjectRefusedError, match=r"SOP Instance UID \(0008,0018\) is '1.2.3', expected 1.2.4"
    ) as refused:
        intake.take(Path("1.2.4"), content, "1.2.4", KeptObjects(folder))
    assert refused.value.status == CANNOT_UNDERSTAND
    assert not list(folder.iterdir())
    assert len(queue) == 0
    assert intake.take(Path("1.2.3"), content, "1.2.3", KeptObjects(folder)) == 1
    assert [one.name for one in folder.iterdir()] == ["1.2.3.dcm"]


def test_folder_that_is_gone_refuses_until_it_is_back(client, tmp_path, folder):
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    with receiver(client, keep_folder=str(folder)) as received:
        shutil.rmtree(folder)
        (refused,) = send(received.port, path)
        assert refused.Status == OUT_OF_RESOURCES
        assert refused.ErrorComment == "cannot be kept: No such file or directory"
        folder.mkdir()
        assert send(received.port, path)[0].Status == SUCCESS
        received.wait(1)
    assert len(received.images) == 1
    assert [one.name for one in folder.iterdir()] == [f"{uid_of(path)}.dcm"]


def test_folder_that_is_none_refuses(client, tmp_path):
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    (tmp_path / "file").write_text("no folder")
    with receiver(client, keep_folder=str(tmp_path / "file")) as received:
        (refused,) = send(received.port, path)
        assert (refused.Status, refused.ErrorComment) == (OUT_OF_RESOURCES, "cannot be kept: Not a directory")


def test_a_full_disk_leaves_nothing_half_written(folder, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        KeptObjects(folder).keep("1.2.3", b"content")
    assert not list(folder.iterdir())


def test_every_step_is_synced_in_its_turn(folder, monkeypatch):
    steps = []
    real_fsync, real_replace = os.fsync, os.replace

    def fsync(descriptor: int) -> None:
        steps.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        real_fsync(descriptor)

    def replace(path: Path, target: Path) -> None:
        steps.append("rename")
        real_replace(path, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    kept = KeptObjects(folder)
    assert kept.keep("1.2.3", b"content").read_bytes() == b"content"
    assert steps == ["file", "rename", "folder"]
    # The crash may have come between the rename and the folder.
    steps.clear()
    kept.keep("1.2.3", b"content")
    assert steps == ["folder"]


def test_the_same_again_is_kept_once_and_another_of_its_name_beside_it(folder):
    kept = KeptObjects(folder)
    assert kept.keep("1.2.3", b"one").name == "1.2.3.dcm"
    assert kept.keep("1.2.3", b"one").name == "1.2.3.dcm"
    assert kept.keep("1.2.3", b"two").name == "1.2.3_2.dcm"
    assert kept.keep("1.2.3", b"two").name == "1.2.3_2.dcm"
    assert {one.name: one.read_bytes() for one in folder.iterdir()} == {"1.2.3.dcm": b"one", "1.2.3_2.dcm": b"two"}


def test_a_link_in_the_folder_is_not_followed(tmp_path, folder):
    victim = tmp_path / "victim"
    victim.write_bytes(b"one")
    (folder / "1.2.3.dcm").symlink_to(victim)
    assert KeptObjects(folder).keep("1.2.3", b"one").name == "1.2.3_2.dcm"
    assert victim.read_bytes() == b"one"


def test_what_a_crash_left_is_removed_at_the_start(folder):
    (folder / ".1.2.3.dcm.00ff00ff.part").write_bytes(b"half")
    (folder / "1.2.4.dcm").write_bytes(b"whole")
    KeptObjects(folder).remove_unfinished()
    assert [one.name for one in folder.iterdir()] == ["1.2.4.dcm"]


def test_the_receiver_removes_it_before_it_listens(folder):
    (folder / ".1.2.3.dcm.00ff00ff.part").write_bytes(b"half")
    settings = ReceptionSettings(port=0, keep_folder=str(folder))
    node: Any = SimpleNamespace()
    service = ReceiveDicomNode._listen(node, settings, Intake(SliceQueue(1), 2**20))
    service._server.server_close()
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "uid", ["", ".", "..", "../1.2", "1.2/3", "1..2", "1.2.", "1" * 65, "1.2\n", "1.2\0", "a.b", "\u0661.\u0662"]
)
def test_only_a_uid_makes_a_file_name(folder, uid):
    assert not is_uid(uid)
    with pytest.raises(ValueError, match="SOP Instance UID is"):
        KeptObjects(folder).keep(uid, b"content")
    assert not list(folder.iterdir())


def test_real_uids_are_uids():
    assert is_uid(generate_uid())
    assert is_uid("1.2.840.10008.5.1.4.1.1.2")
