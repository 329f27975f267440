"""A scanner that sends slices by DICOM push all the time, whatever becomes of the receiver, and remembers each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pydicom
from pydicom.dataset import Dataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
from pynetdicom.dsutils import encode

from support.dicom_clients import association
from support.known_slices import KnownSlice

_PAUSE_S = 0.25
_PER_ASSOCIATION = 10


@dataclass(frozen=True, eq=False)
class Sent:
    """One C-STORE: from when to when by the system's clock, ns, and whether it was acknowledged with success."""

    slice: KnownSlice
    uid: str
    encoded: bytes
    begun_ns: int
    ended_ns: int
    acknowledged: bool

    def is_kept_in(self, folder: Path) -> bool:
        """Whether the folder holds the object, whole, byte by byte, and as a file that can be read."""
        file = folder / f"{self.uid}.dcm"
        if not file.is_file() or not file.read_bytes().endswith(self.encoded):
            return False
        kept = pydicom.dcmread(file)
        start = 144 + int(kept.file_meta.FileMetaInformationGroupLength)
        return file.read_bytes()[start:] == self.encoded and str(kept.SOPInstanceUID) == self.uid


class SliceSender:
    """Sends what `choose` gives, each time as a new object, until it is stopped; in a thread of its own."""

    def __init__(self, port: int, choose: Callable[[], KnownSlice]) -> None:
        self.sent: list[Sent] = []
        self._port = port
        self._choose = choose
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Finish what is being sent, and send no more."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        contexts = [(CTImageStorage, ExplicitVRLittleEndian)]
        while not self._ended.is_set():
            with association(self._port, contexts) as opened:
                for _ in range(_PER_ASSOCIATION):
                    if self._ended.is_set() or not opened.is_established:
                        break
                    self._send(opened, self._choose())
            # Also where nobody listens.
            self._ended.wait(_PAUSE_S)

    def _send(self, opened, chosen: KnownSlice) -> None:
        dataset = pydicom.dcmread(chosen.path)
        dataset.SOPInstanceUID = dataset.file_meta.MediaStorageSOPInstanceUID = generate_uid()
        plain = Dataset(dataset)
        encoded = encode(plain, False, True)
        assert encoded is not None
        begun_ns, status = time.time_ns(), None
        # The association may be lost meanwhile.
        with suppress(RuntimeError, ValueError):
            status = opened.send_c_store(dataset).get("Status")
        uid = str(dataset.SOPInstanceUID)
        self.sent.append(Sent(chosen, uid, encoded, begun_ns, time.time_ns(), status == 0))
        self._ended.wait(_PAUSE_S)
