"""Paths in a launch file's arguments: `~` is expanded, and a file that is not there is refused with a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereoreg_ros.files.given_path import existing_file, expanded


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def test_the_home_folder_is_put_in_place_of_its_sign(home: Path) -> None:
    assert expanded("frame_file", "~/frames/mine.yaml") == f"{home}/frames/mine.yaml"
    assert expanded("frame_file", "~") == str(home)


@pytest.mark.parametrize("given", ["cube6", "a/b.yaml", "/a/~b.yaml", "./~", ""])
def test_what_does_not_begin_with_the_sign_stays(home: Path, given: str) -> None:
    assert expanded("frame_file", given) == given


def test_a_home_that_nobody_has_is_refused() -> None:
    sentence = r"^frame_file: ~nobody-of-that-name/a.yaml: no such home folder, expected that of a user; give the whole"
    with pytest.raises(ValueError, match=sentence):
        expanded("frame_file", "~nobody-of-that-name/a.yaml")


def test_a_file_that_is_there_is_given_with_its_home(home: Path) -> None:
    (home / "mine.yaml").touch()
    assert existing_file("params_file", "~/mine.yaml") == f"{home}/mine.yaml"


def test_a_file_that_is_not_there_and_a_folder_are_refused_by_the_arguments_name(home: Path) -> None:
    with pytest.raises(ValueError, match=rf"^params_file: {home}/mine.yaml: no such file; nothing is started"):
        existing_file("params_file", "~/mine.yaml")
    with pytest.raises(ValueError, match=rf"^params_file: {home}: a folder, expected a file$"):
        existing_file("params_file", "~")


def test_a_relative_path_is_taken_from_the_working_folder(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / "mine.yaml").touch()
    monkeypatch.chdir(home)
    assert existing_file("params_file", "mine.yaml") == "mine.yaml"
