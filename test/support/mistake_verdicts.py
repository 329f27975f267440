"""What came of scenes with mistakes: right, weak, wrong or refused; `benchmarks.mistakes` says what each means.

Of a wrong pose, also whether anything in the slice speaks against it.
"""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from stereoreg_ros import Pose, Refusal, Registration
from stereoreg_ros.geometry.pose import Array, rotation_angle
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.simulation.mistakes import (
    NO_ROD,
    Scene,
)
from support.mistake_scenes import CASES, KINDS, options_of, read_cases, register, scene_of
from support.pose_verdict import STATED, is_wrong

ALLOWED_SHARE = 1e-3
# Probability of residuals as large by noise and tolerance alone, below which the slice speaks against a pose.
_FITS = 0.01


@dataclass(frozen=True)
class Outcome:
    """What came of one scene.

    verdict: right, weak, wrong (see above) or the reason of the refusal. error_mm (at the frame's origin), error_deg,
    nees (error' covariance^-1 error): None where refused, or where the frame is absent. plausibility: see there.
    """

    index: int
    verdict: str
    seconds: float
    caution: bool = False
    error_mm: float | None = None
    error_deg: float | None = None
    nees: float | None = None
    plausibility: float | None = None

    @property
    def fits(self) -> bool:
        """Whether it is wrong, but nothing in the slice speaks against it."""
        return self.verdict == "wrong" and self.plausibility is not None and self.plausibility > _FITS


def judge(scene: Scene, result: Registration | Refusal, *, near_too: bool = False) -> Outcome:
    """The outcome, without index and time. near_too: wrong is what exceeds its stated error, however near it is."""
    if not result:
        return Outcome(0, result.reason, 0.0)
    caution = bool(result.caution)
    if scene.truth is None:
        return Outcome(0, "wrong", 0.0, caution=caution)
    found, truth = result.scanner_from_frame, scene.truth
    shift, turn = found.translation - truth.translation, found.rotation @ truth.rotation.T
    error = np.append(shift, Rotation.from_matrix(turn).as_rotvec())
    nees = float(error @ np.linalg.solve(result.covariance, error))
    is_far = is_wrong(found, truth)
    is_beyond = nees > STATED and (is_far or near_too)
    verdict = "wrong" if is_beyond else "weak" if is_far else "right"
    return Outcome(
        index=0,
        verdict=verdict,
        seconds=0.0,
        caution=caution,
        error_mm=float(np.linalg.norm(shift)),
        error_deg=float(np.degrees(rotation_angle(turn))),
        nees=nees,
        plausibility=plausibility(scene, result),
    )


def plausibility(scene: Scene, result: Registration) -> float | None:
    """Probability of residuals as large by noise and tolerance alone; None where the slice speaks against the pose.

    It does so unless every spot that a rod made is matched, and no other; a rod of several spots leaves some over.
    Where the matches are not the true ones, those must not fit as well, or the slice is ambiguous. Worked out here, not
    taken from the result, as it excuses a wrong pose. The scale's tolerance is left out: that excuses less.
    """
    made = np.flatnonzero(scene.rods != NO_ROD)
    spots = np.array([match.spot for match in result.matches])
    rods = np.array([match.line_index for match in result.matches])
    if not made.size or len(set(scene.rods[made])) < len(made) or not np.array_equal(np.sort(spots), made):
        return None
    if scene.truth is not None and not np.array_equal(scene.rods[spots], rods):
        truth = scene.truth

        def residuals(step: Array) -> Array:
            return _whitened(scene, truth.perturbed(step[:3], step[3:]), scene.rods[made], made)

        best = least_squares(residuals, np.zeros(6), x_scale=[1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
        if _probability(best.fun) > _FITS:
            return None
    return _probability(_whitened(scene, result.estimate.slice_from_frame, rods, spots))


def _whitened(scene: Scene, pose: Pose, rods: NDArray[np.intp], spots: NDArray[np.intp]) -> Array:
    """Residuals (2k,) of spots (k,) at rods (k,), in standard deviations, at a pose slice_from_frame."""
    options, frame = options_of(scene), scene.frame
    predicted, cuts = project(frame, pose, scene.scale)
    residuals = scene.scale.to_mm(scene.spots_px[spots] - predicted[rods])
    along = ((cuts.lambdas - frame.lambda_min) / (frame.lambda_max - frame.lambda_min))[rods]
    # Both ends are off, independently; what they are off by along the normal moves the cut along the rod's slope.
    slope = cuts.directions[rods, :2] / cuts.directions[rods, 2:]
    variance = frame.tolerances_or(options.frame_tolerance_mm)[rods] ** 2 * (along**2 + (1 - along) ** 2)
    of_rods = variance[:, None, None] * (np.eye(2) + slope[:, :, None] * slope[:, None, :])
    of_spots = options.spot_noise_px**2 * scene.scale.matrix @ scene.scale.matrix.T
    whitening = np.linalg.inv(np.linalg.cholesky(of_rods + of_spots))
    whitened: Array = (whitening @ residuals[..., None]).ravel()
    return whitened


def _probability(whitened: Array) -> float:
    """Of residuals (2k,) as large, of which a pose has taken six."""
    return float(chi2.sf(float(whitened @ whitened), len(whitened) - 6))


def measure(kind: str, frame: str, start: int, count: int, seed: int = 0) -> list[Outcome]:
    """The outcomes of scenes `start` to `start + count - 1` of a kind with a frame."""
    cv2.setNumThreads(1)
    return [_timed(index, scene_of(kind, frame, index, seed)) for index in range(start, start + count)]


def measure_cases(path: Path = CASES) -> list[Outcome]:
    """The outcomes of the scenes that were seen to go wrong: right is what is within its stated error, or refused."""
    return [_timed(index, scene, near_too=True) for index, scene in enumerate(read_cases(path))]


def _timed(index: int, scene: Scene, *, near_too: bool = False) -> Outcome:
    start = time.perf_counter()
    result = register(scene)
    seconds = time.perf_counter() - start
    return replace(judge(scene, result, near_too=near_too), index=index, seconds=seconds)


@dataclass(frozen=True)
class Row:
    """A kind with a frame. cautioned: how many of the wrong poses had a caution; nees: mean over accepted poses."""

    kind: str
    frame: str
    scenes: int
    right: int
    weak: int
    wrong: int
    fits: int
    cautioned: int
    refused: dict[str, int]
    nees: float | None
    median_s: float
    wrong_scenes: tuple[Outcome, ...]

    @property
    def shortcoming(self) -> str:
        """What is worse than it may be; empty where nothing is."""
        kind = KINDS.get(self.kind)
        if kind is None:
            return "WRONG" if self.wrong else ""
        if kind.can_show and self.wrong - self.fits > ALLOWED_SHARE * self.scenes:
            return "WRONG"
        if kind.nees is not None and self.nees is not None and not kind.nees[0] <= self.nees <= kind.nees[1]:
            return "NEES"
        return ""


def row_of(kind: str, frame: str, outcomes: list[Outcome]) -> Row:
    """The row of the table."""
    counts = Counter(outcome.verdict for outcome in outcomes)
    nees = [outcome.nees for outcome in outcomes if outcome.nees is not None]
    wrong = tuple(outcome for outcome in outcomes if outcome.verdict == "wrong")
    return Row(
        kind=kind,
        frame=frame,
        scenes=len(outcomes),
        right=counts.pop("right", 0),
        weak=counts.pop("weak", 0),
        wrong=counts.pop("wrong", 0),
        fits=sum(outcome.fits for outcome in wrong),
        cautioned=sum(outcome.caution for outcome in wrong),
        refused=dict(counts),
        nees=float(np.mean(nees)) if nees else None,
        median_s=float(np.median([outcome.seconds for outcome in outcomes])),
        wrong_scenes=wrong,
    )
