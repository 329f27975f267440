"""A folder in which received objects are kept: whole and on the disk, or not there."""

from __future__ import annotations

import os
import re
import secrets
import threading
from itertools import count
from pathlib import Path
from typing import Final

_UID: Final = re.compile(r"[0-9]+(\.[0-9]+)*")
_UNFINISHED: Final = ".part"


def is_uid(text: str) -> bool:
    """Whether the text is a DICOM UID: digits and dots, 64 characters at most. As a file name it leads nowhere else."""
    return len(text) <= 64 and _UID.fullmatch(text) is not None


class KeptObjects:
    """The objects in `folder`, each in a file that bears its SOP instance UID."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()

    def keep(self, uid: str, content: bytes) -> Path:
        """Write an object so that a crash or a power cut leaves it whole; returns its file.

        What is there already is not written again; another object of the same UID gets a file beside the first.
        Raises OSError where the folder is gone, full or read-only, and ValueError where `uid` is no UID.
        """
        if not is_uid(uid):
            raise ValueError(f"SOP Instance UID is {uid!r}, expected digits and dots, 64 at most")
        with self._lock:
            for number in count(1):
                file = self._folder / (f"{uid}.dcm" if number == 1 else f"{uid}_{number}.dcm")
                if not os.path.lexists(file):
                    self._write(file, content)
                elif not _holds(file, content):
                    continue
                # Also where it was there already: the crash may have come before this step.
                _sync_folder(self._folder)
                return file
        raise AssertionError("count does not end")

    def remove_unfinished(self) -> None:
        """Remove what a crash left half written; nobody was told that it was kept."""
        for file in self._folder.glob(f".*{_UNFINISHED}"):
            file.unlink(missing_ok=True)

    def _write(self, file: Path, content: bytes) -> None:
        unfinished = self._folder / f".{file.name}.{secrets.token_hex(4)}{_UNFINISHED}"
        try:
            with unfinished.open("xb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            unfinished.rename(file)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise


def _sync_folder(path: Path) -> None:
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _holds(file: Path, content: bytes) -> bool:
    return not file.is_symlink() and file.stat().st_size == len(content) and file.read_bytes() == content
