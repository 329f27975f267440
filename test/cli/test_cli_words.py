"""What the commands say of results made by hand, and what they pass on: no two numbers are alike."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, cli, load_frame
from stereoreg_ros.calibration.calibrate import Calibration
from stereoreg_ros.calibration.series import SeriesScale, SliceScale
from stereoreg_ros.cli.inspect import USED_OPTIONS
from stereoreg_ros.frames.design_search import Requirements
from stereoreg_ros.frames.expected_error import Imaging
from stereoreg_ros.frames.proposal import Proposal
from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions
from stereoreg_ros.result import Match, PoseEstimate, Reason, Refusal, Registration
from stereoreg_ros.worst_case import WorstCase
from support.dicom_files import write_slice

FRAME = load_frame("cube6")
IMAGE = np.arange(6 * 8, dtype=np.uint16).reshape(6, 8)
SCALE = PixelScale(0.4, 0.7)
TURNED = Pose(rotation_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([1.25, -20.5, 300.0]))
OTHER = Pose(rotation_exp(np.array([np.pi, 0.0, 0.0])), np.array([4.0, 5.0, 6.0]))


def estimate(pose: Pose = TURNED, rods: int = 5, residual_mm: float = 0.25) -> PoseEstimate:
    """Whose slice lies elsewhere, with spots in another order than the rods."""
    matches = tuple(
        Match(FRAME.line_names[row], row, rods - row, np.array([10.0 + row, 20.5]), np.array([10.0, 20.0]), residual_mm)
        for row in range(rods)
    )
    return PoseEstimate(OTHER, pose, np.diag([0.01, 0.04, 0.09, 1e-6, 1e-6, 1e-6]), matches, 3.0, -9.5)


def accepted(caution: str = "") -> Registration:
    return Registration(FRAME, SliceSpots(np.zeros((9, 2)), SCALE), RegistrationOptions(), estimate(), caution)


def refused(reason: Reason, *estimates: PoseEstimate) -> Refusal:
    return Refusal(FRAME, SliceSpots(np.zeros((9, 2)), SCALE), reason, f"because it is {reason}", estimates)


class Command:
    """`stereoreg register` of slices with results that were made by hand."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._folder, self._capsys = folder, capsys
        self.results: list[Registration | Refusal] = []
        self.slices: list[Slice] = []
        monkeypatch.setattr("stereoreg_ros.cli.register.register_slice", self._register)

    def _register(self, ct_slice: Slice, *_: object) -> Registration | Refusal:
        self.slices.append(ct_slice)
        return self.results[len(self.slices) - 1]

    def __call__(self, results: list[Registration | Refusal], *arguments: object, name: str = "slice") -> list[str]:
        """Lines of the output."""
        self.results, self.slices = results, []
        paths = [
            write_slice(self._folder / f"{name}{number}.dcm", IMAGE, PixelSpacing=[SCALE.sy, SCALE.sx])
            for number in range(len(results))
        ]
        assert cli.main(["register", "--frame", "cube6", *map(str, [*arguments, *paths])]) == 0
        return self._capsys.readouterr().out.splitlines()

    def json(self, result: Registration | Refusal, *arguments: object) -> dict[str, Any]:
        (line,) = self([result], "--json", *arguments)
        found: dict[str, Any] = json.loads(line)
        return found


def words(line: str) -> str:
    """A line of a table without its columns."""
    return " ".join(line.split())


@pytest.fixture
def register(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    ("flags", "scale"),
    [
        ([], PixelScale(0.4, 0.7)),
        (["--pixel-shear", -0.02], PixelScale(0.4, 0.7, -0.02)),
        (["--pixel-spacing", 0.9, 0.3], PixelScale(0.9, 0.3)),
        (["--pixel-spacing", 0.9, 0.3, "--pixel-shear", 0.01], PixelScale(0.9, 0.3, 0.01)),
    ],
)
def test_the_scale_is_the_files_unless_it_is_told(register: Command, flags: list[object], scale: PixelScale) -> None:
    register([accepted()], *flags)
    (ct_slice,) = register.slices
    assert ct_slice.scale == scale
    np.testing.assert_array_equal(ct_slice.hu, IMAGE - 1024.0)
    np.testing.assert_array_equal(ct_slice.scanner_from_slice.translation, [-10.0, -20.0, 0.0])


def test_an_accepted_slice_tells_the_pose_in_the_scanner_and_each_match(register: Command) -> None:
    found = register.json(accepted())
    assert found["scanner_from_frame"]["position_mm"] == [1.25, -20.5, 300.0]
    assert found["scanner_from_frame"]["quaternion_xyzw"] == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert found["matches"][1] == {"line": FRAME.line_names[1], "spot_px": [11.0, 20.5], "residual_mm": 0.25}
    assert (found["spots"], found["lines"], found["inliers"], found["ambiguous_poses"]) == (9, 6, 5, 1)
    assert (found["pixel_spacing_x_mm"], found["pixel_spacing_y_mm"]) == (0.4, 0.7)
    assert (found["position_std_mm"], found["log10_false_alarms"]) == (pytest.approx(0.3), -9.5)
    assert "caution" not in found
    assert "alternatives" not in found
    assert register.json(accepted("look twice"))["caution"] == "look twice"


def test_an_ambiguous_slice_tells_every_pose_and_none_as_the_pose(register: Command) -> None:
    found = register.json(refused("ambiguous", estimate(), estimate(OTHER, 4, 0.5)))
    assert (found["scanner_from_frame"], found["matches"]) == (None, [])
    first, second = found["alternatives"]
    assert first["scanner_from_frame"]["position_mm"] == [1.25, -20.5, 300.0]
    assert second["scanner_from_frame"]["position_mm"] == [4.0, 5.0, 6.0]
    assert (first["inliers"], second["inliers"]) == (5, 4)
    assert (first["residual_rms_mm"], second["residual_rms_mm"]) == (0.25, 0.5)
    assert found["ambiguous_poses"] == 2


@pytest.mark.parametrize("reason", ["no_consensus", "inaccurate"])
def test_a_pose_that_is_not_to_be_believed_is_not_told_as_the_pose(register: Command, reason: Reason) -> None:
    found = register.json(refused(reason, estimate()))
    assert (found["outcome"], found["reason"], found["message"]) == ("refused", reason, f"because it is {reason}")
    assert (found["scanner_from_frame"], found["matches"]) == (None, [])
    assert "alternatives" not in found
    # How good it looked is told.
    assert (found["inliers"], found["residual_rms_mm"]) == (5, 0.25)


def test_the_worst_case_is_told_in_its_order_and_null_where_there_is_none(
    register: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    bounds = WorstCase(0.3, 1.5, np.array([0.1, 0.2, 0.3]), np.array([4.0, 5.0, 6.0]))
    asked: list[float] = []

    def worst_case(_: Registration, max_spot_error_px: float) -> WorstCase | None:
        asked.append(max_spot_error_px)
        return bounds if max_spot_error_px < 1 else None

    monkeypatch.setattr("stereoreg_ros.cli.register.worst_case", worst_case)
    found = register.json(accepted(), "--max-spot-error", 0.3)
    assert found["worst_case_target_error_mm"] == 1.5
    assert found["worst_case_position_mm"] == [0.1, 0.2, 0.3]
    assert found["worst_case_rotation_deg"] == [4.0, 5.0, 6.0]
    found = register.json(accepted(), "--max-spot-error", 2)
    assert found["worst_case_target_error_mm"] is found["worst_case_position_mm"] is None
    assert asked == [0.3, 2.0]
    found = register.json(refused("no_consensus", estimate()), "--max-spot-error", 0.3)
    assert found["worst_case_target_error_mm"] is None
    assert len(asked) == 2
    # A spot may be off by nothing at all.
    assert register.json(accepted(), "--max-spot-error", 0)["worst_case_target_error_mm"] == 1.5


def test_the_table_and_its_sum(register: Command) -> None:
    results: list[Registration | Refusal] = [
        accepted(),
        refused("ambiguous", estimate(OTHER, 4, 0.5), estimate()),
        accepted("look twice"),
        refused("no_consensus"),
        refused("ambiguous", estimate()),
    ]
    _, first, second, third, fourth, _, total = register(results)
    assert words(first) == "slice0.dcm accepted 5 of 6 0.25 mm 1.2, -20.5, 300.0 mm"
    assert words(second) == "slice1.dcm ambiguous 4 of 6 0.50 mm because it is ambiguous"
    assert third.endswith("1.2, -20.5, 300.0 mm; look twice")
    assert words(fourth) == "slice3.dcm no_consensus because it is no_consensus"
    assert total == "2 of 5 slices accepted, 3 refused (2 ambiguous, 1 no_consensus)"


def test_of_a_long_name_the_end_is_shown(register: Command) -> None:
    """Names of files mostly differ at their ends."""
    line = register([accepted()], name="a-very-long-name-of-a-series-of-the-day-")[1]
    assert line.startswith("...")
    assert line[3:32] == "a-very-long-name-of-a-series-of-the-day-0.dcm"[-29:]
    assert line[32:].startswith("  accepted")


class TestCalibrate:
    CALIBRATION = Calibration(
        PixelScale(0.41, 0.69, 0.003),
        PixelScale(0.4, 0.7),
        (0.001, 0.002, 0.0005),
        np.diag([1e-6, 4e-6, 2.5e-7]),
        (0.0003, 0.0004, 0.0001),
        3,
        17,
        0.9,
        0.4,
        (),
        "pixel spacing changed",
    )
    ALONE = SliceScale("a-name.dcm", 5, PixelScale(0.42, 0.68), PixelScale(0.415, 0.685), (0.003, 0.004))

    def call(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *flags: object) -> None:
        """With what the series came to made by hand."""
        self.given: tuple[RegistrationOptions, CalibrationOptions] | None = None

        def scale_of_series(
            slices: Any, _frame: Any, options: RegistrationOptions, calibration: CalibrationOptions, _tell: Any
        ) -> SeriesScale:
            self.given = options, calibration
            self.names = [name for name, _ in slices]
            return SeriesScale(SCALE, self.CALIBRATION, (self.ALONE,))

        monkeypatch.setattr("stereoreg_ros.cli.calibrate.scale_of_series", scale_of_series)
        path = write_slice(tmp_path / "one.dcm", IMAGE)
        assert cli.main(["calibrate", "--frame", "cube6", *map(str, [*flags, path])]) == 0

    def test_as_json(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.call(monkeypatch, tmp_path, "--json")
        assert json.loads(capsys.readouterr().out) == {
            "outcome": "accepted",
            "message": "pixel spacing changed",
            "given_pixel_spacing": [0.4, 0.7],
            "pixel_spacing": [0.41, 0.69],
            "pixel_shear": 0.003,
            "standard_errors": [0.001, 0.002, 0.0005],
            "frame_errors": [0.0003, 0.0004, 0.0001],
            "residual_before_px": 0.9,
            "residual_after_px": 0.4,
            "slices": [
                {
                    "file": "a-name.dcm",
                    "rods": 5,
                    "linear": [0.42, 0.68],
                    "newton_raphson": [0.415, 0.685],
                    "standard_errors": [0.003, 0.004],
                }
            ],
        }
        assert self.names == ["one.dcm"]

    def test_as_a_table(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.call(monkeypatch, tmp_path)
        _, alone, outcome = capsys.readouterr().out.splitlines()
        told = "a-name.dcm 5 0.4200, 0.6800 0.4150 +- 0.0030, 0.6850 +- 0.0040 +3.75, -2.14"
        assert words(alone) == told
        assert outcome == "pixel spacing changed"

    def test_options_of_both_kinds_are_passed_on(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        flags = (
            "--calibrate-shear",
            "--calibration-max-change",
            0.1,
            "--calibration-slices",
            7,
            "--spot-noise-px",
            0.2,
        )
        self.call(monkeypatch, tmp_path, *flags)
        assert self.given == (
            RegistrationOptions(spot_noise_px=0.2),
            CalibrationOptions(calibration_slices=7, calibrate_shear=True, calibration_max_change=0.1),
        )
        self.call(monkeypatch, tmp_path)
        assert self.given == (RegistrationOptions(), CalibrationOptions())


# As `inspect` and `design` take them: every option with another value than its default.
OPTIONS = RegistrationOptions(
    spot_noise_px=0.25,
    frame_tolerance_mm=0.0,
    scale_tolerance=0.003,
    slice_thickness_mm=2.5,
    min_inliers=5,
    max_log10_false_alarms=-3.5,
    nominal_orientation=(0.0, 1.0, 0.0, 0.0),
    max_rotation_deg=20.0,
    target_in_frame_mm=(1.0, -2.0, 3.0),
    max_target_error_mm=2.25,
)


def flags_of(options: RegistrationOptions) -> list[str]:
    flags = []
    for name in USED_OPTIONS:
        value = asdict(options)[name]
        flags += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else [value])]
    return flags


def test_inspect_passes_on_all_its_options(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    given: list[tuple[Any, ...]] = []

    def inspect_frame(*arguments: Any) -> None:
        given.append(arguments[:-1])
        raise ValueError("seen enough")

    monkeypatch.setattr("stereoreg_ros.cli.inspect.inspect_frame", inspect_frame)
    slices = ["--pixel-spacing", "0.4", "0.7", "--tilt", "12", "--poses", "34", "--seed", "5"]
    assert cli.main(["inspect", "--frame", "cube5", *slices, *flags_of(OPTIONS)]) == 2
    assert capsys.readouterr().err == "stereoreg: seen enough\n"
    ((frame, *others),) = given
    assert frame.name == "cube5"
    assert others == [OPTIONS, PixelScale(0.4, 0.7), 12.0, 34, 5]


class TestDesign:
    """With a proposal that was made by hand in place of a search."""

    FLAGS = (
        *("--name", "mine", "--lines", "5", "--envelope", "30", "40", "80", "--diameter", "0.5", "--gap", "2.5"),
        *("--pixel-spacing", "0.4", "0.7", "--tilt", "12", "--seed", "3", "--chains", "7"),
        *flags_of(OPTIONS),
    )

    def call(
        self, monkeypatch: pytest.MonkeyPatch, folder: Path, *flags: str, ambiguous: int = 0, interrupted: bool = False
    ) -> int:
        self.asked: tuple[Any, ...] = ()

        def propose(*asked: Any) -> Proposal:
            self.asked = asked[:-1]
            return Proposal(FRAME, 0.25, ambiguous, 20, interrupted)

        monkeypatch.setattr("stereoreg_ros.cli.design.propose", propose)
        monkeypatch.setattr("stereoreg_ros.cli.design.inspected", lambda *_: None)
        monkeypatch.setattr("stereoreg_ros.cli.design.table_of", lambda _: ["a table"])
        monkeypatch.setattr("stereoreg_ros.cli.design.draw", lambda *_: None)
        return cli.main(["design", *flags, "--output", str(folder)])

    def test_all_options_are_passed_on(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        assert self.call(monkeypatch, tmp_path, *self.FLAGS) == 0
        requirements, *others = self.asked
        assert isinstance(requirements, Requirements)
        assert (requirements.envelope.size_mm, requirements.envelope.gap_mm) == ((30.0, 40.0, 80.0), 2.5)
        assert requirements.diameters_mm == (0.5,) * 5
        assert requirements.imaging == Imaging.of(PixelScale(0.4, 0.7), OPTIONS)
        assert requirements.target_mm == (1.0, -2.0, 3.0)
        # By default a quarter of the box's height.
        assert (requirements.largest_tilt_deg, requirements.largest_height_mm) == (12.0, 20.0)
        assert others == ["mine", OPTIONS, 3, 7]

    @pytest.mark.parametrize("height", [0.0, 7.5])
    def test_a_height_can_be_given_even_zero(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, height: float
    ) -> None:
        assert self.call(monkeypatch, tmp_path, *self.FLAGS, "--height", str(height)) == 0
        assert self.asked[0].largest_height_mm == height

    def test_the_call_that_stands_in_the_file_asks_for_the_same(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        assert self.call(monkeypatch, tmp_path, *self.FLAGS, "--height", "0") == 0
        requirements, *others = self.asked
        lines = [line[2:] for line in (tmp_path / "mine.yaml").read_text().splitlines() if line.startswith("# ")]
        assert lines[0].startswith("6 rods; 95 % target error 0.250 mm over the requested slices")
        assert "0 of 20 spot sets ambiguous" in lines[0]
        begin = next(number for number, line in enumerate(lines) if line.startswith("stereoreg design"))
        end = next(number for number, line in enumerate(lines) if line.startswith("Axes"))
        called = shlex.split(" ".join(lines[begin:end]))
        assert self.call(monkeypatch, tmp_path, *called[2:]) == 0
        again = self.asked[0]
        assert self.asked[1:] == tuple(others)
        assert (again.envelope, again.diameters_mm, again.imaging) == (
            requirements.envelope,
            requirements.diameters_mm,
            requirements.imaging,
        )
        assert (again.target_mm, again.largest_tilt_deg, again.largest_height_mm) == (requirements.target_mm, 12.0, 0.0)

    def test_an_ambiguous_frame_is_written_and_complained_of(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert self.call(monkeypatch, tmp_path, *self.FLAGS, ambiguous=1) == 1
        assert {path.name for path in tmp_path.iterdir()} == {"mine.yaml", "mine.txt"}
        assert "another pose explains 1 of 20 spot sets as well" in capsys.readouterr().err

    def test_an_interrupted_search_leaves_its_best_and_no_report(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert self.call(monkeypatch, tmp_path, *self.FLAGS, interrupted=True) == 130
        assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]
        assert "mine.yaml is the best layout so far, not checked for ambiguous poses" in capsys.readouterr().err


@pytest.mark.parametrize(("raised", "code"), [(OSError(28, "No space left on device"), 1), (KeyboardInterrupt(), 130)])
def test_what_cannot_be_written_and_what_is_interrupted_do_not_end_well(
    register: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, raised: BaseException, code: int
) -> None:
    path = write_slice(tmp_path / "one.dcm", IMAGE)

    def write(*_: object) -> None:
        raise raised

    monkeypatch.setattr("stereoreg_ros.cli.register.draw_overlay", lambda *_: np.zeros((4, 4, 3), np.uint8))
    monkeypatch.setattr(Path, "write_bytes", write)
    register.results = [accepted()]
    assert cli.main(["register", "--frame", "cube6", "--overlay", str(tmp_path), str(path)]) == code


def test_behind_a_slice_whose_pixels_cannot_be_read_its_series_goes_on(
    register: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for z in range(3):
        pixels = {"PixelData": IMAGE.tobytes()[:90]} if z == 1 else {}
        write_slice(tmp_path / f"{z}.dcm", IMAGE, float(z), **pixels)
    register.results = [accepted(), refused("no_consensus")]
    assert cli.main(["register", "--frame", "cube6", "--json", str(tmp_path)]) == 1
    output = capsys.readouterr()
    records = [json.loads(line) for line in output.out.splitlines()]
    assert [(Path(one["file"]).name, one["reason"]) for one in records] == [
        ("0.dcm", ""),
        ("1.dcm", "bad_image"),
        ("2.dcm", "no_consensus"),
    ]
    assert "1.dcm: Pixel Data (7FE0,0010) has 90 bytes, expected 96 bytes" in output.err
