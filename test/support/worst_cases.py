"""Worst cases of the pose against true errors: within the box, at its corners, and at those that the bounds name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose, nearest_rotation
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.simulation import ScannerSettings, random_pose
from stereoreg_ros.solvers.maximum_likelihood import refine
from stereoreg_ros.solvers.pose_error_bounds import PoseErrorModel

_TARGET_MM = np.array([0.0, 0.0, 100.0])
_PER_SCENE = 1000


@dataclass(frozen=True)
class WorstCaseCount:
    """What came of many errors of spots.

    scenes: poses; unproven: of these, without bounds; trials: errors of spots tried; exceeded: of these, how many
    carried a component of the pose or the target beyond its bound; nearest: largest share of a bound that was reached;
    reached (scenes,): least share of the seven bounds that the corner named for each reaches, in each scene.
    """

    scenes: int
    unproven: int
    trials: int
    exceeded: int
    nearest: float
    reached: Array


def count_worst_cases(frame: Frame, max_error_px: float, trials: int, seed: int) -> WorstCaseCount:
    """Try `trials` errors of the spots at random poses, a thousand at each; half of them at corners of the box."""
    rng, scanner, n = np.random.default_rng(seed), ScannerSettings(), len(frame)
    unproven = exceeded = tried = scenes = 0
    nearest, reached = 0.0, []
    with tqdm(total=trials, desc=frame.name, unit="trial", disable=None, leave=False) as bar:
        while tried < trials and scenes < 10 * max(trials // _PER_SCENE, 1):
            scenes += 1
            truth = random_pose(rng, frame, scanner)
            spots = project(frame, truth, scanner.scale)[0] + rng.uniform(-max_error_px, max_error_px, (n, 2))
            pose = _solved_again(frame, truth, spots, scanner.scale)
            model = PoseErrorModel(frame, np.arange(n), pose, spots, np.tile(np.eye(2), (n, 1, 1)), scanner.scale)
            reach = model.reach(max_error_px)
            if reach is None:
                unproven += 1
                continue
            functionals = [*np.eye(6), model.displacement(_TARGET_MM)]
            named = np.array([model.worst_corner(one, max_error_px) for one in functionals])
            drawn = rng.uniform(-1, 1, (_PER_SCENE - 2 * len(named), 2 * n))
            drawn[::2] = np.where(drawn[::2] < 0, -1.0, 1.0)
            own = (project(frame, truth, scanner.scale)[0] - spots).T.reshape(1, -1)
            errors = _errors(
                frame, pose, spots, scanner.scale, np.concatenate([named, -named, max_error_px * drawn, own])
            )
            bounds = np.append([reach.bound(row) for row in np.eye(6)], reach.point_mm(_TARGET_MM))
            shares = errors / bounds
            exceeded += int((shares > 1).any(axis=1).sum())
            nearest = max(nearest, float(shares.max()))
            reached.append(float(np.diag(shares[: len(named)]).min()))
            tried += len(errors)
            bar.update(len(errors))
    return WorstCaseCount(scenes, unproven, tried, exceeded, nearest, np.array(reached))


def _errors(frame: Frame, pose: Pose, spots: Array, scale: PixelScale, errors_px: Array) -> Array:
    """Sizes (m, 7) of the components of the pose's error, mm and rad, and of the target's, mm, for errors (m, 2n)."""
    n = len(frame)
    rotations, translations = _solved(
        frame, pose, spots + np.stack([errors_px[:, :n], errors_px[:, n:]], axis=-1), scale
    )
    turns = Rotation.from_matrix(rotations @ pose.rotation.T).as_rotvec()
    target = np.linalg.norm(rotations @ _TARGET_MM + translations - pose @ _TARGET_MM, axis=1)
    return np.column_stack([np.abs(translations - pose.translation), np.abs(turns), target])


def _solved(frame: Frame, start: Pose, spots_px: Array, scale: PixelScale) -> tuple[Array, Array]:
    m = len(spots_px)
    rotations, translations = np.tile(start.rotation, (m, 1, 1)), np.tile(start.translation, (m, 1))
    used = np.ones((m, len(frame)), dtype=bool)
    found = refine(frame, rotations, translations, scale.to_mm(spots_px), used, scale.inverse_matrix, 200)
    return found.rotations, found.translations


def _solved_again(frame: Frame, start: Pose, spots_px: Array, scale: PixelScale) -> Pose:
    """The pose at rest: a step more often than the solver needs it."""
    for _ in range(3):
        rotations, translations = _solved(frame, start, spots_px[None], scale)
        start = Pose(nearest_rotation(rotations[0]), translations[0])
    return start
