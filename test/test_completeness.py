"""The search against another one that goes through all positions along three rods: what that finds, ours must find."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest

from stereoreg_ros import RegistrationOptions, load_frame
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import nearest_rotation, rotation_angle
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.matching import three_line
from stereoreg_ros.matching.consensus import distinct, judged, score
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.seed_search import Starts
from stereoreg_ros.matching.settling import settle
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.simulation import ScannerSettings, SpotSetSettings, random_spot_set

SCANNER = ScannerSettings(shape=(640, 640))
PROBLEMS = 10
STEPS = 30
MOST_STARTS = 6000


def spots_of(settings: SpotSetSettings, spots_px: np.ndarray) -> Spots:
    scale, noise_px = settings.scanner.scale, settings.noise_std_px
    covariance = noise_px**2 * scale.matrix @ scale.matrix.T
    return Spots.of(scale.to_mm(spots_px), np.tile(covariance, (len(spots_px), 1, 1)), None)


def all_positions(rng: np.random.Generator, spots: Spots, frame: Frame, lines: tuple[int, ...]) -> list[Hypothesis]:
    """Explanations from every place of a grid over three rods whose distances three spots may have."""
    rows = list(lines)
    axes = [np.linspace(frame.lambda_min[row], frame.lambda_max[row], STEPS) for row in rows]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = frame.origins[rows] + grid[..., None] * frame.directions[rows]
    corners = ((0, 1), (0, 2), (1, 2))
    distances = np.stack([np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in corners], axis=1)
    near_mm = max(axis[1] - axis[0] for axis in axes)
    starts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for triple in permutations(range(len(spots.mm)), 3):
        flat = np.zeros((3, 3))
        flat[:, :2] = spots.mm[list(triple)]
        wanted = np.array([np.linalg.norm(flat[a] - flat[b]) for a, b in corners])
        chosen = np.flatnonzero((np.abs(distances - wanted) < near_mm).all(axis=1))
        if not chosen.size:
            continue
        moved, middle = points[chosen], flat.mean(axis=0)
        # The rotation that lays three points on three spots best, by the singular values of their products.
        covariance = np.swapaxes(moved - moved.mean(axis=1, keepdims=True), 1, 2) @ (flat - middle)
        rotations = nearest_rotation(np.swapaxes(covariance, 1, 2))
        translations = middle - (rotations @ moved.mean(axis=1)[..., None])[..., 0]
        matched = np.full(len(frame), UNMATCHED)
        matched[rows] = triple
        starts += [(rotation, offset, matched) for rotation, offset in zip(rotations, translations, strict=True)]
    if len(starts) > MOST_STARTS:
        starts = [starts[row] for row in rng.choice(len(starts), MOST_STARTS, replace=False)]
    rotations, translations, matches = (np.array(part) for part in zip(*starts, strict=True))
    found = settle(spots, frame, Starts(rotations, translations, matches, np.arange(len(starts))), 4)
    return distinct(found, spots.gains(frame))


def is_same(a: Hypothesis, b: Hypothesis) -> bool:
    turn = float(rotation_angle(a.rotation @ b.rotation.T))
    return bool(np.linalg.norm(a.translation - b.translation) < 1.0 and turn < math.radians(2.0))


@pytest.mark.parametrize(
    ("name", "visible", "false_spots"), [("cube6", 6, 2), ("cube6", 5, 2), ("zframe", 7, 1), ("leksell_ct", 6, 1)]
)
def test_nothing_that_a_search_of_all_positions_finds_is_missed(name: str, visible: int, false_spots: int) -> None:
    frame = load_frame(name)
    settings = SpotSetSettings(SCANNER, visible, false_spots, 0.3)
    # Chance is no matter here: few spots leave none of these explanations beyond doubt.
    options = RegistrationOptions(spot_noise_px=settings.noise_std_px, max_log10_false_alarms=0.0)
    prior = Prior(np.eye(3), math.pi)
    rng = np.random.default_rng(8)
    compared, rivals = 0, 0
    for _ in range(PROBLEMS):
        problem = random_spot_set(rng, frame, settings)
        spots = spots_of(settings, problem.spots_px)
        gains = spots.gains(frame)
        ours = three_line.match(spots, frame, prior, options).hypotheses
        # Any three rods with a spot will do: a search of all positions along these finds every explanation with them.
        predicted, _ = project(frame, problem.slice_from_frame, SCANNER.scale)
        offset = np.linalg.norm(predicted[:, None] - problem.spots_px, axis=-1).min(axis=1)
        seen = np.flatnonzero(offset < 1.0)
        lines = tuple(rng.permutation(seen)[:3].tolist())
        others = all_positions(rng, spots, frame, lines)
        compared += bool(others)
        if others:
            assert ours, "found nothing"
            assert score(ours[0], gains) > score(others[0], gains) - 1e-6
            # One that the best one does not rule out has to be listed with it.
            for other in judged(others, spots, frame, prior, 0.99):
                rivals += 1
                assert any(is_same(one, other) for one in ours)
    assert compared >= PROBLEMS - 1
    assert rivals >= PROBLEMS - 1
