"""What is known of a slice on its way to the scale: its plane, its area, its errors; and how strictly it counts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from stereoreg_ros.calibration.calibrate import (
    Calibration,
    CalibrationRefusal,
    calibrate,
)
from stereoreg_ros.calibration.matching import match_slice
from stereoreg_ros.calibration.series import scale_of_series
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions
from stereoreg_ros.registration import register_slice, register_spots
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, centred_pose, random_pose, render_slice
from stereoreg_ros.spots import find_spots

TRUE = PixelScale(0.5, 0.6)
SCANNER = ScannerSettings(shape=(200, 300), scale=TRUE, body=False, noise_hu=5.0)
NOISE_PX = 0.25
OPTIONS = RegistrationOptions(spot_noise_px=NOISE_PX)
EXACT_FRAME = replace(OPTIONS, frame_tolerance_mm=0.0)
# A gantry that is tilted by as much as gantries are, beyond what the frame may be turned.
GANTRY = Pose(rotation_exp(np.array([math.radians(20.0), 0.0, 0.0])), np.array([0.0, 0.0, 100.0]))
UPRIGHT = replace(OPTIONS, max_rotation_deg=8.0)


@pytest.fixture(scope="module")
def cube() -> Frame:
    return load_frame("cube6")


def tilted_poses(frame: Frame, count: int) -> list[Pose]:
    """slice_from_frame of a frame that stands nearly upright in the scanner, in slices of the tilted gantry."""
    rng = np.random.default_rng(3)
    middle = centred_pose(frame, SCANNER, rotation=GANTRY.rotation.T)
    return [random_pose(rng, frame, SCANNER, max_tilt_deg=3.0, max_offset_mm=8.0, nominal=middle) for _ in range(count)]


def off_by(
    rng: np.random.Generator, frame: Frame, count: int, noise_px: float, scale: PixelScale = TRUE
) -> list[Array]:
    """Spots of all rods of slices, each coordinate off by a normal error."""
    poses = [random_pose(rng, frame, SCANNER, max_offset_mm=15.0) for _ in range(count)]
    return [project(frame, pose, scale)[0] + rng.normal(0.0, noise_px, (len(frame), 2)) for pose in poses]


def seen(spots_px: Array, plane: Pose | None = None, stated: PixelScale | None = None) -> SliceSpots:
    area_mm2 = 200 * 300 * TRUE.sx * TRUE.sy
    plane = plane or Pose.identity()
    return SliceSpots(spots_px, TRUE, scanner_from_slice=plane, area_mm2=area_mm2, stated_scale=stated)


class TestPlane:
    @pytest.mark.parametrize("configured", [TRUE, PixelScale(1.06 * TRUE.sx, 0.95 * TRUE.sy)], ids=["right", "wrong"])
    def test_the_nominal_orientation_is_relative_to_the_scanner(self, cube: Frame, configured: PixelScale) -> None:
        rng = np.random.default_rng(1)
        spots = [project(cube, pose, TRUE)[0] + rng.normal(0.0, 0.1, (6, 2)) for pose in tilted_poses(cube, 3)]
        found = calibrate([seen(one, GANTRY) for one in spots], cube, configured, UPRIGHT)
        assert isinstance(found, Calibration), found.message
        assert found.slices == 3
        np.testing.assert_allclose([found.scale.sx, found.scale.sy], [TRUE.sx, TRUE.sy], rtol=0.01)

    def test_of_a_slice_of_unknown_plane_it_does_not_stand_like_that(self, cube: Frame) -> None:
        spots = project(cube, tilted_poses(cube, 1)[0], TRUE)[0]
        assert match_slice(seen(spots, GANTRY), cube, TRUE, UPRIGHT)
        assert not match_slice(seen(spots), cube, TRUE, UPRIGHT)

    def test_a_series_has_that_of_its_files(self, cube: Frame) -> None:
        rng = np.random.default_rng(4)
        slices = [
            (f"{number}.dcm", render_slice([PlacedFrame(cube, pose)], SCANNER, rng, GANTRY))
            for number, pose in enumerate(tilted_poses(cube, 3))
        ]
        series = scale_of_series(slices, cube, UPRIGHT, CalibrationOptions())
        assert isinstance(series.outcome, Calibration), series.outcome.message
        assert (series.outcome.slices, len(series.slices)) == (3, 3)


class TestSpotsOfResults:
    def test_has_all_that_is_known_of_the_slice(self, cube: Frame) -> None:
        spots = project(cube, tilted_poses(cube, 1)[0], TRUE)[0]
        covariances = np.arange(1.0, 7.0)[:, None, None] * np.diag([0.01, 0.04])
        for options in (OPTIONS, UPRIGHT):  # accepted, and refused
            result = register_spots(spots, cube, TRUE, options, GANTRY, 18_000.0, covariances_px2=covariances)
            kept = result.spots
            np.testing.assert_array_equal(kept.centres_px, spots)
            np.testing.assert_array_equal(kept.covariances_px2, covariances)
            assert (kept.area_mm2, kept.scanner_from_slice, kept.scale) == (18_000.0, GANTRY, TRUE)

    def test_area_is_that_of_as_many_pixels(self, cube: Frame) -> None:
        spots = project(cube, tilted_poses(cube, 1)[0], TRUE)[0]
        assert seen(spots).with_scale(PixelScale(0.7, 0.2)).area_mm2 == pytest.approx(200 * 300 * 0.7 * 0.2)
        assert SliceSpots(spots, TRUE).with_scale(PixelScale(0.7, 0.2)).area_mm2 is None
        matched = match_slice(seen(spots), cube, TRUE, OPTIONS)
        by_area = [register_spots(spots, cube, TRUE, OPTIONS, slice_area_mm2=area) for area in (18_000.0, None)]
        assert matched
        assert by_area[0]
        assert by_area[1]
        chances = [one.estimate.log10_false_alarms for one in (matched, *by_area)]  # type: ignore[union-attr]
        assert chances[0] == chances[1]
        assert chances[0] < chances[2] - 1.0


def test_the_lengths_of_spots_count_as_in_a_registration(cube: Frame) -> None:
    """Of a slice said to be 20 mm thick, every rod would have to leave a long streak."""
    rng = np.random.default_rng(12)
    ct_slice = render_slice([PlacedFrame(cube, random_pose(rng, cube, SCANNER))], SCANNER, rng)
    spots = find_spots(ct_slice, OPTIONS)
    assert match_slice(spots, cube, TRUE, OPTIONS)
    thick = replace(OPTIONS, slice_thickness_mm=20.0)
    refused = match_slice(spots, cube, TRUE, thick)
    assert not refused
    assert refused.reason == "no_consensus"
    assert not match_slice(register_slice(ct_slice, cube, OPTIONS).spots, cube, TRUE, thick)
    # An outside spot finder has its say, too.
    unmeasured = SliceSpots(spots.centres_px, TRUE, spots.covariances_px2)
    assert match_slice(unmeasured, cube, TRUE, thick)


class TestStandardErrors:
    def test_residuals_larger_than_stated_widen_them_whatever_was_stated(self, cube: Frame) -> None:
        taken = [seen(spots) for spots in off_by(np.random.default_rng(5), cube, 3, 1.45 * NOISE_PX)]
        found = [calibrate(taken, cube, TRUE, replace(EXACT_FRAME, spot_noise_px=n * NOISE_PX)) for n in (1.0, 1.1)]
        for one in found:
            assert isinstance(one, Calibration), one.message
            assert one.slices == 3
        assert found[0].standard_errors == pytest.approx(found[1].standard_errors, rel=1e-4)  # type: ignore[union-attr]
        # As large as those of as much noise, were it stated.
        as_much = calibrate(taken, cube, TRUE, replace(EXACT_FRAME, spot_noise_px=1.45 * NOISE_PX))
        assert isinstance(as_much, Calibration)
        np.testing.assert_allclose(as_much.standard_errors, found[0].standard_errors, rtol=0.3)  # type: ignore[union-attr]

    def test_residuals_smaller_than_stated_do_not_narrow_them(self, cube: Frame) -> None:
        taken = [seen(spots) for spots in off_by(np.random.default_rng(6), cube, 2, 0.3 * NOISE_PX)]
        once, twice = (calibrate(taken, cube, TRUE, replace(EXACT_FRAME, spot_noise_px=n * NOISE_PX)) for n in (1, 2))
        assert isinstance(once, Calibration)
        assert isinstance(twice, Calibration)
        np.testing.assert_allclose(twice.standard_errors, np.multiply(2.0, once.standard_errors), rtol=1e-4)

    @pytest.mark.parametrize(("axis", "name"), [(0, "sx"), (1, "sy")])
    def test_each_axis_must_be_known(self, cube: Frame, axis: int, name: str) -> None:
        """Spots that are blurred along the rows, or along the columns."""
        stds = np.full(2, 0.1)
        stds[axis] = 1.5
        spots = project(cube, tilted_poses(cube, 1)[0], TRUE)[0]
        taken = SliceSpots(spots, TRUE, np.tile(np.diag(stds**2), (6, 1, 1)), area_mm2=18_000.0)
        found = calibrate([taken], cube, TRUE, replace(EXACT_FRAME, max_log10_false_alarms=-1.0))
        assert isinstance(found, CalibrationRefusal)
        assert f"{name} = 0." in found.message
        assert "has a standard error of" in found.message


class TestStated:
    @pytest.mark.parametrize("factors", [(1.02, 1.0), (1.0, 1.02)], ids=["sx", "sy"])
    def test_neither_axis_changes_by_more_than_allowed(self, cube: Frame, factors: tuple[float, float]) -> None:
        told = PixelScale(factors[0] * TRUE.sx, factors[1] * TRUE.sy)
        spots = off_by(np.random.default_rng(7), cube, 3, 0.1)
        found = calibrate([seen(one, stated=told) for one in spots], cube, told, EXACT_FRAME)
        assert isinstance(found, CalibrationRefusal)
        assert re_percent(found.message) == pytest.approx(2.0, abs=0.3)
        assert isinstance(calibrate([seen(one) for one in spots], cube, told, EXACT_FRAME), Calibration)

    def test_of_several_the_last_counts(self, cube: Frame) -> None:
        other = PixelScale(1.03 * TRUE.sx, 1.03 * TRUE.sy)
        spots = off_by(np.random.default_rng(8), cube, 3, 0.1)
        for stated, accepted in (([other, TRUE, None], True), ([TRUE, other, None], False)):
            taken = [seen(one, stated=told) for one, told in zip(spots, stated, strict=True)]
            found = calibrate(taken, cube, TRUE, EXACT_FRAME)
            assert isinstance(found, Calibration) == accepted, found.message


def re_percent(message: str) -> float:
    """By how many percent the scale is off, as a refusal says."""
    return float(message.split(" % off, more than")[0].split()[-1])


class TestStrictness:
    def test_a_scale_that_was_searched_for_must_be_surer_by_as_many_as_were_tried(self, cube: Frame) -> None:
        """One slice and 49 scales: what chance brings with one of them is 49 times as much."""
        (spots,) = off_by(np.random.default_rng(9), cube, 1, 0.05)
        right = calibrate([seen(spots)], cube, TRUE, OPTIONS)
        assert isinstance(right, Calibration), right.message
        low, high = -20.0, -5.0
        while high - low > 0.1:
            middle = 0.5 * (low + high)
            limited = replace(OPTIONS, max_log10_false_alarms=middle)
            low, high = (low, middle) if match_slice(seen(spots), cube, right.scale, limited) else (middle, high)
        told = PixelScale(1.1 * TRUE.sx, 0.9 * TRUE.sy)
        for limit, accepted in ((high + math.log10(49) - 0.4, False), (high + math.log10(49) + 0.4, True)):
            found = calibrate([seen(spots)], cube, told, replace(OPTIONS, max_log10_false_alarms=limit))
            assert isinstance(found, Calibration) == accepted, found.message

    def test_scales_are_tried_about_the_one_in_use_along_each_axis(self, cube: Frame) -> None:
        """Columns and rows so unlike that no scale tried has them the other way round, or equal."""
        true = PixelScale(0.4, 0.7)
        told = PixelScale(1.08 * true.sx, 0.93 * true.sy)
        spots = off_by(np.random.default_rng(10), cube, 2, 0.1, true)
        found = calibrate([seen(one) for one in spots], cube, told, OPTIONS)
        assert isinstance(found, Calibration), found.message
        np.testing.assert_allclose([found.scale.sx, found.scale.sy], [true.sx, true.sy], rtol=0.01)


def without(line: int, spots_px: Array) -> Array:
    """The spots of all rods but one, the last first."""
    return np.delete(spots_px, line, axis=0)[::-1]


class TestResiduals:
    def test_are_those_of_poses_fitted_to_either_scale(self, cube: Frame) -> None:
        """By scipy, slice by slice, over the rods that show: five in each."""
        told = PixelScale(1.01 * TRUE.sx, 0.99 * TRUE.sy)
        spots = [without(k, one) for k, one in enumerate(off_by(np.random.default_rng(11), cube, 3, 0.2))]
        found = calibrate([seen(one) for one in spots], cube, told, EXACT_FRAME)
        assert isinstance(found, Calibration), found.message
        assert (found.slices, found.rods) == (3, 15)
        for scale, stated in ((told, found.residual_before_px), (found.scale, found.residual_after_px)):
            squares = 0.0
            for missing, (one, pose) in enumerate(zip(spots, found.poses, strict=True)):

                def residuals(
                    step: Array, missing: int = missing, one: Array = one, pose: Pose = pose, scale: PixelScale = scale
                ) -> Array:
                    predicted = project(cube, pose.perturbed(step[:3], step[3:]), scale)[0]
                    return (without(missing, predicted) - one).ravel()

                squares += 2 * float(least_squares(residuals, np.zeros(6), xtol=1e-12).cost)
            assert stated == pytest.approx(math.sqrt(squares / 15), rel=1e-4)
        assert found.residual_before_px > 1.2 * found.residual_after_px


class TestEachSliceAlone:
    def test_is_measured_with_the_rods_that_show_and_as_sure_as_they_make_it(self, cube: Frame) -> None:
        rng = np.random.default_rng(12)
        poses = [random_pose(rng, cube, SCANNER, max_offset_mm=10.0) for _ in range(2)]
        hidden = (cube.line_names[1], cube.line_names[4])
        slices = [
            (f"{pose_number}.dcm", render_slice([PlacedFrame(cube, pose, (name,))], SCANNER, rng))
            for pose_number, (pose, name) in enumerate(zip(poses, hidden, strict=True))
        ]
        series = scale_of_series(slices, cube, OPTIONS, CalibrationOptions())
        assert isinstance(series.outcome, Calibration), series.outcome.message
        assert [(one.name, one.rods) for one in series.slices] == [("0.dcm", 5), ("1.dcm", 5)]
        for alone, pose, name in zip(series.slices, poses, hidden, strict=True):
            for scale in (alone.linear, alone.newton_raphson):
                np.testing.assert_allclose([scale.sx, scale.sy], [TRUE.sx, TRUE.sy], rtol=0.01)
            lines = [line for line, other in enumerate(cube.line_names) if other != name]
            columns = []
            for axis in range(8):
                step = 1e-4 * np.eye(8)[axis]
                there, back = (
                    project(
                        cube,
                        pose.perturbed(sign * step[2:5], sign * step[5:]),
                        PixelScale(TRUE.sx + sign * step[0], TRUE.sy + sign * step[1]),
                    )[0][lines]
                    for sign in (1, -1)
                )
                columns.append((there - back).ravel() / 2e-4)
            jacobian = np.stack(columns, axis=-1)
            bound = NOISE_PX * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))[:2]
            np.testing.assert_allclose(alone.standard_errors, bound, rtol=0.1)
