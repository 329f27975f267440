"""The search from three rods, step by step: what it goes on from, looks at once more, and leaves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stereoreg_ros import load_frame
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.matching import level_search
from stereoreg_ros.matching.by_levels import ByLevels
from stereoreg_ros.matching.consensus import score
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.level_search import LevelSearch
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.seeds import Starts
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tables import SeedTables, tolerance_mm
from stereoreg_ros.matching.tolerances import Tolerances
from stereoreg_ros.matching.twin_starts import starts_along_valley, starts_with_spots_exchanged, starts_without_one
from stereoreg_ros.matching.twins import Twins

ANY = Prior(np.eye(3), math.pi)
# The slice is z = 0 of the frame; the fifth rod is cut 2 mm beside the first one.
PLACES = np.array([[0.0, 0.0], [60.0, 0.0], [0.0, 60.0], [60.0, 70.0], [2.0, 0.0], [80.0, 40.0]])
SLOPES = np.array([[0.0, 0.1], [0.1, 0.0], [0.0, -0.1], [0.4, 0.3], [-0.1, 0.05], [0.05, 0.2]])
FIVE = np.array([0, 1, 2, 3, UNMATCHED, 5])


def frame(fifth_ends_at_mm: float = 30.0) -> Frame:
    directions = np.column_stack([SLOPES, np.ones(6)])
    middles = np.column_stack([PLACES, np.zeros(6)])
    high = np.array([30.0, 30.0, 30.0, 30.0, fifth_ends_at_mm, 30.0])[:, None]
    return Frame("six", tuple("abcdef"), middles - 20.0 * directions, middles + high * directions, np.ones(6))


def spots(points_mm: ArrayLike = PLACES) -> Spots:
    points = np.asarray(points_mm, dtype=np.float64)
    return Spots.of(points, np.tile(0.04 * np.eye(2), (len(points), 1, 1)), 1e4, Tolerances.none(frame()))


def explanation(spot_of_line: ArrayLike = FIVE, chi_square: float = 1.0) -> Hypothesis:
    information = np.diag([100.0, 100.0, 100.0, 1e5, 1e5, 1e5])
    return Hypothesis(np.eye(3), np.zeros(3), np.asarray(spot_of_line), chi_square, information, 0)


def problem(given: Spots | None = None) -> Problem:
    return Problem(spots() if given is None else given, frame(), ANY, 4, -6.0)


def searching(given: Spots) -> LevelSearch:
    return LevelSearch(problem(given), SeedTables(frame()))


class TestStarts:
    def test_a_rod_without_a_spot_may_have_that_of_the_one_it_meets(self) -> None:
        starts = starts_with_spots_exchanged(explanation(), spots(), frame())
        assert starts.spot_of_line.tolist() == [[UNMATCHED, 1, 2, 3, 0, 5]]
        np.testing.assert_array_equal(starts.rotations, np.eye(3)[None])

    def test_but_not_where_it_ends_before_the_slice(self) -> None:
        starts = starts_with_spots_exchanged(explanation(), spots(), frame(fifth_ends_at_mm=-5.0))
        assert len(starts.spot_of_line) == 0

    def test_each_rod_is_left_out_in_turn(self) -> None:
        starts = starts_without_one(explanation())
        expected = np.tile(FIVE, (5, 1))
        for row, line in enumerate([0, 1, 2, 3, 5]):
            expected[row, line] = UNMATCHED
        np.testing.assert_array_equal(starts.spot_of_line, expected)

    def test_twins_are_sought_from_all_of_these_and_along_the_valley(self, monkeypatch: pytest.MonkeyPatch) -> None:
        settled: dict[str, Starts] = {}

        def recorded(name: str) -> object:
            def settle(_: Spots, __: Frame, starts: Starts, *___: object) -> list[Hypothesis]:
                settled[name] = starts
                return []

            return settle

        monkeypatch.setattr(level_search, "settle", recorded("anew"))
        monkeypatch.setattr(level_search, "settle_as_matched", recorded("as matched"))
        weak = replace(explanation(), information=np.diag([100.0, 100.0, 1.0, 1e5, 1e5, 1e5]))
        assert list(searching(spots()).twins_of([weak], looks_again=False)) == []
        assert settled["as matched"].spot_of_line.tolist() == [[UNMATCHED, 1, 2, 3, 0, 5]]
        parts = [starts_along_valley(weak), starts_without_one(weak)]
        assert len(parts[0].rotations) > 5
        for name in ("rotations", "translations", "spot_of_line"):
            expected = np.concatenate([getattr(part, name) for part in parts])
            np.testing.assert_array_equal(getattr(settled["anew"], name), expected)


class TestAmongItsOwnSpots:
    def test_what_is_known_is_renumbered_for_these_spots_and_back(self) -> None:
        """The spots are in no rod's own row; with the other three rods among all spots, three more must show."""
        order = np.array([5, 3, 1, 4, 0, 2])
        every = searching(spots(np.concatenate([PLACES[order], [[95.0, 90.0], [-10.0, -10.0]]])))
        known = explanation([4, 2, 5, UNMATCHED, UNMATCHED, UNMATCHED])
        search, (here,), rows = every._among_own([known])
        assert rows.tolist() == [2, 4, 5]
        np.testing.assert_array_equal(search._spots.mm, PLACES[order][rows])
        assert here.spot_of_line.tolist() == [1, 0, 2, UNMATCHED, UNMATCHED, UNMATCHED]
        (back,) = every._renumbered(iter([here]), rows)
        np.testing.assert_array_equal(back.spot_of_line, known.spot_of_line)
        assert back.missing == 3

    def test_all_of_them_are_its_own(self) -> None:
        every = searching(spots())
        search, known, rows = every._among_own([explanation(range(6))])
        assert search is every
        assert known[0].spot_of_line.tolist() == rows.tolist() == list(range(6))


class TestTwinsOfFrames:
    """Whether a look at typical slices finds that they have twins."""

    @pytest.mark.parametrize(
        ("name", "rods", "has_twins"), [("cube8", 8, False), ("cube6", 6, True), ("zframe", 7, True)]
    )
    def test_of_shipped_ones(self, name: str, rods: int, has_twins: bool) -> None:
        assert Twins(SeedTables(load_frame(name))).exist(rods, 0.25) is has_twins

    def test_twins_are_assumed_where_no_slice_shows_that_many_rods(self) -> None:
        assert Twins(SeedTables(load_frame("cube6"))).exist(7, 0.25)


def test_distances_are_known_to_a_tenth_of_a_millimetre_or_worse() -> None:
    """Six standard deviations and a twentieth of a millimetre, rounded up."""
    assert tolerance_mm(0.15) == pytest.approx(1.0)
    assert tolerance_mm(0.16) == pytest.approx(1.1)


def test_explanations_are_told_apart_from_a_number_of_decades_on(monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching(spots())
    monkeypatch.setattr(search, "least_false_alarms", lambda _: -5.0)
    monkeypatch.setattr(search, "false_alarms", lambda _: -9.0)
    assert search.is_told_apart(5, explanation(), 3.9)
    assert not search.is_told_apart(5, explanation(), 4.1)


class TestFindBetter:
    """What contradicts: sure, plausible, and better than what it is to contradict."""

    @staticmethod
    def found(
        monkeypatch: pytest.MonkeyPatch,
        one: Hypothesis,
        least_score: float = -math.inf,
        fewest: int = 0,
        log10: float = -9.0,
        at_once: bool = True,
    ) -> Hypothesis | None:
        def level(_: object, rods: int, *__: object) -> Iterator[Hypothesis]:
            return iter([one] if at_once and rods == one.inliers else [])

        monkeypatch.setattr(LevelSearch, "level", level)
        monkeypatch.setattr(LevelSearch, "second_look", lambda *_: iter([] if at_once else [one]))
        monkeypatch.setattr(LevelSearch, "false_alarms", lambda *_: log10)
        monkeypatch.setattr(LevelSearch, "least_false_alarms", lambda *_: -20.0)
        return ByLevels(frame()).find_better(problem(), -3.0, least_score, fewest)

    def test_is_found_at_once_or_by_a_second_look(self, monkeypatch: pytest.MonkeyPatch) -> None:
        one = explanation()
        assert self.found(monkeypatch, one) is one
        assert self.found(monkeypatch, one, at_once=False) is one

    def test_has_a_better_score(self, monkeypatch: pytest.MonkeyPatch) -> None:
        one = explanation()
        its_score = score(one, spots().gains(frame()))
        assert self.found(monkeypatch, one, least_score=its_score - 0.1) is one
        assert self.found(monkeypatch, one, least_score=its_score + 0.1) is None

    @pytest.mark.parametrize(("fewest", "is_found"), [(5, True), (6, False)])
    def test_has_rods_enough(self, fewest: int, is_found: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        assert (self.found(monkeypatch, explanation(), fewest=fewest) is not None) is is_found

    def test_could_come_from_the_stated_noise(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.found(monkeypatch, explanation(chi_square=10.0)) is not None
        assert self.found(monkeypatch, explanation(chi_square=100.0)) is None

    def test_is_not_by_chance(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.found(monkeypatch, explanation(), log10=-2.0) is None


class TestNothingFound:
    def test_all_spots_are_looked_at_once_more_even_where_only_all_rods_were_sought(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        looked = []

        def second_look(_: object, rods: int, *__: object, **___: object) -> Iterator[Hypothesis]:
            looked.append(rods)
            return iter([])

        monkeypatch.setattr(LevelSearch, "hopeless", lambda _, rods: rods < 6)
        monkeypatch.setattr(LevelSearch, "level", lambda *_: iter([]))
        monkeypatch.setattr(LevelSearch, "second_look", second_look)
        found = ByLevels(frame()).match(problem())
        assert looked == [6]
        assert (found.hypotheses, found.least_rods, found.given_up) == ([], 6, "")

    def test_but_not_where_nothing_was_sought(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(LevelSearch, "hopeless", lambda *_: True)
        found = ByLevels(frame()).match(problem())
        assert (found.hypotheses, found.least_rods) == ([], 7)


def test_what_is_recognised_is_known_by_how_often_chance_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rival = replace(explanation(), translation=np.array([30.0, 0.0, 0.0]))
    monkeypatch.setattr(LevelSearch, "hopeless", lambda *_: False)
    monkeypatch.setattr(LevelSearch, "level", lambda *_: iter([explanation(), rival]))
    found = ByLevels(frame()).match_most(problem())
    assert found
    assert problem().decades_apart == 3.0
    assert np.isfinite([one.log10_false_alarms for one in found[:1]]).all()
