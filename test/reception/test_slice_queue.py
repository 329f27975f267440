"""Slices that wait: in order, bounded, and none in between kept or lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereoreg_ros.dicom import read_slice
from stereoreg_ros.reception import slice_queue
from stereoreg_ros.reception.slice_queue import QueueFullError, ReceivedSlice, SliceQueue
from support.dicom_files import write_slice

PIXELS = np.zeros((16, 16), np.uint16)


@pytest.fixture
def slices(tmp_path: Path) -> list[ReceivedSlice]:
    path = write_slice(tmp_path / "a.dcm", PIXELS)
    return [ReceivedSlice(read_slice(path), float(number)) for number in range(6)]


def put(queue: SliceQueue, slices: list[ReceivedSlice]) -> None:
    with queue.room_for(slices):
        pass


def test_first_in_first_out(slices):
    queue = SliceQueue(10)
    assert queue.first() is None
    put(queue, slices[:2])
    put(queue, slices[2:3])
    for expected in slices[:3]:
        assert queue.first() is queue.first() is expected
        queue.remove_first()
    assert queue.first() is None


def test_all_of_an_object_or_none_of_it(slices):
    queue = SliceQueue(4)
    put(queue, slices[:3])
    with pytest.raises(QueueFullError, match="3 slices are already waiting, no room for 2 more"):
        put(queue, slices[3:5])
    assert len(queue) == 3
    put(queue, slices[3:4])
    assert len(queue) == 4


def test_room_is_kept_while_an_object_is_stored_and_given_back_where_that_fails(slices):
    queue = SliceQueue(2)

    def store() -> None:
        assert queue.first() is None
        with pytest.raises(QueueFullError, match="2 slices are already waiting"):
            put(queue, slices[2:3])
        raise OSError("disk")

    with pytest.raises(OSError, match="disk"), queue.room_for(slices[:2]):
        store()
    assert queue.first() is None
    put(queue, slices[3:5])
    assert queue.first() is slices[3]


def test_pixels_are_bounded_as_well(slices, monkeypatch):
    monkeypatch.setattr(slice_queue, "MAX_BYTES", 3 * PIXELS.size * np.float32().nbytes)
    queue = SliceQueue(100)
    put(queue, slices[:3])
    with pytest.raises(QueueFullError, match="3 slices are already waiting"):
        put(queue, slices[3:4])
    queue.remove_first()
    put(queue, slices[3:4])


def test_what_failed_to_be_stored_leaves_the_room_of_its_pixels(slices, monkeypatch):
    monkeypatch.setattr(slice_queue, "MAX_BYTES", 3 * PIXELS.size * np.float32().nbytes)
    queue = SliceQueue(100)
    for _ in range(2):
        with pytest.raises(OSError, match="disk"), queue.room_for(slices[:3]):
            raise OSError("disk")
    put(queue, slices[:3])
    assert len(queue) == 3


def test_a_closed_queue_takes_nothing(slices):
    queue = SliceQueue(10)
    put(queue, slices[:1])
    queue.close()
    with pytest.raises(QueueFullError, match="ending"):
        put(queue, slices[1:2])
    assert queue.first() is slices[0]
