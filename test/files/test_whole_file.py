"""Files that are written whole: what they may be read by, and what a crash leaves."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from stereoreg_ros.files.whole_file import remove_unfinished, write_whole


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_a_file_may_be_read_by_whom_the_mask_allows(tmp_path: Path, mask: int, mode: int) -> None:
    """As every file that a program makes; a temporary file of Python's would be for its owner alone."""
    path = tmp_path / "a.yaml"
    before = os.umask(mask)
    try:
        write_whole(path, "text")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == mode
    assert path.read_text() == "text"


def test_what_a_crash_left_is_removed_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_whole(tmp_path / "a.dcm", b"whole")
    (tmp_path / "b.part").touch()
    (tmp_path / ".c").touch()

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", killed)
        patched.setattr(Path, "unlink", lambda *_, **__: None)
        with pytest.raises(KeyboardInterrupt):
            write_whole(tmp_path / "a.dcm", b"new")
    assert len(list(tmp_path.iterdir())) == 4
    remove_unfinished(tmp_path)
    assert {one.name for one in tmp_path.iterdir()} == {"a.dcm", "b.part", ".c"}
    assert (tmp_path / "a.dcm").read_bytes() == b"whole"
