"""Matching from seeds of three rods and three spots, the least that fixes a pose.

Triples of spots -> poses (`solvers.three_lines`) -> further rods predicted (`matching.seed_search`) -> refined and
matched until the matches no longer change (`matching.settling`). Which seeds, in which order, and when
to stop, is said here.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.matching.consensus import Spots, distinct, judged
from stereoreg_ros.matching.hypothesis import Hypothesis
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.seed_search import END_SLACK_MM, SeedSearch, search_seeds
from stereoreg_ros.matching.settling import settle
from stereoreg_ros.matching.significance import LEAST_COSINE
from stereoreg_ros.matching.triple_order import triple_order
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.solvers.three_lines import ThreeLineSolver

# Hypotheses refined at once: bounds the memory.
_CHUNK = 4000


def match(spots: Spots, frame: Frame, prior: Prior, options: RegistrationOptions) -> list[Hypothesis]:
    """All explanations of the spots that the best one does not rule out, best first; none where there is none.

    Explanations of all rods are sought first, then of all but one, and so on. At each level every set of so many rods
    holds a triple that is tried, and every seed of that triple is pursued whose predictions hit enough spots. Once an
    explanation of so many rods is found, those of fewer are not sought: a rod more is worth more than any residual that
    passes the gates but a bad one. Complete but for the seeds: of a well-conditioned triple 99.5 % of the poses are
    found, not all, which other triples mostly make up for.
    """
    found: list[Hypothesis] = []
    order = triple_order(frame, options.min_inliers)
    searches: dict[tuple[int, int], SeedSearch] = {}
    for level in range(len(frame), options.min_inliers - 1, -1):
        for index, (lines, complete_from) in enumerate(order):
            for rods_cut in range(len(frame), level - 1, -1):
                if (index, rods_cut) not in searches:
                    solver = _solver(frame, lines, round(6.0 * spots.sigma_mm + 0.05, 1))
                    searches[index, rods_cut] = search_seeds(spots, frame, solver, rods_cut, prior, options.min_inliers)
                starts = searches[index, rods_cut].reaching(level)
                for start in range(0, len(starts.spot_of_line), _CHUNK):
                    part = starts.take(slice(start, start + _CHUNK))
                    found += [
                        hypothesis
                        for hypothesis in settle(spots, frame, part, options.min_inliers)
                        if prior.angles(hypothesis.rotation[None])[0] <= prior.max_rotation
                    ]
            if complete_from <= level:
                break
        found = distinct(found, spots)
        if found and max(hypothesis.inliers for hypothesis in found) >= level:
            break
    seeds_by_visible = np.zeros(len(frame) - 2, dtype=np.int64)
    for search in searches.values():
        seeds_by_visible += search.seeds_by_visible
    return judged(found, spots, frame, seeds_by_visible)


@lru_cache(maxsize=64)
def _solver(frame: Frame, lines: tuple[int, int, int], tolerance_mm: float) -> ThreeLineSolver:
    return ThreeLineSolver(frame, lines, tolerance_mm, END_SLACK_MM, LEAST_COSINE)
