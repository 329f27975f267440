"""How a frame is chosen among the layouts of a search, and tried: with layouts and trials made by hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from joblib import parallel_config

from stereoreg_ros import PixelScale, RegistrationOptions
from stereoreg_ros.frames import design_search as search_module
from stereoreg_ros.frames.ambiguity import Trial
from stereoreg_ros.frames.design_search import Candidate, Requirements, search
from stereoreg_ros.frames.expected_error import Imaging
from stereoreg_ros.frames.layouts import Envelope, Layouts
from stereoreg_ros.frames.proposal import Proposal, propose
from stereoreg_ros.frames.slice_poses import SlicePoses
from stereoreg_ros.geometry.pose import Array

OPTIONS = RegistrationOptions(nominal_orientation=(1.0, 0.0, 0.0, 0.0), max_rotation_deg=20.0)
RIGHT, WRONG = Trial(None, "", True, ()), Trial(None, "", False, ())
AMBIGUOUS, REFUSED = Trial(None, "ambiguous", True, ()), Trial(None, "no_consensus", False, ())
# Shares of the faces: four leaning rods, far apart.
CORNERS = np.array([0.1, 0.1, 0.3, 0.1, 0.9, 0.1, 0.9, 0.4, 0.9, 0.9, 0.6, 0.9, 0.1, 0.9, 0.1, 0.5])


def requirements(target_mm: tuple[float, float, float] = (0.0, 100.0, 0.0)) -> Requirements:
    return Requirements(
        Envelope((60.0, 60.0, 60.0), 5.0), (1.0,) * 4, Imaging(PixelScale(0.5, 0.5), 0.3, 1.0), target_mm, 30.0, 15.0
    )


@dataclass
class Search:
    """The layouts of each search, one after the other, and what the trials of each frame come to."""

    candidates: list[list[Candidate]]
    outcomes: list[list[Trial]]
    seeds: list[int] = field(default_factory=list)
    poses: list[SlicePoses] = field(default_factory=list)
    left_out: list[Sequence[int | None]] = field(default_factory=list)

    def search(self, _wish: Requirements, seed: int, _chains: int, _tell: object) -> list[Candidate]:
        self.seeds.append(seed)
        return self.candidates[len(self.seeds) - 1]

    def trials(
        self, _frame: Any, poses: SlicePoses, _scale: Any, _options: Any, left_out: Sequence[int | None], _rng: Any
    ) -> Iterator[Trial]:
        self.poses.append(poses)
        self.left_out.append(left_out)
        yield from self.outcomes[len(self.poses) - 1]


def proposed(
    monkeypatch: pytest.MonkeyPatch,
    candidates: list[list[Candidate]],
    outcomes: list[list[Trial]],
    progress: Any = None,
) -> tuple[Proposal, Search]:
    made = Search(candidates, outcomes)
    monkeypatch.setattr("stereoreg_ros.frames.proposal.search", made.search)
    monkeypatch.setattr("stereoreg_ros.frames.proposal.trials", made.trials)
    return propose(requirements(), "mine", OPTIONS, 5, 1, progress), made


def candidate(moved: float = 0.0, interrupted: bool = False) -> Candidate:
    return Candidate(np.clip(CORNERS + moved, 0.0, 1.0), 0.5, interrupted)


class TestProposal:
    def test_it_is_tried_with_all_rods_and_each_missing_as_the_frame_stands(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        found, made = proposed(monkeypatch, [[candidate()]], [[RIGHT, REFUSED, RIGHT]])
        assert (found.ambiguous, found.tried, found.interrupted) == (0, 3, False)
        assert [list(one) for one in made.left_out] == [[None, 0, 1, 2, 3]]
        (poses,) = made.poses
        # Head down, and not turned by more than is allowed.
        assert (poses.rotations[:, 2, 2] < -np.cos(np.radians(20.0)) + 1e-9).all()
        assert (poses.rotations[:, 0, 0] > np.cos(np.radians(20.0)) - 1e-9).all()
        assert -15 <= poses.heights_mm.min() < -14
        assert 14 < poses.heights_mm.max() <= 15

    def test_its_ends_are_rounded_and_its_error_is_that_of_the_rounded_ones(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        found, _ = proposed(monkeypatch, [[candidate(0.0007)]], [[RIGHT]])
        assert found.frame.name == "mine"
        exact = requirements().envelope.layouts((CORNERS + 0.0007)[None], (1.0,) * 4)
        np.testing.assert_allclose(found.frame.starts, np.round(exact.starts[0], 1))
        np.testing.assert_allclose(found.frame.ends, np.round(exact.ends[0], 1))
        assert found.target_error_95_mm == pytest.approx(
            requirements().target_errors(Layouts.of(found.frame))[0], rel=1e-12
        )
        assert found.target_error_95_mm != pytest.approx(requirements().target_errors(exact)[0], rel=1e-6)

    @pytest.mark.parametrize("bad", [AMBIGUOUS, WRONG])
    def test_one_that_is_ambiguous_or_accepted_with_a_wrong_rod_gives_way_to_the_next(
        self, monkeypatch: pytest.MonkeyPatch, bad: Trial
    ) -> None:
        found, made = proposed(monkeypatch, [[candidate(), candidate(0.05)]], [[RIGHT, bad, RIGHT], [RIGHT] * 3])
        assert (found.ambiguous, found.tried) == (0, 3)
        np.testing.assert_allclose(found.frame.starts[0, 0], round((0.15 - 0.5) * 59, 1))
        assert made.seeds == [5]

    def test_where_all_are_ambiguous_it_is_the_one_that_was_so_latest_of_three_searches(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        outcomes = [[RIGHT, AMBIGUOUS], [RIGHT, RIGHT, RIGHT, WRONG, RIGHT], [RIGHT, RIGHT, AMBIGUOUS]]
        candidates = [[candidate()], [candidate(0.05)], [candidate(0.02)]]
        found, made = proposed(monkeypatch, candidates, outcomes)
        assert (found.ambiguous, found.tried) == (1, 4)
        np.testing.assert_allclose(found.frame.starts[0, 0], round((0.15 - 0.5) * 59, 1))
        assert made.seeds == [5, 6, 7]

    def test_an_interruption_is_reported_whenever_it_comes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found, _ = proposed(monkeypatch, [[candidate(interrupted=True)]], [])
        assert (found.interrupted, found.tried) == (True, 0)
        found, _ = proposed(monkeypatch, [[candidate()]], [[RIGHT] * 9], lambda *step: step[0] == "searching")
        assert (found.interrupted, found.tried, found.ambiguous) == (True, 1, 0)
        # One that was tried to its end is better than one that was not tried at all.
        found, _ = proposed(monkeypatch, [[candidate()], [candidate(0.05, True)]], [[RIGHT, AMBIGUOUS]])
        assert (found.interrupted, found.ambiguous, found.tried) == (False, 1, 2)


def upright(distance_mm: float) -> Array:
    """Four upright rods, the first two so far apart from axis to axis, the others farther."""
    x = np.array([0.0, distance_mm / 59, 0.9, 0.5])
    y = np.array([0.5, 0.5, 0.5, 1.0])
    corners: Array = np.stack([x, y, x, y], axis=-1).ravel()
    return corners


class TestSearch:
    def test_rods_keep_their_gap_when_their_ends_are_rounded(self) -> None:
        """5 mm and what rounding may take, between rods of 1 mm."""
        can = requirements().can_be_built(np.array([upright(distance) for distance in (5.9, 6.1, 6.2)]))
        assert can.tolist() == [False, False, True]

    def test_what_is_too_near_costs_by_its_square(self) -> None:
        costs, errors = (
            np.array([f(one) for one in (upright(4.0), upright(7.0))])
            for f in (
                lambda corners: requirements().costs(corners[None])[0],
                lambda corners: requirements().target_errors(
                    requirements().envelope.layouts(corners[None], (1.0,) * 4)
                )[0],
            )
        )
        np.testing.assert_allclose(costs - errors, [2.2**2, 0.0], atol=1e-9)

    def test_the_error_is_that_of_the_target(self) -> None:
        layouts = requirements().envelope.layouts(CORNERS[None], (1.0,) * 4)
        near, far = (requirements(target).target_errors(layouts)[0] for target in ((0.0, 0.0, 0.0), (0.0, 300.0, 0.0)))
        assert far > 2 * near

    def test_the_best_that_can_be_built_comes_first(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Whatever the chains say of it."""
        others = np.random.default_rng(3).permuted(np.tile(CORNERS, (3, 1)), axis=1)
        found = {0: (CORNERS, 9.0), 1: (upright(4.0), 0.0), 2: (others[0], 0.0)}
        monkeypatch.setattr(search_module, "_chain", lambda _wish, seed: found[seed.spawn_key[-1]])
        with parallel_config(backend="sequential"):
            candidates = search(requirements(), seed=1, chains=3)
        errors = [one.target_error_95_mm for one in candidates]
        assert errors == sorted(errors)
        layouts = requirements().envelope.layouts(np.array([one.corners for one in candidates]), (1.0,) * 4)
        np.testing.assert_allclose(requirements().target_errors(layouts), errors)
        assert requirements().can_be_built(np.array([one.corners for one in candidates])).all()
        assert any((one.corners == CORNERS).all() for one in candidates)
        assert not any(one.interrupted for one in candidates)
