"""Storage over DICOM's network, in this process: associations one beside the other, objects one after the other."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros.dicom import read_slice
from stereoreg_ros.files.whole_file import write_whole
from stereoreg_ros.reception.bounded_socket import Limits
from stereoreg_ros.reception.intake import Intake
from stereoreg_ros.reception.kept_objects import KeptObjects
from stereoreg_ros.reception.slice_queue import SliceQueue
from stereoreg_ros.reception.storage_service import Endpoint, StorageService
from support.dicom_clients import association, echo, send
from support.dicom_files import write_slice

SUCCESS, CANNOT_UNDERSTAND = 0x0000, 0xC000
MAX_OBJECT_BYTES = 2**20
PATIENCE_S = 60.0
IMAGE = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)
# Two of them and their headers are more than one object may have.
LARGE: NDArray[np.uint16] = np.zeros((512, 520), np.uint16)


@contextmanager
def service(
    limits: Limits, queue: SliceQueue, kept: KeptObjects | None = None, callers: tuple[str, ...] = ()
) -> Iterator[StorageService]:
    """A receiver that is running."""
    intake = Intake(queue, limits.max_object_bytes)
    one = StorageService(Endpoint("127.0.0.1", 0, "STEREOREG", callers), limits, intake, kept)
    one.start()
    try:
        yield one
    finally:
        one.stop()


@contextmanager
def storage(
    queue: SliceQueue, kept: KeptObjects | None = None, callers: tuple[str, ...] = (), max_associations: int = 4
) -> Iterator[int]:
    """A running receiver that takes objects of a mebibyte; its port."""
    with service(Limits(MAX_OBJECT_BYTES, max_associations, PATIENCE_S, PATIENCE_S), queue, kept, callers) as one:
        yield one.port


def test_one_after_the_other_in_an_association_each_object_may_be_as_large_as_is_allowed(tmp_path: Path) -> None:
    queue = SliceQueue(10)
    paths = [write_slice(tmp_path / f"{number}.dcm", LARGE + number) for number in range(5)]
    with storage(queue) as port:
        assert [one.Status for one in send(port, *paths)] == [SUCCESS] * 5
    assert len(queue) == 5


def test_an_object_nearly_as_large_as_is_allowed_arrives_with_all_that_is_sent_around_it(tmp_path: Path) -> None:
    """Its command, and twelve bytes for every sixteen thousand."""
    rows = 64
    small = write_slice(tmp_path / "small.dcm", np.zeros((rows, 1), np.uint16)).stat().st_size
    columns = (MAX_OBJECT_BYTES - 200 - small) // (2 * rows) + 1
    path = write_slice(tmp_path / "a.dcm", np.zeros((rows, columns), np.uint16))
    assert MAX_OBJECT_BYTES - 400 < path.stat().st_size <= MAX_OBJECT_BYTES - 200
    with storage(SliceQueue(10)) as port:
        assert send(port, path)[0].Status == SUCCESS


def test_only_who_may_call_and_calls_it_by_its_name_is_served() -> None:
    with storage(SliceQueue(10), callers=("CT1", "CT2")) as port:
        assert echo(port, caller="CT1") == echo(port, caller="CT2") == SUCCESS
        for caller, called in (("CT3", "STEREOREG"), ("CT1", "ANY-SCP")):
            with association(port, caller=caller, called=called) as opened:
                assert opened.is_rejected


def test_as_many_associations_as_are_allowed_and_no_more_until_one_has_ended() -> None:
    with (
        storage(SliceQueue(10), max_associations=2) as port,
        association(port) as first,
        association(port) as second,
    ):
        assert first.is_established
        assert second.is_established
        with association(port) as third:
            assert third.is_rejected
        assert second.send_c_echo().Status == SUCCESS
        first.release()
        # Its end is noticed a moment later: on a busy machine, after any number of tries.
        end_s = time.monotonic() + PATIENCE_S
        while (status := echo(port)) is None and time.monotonic() < end_s:
            pass
        assert status == SUCCESS


def test_what_was_announced_as_another_object_or_as_none_is_refused_and_not_kept(tmp_path: Path) -> None:
    """As by a client that does not check what it announces."""
    folder = tmp_path / "kept"
    folder.mkdir()
    queue = SliceQueue(10)
    content = write_slice(tmp_path / "a.dcm", IMAGE, SOPInstanceUID="1.2.3").read_bytes()
    with service(Limits(MAX_OBJECT_BYTES, 1, PATIENCE_S, PATIENCE_S), queue, KeptObjects(folder)) as storing:

        def store(announced: str) -> Any:
            requestor = SimpleNamespace(primitive=None, address="here")
            event: Any = SimpleNamespace(
                request=SimpleNamespace(AffectedSOPInstanceUID=announced),
                assoc=SimpleNamespace(requestor=requestor),
                encoded_dataset=lambda: content,
            )
            return storing._store(event)

        refused = store("1.2.4")
        assert (refused.Status, refused.ErrorComment[:40]) == (
            CANNOT_UNDERSTAND,
            "SOP Instance UID (0008,0018) is '1.2.3',",
        )
        refused = store("../1.2.3")
        assert (refused.Status, refused.ErrorComment) == (CANNOT_UNDERSTAND, "SOP Instance UID '../1.2.3' is no UID")
        assert list(folder.iterdir()) == []
        assert store("1.2.3") == SUCCESS
    assert [one.name for one in folder.iterdir()] == ["1.2.3.dcm"]
    assert len(queue) == 1


def test_each_time_limit_is_for_what_it_is_called() -> None:
    limits = Limits(MAX_OBJECT_BYTES, 4, association_timeout_s=3.0, network_timeout_s=7.0)
    with service(limits, SliceQueue(1)) as storing:
        entity = storing._entity
        assert (entity.acse_timeout, entity.network_timeout, entity.dimse_timeout) == (3.0, 7.0, 7.0)


class WatchedLock:
    """A lock that tells when somebody has to wait for it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.somebody_waits = threading.Event()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            self.somebody_waits.set()
            self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def test_of_two_associations_that_store_one_uid_at_once_neither_overwrites_what_the_other_has_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both find no file of that name; what was acknowledged first must not be gone when the second is renamed."""
    folder = tmp_path / "kept"
    folder.mkdir()
    paths = [write_slice(tmp_path / f"{value}.dcm", IMAGE + value, SOPInstanceUID="1.2.3") for value in (1, 2)]
    lock = WatchedLock()
    with monkeypatch.context() as patched:
        patched.setattr(threading, "Lock", lambda: lock)
        kept = KeptObjects(folder)
    writing = threading.Semaphore(0)

    def write(file: Path, content: bytes) -> None:
        # The first to write goes on once the second is there too: it waits for the lock, or writes as well.
        if writing.acquire(blocking=False):
            lock.somebody_waits.set()
        else:
            writing.release()
        assert lock.somebody_waits.wait(PATIENCE_S)
        write_whole(file, content)

    monkeypatch.setattr("stereoreg_ros.reception.kept_objects.write_whole", write)
    with storage(SliceQueue(10), kept) as port, ThreadPoolExecutor(2) as clients:
        responses = list(clients.map(lambda path: send(port, path)[0].Status, paths))
    assert responses == [SUCCESS, SUCCESS]
    assert {one.name for one in folder.iterdir()} == {"1.2.3.dcm", "1.2.3_2.dcm"}
    assert {int(read_slice(one).ct_slice.hu[0, 0]) + 1024 for one in folder.iterdir()} == {1, 2}
