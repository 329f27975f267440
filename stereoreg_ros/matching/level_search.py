"""One search among the spots of a slice: explanations of a given number of rods, from the seeds found so far."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.matching.consensus import (
    count_missing,
    least_log10_false_alarms,
    log10_by_chance,
    log10_false_alarms,
)
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.seeds import Starts, TripleSeeds, joined, seeds_of_triple
from stereoreg_ros.matching.settling import settle, settle_as_matched
from stereoreg_ros.matching.tables import SeedTables
from stereoreg_ros.matching.triple_order import further_triples, triple_order
from stereoreg_ros.matching.twin_starts import starts_along_valley, starts_with_spots_exchanged, starts_without_one

# Hypotheses refined at once: bounds the memory.
_CHUNK: Final = 4000
# Work after which a search is given up: some seconds, which only clutter takes. The unit is what one triple of spots
# takes with six rods. _WORK_OF_START is that of a start that is refined, with six rods and few spots, _WORK_OF_SEARCH
# that of searching a triple of rods at all. After the share _LONG of the work, a search is not done a second time.
_MOST_WORK = 6_000_000
_WORK_OF_START, _WORK_OF_SEARCH, _LONG = 40, 100_000, 0.1
_FEW_SPOTS: Final = 30
# How many triples of each set of rods a second look tries: all of a set of four, as four rods have twins; LOOKS of a
# larger one when looking for twins of an accepted explanation; LOOKS_AGAIN when the first search found nothing.
_FEWEST, _LOOKS_AT_FOUR = 4, 4
LOOKS: Final = 3
LOOKS_AGAIN: Final = 2
# Explanations that chance brings less often than this (log10) are not sought beside one that was found.
_LOG10_RIVALS: Final = -3.0


class SearchGivenUpError(Exception):
    """A search goes on for too long."""


class LevelSearch:
    """The seeds found so far, and explanations of a given number of rods from them."""

    def __init__(self, problem: Problem, tables: SeedTables) -> None:
        self.problem = problem
        self._spots, self._frame, self._prior = problem.spots, problem.frame, problem.prior
        self._tables = tables
        self._order = triple_order(problem.frame, problem.min_inliers)
        self._searched: dict[tuple[int, int, int], list[TripleSeeds]] = {}
        self._searched_down_to: dict[tuple[int, int, int], int] = {}
        self._log10_false_alarms: dict[Hypothesis, float] = {}
        self._work = 0.0

    @property
    def is_long(self) -> bool:
        """Whether the search has taken so long that it must not be done a second time."""
        return self._work > _LONG * _MOST_WORK

    @property
    def levels(self) -> range:
        """Numbers of rods to seek, most first."""
        return range(min(len(self._frame), len(self._spots.mm)), self.problem.min_inliers - 1, -1)

    def is_acceptable(self, hypothesis: Hypothesis) -> bool:
        """Whether chance is ruled out as an explanation of the explanation."""
        return self.false_alarms(hypothesis) <= self.problem.max_log10_false_alarms

    def false_alarms(self, hypothesis: Hypothesis) -> float:
        """log10 of the number of false alarms, order in the clutter apart; see `consensus.log10_false_alarms`."""
        if hypothesis not in self._log10_false_alarms:
            value = log10_false_alarms(hypothesis, self._spots, self._frame, self._prior, in_order=False)
            self._log10_false_alarms[hypothesis] = value
        return self._log10_false_alarms[hypothesis]

    def hopeless(self, level: int) -> bool:
        """Whether even a true match of `level` rods could hardly be distinguished from chance."""
        return self.least_false_alarms(level) > self.problem.max_log10_false_alarms

    def least_false_alarms(self, level: int) -> float:
        """log10 of the number of false alarms that a true match of `level` rods is hardly ever below."""
        return least_log10_false_alarms(level, self._spots, self._frame, self._prior)

    def is_told_apart(self, level: int, best: Hypothesis, apart: float) -> bool:
        """Whether matches of `level` rods come by chance so much more often that they do not rival the best."""
        return self.least_false_alarms(level) > self.false_alarms(best) + apart

    def has_rivals(self, level: int, chi_square: float) -> bool:
        """Whether chance may bring explanations of `level` rods, of so low a chi-square, that could be accepted."""
        if self.hopeless(level):
            return False
        return log10_by_chance(level, chi_square, self._spots, self._frame, self._prior) > _LOG10_RIVALS

    def level(self, level: int, most_chi_square: float, known: list[Hypothesis]) -> Iterator[Hypothesis]:
        """Explanations of `level` rods or more, besides the known; most_chi_square: see `TripleSeeds.reaching`."""
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
            yield from self._allowed(settle(self._spots, self._frame, starts, self.problem.min_inliers))

    def _allowed(self, hypotheses: list[Hypothesis]) -> Iterator[Hypothesis]:
        """Those within the prior."""
        for hypothesis in hypotheses:
            if self._prior.angles(hypothesis.rotation) <= self._prior.max_rotation:
                yield hypothesis

    def second_look(
        self, level: int, known: list[Hypothesis], most_chi_square: float = math.inf, looks: int = LOOKS_AGAIN
    ) -> Iterator[Hypothesis]:
        """Explanations of `level` rods or more, besides the known, from triples of rods that `level` has not tried."""
        for starts in self._second_starts(level, known, most_chi_square, looks):
            yield from self._settled(starts)

    def _second_starts(
        self, level: int, known: list[Hypothesis], most_chi_square: float, looks: int
    ) -> Iterator[Starts]:
        for lines in further(self._frame, self.problem.min_inliers, level, looks):
            yield from self._starts_from_triple(lines, level, most_chi_square, known)

    def level_of_twins(self, level: int, most_chi_square: float, known: list[Hypothesis]) -> Iterator[Hypothesis]:
        """The same as `level`, but only from the spots of the best explanation known."""
        search, here, rows = self._among_own(known)
        return self._renumbered(search.level(level, most_chi_square, here), rows)

    def twins_of(self, known: list[Hypothesis], looks_again: bool) -> Iterator[Hypothesis]:
        """Twins of the best explanation, made of its spots, that one triple of rods may have missed.

        The true pose may be the one that was missed, and what was found its twin: no level below would show that, as it
        seeks what comes near the best with fewer rods. looks_again: whether further triples of rods are tried, which
        takes long.
        """
        exchanged = starts_with_spots_exchanged(known[0], self._spots, self._frame)
        yield from self._allowed(settle_as_matched(self._spots, self._frame, exchanged))
        starts = [starts_along_valley(known[0]), starts_without_one(known[0])]
        if looks_again:
            rods = known[0].inliers
            search, here, rows = self._among_own(known)
            if search is self:
                starts += self._second_starts(rods, here, math.inf, LOOKS)
            else:
                yield from self._renumbered(search.second_look(rods, here, looks=LOOKS), rows)
        # What all of them lead to costs little more than what one of them does.
        yield from self._settled(joined(starts))

    def _among_own(self, known: list[Hypothesis]) -> tuple[LevelSearch, list[Hypothesis], NDArray[np.intp]]:
        """The search among the spots of the best explanation known; what is known, in terms of these; their rows."""
        rows = np.sort(known[0].spot_of_line[known[0].spot_of_line != UNMATCHED])
        if len(rows) == len(self._spots.mm):
            return self, known, rows
        search = LevelSearch(self.problem.only(rows), self._tables)
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

    def _seeds(self, lines: tuple[int, int, int], level: int) -> list[TripleSeeds]:
        """The seeds of the triple of rods where a slice may cut `level` rods or more."""
        down_to = self._searched_down_to.get(lines, len(self._frame) + 1)
        if level < down_to:
            self._spend(_WORK_OF_SEARCH)
            solver = self._tables.solver(lines, self._spots.sigma_mm)
            search = seeds_of_triple(self.problem, solver, (level, down_to - 1))
            self._spend(search.triples * len(self._frame) / 6)
            self._searched.setdefault(lines, []).append(search)
            self._searched_down_to[lines] = level
        return self._searched[lines]


def further(frame: Frame, min_inliers: int, rods: int, looks: int) -> tuple[tuple[int, int, int], ...]:
    """The additional triples of rods to try when a slice that shows `rods` rods is looked at a second time."""
    return further_triples(frame, min_inliers, rods, _LOOKS_AT_FOUR if rods == _FEWEST else looks)
