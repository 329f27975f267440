"""Matching from seeds of three rods and three spots, the least that fixes a pose.

Triples of spots -> poses (`solvers.three_lines`) -> further rods predicted (`matching.seed_search`) -> refined and
matched until the matches no longer change (`matching.settling`). Which seeds, in which order, and when
to stop, is said here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.visibility import END_SLACK_MM, LEAST_COSINE, may_show
from stereoreg_ros.matching.consensus import (
    EVIDENCE_SLACK,
    IMPLAUSIBLE,
    SHARED_SPOT_MM,
    count_missing,
    decades_apart,
    distinct,
    judged,
    least_log10_false_alarms,
    log10_by_chance,
    log10_false_alarms,
    score,
)
from stereoreg_ros.matching.hypothesis import UNMATCHED, Found, Hypothesis
from stereoreg_ros.matching.pose_volume import plane_sample, typical_slices
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.seeds import SeedSearch, Starts, joined, search_seeds
from stereoreg_ros.matching.settling import settle, settle_as_matched
from stereoreg_ros.matching.significance import most_chi_square_of, share_of
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.matching.triple_order import further_triples, triple_order
from stereoreg_ros.matching.valley_starts import starts_along_valley
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.solvers.three_rods import ThreeLineSolver

# Hypotheses refined at once: bounds the memory.
_CHUNK = 4000
# Work after which a search is given up: some seconds. Only clutter takes so much. The unit is what a triple of spots
# takes with six rods; so much more takes a start that is refined, with six rods and few spots, and the search of a
# triple of rods by itself. From this share of it on, a search is not done once more.
_MOST_WORK = 6_000_000
_WORK_OF_START, _WORK_OF_SEARCH, _LONG = 40, 100_000, 0.1
_FEW_SPOTS = 30
# How many triples of each set of rods a second look tries: all of a set of four, as four rods have twins; _LOOKS of a
# larger one when looking for twins of an accepted explanation; _LOOKS_AGAIN when the first search found nothing.
_FEWEST, _LOOKS_AT_FOUR, _LOOKS, _LOOKS_AGAIN = 4, 4, 3, 2
# From so many rods on, only of a frame of which any of so many typical slices has twins; these are poses of no more
# than this chi-square, with spots known to so many mm or worse.
_FEWEST_WITHOUT_TWINS, _TYPICAL_SLICES, _NEAR_TWIN, _LEAST_SIGMA_MM = 6, 32, 20.0, 0.25
# Solvers that are kept, of a few megabytes each.
_SOLVERS = 64
# Explanations that chance brings less often than this (log10) are not sought beside one that was found.
_LOG10_RIVALS = -3.0


def match(
    spots: Spots,
    frame: Frame,
    prior: Prior,
    options: RegistrationOptions,
    known: Sequence[Hypothesis] = (),
) -> Found:
    """All explanations of the spots that the best one does not rule out; known: some of them, best first, accepted
    elsewhere and not sought again.

    Explanations of all rods are sought first, then of all but one, and so on. At each level every set of so many rods
    holds a triple that is tried, and every seed of that triple is pursued whose predictions hit enough spots. Where
    nothing is found, the search ends where so few rods could hardly be told from chance. Where something is found, it
    goes on as long as an explanation of fewer rods, if it fits well, could come near: among the spots of the best
    explanation, as twins of a pose share them, and among all spots where chance may bring one that could be accepted.
    What was found is looked at once more from further triples of rods, for twins that one triple may have missed: see
    docs/matching.md for how many of the poses a triple of rods finds. Where nothing acceptable was found, further
    triples are tried too: the spots of the first may lie in a line.
    """
    gains, apart = spots.gains(frame), decades_apart(options)
    search = _Search(spots, frame, prior, options)
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
                further = search.level if search.has_rivals(level, most_chi_square) else search.level_of_twins
                found = distinct([*found, *further(level, most_chi_square, found)], gains)
            least_rods = level
        if found and (known or search.is_acceptable(found[0])):
            if found[0].missing and found[0].inliers < len(spots.mm) and not search.is_long:
                # What the missing rods lack, an explanation by other spots may have that one triple missed.
                found = distinct([*found, *search.second_look(found[0].inliers, found)], gains)
            found = distinct([*found, *search.twins_of(found, looks_twice=not known)], gains)
        elif least_rods <= len(frame) and not search.is_long:
            # A set of rods is tried by one triple, whose spots may lie in a line: no level below finds what it missed.
            found = distinct([*found, *search.second_look(least_rods, found)], gains)
            if found and search.is_acceptable(found[0]):
                found = distinct([*found, *search.twins_of(found)], gains)
    except SearchGivenUpError:
        return Found([], least_rods, "given up: too many of them look like parts of the frame")
    if known and len(found) == 1:
        return Found(found, least_rods)  # it has been judged
    return Found(judged(found, spots, frame, prior, apart), least_rods)


def find_better(
    spots: Spots,
    frame: Frame,
    prior: Prior,
    options: RegistrationOptions,
    allowed_log10: float,
    least_score: float = -math.inf,
    fewest: int = 0,
) -> Hypothesis | None:
    """An explanation within the prior that scores above `least_score`, and that chance brings less often than allowed.

    The one of the most rods, or None where there is none of `fewest` or more. least_score: see `consensus.score`;
    allowed_log10: number of such explanations that chance may bring, each number of rods taken by itself. Where none is
    found soon, further triples of rods are tried. Raises SearchGivenUpError where it would take too long to say.
    """
    gains = spots.gains(frame)
    search = _Search(spots, frame, prior, options)

    def best_of(found: Iterator[Hypothesis], allowed: float) -> Hypothesis | None:
        better = (
            one
            for one in distinct([*found], gains)
            if score(one, gains) > least_score
            and search.false_alarms(one) <= allowed
            and one.chi_square <= chi2.isf(IMPLAUSIBLE, 2 * one.inliers - 6)
        )
        return next(better, None)

    tried = None
    for level in search.levels:
        # What matches of so many rods have to share with those of other numbers does not count here.
        allowed = allowed_log10 - math.log10(share_of(level, len(frame)))
        decades_left = allowed - search.least_false_alarms(level)
        if level < fewest or level * gains.max() < least_score or decades_left < 0:
            break
        # What the stated errors cannot explain would not be accepted either, and speaks against nothing.
        most_chi_square = min(
            2 * (level * gains.max() - least_score),
            float(chi2.isf(IMPLAUSIBLE, 2 * level - 6)),
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


def match_most(spots: Spots, frame: Frame, prior: Prior, options: RegistrationOptions) -> list[Hypothesis]:
    """The explanations of the most rods, and rivals of as many; none where there is none, or the search is long."""
    search = _Search(spots, frame, prior, options)
    try:
        for level in search.levels:
            if search.hopeless(level):
                break
            found = distinct(list(search.level(level, math.inf, [])), spots.gains(frame))
            if found:
                return judged(found, spots, frame, prior, decades_apart(options))
    except SearchGivenUpError:
        pass
    return []


class SearchGivenUpError(Exception):
    """A search goes on for too long."""


class _Search:
    """The seeds found so far, and explanations of so many rods from them."""

    def __init__(self, spots: Spots, frame: Frame, prior: Prior, options: RegistrationOptions) -> None:
        self._spots, self._frame, self._prior, self._options = spots, frame, prior, options
        self._order = triple_order(frame, options.min_inliers)
        self._searched: dict[tuple[int, int, int], list[SeedSearch]] = {}
        self._searched_down_to: dict[tuple[int, int, int], int] = {}
        self._log10_false_alarms: dict[Hypothesis, float] = {}
        self._work = 0.0

    @property
    def is_long(self) -> bool:
        """Whether so much has been done that the like once more would take too long."""
        return self._work > _LONG * _MOST_WORK

    @property
    def levels(self) -> range:
        """Numbers of rods to seek, most first."""
        return range(min(len(self._frame), len(self._spots.mm)), self._options.min_inliers - 1, -1)

    def is_acceptable(self, hypothesis: Hypothesis) -> bool:
        """Whether chance is ruled out as an explanation of the explanation."""
        return self.false_alarms(hypothesis) <= self._options.max_log10_false_alarms

    def false_alarms(self, hypothesis: Hypothesis) -> float:
        """log10 of the number of false alarms, order in the clutter apart; see `consensus.log10_false_alarms`."""
        if hypothesis not in self._log10_false_alarms:
            value = log10_false_alarms(hypothesis, self._spots, self._frame, self._prior, in_order=False)
            self._log10_false_alarms[hypothesis] = value
        return self._log10_false_alarms[hypothesis]

    def hopeless(self, level: int) -> bool:
        """Whether even a true match of so many rods would hardly be told from chance."""
        return self.least_false_alarms(level) > self._options.max_log10_false_alarms

    def least_false_alarms(self, level: int) -> float:
        """log10 of the number of false alarms that a true match of so many rods is hardly ever below."""
        return least_log10_false_alarms(level, self._spots, self._frame, self._prior)

    def is_told_apart(self, level: int, best: Hypothesis, apart: float) -> bool:
        """Whether chance brings matches of so many rods so much more often that they are no rivals of the best."""
        return self.least_false_alarms(level) > self.false_alarms(best) + apart

    def has_rivals(self, level: int, chi_square: float) -> bool:
        """Whether chance may bring explanations of `level` rods, of so low a chi-square, that could be accepted."""
        if self.hopeless(level):
            return False
        return log10_by_chance(level, chi_square, self._spots, self._frame, self._prior) > _LOG10_RIVALS

    def level(self, level: int, most_chi_square: float, known: list[Hypothesis]) -> Iterator[Hypothesis]:
        """Explanations of so many rods, or more, besides the known; most_chi_square: see `SeedSearch.reaching`."""
        for lines, complete_from in self._order:
            yield from self._from_triple(lines, level, most_chi_square, known)
            if complete_from <= level:
                return

    def _from_triple(
        self, lines: tuple[int, int, int], level: int, most_chi_square: float, known: list[Hypothesis]
    ) -> Iterator[Hypothesis]:
        for starts in self._starts_from_triple(lines, level, most_chi_square, known):
            yield from self._settled(starts)

    def _starts_from_triple(
        self, lines: tuple[int, int, int], level: int, most_chi_square: float, known: list[Hypothesis]
    ) -> Iterator[Starts]:
        for seeds in self._seeds(lines, level):
            starts = seeds.reaching(level, most_chi_square, known)
            self._spend(_WORK_OF_START * starts.spot_of_line.size / 6 * (1 + len(self._spots.mm) / _FEW_SPOTS))
            for first in range(0, len(starts.spot_of_line), _CHUNK):
                yield starts.take(slice(first, first + _CHUNK))

    def _settled(self, starts: Starts) -> Iterator[Hypothesis]:
        if len(starts.origin):
            yield from self._allowed(settle(self._spots, self._frame, starts, self._options.min_inliers))

    def _allowed(self, hypotheses: list[Hypothesis]) -> Iterator[Hypothesis]:
        """Those within the prior."""
        for hypothesis in hypotheses:
            if self._prior.angles(hypothesis.rotation) <= self._prior.max_rotation:
                yield hypothesis

    def second_look(
        self, level: int, known: list[Hypothesis], most_chi_square: float = math.inf, looks: int = _LOOKS_AGAIN
    ) -> Iterator[Hypothesis]:
        """Explanations of so many rods, or more, besides the known, from further triples of rods than `level` tried."""
        for starts in self._second_starts(level, known, most_chi_square, looks):
            yield from self._settled(starts)

    def _second_starts(
        self, level: int, known: list[Hypothesis], most_chi_square: float, looks: int
    ) -> Iterator[Starts]:
        for lines in _further(self._frame, self._options, level, looks):
            yield from self._starts_from_triple(lines, level, most_chi_square, known)

    def level_of_twins(self, level: int, most_chi_square: float, known: list[Hypothesis]) -> Iterator[Hypothesis]:
        """The same as `level`, but only from the spots of the best explanation known."""
        search, here, rows = self._among_own(known)
        return self._renumbered(search.level(level, most_chi_square, here), rows)

    def twins_of(self, known: list[Hypothesis], looks_twice: bool = True) -> Iterator[Hypothesis]:
        """Twins of the best explanation, made of its spots, that one triple of rods may have missed.

        The true pose may be the one that was missed, and what was found its twin: no level below would tell, as it
        seeks what comes near the best with fewer rods. looks_twice: whether further triples are tried of six rods or
        more. Near a guess they are not: the guess as a rule is a pose that was accepted after such a search, and one
        triple of six rods rarely misses a twin.
        """
        exchanged = _starts_with_spots_exchanged(known[0], self._spots, self._frame)
        yield from self._allowed(settle_as_matched(self._spots, self._frame, exchanged))
        starts = [starts_along_valley(known[0]), _starts_without_one(known[0])]
        rods = known[0].inliers
        if rods < _FEWEST_WITHOUT_TWINS or (looks_twice and _has_twins(self._frame, rods, self._spots.sigma_mm)):
            search, here, rows = self._among_own(known)
            if search is self:
                starts += self._second_starts(rods, here, math.inf, _LOOKS)
            else:
                yield from self._renumbered(search.second_look(rods, here, looks=_LOOKS), rows)
        # What all of them lead to costs little more than what one of them does.
        yield from self._settled(joined(starts))

    def _among_own(self, known: list[Hypothesis]) -> tuple[_Search, list[Hypothesis], NDArray[np.intp]]:
        """The search among the spots of the best explanation known; what is known, in terms of these; their rows."""
        rows = np.sort(known[0].spot_of_line[known[0].spot_of_line != UNMATCHED])
        if len(rows) == len(self._spots.mm):
            return self, known, rows
        search = _Search(self._spots.only(rows), self._frame, self._prior.only(rows), self._options)
        row_of = np.full(len(self._spots.mm) + 1, UNMATCHED)  # the last one is for UNMATCHED
        row_of[rows] = np.arange(len(rows))
        return search, [replace(one, spot_of_line=row_of[one.spot_of_line]) for one in known], rows

    def _renumbered(self, found: Iterator[Hypothesis], rows: NDArray[np.intp]) -> Iterator[Hypothesis]:
        """Explanations of some of the spots in terms of all; rows: of these spots."""
        for one in found:
            spot_of_line = np.where(one.spot_of_line != UNMATCHED, rows[one.spot_of_line], UNMATCHED)
            # Among all spots more rods must show than among the few.
            cuts = cut(self._frame, one.rotation, one.translation)
            missing = int(count_missing(self._spots, self._frame, cuts, spot_of_line))
            yield replace(one, spot_of_line=spot_of_line, missing=missing)

    def _spend(self, work: float) -> None:
        self._work += work
        if self._work > _MOST_WORK:
            raise SearchGivenUpError

    def _seeds(self, lines: tuple[int, int, int], level: int) -> list[SeedSearch]:
        """The seeds of the triple of rods where a slice may cut `level` rods or more."""
        down_to = self._searched_down_to.get(lines, len(self._frame) + 1)
        if level < down_to:
            self._spend(_WORK_OF_SEARCH)
            solver = _solver(self._frame, lines, _tolerance_mm(self._spots.sigma_mm))
            search = search_seeds(
                self._spots, self._frame, solver, (level, down_to - 1), self._prior, self._options.min_inliers
            )
            self._spend(search.triples * len(self._frame) / 6)
            self._searched.setdefault(lines, []).append(search)
            self._searched_down_to[lines] = level
        return self._searched[lines]


def _further(frame: Frame, options: RegistrationOptions, rods: int, looks: int) -> tuple[tuple[int, int, int], ...]:
    """The additional rod triples to search when a slice showing `rods` rods is searched a second time."""
    return further_triples(frame, options.min_inliers, rods, _LOOKS_AT_FOUR if rods == _FEWEST else looks)


def _starts_without_one(hypothesis: Hypothesis) -> Starts:
    """Starts at a pose with each of its rods left out in turn.

    A false spot may draw the pose to itself; from every seed, and with all its rods, the search then ends there.
    """
    lines = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    spot_of_line = np.tile(hypothesis.spot_of_line, (len(lines), 1))
    spot_of_line[np.arange(len(lines)), lines] = UNMATCHED
    rotations = np.tile(hypothesis.rotation, (len(lines), 1, 1))
    translations = np.tile(hypothesis.translation, (len(lines), 1))
    return Starts(rotations, translations, spot_of_line, np.arange(len(lines)))


def _starts_with_spots_exchanged(hypothesis: Hypothesis, spots: Spots, frame: Frame) -> Starts:
    """Starts at a pose with the spot of a rod given to another one, which has none and is cut beside it.

    Where two rods meet and one of them does not show, nothing but the other matches says which one does.
    """
    cuts = cut(frame, hypothesis.rotation, hypothesis.translation)
    without = np.flatnonzero((hypothesis.spot_of_line == UNMATCHED) & may_show(frame, cuts))
    having = np.flatnonzero(hypothesis.spot_of_line != UNMATCHED)
    apart = np.linalg.norm(cuts.points_mm[without, None] - spots.mm[hypothesis.spot_of_line[having]], axis=2)
    rows = np.argwhere(apart <= SHARED_SPOT_MM)
    spot_of_line = np.tile(hypothesis.spot_of_line, (len(rows), 1))
    for matches, (row, column) in zip(spot_of_line, rows, strict=True):
        matches[without[row]], matches[having[column]] = matches[having[column]], UNMATCHED
    rotations = np.tile(hypothesis.rotation, (len(rows), 1, 1))
    translations = np.tile(hypothesis.translation, (len(rows), 1))
    return Starts(rotations, translations, spot_of_line, np.arange(len(rows)))


def _has_twins(frame: Frame, rods: int, sigma_mm: float) -> bool:
    """Whether any of a sample of slices that show `rods` rods has a twin, with spots known to sigma_mm.

    The distances between k spots set 2k - 3 conditions to the six numbers of two slices that show the same: four spots
    have twins, and five near ones. From six on few slices have them, unless the frame is nearly symmetric.
    """
    return _twin_sample(frame, rods, sigma_mm).any()


class _TwinSample:
    """Typical slices that show so many rods, and whether any of them has a second explanation of them all."""

    def __init__(self, frame: Frame, rods: int, sigma_mm: float) -> None:
        self._frame, self._rods, self._sigma_mm = frame, rods, sigma_mm
        self._left = zip(*typical_slices(frame, rods, _TYPICAL_SLICES), strict=True)
        self._rng = np.random.default_rng(0)
        self._looked_at = self._twins = 0

    def any(self) -> bool:
        """Whether a slice was found that has twins; true too where no slice shows so many rods."""
        while not self._twins and self.look_at_next():
            pass
        return self._twins > 0 or not self._looked_at

    def look_at_next(self) -> bool:
        """Look at one slice more; False where there is none."""
        try:
            rotation, translation, seen = next(self._left)
        except StopIteration:
            return False
        shown = self._rng.permutation(np.flatnonzero(seen))[: self._rods]
        points_mm = cut(self._frame, rotation, translation).points_mm[shown]
        noise_mm2 = np.tile(self._sigma_mm**2 * np.eye(2), (self._rods, 1, 1))
        spots = Spots.of(points_mm, noise_mm2, None, Tolerances.none(self._frame))
        search = _Search(spots, self._frame, Prior(np.eye(3), math.pi), RegistrationOptions())
        self._looked_at += 1
        try:
            near = [one for one in search.level(self._rods, math.inf, []) if one.chi_square < _NEAR_TWIN]
            self._twins += len(distinct(near, spots.gains(self._frame))) > 1
        except SearchGivenUpError:
            self._twins += 1  # For all that is known.
        return True


def _twin_sample(frame: Frame, rods: int, sigma_mm: float) -> _TwinSample:
    """Of spots known so well or less; in steps, so that few are made."""
    return _kept_twin_sample(frame, rods, max(2.0 ** math.ceil(math.log2(sigma_mm)), _LEAST_SIGMA_MM))


@lru_cache(maxsize=64)
def _kept_twin_sample(frame: Frame, rods: int, sigma_mm: float) -> _TwinSample:
    return _TwinSample(frame, rods, sigma_mm)


def preparation(frame: Frame, sigma_mm: float, options: RegistrationOptions) -> Iterator[None]:
    """Fill the tables that slices need, some at each step.

    First those for all rods or all but one; then those for slices without the frame, where the search goes down to the
    fewest rods. sigma_mm: of the spots' centres.
    """
    most, least = len(frame), max(len(frame) - 1, options.min_inliers)
    order = triple_order(frame, options.min_inliers)
    for lines, complete_from in order:
        for range_of_rods in ((most, most), (least, most), (least, least)):
            _solver(frame, lines, _tolerance_mm(sigma_mm)).table(*range_of_rods)
            yield
        if complete_from <= least:
            break
    for rods in range(options.min_inliers, most + 1):
        plane_sample(frame, rods)
        yield
    for rods in range(max(least, _FEWEST_WITHOUT_TWINS), most + 1):
        while _twin_sample(frame, rods, sigma_mm).look_at_next():
            yield
    # Of slices with all rods or all but one, what was accepted is looked at once more.
    for rods in range(max(least, _FEWEST_WITHOUT_TWINS), most + 1):
        if _has_twins(frame, rods, sigma_mm):
            for lines in _further(frame, options, rods, _LOOKS):
                _solver(frame, lines, _tolerance_mm(sigma_mm)).table(rods, most)
                yield
    # Where nothing is found, or nothing that contradicts it, all spots are looked at once more.
    again = [
        (lines, rods)
        for rods in range(most, options.min_inliers - 1, -1)
        for lines in _further(frame, options, rods, _LOOKS_AGAIN)
    ]
    for lines, rods in again[: _SOLVERS // 2]:
        _solver(frame, lines, _tolerance_mm(sigma_mm)).table(rods, most)
        yield
    begun_at = most
    # Of frames of many rods only some: the rest is for spots that are known less well.
    for lines, complete_from in order[: _SOLVERS // 2]:
        # As `_Search` asks for them: with all that a triple has not been tried for, then level by level.
        for ranges in ((begun_at, most), *((rods, rods) for rods in range(begun_at - 1, options.min_inliers - 1, -1))):
            _solver(frame, lines, _tolerance_mm(sigma_mm)).table(*ranges)
            yield
        begun_at = min(begun_at, complete_from - 1)


def _tolerance_mm(sigma_mm: float) -> float:
    """How far noise may change a distance between two spots; in steps, so that few solvers serve all noises.

    Upwards: spots are known as well as the options say or a little less well, and the solvers prepared serve both.
    """
    return math.ceil(10 * (6.0 * sigma_mm + 0.05)) / 10


@lru_cache(maxsize=_SOLVERS)
def _solver(frame: Frame, lines: tuple[int, int, int], tolerance_mm: float) -> ThreeLineSolver:
    return ThreeLineSolver(frame, lines, tolerance_mm, END_SLACK_MM, LEAST_COSINE)
