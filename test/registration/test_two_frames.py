"""Two different cubes in one slice, as on the paper's rail: to each the other's spots are false ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame, register_frames, register_slice, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import Slice
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.registration import Registrar
from stereoreg_ros.result import Refusal, Registration
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, centred_pose, random_pose, render_slice
from stereoreg_ros.spots import find_spots

SCANNER = ScannerSettings()
# Between the cubes' middles; the paper's stand 118.29 mm apart.
APART_MM = 118.0
FIRST = load_frame("cube6")
SECOND = Frame(
    "another cube",
    tuple("ghijkl"),
    np.array(
        [[-30.0, 0, -30], [10, 30, -30], [30, 10, -30], [0, -30, -30], [-20, -20, -30], [20, -10, -30]],
    ),
    np.array([[0.0, 30, 30], [30, 0, 30], [10, -30, 30], [-30, -10, 30], [15, -15, 30], [-15, 15, 30]]),
    np.ones(6),
)


def scene(seed: int) -> tuple[Slice, Pose, Pose]:
    """A slice through both cubes, each tilted on its own, and their slice_from_frame."""
    rng = np.random.default_rng(seed)
    middle = centred_pose(FIRST, SCANNER, share=(0.5, 0.45)).translation
    poses = []
    for frame, side in ((FIRST, -0.5), (SECOND, 0.5)):
        nominal = Pose(np.eye(3), middle + np.array([side * APART_MM, 0.0, 0.0]))
        # Turned about the cube's middle alone: the distance between the middles is kept, along the slice.
        poses.append(
            random_pose(rng, frame, SCANNER, max_tilt_deg=15, max_offset_mm=0, max_depth_mm=6, nominal=nominal)
        )
    placed = [PlacedFrame(frame, pose) for frame, pose in zip((FIRST, SECOND), poses, strict=True)]
    return render_slice(placed, SCANNER, rng), poses[0], poses[1]


def assert_right(result: Registration | Refusal, frame: Frame, true: Pose) -> None:
    assert isinstance(result, Registration), result.message
    assert result.frame is frame
    found = result.scanner_from_frame
    assert np.linalg.norm(found.translation - true.translation) < 0.3
    assert np.degrees(rotation_angle(found.rotation @ true.rotation.T)) < 0.5
    assert result.estimate.inliers == 6


def taken(result: Registration) -> Array:
    return np.array([match.spot_px for match in result.matches])


@pytest.fixture(scope="module")
def scenes() -> Sequence[tuple[Slice, Pose, Pose]]:
    return [scene(seed) for seed in range(15)]


def test_both_are_registered_in_one_call(scenes) -> None:
    for ct_slice, first, second in scenes:
        results = register_frames(ct_slice, [FIRST, SECOND])
        assert len(results) == 2
        assert_right(results[0], FIRST, first)
        assert_right(results[1], SECOND, second)


def test_no_spot_is_of_both(scenes) -> None:
    for ct_slice, first, second in scenes[:4]:
        results = register_frames(ct_slice, [FIRST, SECOND])
        one, other = results
        assert isinstance(one, Registration)
        assert isinstance(other, Registration)
        # Neither wants the other's: each is found among all of them, and each match counts in its own result's spots.
        assert len(one.spots_px) == len(other.spots_px) == 12
        for result, frame, pose in ((one, FIRST, first), (other, SECOND, second)):
            for match in result.matches:
                np.testing.assert_array_equal(result.spots_px[match.spot], match.spot_px)
                expected = project(frame, pose, SCANNER.scale)[0][match.line_index]
                assert np.linalg.norm(match.spot_px - expected) < 0.5
        apart = np.linalg.norm(taken(one)[:, None] - taken(other)[None], axis=2)
        assert apart.min() > 2
        together = np.concatenate([taken(one), taken(other)])
        np.testing.assert_array_equal(np.sort(together, axis=0), np.sort(one.spots_px, axis=0))


def test_their_order_does_not_matter(scenes) -> None:
    for ct_slice, first, second in scenes[:6]:
        there, back = register_frames(ct_slice, [FIRST, SECOND]), register_frames(ct_slice, [SECOND, FIRST])
        assert_right(back[0], SECOND, second)
        assert_right(back[1], FIRST, first)
        for one, other in zip(there, reversed(back), strict=True):
            assert isinstance(one, Registration)
            assert isinstance(other, Registration)
            np.testing.assert_allclose(
                one.scanner_from_frame.translation, other.scanner_from_frame.translation, atol=1e-4
            )
            np.testing.assert_allclose(one.scanner_from_frame.rotation, other.scanner_from_frame.rotation, atol=1e-6)


@pytest.mark.parametrize("absent_is_first", [False, True])
def test_one_that_is_not_there_is_refused_and_takes_nothing(absent_is_first: bool) -> None:
    for seed in range(4):
        rng = np.random.default_rng(100 + seed)
        true = random_pose(rng, SECOND, SCANNER, max_tilt_deg=15)
        ct_slice = render_slice([PlacedFrame(SECOND, true)], SCANNER, rng)
        frames = [FIRST, SECOND] if absent_is_first else [SECOND, FIRST]
        results = register_frames(ct_slice, frames)
        absent, present = (results[0], results[1]) if absent_is_first else (results[1], results[0])
        assert_right(present, SECOND, true)
        assert isinstance(absent, Refusal)
        assert absent.frame is FIRST
        # On all spots, whatever the order: what is not accepted lays claim to none.
        assert len(absent.spots_px) == 6
        assert absent.reason in ("no_consensus", "inaccurate", "contradicted")


def test_one_frame_is_as_by_register_slice(scenes) -> None:
    ct_slice, first, _ = scenes[0]
    options = RegistrationOptions(spot_noise_px=0.1)
    (alone,) = register_frames(ct_slice, [FIRST], options)
    assert_right(alone, FIRST, first)
    same = register_slice(ct_slice, FIRST, options)
    assert isinstance(alone, Registration)
    assert isinstance(same, Registration)
    np.testing.assert_array_equal(alone.scanner_from_frame.translation, same.scanner_from_frame.translation)
    assert alone.options is options
    assert register_frames(ct_slice, [], options) == []


def test_the_same_cube_twice_is_two_cubes(scenes) -> None:
    """Asked for twice where it stands once, the second time it is gone."""
    ct_slice, first, _ = scenes[1]
    one, again = register_frames(ct_slice, [FIRST, FIRST])
    assert_right(one, FIRST, first)
    assert not again
    # Sought among what the first has left.
    assert len(again.spots_px) == 6


def twins_at_odds(ct_slice: Slice, frames: Sequence[Frame]) -> list[tuple[bool, int]]:
    """Which of several frames are accepted, and among how many spots each was sought last."""
    return [(bool(result), len(result.spots_px)) for result in register_frames(ct_slice, frames)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_of_two_that_want_the_same_spots_the_surer_has_them_in_any_order(scenes, seed: int) -> None:
    """A file with five of the six rods describes what is there, too; chance brings its matches more often."""
    ct_slice, first, _ = scenes[seed]
    part = Frame("five of six", FIRST.line_names[:5], FIRST.starts[:5], FIRST.ends[:5], FIRST.diameters[:5])
    assert register_slice(ct_slice, part)
    for frames in ([FIRST, part], [part, FIRST]):
        results = register_frames(ct_slice, frames)
        whole, other = results if frames[0] is FIRST else results[::-1]
        assert_right(whole, FIRST, first)
        assert not other
        assert other.frame is part
        assert len(other.spots_px) == 6
    assert twins_at_odds(ct_slice, [FIRST, part, SECOND]) == twins_at_odds(ct_slice, [SECOND, part, FIRST])[::-1]


def test_each_is_looked_for_where_it_was_itself(scenes) -> None:
    """Chance brings less near a guess; that of the other frame is none."""
    ct_slice, first, second = scenes[3]
    told = register_frames(ct_slice, [FIRST, SECOND], previous=[first, second])
    swapped = register_frames(ct_slice, [FIRST, SECOND], previous=[second, first])
    for one, other, frame, pose in zip(told, swapped, (FIRST, SECOND), (first, second), strict=True):
        assert_right(one, frame, pose)
        assert_right(other, frame, pose)
        assert isinstance(one, Registration)
        assert isinstance(other, Registration)
        assert one.estimate.log10_false_alarms < other.estimate.log10_false_alarms - 3


@pytest.mark.parametrize("poses", [1, 3])
def test_poses_before_are_one_for_each_frame(scenes, poses: int) -> None:
    with pytest.raises(ValueError, match=f"previous has {poses} poses, expected one for each of 2 frames"):
        register_frames(scenes[0][0], [FIRST, SECOND], previous=[None] * poses)


def test_one_that_is_sought_again_is_looked_for_where_it_was_itself(scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    ct_slice, first, _ = scenes[1]
    sought = []

    def recorded(
        registrar: Registrar, spots: SliceSpots, options: RegistrationOptions, previous: Pose | None
    ) -> Registration | Refusal:
        sought.append((len(spots), previous))
        return register(registrar, spots, options, previous)

    register = Registrar.register
    monkeypatch.setattr(Registrar, "register", recorded)
    nearby = first.perturbed(np.array([0.5, 0.0, 0.0]), np.zeros(3))
    one, again = register_frames(ct_slice, [FIRST, FIRST], previous=[first, nearby])
    assert_right(one, FIRST, first)
    assert not again
    assert sought == [(12, first), (12, nearby), (6, nearby)]


# Of (sx, sy, shear).
SCALE_COVARIANCE = np.array([[4.0, 1.0, 0.6], [1.0, 9.0, -0.8], [0.6, -0.8, 2.0]]) * 1e-6


def test_one_that_is_sought_again_is_as_uncertain_as_what_is_left_to_it() -> None:
    """Two cubes of a kind, both last seen at the same place: the second takes what the first has left."""
    rng = np.random.default_rng(7)
    poses = [
        centred_pose(FIRST, SCANNER, (share, 0.45), rotation_exp(np.array([0.1, -0.1, turn])))
        for share, turn in ((0.3, 0.2), (0.7, 0.9))
    ]
    ct_slice = render_slice([PlacedFrame(FIRST, pose) for pose in poses], SCANNER, rng)
    options = RegistrationOptions(spot_noise_px=0.001)
    one, other = register_frames(ct_slice, [FIRST, FIRST], options, [poses[0]] * 2, SCALE_COVARIANCE)
    assert_right(one, FIRST, poses[0])
    assert_right(other, FIRST, poses[1])
    assert isinstance(one, Registration)
    assert isinstance(other, Registration)
    found = find_spots(ct_slice, options)
    left = np.setdiff1d(np.arange(len(found)), [match.spot for match in one.matches])
    expected = register_spots(
        found.centres_px[left],
        FIRST,
        ct_slice.scale,
        options,
        slice_area_mm2=512 * 512 * 0.25,
        previous=poses[0],
        covariances_px2=found.covariances_px2[left],
        scale_covariance=SCALE_COVARIANCE,
    )
    assert isinstance(expected, Registration)
    np.testing.assert_array_equal(other.covariances_px2, expected.covariances_px2)
    np.testing.assert_array_equal(other.covariance, expected.covariance)
    np.testing.assert_array_equal(other.scanner_from_frame.translation, expected.scanner_from_frame.translation)
