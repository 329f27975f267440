"""`stereoreg register`, by calling it and as a process of its own."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import select
import struct
import subprocess
import sys
import termios
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydicom.uid import CTImageStorage, DigitalXRayImageStorageForPresentation

from stereoreg_ros import cli, load_frame
from stereoreg_ros.geometry.pose import Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.result import Refusal
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, random_pose, render_slice
from support.contract import DIAGNOSTIC_KEYS
from support.dicom_files import CATPHAN, ROOT, SHARED_DATA, real, write_slice

SCALE = PixelScale(0.4, 0.45)
SLICE_FROM_FRAME = Pose(rotation_exp(np.array([0.12, -0.08, 0.3])), np.array([42.0, 48.0, 3.0]))
# Where write_slice puts the slice unless told otherwise.
SCANNER_FROM_SLICE = Pose(np.eye(3), np.array([-10.0, -20.0, 0.0]))
# How the cube roughly stands: without it, a slice is accepted with a caution.
CUBE_PRIOR = ["--max-rotation-deg", "40"]
LEKSELL_PRIOR = ["--threshold", "1000", "--nominal-orientation", "0", "0", "0", "1", "--max-rotation-deg", "30"]


@pytest.fixture(scope="session")
def cube_hu():
    """HU of a slice of the shipped cube at SLICE_FROM_FRAME."""
    settings = ScannerSettings(shape=(220, 230), scale=SCALE, body=False)
    placed = PlacedFrame(load_frame("cube6"), SLICE_FROM_FRAME)
    return render_slice([placed], settings, np.random.default_rng(1)).hu


@pytest.fixture(scope="session")
def cube_slice(tmp_path_factory, cube_hu):
    """That slice as a DICOM file."""
    return write_hu(tmp_path_factory.mktemp("cube") / "cube.dcm", cube_hu)


def write_hu(path: Path, hu: np.ndarray, **elements) -> Path:
    return write_slice(path, (hu + 1024).astype(np.uint16), PixelSpacing=[SCALE.sy, SCALE.sx], **elements)


@pytest.fixture
def stereoreg(capsys):
    """Call the command; returns exit code, standard output and standard error."""

    def call(*arguments):
        code: int | str | None
        try:
            code = cli.main([str(argument) for argument in arguments])
        except SystemExit as leaving:
            code = leaving.code
        output = capsys.readouterr()
        assert "Traceback" not in output.err
        return code, output.out, output.err

    return call


def objects(text: str) -> list[dict]:
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


def test_accepted_slice_as_json(stereoreg, cube_slice):
    code, output, errors = stereoreg("register", "--frame", "cube6", *CUBE_PRIOR, "--json", cube_slice)
    assert (code, errors) == (0, "")
    (found,) = objects(output)
    assert list(found) == ["file", *DIAGNOSTIC_KEYS, "scanner_from_frame", "matches"]
    assert found["file"] == str(cube_slice)
    assert (found["outcome"], found["reason"], found["frame"]) == ("accepted", "", "cube6")
    assert (found["inliers"], found["lines"], found["calibration"]) == (6, 6, "configured")
    assert (found["pixel_spacing_x_mm"], found["pixel_spacing_y_mm"]) == (0.4, 0.45)
    assert found["duration_ms"] > 0
    truth = SCANNER_FROM_SLICE @ SLICE_FROM_FRAME
    pose = found["scanner_from_frame"]
    scanner_from_frame = Pose.from_quaternion(pose["quaternion_xyzw"], pose["position_mm"])
    assert np.linalg.norm(scanner_from_frame.translation - truth.translation) < 0.5
    assert np.degrees(rotation_angle(scanner_from_frame.rotation @ truth.rotation.T)) < 0.5
    assert {match["line"] for match in found["matches"]} == set(load_frame("cube6").line_names)
    for match in found["matches"]:
        assert list(match) == ["line", "spot_px", "residual_mm"]
        assert len(match["spot_px"]) == 2
        assert 0 <= match["residual_mm"] < 0.5


def test_a_pose_without_an_orientation_bears_a_caution(stereoreg, cube_slice):
    (found,) = objects(stereoreg("register", "--frame", "cube6", "--json", cube_slice)[1])
    assert list(found) == ["file", *DIAGNOSTIC_KEYS, "caution", "scanner_from_frame", "matches"]
    assert found["outcome"] == "accepted"
    assert "no nominal orientation is configured" in found["caution"]
    assert stereoreg("register", "--frame", "cube6", cube_slice)[1].splitlines()[1].endswith(found["caution"])


WORST_KEYS = ["worst_case_target_error_mm", "worst_case_position_mm", "worst_case_rotation_deg"]


def test_worst_case_on_demand(stereoreg, cube_slice, tmp_path):
    target = ("--target-in-frame-mm", 0, 0, 100)
    dark = write_hu(tmp_path / "dark.dcm", np.full((64, 64), -1000))
    told = ("register", "--frame", "cube6", *target, "--max-spot-error", 0.05)
    code, output, errors = stereoreg(*told, "--json", cube_slice, dark)
    assert (code, errors) == (0, "")
    found, refused = objects(output)
    bounds = [found[key] for key in WORST_KEYS]
    assert all(0 < bound < 5 for bound in [bounds[0], *bounds[1], *bounds[2]])
    assert [len(bound) for bound in bounds[1:]] == [3, 3]
    assert refused["outcome"] == "refused"
    assert [refused[key] for key in WORST_KEYS] == [None] * 3
    # Of 0.02 pixel it is two fifths, but for the second order.
    (smaller,) = objects(stereoreg(*told[:-1], 0.02, "--json", cube_slice)[1])
    assert smaller[WORST_KEYS[0]] == pytest.approx(0.4 * bounds[0], rel=0.1)
    line = stereoreg(*told, cube_slice)[1].splitlines()[1]
    assert f"target off by at most {bounds[0]:.2f} mm" in line
    assert "no bound on the target error for spots 9 pixel off" in stereoreg(*told[:-1], 9, cube_slice)[1]
    (beyond,) = objects(stereoreg(*told[:-1], 9, "--json", cube_slice)[1])
    assert [beyond[key] for key in WORST_KEYS] == [None] * 3
    truth = SCANNER_FROM_SLICE @ SLICE_FROM_FRAME
    pose = found["scanner_from_frame"]
    stated = Pose.from_quaternion(pose["quaternion_xyzw"], pose["position_mm"])
    assert np.linalg.norm(stated @ np.array([0.0, 0, 100]) - truth @ np.array([0.0, 0, 100])) < bounds[0]


def test_table_for_people(stereoreg, cube_slice, tmp_path):
    dark = write_hu(tmp_path / "dark.dcm", np.full((64, 64), -1000))
    code, output, errors = stereoreg("register", "--frame", "cube6", *CUBE_PRIOR, cube_slice, dark)
    assert (code, errors) == (0, "")
    head, accepted, refused, summary = output.splitlines()
    assert head.split() == ["slice", "outcome", "rods", "residual", "position", "in", "the", "scanner"]
    assert accepted.split()[:5] == ["cube.dcm", "accepted", "6", "of", "6"]
    position = [float(number) for number in accepted.removesuffix(" mm").rsplit("mm", 1)[1].split(",")]
    np.testing.assert_allclose(position, (SCANNER_FROM_SLICE @ SLICE_FROM_FRAME).translation, atol=0.5)
    assert refused.split()[:2] == ["dark.dcm", "too_few_spots"]
    assert summary == "1 of 2 slices accepted, 1 refused (1 too_few_spots)"


def test_refused_slice_as_json(stereoreg, tmp_path):
    dark = write_hu(tmp_path / "dark.dcm", np.full((64, 64), -1000))
    code, output, _ = stereoreg("register", "--frame", "cube6", "--json", dark)
    assert code == 0
    (found,) = objects(output)
    assert list(found) == ["file", *DIAGNOSTIC_KEYS, "message", "scanner_from_frame", "matches"]
    assert (found["outcome"], found["reason"]) == ("refused", "too_few_spots")
    assert "0 spots" in found["message"]
    assert (found["scanner_from_frame"], found["matches"], found["residual_rms_mm"]) == (None, [], None)


NO_PLANE = {"ImagePositionPatient": None, "ImageOrientationPatient": None}


@pytest.mark.parametrize("sop_class", [CTImageStorage, DigitalXRayImageStorageForPresentation])
def test_what_lies_nowhere_in_the_scanner_has_a_pose_in_its_own_axes_only_where_that_is_asked_for(
    stereoreg, tmp_path, cube_hu, sop_class
):
    path = write_hu(tmp_path / "a.dcm", cube_hu, SOPClassUID=sop_class, **NO_PLANE)
    call = ["register", "--frame", "cube6", *CUBE_PRIOR, path]
    code, output, errors = stereoreg(*call, "--json")
    assert code == 1
    (found,) = objects(output)
    assert (found["outcome"], found["reason"], found["scanner_from_frame"]) == ("refused", "bad_image", None)
    assert "ask for poses in the slice's own axes: --slice-axes" in found["message"]
    assert "axes" not in found
    assert errors == f"stereoreg: {found['message']}\n"
    code, output, errors = stereoreg(*call, "--json", "--slice-axes")
    assert (code, errors) == (0, "")
    (found,) = objects(output)
    assert list(found) == ["file", *DIAGNOSTIC_KEYS, "axes", "scanner_from_frame", "matches"]
    assert (found["outcome"], found["axes"]) == ("accepted", "slice")
    position = found["scanner_from_frame"]["position_mm"]
    np.testing.assert_allclose(position, SLICE_FROM_FRAME.translation, atol=0.5)
    head = stereoreg(*call, "--slice-axes")[1].splitlines()[0]
    assert head.endswith("  residual  position in the slice's own axes")


def test_in_the_slices_own_axes_a_plane_does_not_count(stereoreg, cube_slice):
    call = ["register", "--frame", "cube6", *CUBE_PRIOR, "--json", "--slice-axes", cube_slice]
    (found,) = objects(stereoreg(*call)[1])
    position = found["scanner_from_frame"]["position_mm"]
    np.testing.assert_allclose(position, SLICE_FROM_FRAME.translation, atol=0.5)


def test_a_localizer_in_a_series_is_refused_and_the_slices_are_registered(stereoreg, tmp_path, cube_slice):
    (tmp_path / "slice.dcm").write_bytes(cube_slice.read_bytes())
    write_slice(tmp_path / "scout.dcm", np.zeros((8, 8)), 5.0, ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    code, output, _ = stereoreg("register", "--frame", "cube6", *CUBE_PRIOR, "--json", tmp_path)
    assert code == 1
    assert {Path(one["file"]).name: one["reason"] for one in objects(output)} == {
        "slice.dcm": "",
        "scout.dcm": "bad_image",
    }


def test_bad_files_among_good_ones(stereoreg, cube_slice, tmp_path):
    short = write_slice(tmp_path / "short.dcm", np.zeros((8, 8)), PixelData=b"\0" * 100)
    missing = tmp_path / "missing.dcm"
    code, output, errors = stereoreg("register", "--frame", "cube6", "--json", short, cube_slice, missing, cube_slice)
    assert code == 1
    found = objects(output)
    assert [one["file"] for one in found] == [str(path) for path in (short, cube_slice, missing, cube_slice)]
    assert [one["outcome"] for one in found] == ["refused", "accepted", "refused", "accepted"]
    assert list(found[0]) == ["file", *DIAGNOSTIC_KEYS, "message", "scanner_from_frame", "matches"]
    assert found[0]["reason"] == found[2]["reason"] == "bad_image"
    assert "Pixel Data (7FE0,0010) has 100 bytes, expected 128 bytes" in found[0]["message"]
    assert found[0]["pixel_spacing_x_mm"] is None
    assert [line.startswith("stereoreg: ") for line in errors.splitlines()] == [True, True]
    code, output, _ = stereoreg("register", "--frame", "cube6", short, cube_slice)
    assert code == 1
    assert output.splitlines()[-1] == "1 of 1 slices accepted, 0 refused, 1 not readable"


def test_faulty_file_in_a_folder(stereoreg, cube_slice, tmp_path):
    content = cube_slice.read_bytes()
    (tmp_path / "good.dcm").write_bytes(content)
    write_slice(tmp_path / "bad.dcm", np.zeros((8, 8)), PixelSpacing=None)
    (tmp_path / "note.txt").write_text("no image")
    code, output, errors = stereoreg("register", "--frame", "cube6", "--json", tmp_path)
    assert code == 1
    outcomes = {Path(one["file"]).name: one["outcome"] for one in objects(output)}
    assert outcomes == {"good.dcm": "accepted", "bad.dcm": "refused"}
    assert f"stereoreg: skipped {tmp_path / 'note.txt'}: not a DICOM file" in errors


def test_mixed_series(stereoreg, tmp_path):
    write_slice(tmp_path / "0.dcm", np.zeros((8, 8)))
    write_slice(tmp_path / "1.dcm", np.zeros((8, 8)), 1.0, SeriesInstanceUID="1.2.3")
    code, output, errors = stereoreg("register", "--frame", "cube6", "--json", tmp_path)
    assert code == 1
    (found,) = objects(output)
    assert (found["file"], found["reason"]) == (str(tmp_path), "bad_image")
    assert "holds 2 series, expected one" in found["message"]
    assert "holds 2 series, expected one" in errors


def test_own_pixel_scale(stereoreg, cube_slice):
    arguments = ["register", "--frame", "cube6", "--json", cube_slice]
    _, output, _ = stereoreg(*arguments, "--pixel-spacing", 0.4, 0.46)
    (found,) = objects(output)
    assert (found["pixel_spacing_x_mm"], found["pixel_spacing_y_mm"]) == (0.4, 0.46)
    plain = objects(stereoreg(*arguments)[1])[0]
    sheared = objects(stereoreg(*arguments, "--pixel-shear", 0.01)[1])[0]
    assert sheared["residual_rms_mm"] != plain["residual_rms_mm"]
    assert sheared["pixel_spacing_x_mm"] == 0.4


def test_every_option_has_its_flag(stereoreg, cube_slice, monkeypatch):
    given: list[RegistrationOptions] = []

    def register_slice(ct_slice, frame, options):
        given.append(options)
        return Refusal(frame, SliceSpots(np.empty((0, 2)), ct_slice.scale), "no_consensus", "not tried")

    monkeypatch.setattr("stereoreg_ros.cli.register.register_slice", register_slice)
    wanted = RegistrationOptions(
        threshold=-1.5e3,
        min_spot_area_mm2=1.0,
        max_spot_area_mm2=9.5,
        spot_noise_px=0.25,
        frame_tolerance_mm=0.35,
        scale_tolerance=1e-3,
        slice_thickness_mm=2.5,
        min_inliers=5,
        matcher="maurin2009",
        max_log10_false_alarms=-1e-5,
        nominal_orientation=(-1e-5, 0.0, -1.0, 0.5),
        max_rotation_deg=20.0,
        max_position_std_mm=2.0,
        target_in_frame_mm=(0.0, -30.0, 1e2),
        max_target_error_mm=2.5,
    )
    flags = []
    for entry in fields(RegistrationOptions):
        value = getattr(wanted, entry.name)
        assert value != entry.default, f"{entry.name}: the default shows no flag"
        flags += [f"--{entry.name.replace('_', '-')}", *(value if isinstance(value, tuple) else [value])]
    arguments = ["register", "--frame", "cube6", cube_slice]
    assert stereoreg(*arguments, *flags)[0] == 0
    assert stereoreg(*arguments)[0] == 0
    assert stereoreg(*arguments, "--threshold", "auto")[0] == 0
    assert given == [wanted, RegistrationOptions(), RegistrationOptions(threshold="auto")]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "COMMAND"),
        (["nonsense"], "nonsense"),
        (["register", "--frame", "cube6"], "PATH"),
        (["register", "x.dcm"], "--frame"),
        (["register", "--frame", "nowhere.yaml", "x.dcm"], "nowhere.yaml"),
        (["register", "--frame", "unheard", "x.dcm"], "unheard"),
        (["register", "--frame", "cube6", "--threshold", "high", "x.dcm"], "--threshold: invalid float value: 'high'"),
        (["register", "--frame", "cube6", "--threshold", "nan", "x.dcm"], "threshold is nan, expected a number"),
        (["register", "--frame", "cube6", "--min-inliers", "4.5", "x.dcm"], "--min-inliers"),
        (
            ["register", "--frame", "cube6", "--frame-tolerance-mm", "-1", "x.dcm"],
            "frame_tolerance_mm is -1.0, expected a number from 0 to 10",
        ),
        (
            ["register", "--frame", "cube6", "--scale-tolerance", "nan", "x.dcm"],
            "scale_tolerance is nan, expected a number from 0 to 0.1",
        ),
        (["register", "--frame", "cube6", "--matcher", "magic", "x.dcm"], "matcher is 'magic', expected one of"),
        (["register", "--frame", "cube6", "--nominal-orientation", *"0000", "x.dcm"], "nominal_orientation"),
        (["register", "--frame", "cube6", "--pixel-spacing", "0", "1", "x.dcm"], "sx is 0.0, expected a positive"),
        (["register", "--frame", "cube6", "--pixel-shear", "inf", "x.dcm"], "shear is inf"),
        (["register", "--frame", "cube6", "--target-in-frame-mm", "0", "nan", "0", "x.dcm"], "target_in_frame_mm is"),
        (
            ["register", "--frame", "cube6", "--max-target-error-mm", "0", "x.dcm"],
            "max_target_error_mm is 0.0, expected",
        ),
        (
            ["register", "--frame", "cube6", "--max-spot-error", "-1", "x.dcm"],
            "max_spot_error is -1.0, expected a number",
        ),
        (
            ["register", "--frame", "cube6", "--max-spot-error", "nan", "x.dcm"],
            "max_spot_error is nan, expected a number",
        ),
    ],
)
def test_wrong_calls(stereoreg, arguments, sentence):
    code, output, errors = stereoreg(*arguments)
    assert (code, output) == (2, "")
    assert errors.startswith("stereoreg")
    assert len(errors.splitlines()) == 1
    assert sentence in errors


def test_malformed_frame_file(stereoreg, tmp_path):
    frame = tmp_path / "frame.yaml"
    frame.write_text("name: two\nlines:\n  - {name: a, from: [0, 0, 0], to: [0, 0, 1], diameter: 1}\n")
    code, output, errors = stereoreg("register", "--frame", frame, "x.dcm")
    assert (code, output) == (2, "")
    assert str(frame) in errors
    assert len(errors.splitlines()) == 1


def test_overlays(stereoreg, cube_slice, tmp_path):
    dark = write_hu(tmp_path / "dark.dcm", np.full((64, 64), -1000))
    bad = tmp_path / "bad.dcm"
    bad.write_bytes(b"")
    folder = tmp_path / "pictures" / "of today"
    arguments = ["register", "--frame", "cube6", "--overlay", folder, cube_slice, cube_slice, dark, bad]
    for _ in range(2):
        assert stereoreg(*arguments)[0] == 1
        assert sorted(path.name for path in folder.iterdir()) == ["cube.png", "cube_2.png", "dark.png"]
    picture = cv2.imread(str(folder / "cube.png"))
    assert picture is not None
    assert picture.ndim == 3


def test_overlay_folder_that_cannot_be(stereoreg, cube_slice, tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("a file")
    code, output, errors = stereoreg("register", "--frame", "cube6", "--overlay", taken, cube_slice)
    assert (code, output) == (2, "")
    assert f"--overlay: {taken} cannot be created" in errors


def test_version_and_help(stereoreg):
    code, output, _ = stereoreg("--version")
    assert code == 0
    assert output.startswith("stereoreg ")
    code, output, _ = stereoreg("register", "--help")
    assert code == 0
    assert all(f"--{entry.name.replace('_', '-')}" in output for entry in fields(RegistrationOptions))


COMMAND = [sys.executable, "-m", "stereoreg_ros.cli"]


@pytest.fixture
def series(cube_slice, tmp_path):
    """The cube's slice three times, at different heights, in a folder."""
    hu = np.frombuffer(cube_slice.read_bytes()[-220 * 230 * 2 :], np.uint16).reshape(220, 230)
    for z in range(3):
        write_slice(tmp_path / f"{z}.dcm", hu, float(z), PixelSpacing=[SCALE.sy, SCALE.sx])
    return tmp_path


def test_progress_is_shown_to_people_only(series):
    arguments = [*COMMAND, "register", "--frame", "cube6", "--json", str(series)]
    quiet = subprocess.run(arguments, capture_output=True, text=True, check=True, timeout=60, cwd=ROOT)
    assert quiet.stderr == ""
    assert [Path(one["file"]).name for one in objects(quiet.stdout)] == ["0.dcm", "1.dcm", "2.dcm"]
    master, terminal = pty.openpty()
    try:
        # A new terminal has no columns, and so no room for a bar.
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        watched = subprocess.run(
            arguments, stdout=subprocess.PIPE, stderr=terminal, text=True, check=True, timeout=60, cwd=ROOT
        )
        ready, _, _ = select.select([master], [], [], 0)
        shown = os.read(master, 100_000).decode() if ready else ""
    finally:
        os.close(master)
        os.close(terminal)
    assert "0/3" in shown
    assert len(objects(watched.stdout)) == 3


def test_reader_that_has_seen_enough(series):
    arguments = [*COMMAND, "register", "--frame", "cube6", "--json", *[str(series)] * 3]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(60) == 1


def test_leksell_is_ambiguous_without_a_prior(stereoreg):
    path = real(SHARED_DATA / "leksell_ct" / "slice.dcm")
    code, output, _ = stereoreg("register", "--frame", "leksell_ct", "--threshold", 1000, "--json", path)
    assert code == 0
    (found,) = objects(output)
    assert (found["reason"], found["ambiguous_poses"]) == ("ambiguous", 4)
    assert found["scanner_from_frame"] is None
    assert len(found["alternatives"]) == 4
    for alternative in found["alternatives"]:
        assert list(alternative) == ["scanner_from_frame", "inliers", "residual_rms_mm"]
        assert alternative["inliers"] == 6
        assert alternative["residual_rms_mm"] < 0.3


def test_leksell_is_accepted_with_a_prior(stereoreg):
    path = real(SHARED_DATA / "leksell_ct" / "slice.dcm")
    arguments = ["register", "--frame", "leksell_ct", "--json", *LEKSELL_PRIOR, path]
    # Two plates leave the tilt weak: at the frame's corner it is not known well enough, in the head it is.
    (corner,) = objects(stereoreg(*arguments)[1])
    assert corner["reason"] == "inaccurate"
    assert corner["target_error_95_mm"] > 3.0
    assert "raise max_target_error_mm" in corner["message"]
    code, output, _ = stereoreg(*arguments, "--target-in-frame-mm", 95, -60, -60)
    assert code == 0
    (found,) = objects(output)
    assert (found["outcome"], found["inliers"]) == ("accepted", 6)
    assert found["residual_rms_mm"] <= 0.3
    spots = {tuple(np.round(match["spot_px"])) for match in found["matches"]}
    expected = [(105.5, 162.3), (108.3, 246.9), (111.4, 354.3), (408.9, 153.1), (411.5, 232.9), (414.5, 345.0)]
    for spot in expected:
        assert min(np.hypot(*np.subtract(spot, one)) for one in spots) < 2


def test_zframe_series_with_a_prior(stereoreg):
    arguments = ["--threshold", 200, "--nominal-orientation", 0, 0, 0, 1, "--max-rotation-deg", 30, "--json"]
    code, output, _ = stereoreg("register", "--frame", "zframe", *arguments, real(SHARED_DATA / "zframe_mr"))
    assert code == 0
    found = {Path(one["file"]).stem: one for one in objects(output)}
    assert len(found) == 20
    for number in range(6, 12):
        assert found[f"slice_{number:02}"]["outcome"] == "accepted"


def test_catphan_series(stereoreg):
    arguments = ["--threshold", 300, "--max-rotation-deg", 20, "--json"]
    code, output, errors = stereoreg("register", "--frame", "catphan_ctp404", *arguments, real(CATPHAN))
    assert code == 0
    found = objects(output)
    assert len(found) == 64
    assert "RT Structure Set" in errors or not list(CATPHAN.glob("RS*"))
    assert sum(one["outcome"] == "accepted" for one in found) >= 6


@pytest.fixture(scope="session")
def off_series(tmp_path_factory):
    """Four slices of the cube, whose files say 2 % more and 1 % less."""
    folder = tmp_path_factory.mktemp("series")
    frame, rng = load_frame("cube6"), np.random.default_rng(5)
    settings = ScannerSettings(shape=(220, 230), scale=SCALE, body=False)
    for number in range(4):
        placed = PlacedFrame(frame, random_pose(rng, frame, settings))
        hu = render_slice([placed], settings, rng).hu
        stored = (hu + 1024).astype(np.uint16)
        write_slice(folder / f"{number}.dcm", stored, z=float(number), PixelSpacing=[0.99 * SCALE.sy, 1.02 * SCALE.sx])
    return folder


# What a file says of its spacing is known better than what somebody typed in: so large a change has to be allowed.
CHANGE = ["--calibration-max-change", "0.15"]


class TestCalibrate:
    """The pixel spacing of a series whose files say one that is off."""

    def test_table_and_plot(self, stereoreg, off_series, tmp_path):
        plot = tmp_path / "scale.png"
        code, output, _ = stereoreg("calibrate", "--frame", "cube6", *CHANGE, "--plot", plot, off_series)
        assert code == 0
        lines = output.splitlines()
        assert len(lines) == 1 + 4 + 1
        assert lines[-1].startswith("pixel spacing changed from (0.4080, 0.4455) to (0.")
        assert "from 4 slices with 24 rods" in lines[-1]
        assert cv2.imread(str(plot)) is not None

    def test_json(self, stereoreg, off_series):
        code, output, _ = stereoreg("calibrate", "--frame", "cube6", *CHANGE, "--json", off_series)
        assert code == 0
        record = json.loads(output)
        assert record["outcome"] == "accepted"
        assert record["given_pixel_spacing"] == pytest.approx([0.408, 0.4455])
        for found, true, error in zip(
            record["pixel_spacing"], (SCALE.sx, SCALE.sy), record["standard_errors"], strict=True
        ):
            assert abs(found - true) < 4 * error
        assert [one["rods"] for one in record["slices"]] == [6] * 4
        for one in record["slices"]:
            assert one["newton_raphson"] == pytest.approx([SCALE.sx, SCALE.sy], rel=0.01)
            assert one["linear"] == pytest.approx([SCALE.sx, SCALE.sy], rel=0.01)

    @pytest.mark.parametrize("change", [[], ["--calibration-max-change", "0.015"]], ids=["default", "set"])
    def test_refused(self, stereoreg, off_series, change):
        code, output, _ = stereoreg("calibrate", "--frame", "cube6", *change, "--json", off_series)
        assert code == 0
        record = json.loads(output)
        assert record["outcome"] == "refused"
        assert record["pixel_spacing"] is None
        assert record["slices"] == []
        assert record["message"].startswith("calibration refused: ")

    def test_wrong_calls(self, stereoreg, off_series, tmp_path):
        assert (
            "calibration_max_change is 0.9"
            in stereoreg("calibrate", "--frame", "cube6", "--calibration-max-change", "0.9", off_series)[2]
        )
        code, _, errors = stereoreg("calibrate", "--frame", "cube6", tmp_path / "nothing")
        assert code == 1
        assert "nothing" in errors

    def test_one_unreadable_file_is_named_and_changes_the_exit_status(self, stereoreg, off_series, tmp_path):
        """What the others say is told all the same."""
        broken = tmp_path / "broken.dcm"
        broken.write_bytes(b"\0" * 128 + b"DICM" + b"\xff" * 40)
        code, output, errors = stereoreg("calibrate", "--frame", "cube6", *CHANGE, "--json", off_series, broken)
        assert code == 1
        assert "broken.dcm" in errors
        record = json.loads(output)
        assert record["outcome"] == "accepted"
        assert len(record["slices"]) == 4

    def test_spacings_that_differ(self, stereoreg, off_series, tmp_path):
        other = tmp_path / "other.dcm"
        write_slice(other, np.zeros((64, 64), np.uint16), PixelSpacing=[0.7, 0.7])
        code, _, errors = stereoreg("calibrate", "--frame", "cube6", off_series, other)
        assert code == 1
        assert "other.dcm: pixel spacing is (0.7, 0.7) mm/pixel, expected that of the slices before" in errors
