"""The scanner's scale from slices, from a wrong start too, and when it is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from frames import random_frame, random_slice_from_frame

from stereoreg_ros.calibration import Calibration, CalibrationRefusal, Sighting, calibrate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.simulation import ScannerSettings, SpotSetSettings, random_pose, random_spot_set

TRUE = PixelScale(0.5, 0.48)
SCANNER = ScannerSettings(scale=TRUE)
NOISE_PX = 0.25
OPTIONS = RegistrationOptions(spot_noise_px=NOISE_PX)


def seen(spots_px: np.ndarray) -> Sighting:
    return Sighting(spots_px, np.zeros((len(spots_px), 2, 2)))


def sightings(
    rng: np.random.Generator, frame: Frame, count: int, false_spots: int = 0, noise_px: float = NOISE_PX
) -> list[Sighting]:
    settings = SpotSetSettings(SCANNER, len(frame), false_spots, noise_px, gaussian=True)
    return [seen(random_spot_set(rng, frame, settings).spots_px) for _ in range(count)]


@pytest.fixture(scope="module")
def cube() -> Frame:
    return load_frame("cube6")


class TestAccepted:
    @pytest.mark.parametrize("slices", [1, 3, 10])
    def test_standard_errors_are_those_of_many_trials(self, cube: Frame, slices: int) -> None:
        rng = np.random.default_rng(slices)
        nees = []
        trials = 60
        for _ in range(trials):
            found = calibrate(sightings(rng, cube, slices), cube, TRUE, OPTIONS)
            assert isinstance(found, Calibration), found.message
            error = np.array([found.scale.sx - TRUE.sx, found.scale.sy - TRUE.sy])
            nees.append(error @ np.linalg.solve(found.covariance, error))
            assert found.slices == slices
            assert found.rods == 6 * slices
        # Residuals larger than stated widen the errors, smaller ones do not narrow them: a little below 2.
        assert 2 - 4 * math.sqrt(4 / trials) < np.mean(nees) < 2 + 3 * math.sqrt(4 / trials)

    def test_forty_three_slices_are_good_to_a_thousandth(self, cube: Frame) -> None:
        rng = np.random.default_rng(43)
        for _ in range(3):
            found = calibrate(sightings(rng, cube, 43), cube, TRUE, OPTIONS)
            assert isinstance(found, Calibration), found.message
            assert abs(found.scale.sx / TRUE.sx - 1) <= 1e-3
            assert abs(found.scale.sy / TRUE.sy - 1) <= 1e-3

    def test_exact_spots(self, cube: Frame) -> None:
        found = calibrate(sightings(np.random.default_rng(2), cube, 2, noise_px=0.0), cube, TRUE, OPTIONS)
        assert isinstance(found, Calibration)
        assert found.scale.sx == pytest.approx(TRUE.sx, abs=1e-8)
        assert found.scale.sy == pytest.approx(TRUE.sy, abs=1e-8)
        assert found.residual_after_px < 1e-5

    @pytest.mark.parametrize("slices", [1, 4])
    def test_from_ten_percent_wrong(self, cube: Frame, slices: int) -> None:
        """False spots among the rods, and either axis off by up to a tenth, in opposite ways too."""
        rng = np.random.default_rng(10 + slices)
        refused = 0
        for trial in range(8):
            by_x, by_y = rng.choice([0.9, 1.1], 2) if trial % 2 else 1 + rng.uniform(-0.1, 0.1, 2)
            told = PixelScale(by_x * TRUE.sx, by_y * TRUE.sy)
            found = calibrate(sightings(rng, cube, slices, int(rng.integers(0, 9))), cube, told, OPTIONS)
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
            found = calibrate(sightings(rng, cube, 5, 3), cube, told, OPTIONS)
            assert isinstance(found, Calibration), found.message
            assert found.slices == 5
            assert abs(found.scale.sx / TRUE.sx - 1) < 0.01
            assert abs(found.scale.sy / TRUE.sy - 1) < 0.01

    def test_slices_without_the_frame_do_no_harm(self, cube: Frame) -> None:
        rng = np.random.default_rng(6)
        clutter = [seen(rng.uniform(0, 500, (12, 2))) for _ in range(3)]
        found = calibrate([*clutter, *sightings(rng, cube, 3, 2), *clutter], cube, TRUE, OPTIONS)
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
        found = calibrate(sightings(np.random.default_rng(8), cube, 3), cube, told, OPTIONS)
        assert isinstance(found, Calibration)
        assert found.message.startswith("pixel spacing changed from (0.5050, 0.4850) to (0.")
        assert f"{found.scale.sx:.4f} +- {found.standard_errors[0]:.4f}" in found.message
        assert f"{found.scale.sy:.4f} +- {found.standard_errors[1]:.4f}" in found.message
        assert "from 3 slices with 18 rods" in found.message
        assert found.residual_after_px < found.residual_before_px


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
        assert "5 rods are needed, and none of 3 slices has so many spots" in self.refusal(few, cube, TRUE).message

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
        taken = sightings(np.random.default_rng(11), cube, 3)
        message = self.refusal(taken, cube, told, OPTIONS, strict).message
        assert "4 %" in message

    def test_a_scale_that_is_hardly_known(self, cube: Frame) -> None:
        taken = sightings(np.random.default_rng(12), cube, 1)
        options = RegistrationOptions(spot_noise_px=1.5, max_log10_false_alarms=0.0)
        message = self.refusal(taken, cube, TRUE, options).message
        assert "has a standard error of" in message
        assert message.endswith("more than 1 %")

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
        taken = [*sightings(rng, cube, 1), *(seen(rng.uniform(0, 500, (9, 2))) for _ in range(2))]
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
    ],
)
def test_faulty_option_is_named(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        CalibrationOptions(**values)  # type: ignore[arg-type]
