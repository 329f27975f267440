"""One rod more with another scale: found where the spacing is wrong, and not where a rod is missing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from stereoreg_ros import RegistrationOptions, load_frame
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.consensus import MISSING_COST, SHARED_SPOT_MM, count_missing
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.other_scale import _evidence, _with_one_more, with_other_scale
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.spots import Spots, whitening_of
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.simulation import ScannerSettings
from stereoreg_ros.simulation.mistakes import NO_ROD, NOISE_PX, Scene, Surroundings, true_scene, wrong_spacing
from stereoreg_ros.solvers.maximum_likelihood import refine

AROUND = Surroundings(ScannerSettings(shape=(640, 640)), 30.0)
PRIOR = Prior(np.eye(3), math.radians(30.0))
SURE = math.log(1000.0)
OPTIONS = RegistrationOptions()


def spots_of(scene: Scene) -> Spots:
    scale, rods_mm = scene.scale, scene.frame.tolerances_or(OPTIONS.frame_tolerance_mm)
    tolerances = Tolerances.of(scene.frame, rods_mm, scale, OPTIONS.scale_tolerance, None, 0.0)
    noise = np.tile(NOISE_PX**2 * scale.matrix @ scale.matrix.T, (len(scene.spots_px), 1, 1))
    return Spots.of(scale.to_mm(scene.spots_px), noise, scene.slice_area_mm2, tolerances)


def true_matches(scene: Scene) -> NDArray[np.intp]:
    spot_of_line = np.full(len(scene.frame), UNMATCHED)
    made = np.flatnonzero(scene.rods != NO_ROD)
    spot_of_line[scene.rods[made]] = made
    return spot_of_line


def explained(scene: Scene, spots: Spots, spot_of_line: NDArray[np.intp]) -> Hypothesis:
    """The pose, at the stated scale, that fits these matches best."""
    frame: Frame = scene.frame
    assert scene.truth is not None
    rotations, translations = scene.truth.rotation[None], scene.truth.translation[None]
    used = (spot_of_line != UNMATCHED)[None]
    for _ in range(3):
        cuts = cut(frame, rotations, translations)
        whitening = whitening_of(spots.match_covariances(frame, cuts, spot_of_line[None]))
        common = spots.common(frame, cuts, spot_of_line[None], used)
        refined = refine(frame, rotations, translations, spots.mm[spot_of_line][None], used, whitening, 100, common)
        rotations, translations = refined.rotations, refined.translations
    missing = int(count_missing(spots, frame, refined.cuts, spot_of_line[None])[0])
    chi_square = float(refined.chi_square[0])
    return Hypothesis(rotations[0], translations[0], spot_of_line, chi_square, refined.information[0], missing)


def off_mm(scene: Scene, one: Hypothesis) -> float:
    assert scene.truth is not None
    return float(np.linalg.norm(one.translation - scene.truth.translation))


@pytest.mark.parametrize("share", [0.03, -0.05, 0.08])
def test_a_wrong_spacing_is_found_with_its_size(share: float) -> None:
    """Eight of nine rods are matched, the pose millimetres off for it."""
    frame = load_frame("leksell_ct9")
    far = 0
    for seed in range(20):
        rng = np.random.default_rng([1, seed])
        scene = wrong_spacing(rng, frame, AROUND, share=share)
        spots, matches = spots_of(scene), true_matches(scene)
        matches[rng.integers(len(frame))] = UNMATCHED
        best = explained(scene, spots, matches)
        far += off_mm(scene, best) > 5.0
        other = with_other_scale(best, spots, frame, PRIOR)
        assert other is not None
        assert other.inliers == 9
        assert other.evidence > SURE
        wrong = [scene.scale.sx / AROUND.scanner.scale.sx - 1, scene.scale.sy / AROUND.scanner.scale.sy - 1]
        assert other.too_large == pytest.approx(wrong, abs=0.012)
    assert far >= 3, "else it need not be found"


@pytest.mark.parametrize(("share", "too_large"), [(0.12, 0.108), (0.2, 0.167), (-0.12, -0.135), (-0.14, -0.158)])
def test_more_than_fifteen_per_cent_is_believed_of_no_scale(share: float, too_large: float) -> None:
    """Either way; the pixels of this scene are too long, or too short, along y."""
    frame = load_frame("leksell_ct9")
    scene = wrong_spacing(np.random.default_rng([5, 0]), frame, AROUND, share=share)
    spots, matches = spots_of(scene), true_matches(scene)
    matches[4] = UNMATCHED
    other = with_other_scale(explained(scene, spots, matches), spots, frame, PRIOR)
    assert other is not None
    assert other.too_large == pytest.approx([0.0, too_large], abs=0.004)
    assert (other.evidence > SURE) is (abs(too_large) < 0.15)


@pytest.mark.parametrize(("beyond_mm", "is_found"), [(0.5, True), (2.5, False)])
def test_a_spot_beyond_a_rods_end_is_not_on_it(beyond_mm: float, is_found: bool) -> None:
    frame = load_frame("leksell_ct9")
    scene = wrong_spacing(np.random.default_rng([5, 0]), frame, AROUND, share=0.05)
    assert scene.truth is not None
    lambdas = cut(frame, scene.truth.rotation, scene.truth.translation).lambdas
    ends = frame.ends.copy()
    ends[4] = frame.points([4], lambdas[4] - np.array([beyond_mm]))[0]
    scene = replace(scene, frame=replace(frame, ends=ends))
    spots, matches = spots_of(scene), true_matches(scene)
    matches[4] = UNMATCHED
    other = with_other_scale(explained(scene, spots, matches), spots, scene.frame, PRIOR)
    assert (other is not None and other.evidence > SURE) is is_found


def test_what_no_scale_explains_is_none() -> None:
    """A spot 12 mm from the place of the rod that has none, where nothing else is wrong."""
    frame = load_frame("leksell_ct9")
    scene = true_scene(np.random.default_rng(6), frame, AROUND, most_false=0)
    spots, matches = spots_of(scene), true_matches(scene)
    points = spots.mm.copy()
    points[matches[4]] += [7.0, 10.0]
    moved = spots._replace(mm=points)
    matches[4] = UNMATCHED
    assert with_other_scale(explained(scene, moved, matches), moved, frame, PRIOR) is None


def test_where_rods_meet_the_one_may_have_taken_the_spot_of_the_other() -> None:
    frame = load_frame("leksell_ct9")
    found = 0
    for seed in range(200):
        scene = wrong_spacing(np.random.default_rng([2, seed]), frame, AROUND)
        spots, matches = spots_of(scene), true_matches(scene)
        assert scene.truth is not None
        points = cut(frame, scene.truth.rotation, scene.truth.translation).points_mm
        apart = np.linalg.norm(points[:, None] - points, axis=2) + 1e3 * np.eye(len(frame))
        rod, other_rod = (int(row) for row in np.unravel_index(apart.argmin(), apart.shape))
        if apart.min() > 6.0:
            continue
        matches[rod], matches[other_rod] = UNMATCHED, matches[rod]
        other = with_other_scale(explained(scene, spots, matches), spots, frame, PRIOR)
        found += other is not None and other.evidence > SURE
    assert found >= 3


@pytest.mark.parametrize("name", ["cube6", "cube8", "zframe"])
def test_a_missing_rod_and_false_spots_hardly_ever_look_so(name: str) -> None:
    frame = load_frame(name)
    believed = 0
    draw = partial(true_scene, missing=1, most_false=24)
    for seed in range(150):
        scene = draw(np.random.default_rng([3, seed]), frame, AROUND)
        spots = spots_of(scene)
        other = with_other_scale(explained(scene, spots, true_matches(scene)), spots, frame, PRIOR)
        believed += other is not None and other.evidence > SURE
    # Once in a thousand by the bound on it.
    assert believed <= 1


def test_evidence_is_the_likelihood_of_all_residuals_at_once_with_its_room_and_the_cost_of_missing_rods() -> None:
    """By the covariance of all residuals together, in which the errors of the scale are shared."""
    frame = load_frame("leksell_ct9")
    scene = true_scene(np.random.default_rng(7), frame, AROUND, most_false=3)
    spots, matches = spots_of(scene), true_matches(scene)
    spots = spots._replace(tolerances=spots.tolerances.with_scale_known_to(0.05))
    matches[4] = UNMATCHED
    best = explained(scene, spots, matches)
    assert best.missing == 1
    cuts = cut(frame, best.rotation[None], best.translation[None])
    used = np.flatnonzero(matches != UNMATCHED)
    own = spots.match_covariances(frame, cuts, matches[None])[0, used]
    together = np.zeros((2 * len(used), 2 * len(used)))
    for row, covariance in enumerate(own):
        together[2 * row : 2 * row + 2, 2 * row : 2 * row + 2] = covariance
    moved = spots.tolerances.common(frame, cuts, spots.mm[matches][None], (matches != UNMATCHED)[None])[0, used]
    moved = moved.reshape(2 * len(used), -1)
    together += moved @ moved.T
    expected = -len(used) * math.log(2 * math.pi * spots.clutter_density(frame))
    expected -= 0.5 * np.linalg.slogdet(together)[1] + 0.5 * np.linalg.slogdet(best.information)[1]
    expected -= best.chi_square / 2 + MISSING_COST
    found = _evidence(spots, frame, cuts, matches[None], np.array([best.chi_square]), best.information[None])
    assert found[0] == pytest.approx(expected, rel=1e-9)


def test_completions_give_each_rod_without_a_spot_one_left_over_or_that_of_a_rod_it_meets() -> None:
    """The pose has the fifth rod beside the first; the spot left over may be either's then."""
    frame = load_frame("leksell_ct9")
    scene = true_scene(np.random.default_rng(8), frame, AROUND, most_false=0)
    spots, matches = spots_of(scene), true_matches(scene)
    best = explained(scene, spots, matches)
    points = cut(frame, best.rotation, best.translation).points_mm
    moved = spots.mm.copy()
    moved[matches[0]] = points[4] + [SHARED_SPOT_MM - 0.1, 0.0]
    moved[matches[1]] = points[4] + [0.0, SHARED_SPOT_MM + 0.1]
    without = matches.copy()
    without[4] = UNMATCHED
    found = _with_one_more(replace(best, spot_of_line=without), spots._replace(mm=moved), frame)
    exchanged = matches.copy()
    exchanged[[0, 4]] = matches[[4, 0]]
    assert found.tolist() == [matches.tolist(), exchanged.tolist()]


def test_nothing_left_over_is_nothing_to_try() -> None:
    scene = true_scene(np.random.default_rng(4), load_frame("cube6"), AROUND, most_false=0)
    spots = spots_of(scene)
    assert with_other_scale(explained(scene, spots, true_matches(scene)), spots, scene.frame, PRIOR) is None


def test_only_within_the_orientation_that_is_configured() -> None:
    frame = load_frame("leksell_ct9")
    scene = wrong_spacing(np.random.default_rng([1, 0]), frame, AROUND)
    spots, matches = spots_of(scene), true_matches(scene)
    matches[4] = UNMATCHED
    best = explained(scene, spots, matches)
    assert with_other_scale(best, spots, frame, PRIOR) is not None
    assert with_other_scale(best, spots, frame, Prior(np.eye(3), math.radians(0.1))) is None
