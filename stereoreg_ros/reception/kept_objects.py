"""A folder in which received objects are kept: whole and on the disk, or not there."""

from __future__ import annotations

import os
import re
import threading
from itertools import count
from pathlib import Path
from typing import Final

from stereoreg_ros.files.whole_file import remove_unfinished, sync_folder, write_whole

_UID: Final = re.compile(r"[0-9]+(\.[0-9]+)*")


def is_uid(text: str) -> bool:
    """Whether the text is a DICOM UID: digits and dots, 64 characters at most. Safe as a file name."""
    return len(text) <= 64 and _UID.fullmatch(text) is not None


class KeptObjects:
    """The objects in `folder`, each in a file named after its SOP Instance UID."""

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
                    write_whole(file, content)
                    return file
                if _holds(file, content):
                    # A crash may have come before this step.
                    sync_folder(self._folder)
                    return file
        raise AssertionError("count does not end")

    def remove_unfinished(self) -> None:
        """Remove what a crash left half written; it was never acknowledged."""
        remove_unfinished(self._folder)


def _holds(file: Path, content: bytes) -> bool:
    return not file.is_symlink() and file.stat().st_size == len(content) and file.read_bytes() == content
