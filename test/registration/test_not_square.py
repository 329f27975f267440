"""Slices of 200 rows by 300 columns whose pixels are oblong and sheared: nothing is square, no axis is the other."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_frames, register_slice, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.matching.spots import Streaks
from stereoreg_ros.result import Registration
from stereoreg_ros.simulation import (
    Cylinder,
    PlacedFrame,
    ScannerSettings,
    SpotSetSettings,
    add_metal,
    centred_pose,
    metal_fraction,
    random_pose,
    random_spot_set,
    render_slice,
)
from stereoreg_ros.simulation.mistakes import NO_ROD, Surroundings, true_scene, wrong_spacing
from stereoreg_ros.simulation.patient import AIR_HU, background
from stereoreg_ros.simulation.scene import BLOCK_HU
from stereoreg_ros.spots import find_spots

SHAPE = ROWS, COLUMNS = 200, 300
SCALE = PixelScale(0.5, 0.65, 0.04)
SCANNER = ScannerSettings(shape=SHAPE, scale=SCALE, body=False)
BARE = replace(SCANNER, noise_hu=0.0, block=False)
PLANE = Pose(rotation_exp(np.array([0.3, -0.8, 0.5])), np.array([5.0, 60.0, 70.0]))
# Of (sx, sy, shear).
SCALE_COVARIANCE = np.array([[4.0, 1.0, 0.6], [1.0, 9.0, -0.8], [0.6, -0.8, 2.0]]) * 1e-6


@pytest.fixture(scope="module")
def cube() -> Frame:
    return load_frame("cube6")


@pytest.fixture(scope="module")
def to_the_right(cube: Frame) -> tuple[Slice, Pose]:
    """A frame in columns that a square image of as many rows does not have, and its slice_from_frame."""
    middle = centred_pose(cube, SCANNER, (0.74, 0.55), rotation_exp(np.array([0.1, 0.15, 0.6])))
    return render_slice([PlacedFrame(cube, middle)], SCANNER, np.random.default_rng(1), PLANE), middle


def middle_of(image: Array) -> Array:
    """Centroid (2,), pixel (u, v)."""
    v, u = np.indices(image.shape)
    return np.array([float((place * image).sum() / image.sum()) for place in (u, v)])


class TestRegisterSlice:
    @pytest.mark.parametrize("threshold", ["auto", 1200.0])
    def test_finds_the_frame_wherever_it_is(
        self, cube: Frame, to_the_right: tuple[Slice, Pose], threshold: float | str
    ) -> None:
        ct_slice, truth = to_the_right
        result = register_slice(ct_slice, cube, RegistrationOptions(threshold=threshold))
        assert result, result.message
        assert result.spots_px[:, 0].max() > ROWS
        assert result.estimate.inliers == 6
        expected = PLANE @ truth
        assert np.linalg.norm(result.scanner_from_frame.translation - expected.translation) < 0.1
        assert math.degrees(float(rotation_angle(result.scanner_from_frame.rotation @ expected.rotation.T))) < 0.2
        for match in result.matches:
            np.testing.assert_allclose(match.spot_px, project(cube, truth, SCALE)[0][match.line_index], atol=0.1)

    def test_hands_on_all_that_it_knows_of_the_slice(self, cube: Frame, to_the_right: tuple[Slice, Pose]) -> None:
        """The area, the spots' errors, the plane and the errors of the scale, with the frame alone or among others."""
        ct_slice, _ = to_the_right
        options = RegistrationOptions(spot_noise_px=0.02)
        found = find_spots(ct_slice, options)
        for errors in (None, SCALE_COVARIANCE):
            expected = register_spots(
                found.centres_px,
                cube,
                SCALE,
                options,
                PLANE,
                ROWS * COLUMNS * 0.5 * 0.65,
                covariances_px2=found.covariances_px2,
                scale_covariance=errors,
            )
            alone = register_slice(ct_slice, cube, options, scale_covariance=errors)
            among = register_frames(ct_slice, [cube], options, scale_covariance=errors)
            assert isinstance(expected, Registration)
            for result in (alone, *among):
                assert isinstance(result, Registration)
                np.testing.assert_array_equal(result.covariance, expected.covariance)
                np.testing.assert_array_equal(result.covariances_px2, expected.covariances_px2)
                assert result.estimate.log10_false_alarms == expected.estimate.log10_false_alarms
                np.testing.assert_array_equal(
                    result.scanner_from_frame.translation, expected.scanner_from_frame.translation
                )


class TestSpots:
    @pytest.mark.parametrize("threshold", ["auto", 2000.0])
    def test_beside_every_edge(self, threshold: float | str) -> None:
        places = np.array([[7.0, 100.0], [150.0, 6.0], [293.0, 60.0], [210.0, 194.0], [292.0, 193.0]])
        v, u = np.indices(SHAPE)
        image = np.full(SHAPE, 40.0)
        for x, y in places:
            image += 8000.0 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 2)
        found = find_spots(Slice(image.astype(np.float32), SCALE), RegistrationOptions(threshold=threshold))
        np.testing.assert_allclose(found.centres_px, places[[1, 2, 0, 4, 3]], atol=0.05)

    @pytest.mark.parametrize("threshold", ["auto", 1000.0])
    @pytest.mark.parametrize("second", [[255.0, 61.0], [251.0, 65.0]], ids=["beside", "below"])
    def test_two_that_touch_are_two(self, threshold: float | str, second: list[float]) -> None:
        places = np.array([[250.0, 60.0], second])
        v, u = np.indices(SHAPE)
        image = np.full(SHAPE, 40.0)
        for (x, y), peak in zip(places, (3000.0, 2500.0), strict=True):
            image += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.3**2))
        image += 5.0 * np.random.default_rng(9).standard_normal(SHAPE)
        found = find_spots(Slice(image.astype(np.float32), SCALE), RegistrationOptions(threshold=threshold))
        np.testing.assert_allclose(found.centres_px, places, atol=0.4)

    @pytest.mark.parametrize("turn_deg", [10.0, 80.0])
    def test_a_long_streak_near_the_edge_is_one(self, turn_deg: float) -> None:
        """So long that it is looked at anew from its middle; its brightest place is near one of its ends."""
        turn = math.radians(turn_deg)
        v, u = np.indices(SHAPE)
        off = np.stack([u - 275.0, v - 150.0], axis=-1)
        far, aside = off @ [math.cos(turn), math.sin(turn)], off @ [-math.sin(turn), math.cos(turn)]
        profile = (1.0 + 0.002 * far) / (1.0 + np.exp((np.abs(far) - 14.0) / 0.8))
        image = 40.0 + 3000.0 * profile * np.exp(-((aside / 1.0) ** 2) / 2)
        image += 5.0 * np.random.default_rng(9).standard_normal(SHAPE)
        found = find_spots(Slice(image.astype(np.float32), PixelScale(0.6, 0.7)), RegistrationOptions())
        np.testing.assert_allclose(found.centres_px, [[275.0, 150.0]], atol=0.5)

    def test_areas_are_those_of_oblong_pixels(self) -> None:
        """12 pixels of 0.325 mm^2: 3.9 mm^2, where square ones would have 3 or 5.07."""
        image = np.full(SHAPE, 40.0)
        image[99:102, 200:204] = 5000.0
        ct_slice = Slice(image.astype(np.float32), SCALE)
        for least, most, count in ((3.8, 80.0, 1), (4.0, 80.0, 0), (0.5, 4.0, 1), (0.5, 3.8, 0)):
            options = RegistrationOptions(threshold=2000.0, min_spot_area_mm2=least, max_spot_area_mm2=most)
            assert len(find_spots(ct_slice, options)) == count

    @pytest.mark.parametrize("azimuth_deg", [0.0, 70.0, 145.0])
    def test_a_streak_is_as_long_as_the_slice_is_thick_where_a_rod_leans_by_45_degrees(
        self, azimuth_deg: float
    ) -> None:
        azimuth, thickness_mm = math.radians(azimuth_deg), 10.0
        lean = np.array([math.cos(azimuth), math.sin(azimuth), 1.0])
        middle = np.append(SCALE.to_mm(np.array([220.0, 90.0])), 0.0)
        image = np.full(SHAPE, 40.0)
        add_metal(image, Cylinder(middle - 30 * lean, middle + 30 * lean, 1.0), SCALE, thickness_mm, 0.45, 8000.0)
        found = find_spots(Slice(image.astype(np.float32), SCALE), RegistrationOptions())
        streaks = Streaks.of(found, thickness_mm)
        assert streaks is not None
        (along,) = streaks.along_mm
        along = along * np.sign(along @ lean[:2])
        np.testing.assert_allclose(along, thickness_mm * lean[:2], atol=0.1 * thickness_mm)
        np.testing.assert_allclose(found.centres_px, [[220.0, 90.0]], atol=0.02)
        assert streaks.thickness_mm == thickness_mm

    @pytest.mark.parametrize("turn_deg", [20.0, 100.0, 160.0])
    def test_the_centre_of_a_streak_is_less_sure_along_it(self, turn_deg: float) -> None:
        """A long spot in noise, aslant: its covariance lies as it does itself."""
        turn = math.radians(turn_deg)
        along = np.array([math.cos(turn), math.sin(turn)])
        v, u = np.indices(SHAPE)
        off = np.stack([u - 230.3, v - 80.6], axis=-1)
        far, aside = off @ along, off @ [-along[1], along[0]]
        image = 40.0 + 3000.0 * np.exp(-((far / 4.0) ** 2 + (aside / 1.2) ** 2) / 2)
        image += 60.0 * np.random.default_rng(8).standard_normal(SHAPE)
        found = find_spots(Slice(image.astype(np.float32), SCALE), RegistrationOptions(threshold=1000.0))
        assert len(found) == 1
        variances, axes = np.linalg.eigh(found.covariances_px2[0])
        assert abs(axes[:, 1] @ along) > math.cos(math.radians(6.0))
        # For noise alone a Gaussian's centre is known in proportion to its width.
        assert math.sqrt(variances[1] / variances[0]) == pytest.approx(4.0 / 1.2, rel=0.25)
        moments, axes = np.linalg.eigh(found.extents_px2[0])
        assert abs(axes[:, 1] @ along) > math.cos(math.radians(3.0))
        assert math.sqrt(moments[1] / moments[0]) == pytest.approx(4.0 / 1.2, rel=0.1)

    def test_the_length_of_a_uniform_streak_follows_from_its_moments(self) -> None:
        """A twelfth of the squared length, and as much along as across what the spot is wide."""
        along_mm = np.array([[6.0, 2.0], [-1.0, 9.0]])
        moments_mm2 = along_mm[:, :, None] * along_mm[:, None, :] / 12 + 0.2 * np.eye(2)
        to_px = np.linalg.inv(SCALE.matrix)
        extents_px2, cut_short = to_px @ moments_mm2 @ to_px.T, np.array([True, False])
        found = SliceSpots(np.zeros((2, 2)), SCALE, extents_px2=extents_px2, cut_short=cut_short)
        streaks = Streaks.of(found, 5.0)
        assert streaks is not None
        signs = np.sign((streaks.along_mm * along_mm).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(signs * streaks.along_mm, along_mm, rtol=1e-9)
        assert streaks.cut_short.tolist() == [True, False]


class TestSimulator:
    def test_size(self) -> None:
        np.testing.assert_allclose(SCANNER.size_mm, [150.0, 130.0])

    def test_the_frame_is_centred_in_the_image(self, cube: Frame) -> None:
        middle = 0.5 * (
            np.vstack([cube.starts, cube.ends]).min(axis=0) + np.vstack([cube.starts, cube.ends]).max(axis=0)
        )
        turned = rotation_exp(np.array([0.1, 0.2, 0.3]))
        np.testing.assert_allclose(centred_pose(cube, SCANNER) @ middle, [79.0, 65.0, 0.0], atol=1e-9)
        # 75 columns and 150 rows: 0.5 * 75 + 0.04 * 150, 0.65 * 150.
        pose = centred_pose(cube, SCANNER, (0.25, 0.75), turned)
        np.testing.assert_allclose(pose @ middle, [43.5, 97.5, 0.0], atol=1e-9)

    def test_a_rod_shows_at_its_pixel(self) -> None:
        for pixel in ([260.0, 150.0], [285.0, 40.0]):
            place = SCALE.to_mm(np.array(pixel))
            lean = np.array([2.0, -3.0, 20.0])
            image = np.zeros(SHAPE)
            rod = Cylinder(np.append(place, 0) - lean, np.append(place, 0) + lean, 1.0)
            add_metal(image, rod, SCALE, 1.0, 0.45)
            np.testing.assert_allclose(middle_of(image), pixel, atol=1e-3)
            # All of its volume is there: a section of pi / 4 mm^2 that leans.
            volume = math.pi / 4 * float(np.linalg.norm(lean)) / 20.0
            assert image.sum() * 0.5 * 0.65 == pytest.approx(volume, rel=1e-4)

    def test_the_point_spread_is_as_wide_in_mm_along_either_axis(self) -> None:
        straight, place = PixelScale(0.5, 0.65), np.array([120.0, 60.0, 0.0])
        image = np.zeros(SHAPE)
        up = np.array([0.0, 0.0, 20.0])
        add_metal(image, Cylinder(place - up, place + up, 1.0), straight, 1.0, 0.6)
        v, u = np.indices(SHAPE)
        x, y = 0.5 * u - 120.0, 0.65 * v - 60.0
        # The spread, the rod's disc and the pixel: a sixteenth of a squared diameter, a twelfth of a squared side.
        for off, side in ((x, 0.5), (y, 0.65)):
            moment = float((off**2 * image).sum() / image.sum())
            assert moment == pytest.approx(0.6**2 + 1.0 / 16 + side**2 / 12, rel=1e-3)

    def test_poses_use_the_whole_image_and_no_more(self, cube: Frame) -> None:
        rng = np.random.default_rng(4)
        cuts = np.array([project(cube, random_pose(rng, cube, SCANNER), SCALE)[0] for _ in range(60)])
        assert (cuts >= 4.0).all()
        assert (cuts <= [COLUMNS - 5.0, ROWS - 5.0]).all()
        assert (cuts.max(axis=(0, 1)) > [COLUMNS - 25.0, ROWS - 25.0]).all()
        assert (cuts.min(axis=(0, 1)) < [25.0, 25.0]).all()

    def test_the_block_is_where_the_frame_is(self, cube: Frame) -> None:
        """Pixel by pixel: 100 HU within 4 mm of the box around the rods, air beyond; but at its border."""
        pose = centred_pose(cube, SCANNER, (0.7, 0.5), rotation_exp(np.array([0.2, 0.1, 0.5])))
        hidden = PlacedFrame(cube, pose, cube.line_names)
        settings = replace(SCANNER, noise_hu=0.0, slice_thickness_mm=0.1, psf_sigma_mm=0.1)
        hu = render_slice([hidden], settings, np.random.default_rng(0)).hu
        v, u = np.indices(SHAPE)
        in_slice = np.zeros((ROWS * COLUMNS, 3))
        in_slice[:, :2] = np.stack([u, v], axis=-1).reshape(-1, 2) @ SCALE.matrix.T
        in_frame = pose.inverse() @ in_slice
        ends = np.vstack([cube.starts, cube.ends])
        low, high = ends.min(axis=0) - 4.0, ends.max(axis=0) + 4.0
        deep = np.minimum(in_frame - low, high - in_frame).min(axis=1).reshape(SHAPE)
        assert (deep > 0.5).sum() > 5000
        np.testing.assert_array_equal(hu[deep > 0.5], BLOCK_HU)
        np.testing.assert_array_equal(hu[deep < -0.5], AIR_HU)

    def test_false_spots_are_whole_and_everywhere(self) -> None:
        rng = np.random.default_rng(5)
        places = []
        for _ in range(6):
            hu = render_slice([], replace(BARE, false_spots=10), rng).hu
            count, _, _, centres = cv2.connectedComponentsWithStats((hu > 0).astype(np.uint8), connectivity=8)
            assert count == 11
            places.append(centres[1:])
        every = np.concatenate(places)
        assert (every.max(axis=0) > [COLUMNS - 30, ROWS - 30]).all()
        assert (every.min(axis=0) < [30, 30]).all()

    def test_spot_sets_have_false_spots_over_the_whole_image(self, cube: Frame) -> None:
        spots = random_spot_set(np.random.default_rng(6), cube, SpotSetSettings(SCANNER, 6, 200, 0.0)).spots_px
        assert (spots <= [COLUMNS, ROWS]).all()
        assert (spots.max(axis=0) > [COLUMNS - 10, ROWS - 10]).all()

    def test_scenes_have_false_spots_over_the_whole_image_and_its_area(self, cube: Frame) -> None:
        rng = np.random.default_rng(10)
        scenes = [true_scene(rng, cube, Surroundings(SCANNER, 30.0), most_false=15) for _ in range(12)]
        false = np.concatenate([scene.spots_px[scene.rods == NO_ROD] for scene in scenes])
        assert (false <= [COLUMNS, ROWS]).all()
        assert (false.max(axis=0) > [COLUMNS - 15, ROWS - 15]).all()
        for scene in scenes:
            assert scene.slice_area_mm2 == pytest.approx(ROWS * COLUMNS * 0.5 * 0.65)
        # A scale that is configured wrong makes the area another one.
        scene = wrong_spacing(rng, cube, Surroundings(SCANNER, 30.0), share=0.1)
        assert scene.scale.shear == pytest.approx(SCALE.shear)
        assert scene.slice_area_mm2 == pytest.approx(ROWS * COLUMNS * scene.scale.sx * scene.scale.sy)
        factors = sorted([scene.scale.sx / SCALE.sx, scene.scale.sy / SCALE.sy])
        # Where the image shows the middle of the frame, it is at that scale.
        assert scene.truth is not None
        shown = project(cube, scene.truth, scene.scale)[0][scene.rods]
        assert np.linalg.norm((scene.spots_px - shown).mean(axis=0)) < 2.0
        assert factors in (pytest.approx([1.0, 1.1]), pytest.approx([0.9, 1.0]))

    def test_a_spot_set_is_of_rods_in_its_own_pixels(self, cube: Frame) -> None:
        drawn = random_spot_set(np.random.default_rng(7), cube, SpotSetSettings(SCANNER, 6, 0, 0.0))
        expected = project(cube, drawn.slice_from_frame, SCALE)[0]
        np.testing.assert_allclose(np.sort(drawn.spots_px, axis=0), np.sort(expected, axis=0), atol=1e-9)

    def test_metal_is_a_share_of_the_pixel(self, cube: Frame) -> None:
        pose = centred_pose(cube, BARE)
        image = metal_fraction([PlacedFrame(cube, pose, cube.line_names[1:])], BARE)
        cosine = abs(cube.directions[0, 2])
        assert image.sum() * 0.5 * 0.65 == pytest.approx(math.pi / 4 * cube.diameters[0] ** 2 / cosine, rel=1e-3)

    def test_the_patient_lies_across_the_image(self) -> None:
        hu = background(SHAPE, PixelScale(0.5, 0.65), True)
        # The outermost ellipse: 0.045 to 0.955 of the width, 0.44 to 0.99 of the height.
        row = round(0.715 * ROWS)
        across = np.flatnonzero(hu[row] > -500)
        down = np.flatnonzero(hu[:, COLUMNS // 2] > -500)
        np.testing.assert_allclose([across[0], across[-1]], [0.045 * COLUMNS, 0.955 * COLUMNS], atol=2)
        np.testing.assert_allclose([down[0], down[-1]], [0.44 * ROWS, 0.99 * ROWS], atol=2)
