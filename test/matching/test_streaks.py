"""Lengths of spots, and covariances of their own, in matching."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereoreg_ros import PixelScale, RegistrationOptions, load_frame, register_slice, register_spots
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.spots import Streaks
from stereoreg_ros.simulation import PlacedFrame, ScannerSettings, SpotSetSettings, random_pose, render_slice
from stereoreg_ros.simulation.spot_sets import random_spot_set

SCALE = PixelScale(0.5, 0.5)


def leaning(degrees: float) -> Pose:
    """slice_from_frame in which the first rod of the Leksell box, upright, leans along x and is cut in its middle."""
    return cut_at(0.5, degrees)


def cut_at(share: float, degrees: float) -> Pose:
    """The same, cut at a share of that rod's length."""
    frame = load_frame("leksell_ct")
    rotation = rotation_exp(np.array([0.0, math.radians(degrees), 0.0]))
    return Pose(rotation, -(rotation @ (frame.starts[0] + share * (frame.ends[0] - frame.starts[0]))))


@pytest.mark.parametrize(
    ("along_mm", "cut_short", "allowed"),
    [
        ((5.0, 0.0), False, True),
        ((-5.0, 0.3), False, True),
        ((4.0, 1.0), False, True),
        ((0.0, 5.0), False, False),  # across
        ((0.5, 0.0), False, False),  # round
        ((0.5, 0.0), True, True),  # round as far as the threshold shows it
        ((12.0, 0.0), False, False),
        ((12.0, 0.0), True, False),
    ],
)
def test_a_leaning_rod_in_a_thick_slice_leaves_a_streak(
    along_mm: tuple[float, float], cut_short: bool, allowed: bool
) -> None:
    frame, pose = load_frame("leksell_ct"), leaning(45.0)
    cuts = cut(frame, pose.rotation[None], pose.translation[None])
    streaks = Streaks(np.array([along_mm]), np.array([cut_short]), 5.0)
    assert bool(streaks.allow(frame, cuts)[0, 0, 0]) == allowed


def test_an_upright_rod_leaves_none() -> None:
    frame, pose = load_frame("leksell_ct"), leaning(2.0)
    cuts = cut(frame, pose.rotation[None], pose.translation[None])
    streaks = Streaks(np.array([[0.4, 0.2], [6.0, 0.0]]), np.zeros(2, dtype=bool), 5.0)
    assert streaks.allow(frame, cuts)[0, 0].tolist() == [True, False]


def allowed_lengths(frame: Frame, pose: Pose, thickness_mm: float) -> list[float]:
    """Of streaks along x, the shortest and the longest that the first rod may leave, mm."""
    lengths = np.arange(0.0, 30.0, 0.05)
    along = np.column_stack([lengths, np.zeros(len(lengths))])
    streaks = Streaks(along, np.zeros(len(lengths), dtype=bool), thickness_mm)
    allowed = lengths[streaks.allow(frame, cut(frame, pose.rotation[None], pose.translation[None]))[0, 0]]
    return [float(allowed.min()), float(allowed.max())]


def thick(diameter_mm: float) -> Frame:
    frame = load_frame("leksell_ct")
    return replace(frame, diameters=np.full(len(frame), diameter_mm))


def test_a_thick_rod_leaves_a_longer_streak_and_never_has_to() -> None:
    """A tube of 7.5 mm at 45 degrees was seen 6.9 mm long in a slice of 2.4 mm."""
    pose = leaning(45.0)
    thin, tube = allowed_lengths(thick(0.5), pose, 2.4), allowed_lengths(thick(7.5), pose, 2.4)
    assert tube[0] == thin[0]
    assert thin[1] < 6.9 < tube[1]
    # Root of twelve times the difference of the second moments, of the slab's thickness and of a bright wall's ellipse.
    wall = math.hypot(2.4, math.sqrt(12 * 7.5**2 / 8))
    assert 1.4 * wall < tube[1] < 2.2 * wall


@pytest.mark.parametrize(("share", "is_whole"), [(0.5, True), (0.02, False), (0.98, False)])
def test_a_rod_that_ends_within_the_slice_may_leave_a_shorter_streak(share: float, is_whole: bool) -> None:
    shortest, longest = allowed_lengths(thick(1.0), cut_at(share, 45.0), 8.0)
    assert (shortest > 2.0) == is_whole
    assert longest == pytest.approx(allowed_lengths(thick(1.0), leaning(45.0), 8.0)[1])


@pytest.mark.parametrize(("from_end_mm", "is_whole"), [(5.6, False), (5.7, True)])
@pytest.mark.parametrize("is_lower", [True, False])
def test_a_rod_ends_within_the_slice_up_to_half_its_thickness_along_the_rod(
    from_end_mm: float, is_whole: bool, is_lower: bool
) -> None:
    """Of 8 mm at 45 degrees these are 5.657 mm."""
    frame = load_frame("leksell_ct")
    share = from_end_mm / float(np.linalg.norm(frame.ends[0] - frame.starts[0]))
    shortest, _ = allowed_lengths(thick(1.0), cut_at(share if is_lower else 1 - share, 45.0), 8.0)
    assert (shortest > 2.0) == is_whole


@pytest.mark.parametrize("threshold", [2000.0, "auto"])
@pytest.mark.parametrize("thickness_mm", [1.0, 3.0, 5.0])
def test_no_rod_is_lost_where_the_thickness_is_known(thickness_mm: float, threshold: float | str) -> None:
    frame = load_frame("cube6")
    scanner = ScannerSettings(slice_thickness_mm=thickness_mm, false_spots=4, shape=(320, 320))
    options = RegistrationOptions(threshold=threshold)
    rng = np.random.default_rng(9)
    for _ in range(6):
        placed = PlacedFrame(frame, random_pose(rng, frame, scanner))
        ct_slice = render_slice([placed], scanner, rng)
        without = register_slice(ct_slice, frame, options)
        told = register_slice(ct_slice, frame, replace(options, slice_thickness_mm=thickness_mm))
        assert bool(told) == bool(without)
        if told and without:
            assert told.estimate.inliers == without.estimate.inliers


def test_a_wrong_thickness_is_refused_not_absorbed() -> None:
    """Told 20 mm, every rod would have to leave a long streak."""
    frame, scanner = load_frame("cube6"), ScannerSettings(shape=(320, 320))
    rng = np.random.default_rng(10)
    ct_slice = render_slice([PlacedFrame(frame, random_pose(rng, frame, scanner))], scanner, rng)
    assert register_slice(ct_slice, frame, RegistrationOptions(threshold="auto"))
    refused = register_slice(ct_slice, frame, RegistrationOptions(threshold="auto", slice_thickness_mm=20.0))
    assert not refused
    assert refused.reason == "no_consensus"


def noisy(rng: np.random.Generator, count: int) -> Array:
    """Covariances (count, 2, 2) pixel^2 of streaks in all directions."""
    turns, long = rng.uniform(0, math.pi, count), rng.uniform(0.1, 0.7, count)
    axes = np.stack([np.stack([np.cos(turns), np.sin(turns)], -1), np.stack([-np.sin(turns), np.cos(turns)], -1)], -1)
    return np.asarray((axes * np.stack([long**2, np.full(count, 0.05**2)], -1)[:, None]) @ np.swapaxes(axes, 1, 2))


def test_the_pose_is_as_sure_as_its_spots_are() -> None:
    """Squared errors in terms of the covariance stated, for spots that are each known otherwise."""
    frame = load_frame("cube6")
    rng = np.random.default_rng(11)
    nees = []
    trials = 75
    for _ in range(trials):
        truth = random_spot_set(rng, frame, SpotSetSettings(ScannerSettings(), 6, 0, 0.0))
        covariances = noisy(rng, 6)
        spots = truth.spots_px + np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=(6, 2)))
        options = RegistrationOptions(
            spot_noise_px=0.001,
            frame_tolerance_mm=0.0,
            scale_tolerance=0.0,
            max_log10_false_alarms=0.0,
            max_target_error_mm=1000.0,
        )
        result = register_spots(spots, frame, SCALE, options, covariances_px2=covariances)
        if not result:
            continue
        error = np.append(
            result.scanner_from_frame.translation - truth.slice_from_frame.translation,
            small_turn(result.scanner_from_frame.rotation @ truth.slice_from_frame.rotation.T),
        )
        nees.append(error @ np.linalg.solve(result.covariance, error))
    assert len(nees) >= 0.9 * trials
    assert np.mean(nees) == pytest.approx(6.0, abs=4 * math.sqrt(12 / len(nees)))


def small_turn(rotation: Array) -> Array:
    """Rotation vector (3,) of a small rotation."""
    odd = rotation - rotation.T
    return np.array([odd[2, 1], odd[0, 2], odd[1, 0]]) / 2


def test_a_spot_is_never_better_known_than_the_option_says() -> None:
    frame = load_frame("cube6")
    spots = random_spot_set(np.random.default_rng(12), frame, SpotSetSettings(ScannerSettings(), 6, 3, 0.3)).spots_px
    perfect = RegistrationOptions(frame_tolerance_mm=0.0, scale_tolerance=0.0)
    better, worse_px2 = (np.tile(std**2 * np.eye(2), (len(spots), 1, 1)) for std in (0.01, 0.6))
    plain = register_spots(spots, frame, SCALE, perfect)
    told = register_spots(spots, frame, SCALE, perfect, covariances_px2=better)
    assert plain
    assert told
    np.testing.assert_allclose(told.covariance, plain.covariance, rtol=1e-9)
    worse = register_spots(spots, frame, SCALE, perfect, covariances_px2=worse_px2)
    assert not worse or worse.estimate.position_std_mm == pytest.approx(2 * plain.estimate.position_std_mm, rel=0.01)


@pytest.mark.parametrize(
    ("covariances", "message"),
    [
        (np.zeros((5, 2, 2)), r"covariances_px2 has shape \(5, 2, 2\), expected \(6, 2, 2\)"),
        (np.full((6, 2, 2), np.nan), "covariances_px2 must be finite and symmetric"),
        (np.tile([[1.0, 0.5], [0.0, 1.0]], (6, 1, 1)), "covariances_px2 must be finite and symmetric"),
        (np.tile([[1.0, 2.0], [2.0, 1.0]], (6, 1, 1)), "negative variance"),
    ],
)
def test_wrong_covariances_are_exceptions(covariances: Array, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        register_spots(
            np.random.default_rng(0).uniform(0, 100, (6, 2)), load_frame("cube6"), SCALE, covariances_px2=covariances
        )
