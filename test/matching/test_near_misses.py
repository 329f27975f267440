"""Rods without a spot and spots without a rod: what must show, what speaks against a pose, and which rivals remain."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.geometry.projection import cut
from stereoreg_ros.geometry.visibility import may_show, must_show
from stereoreg_ros.matching import consensus
from stereoreg_ros.matching.consensus import MISSING_COST, count_missing, evidence, judged, near_misses
from stereoreg_ros.matching.hypothesis import UNMATCHED, Hypothesis
from stereoreg_ros.matching.prior import Prior
from stereoreg_ros.matching.problem import Problem
from stereoreg_ros.matching.spots import Spots
from stereoreg_ros.matching.tolerances import Tolerances

AREA_MM2 = 10_000.0
# By which each rod leans: mm along x and y for one of height. The slice is z = 0 of the frame.
SLOPES = np.array([[0.0, 0.1], [0.1, 0.0], [0.0, -0.1], [0.4, 0.3], [-0.1, 0.05], [0.05, 0.2]])
PLACES = np.array([[0.0, 0.0], [60.0, 0.0], [0.0, 60.0], [60.0, 70.0], [30.0, 35.0], [80.0, 40.0]])
LOW_MM, HIGH_MM = -20.0, 30.0


def frame(slopes: Array = SLOPES, places: Array = PLACES, high_mm: ArrayLike = HIGH_MM) -> Frame:
    """Rods cut at these places, from 20 mm below the slice to 30 mm above it unless told otherwise."""
    directions = np.column_stack([slopes, np.ones(len(slopes))])
    middles = np.column_stack([places, np.zeros(len(places))])
    high = np.broadcast_to(np.asarray(high_mm, dtype=np.float64), len(slopes))[:, None]
    return Frame("six", tuple("abcdef"), middles + LOW_MM * directions, middles + high * directions, np.ones(6))


def spots(points_mm: ArrayLike) -> Spots:
    points = np.asarray(points_mm, dtype=np.float64)
    return Spots.of(points, np.tile(0.04 * np.eye(2), (len(points), 1, 1)), AREA_MM2, Tolerances.none(frame()))


def explanation(spot_of_line: list[int], chi_square: float = 1.0, information: Array | None = None) -> Hypothesis:
    given = np.eye(6) if information is None else information
    return Hypothesis(np.eye(3), np.zeros(3), np.array(spot_of_line), chi_square, given, 0)


class TestVisibility:
    """Beyond its end a rod may show for a millimetre, and must two millimetres before it."""

    @pytest.mark.parametrize(
        ("end_mm", "may", "must"), [(-1.1, False, False), (-0.9, True, False), (1.9, True, False), (2.1, True, True)]
    )
    @pytest.mark.parametrize("is_lower", [True, False])
    def test_near_an_end(self, end_mm: float, may: bool, must: bool, is_lower: bool) -> None:
        """end_mm: how far along the rod its end is beyond the slice."""
        direction = np.array([0.6, 0.0, 0.8])
        starts, ends = np.tile([0.0, 0, -50], (3, 1)), np.tile([0.0, 0, 50], (3, 1))
        starts[1:, 0] = ends[1:, 0] = [20.0, 40.0]
        starts[0] = -(end_mm if is_lower else 50.0) * direction
        ends[0] = (50.0 if is_lower else end_mm) * direction
        rods = Frame("three", tuple("abc"), starts, ends, np.ones(3))
        cuts = cut(rods, np.eye(3), np.zeros(3))
        assert bool(may_show(rods, cuts)[0]) is may
        assert bool(must_show(rods, cuts)[0]) is must

    def test_which_end_is_called_the_first_does_not_matter(self) -> None:
        rods = frame()
        turned = replace(rods, starts=rods.ends, ends=rods.starts)
        cuts = cut(turned, np.eye(3), np.zeros(3))
        np.testing.assert_allclose(cuts.points_mm, PLACES, atol=1e-12)
        assert cuts.inside.all()
        assert may_show(turned, cuts).all()
        assert must_show(turned, cuts).all()

    @pytest.mark.parametrize(("degrees", "shows"), [(11.6, True), (11.4, False)])
    def test_near_the_slice(self, degrees: float, shows: bool) -> None:
        slopes = SLOPES.copy()
        slopes[3] = [1 / math.tan(math.radians(degrees)), 0.0]
        rods = frame(slopes)
        cuts = cut(rods, np.eye(3), np.zeros(3))
        assert bool(may_show(rods, cuts)[3]) is bool(must_show(rods, cuts)[3]) is shows


class TestMissing:
    def test_counts_rods_that_must_show_among_the_spots_and_have_none(self) -> None:
        rods = frame(high_mm=[30, 30, 1.5, 30, 30, 30])
        cuts = cut(rods, np.eye(3), np.zeros(3))
        # The box of the spots is from 0 to 60 along x and from 0 to 70 along y: the last rod is 20 mm outside it.
        seen = spots(PLACES[[0, 1, 2, 3]])
        for matched, missing in (([0, 1, 2, 3, -1, -1], 1), ([0, 1, -1, 3, -1, -1], 1), ([-1, 1, -1, 3, -1, -1], 2)):
            assert count_missing(seen, rods, cuts, np.array(matched)) == missing

    @pytest.mark.parametrize(("beyond_mm", "is_missing"), [(2.9, True), (3.1, False)])
    def test_the_image_goes_on_for_three_millimetres_beyond_the_spots(self, beyond_mm: float, is_missing: bool) -> None:
        for place in ([60 + beyond_mm, 35.0], [-beyond_mm, 35.0], [30.0, 70 + beyond_mm], [30.0, -beyond_mm]):
            places = PLACES.copy()
            places[4] = place
            rods = frame(places=places)
            cuts = cut(rods, np.eye(3), np.zeros(3))
            missing = count_missing(spots(PLACES[:4]), rods, cuts, np.array([0, 1, 2, 3, -1, -1]))
            assert missing == int(is_missing)


class TestGains:
    def test_are_the_spots_density_right_at_a_rod_over_that_of_clutter(self) -> None:
        """Nine spots of six rods: three and one more are clutter, in 10 000 mm^2."""
        points = np.concatenate([PLACES, [[10.0, 80.0], [20.0, 90.0], [90.0, 5.0]]])
        covariances = np.tile(0.04 * np.eye(2), (9, 1, 1))
        covariances[2] = [[0.09, 0.0], [0.0, 0.25]]
        given = Spots.of(points, covariances, AREA_MM2, Tolerances.none(frame()))
        assert given.clutter_density(frame()) == pytest.approx(4 / AREA_MM2)
        gains = given.gains(frame())
        assert gains[0] == pytest.approx(math.log(1 / (2 * math.pi * 0.04) / (4 / AREA_MM2)))
        assert gains[2] == pytest.approx(math.log(1 / (2 * math.pi * 0.3 * 0.5) / (4 / AREA_MM2)))
        # Of fewer spots than rods, one is reckoned with.
        assert given.only(np.arange(4)).clutter_density(frame()) == pytest.approx(1 / AREA_MM2)

    def test_where_the_slices_area_is_not_known_it_is_by_the_spots(self) -> None:
        covariances = np.tile(0.04 * np.eye(2), (6, 1, 1))
        given = Spots.of(PLACES, covariances, None, Tolerances.none(frame()))
        assert given.clutter_density(frame()) == pytest.approx(1 / (80 * 70 * (7 / 5) ** 2))


class TestNearMisses:
    FIVE = (0, 1, 2, UNMATCHED, 3, 4)
    MATCHED = PLACES[[0, 1, 2, 4, 5]]

    @staticmethod
    def density(away: ArrayLike, slope: Array, low_mm: float = LOW_MM, high_mm: float = HIGH_MM) -> float:
        """By hand: half a few millimetres off in any direction, half along the way of the rod's spot."""
        away = np.asarray(away, dtype=np.float64)
        anywhere = (1 + float(away @ away) / 8) ** -2 / (8 * math.pi)
        run = float(np.linalg.norm(slope))
        along = float(away @ slope) / run
        across = float(away[0] * slope[1] - away[1] * slope[0]) / run
        scale = math.hypot(2 * math.sqrt(2), 0.2 * along)
        beside = (1 + (across / scale) ** 2) ** -1.5 / (2 * scale)
        is_on_way = run * low_mm <= along <= run * high_mm
        on_its_way = beside / max(run * (high_mm - low_mm), scale) if is_on_way else 0.0
        return 0.5 * (anywhere + on_its_way)

    @pytest.mark.parametrize("away", [(1.0, 0.5), (-3.0, 1.0), (12.0, 7.0), (-8.0, -3.0), (3.0, 4.0)])
    def test_of_a_spot_beside_the_place_of_a_rod_that_has_none(self, away: tuple[float, float]) -> None:
        """The fourth rod leans by 0.5: its spot goes 10 mm to the one side and 15 mm to the other."""
        given = spots([*self.MATCHED, PLACES[3] + away])
        clutter = 1 / AREA_MM2
        expected = math.log(self.density(away, SLOPES[3]) / clutter) + MISSING_COST
        assert expected > 1
        found = near_misses(explanation(list(self.FIVE)), given, frame())
        assert found == pytest.approx(expected, rel=1e-9)

    @pytest.mark.parametrize("away_mm", [-10.5, 15.5])
    def test_beyond_the_ends_of_that_way_only_nearness_counts(self, away_mm: float) -> None:
        given = spots([*self.MATCHED, PLACES[3] + away_mm * np.array([0.8, 0.6])])
        anywhere = 0.5 * (1 + away_mm**2 / 8) ** -2 / (8 * math.pi)
        expected = max(math.log(anywhere * AREA_MM2) + MISSING_COST, 0.0)
        assert near_misses(explanation(list(self.FIVE)), given, frame()) == pytest.approx(expected, rel=1e-9)

    def test_of_an_upright_rod_there_is_no_way(self) -> None:
        """A spot far away is none of its own."""
        slopes = SLOPES.copy()
        slopes[3] = 0.0
        given = spots([*self.MATCHED, PLACES[3] + [-40.0, 25.0]])
        assert near_misses(explanation(list(self.FIVE)), given, frame(slopes)) == 0.0
        near = spots([*self.MATCHED, PLACES[3] + [1.0, 0.0]])
        expected = math.log(0.5 * (9 / 8) ** -2 / (8 * math.pi) * AREA_MM2) + MISSING_COST
        assert near_misses(explanation(list(self.FIVE)), near, frame(slopes)) == pytest.approx(expected, rel=1e-6)

    def test_of_a_rod_that_need_not_show_there_is_no_cost(self) -> None:
        """Cut a millimetre before its end: that it has no spot is nothing strange."""
        rods = frame(high_mm=[30, 30, 30, 1.0, 30, 30])
        given = spots([*self.MATCHED, PLACES[3] + [0.0, 1.0]])
        expected = math.log(self.density([0.0, 1.0], SLOPES[3], high_mm=1.0) * AREA_MM2)
        assert near_misses(explanation(list(self.FIVE)), given, rods) == pytest.approx(expected, rel=1e-9)

    def test_a_rod_that_the_slice_does_not_reach_misses_nothing(self) -> None:
        rods = frame(high_mm=[30, 30, 30, -5.0, 30, 30])
        given = spots([*self.MATCHED, PLACES[3] + [0.0, 1.0]])
        assert near_misses(explanation(list(self.FIVE)), given, rods) == 0.0

    def test_nothing_left_over_or_nothing_missing_is_no_near_miss(self) -> None:
        assert near_misses(explanation(list(self.FIVE)), spots(self.MATCHED), frame()) == 0.0
        given = spots([*PLACES, PLACES[3] + [1.0, 0.0]])
        assert near_misses(explanation([0, 1, 2, 3, 4, 5]), given, frame()) == 0.0

    def test_those_of_two_rods_add_up(self) -> None:
        four = [0, 1, UNMATCHED, UNMATCHED, 2, 3]
        away = np.array([[0.5, -1.0], [1.0, 2.0]])
        given = spots([*PLACES[[0, 1, 4, 5]], PLACES[2] + away[0], PLACES[3] + away[1]])
        expected = sum(
            math.log(self.density(one, SLOPES[rod]) * AREA_MM2) + MISSING_COST
            for rod, one in zip((2, 3), away, strict=True)
        )
        assert near_misses(explanation(four), given, frame()) == pytest.approx(expected, rel=1e-9)

    @pytest.mark.parametrize(("apart_mm", "counts"), [(4.9, True), (5.1, False)])
    def test_a_rod_may_have_the_spot_of_another_one_that_is_cut_beside_it(self, apart_mm: float, counts: bool) -> None:
        """And the spot that is left over be that other rod's."""
        places = PLACES.copy()
        places[3] = places[4] + [0.0, apart_mm]
        rods = frame(places=places)
        # Beside the fifth rod's place, on the side away from the fourth.
        away = np.array([0.0, -6.0])
        given = spots([*places[[0, 1, 2, 4, 5]], places[4] + away])
        of_other = math.log(self.density(away, SLOPES[4]) * AREA_MM2) + MISSING_COST
        of_own = math.log(self.density(away - [0.0, apart_mm], SLOPES[3]) * AREA_MM2) + MISSING_COST
        assert of_other > of_own + 0.1
        expected = max(of_other if counts else of_own, 0.0)
        assert near_misses(explanation(list(self.FIVE)), given, rods) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("allowed", "apart"), [(-6.0, 3.0), (-2.5, 1.25), (-1.0, 1.0), (0.0, 1.0)])
def test_poses_are_told_apart_by_half_the_decades_by_which_chance_is_ruled_out(allowed: float, apart: float) -> None:
    assert Problem(spots(PLACES), frame(), Prior(np.eye(3), 1.0), 4, allowed).decades_apart == apart


class TestRivals:
    """Which explanations the best one does not rule out, by their evidence and by chance."""

    PRIOR = Prior(np.eye(3), math.pi)
    SIX, FIVE = [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, UNMATCHED]
    APART = 3.0

    def rivals(
        self, monkeypatch: pytest.MonkeyPatch, best: Hypothesis, others: dict[Hypothesis, float]
    ) -> list[Hypothesis]:
        """By their poses; the best one's log10 of false alarms is -9, those of the others are given."""
        by_pose = {id(one.translation): log10 for one, log10 in others.items()} | {id(best.translation): -9.0}
        monkeypatch.setattr(consensus, "log10_false_alarms", lambda one, *_, **__: by_pose[id(one.translation)])
        found = judged([best, *others], self.spots, frame(), self.PRIOR, self.APART)
        assert found[0].log10_false_alarms == -9.0
        kept = {id(one.translation) for one in found[1:]}
        assert [one.log10_false_alarms for one in found[1:]] == [
            log10 for one, log10 in others.items() if id(one.translation) in kept
        ]
        return [one for one in others if id(one.translation) in kept]

    @property
    def spots(self) -> Spots:
        return spots([*PLACES, [10.0, 80.0], [25.0, 90.0], [90.0, 5.0]])

    def behind(self, decades: float) -> Hypothesis:
        """Of all six rods too, and so much less likely than the best one."""
        one = explanation(self.SIX, 1.0 + 2 * decades * math.log(10))
        assert evidence(one, np.zeros(9)) == pytest.approx(
            evidence(explanation(self.SIX), np.zeros(9)) - decades * math.log(10)
        )
        return one

    def test_of_as_many_rods_by_evidence_alone(self, monkeypatch: pytest.MonkeyPatch) -> None:
        near, far = self.behind(0.99 * self.APART), self.behind(1.01 * self.APART)
        assert self.rivals(monkeypatch, explanation(self.SIX), {near: 5.0, far: -9.0}) == [near]

    def test_of_fewer_rods_by_chance_as_well(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """So well known a pose that evidence makes up for the spot less."""
        wide = 1e-3 * np.eye(6)
        rare, common = (explanation(self.FIVE, 1.0, wide) for _ in range(2))
        others = {rare: -9.0 + 0.99 * self.APART, common: -9.0 + 1.01 * self.APART}
        assert self.rivals(monkeypatch, explanation(self.SIX), others) == [rare]

    @pytest.mark.parametrize(("times", "is_rival"), [(1.0, False), (10.0, True)])
    def test_spots_in_order_with_false_ones_say_less(
        self, monkeypatch: pytest.MonkeyPatch, times: float, is_rival: bool
    ) -> None:
        """So many times as dense, by which each counts less: of the best one's six spots the rival has five."""
        another = explanation([0, 1, 2, 3, 4, 6], 1.0 + 2 * 3.5 * math.log(10))
        dense = np.full(6, 0.5)
        monkeypatch.setattr(consensus, "_densities", lambda *_, in_order=True: times * dense if in_order else dense)
        found = self.rivals(monkeypatch, explanation(self.SIX), {another: 5.0})
        assert found == ([another] if is_rival else [])

    def test_nothing_found_has_no_rivals(self) -> None:
        assert judged([], self.spots, frame(), self.PRIOR, self.APART) == []

    def test_the_best_one_bears_what_speaks_against_it(self) -> None:
        """Here it is that a spot lies beside the place of the last rod."""
        given = spots([*PLACES[:5], PLACES[5] + [1.0, 0.5]])
        (found,) = judged([explanation(self.FIVE)], given, frame(), self.PRIOR, self.APART)
        bare = replace(found, near_misses=0.0)
        assert found.near_misses == near_misses(bare, given, frame())
        assert found.near_misses > 3.0
        assert math.isfinite(found.log10_false_alarms)
