"""The scanner's scale from slices, from a wrong start too, and when it is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereoreg_ros.calibration import measured
from stereoreg_ros.calibration.calibrate import Calibration, CalibrationRefusal, calibrate
from stereoreg_ros.calibration.series import scale_of_series
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.simulation import (
    PlacedFrame,
    ScannerSettings,
    SpotSetSettings,
    random_pose,
    random_spot_set,
    render_slice,
)
from stereoreg_ros.solvers.tolerant_calibration import TolerantScale, calibrate_tolerantly
from support.frames import random_frame, random_slice_from_frame

TRUE = PixelScale(0.5, 0.48)
SCANNER = ScannerSettings(scale=TRUE)
NOISE_PX = 0.25
OPTIONS = RegistrationOptions(spot_noise_px=NOISE_PX)
EXACT_FRAME = replace(OPTIONS, frame_tolerance_mm=0.0)
SCALE_OR_SIZE = "Slices cannot distinguish the scale from the size of the frame"


def seen(spots_px: np.ndarray, stated: PixelScale | None = None) -> SliceSpots:
    return SliceSpots(spots_px, TRUE, stated_scale=stated)


def slices_of(
    rng: np.random.Generator,
    frame: Frame,
    count: int,
    false_spots: int = 0,
    noise_px: float = NOISE_PX,
    stated: PixelScale | None = None,
) -> list[SliceSpots]:
    settings = SpotSetSettings(SCANNER, len(frame), false_spots, noise_px, gaussian=True)
    return [seen(random_spot_set(rng, frame, settings).spots_px, stated) for _ in range(count)]


def grown(frame: Frame, factor: float) -> Frame:
    """A frame of another size."""
    return replace(frame, starts=factor * frame.starts, ends=factor * frame.ends)


def as_built(rng: np.random.Generator, frame: Frame, tolerance_mm: float) -> Frame:
    """A frame whose rods end somewhat off where they should."""
    starts, ends = (points + tolerance_mm * rng.standard_normal(points.shape) for points in (frame.starts, frame.ends))
    return replace(frame, starts=starts, ends=ends)


@pytest.fixture(scope="module")
def cube() -> Frame:
    return load_frame("cube6")


class TestAccepted:
    @pytest.mark.parametrize("slices", [1, 3, 10])
    def test_standard_errors_are_those_of_many_trials(self, cube: Frame, slices: int) -> None:
        rng = np.random.default_rng(slices)
        nees = []
        trials = {1: 60, 3: 24, 10: 8}[slices]
        for _ in range(trials):
            found = calibrate(slices_of(rng, cube, slices), cube, TRUE, EXACT_FRAME)
            assert isinstance(found, Calibration), found.message
            assert found.frame_errors == (0.0, 0.0)
            assert "the frame is taken to be exact" in found.message
            error = np.array([found.scale.sx - TRUE.sx, found.scale.sy - TRUE.sy])
            nees.append(error @ np.linalg.solve(found.covariance, error))
            # A slice in a hundred or so may be refused.
            assert found.slices >= 0.9 * slices
            assert found.rods == 6 * found.slices
        # Residuals larger than stated widen the errors, smaller ones do not narrow them: a little below 2.
        assert 2 - 4 * math.sqrt(4 / trials) < np.mean(nees) < 2 + 3 * math.sqrt(4 / trials)

    def test_forty_three_slices_are_good_to_a_thousandth(self, cube: Frame) -> None:
        rng = np.random.default_rng(43)
        found = calibrate(slices_of(rng, cube, 43), cube, TRUE, EXACT_FRAME)
        assert isinstance(found, Calibration), found.message
        assert abs(found.scale.sx / TRUE.sx - 1) <= 1e-3
        assert abs(found.scale.sy / TRUE.sy - 1) <= 1e-3

    def test_exact_spots(self, cube: Frame) -> None:
        found = calibrate(slices_of(np.random.default_rng(2), cube, 2, noise_px=0.0), cube, TRUE, OPTIONS)
        assert isinstance(found, Calibration)
        assert found.scale.sx == pytest.approx(TRUE.sx, abs=1e-8)
        assert found.scale.sy == pytest.approx(TRUE.sy, abs=1e-8)
        assert found.residual_after_px < 1e-5

    @pytest.mark.parametrize("slices", [1, 4])
    def test_from_ten_percent_wrong(self, cube: Frame, slices: int) -> None:
        """False spots among the rods, and either axis off by up to a tenth, in opposite ways too."""
        rng = np.random.default_rng(10 + slices)
        refused = 0
        for trial in range(6):
            by_x, by_y = rng.choice([0.9, 1.1], 2) if trial % 2 else 1 + rng.uniform(-0.1, 0.1, 2)
            told = PixelScale(by_x * TRUE.sx, by_y * TRUE.sy)
            found = calibrate(slices_of(rng, cube, slices, int(rng.integers(0, 9))), cube, told, OPTIONS)
            if not isinstance(found, Calibration):
                refused += 1
                continue
            assert found.previous_scale == told
            for new, true, error in zip(
                (found.scale.sx, found.scale.sy), (TRUE.sx, TRUE.sy), found.standard_errors, strict=True
            ):
                assert abs(new - true) < 4.5 * error
        assert refused <= 1

    def test_a_slice_accepted_with_one_rod_left_out_does_not_decide(self, cube: Frame) -> None:
        """With a scale 5 % off some slices are accepted, the rod that fits worst left out."""
        rng = np.random.default_rng(5)
        for _ in range(6):
            told = PixelScale(1.03 * TRUE.sx, 0.95 * TRUE.sy)
            found = calibrate(slices_of(rng, cube, 5, 3), cube, told, OPTIONS)
            assert isinstance(found, Calibration), found.message
            assert found.slices == 5
            assert abs(found.scale.sx / TRUE.sx - 1) < 0.01
            assert abs(found.scale.sy / TRUE.sy - 1) < 0.01

    def test_slices_without_the_frame_do_no_harm(self, cube: Frame) -> None:
        rng = np.random.default_rng(6)
        clutter = [seen(rng.uniform(0, 500, (12, 2))) for _ in range(3)]
        found = calibrate([*clutter, *slices_of(rng, cube, 3, 2), *clutter], cube, TRUE, OPTIONS)
        assert isinstance(found, Calibration), found.message
        assert found.slices == 3

    def test_shear(self, cube: Frame) -> None:
        rng = np.random.default_rng(7)
        sheared = PixelScale(TRUE.sx, TRUE.sy, 0.01)
        taken = []
        for _ in range(12):
            spots, _ = project(cube, random_pose(rng, cube, SCANNER), sheared)
            taken.append(seen(spots + rng.normal(0, 0.1, spots.shape)))
        options = replace(OPTIONS, spot_noise_px=0.1)
        found = calibrate(taken, cube, replace(sheared, shear=0.0), options, CalibrationOptions(calibrate_shear=True))
        assert isinstance(found, Calibration), found.message
        assert abs(found.scale.shear - 0.01) < 4 * found.standard_errors[2]
        assert found.standard_errors[2] < 0.002
        assert "shear 0.0" in found.message

    def test_the_message_has_the_figures(self, cube: Frame) -> None:
        told = PixelScale(0.505, 0.485)
        found = calibrate(slices_of(np.random.default_rng(8), cube, 3), cube, told, OPTIONS)
        assert isinstance(found, Calibration)
        assert found.message.startswith("pixel spacing changed from (0.5050, 0.4850) to (0.")
        assert f"{found.scale.sx:.4f} +- {found.standard_errors[0]:.4f}" in found.message
        assert f"{found.scale.sy:.4f} +- {found.standard_errors[1]:.4f}" in found.message
        assert "from 3 slices with 18 rods" in found.message
        by_x, by_y = found.frame_errors
        assert f"rod ends known to 0.2 mm contribute {by_x:.4f} and {by_y:.4f} to the errors" in found.message
        assert SCALE_OR_SIZE in found.message
        assert found.residual_after_px < found.residual_before_px


class TestFrameAsBuilt:
    """Rods that are not quite where their file has them, in every slice the same way."""

    @pytest.mark.parametrize("slices", [1, 6])
    def test_standard_errors_hold_what_the_tolerance_does(self, cube: Frame, slices: int) -> None:
        """About 0.2 % of a cube of 60 mm, which more slices do not make less."""
        rng = np.random.default_rng(100 + slices)
        nees = []
        trials = 40 if slices == 1 else 8
        for _ in range(trials):
            found = calibrate(slices_of(rng, as_built(rng, cube, 0.2), slices), cube, TRUE, OPTIONS)
            assert isinstance(found, Calibration), found.message
            error = np.array([found.scale.sx - TRUE.sx, found.scale.sy - TRUE.sy])
            nees.append(error @ np.linalg.solve(found.covariance, error))
            for of_frame, whole, spacing in zip(
                found.frame_errors, found.standard_errors, (TRUE.sx, TRUE.sy), strict=True
            ):
                assert 0.0015 * spacing < of_frame < whole < (0.01 if slices == 1 else 0.004) * spacing
        assert 2 - 4 * math.sqrt(4 / trials) < np.mean(nees) < 2 + 3 * math.sqrt(4 / trials)

    def test_what_a_file_says_of_its_rods_counts_before_the_option(self, cube: Frame) -> None:
        taken = slices_of(np.random.default_rng(20), cube, 3)
        errors = {}
        for name, frame in (
            ("exact", replace(cube, tolerances_mm=np.zeros(6))),
            ("unknown", cube),
            ("rough", replace(cube, tolerances_mm=np.array([0.1, 0.5, 0.5, 0.5, 0.5, 0.5]))),
        ):
            found = calibrate(taken, frame, TRUE, OPTIONS)
            assert isinstance(found, Calibration), found.message
            errors[name] = found.frame_errors[0]
            if name == "rough":
                assert "rod ends known to 0.1 to 0.5 mm contribute" in found.message
        assert 0 == errors["exact"] < errors["unknown"] < errors["rough"]

    def test_rods_farther_off_than_stated_are_noticed(self, cube: Frame) -> None:
        """1.5 mm where 0.1 is stated."""
        rng = np.random.default_rng(21)
        options, near = replace(OPTIONS, frame_tolerance_mm=0.1), CalibrationOptions(calibration_max_change=0.02)
        for _ in range(6):
            assert not calibrate(slices_of(rng, as_built(rng, cube, 1.5), 3), cube, TRUE, options, near)


class TestWhereTheSpacingCameFrom:
    """A frame 3 % larger than its file fits exactly, with a scale that is 3 % off."""

    LARGE = 1.03

    def test_of_the_slices_it_is_not_made_to_fit_the_frame(self, cube: Frame) -> None:
        rng = np.random.default_rng(30)
        for slices in (1, 4, 10):
            taken = slices_of(rng, grown(cube, self.LARGE), slices, 3, stated=TRUE)
            refusal = calibrate(taken, cube, TRUE, OPTIONS)
            assert isinstance(refusal, CalibrationRefusal), refusal.message
            assert "scanner, or frame file?" in refusal.message
            assert "that came with the slices is (0.5000, 0.4800) mm/pixel, the one measured is (0.4" in refusal.message
            assert "more than 0.5 %" in refusal.message
            assert SCALE_OR_SIZE in refusal.message
            assert "calibration_max_change" in refusal.message
            size = re.search(r"the frame would have to be (\d\.\d) % larger than its file says", refusal.message)
            assert size is not None, refusal.message
            assert 2.0 < float(size[1]) < 4.0

    def test_a_smaller_frame_is_called_smaller(self, cube: Frame) -> None:
        taken = slices_of(np.random.default_rng(31), grown(cube, 0.98), 10, stated=TRUE)
        assert re.search(r"would have to be [12]\.\d % smaller", calibrate(taken, cube, TRUE, OPTIONS).message)

    @pytest.mark.parametrize("limit", [0.15, 0.05])
    def test_a_limit_set_on_purpose_counts(self, cube: Frame, limit: float) -> None:
        taken = slices_of(np.random.default_rng(32), grown(cube, self.LARGE), 5, stated=TRUE)
        calibration = CalibrationOptions(calibration_max_change=limit)
        found = calibrate(taken, cube, TRUE, OPTIONS, calibration)
        assert isinstance(found, Calibration), found.message
        assert found.scale.sx == pytest.approx(TRUE.sx / self.LARGE, rel=0.01)
        assert re.search(r"the frame would have to be [23]\.\d % larger than its file says", found.message)

    def test_typed_in_it_may_be_off_as_well(self, cube: Frame) -> None:
        taken = slices_of(np.random.default_rng(33), grown(cube, self.LARGE), 5)
        found = calibrate(taken, cube, TRUE, OPTIONS)
        assert isinstance(found, Calibration), found.message
        assert SCALE_OR_SIZE in found.message
        assert re.search(r"if \(0.5000, 0.4800\) is right, the frame would have to be [23]\.\d % larger", found.message)

    def test_a_small_change_is_made(self, cube: Frame) -> None:
        told = PixelScale(0.9985 * TRUE.sx, 1.0015 * TRUE.sy)
        taken = slices_of(np.random.default_rng(34), cube, 30, stated=told)
        found = calibrate(taken, cube, told, EXACT_FRAME)
        assert isinstance(found, Calibration), found.message
        assert abs(found.scale.sx - TRUE.sx) < 4 * found.standard_errors[0] < 0.003 * TRUE.sx

    def test_the_change_is_that_from_what_the_slices_say_not_from_what_is_in_use(self, cube: Frame) -> None:
        """Many small steps must not add up."""
        in_use = PixelScale(1.008 * TRUE.sx, 1.008 * TRUE.sy)
        taken = slices_of(np.random.default_rng(35), cube, 12, stated=TRUE)
        assert calibrate(taken, cube, in_use, EXACT_FRAME)
        off = replace(TRUE, sx=0.992 * TRUE.sx, sy=0.992 * TRUE.sy)
        taken = slices_of(np.random.default_rng(35), cube, 12, stated=off)
        assert "scanner, or frame file?" in calibrate(taken, cube, TRUE, EXACT_FRAME).message

    def test_axes_that_differ_are_not_put_down_to_the_frames_size(self, cube: Frame) -> None:
        told = PixelScale(1.03 * TRUE.sx, TRUE.sy)
        taken = slices_of(np.random.default_rng(36), cube, 10, stated=told)
        message = calibrate(taken, cube, told, OPTIONS).message
        assert "scanner, or frame file?" in message
        assert re.search(r"[23]\.\d % larger along the rows and 0\.\d % (larger|smaller) along the columns", message)
        assert "which no other size of it is" in message

    def test_a_series_of_files_states_its_spacing(self, cube: Frame) -> None:
        rng = np.random.default_rng(37)
        scanner = ScannerSettings(shape=(240, 240), scale=TRUE, body=False)
        frame = grown(cube, self.LARGE)
        slices: list[tuple[str, Slice]] = []
        for number in range(3):
            placed = PlacedFrame(frame, random_pose(rng, frame, scanner))
            slices.append((f"{number}.dcm", render_slice([placed], scanner, rng)))
        series = scale_of_series(slices, cube, OPTIONS, CalibrationOptions())
        assert "scanner, or frame file?" in series.outcome.message
        series = scale_of_series(slices, cube, OPTIONS, CalibrationOptions(calibration_max_change=0.15))
        assert isinstance(series.outcome, Calibration), series.outcome.message
        assert len(series.slices) == 3


class TestRefused:
    def refusal(self, *arguments: object) -> CalibrationRefusal:
        refusal = calibrate(*arguments)  # type: ignore[arg-type]
        assert isinstance(refusal, CalibrationRefusal), refusal.message
        assert not refusal
        assert refusal.message.startswith("calibration refused: ")
        return refusal

    def test_no_slice(self, cube: Frame) -> None:
        assert "there is no slice" in self.refusal([], cube, TRUE).message

    def test_too_few_spots(self, cube: Frame) -> None:
        few = [seen(np.random.default_rng(0).uniform(0, 500, (4, 2)))] * 3
        assert "5 rods are needed, and none of 3 slices has that many spots" in self.refusal(few, cube, TRUE).message

    def test_four_rods(self) -> None:
        rng = np.random.default_rng(32)
        frame = random_frame(rng, 4)
        spots = [project(frame, random_slice_from_frame(rng, frame), TRUE)[0] for _ in range(2)]
        with_one_more = [seen(np.vstack([one, rng.uniform(0, 500, (1, 2))])) for one in spots]
        options = RegistrationOptions(spot_noise_px=0.1, max_log10_false_alarms=0.0)
        message = self.refusal(with_one_more, frame, TRUE, options).message
        assert "4 rods are identified in a slice at most, 5 are needed" in message

    def test_a_frame_that_fixes_no_scale(self) -> None:
        frame = load_frame("leksell_ct")
        turn = rotation_exp(np.array([0.15, 0.1, 0.05]))
        pose = Pose(turn, turn @ np.array([-95.0, 60.0, 60.0]) + [140.0, 120.0, 0.0])
        options = RegistrationOptions(spot_noise_px=0.1, max_rotation_deg=30, max_log10_false_alarms=0.0)
        message = self.refusal([seen(project(frame, pose, TRUE)[0])], frame, TRUE, options).message
        assert "the rods do not fix the scale, degenerate: three_coplanar_lines" in message

    def test_a_change_that_is_too_large(self, cube: Frame) -> None:
        """Off by 8 %, and no more than 4 % allowed: what is found in reach of the search is refused all the same."""
        told = PixelScale(1.08 * TRUE.sx, TRUE.sy)
        strict = CalibrationOptions(calibration_max_change=0.04)
        taken = slices_of(np.random.default_rng(11), cube, 3)
        message = self.refusal(taken, cube, told, OPTIONS, strict).message
        assert "4 %" in message

    def test_a_scale_that_is_hardly_known(self, cube: Frame) -> None:
        taken = slices_of(np.random.default_rng(12), cube, 1)
        options = RegistrationOptions(spot_noise_px=1.5, max_log10_false_alarms=0.0)
        message = self.refusal(taken, cube, TRUE, options).message
        assert "has a standard error of" in message
        assert message.endswith("more than 1 %")

    def test_a_fit_that_would_get_worse(self, cube: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
        """As if the steps had ended at another place than the best."""
        taken = slices_of(np.random.default_rng(15), cube, 3)

        def ended_elsewhere(*arguments: Any, **named: Any) -> TolerantScale:
            found = calibrate_tolerantly(*arguments, **named)
            return replace(found, chi_square=found.chi_square + 1.0) if named.get("measured") != 0 else found

        best = calibrate(taken, cube, TRUE, OPTIONS)
        assert isinstance(best, Calibration)
        monkeypatch.setattr(measured, "calibrate_tolerantly", ended_elsewhere)
        message = self.refusal(taken, cube, best.scale, OPTIONS).message
        assert "the slices fit (" in message
        assert "better than (" in message

    def test_five_rods_of_one_slice(self) -> None:
        rng = np.random.default_rng(13)
        frame = random_frame(rng, 5)
        spots = project(frame, random_slice_from_frame(rng, frame), TRUE)[0]
        options = RegistrationOptions(spot_noise_px=0.05, max_log10_false_alarms=0.0)
        message = self.refusal([seen(spots)], frame, TRUE, options).message
        assert "5 rods in 1 slice leave too little to check the scale by" in message

    def test_clutter_only(self, cube: Frame) -> None:
        rng = np.random.default_rng(14)
        taken = [seen(rng.uniform(0, 500, (9, 2))) for _ in range(2)]
        told: list[float] = []

        def tell(share: float) -> bool:
            told.append(share)
            return True

        refusal = calibrate(taken, cube, TRUE, OPTIONS, progress=tell)
        assert isinstance(refusal, CalibrationRefusal)
        assert "in none of 2 slices the rods could be identified" in refusal.message
        assert told == sorted(told)
        assert told[0] == 0.0
        assert told[-1] < 1.0

    def test_the_search_can_be_given_up(self, cube: Frame) -> None:
        rng = np.random.default_rng(14)
        taken = [*slices_of(rng, cube, 1), *(seen(rng.uniform(0, 500, (9, 2))) for _ in range(2))]
        told: list[float] = []

        def ten_times(share: float) -> bool:
            told.append(share)
            return len(told) < 10

        refusal = calibrate(taken, cube, TRUE, OPTIONS, progress=ten_times)
        assert isinstance(refusal, CalibrationRefusal)
        assert "given up" in refusal.message
        assert len(told) == 10


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"calibration_slices": 0}, "calibration_slices is 0, expected a number from 1 to 200"),
        ({"calibration_slices": 2.5}, "calibration_slices is 2.5, expected a whole number"),
        ({"calibrate_shear": 1}, "calibrate_shear is 1, expected true or false"),
        ({"calibration_max_change": 0.9}, r"calibration_max_change is 0.9, expected a number from 0.001 to 0.5"),
        ({"calibration_max_change": "any"}, r"calibration_max_change is 'any', expected .* to 0.5, or 'auto'"),
    ],
)
def test_faulty_option_is_named(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        CalibrationOptions(**values)  # type: ignore[arg-type]


def test_the_limit_depends_on_where_the_spacing_came_from_unless_it_was_set() -> None:
    by_itself, on_purpose = CalibrationOptions(), CalibrationOptions(calibration_max_change=0.03)
    assert by_itself.calibration_max_change == "auto"
    assert by_itself.largest_change(came_with_slices=True) == 0.005
    assert by_itself.largest_change(came_with_slices=False) == 0.15
    assert on_purpose.largest_change(came_with_slices=True) == 0.03
    assert on_purpose.largest_change(came_with_slices=False) == 0.03
