"""Files written atomically and durably, so that a reader finds the old or the new one, whole; and read as a whole."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from pathlib import Path
from typing import Final

# Ending of a file that is being written, whose name begins with a dot.
UNFINISHED: Final = ".part"


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8, atomically and durably. Raises OSError where that fails; the old file then stays."""
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}{UNFINISHED}")
    try:
        with unfinished.open("xb") as file:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def remove_unfinished(folder: Path) -> None:
    """Remove what `write_whole` left half written in a crash. Raises OSError where that fails."""
    for file in folder.glob(f".*{UNFINISHED}"):
        file.unlink(missing_ok=True)


def read_whole(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file; OSError where it cannot be read, is larger, or is a pipe or a device.

    Reading those could block, or never end.
    """
    try:
        # Opened so, a pipe does not wait for its other end.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except ValueError as error:
        raise OSError(errno.EINVAL, f"no name of a file: {error}") from None
    with open(descriptor, "rb") as file:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "not a regular file")
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"longer than {most_bytes} bytes")
    return content


def sync_folder(folder: Path) -> None:
    """Write the folder's entries to the disk, not only the files."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
