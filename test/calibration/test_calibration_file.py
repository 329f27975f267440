"""The file with the measured scale: whole after a crash, and refused with a sentence where it is not ours."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from stereoreg_ros.calibration.file import (
    CalibrationFileError,
    load_calibration,
    remove_calibration,
    save_calibration,
)
from stereoreg_ros.geometry.slice import PixelScale
from support.calibration_records import RECORD, content
from support.dicom_files import ROOT

KILLS = 100
# One process that makes others, which write until they are killed: to start Python for each would take minutes.
WRITERS = """
import os, sys
from dataclasses import replace
from pathlib import Path
from support.calibration_records import RECORD
from stereoreg_ros.calibration.file import save_calibration
for _ in sys.stdin:
    child = os.fork()
    if child:
        print(child, flush=True)
        os.waitpid(child, 0)
        print("gone", flush=True)
        continue
    number = 0
    while True:
        number += 1
        save_calibration(Path(sys.argv[1]), replace(RECORD, slices=number, rods=6 * number))
"""


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    assert load_calibration(path) is None
    save_calibration(path, RECORD)
    assert load_calibration(path) == RECORD
    newer = replace(RECORD, scale=PixelScale(0.49, 0.51), covariance=((1e-6, 5e-7), (5e-7, 1e-6)))
    save_calibration(path, newer)
    assert load_calibration(path) == newer
    assert [entry.name for entry in tmp_path.iterdir()] == ["scale.yaml"]
    remove_calibration(path)
    remove_calibration(path)
    assert load_calibration(path) is None


def test_standard_errors_are_roots_of_the_variances() -> None:
    assert RECORD.standard_errors == pytest.approx((0.0004, 0.0005, 0.0002))


def test_each_number_of_the_configured_scale_is_kept_and_counts(tmp_path: Path) -> None:
    """No two of them alike, lest one stand for another."""
    configured = PixelScale(0.52, 0.47, 0.003)
    path = tmp_path / "scale.yaml"
    save_calibration(path, replace(RECORD, configured=configured))
    record = load_calibration(path)
    assert record is not None
    assert (record.scale, record.configured) == (RECORD.scale, configured)
    assert record.replaces(replace(configured, sx=0.52 * (1 + 1e-9)))
    for name in ("sx", "sy", "shear"):
        assert not record.replaces(replace(configured, **{name: getattr(configured, name) + 1e-5}))


@pytest.mark.parametrize("size", [2, 3])
def test_of_a_file_without_correlations_the_largest_covariance_is_taken(tmp_path: Path, size: int) -> None:
    errors = np.array([0.001, 0.002, 0.0005])[:size]
    old = {key: value for key, value in content().items() if key != "covariance"}
    path = tmp_path / "scale.yaml"
    path.write_text(yaml.safe_dump({**old, "standard_errors": errors.tolist()}), encoding="utf-8")
    record = load_calibration(path)
    assert record is not None
    rng = np.random.default_rng(1)
    for _ in range(50):
        root = rng.normal(size=(size, int(rng.integers(1, 4))))
        root /= np.linalg.norm(root, axis=1, keepdims=True)
        true = np.outer(errors, errors) * (root @ root.T)
        assert np.linalg.eigvalsh(np.array(record.covariance) - true).min() > -1e-12


def test_belongs_to_the_scale_in_place_of_which_it_was_measured() -> None:
    record = replace(RECORD, configured=PixelScale(0.5, 0.6, 0.01))
    assert record.replaces(PixelScale(0.5, 0.6, 0.01))
    for other in (
        PixelScale(0.50001, 0.6, 0.01),
        PixelScale(0.5, 0.60001, 0.01),
        PixelScale(0.6, 0.5, 0.01),
        PixelScale(0.5, 0.6, -0.01),
        PixelScale(0.5, 0.6),
    ):
        assert not record.replaces(other)
    # What a file's decimals may lose.
    assert record.replaces(PixelScale(0.5 * (1 + 5e-7), 0.6, 0.01))


def test_killed_while_it_writes_the_file_is_the_old_or_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    rng = random.Random(3)
    found, highest = 0, 0
    command = [sys.executable, "-W", "ignore", "-c", WRITERS, str(path)]
    # The code under test, wherever another copy may be installed.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "test")])}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as writers:
        assert writers.stdin is not None
        assert writers.stdout is not None
        for _ in range(KILLS):
            writers.stdin.write("\n")
            writers.stdin.flush()
            child = int(writers.stdout.readline())
            time.sleep(rng.uniform(0.0, 0.05))  # any moment will do
            os.kill(child, signal.SIGKILL)
            assert writers.stdout.readline() == "gone\n"
            record = load_calibration(path)
            if record is None:
                assert found == 0
                continue
            found += 1
            assert record.rods == 6 * record.slices
            highest = max(highest, record.slices)
        writers.stdin.close()
    assert found > KILLS // 2
    assert highest > 1


def test_what_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scale.yaml"
    save_calibration(path, RECORD)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_calibration(path, replace(RECORD, slices=1))
    monkeypatch.undo()
    assert load_calibration(path) == RECORD
    assert [entry.name for entry in tmp_path.iterdir()] == ["scale.yaml"]


def test_a_write_and_a_removal_are_on_the_disk_before_they_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A renamed or removed file comes back after a power cut, unless its folder is synced afterwards."""
    steps: list[str] = []
    real_fsync, real_replace, real_unlink = os.fsync, os.replace, Path.unlink

    def fsync(descriptor: int) -> None:
        is_folder = os.path.samestat(os.fstat(descriptor), tmp_path.stat())
        steps.append("sync the folder" if is_folder else "sync the file")
        real_fsync(descriptor)

    def replace_file(source: Path, target: Path) -> None:
        steps.append("rename")
        real_replace(source, target)

    def unlink(path: Path, missing_ok: bool = False) -> None:
        steps.append("remove")
        real_unlink(path, missing_ok)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace_file)
    monkeypatch.setattr(Path, "unlink", unlink)
    path = tmp_path / "scale.yaml"
    save_calibration(path, RECORD)
    assert steps == ["sync the file", "rename", "sync the folder"]
    steps.clear()
    remove_calibration(path)
    assert steps == ["remove", "sync the folder"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "kind is 'NoneType', expected 'stereoreg_ros pixel scale'"),
        ("[1, 2", "not YAML"),
        ("\xff\xfe", "kind is"),
        ("!!python/object/apply:os.system [true]", "not YAML"),
        ("name: cube6\nlines: []\n", "kind is None, expected"),
        ("a" * 70000, "longer than 65536 bytes"),
        ({"kind": "other"}, "kind is 'other'"),
        ({"pixel_spacing": [0.5]}, r"pixel_spacing is \[0.5\], expected 2 finite numbers"),
        ({"pixel_spacing": [0.5, float("nan")]}, "pixel_spacing is .*, expected 2 finite numbers"),
        ({"pixel_spacing": [0.5, -0.5]}, "pixel spacing sy is -0.5, expected a positive number"),
        ({"pixel_shear": "x"}, r"pixel_shear is \['x'\], expected 1 finite numbers"),
        ({"standard_errors": [True, 1]}, "standard_errors is .*, expected 2 or 3 finite numbers"),
        ({"covariance": [[1e-6, 0.0]]}, "covariance is .*, expected 2 rows of 2 finite numbers"),
        ({"covariance": None}, "covariance is None, expected 2 rows of 2 finite numbers"),
        ({"covariance": [[1e-6, 0.0], [0.0]]}, r"covariance is \[0.0\], expected 2 finite numbers"),
        ({"covariance": [[1e-6, 1e-7], [0.0, 1e-6]]}, "covariance: .*, expected a finite and symmetric matrix"),
        ({"covariance": [[1e-6, 2e-6], [2e-6, 1e-6]]}, "covariance: .*, expected no negative variance"),
        ({"covariance": [[1e-6, 0.0], [0.0, 4e-6]]}, "covariance has the variances .*, expected the squares of the"),
        (
            {"covariance": [[1e-6, 0.0], [0.0, 1e-6]], "standard_errors": [-0.001, 0.001]},
            "expected numbers of mm/pixel",
        ),
        (
            {"covariance": None, "standard_errors": [1e200, 1e200]},
            "standard_errors is .*, expected numbers of mm/pixel",
        ),
        ({"pixel_spacing": [0.5, 1.1]}, r"pixel_spacing is \[0.5, 1.1\], expected \[0.5, 0.5\], .* by a factor of 2"),
        ({"pixel_spacing": [10**400, 0.5]}, "not YAML: line [0-9]+: a value has 401 characters, expected 200 at most"),
        ({"slices": 10**10}, "slices is 10000000000, expected a number of 1 or more"),
        ({"frame": "a\ud800"}, "frame is 'a\\\\ud800', expected a text in one line"),
        ({"date": "a\nb"}, "expected a text in one line"),
        ({"slices": 0}, "slices is 0, expected a number of 1 or more"),
        ({"frame": 3}, "frame is 3, expected a text"),
    ],
)
def test_broken_file_is_named(tmp_path: Path, text: str | dict[str, object], sentence: str) -> None:
    path = tmp_path / "scale.yaml"
    path.write_text(text if isinstance(text, str) else yaml.safe_dump({**content(), **text}), encoding="utf-8")
    with pytest.raises(CalibrationFileError, match=sentence) as caught:
        load_calibration(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        ("slices: !!int ''", "'' is not of type int"),
        ("slices: !!bool maybe", "'maybe' is not of type bool"),
        ("slices: !!float x", "'x' is not of type float"),
        ("slices: !!timestamp x", "found a value of type timestamp"),
        ("slices: !!python/name:os.system", "found a value of type .*python/name:os.system, expected texts, numbers"),
        ("slices: 2001-01-01", "found a value of type timestamp"),
        ("slices: " + "1:" * 60 + "1.5", "is not of type float"),
        ("slices: 0x" + "f" * 190, "is not of type int"),
        ("slices: 3\nslices: 4", "key 'slices' comes a second time"),
        ("slices: 3\n3: 4", "a key is 3, expected a text"),
        ("slices: &a [*a]", "repeats a value by an alias, expected none"),
        ("slices: [[[[[[1]]]]]]", "is nested more than 4 levels deep"),
        ("slices: [" + "1," * 5000 + "1]", "holds more than 4000 values"),
    ],
)
def test_values_that_break_constructors_are_named(tmp_path: Path, found: str, sentence: str) -> None:
    path = tmp_path / "scale.yaml"
    path.write_text(yaml.safe_dump(content(), sort_keys=False).replace("slices: 3", found), encoding="utf-8")
    with pytest.raises(CalibrationFileError, match=f"not YAML: line [0-9]+: .*{sentence}"):
        load_calibration(path)


def test_aliases_of_aliases_end_soon(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    levels = [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 30)]
    path.write_text("l0: &l0 [1]\n" + "\n".join(levels) + "\nkind: *l29\n", encoding="utf-8")
    with pytest.raises(CalibrationFileError, match="repeats a value by an alias") as caught:
        load_calibration(path)
    assert len(str(caught.value)) < 500


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(CalibrationFileError, match=r"pipe\.yaml: cannot be read: not a regular file"):
        load_calibration(tmp_path / "pipe.yaml")


def test_truncated_anywhere_is_refused_or_whole(tmp_path: Path) -> None:
    path = tmp_path / "scale.yaml"
    save_calibration(path, RECORD)
    raw = path.read_bytes()
    for size in range(len(raw) - 1):
        path.write_bytes(raw[:size])
        try:
            record = load_calibration(path)
        except CalibrationFileError:
            continue
        assert record is not None
        # Only the last entry, which nothing depends on, can be cut without being noticed.
        assert replace(record, software=RECORD.software) == RECORD


def test_folder_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(CalibrationFileError, match="cannot be read"):
        load_calibration(tmp_path)
