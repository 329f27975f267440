"""Matching from seeds of three rods and three spots, the least that fixes a pose.

Triples of spots -> poses (`solvers.three_rods`) -> further rods predicted (`matching.seeds`) -> refined and
matched until the matches no longer change (`matching.settling`). Which seeds, in which order, and when
to stop, is said here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from scipy.special import chdtri

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.matching.consensus import EVIDENCE_SLACK, IMPLAUSIBLE, distinct, judged, score
from stereoreg_ros.matching.hypothesis import Found, Hypothesis
from stereoreg_ros.matching.level_search import LOOKS, LOOKS_AGAIN, LevelSearch, SearchGivenUpError, further
from stereoreg_ros.matching.near import match_near
from stereoreg_ros.matching.pose_volume import plane_sample
from stereoreg_ros.matching.problem import Problem, tolerances_of
from stereoreg_ros.matching.significance import most_chi_square_of, share_of
from stereoreg_ros.matching.tables import KEPT_TRIPLES, SeedTables
from stereoreg_ros.matching.triple_order import triple_order
from stereoreg_ros.matching.twins import Twins
from stereoreg_ros.options import RegistrationOptions

# From this many rods on, twins are looked for by further triples only of a frame that has them.
_FEWEST_WITHOUT_TWINS: Final = 6


class ByLevels:
    """Finds all explanations of a slice's spots by one frame, the most rods first; keeps the frame's tables."""

    follows_guess: Final = True

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.tables = SeedTables(frame)
        self._twins = Twins(self.tables)

    def match(self, problem: Problem) -> Found:
        """The explanations that the best one does not rule out: near the guess if that is enough, else everywhere."""
        near = match_near(problem, self) if problem.guess is not None else None
        return near or self.match_anywhere(problem)

    def match_anywhere(self, problem: Problem, known: Sequence[Hypothesis] = ()) -> Found:
        """All explanations of the spots that the best one does not rule out, wherever the frame was before.

        known: some of them, best first, accepted elsewhere and not sought again.

        Explanations of all rods are sought first, then of all but one, and so on. At each level every set of that many
        rods holds a triple that is tried, and every seed of that triple is pursued whose predictions hit enough spots.
        Where nothing is found, the search ends where a match of so few rods could hardly be distinguished from chance.
        Where something is found, it goes on as long as an explanation of fewer rods, if it fits well, could come near:
        among the spots of the best explanation, as twins of a pose share them, and among all spots where chance may
        bring one that could be accepted. What was found is looked at once more from further triples of rods, for twins
        that one triple may have missed: see docs/matching.md for how many of the poses a triple of rods finds. Where
        nothing acceptable was found, further triples are tried too: the spots of the first may lie in a line.
        """
        spots, frame = problem.spots, problem.frame
        gains, apart = problem.gains, problem.decades_apart
        search = LevelSearch(problem, self.tables)
        found = list(known)
        least_rods = len(frame) + 1
        try:
            for level in search.levels:
                # What is known has been accepted by who knows it: its twins are sought however it looks from here.
                if not known and (not found or not search.is_acceptable(found[0])):
                    if search.hopeless(level):
                        break
                    found = distinct([*found, *search.level(level, math.inf, found)], gains)
                else:
                    most_chi_square = 2 * (
                        level * gains.max() - score(found[0], gains) + apart * math.log(10) + EVIDENCE_SLACK
                    )
                    # Of as many rods as the best has, a twin is a rival however lucky the best one's residuals are.
                    fewer = level < found[0].inliers
                    if most_chi_square < 0 or (fewer and search.is_told_apart(level, found[0], apart)):
                        break
                    seek = search.level if search.has_rivals(level, most_chi_square) else search.level_of_twins
                    found = distinct([*found, *seek(level, most_chi_square, found)], gains)
                least_rods = level
            if found and (known or search.is_acceptable(found[0])):
                if found[0].missing and found[0].inliers < len(spots.mm) and not search.is_long:
                    # What the missing rods lack, an explanation by other spots may have that one triple missed.
                    found = distinct([*found, *search.second_look(found[0].inliers, found)], gains)
                looks_again = self._looks_again(found[0], spots.sigma_mm, accepted_before=bool(known))
                found = distinct([*found, *search.twins_of(found, looks_again)], gains)
            elif least_rods <= len(frame) and not search.is_long:
                # One triple stands for a set of rods; where its spots lie in a line, no level below finds what it
                # missed.
                found = distinct([*found, *search.second_look(least_rods, found)], gains)
                if found and search.is_acceptable(found[0]):
                    looks_again = self._looks_again(found[0], spots.sigma_mm)
                    found = distinct([*found, *search.twins_of(found, looks_again)], gains)
        except SearchGivenUpError:
            return Found([], least_rods, "given up: too many of them look like parts of the frame")
        if known and len(found) == 1:
            return Found(found, least_rods)  # it has been judged
        return Found(judged(found, spots, frame, problem.prior, apart), least_rods)

    def find_better(
        self, problem: Problem, allowed_log10: float, least_score: float = -math.inf, fewest: int = 0
    ) -> Hypothesis | None:
        """An explanation within the prior that scores above `least_score` and is not by chance.

        The one of the most rods, or None where there is none of `fewest` or more. least_score: see `consensus.score`;
        allowed_log10: log10 of the number of such explanations that chance may bring, each number of rods taken by
        itself. Where none is found soon, further triples of rods are tried. Raises SearchGivenUpError where it would
        take too long to say.
        """
        gains = problem.gains
        search = LevelSearch(problem, self.tables)

        def best_of(found: Iterator[Hypothesis], allowed: float) -> Hypothesis | None:
            better = (
                one
                for one in distinct([*found], gains)
                if score(one, gains) > least_score
                and search.false_alarms(one) <= allowed
                and one.chi_square <= chdtri(2 * one.inliers - 6, IMPLAUSIBLE)
            )
            return next(better, None)

        tried = None
        for level in search.levels:
            # Each number of rods is taken by itself here: it shares its allowance with no other.
            allowed = allowed_log10 - math.log10(share_of(level, len(problem.frame)))
            decades_left = allowed - search.least_false_alarms(level)
            if level < fewest or level * gains.max() < least_score or decades_left < 0:
                break
            # What the stated errors cannot explain would not be accepted either, and speaks against nothing.
            most_chi_square = min(
                2 * (level * gains.max() - least_score),
                float(chdtri(2 * level - 6, IMPLAUSIBLE)),
                most_chi_square_of(level, decades_left),
            )
            best = best_of(search.level(level, most_chi_square, []), allowed)
            if best is not None:
                return best
            tried = level, most_chi_square, allowed
        if tried is None or search.is_long:
            return None
        level, most_chi_square, allowed = tried
        return best_of(search.second_look(level, [], most_chi_square), allowed)

    def match_most(self, problem: Problem) -> list[Hypothesis]:
        """The explanations of the most rods, and rivals of as many; none where there is none, or the search is long."""
        search = LevelSearch(problem, self.tables)
        try:
            for level in search.levels:
                if search.hopeless(level):
                    break
                found = distinct(list(search.level(level, math.inf, [])), problem.gains)
                if found:
                    return judged(found, problem.spots, problem.frame, problem.prior, problem.decades_apart)
        except SearchGivenUpError:
            pass
        return []

    def _looks_again(self, best: Hypothesis, sigma_mm: float, accepted_before: bool = False) -> bool:
        """Whether twins of what was accepted are looked for by further triples of rods.

        Of six rods or more only of frames that have twins; and not near a guess: as a rule that is a pose which was
        accepted after such a search, and one triple of six rods rarely misses a twin.
        """
        if best.inliers < _FEWEST_WITHOUT_TWINS:
            return True
        return not accepted_before and self._twins.exist(best.inliers, sigma_mm)

    def preparation(self, scale: PixelScale, options: RegistrationOptions) -> Iterator[None]:
        """Fill the tables that slices need, some at each step.

        First those for all rods or all but one; then those for slices without the frame, where the search goes down to
        the fewest rods.
        """
        frame = self.frame
        noise_mm = options.spot_noise_px * max(scale.sx, scale.sy)
        sigma_mm = math.hypot(noise_mm, tolerances_of(frame, scale, options).extent_mm)
        most, least = len(frame), max(len(frame) - 1, options.min_inliers)
        order = triple_order(frame, options.min_inliers)
        for lines, complete_from in order:
            for range_of_rods in ((most, most), (least, most), (least, least)):
                self.tables.solver(lines, sigma_mm).table(*range_of_rods)
                yield
            if complete_from <= least:
                break
        for rods in range(options.min_inliers, most + 1):
            plane_sample(frame, rods)
            yield
        for rods in range(max(least, _FEWEST_WITHOUT_TWINS), most + 1):
            while self._twins.sample(rods, sigma_mm).look_at_next():
                yield
        # Of slices with all rods or all but one, what was accepted is looked at once more.
        for rods in range(max(least, _FEWEST_WITHOUT_TWINS), most + 1):
            if self._twins.exist(rods, sigma_mm):
                for lines in further(frame, options.min_inliers, rods, LOOKS):
                    self.tables.solver(lines, sigma_mm).table(rods, most)
                    yield
        # Where nothing is found, or nothing that contradicts it, all spots are looked at once more.
        again = [
            (lines, rods)
            for rods in range(most, options.min_inliers - 1, -1)
            for lines in further(frame, options.min_inliers, rods, LOOKS_AGAIN)
        ]
        for lines, rods in again[: KEPT_TRIPLES // 2]:
            self.tables.solver(lines, sigma_mm).table(rods, most)
            yield
        begun_at = most
        # Of frames of many rods only some: the rest is for spots that are known less well.
        for lines, complete_from in order[: KEPT_TRIPLES // 2]:
            # As `LevelSearch` asks for them: with all that a triple has not been tried for, then level by level.
            for ranges in (
                (begun_at, most),
                *((rods, rods) for rods in range(begun_at - 1, options.min_inliers - 1, -1)),
            ):
                self.tables.solver(lines, sigma_mm).table(*ranges)
                yield
            begun_at = min(begun_at, complete_from - 1)
