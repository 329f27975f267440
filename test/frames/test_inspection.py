"""What the inspector makes of a frame, with trials made by hand in place of registrations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame
from stereoreg_ros.frames.ambiguity import Trial
from stereoreg_ros.frames.inspection import Inspection, _turned, inspect_frame
from stereoreg_ros.frames.inspection_table import table_of
from stereoreg_ros.frames.slice_poses import SlicePoses
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import rotation_exp
from stereoreg_ros.solvers.calibration import calibration_covariance
from stereoreg_ros.uncertainty import cramer_rao_pose, error_ball_95, point_covariance

FRAME = load_frame("cube6")
SCALE = PixelScale(0.5, 0.5)
# Upright or leaning rods alike, where they are drawn, at a scale that is known: the bound is that of the noise alone.
NOISE_ALONE = RegistrationOptions(
    spot_noise_px=0.3,
    slice_thickness_mm=0.0,
    frame_tolerance_mm=0.0,
    scale_tolerance=0.0,
    target_in_frame_mm=(0, 80, 0),
)
RIGHT = Trial(None, "", True, ())


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> dict[int | None, Trial]:
    """What the trials come to, by the rod that is left out; right unless something else is put in."""
    outcomes: dict[int | None, Trial] = {}

    def trials(
        _frame: Frame, poses: SlicePoses, _scale: object, _options: object, left_out: Sequence[int | None], _rng: object
    ) -> Iterator[Trial]:
        for _ in range(len(poses)):
            for out in left_out:
                yield replace(outcomes.get(out, RIGHT), left_out=out)

    monkeypatch.setattr("stereoreg_ros.frames.inspection.trials", trials)
    return outcomes


def inspected(frame: Frame = FRAME, options: RegistrationOptions = NOISE_ALONE, **asked: Any) -> Inspection:
    return inspect_frame(frame, options, SCALE, **asked)


@pytest.mark.usefixtures("made")
class TestFigures:
    def test_of_one_pose_they_are_those_of_the_bound(self) -> None:
        for seed in range(3):
            found = inspected(count=1, seed=seed, largest_tilt_deg=40.0)
            pose, lines = found.poses.pose(0), np.flatnonzero(found.visible[0])
            covariance = cramer_rao_pose(FRAME, lines, pose, SCALE, 0.3)
            for radii, point in ((found.error_origin_mm, np.zeros(3)), (found.error_target_mm, [0.0, 80.0, 0.0])):
                ball = error_ball_95(point_covariance(covariance, pose, np.asarray(point)))
                np.testing.assert_allclose(radii, ball, rtol=1e-6)
            for std, block in (
                (found.position_std_mm, covariance[:3, :3]),
                (np.radians(found.rotation_std_deg), covariance[3:, 3:]),
            ):
                # Along the frame's axes as they stand in the slice.
                along = [np.sqrt(axis @ block @ axis) for axis in pose.rotation.T]
                np.testing.assert_allclose(std, along, rtol=1e-6)
            values, vectors = np.linalg.eigh(covariance[:3, :3])
            assert values[2] > 1.1 * values[1]
            assert abs(found.weakest_axis @ (pose.rotation.T @ vectors[:, 2])) == pytest.approx(1.0)
            assert found.weakest_axis[np.abs(found.weakest_axis).argmax()] > 0

    def test_a_scale_from_one_slice_follows_where_five_rods_show(self) -> None:
        found = inspected(count=300)
        rods = found.visible.sum(axis=1)
        assert set(rods) == {4, 5, 6}
        assert np.isinf(found.scale_std_percent[rods == 4]).all()
        assert np.isfinite(found.scale_std_percent[rods == 6]).all()
        for row in np.flatnonzero(rods == 6)[:5]:
            bound = calibration_covariance(FRAME, np.arange(6), found.poses.pose(int(row)), SCALE, 0.3)
            worse = 100 * np.sqrt(bound[:2, :2].diagonal().max()) / 0.5
            assert found.scale_std_percent[row] == pytest.approx(worse, rel=1e-4)

    @pytest.mark.parametrize("fewest", [4, 5, 6])
    def test_every_pose_shows_the_rods_that_are_needed(self, fewest: int) -> None:
        found = inspected(options=replace(NOISE_ALONE, min_inliers=fewest), count=100)
        assert found.visible.sum(axis=1).min() == fewest
        assert found.record()["share_of_poses_shown"] == found.shown < 1.0

    def test_slices_are_those_of_a_frame_that_stands_as_configured(self) -> None:
        """Head down, and within twenty degrees of that."""
        options = replace(NOISE_ALONE, nominal_orientation=(1.0, 0.0, 0.0, 0.0), max_rotation_deg=20.0)
        found = inspected(options=options, count=50)
        assert (found.poses.rotations[:, 2, 2] < np.cos(np.radians(20.0)) * -1 + 1e-9).all()
        assert (found.poses.rotations[:, 0, 0] > np.cos(np.radians(20.0)) - 1e-9).all()

    def test_covariances_are_turned_into_the_frames_axes(self) -> None:
        """By a third of a turn, which takes the frame's x axis to the slice's y, y to z, z to x."""
        turn = rotation_exp(2 * np.pi / 3 * np.ones(3) / np.sqrt(3))
        np.testing.assert_allclose(turn @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
        turned = _turned(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])[None], turn[None])[0]
        np.testing.assert_allclose(turned, np.diag([2.0, 3.0, 1.0, 5.0, 6.0, 4.0]), atol=1e-12)


class TestTrials:
    def test_all_rods_in_every_pose_and_each_missing_in_as_many_as_take_as_long(
        self, made: dict[int | None, Trial]
    ) -> None:
        made[2] = Trial(2, "ambiguous", False, (("a -> b", 90.0, 3.0), ("b -> a", 80.0, 2.0)))
        made[3] = Trial(3, "", False, (("a -> b", 70.0, 5.0),))
        shares: list[float] = []

        def progress(share: float) -> bool:
            shares.append(share)
            return True

        found = inspected(count=12, progress=progress)
        assert [trial.left_out for trial in found.whole] == [None] * 12
        assert [trial.left_out for trial in found.one_missing] == [0, 1, 2, 3, 4, 5] * 2
        np.testing.assert_allclose(shares, np.arange(1, 25) / 24)
        record = found.record()
        assert (record["outcomes"], record["outcomes_one_rod_missing"]) == (
            {"accepted": 12},
            {"accepted": 10, "ambiguous": 2},
        )
        # Refused is not wrong.
        assert record["wrong"] == 2
        assert record["twins"] == [
            {"rods": "a -> b", "times": 4, "angle_deg": 80.0, "distance_mm": 4.0},
            {"rods": "b -> a", "times": 2, "angle_deg": 80.0, "distance_mm": 2.0},
        ]
        lines = table_of(found)
        assert "registered, all rods there:   100.0 % accepted; 0 of 12 accepted with a wrong rod" in lines
        wrong = "registered, one rod missing:  83.3 % accepted, 16.7 % ambiguous; 2 of 12 accepted with a wrong rod"
        assert wrong in lines

    def test_the_table_says_where_tolerances_come_from(self, made: dict[int | None, Trial]) -> None:
        assert not made
        options = replace(NOISE_ALONE, frame_tolerance_mm=0.1)
        for own, sentence in (
            ([np.nan] * 6, "rods' ends to 0.1 mm per axis (frame_tolerance_mm)"),
            ([0.25] * 6, "rods' ends to 0.25 mm per axis (frame file)"),
            ([0.25] + [np.nan] * 5, "a 0.25, b 0.1, c 0.1, d 0.1, e 0.1, f 0.1 mm per axis (frame file, frame_toleran"),
        ):
            found = inspected(replace(FRAME, tolerances_mm=np.array(own)), options, count=2)
            assert sentence in table_of(found)[1]
