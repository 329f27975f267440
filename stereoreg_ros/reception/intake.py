"""What happens to an object that has arrived: read, kept, queued; or refused with a status and a reason."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final

from stereoreg_ros.dicom import DicomError, read_frames
from stereoreg_ros.geometry.slice import SPACING_RANGE_MM
from stereoreg_ros.reception.kept_objects import KeptObjects
from stereoreg_ros.reception.slice_queue import QueueFullError, ReceivedSlice, SliceQueue

# Status codes of the storage service, PS3.4 B.2.3.
OUT_OF_RESOURCES: Final = 0xA700
CANNOT_UNDERSTAND: Final = 0xC000


class ObjectRefusedError(Exception):
    """An object that was refused; status: that of the C-STORE response; the text is the reason."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class Intake:
    """Takes objects from any thread and puts their slices into `queue`.

    max_object_bytes: limit for an object, both as it came and unpacked.
    """

    def __init__(self, queue: SliceQueue, max_object_bytes: int) -> None:
        self._queue = queue
        self._max_object_bytes = max_object_bytes

    def take(self, name: Path, content: bytes, uid: str = "", kept: KeptObjects | None = None) -> int:
        """Take an object in the form of a DICOM file; returns the number of its slices.

        name: stands for it in reasons. uid: the SOP Instance UID that it was announced with, and must have. kept: where
        it is kept, under that UID, before this returns.
        Raises ObjectRefusedError; nothing of the object is queued then.
        """
        arrival_s = time.monotonic()
        if len(content) > self._max_object_bytes:
            raise ObjectRefusedError(
                OUT_OF_RESOURCES, f"{name}: has {len(content)} bytes, expected {self._max_object_bytes} at most"
            )
        try:
            frames = read_frames(name, content, self._max_object_bytes, uid)
        except DicomError as error:
            raise ObjectRefusedError(CANNOT_UNDERSTAND, str(error)) from None
        # The range that register_node accepts.
        low, high = SPACING_RANGE_MM
        for frame in frames:
            scale = frame.header.scale
            if not (low <= scale.sx <= high and low <= scale.sy <= high):
                raise ObjectRefusedError(
                    CANNOT_UNDERSTAND,
                    f"{name}: Pixel Spacing (0028,0030) is {[scale.sy, scale.sx]}, expected {low:g} to {high:g} mm",
                )
        try:
            with self._queue.room_for([ReceivedSlice(frame, arrival_s) for frame in frames]):
                if kept is not None:
                    kept.keep(uid, content)
        except QueueFullError as error:
            raise ObjectRefusedError(OUT_OF_RESOURCES, f"{name}: {error}") from None
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else str(error)
            raise ObjectRefusedError(OUT_OF_RESOURCES, f"{name}: cannot be kept: {why}") from None
        except ValueError as error:
            raise ObjectRefusedError(CANNOT_UNDERSTAND, f"{name}: {error}") from None
        return len(frames)
