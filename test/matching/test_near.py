"""A guess of the pose: it helps where it is right, and costs no safety where it is wrong."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereoreg_ros import Pose, RegistrationOptions, load_frame, register_spots
from stereoreg_ros.geometry.pose import rotation_angle, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.matching import near
from stereoreg_ros.matching.by_levels import ByLevels
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found, Hypothesis
from stereoreg_ros.matching.level_search import LevelSearch, SearchGivenUpError
from stereoreg_ros.matching.near import match_near
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.settling import settle
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.simulation import ScannerSettings, SpotSetSettings, random_pose, random_spot_set

SCANNER = ScannerSettings()
SCALE = SCANNER.scale
# Of a frame as its file has it, in slices as large as they say.
PERFECT = RegistrationOptions(frame_tolerance_mm=0.0, scale_tolerance=0.0)
CUBE = load_frame("cube6")


def moved(rng: np.random.Generator, pose: Pose, mm: float, degrees: float) -> Pose:
    """The pose, as much as that away in a random direction."""
    step, axis = rng.normal(size=(2, 3))
    return pose.perturbed(mm * step / np.linalg.norm(step), np.radians(degrees) * axis / np.linalg.norm(axis))


def is_wrong(found: Pose, truth: Pose) -> bool:
    turn = np.degrees(rotation_angle(found.rotation @ truth.rotation.T))
    return bool(np.linalg.norm(found.translation - truth.translation) > 2.0 or turn > 3.0)


@pytest.mark.parametrize(("mm", "degrees"), [(0.5, 0.3), (4.0, 2.0)])
def test_five_rods_among_thirty_spots_are_sure_near_the_pose_before(mm: float, degrees: float) -> None:
    rng = np.random.default_rng(1)
    settings = SpotSetSettings(SCANNER, visible_rods=5, false_spots=25, noise_px=0.5)
    options = replace(PERFECT, spot_noise_px=settings.noise_std_px)
    near, alone = 0, 0
    for _ in range(30):
        problem = random_spot_set(rng, CUBE, settings)
        guess = moved(rng, problem.slice_from_frame, mm, degrees)
        result = register_spots(problem.spots_px, CUBE, SCALE, options, previous=guess)
        near += bool(result)
        if result:
            assert not is_wrong(result.scanner_from_frame, problem.slice_from_frame)
        alone += bool(register_spots(problem.spots_px, CUBE, SCALE, options))
    assert near == 30
    assert alone < 15


def test_the_guess_is_of_the_frame_in_the_scanner_whatever_the_slices_plane() -> None:
    """As sure, and as near, as where the scanner is the slice."""
    plane = Pose(rotation_exp(np.array([0.6, -0.4, 1.0])), np.array([30.0, -200.0, 500.0]))
    rng = np.random.default_rng(9)
    problem = random_spot_set(rng, CUBE, SpotSetSettings(SCANNER, visible_rods=6, false_spots=8, noise_px=0.3))
    guess = moved(rng, problem.slice_from_frame, 2.0, 1.0)
    flat = register_spots(problem.spots_px, CUBE, SCALE, PERFECT, previous=guess)
    oblique = register_spots(problem.spots_px, CUBE, SCALE, PERFECT, plane, previous=plane @ guess)
    without = register_spots(problem.spots_px, CUBE, SCALE, PERFECT, plane)
    assert flat
    assert oblique
    assert without
    assert oblique.estimate.log10_false_alarms == pytest.approx(flat.estimate.log10_false_alarms, abs=1e-6)
    assert oblique.estimate.log10_false_alarms < without.estimate.log10_false_alarms - 3
    expected = plane @ flat.scanner_from_frame
    np.testing.assert_allclose(oblique.scanner_from_frame.translation, expected.translation, atol=1e-6)


def test_says_the_same_as_without_a_guess() -> None:
    rng = np.random.default_rng(2)
    settings = SpotSetSettings(SCANNER, visible_rods=6, false_spots=12, noise_px=0.3)
    for _ in range(20):
        problem = random_spot_set(rng, CUBE, settings)
        alone = register_spots(problem.spots_px, CUBE, SCALE)
        guided = register_spots(problem.spots_px, CUBE, SCALE, previous=moved(rng, problem.slice_from_frame, 3.0, 2.0))
        assert alone
        assert guided
        assert [match.spot for match in alone.matches] == [match.spot for match in guided.matches]
        np.testing.assert_allclose(
            guided.scanner_from_frame.translation, alone.scanner_from_frame.translation, atol=1e-4
        )
        # Far fewer poses could have been meant.
        assert guided.estimate.log10_false_alarms < alone.estimate.log10_false_alarms - 2


@pytest.mark.parametrize("is_right", [True, False])
def test_of_the_false_alarms_that_are_allowed_each_of_two_searches_gets_half(is_right: bool) -> None:
    """A guess, right or wrong, must not have chance bring twice as much as was allowed."""
    rng = np.random.default_rng(10)
    truth = random_pose(rng, CUBE, SCANNER)
    spots = np.concatenate([project(CUBE, truth, SCALE)[0], rng.uniform(50, 450, (4, 2))])
    spots[:6] += rng.normal(0, 0.3, (6, 2))
    guess = moved(rng, truth, 2.0, 1.0) if is_right else moved(rng, truth, 100.0, 90.0)
    result = register_spots(spots, CUBE, SCALE, previous=guess)
    assert result
    alone = register_spots(spots, CUBE, SCALE)
    assert alone
    brought = result.estimate.log10_false_alarms
    assert (brought < alone.estimate.log10_false_alarms - 2) is is_right

    def is_accepted(allowed: float, previous: Pose | None) -> bool:
        options = RegistrationOptions(max_log10_false_alarms=allowed)
        found = register_spots(spots, CUBE, SCALE, options, previous=previous)
        assert found or found.reason == "no_consensus"
        return bool(found)

    half = math.log10(2)
    assert not is_accepted(brought + half - 0.01, guess)
    assert is_accepted(brought + half + 0.01, guess)
    # One search alone has them all.
    assert not is_accepted(alone.estimate.log10_false_alarms - 0.01, None)
    assert is_accepted(alone.estimate.log10_false_alarms + 0.01, None)


def test_a_wrong_guess_does_no_harm() -> None:
    rng = np.random.default_rng(3)
    settings = SpotSetSettings(SCANNER, visible_rods=6, false_spots=12, noise_px=0.3)
    for mm, degrees in ((30.0, 0.0), (0.0, 20.0), (200.0, 170.0)):
        for _ in range(10):
            problem = random_spot_set(rng, CUBE, settings)
            guess = moved(rng, problem.slice_from_frame, mm, degrees)
            result = register_spots(problem.spots_px, CUBE, SCALE, previous=guess)
            assert result
            assert not is_wrong(result.scanner_from_frame, problem.slice_from_frame)


def test_clutter_is_not_taken_for_the_frame_that_was_there() -> None:
    rng = np.random.default_rng(4)
    for _ in range(60):
        guess = random_pose(rng, CUBE, SCANNER)
        spots = rng.uniform(0, 512, (rng.integers(5, 40), 2))
        assert not register_spots(spots, CUBE, SCALE, previous=guess)


@pytest.mark.parametrize("name", ["zframe", "leksell_ct"])
def test_twins_are_found_far_from_the_guess(name: str) -> None:
    frame = load_frame(name)
    scanner = ScannerSettings(shape=(640, 640))
    rng = np.random.default_rng(5)
    for _ in range(6):
        truth = random_pose(rng, frame, scanner, max_tilt_deg=4.0, max_offset_mm=10.0, max_depth_mm=15.0)
        spots, _ = project(frame, truth, SCALE)
        result = register_spots(spots + rng.normal(0, 0.2, spots.shape), frame, SCALE, previous=truth)
        assert not result
        assert result.reason == "ambiguous"


def test_the_orientation_that_is_allowed_holds_near_a_guess_too() -> None:
    rng = np.random.default_rng(6)
    truth = random_pose(rng, CUBE, SCANNER)
    spots, _ = project(CUBE, truth, SCALE)
    elsewhere = Pose(rotation_exp(np.array([0.0, 0.0, 2.0])) @ truth.rotation, np.zeros(3)).quaternion_xyzw
    options = RegistrationOptions(nominal_orientation=tuple(elsewhere), max_rotation_deg=30.0)
    assert register_spots(spots, CUBE, SCALE, previous=truth)
    assert not register_spots(spots, CUBE, SCALE, options, previous=truth)


@pytest.mark.parametrize(("degrees", "is_near"), [(4.5, True), (5.5, False)])
def test_near_is_within_five_degrees(degrees: float, is_near: bool) -> None:
    """What is found from a guess that is farther off is as unlikely by chance as what is found without."""
    rng = np.random.default_rng(11)
    truth = random_pose(rng, CUBE, SCANNER)
    spots, _ = project(CUBE, truth, SCALE)
    turned = truth.perturbed(np.zeros(3), math.radians(degrees) * np.array([0.6, 0.8, 0.0]))
    # Turned about the frame's middle, so that its rods are still near.
    middle = (CUBE.starts.mean(axis=0) + CUBE.ends.mean(axis=0)) / 2
    guess = Pose(turned.rotation, turned.translation + truth @ middle - turned @ middle)
    options = RegistrationOptions(max_rotation_deg=170.0)
    result, alone = (register_spots(spots, CUBE, SCALE, options, previous=one) for one in (guess, None))
    assert result
    assert alone
    assert result.options is options
    assert (result.estimate.log10_false_alarms < alone.estimate.log10_false_alarms - 2) is is_near


def test_other_matches_of_the_pose_widen_it_near_a_guess_too(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(12)
    truth = random_pose(rng, CUBE, SCANNER)
    spots = project(CUBE, truth, SCALE)[0] + rng.normal(0, 0.2, (6, 2))
    plain = register_spots(spots, CUBE, SCALE, PERFECT, previous=truth)

    def widening(*given: Any, **named: Any) -> Found:
        (one,) = match(*given, **named).hypotheses
        return Found([replace(one, information=one.information / 4, is_widened=True)], 6)

    match = ByLevels.match_anywhere
    monkeypatch.setattr(ByLevels, "match_anywhere", widening)
    wide = register_spots(spots, CUBE, SCALE, PERFECT, previous=truth)
    assert plain
    assert wide
    np.testing.assert_allclose(wide.covariance, 4 * plain.covariance, rtol=1e-9)


def test_what_chance_may_bring_near_a_guess_is_left_to_the_search_without() -> None:
    truth = random_pose(np.random.default_rng(14), CUBE, SCANNER)
    mm = SCALE.to_mm(project(CUBE, truth, SCALE)[0])
    spots = Spots.of(mm, np.tile(0.15**2 * np.eye(2), (len(mm), 1, 1)), 256.0**2, Tolerances.none(CUBE))
    problem = Problem(spots, CUBE, Prior(np.eye(3), np.pi), 4, -6.0, truth)
    found = match_near(problem, ByLevels(CUBE))
    assert found is not None
    (best,) = found.hypotheses
    for allowed, is_found in ((best.log10_false_alarms + 0.1, True), (best.log10_false_alarms - 0.1, False)):
        stricter = replace(problem, max_log10_false_alarms=allowed)
        assert (match_near(stricter, ByLevels(CUBE)) is not None) is is_found


def test_where_the_nearest_spots_leave_a_rod_out_that_must_show_others_are_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth = random_pose(np.random.default_rng(14), CUBE, SCANNER)
    mm = SCALE.to_mm(project(CUBE, truth, SCALE)[0])
    spots = Spots.of(mm, np.tile(0.15**2 * np.eye(2), (len(mm), 1, 1)), 256.0**2, Tolerances.none(CUBE))
    problem = Problem(spots, CUBE, Prior(np.eye(3), np.pi), 4, -6.0, truth)

    def lacking(*given) -> list[Hypothesis]:
        (one,) = settle(*given)
        spot_of_line = one.spot_of_line.copy()
        spot_of_line[2] = UNMATCHED
        return [replace(one, spot_of_line=spot_of_line, missing=1)]

    monkeypatch.setattr(near, "settle", lacking)
    found = match_near(problem, ByLevels(CUBE))
    assert found is not None
    assert [(one.inliers, one.missing) for one in found.hypotheses] == [(6, 0)]


def test_where_twins_are_sought_in_vain_for_long_there_is_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    def endless(*_: object, **__: object) -> None:
        raise SearchGivenUpError

    truth = random_pose(np.random.default_rng(13), CUBE, SCANNER)
    spots, _ = project(CUBE, truth, SCALE)
    assert register_spots(spots, CUBE, SCALE, previous=truth)
    monkeypatch.setattr(LevelSearch, "twins_of", endless)
    result = register_spots(spots, CUBE, SCALE, previous=truth)
    assert not result
    assert "given up" in result.message


def test_guesses_that_make_no_sense() -> None:
    rng = np.random.default_rng(7)
    truth = random_pose(rng, CUBE, SCANNER)
    spots, _ = project(CUBE, truth, SCALE)
    flat = rotation_exp(np.array([np.pi / 2, 0.0, 0.0]))  # rods within the slice, or nearly
    for guess in (Pose(flat, truth.translation), Pose(flat, np.full(3, 1e6)), Pose.identity()):
        result = register_spots(spots, CUBE, SCALE, previous=guess)
        assert result
        assert not is_wrong(result.scanner_from_frame, truth)
    assert not register_spots(np.full((8, 2), 100.0), CUBE, SCALE, previous=truth)


def test_the_guess_is_in_the_scanner() -> None:
    rng = np.random.default_rng(8)
    truth = random_pose(rng, CUBE, SCANNER)
    spots, _ = project(CUBE, truth, SCALE)
    scanner_from_slice = Pose(rotation_exp(np.array([0.2, 0.5, -1.0])), np.array([10.0, -300.0, 55.0]))
    expected = scanner_from_slice @ truth
    near = register_spots(spots, CUBE, SCALE, None, scanner_from_slice, previous=expected)
    far = register_spots(spots, CUBE, SCALE, None, scanner_from_slice, previous=truth)
    assert near
    assert far
    assert near.estimate.log10_false_alarms < far.estimate.log10_false_alarms - 2
    np.testing.assert_allclose(near.scanner_from_frame.translation, expected.translation, atol=1e-5)


def test_twins_of_what_is_known_are_sought_even_where_chance_is_not_ruled_out() -> None:
    """A pose that is sure near a guess may not be sure by its spots alone; its twins must be found all the same."""
    frame = load_frame("zframe")
    truth = random_pose(np.random.default_rng(9), frame, SCANNER, max_tilt_deg=4.0, max_offset_mm=10.0)
    spots_px, _ = project(frame, truth, SCALE)
    mm = SCALE.to_mm(spots_px)
    spots = Spots.of(mm, np.tile(0.15**2 * np.eye(2), (len(mm), 1, 1)), 256.0**2, Tolerances.none(frame))
    prior = Prior(np.eye(3), np.pi)
    problem, matcher = Problem(spots, frame, prior, 4, -6.0), ByLevels(frame)
    every = matcher.match(problem).hypotheses
    assert len(every) == 2
    strict = replace(problem, max_log10_false_alarms=-300.0)
    again = matcher.match_anywhere(strict, known=every[:1]).hypotheses
    # So strict a caller is told of more: of those of all rods, the twin must be one.
    assert sum(one.inliers == 7 for one in again) == 2
