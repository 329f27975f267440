"""The paper's own matching: random samples of four spots for every four rods (Maurin 2009, section 5, fig. 5).

Kept as it was, one sample after the other: it is the baseline that ours is measured against. Its best sample is refined
by maximum likelihood and judged like any other match.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from itertools import combinations, permutations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array, Pose
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.matching.consensus import distinct, judged
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.settling import hypotheses_of, refine_matches
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.solvers.linear_system import MAX_CONDITION, POSE_RANK, assemble, condition_number
from stereoreg_ros.solvers.ls_tz import solve_system

SAMPLE: Final = 4
# The collinearity constraint s_c: sine of the smallest angle that a triangle of spots may have.
SMALLEST_SINE: Final = math.sin(math.radians(20.0))
# p of eq. 27: wanted probability that one sample at least is free of outliers.
SUCCESS: Final = 0.99
# s_d = sqrt(6) sigma: an inlier's greatest distance from its rod.
INLIER_DISTANCE: Final = math.sqrt(6.0)
# The paper does not say what sigma is. A right spot's distance from the rod that a pose from four spots predicts is
# mostly that pose's error: with a spot's own noise most right poses find no fifth rod, with three times it most do.
PREDICTION_SPREAD: Final = 3.0


class Consensus(NamedTuple):
    """A qualified sample: one with more than four inliers.

    frame_from_slice: its pose, mm; pairs: (line, spot) within s_d; std_mm: of their distances, mm.
    """

    frame_from_slice: Pose
    pairs: tuple[tuple[int, int], ...]
    std_mm: float


class Search(NamedTuple):
    """What a search gave.

    qualified: smallest deviation first, the first being the paper's answer; samples: how many were drawn; planned: how
    many the algorithm asks for; seconds: time taken.
    """

    qualified: list[Consensus]
    samples: int
    planned: int
    seconds: float


def samples_for(lines: int, spots: int) -> int:
    """N of eq. 27, the share w of inliers being that of lines in spots; no fewer than there are spots."""
    share = min(1.0, lines / spots)
    clean = share**SAMPLE
    wanted = math.log(1 - SUCCESS) / math.log(1 - clean) if clean < 1 else 1.0
    return max(math.ceil(wanted), spots)


def search(
    spots_mm: Array,
    frame: Frame,
    noise_mm: float,
    smallest_sine: float = SMALLEST_SINE,
    max_samples: int | None = None,
    seed: int = 0,
) -> Search:
    """Search the spots (s, 2) mm as fig. 5 says; noise_mm: sigma of s_d.

    Each of the N random sets of four spots is tried with every arrangement of four rods, so that one set free of
    outliers, which eq. 27 is about, is enough. max_samples: stop after this many, to time a part of a long search.
    """
    rng = np.random.default_rng(seed)
    started = time.perf_counter()
    arrangements = [np.array(order) for order in permutations(range(len(frame)), SAMPLE)]
    sets = samples_for(len(frame), len(spots_mm)) if len(spots_mm) >= SAMPLE else 0
    planned = sets * len(arrangements)
    qualified: dict[tuple[tuple[int, int], ...], Consensus] = {}
    drawn = 0
    for _ in range(sets):
        if max_samples is not None and drawn >= max_samples:
            break
        sample = rng.choice(len(spots_mm), SAMPLE, replace=False)
        drawn += len(arrangements)
        if smallest_sine > 0 and _has_collinear_triple(spots_mm[sample], smallest_sine):
            continue
        for lines in arrangements:
            found = _consensus(spots_mm, frame, lines, sample, INLIER_DISTANCE * noise_mm)
            if found is not None:
                known = qualified.setdefault(found.pairs, found)
                if found.std_mm < known.std_mm:
                    qualified[found.pairs] = found
    ranked = sorted(qualified.values(), key=lambda one: one.std_mm)
    return Search(ranked, drawn, planned, time.perf_counter() - started)


class Maurin2009:
    """The paper's matcher of one frame; it needs no tables."""

    follows_guess: Final = False

    def __init__(self, frame: Frame) -> None:
        self.frame = frame

    def match(self, problem: Problem) -> Found:
        """Explanations by the paper's search, refined and judged, best first; none where no sample qualified.

        Being random, it may miss what is there.
        """
        spots, frame = problem.spots, problem.frame
        result = search(spots.mm, frame, PREDICTION_SPREAD * spots.sigma_mm)
        starts = [(one.frame_from_slice.inverse(), _one_to_one(one, frame, spots.mm)) for one in result.qualified]
        starts = [start for start in starts if (start[1] != UNMATCHED).sum() >= problem.min_inliers]
        if not starts:
            return Found([], SAMPLE + 1)
        spot_of_line = np.array([assigned for _, assigned in starts])
        rotations = np.array([start.rotation for start, _ in starts])
        translations = np.array([start.translation for start, _ in starts])
        refined = refine_matches(spots, frame, (rotations, translations), spot_of_line)
        kept = refined.converged & (problem.prior.angles(refined.rotations) <= problem.prior.max_rotation)
        found = distinct(hypotheses_of(spots, frame, refined.take(kept), spot_of_line[kept]), problem.gains)
        return Found(judged(found, spots, frame, problem.prior, problem.decades_apart), SAMPLE + 1)

    def preparation(self, scale: PixelScale, options: RegistrationOptions) -> Iterator[None]:
        """Nothing has to be prepared."""
        return iter(())


def _has_collinear_triple(four: Array, smallest_sine: float) -> bool:
    """Whether three of four spots make a triangle with an angle of a smaller sine (the constraint C_col)."""
    for triple in combinations(four, 3):
        a, b, c = triple
        ab, ac, bc = b - a, c - a, c - b
        twice_area = abs(ab[0] * ac[1] - ab[1] * ac[0])
        sides = sorted(math.hypot(*side) for side in (ab, ac, bc))
        # The smallest sine belongs to the angle between the two longest sides, or to the obtuse one opposite them.
        if sides[0] == 0 or twice_area < smallest_sine * sides[1] * sides[2]:
            return True
    return False


def _consensus(
    spots_mm: Array, frame: Frame, lines: NDArray[np.intp], sample: NDArray[np.intp], inlier_mm: float
) -> Consensus | None:
    """The best qualified pose of one sample of four, if any: LS-TZ, support, more than four inliers."""
    points = spots_mm[sample]
    if condition_number(frame, lines, points, POSE_RANK) > MAX_CONDITION:
        return None
    best: Consensus | None = None
    for solution in solve_system(assemble(frame, lines, points)):
        pose = solution.frame_from_slice
        in_frame = spots_mm @ pose.rotation[:, :2].T + pose.translation
        offset = np.cross(frame.directions[:, None], in_frame[None]) - frame.moments[:, None]
        distance = np.sqrt((offset**2).sum(axis=2))
        position = frame.directions @ in_frame.T
        on_rod = (position >= frame.lambda_min[:, None]) & (position <= frame.lambda_max[:, None])
        line, spot = np.nonzero((distance < inlier_mm) & on_rod)
        if len(set(line.tolist())) > SAMPLE:
            std_mm = float(np.sqrt((distance[line, spot] ** 2).mean()))
            if best is None or std_mm < best.std_mm:
                best = Consensus(pose, tuple(zip(line.tolist(), spot.tolist(), strict=True)), std_mm)
    return best


def _one_to_one(consensus: Consensus, frame: Frame, spots_mm: Array) -> NDArray[np.intp]:
    """One spot for each rod of a consensus, UNMATCHED where none: the nearest, where several couples share one."""
    start = consensus.frame_from_slice.inverse()
    cuts = cut(frame, start.rotation[None], start.translation[None])
    distance = {
        (line, spot): float(np.linalg.norm(spots_mm[spot] - cuts.points_mm[0, line])) for line, spot in consensus.pairs
    }
    spot_of_line = np.full(len(frame), UNMATCHED)
    for line, spot in sorted(distance, key=lambda pair: distance[pair]):
        if spot_of_line[line] == UNMATCHED and spot not in spot_of_line:
            spot_of_line[line] = spot
    return spot_of_line
