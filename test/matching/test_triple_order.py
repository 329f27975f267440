"""The order of triples covers what it says it covers."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame, shipped_frames
from stereoreg_ros.matching.triple_order import RankedTriple, further_triples, triple_order
from support.frames import random_frame

MIN_INLIERS = 4


def check_covering(n: int, order: tuple[RankedTriple, ...], usable: set[tuple[int, int, int]]) -> None:
    """For each k, once complete_from says k, every k rods that hold a usable triple hold one of those tried."""
    levels = [entry.complete_from for entry in order]
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] == MIN_INLIERS
    assert len({entry.lines for entry in order}) == len(order)
    for k in range(MIN_INLIERS, n + 1):
        tried = [set(entry.lines) for entry in order[: 1 + next(i for i, level in enumerate(levels) if level <= k)]]
        for rods in combinations(range(n), k):
            if any(triple in usable for triple in combinations(rods, 3)):
                assert any(triple <= set(rods) for triple in tried), (k, rods)


def flat_or_parallel(frame: Frame, triple: tuple[int, int, int]) -> bool:
    """Whether three rods lie in one plane or are all parallel."""
    rows = list(triple)
    directions = frame.directions[rows]
    offsets = frame.starts[rows] - frame.starts[rows[0]]
    in_plane = np.linalg.matrix_rank(np.vstack([directions, offsets]), tol=1e-6) < 3
    return bool(in_plane or np.linalg.matrix_rank(directions, tol=1e-6) < 2)


@pytest.mark.parametrize("n", [4, 5, 6, 7, 8, 9])
def test_covers_random_frames(n: int) -> None:
    frame = random_frame(np.random.default_rng(n), n)
    order = triple_order(frame, MIN_INLIERS)
    # Of generic rods every triple is usable, but for those no slice cuts well: these must be few.
    check_covering(n, order, {entry.lines for entry in order})
    covered = [any(set(entry.lines) <= set(rods) for entry in order) for rods in combinations(range(n), MIN_INLIERS)]
    assert all(covered)


@pytest.mark.parametrize("name", sorted(shipped_frames()))
def test_covers_shipped_frames(name: str) -> None:
    frame = load_frame(name)
    n = len(frame)
    order = triple_order(frame, MIN_INLIERS)
    usable = {triple for triple in combinations(range(n), 3) if not flat_or_parallel(frame, triple)}
    assert {entry.lines for entry in order} <= usable
    check_covering(n, order, usable)


def test_coplanar_and_parallel_triples_are_not_used() -> None:
    frame = load_frame("leksell_ct")
    used = {entry.lines for entry in triple_order(frame, MIN_INLIERS)}
    assert (0, 1, 2) not in used
    assert (3, 4, 5) not in used
    assert (0, 2, 3) not in used
    assert used


def test_parallel_rods_are_not_used_together() -> None:
    starts = np.array([[0, 0, -30], [40, 0, -30], [0, 30, -30], [-30, -30, -30], [20, 20, -30]], dtype=float)
    ends = starts + np.array([0.0, 0.0, 60.0])
    ends[3:, :2] += [[20, 5], [-15, 10]]
    used = {entry.lines for entry in triple_order(Frame("mixed", tuple("abcde"), starts, ends, np.ones(5)), 4)}
    assert (0, 1, 2) not in used
    assert used


@pytest.mark.parametrize("n", [6, 9])
def test_the_first_triple_covers_the_whole_frame_and_few_cover_one_less(n: int) -> None:
    order = triple_order(random_frame(np.random.default_rng(50 + n), n), MIN_INLIERS)
    assert order[0].complete_from <= n
    # Two triples without a common rod hold out against any one missing rod.
    assert next(i for i, entry in enumerate(order) if entry.complete_from <= n - 1) == 1


def test_stops_at_the_fewest_rods_asked_for() -> None:
    frame = random_frame(np.random.default_rng(60), 8)
    short, long = triple_order(frame, 6), triple_order(frame, MIN_INLIERS)
    assert short[-1].complete_from == 6
    assert len(short) < len(long)
    assert [entry.lines for entry in long[: len(short)]] == [entry.lines for entry in short]


def test_more_rods_than_subsets_can_be_counted_for() -> None:
    rng = np.random.default_rng(61)
    starts = np.column_stack([rng.uniform(-30, 30, (20, 2)), np.full(20, -30.0)])
    ends = np.column_stack([rng.uniform(-30, 30, (20, 2)), np.full(20, 30.0)])
    frame = Frame("many", tuple(f"r{i}" for i in range(20)), starts, ends, np.ones(20))
    order = triple_order(frame, MIN_INLIERS)
    levels = [entry.complete_from for entry in order]
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] == MIN_INLIERS
    assert len({entry.lines for entry in order}) == len(order)


def test_is_the_same_every_time() -> None:
    one, other = (random_frame(np.random.default_rng(70), 7) for _ in range(2))
    assert one is not other
    assert triple_order(one, MIN_INLIERS) == triple_order(other, MIN_INLIERS)
    assert triple_order.__wrapped__(one, MIN_INLIERS) == triple_order(one, MIN_INLIERS)


def tried_for(frame: Frame, rods: int) -> list[tuple[int, int, int]]:
    """The triples that `triple_order` has tried once every set of that many rods holds one."""
    order = triple_order(frame, MIN_INLIERS)
    return [
        entry.lines for entry in order[: 1 + next(i for i, entry in enumerate(order) if entry.complete_from <= rods)]
    ]


class TestFurtherTriples:
    """A second look: every set of rods holds as many tried triples as it should, and no triple is tried in vain."""

    @pytest.mark.parametrize("rods", [4, 5, 6])
    @pytest.mark.parametrize("looks", [2, 3])
    def test_every_set_holds_as_many_as_asked_for(self, rods: int, looks: int) -> None:
        frame = random_frame(np.random.default_rng(80), 7)
        first, further = tried_for(frame, rods), further_triples(frame, MIN_INLIERS, rods, looks)
        assert not set(first) & set(further)
        assert len(set(further)) == len(further)
        held = dict.fromkeys((frozenset(one) for one in combinations(range(7), rods)), 0)
        for number, triple in enumerate([*first, *further]):
            holding = [one for one in held if set(triple) <= one]
            assert number < len(first) or any(held[one] < looks for one in holding), f"{triple} serves no set"
            for one in holding:
                held[one] += 1
        assert min(held.values()) >= looks

    def test_one_look_is_what_the_order_itself_gives(self) -> None:
        for rods in (4, 5, 6, 7):
            assert further_triples(random_frame(np.random.default_rng(81), 7), MIN_INLIERS, rods, 1) == ()

    def test_more_looks_than_there_are_triples_are_all_of_them(self) -> None:
        frame = random_frame(np.random.default_rng(82), 5)
        every = {*tried_for(frame, 4), *further_triples(frame, MIN_INLIERS, 4, 100)}
        assert every == set(combinations(range(5), 3))

    def test_of_more_rods_than_there_are_none(self) -> None:
        assert further_triples(random_frame(np.random.default_rng(83), 5), MIN_INLIERS, 6, 2) == ()
