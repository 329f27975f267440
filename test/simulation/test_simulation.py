"""The simulated scanner against geometry worked out here by hand, and against brute force."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.simulation import (
    Cylinder,
    PlacedFrame,
    ScannerSettings,
    add_metal,
    metal_fraction,
    passage,
    random_pose,
    render_slice,
)
from stereoreg_ros.simulation.scene import _clear_of, _outline

BARE = ScannerSettings(noise_hu=0, body=False, block=False)
CUBE = Frame(
    "cube",
    ("a", "b", "c", "d", "e", "f"),
    np.array([[-30, -30, -30], [30, 30, -30], [-20, 30, -30], [20, -30, -30], [-10, 10, -30], [25, 0, -30]], float),
    np.array([[-30, 30, 30], [30, -30, 30], [20, 30, 30], [-20, -30, 30], [15, -5, 30], [-5, 20, 30]], float),
    np.ones(6),
)
UPRIGHT = Pose(np.eye(3), np.array([128.0, 128.0, 0.0]))


def leaning(degrees: float, azimuth_deg: float, middle: Array, length: float = 60.0, diameter: float = 1.0) -> Cylinder:
    """A cylinder through `middle` (2,) mm that leans from the slice's normal."""
    lean, azimuth = np.radians([degrees, azimuth_deg])
    direction = np.array([np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)])
    return Cylinder(
        np.append(middle, 0) - 0.5 * length * direction, np.append(middle, 0) + 0.5 * length * direction, diameter
    )


def rendered(cylinder: Cylinder, scale: PixelScale, thickness: float, psf: float = 0.45, side: int = 96) -> Array:
    image = np.zeros((side, side))
    add_metal(image, cylinder, scale, thickness, psf)
    return image


def centroid(image: Array) -> Array:
    v, u = np.indices(image.shape)
    middle: Array = np.array([(u * image).sum(), (v * image).sum()]) / image.sum()
    return middle


def blobs(hu: NDArray[np.floating[Any]], threshold: float) -> int:
    return int(cv2.connectedComponents((hu > threshold).astype(np.uint8), connectivity=8)[0]) - 1


def chord_by_brute_force(cylinder: Cylinder, thickness: float, x: Array, y: Array) -> Array:
    """Share of the slice's thickness that is inside the cylinder above each point, by trying many depths."""
    z = (np.arange(40) + 0.5) / 40 * thickness - 0.5 * thickness
    points = np.stack(np.broadcast_arrays(x[..., None], y[..., None], z), axis=-1) - cylinder.start
    along = points @ cylinder.direction
    away = np.linalg.norm(points - along[..., None] * cylinder.direction, axis=-1)
    inside = (away <= 0.5 * cylinder.diameter) & (along >= 0) & (along <= cylinder.length)
    share: Array = inside.mean(axis=-1)
    return share


class TestSpot:
    @pytest.mark.parametrize("thickness", [1.0, 5.0])
    @pytest.mark.parametrize(
        "scale", [PixelScale(0.5, 0.5), PixelScale(0.45, 0.8), PixelScale(0.5, 0.6, 0.05)], ids=str
    )
    @pytest.mark.parametrize("degrees", [0, 10, 25, 45])
    def test_centroid_is_the_cut(self, degrees: float, scale: PixelScale, thickness: float) -> None:
        rng = np.random.default_rng(1)
        for azimuth in (0, 50, 130):
            start = np.append(scale.to_mm(rng.uniform(40, 55, 2)), -30.0)
            lean, turn = np.radians([degrees, azimuth])
            end = start + 60 * np.array([np.tan(lean) * np.cos(turn), np.tan(lean) * np.sin(turn), 1.0])
            drift = scale.to_mm(np.array([48.0, 48.0])) - 0.5 * (start + end)[:2] + rng.uniform(-1, 1, 2)
            start[:2] += drift
            end[:2] += drift
            cut = start + start[2] / (start[2] - end[2]) * (end - start)
            spot = centroid(rendered(Cylinder(start, end, 1.0), scale, thickness))
            np.testing.assert_allclose(spot, scale.to_px(cut[:2]), atol=0.01)

    def test_centroid_is_the_cut_for_every_rod_of_a_frame(self) -> None:
        rng = np.random.default_rng(2)
        for _ in range(5):
            pose = random_pose(rng, CUBE, BARE, max_offset_mm=20)
            starts, ends = pose @ CUBE.starts, pose @ CUBE.ends
            for k, name in enumerate(CUBE.line_names):
                others = tuple(other for other in CUBE.line_names if other != name)
                image = BARE.rod_hu * metal_fraction([PlacedFrame(CUBE, pose, others)], BARE)
                cut = starts[k] + starts[k, 2] / (starts[k, 2] - ends[k, 2]) * (ends[k] - starts[k])
                np.testing.assert_allclose(centroid(image), BARE.scale.to_px(cut[:2]), atol=0.01)

    @pytest.mark.parametrize("degrees", [0, 20, 45, 67])
    @pytest.mark.parametrize("thickness", [1.0, 5.0])
    @pytest.mark.parametrize("diameter", [1.0, 3.5])
    def test_mass_is_the_cross_section(self, degrees: float, thickness: float, diameter: float) -> None:
        scale = PixelScale(0.5, 0.7)
        image = rendered(leaning(degrees, 35, np.array([24.0, 33.0]), diameter=diameter), scale, thickness)
        section = np.pi * diameter**2 / 4 / np.cos(np.radians(degrees))
        assert image.sum() * scale.sx * scale.sy == pytest.approx(section, rel=1e-3)

    @pytest.mark.parametrize(
        ("cylinder", "thickness"),
        [
            (leaning(0, 0, np.array([4.1, 4.3])), 1.0),
            (leaning(40, 30, np.array([4.1, 4.3])), 1.0),
            (leaning(65, 70, np.array([4.1, 4.3])), 2.0),
            (leaning(30, 200, np.array([4.1, 4.3]), length=1.2), 1.5),
            (leaning(0, 0, np.array([4.1, 4.3]), diameter=4.0), 1.0),
        ],
        ids=["upright", "leaning", "streak", "short", "thick"],
    )
    @pytest.mark.parametrize("psf", [0.25, 0.45])
    def test_pixels_agree_with_brute_force(self, cylinder: Cylinder, thickness: float, psf: float) -> None:
        scale = PixelScale(0.5, 0.4)
        image = rendered(cylinder, scale, thickness, psf, side=20)
        fine = 16
        u, v = ((np.arange(20 * fine) + 0.5) / fine - 0.5 for _ in range(2))
        share = chord_by_brute_force(cylinder, thickness, *np.meshgrid(u * scale.sx, v * scale.sy))
        sigma = psf * fine / np.array([scale.sx, scale.sy])
        blurred = cv2.GaussianBlur(share, (0, 0), sigma[0], sigmaY=sigma[1], borderType=cv2.BORDER_CONSTANT)
        expected = blurred.reshape(20, fine, 20, fine).mean(axis=(1, 3))
        # What brute force itself is good for on so coarse a grid.
        np.testing.assert_allclose(image, expected, atol=0.006)

    def test_a_rod_shows_the_same_from_either_end(self) -> None:
        rod = leaning(30, 20, np.array([20.0, 24.0]))
        scale = PixelScale(0.5, 0.4)
        down = rendered(Cylinder(rod.end, rod.start, rod.diameter), scale, 1.5)
        np.testing.assert_allclose(down, rendered(rod, scale, 1.5), atol=1e-4)

    def test_a_rod_that_ends_in_the_slice_is_fainter(self) -> None:
        scale = PixelScale(0.5, 0.5)
        whole = rendered(Cylinder(np.array([20.0, 20, -9]), np.array([20.0, 20, 9]), 1.0), scale, 2.0)
        ending = rendered(Cylinder(np.array([20.0, 20, -9]), np.array([20.0, 20, -0.5]), 1.0), scale, 2.0)
        np.testing.assert_allclose(ending, 0.25 * whole, atol=1e-12)

    def test_a_rod_beside_the_slice_leaves_no_trace(self) -> None:
        scale = PixelScale(0.5, 0.5)
        assert not rendered(Cylinder(np.array([20.0, 20, -9]), np.array([20.0, 20, -0.6]), 1.0), scale, 1.0).any()
        assert not rendered(Cylinder(np.array([5.0, 5, 1.1]), np.array([30.0, 30, 1.1]), 1.0), scale, 1.0).any()

    def test_a_rod_in_the_plane_is_a_strip(self) -> None:
        scale = PixelScale(0.5, 0.5)
        image = rendered(Cylinder(np.array([10.0, 20, 0]), np.array([40.0, 20, 0]), 1.0), scale, 2.0)
        assert image.sum() * 0.25 * 2.0 == pytest.approx(30 * np.pi / 4, rel=1e-6)
        assert image[40, 25:75].std() < 1e-3

    def test_a_spot_at_the_edge_of_the_image_is_cut_off(self) -> None:
        scale = PixelScale(0.5, 0.5)
        image = rendered(leaning(0, 0, np.array([-0.25, 20.0])), scale, 1.0)
        assert image.sum() * 0.25 == pytest.approx(0.5 * np.pi / 4, rel=1e-3)


class TestSlice:
    def test_same_seed_same_slice(self) -> None:
        settings = ScannerSettings(false_spots=4, needle=True)
        one, two, other = (
            render_slice([PlacedFrame(CUBE, UPRIGHT)], settings, np.random.default_rng(seed)).hu for seed in (7, 7, 8)
        )
        assert np.array_equal(one, two)
        assert not np.array_equal(one, other)

    def test_values_are_whole_hu_within_the_scanners_range(self) -> None:
        hu = render_slice([PlacedFrame(CUBE, UPRIGHT)], ScannerSettings(noise_hu=50), np.random.default_rng(1)).hu
        assert np.array_equal(hu, np.rint(hu))
        assert hu.min() == -1024
        assert hu.max() == 3071
        assert np.array_equal(hu.astype(np.int16), hu)

    def test_noise_has_the_level_asked_for(self) -> None:
        settings = ScannerSettings(body=False, block=True, noise_hu=20)
        hu = render_slice([PlacedFrame(CUBE, UPRIGHT)], settings, np.random.default_rng(3)).hu
        plastic = hu[210:245, 270:300]
        assert plastic.mean() == pytest.approx(100, abs=2)
        assert plastic.std() == pytest.approx(20, rel=0.1)

    def test_rods_show_and_hidden_ones_do_not(self) -> None:
        rng = np.random.default_rng(4)
        pose = random_pose(rng, CUBE, BARE)
        settings = ScannerSettings(needle=False)
        whole = render_slice([PlacedFrame(CUBE, pose)], settings, rng).hu
        assert blobs(whole, 1500) == 6
        assert blobs(render_slice([PlacedFrame(CUBE, pose, ("b", "e"))], settings, rng).hu, 1500) == 4
        without = metal_fraction([PlacedFrame(CUBE, pose, ("b",))], BARE)
        only = metal_fraction([PlacedFrame(CUBE, pose, ("a", "c", "d", "e", "f"))], BARE)
        np.testing.assert_allclose(without + only, metal_fraction([PlacedFrame(CUBE, pose)], BARE))

    @pytest.mark.parametrize("count", [0, 1, 8, 30])
    def test_false_spots_are_as_many_as_asked_for(self, count: int) -> None:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            settings = ScannerSettings(noise_hu=0, body=False, block=False, false_spots=count)
            placed = [PlacedFrame(CUBE, random_pose(rng, CUBE, settings))]
            hu = render_slice(placed, settings, rng).hu
            assert blobs(hu, -500) == 6 + count
            rods = metal_fraction(placed, settings)
            # False spots stay clear of the rods' spots.
            near = cv2.dilate((rods > 0.01).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            alone = render_slice(placed, BARE, rng).hu
            assert np.array_equal(hu[near], alone[near])

    def test_clutter_is_clear_of_everything_that_is_there(self) -> None:
        """Of places that are clear of nothing, of one of two, and of both by 3.9 and by 4.1 mm, the last is taken."""
        there = [leaning(0, 0, np.array([x, 50.0])) for x in (50.0, 90.0)]
        occupied = [_outline(one, BARE) for one in there]
        places = [50.5, 89.0, 54.9, 55.1]
        drawn = iter([leaning(0, 0, np.array([x, 50.0])) for x in places])
        found = _clear_of(occupied, BARE, lambda: next(drawn), "something")
        assert found.start[0] == 55.1
        assert len(occupied) == 3

    def test_needle_is_long_bright_and_clear_of_the_rods(self) -> None:
        settings = ScannerSettings(noise_hu=0, body=False, block=False, needle=True)
        for seed in range(3):
            rng = np.random.default_rng(seed)
            placed = [PlacedFrame(CUBE, random_pose(rng, CUBE, settings))]
            hu = render_slice(placed, settings, rng).hu
            _, _, stats, _ = cv2.connectedComponentsWithStats((hu > 0).astype(np.uint8), connectivity=8)
            longest = np.hypot(stats[1:, cv2.CC_STAT_WIDTH], stats[1:, cv2.CC_STAT_HEIGHT]).max()
            assert longest * 0.5 > 30
            assert len(stats) - 1 == 7

    def test_two_frames_in_one_slice(self) -> None:
        settings = ScannerSettings(noise_hu=0, body=False)
        one = PlacedFrame(CUBE, Pose(np.eye(3), np.array([75.0, 100.0, 3.0])))
        other = PlacedFrame(CUBE, Pose(np.eye(3), np.array([180.0, 150.0, -4.0])))
        both = render_slice([one, other], settings, np.random.default_rng(5)).hu
        assert blobs(both, 1500) == 12
        alone = (render_slice([placed], settings, np.random.default_rng(5)).hu for placed in (one, other))
        assert np.array_equal(both, np.maximum(*alone))

    def test_background_shows_block_and_body(self) -> None:
        hu = render_slice([PlacedFrame(CUBE, UPRIGHT)], ScannerSettings(noise_hu=0), np.random.default_rng(6)).hu
        assert hu[0, 0] == -1000
        assert hu[230, 285] == pytest.approx(100)
        bare = render_slice([], ScannerSettings(noise_hu=0), np.random.default_rng(6)).hu
        bone = (bare > 600) & (bare < 1300)
        assert bone.sum() * 0.25 > 300
        assert bare.max() < 1300
        assert ((bare > -150) & (bare < 300)).mean() > 0.3

    def test_block_ends_where_the_frame_ends(self) -> None:
        settings = ScannerSettings(noise_hu=0, body=False)
        for z, expected in ((33.0, 100), (35.5, -1000)):
            placed = PlacedFrame(CUBE, Pose(np.eye(3), np.array([128.0, 128.0, z])))
            hu = render_slice([placed], settings, np.random.default_rng(1)).hu
            assert hu[256, 256] == expected

    def test_plane_is_handed_on(self) -> None:
        plane = Pose(np.eye(3), np.array([-128.0, -128.0, 40.0]))
        rendered_slice = render_slice([], BARE, np.random.default_rng(1), plane)
        assert rendered_slice.scanner_from_slice is plane
        assert rendered_slice.scale == BARE.scale


class TestMotion:
    def test_random_poses_keep_their_bounds(self) -> None:
        rng = np.random.default_rng(1)
        poses = [random_pose(rng, CUBE, BARE) for _ in range(200)]
        tilts = np.degrees([rotation_angle(pose.rotation) for pose in poses])
        assert tilts.max() < 20 * np.sqrt(3) + 1
        assert tilts.max() > 20
        offsets = np.array([pose.translation for pose in poses]) - [128, 128, 0]
        assert (np.abs(offsets) <= [50, 50, 10]).all()
        assert (np.abs(offsets).max(axis=0) > [40, 40, 8]).all()
        for pose in poses:
            starts, ends = pose @ CUBE.starts, pose @ CUBE.ends
            assert (starts[:, 2] * ends[:, 2] < 0).all()
            cuts = starts + (starts[:, 2] / (starts[:, 2] - ends[:, 2]))[:, None] * (ends - starts)
            assert ((cuts[:, :2] > 0) & (cuts[:, :2] < 255.5)).all()

    def test_random_pose_about_a_nominal_one(self) -> None:
        rng = np.random.default_rng(2)
        nominal = Pose.from_quaternion([0, 0, 1, 1], [100.0, 90.0, 0.0])
        for _ in range(20):
            pose = random_pose(rng, CUBE, BARE, nominal=nominal, max_tilt_deg=5, max_offset_mm=2, max_depth_mm=1)
            assert np.degrees(rotation_angle(pose.rotation @ nominal.rotation.T)) < 9
            assert (np.abs(pose.translation - nominal.translation) <= [2, 2, 1]).all()

    def test_the_middle_of_the_frame_is_where_it_is_asked_for_wherever_its_origin_is(self) -> None:
        shift = np.array([5.0, 80.0, -40.0])
        shifted = replace(CUBE, starts=CUBE.starts + shift, ends=CUBE.ends + shift)
        rng = np.random.default_rng(6)
        for _ in range(20):
            pose = random_pose(rng, shifted, BARE, max_offset_mm=2, max_depth_mm=1)
            assert (np.abs(pose @ shift - [128.0, 128.0, 0.0]) <= [2, 2, 1]).all()

    def test_random_pose_that_cannot_be(self) -> None:
        rng = np.random.default_rng(3)
        with pytest.raises(ValueError, match=r"frame 'cube': no pose found with 6 rods .* 32 x 32 mm"):
            random_pose(rng, CUBE, ScannerSettings(shape=(64, 64)))
        with pytest.raises(ValueError, match="min_rods is 7, expected 0 to 6"):
            random_pose(rng, CUBE, BARE, min_rods=7)

    def test_passage_loses_rods_towards_both_ends(self) -> None:
        middle = random_pose(np.random.default_rng(4), CUBE, BARE, max_tilt_deg=8, max_offset_mm=5, max_depth_mm=0)
        settings = ScannerSettings(shape=(512, 512), noise_hu=0, body=False)
        poses = list(itertools.islice(passage(CUBE, middle, 2.0), 34))
        counts = [
            blobs(render_slice([PlacedFrame(CUBE, pose)], settings, np.random.default_rng(5)).hu, 800) for pose in poses
        ]
        assert max(counts) == 6
        assert min(counts) >= 2
        assert min(counts[:3]) < 6
        assert min(counts[-6:]) < 6
        assert sum(count == 6 for count in counts) > 20
        steps = np.diff([pose.translation for pose in poses], axis=0)
        assert np.abs(np.abs(steps[:20, 2]) - 2.0).max() < 0.05

    def test_passage_goes_to_and_fro(self) -> None:
        poses = list(itertools.islice(passage(CUBE, UPRIGHT, 2.0, drift_deg=0), 200))
        z = np.array([pose.translation[2] for pose in poses])
        assert z.min() == pytest.approx(-30)
        assert z.max() == pytest.approx(30)
        assert np.abs(np.diff(z)).max() <= 2.0 + 1e-9
        assert (np.diff(np.sign(np.diff(z))) != 0).sum() >= 5

    def test_passage_that_cannot_be(self) -> None:
        with pytest.raises(ValueError, match="step_mm is 0, expected a positive number"):
            passage(CUBE, UPRIGHT, 0)
        with pytest.raises(ValueError, match="min_rods is 0, expected 1 to 6"):
            passage(CUBE, UPRIGHT, 1.0, min_rods=0)
        flat = Pose.from_quaternion([1, 0, 0, 1], [0, 0, 0])
        apart = Frame("apart", ("a", "b", "c"), np.array([[0, k, 0] for k in (0, 9, 18)], float),
                      np.array([[9, k, 1] for k in (0, 9, 18)], float), np.ones(3))  # fmt: skip
        with pytest.raises(ValueError, match="frame 'apart': no slice is reached by 3 rods"):
            passage(apart, flat, 1.0)


class TestBadSettings:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("slice_thickness_mm", 0.0),
            ("slice_thickness_mm", float("nan")),
            ("psf_sigma_mm", -1.0),
            ("noise_hu", -0.1),
            ("noise_hu", "20"),
            ("rod_hu", 0.0),
            ("false_spots", -1),
            ("false_spots", 2.5),
            ("false_spots", True),
            ("shape", (512,)),
            ("shape", (0, 512)),
            ("shape", (512.0, 512)),
            ("scale", 0.5),
        ],
    )
    def test_is_refused_by_name(self, name: str, value: Any) -> None:
        with pytest.raises(ValueError, match=f"^{name} is .*, expected "):
            ScannerSettings(**{name: value})

    def test_unknown_hidden_line(self) -> None:
        with pytest.raises(
            ValueError, match="hidden_lines names 'z', expected names of frame 'cube': a, b, c, d, e, f"
        ):
            PlacedFrame(CUBE, UPRIGHT, ("a", "z"))

    def test_no_room_for_false_spots(self) -> None:
        with pytest.raises(ValueError, match="false_spots: no place found that is 4 mm clear"):
            render_slice([], ScannerSettings(shape=(32, 32), false_spots=30), np.random.default_rng(1))
