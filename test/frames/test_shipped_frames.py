"""The shipped frames: rods where their drawings have them, tolerances that were measured, comments that are true."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from stereoreg_ros import RegistrationOptions, load_frame, register_slice
from stereoreg_ros.cli import design as design_command
from stereoreg_ros.cli import main
from stereoreg_ros.cli.parsing import INTERRUPTED
from stereoreg_ros.dicom import read_series
from stereoreg_ros.frames.design_search import Requirements
from stereoreg_ros.frames.inspection import Inspection
from stereoreg_ros.frames.layouts import Layouts
from stereoreg_ros.frames.proposal import Proposal
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import shipped_frames
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, centred_pose, render_slice
from stereoreg_ros.spots import find_spots
from support.dicom_files import CATPHAN, SHARED_DATA, real

CUBES = ("cube5", "cube6", "cube8")
# How the phantoms stand, by the description of the data: a point of the frame, where it lies, and the rotation vector.
LEKSELL9 = ((95.0, -60.0, -60.0), (3.05, -0.65, -6.68), (-0.18, 1.51, 0.38))
CATPHAN_SECOND = ((0.0, 0.0, 0.0), (0.7, 0.8, 30.5), (0.0, 0.0, 0.0))


def comment_of(name: str) -> str:
    """The comment of a frame file, in one line."""
    lines = shipped_frames()[name].read_text().splitlines()
    return " ".join(line.removeprefix("# ") for line in lines if line.startswith("#"))


def standing(point: tuple[float, ...], at: tuple[float, ...], turned_deg: tuple[float, ...]) -> Pose:
    rotation = rotation_exp(np.radians(turned_deg))
    return Pose(rotation, np.array(at) - rotation @ np.array(point))


@pytest.mark.parametrize("name", sorted(shipped_frames()))
def test_says_how_it_stands(name: str) -> None:
    told = comment_of(name)
    assert re.search(r"nominal_orientation [01] 0 0 [01] ", told)
    assert "of a patient lying head first, supine" in told
    assert "(DICOM's L, P, S)" in told or "DICOM's L, P, S of" in told or "(DICOM's L, A, I)" in told


@pytest.mark.parametrize("name", sorted(set(shipped_frames()) - set(CUBES)))
def test_is_known_to_a_tolerance_and_says_where_it_is_from(name: str) -> None:
    frame = load_frame(name)
    assert np.isin(frame.tolerances_or(np.nan), [0.25, 0.35, 0.4]).all()
    assert "tolerance_mm" in comment_of(name)
    assert "Threshold: " in comment_of(name)


@pytest.mark.parametrize("name", CUBES)
def test_cubes_leave_the_tolerance_to_the_option(name: str) -> None:
    assert np.isnan(load_frame(name).tolerances_or(np.nan)).all()


@pytest.mark.parametrize("name", CUBES)
def test_the_call_in_a_cubes_file_writes_that_file(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All but the search itself, which takes minutes: the error and the text, down to the last letter."""

    def stopped(*_: object) -> Inspection:
        raise KeyboardInterrupt

    frame = load_frame(name)
    call = re.search(r"Made by stereoreg (design .*?) Axes", comment_of(name))
    tried = re.search(r"0 of (\d+) spot sets", comment_of(name))
    assert call
    assert tried

    def found(requirements: Requirements, *_: object) -> Proposal:
        return Proposal(frame, float(requirements.target_errors(Layouts.of(frame))[0]), 0, int(tried[1]), False)

    monkeypatch.setattr(design_command, "propose", found)
    monkeypatch.setattr(design_command, "inspected", stopped)
    assert main([*shlex.split(call[1]), "--output", str(tmp_path)]) == INTERRUPTED
    assert (tmp_path / f"{name}.yaml").read_text() == shipped_frames()[name].read_text()


class TestDrawings:
    def test_the_side_plates_of_both_leksell_boxes_are_the_same(self) -> None:
        two, three = load_frame("leksell_ct"), load_frame("leksell_ct9")
        np.testing.assert_array_equal(three.starts[:6], two.starts)
        np.testing.assert_array_equal(three.ends[:6], two.ends)
        np.testing.assert_array_equal(three.starts[6:], [[35, -175, 0], [35, -175, 0], [155, -175, 0]])
        np.testing.assert_array_equal(three.ends[6:], [[35, -175, -120], [155, -175, -120], [155, -175, -120]])

    def test_half_a_turn_about_x_leaves_the_side_plates_but_not_the_front_one(self) -> None:
        turned = np.array([1.0, -1.0, -1.0])
        for name, same in (("leksell_ct", True), ("leksell_ct9", False)):
            frame = load_frame(name)
            middle = np.array([95.0, -60.0, -60.0])
            assert (
                is_same(frame, turned * (frame.starts - middle) + middle, turned * (frame.ends - middle) + middle)
                is same
            )

    def test_brw(self) -> None:
        frame = load_frame("brw")
        starts, ends = frame.starts, frame.ends
        np.testing.assert_allclose(np.linalg.norm(starts[:, :2], axis=1), 140, atol=1e-3)
        np.testing.assert_allclose(np.linalg.norm(ends[:, :2], axis=1), 140, atol=1e-3)
        np.testing.assert_array_equal(starts[:, 2], 0)
        np.testing.assert_array_equal(ends[:, 2], 189.2)
        angles = np.degrees(np.arctan2(starts[:6, 1], starts[:6, 0])) % 360
        np.testing.assert_allclose(angles, np.arange(0, 360, 60), atol=1e-3)
        np.testing.assert_array_equal(starts[:6, :2], ends[:6, :2])
        np.testing.assert_allclose(np.linalg.norm((ends - starts)[6:, :2], axis=1), 140, atol=2e-3)
        assert is_same(frame, frame.starts @ (turn := rotation_exp(np.radians([0, 0, 120]))).T, frame.ends @ turn.T)
        assert not is_same(frame, frame.starts @ (turn := rotation_exp(np.radians([0, 0, 60]))).T, frame.ends @ turn.T)


def is_same(frame: Frame, starts: Array, ends: Array) -> bool:
    """Whether rods with these ends, in whatever order, are those of the frame."""
    own = np.concatenate([np.hstack([frame.starts, frame.ends]), np.hstack([frame.ends, frame.starts])])
    apart = np.linalg.norm(np.hstack([starts, ends])[:, None] - own, axis=-1)
    return bool((apart.min(axis=1) < 0.01).all())


def seen(frame: Frame, pose: Pose, slices: Iterator[Slice], threshold: float) -> tuple[Array, Array]:
    """Spots (m, 3) mm in the scanner within 3 mm of where the pose has rods (m,) cut, and these rods."""
    options, points, lines = RegistrationOptions(threshold=threshold), [], []
    for one in slices:
        mm = one.scale.to_mm(find_spots(one, options).centres_px)
        slice_from_frame = one.scanner_from_slice.inverse() @ pose
        cuts = cut(frame, slice_from_frame.rotation, slice_from_frame.translation)
        for line in np.flatnonzero(cuts.inside):
            away = np.linalg.norm(mm - cuts.points_mm[line], axis=1)
            if away.min(initial=np.inf) < 3.0:
                points.append(one.scanner_from_slice @ np.append(mm[away.argmin()], 0.0))
                lines.append(line)
    return np.array(points), np.array(lines)


def fitted(frame: Frame, pose: Pose, points: Array, lines: Array) -> Pose:
    """The pose with the least squared distances from points (m, 3) to lines (m,)."""

    def moved(change: Array) -> Pose:
        return pose.perturbed(change[:3], change[3:])

    def distances(change: Array) -> Array:
        return off_lines(frame, moved(change), points, lines).ravel()

    return moved(least_squares(distances, np.zeros(6), x_scale=[1, 1, 1, 0.01, 0.01, 0.01]).x)


def off_lines(frame: Frame, pose: Pose, points: Array, lines: Array) -> Array:
    """From the rods to points of the scanner, (m, 3) mm in the frame's axes, at right angles to the rods."""
    away = pose.inverse() @ points - frame.starts[lines]
    directions = frame.directions[lines]
    return np.asarray(away - np.einsum("ij,ij->i", away, directions)[:, None] * directions)


def spread_of_ends(frame: Frame, pose: Pose, points: Array, lines: Array) -> float:
    """Standard deviation per axis, mm, of where straight lines through each rod's points have its ends."""
    off = off_lines(frame, pose, points, lines)
    along = np.einsum("ij,ij->i", pose.inverse() @ points - frame.starts[lines], frame.directions[lines])
    squares = 0.0
    for line in range(len(frame)):
        mine = lines == line
        share = along[mine] / np.linalg.norm(frame.ends[line] - frame.starts[line])
        squares += float((np.linalg.lstsq(np.column_stack([1 - share, share]), off[mine], rcond=None)[0] ** 2).sum())
    # Two axes at each of two ends; the pose has taken six of these degrees of freedom.
    return float(np.sqrt(squares / (4 * len(frame) - 6)))


class TestTolerances:
    def test_leksell_rods_are_off_as_the_file_says(self) -> None:
        frame = load_frame("leksell_ct9")
        series = [one.ct_slice for one in read_series(real(SHARED_DATA / "leksell9_ct"))]
        shown = [one for one in series if -50.5 < one.scanner_from_slice.translation[2] < 50]
        points, lines = seen(frame, standing(*LEKSELL9), iter(shown[::4]), 1000.0)
        assert (np.bincount(lines) >= 9).all()
        pose = fitted(frame, standing(*LEKSELL9), points, lines)
        spread = spread_of_ends(frame, pose, points, lines)
        print(f"ends off by {spread:.2f} mm per axis")
        assert 0.3 < spread < 0.45
        # As told, and with it which way the patient lies: by the tags of the scan.
        assert np.linalg.norm(pose @ np.array(LEKSELL9[0]) - LEKSELL9[1]) < 0.5
        assert np.degrees(rotation_angle(pose.rotation)) < 2.5

    def test_catphans_differ_as_the_file_says(self) -> None:
        frame = load_frame("catphan_ctp404")
        series = [one.ct_slice for one in read_series(real(SHARED_DATA / "catphan_second"))]
        shown = [one for one in series if 19.5 < one.scanner_from_slice.translation[2] < 38.5]
        points, lines = seen(frame, standing(*CATPHAN_SECOND), iter(shown), 300.0)
        assert (np.bincount(lines) >= 9).all()
        spread = spread_of_ends(frame, fitted(frame, standing(*CATPHAN_SECOND), points, lines), points, lines)
        print(f"ends of another unit off by {spread:.2f} mm per axis")
        assert 0.3 < spread < 0.45

    def test_zframe_tubes_are_off_as_the_file_says(self) -> None:
        """In the middle of the tubes, which is all that six slices show: the mean of each tube, the slices apart."""
        frame = load_frame("zframe")
        series = [one.ct_slice for one in read_series(real(SHARED_DATA / "zframe_mr"))][6:12]
        start = Pose(np.eye(3), np.array([7.2, -17.2, -102.2]))
        for _ in range(2):
            points, lines = seen(frame, start, iter(series), 200.0)
            start = fitted(frame, start, points, lines)
        assert (np.bincount(lines) == 6).all()
        off = off_lines(frame, start, points, lines)
        means = np.array([off[lines == line].mean(axis=0) for line in range(len(frame))])
        # Two axes a tube, less six of the pose; of the middle, half the variance of the ends.
        spread = float(np.sqrt(2 * (means**2).sum() / (2 * len(frame) - 6)))
        print(f"ends off by {spread:.2f} mm per axis")
        assert 0.15 < spread < 0.35


class TestAdvice:
    """Each frame in a slice as its comment says: threshold, orientation, target; everything else by default."""

    @pytest.mark.parametrize(
        ("name", "folder", "threshold", "heights_mm"),
        [
            ("leksell_ct9", SHARED_DATA / "leksell9_ct", 1000.0, (-30.4, 12.1)),
            ("zframe", SHARED_DATA / "zframe_mr", 200.0, (-103.5, -101.1)),
            ("catphan_ctp404", SHARED_DATA / "catphan_second", 300.0, (27.9, 31.8)),
            ("catphan_ctp404", CATPHAN, 300.0, (-1.3, 1.2)),
        ],
        ids=["leksell", "zframe", "second catphan", "catphan"],
    )
    def test_stands_near_the_identity_in_the_images(
        self, name: str, folder: Path, threshold: float, heights_mm: tuple[float, ...]
    ) -> None:
        frame = load_frame(name)
        middle = np.concatenate([frame.starts, frame.ends]).mean(axis=0)
        options = RegistrationOptions(threshold=threshold, max_rotation_deg=30.0, target_in_frame_mm=tuple(middle))
        series = [one.ct_slice for one in read_series(real(folder))]
        for wanted in heights_mm:
            one = min(series, key=lambda one: abs(one.scanner_from_slice.translation[2] - wanted))
            result = register_slice(one, frame, options)
            assert result, result.message
            assert result.estimate.inliers == len(frame)
            assert np.degrees(rotation_angle(result.scanner_from_frame.rotation)) < 5

    @pytest.mark.parametrize("threshold", [300.0, "auto"])
    @pytest.mark.parametrize(("thickness_mm", "height_mm"), [(0.625, 60.0), (2.0, 120.0)])
    def test_brw_in_a_rendered_slice(self, threshold: float | str, thickness_mm: float, height_mm: float) -> None:
        frame = load_frame("brw")
        settings = ScannerSettings(
            scale=PixelScale(0.65, 0.65), slice_thickness_mm=thickness_mm, rod_hu=1500.0, body=False, block=False
        )
        level = centred_pose(frame, settings)
        tilted = Pose(rotation_exp(np.radians([3.0, -4.0, 5.0])), np.zeros(3))
        middle = np.array([0.0, 0.0, height_mm])
        truth = Pose(tilted.rotation, (level @ middle) * [1, 1, 0] - tilted.rotation @ middle)
        ct_slice = render_slice([PlacedFrame(frame, truth)], settings, np.random.default_rng(0))
        options = RegistrationOptions(threshold=threshold, max_rotation_deg=30.0, slice_thickness_mm=thickness_mm)
        result = register_slice(ct_slice, frame, options)
        assert result, result.message
        assert result.estimate.inliers == 9
        assert np.linalg.norm(result.scanner_from_frame @ middle - truth @ middle) < 0.3
        assert np.degrees(rotation_angle(result.scanner_from_frame.rotation @ truth.rotation.T)) < 0.3

    def test_brw_without_orientation_is_ambiguous(self) -> None:
        frame = load_frame("brw")
        settings = ScannerSettings(scale=PixelScale(0.65, 0.65), rod_hu=1500.0, body=False, block=False)
        pose = centred_pose(frame, settings)
        ct_slice = render_slice(
            [PlacedFrame(frame, pose.perturbed(np.array([0, 0, 9.0]), np.zeros(3)))], settings, np.random.default_rng(0)
        )
        result = register_slice(ct_slice, frame, RegistrationOptions(threshold=300.0))
        assert not result
        assert result.reason == "ambiguous"
