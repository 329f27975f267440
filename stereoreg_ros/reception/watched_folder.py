"""A folder to which a scanner exports: each DICOM file in it is taken once, when it is complete."""

from __future__ import annotations

import logging
import os
import stat
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from stereoreg_ros.reception.intake import OUT_OF_RESOURCES, Intake, ObjectRefusedError

_LOG = logging.getLogger(__name__)
_Version: TypeAlias = tuple[int, int]
# Links and special files are never opened, not even where one has just replaced a file or folder.
_READ: Final = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
_ENTER: Final = os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY


@dataclass(frozen=True)
class _Found:
    path: Path
    size: int
    modified_ns: int

    @property
    def version(self) -> _Version:
        return self.size, self.modified_ns


class WatchedFolder:
    """Scans `folder` and its subfolders every `period_s` seconds, in a thread of its own.

    A file is complete when its size and time have not changed since the last scan and all of it can be read as DICOM.
    Files that are there at the start are left alone, unless they change: they may be of any age, and would look new.
    For the same reason a file that vanishes and returns unchanged, as on a share that is mounted again, stays known.
    Names that begin with a dot are unfinished files of other programs, and left alone. max_file_bytes: larger files are
    not read. Raises OSError where the folder cannot be listed.
    """

    def __init__(self, folder: Path, period_s: float, max_file_bytes: int, intake: Intake) -> None:
        self._folder = folder
        self._period_s = period_s
        self._max_file_bytes = max_file_bytes
        self._intake = intake
        with os.scandir(folder):
            self._seen = {found.path: found.version for found in self._files()}
        self._done = dict(self._seen)
        self._has_to_wait: Path | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watched-folder", daemon=True)

    def start(self) -> None:
        """Start to scan."""
        self._thread.start()

    def stop(self) -> None:
        """Stop scanning."""
        self._ended.set()

    def look(self) -> None:
        """Take what has become complete since the last scan, the oldest first."""
        found = sorted(self._files(), key=lambda one: (one.modified_ns, one.path))
        before, self._seen = self._seen, {one.path: one.version for one in found}
        for one in found:
            if self._done.get(one.path) != one.version and before.get(one.path) == one.version:
                if not self._take(one):
                    # The others wait as well, so that they keep their order.
                    return
                self._done[one.path] = one.version

    def _watch(self) -> None:
        while not self._ended.wait(self._period_s):
            try:
                self.look()
            except Exception:
                _LOG.exception("internal error while scanning %s", self._folder)

    def _files(self) -> Iterator[_Found]:
        for folder, subfolders, names in os.walk(self._folder, followlinks=False):
            subfolders[:] = [name for name in subfolders if not name.startswith(".")]
            for name in names:
                path = Path(folder, name)
                try:
                    status = path.lstat()
                except OSError:
                    continue
                if stat.S_ISREG(status.st_mode) and not name.startswith("."):
                    yield _Found(path, status.st_size, status.st_mtime_ns)

    def _opened(self, path: Path) -> int:
        """A descriptor of a file in the folder, opened step by step so that no link on the way is followed."""
        *subfolders, name = path.relative_to(self._folder).parts
        folder = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            for subfolder in subfolders:
                inner = os.open(subfolder, _ENTER, dir_fd=folder)
                os.close(folder)
                folder = inner
            return os.open(name, _READ, dir_fd=folder)
        finally:
            os.close(folder)

    def _take(self, found: _Found) -> bool:
        """Take a file, or warn that it cannot be used; false where there is no room for it at present."""
        try:
            if found.size > self._max_file_bytes:
                raise OSError(f"has {found.size} bytes, expected {self._max_file_bytes} at most")
            with open(self._opened(found.path), "rb") as stream:
                status = os.fstat(stream.fileno())
                if not stat.S_ISREG(status.st_mode) or (status.st_size, status.st_mtime_ns) != found.version:
                    raise OSError("was replaced while it was being read")
                content = stream.read(found.size)
            slices = self._intake.take(found.path, content)
        except OSError as error:
            _LOG.warning("left out %s: %s", found.path, error.strerror or error)
        except ObjectRefusedError as refusal:
            if refusal.status == OUT_OF_RESOURCES:
                if self._has_to_wait != found.path:
                    self._has_to_wait = found.path
                    _LOG.warning("has to wait: %s", refusal)
                return False
            _LOG.warning("left out %s", refusal)
        else:
            _LOG.info("took %s: %d slice%s", found.path, slices, "s"[: slices != 1])
        return True
