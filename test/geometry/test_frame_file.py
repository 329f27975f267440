"""Frames from files: every fault says file, line and key."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import FrameFileError, frame_text, load_frame, shipped_frames

GOOD = """\
name: block
lines:
  - {name: a, from: [-10, -10, -20], to: [-10, 5, 20], diameter: 1.0}
  - {name: b, from: [10, -10, -20], to: [5, -10, 2e1], diameter: 1.5}
  # a comment moves the lines below it
  - name: c
    from: [0, 10, -20.5]
    to: [3, 10, +20]
    diameter: 2
"""
FILE = "frame under test.yaml"


def written(folder: Path, content: str | bytes) -> Path:
    path = folder / FILE
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def fault(path: Path) -> str:
    with pytest.raises(FrameFileError) as caught:
        load_frame(path)
    assert str(caught.value).startswith(f"{path}: ") or str(caught.value).startswith(f"{path}, line ")
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(str(path))


class TestGood:
    def test_every_number_arrives(self, tmp_path: Path) -> None:
        frame = load_frame(written(tmp_path, GOOD))
        assert frame.name == "block"
        assert frame.line_names == ("a", "b", "c")
        np.testing.assert_array_equal(frame.starts, [[-10, -10, -20], [10, -10, -20], [0, 10, -20.5]])
        np.testing.assert_array_equal(frame.ends, [[-10, 5, 20], [5, -10, 20], [3, 10, 20]])
        np.testing.assert_array_equal(frame.diameters, [1, 1.5, 2])

    def test_path_as_text(self, tmp_path: Path) -> None:
        assert load_frame(str(written(tmp_path, GOOD))).name == "block"

    def test_anchors_and_aliases(self, tmp_path: Path) -> None:
        content = GOOD.replace("[-10, -10, -20]", "&corner [-10, -10, -20]").replace("[10, -10, -20]", "*corner")
        np.testing.assert_array_equal(load_frame(written(tmp_path, content)).starts[1], [-10, -10, -20])

    def test_byte_order_mark_windows_line_ends_and_accents(self, tmp_path: Path) -> None:
        content = b"\xef\xbb\xbf" + GOOD.replace("name: a", "name: \u00e4").replace("\n", "\r\n").encode()
        assert load_frame(written(tmp_path, content)).line_names == ("\u00e4", "b", "c")

    def test_tolerances_of_the_frame_and_of_one_rod(self, tmp_path: Path) -> None:
        content = GOOD.replace("name: block", "name: block\ntolerance_mm: 0.25\norientation_required: true")
        frame = load_frame(written(tmp_path, content.replace("diameter: 1.5", "diameter: 1.5, tolerance_mm: 0")))
        np.testing.assert_array_equal(frame.tolerances_or(9.0), [0.25, 0.0, 0.25])
        assert frame.orientation_required

    def test_what_is_not_said_of_tolerances_is_unknown(self, tmp_path: Path) -> None:
        frame = load_frame(written(tmp_path, GOOD.replace("diameter: 1.5", "diameter: 1.5, tolerance_mm: 0.1")))
        np.testing.assert_array_equal(frame.tolerances_or(0.3), [0.3, 0.1, 0.3])
        assert not frame.orientation_required

    @pytest.mark.parametrize(("word", "meant"), [("true", True), ("False", False), ("yes", True), ("off", False)])
    def test_orientation_required_in_all_of_yamls_words(self, word: str, meant: bool, tmp_path: Path) -> None:
        content = GOOD.replace("name: block", f"name: block\norientation_required: {word}")
        assert load_frame(written(tmp_path, content)).orientation_required is meant

    def test_rods_that_meet_in_a_corner_may_have_a_tolerance(self, tmp_path: Path) -> None:
        content = GOOD.replace("[10, -10, -20]", "[-10, -10, -20]").replace(
            "diameter: 1.5", "diameter: 1, tolerance_mm: 1"
        )
        assert load_frame(written(tmp_path, content)).tolerances_or(0.0)[1] == 1.0

    def test_a_file_in_the_working_folder_goes_before_a_shipped_name(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "cube6").write_text(GOOD)
        monkeypatch.chdir(tmp_path)
        assert load_frame("cube6").name == "block"


COORDINATES = st.integers(-99_000_000, 99_000_000).map(lambda thousandths: thousandths / 1000)
TOLERANCES = st.one_of(st.none(), st.floats(0.0, 0.4))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    corners=st.lists(st.tuples(COORDINATES, COORDINATES, COORDINATES), min_size=3, max_size=8, unique=True),
    tolerances=st.one_of(st.lists(TOLERANCES, min_size=8, max_size=8), TOLERANCES.map(lambda one: [one] * 8)),
    required=st.booleans(),
    diameter=st.integers(1, 20_000).map(lambda thousandths: thousandths / 1000),
)
def test_what_is_written_is_read_again(
    tmp_path: Path,
    corners: list[tuple[float, ...]],
    tolerances: list[float | None],
    required: bool,
    diameter: float,
) -> None:
    starts, n = np.array(corners), len(corners)
    # Rods of 60 mm, apart by far more than any tolerance where their starts are.
    assume(all(np.linalg.norm(starts[i] - starts[j]) > 10 for i in range(n) for j in range(i)))
    ends = np.round(starts + np.array([10.0, -20.0, 60.0]), 3)
    given_mm = np.array([np.nan if one is None else one for one in tolerances[:n]])
    names = tuple(f"rod {i}" for i in range(n))
    frame = Frame("any", names, starts, ends, np.full(n, diameter), given_mm, required)
    again = load_frame(written(tmp_path, frame_text(frame, "a comment:\n- of two lines")))
    assert (again.name, again.line_names, again.orientation_required) == ("any", names, required)
    for one, other in ((again.starts, starts), (again.ends, ends), (again.diameters, frame.diameters)):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(again.tolerances_or(np.nan), given_mm)


def test_of_a_frame_that_is_written_everything_stands_there(tmp_path: Path) -> None:
    starts, ends = np.array([[-10.0, -10, -20], [10, -10, -20], [0, 10, -20.125]]), np.full((3, 3), 20.0)
    diameters, own = np.array([1.0, 1.5, 2.0]), np.array([0.25, np.nan, 0.5])
    for tolerances in (own, np.full(3, 0.125)):
        frame = Frame("any", ("a", "b", "c"), starts, ends, diameters, tolerances, True)
        again = load_frame(written(tmp_path, frame_text(frame, "")))
        assert again.orientation_required
        np.testing.assert_array_equal(again.tolerances_or(np.nan), tolerances)
        np.testing.assert_array_equal(again.diameters, diameters)
        np.testing.assert_array_equal(again.starts, starts)


class TestShipped:
    def test_what_is_shipped(self) -> None:
        assert set(shipped_frames()) == {
            *("cube5", "cube6", "cube8", "leksell_ct", "leksell_ct9", "brw", "zframe", "catphan_ctp404")
        }

    @pytest.mark.parametrize("name", sorted(shipped_frames()))
    def test_loads_by_name_and_by_path(self, name: str) -> None:
        by_name, by_path = load_frame(name), load_frame(shipped_frames()[name])
        assert by_name.name == name
        assert by_name.line_names == by_path.line_names
        np.testing.assert_array_equal(by_name.starts, by_path.starts)
        np.testing.assert_array_equal(by_name.ends, by_path.ends)
        np.testing.assert_array_equal(by_name.diameters, by_path.diameters)

    @pytest.mark.parametrize("name", ["cube7", "", "Cube6"])
    def test_unknown_name_lists_the_shipped_ones(self, name: str) -> None:
        with pytest.raises(FrameFileError, match=f"frame '{name}' is neither a file nor a shipped frame") as caught:
            load_frame(name)
        assert all(shipped in str(caught.value) for shipped in shipped_frames())

    def test_a_shipped_name_with_an_ending_is_a_path(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        with pytest.raises(FrameFileError, match=r"cube6\.yaml: cannot be read: No such file"):
            load_frame("cube6.yaml")


# Where the fault is put, the line in the file, and what the message says besides the file.
FAULTS: dict[str, tuple[str, str, int, str]] = {
    "no name": ("name: block\n", "", 1, "frame file: found no key 'name', expected the keys name, lines"),
    "empty name": ("name: block", "name:", 1, "name: found nothing, expected a name"),
    "blank name": ("name: block", "name: '  '", 1, "name: found '  ', expected a name"),
    "name is a list": ("name: block", "name: [block]", 1, "name: found a list, expected a name"),
    "no lines": (GOOD[GOOD.index("lines:") :], "", 1, "frame file: found no key 'lines'"),
    "lines are empty": (GOOD[GOOD.index("lines:") :], "lines:\n", 2, "lines: found nothing, expected a list of rods"),
    "lines are a mapping": (
        GOOD[GOOD.index("lines:") :],
        "lines: {a: 1}\n",
        2,
        "lines: found a mapping, expected a list of rods",
    ),
    "two lines": (
        GOOD[GOOD.index("  - name: c") :],
        "",
        3,
        "lines: found 2 rods, expected at least 3",
    ),
    "unknown key": ("name: block", "name: block\nunits: mm", 2, "frame file: found unknown key 'units'"),
    "key twice": ("name: block", "name: block\nname: block2", 2, "frame file: found key 'name' a second time"),
    "unknown key of a rod": ("diameter: 1.5", "radius: 1.5", 4, "lines[1]: found unknown key 'radius'"),
    "key of a rod twice": (
        "    diameter: 2",
        "    diameter: 2\n    diameter: 3",
        10,
        "lines[2]: found key 'diameter' a second time",
    ),
    "merge key": ("    diameter: 2", "    <<: {diameter: 2}", 9, "lines[2]: found unknown key '<<'"),
    "a list as key": ("name: block", "name: block\n[1, 2]: 3", 2, "frame file: found unknown key 'a list'"),
    "rod without diameter": (
        ", diameter: 1.5",
        "",
        4,
        "lines[1]: found no key 'diameter', expected the keys name, from, to, diameter",
    ),
    "rod is a number": (
        "  - {name: b, from: [10, -10, -20], to: [5, -10, 2e1], diameter: 1.5}",
        "  - 5",
        4,
        "lines[1]: found '5', expected the keys",
    ),
    "rod named twice": ("  - name: c", "  - name: a", 6, "lines[2].name: found 'a' a second time"),
    "rod without a name": ("name: b,", "name: '',", 4, "lines[1].name: found nothing, expected a name"),
    "two coordinates": (
        "[0, 10, -20.5]",
        "[0, 10]",
        7,
        "lines[2].from: found 2 numbers, expected three numbers [x, y, z] in mm",
    ),
    "four coordinates": ("[3, 10, +20]", "[3, 10, 20, 1]", 8, "lines[2].to: found 4 numbers, expected three numbers"),
    "no list of coordinates": ("[3, 10, +20]", "3 10 20", 8, "lines[2].to: found '3 10 20', expected three numbers"),
    "text for a number": ("-20.5", "low", 7, "lines[2].from[z]: found 'low', expected a number in mm"),
    "decimal comma": ("[0, 10, -20.5]", "['0,5', 10, 20]", 7, "lines[2].from[x]: found '0,5', expected a number"),
    "nothing for a number": ("diameter: 2", "diameter:", 9, "lines[2].diameter: found nothing, expected a number"),
    "list for a number": ("diameter: 1.5", "diameter: [1.5]", 4, "lines[1].diameter: found a list, expected a number"),
    "YAML NaN": ("2e1", ".nan", 4, "lines[1].to[z]: found '.nan', expected a number"),
    "NaN": ("2e1", "nan", 4, "lines[1].to[z]: found nan, expected a finite number"),
    "infinite": ("2e1", "-inf", 4, "lines[1].to[z]: found -inf, expected a finite number"),
    "overflow": ("2e1", "1e999", 4, "lines[1].to[z]: found inf, expected a finite number"),
    "too large": ("2e1", "100001", 4, "lines[1].to[z]: found 100001, expected a finite number in mm, at most 1e5"),
    "no thickness": ("diameter: 1.5", "diameter: 0", 4, "lines[1].diameter: found 0, expected a positive length in mm"),
    "negative thickness": ("diameter: 2", "diameter: -2", 9, "lines[2].diameter: found -2, expected a positive"),
    "no length": ("[3, 10, +20]", "[0, 10, -20.5]", 8, "lines[2].to: found the same point as 'from'"),
    "broken YAML": ("diameter: 1.5}", "diameter: 1.5", 6, "is not valid YAML: expected ',' or '}', but got '-'"),
    "tab": ("    from: [0", "\tfrom: [0", 7, "is not valid YAML"),
    "unknown alias": ("[3, 10, +20]", "*nowhere", 8, "is not valid YAML: found undefined alias"),
    "a second document": ("    diameter: 2\n", "    diameter: 2\n---\nname: other\n", 10, "is not valid YAML"),
    "negative tolerance": (
        "name: block",
        "name: block\ntolerance_mm: -0.1",
        2,
        "tolerance_mm: found -0.1, expected a standard deviation in mm, 0 or more",
    ),
    "tolerance NaN": ("name: block", "name: block\ntolerance_mm: nan", 2, "tolerance_mm: found nan, expected a finite"),
    "infinite tolerance": (
        "diameter: 1.5",
        "diameter: 1.5, tolerance_mm: inf",
        4,
        "lines[1].tolerance_mm: found inf, expected a finite number",
    ),
    "tolerance without a number": ("name: block", "name: block\ntolerance_mm:", 2, "tolerance_mm: found nothing"),
    "tolerance larger than the rods": (
        "name: block",
        "name: block\ntolerance_mm: 60",
        2,
        "tolerance_mm: found 60, expected at most a tenth of the 21.2 mm between rods 'a' and 'b'",
    ),
    "tolerance of a rod larger than it is long": (
        "[3, 10, +20]",
        "[3, 10, -19.5]\n    tolerance_mm: 0.4",
        9,
        "lines[2].tolerance_mm: found 0.4, expected at most a tenth of the 3.16 mm that rod 'c' is long",
    ),
    "tolerance of a rod between others": (
        "diameter: 1.5",
        "diameter: 1.5, tolerance_mm: 3",
        4,
        "lines[1].tolerance_mm: found 3, expected at most a tenth of the",
    ),
    "tolerance twice": (
        "name: block",
        "tolerance_mm: 0.1\ntolerance_mm: 0.2\nname: block",
        2,
        "frame file: found key 'tolerance_mm' a second time",
    ),
    "orientation_required is no truth": (
        "name: block",
        "name: block\norientation_required: maybe",
        2,
        "orientation_required: found 'maybe', expected true or false",
    ),
    "orientation_required is text": (
        "name: block",
        "name: block\norientation_required: 'true'",
        2,
        "orientation_required: found 'true', expected true or false",
    ),
    "orientation_required is no truth by its tag": (
        "name: block",
        "name: block\norientation_required: !!bool 2",
        2,
        "orientation_required: found '2', expected true or false",
    ),
    "orientation_required of a rod": (
        "diameter: 1.5",
        "diameter: 1.5, orientation_required: true",
        4,
        "lines[1]: found unknown key 'orientation_required'",
    ),
    "rods within themselves": (
        GOOD[GOOD.index("lines:") :],
        "lines: &rods [*rods, *rods, *rods]\n",
        2,
        "lines[0]: found a list, expected the keys",
    ),
}


class TestFaults:
    @pytest.mark.parametrize("case", FAULTS)
    def test_says_line_and_key(self, case: str, tmp_path: Path) -> None:
        old, new, line, told = FAULTS[case]
        assert GOOD.count(old) == 1
        message = fault(written(tmp_path, GOOD.replace(old, new)))
        assert f"line {line}," in message or f"line {line}:" in message
        assert told in message

    @pytest.mark.parametrize(
        ("content", "told"),
        [
            (b"", "frame file: found an empty file, expected the keys name, lines"),
            (b"# only a comment\n", "frame file: found an empty file"),
            (b"just text", "line 1, frame file: found 'just text', expected the keys"),
            (b"- name: a\n- name: b\n", "line 1, frame file: found a list"),
            (GOOD.encode("utf-16"), "is not UTF-8 text, expected YAML"),
            (GOOD.replace("block", "bl\u00f6ck").encode("latin-1"), "is not UTF-8 text, expected YAML"),
            (b"name: block\nlines: a\0b\n", ", line 2: is not valid YAML: special characters are not allowed"),
            (b"[" * 20_000, ", line 1: is nested more than 20 levels deep"),
            (GOOD.encode() + b"#" * 65536, "longer than 65536 bytes, expected a frame file"),
        ],
        ids=["empty", "comment", "text", "list", "utf-16", "latin-1", "nul", "deep", "huge"],
    )
    def test_what_is_no_frame_file(self, content: bytes, told: str, tmp_path: Path) -> None:
        assert told in fault(written(tmp_path, content))

    @pytest.mark.parametrize("per_mm", [1e-3, 1 / 25.4, 1e3], ids=["metres", "inches", "micrometres"])
    def test_other_units_than_mm_are_asked_about(self, per_mm: float, tmp_path: Path) -> None:
        cube = load_frame("cube6")
        other = replace(cube, starts=cube.starts * per_mm, ends=cube.ends * per_mm)
        message = fault(written(tmp_path, frame_text(other, "a comment moves the lines")))
        assert ": line 4, lines: found rods of " in message
        assert message.endswith("expected at least one of 5 to 2000 mm; metres or inches instead of mm?")

    def test_one_rod_of_a_sane_length_makes_the_unit(self, tmp_path: Path) -> None:
        short = GOOD.replace("[-10, 5, 20]", "[-10, -10, -19]").replace("[5, -10, 2e1]", "[10, -10, -19]")
        assert len(load_frame(written(tmp_path, short))) == 3

    def test_too_many_rods(self, tmp_path: Path) -> None:
        rods = "".join(f"  - {{name: r{i}, from: [{i}, 0, 0], to: [{i}, 0, 9], diameter: 1}}\n" for i in range(200))
        assert "lines: found 200 rods, expected at least 3" in fault(written(tmp_path, f"name: many\nlines:\n{rods}"))

    def test_what_would_be_waited_for_is_not_opened(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe.yaml")
        assert "cannot be read: not a regular file" in fault(tmp_path / "pipe.yaml")
        assert "cannot be read: not a regular file" in fault(Path("/dev/zero"))

    @pytest.mark.parametrize("name", ["a" * 300, "a" * 300 + ".yaml", "a\0b", "a\0b.yaml", "\ud800.yaml"])
    def test_names_that_no_file_can_have(self, name: str) -> None:
        with pytest.raises(FrameFileError):
            load_frame(name)

    @pytest.mark.parametrize("name", ['"\\ud800"', '"a\\0b"', '"a\\nb"', '"\\x1b[2J"', "a" * 101])
    def test_names_that_cannot_go_into_messages(self, name: str, tmp_path: Path) -> None:
        told = fault(written(tmp_path, GOOD.replace("name: block", f"name: {name}")))
        assert "line 1, name: found " in told
        assert "expected a name of at most 100 printable characters" in told
        told.encode()

    def test_a_long_value_is_not_repeated_as_a_whole(self, tmp_path: Path) -> None:
        assert len(fault(written(tmp_path, GOOD.replace("2e1", "x" * 50_000)))) < 500

    @pytest.mark.parametrize(
        ("content", "told"),
        [
            (b"[" + b"1," * 32_000 + b"1]", "holds more than 4000 values, expected fewer"),
            (b"a:\n" * 16_000, "holds more than 4000 values, expected fewer"),
            (b"[" * 60_000, "is nested more than 20 levels deep, expected fewer"),
            (b"- " * 30_000, "is nested more than 20 levels deep, expected fewer"),
        ],
    )
    def test_dense_and_deep_files_are_given_up_soon(self, content: bytes, told: str, tmp_path: Path) -> None:
        path = written(tmp_path, content)
        started_s = time.process_time()
        assert told in fault(path)
        # To the end, PyYAML takes a second and more.
        assert time.process_time() - started_s < 0.6

    def test_missing_file(self, tmp_path: Path) -> None:
        assert "cannot be read: No such file or directory" in fault(tmp_path / "none.yaml")

    def test_folder(self, tmp_path: Path) -> None:
        assert "cannot be read: Is a directory" in fault(tmp_path)

    def test_aliases_of_aliases_end_soon(self, tmp_path: Path) -> None:
        levels = [f"  - &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 30)]
        content = "name: laughs\nlines:\n  - &l0 [1]\n" + "\n".join(levels)
        assert "lines[0]: found a list, expected the keys" in fault(written(tmp_path, content))
