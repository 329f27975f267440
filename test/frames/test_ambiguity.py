"""Trials for ambiguous poses, with answers made by hand: what the registration is given, and how it is judged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereoreg_ros import PixelScale, Refusal, Registration, RegistrationOptions, load_frame
from stereoreg_ros.frames.ambiguity import Trial, reasons, trials
from stereoreg_ros.frames.slice_poses import MIDDLE_MM, SlicePoses
from stereoreg_ros.geometry.pose import Array, Pose, rotation_exp
from stereoreg_ros.geometry.projection import project
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.result import Match, PoseEstimate, Reason

FRAME = load_frame("cube6")
SCALE = PixelScale(0.4, 0.7)
PERFECT = RegistrationOptions(spot_noise_px=0.001, frame_tolerance_mm=0.0, scale_tolerance=0.0)
TURN = rotation_exp(np.array([0.1, -0.05, 0.4]))
TRUTH = Pose(TURN, np.array([*MIDDLE_MM, 2.0]))


def meeting(count: int = 1) -> SlicePoses:
    nothing = np.zeros(count)
    return SlicePoses(np.tile(TRUTH.rotation, (count, 1, 1)), np.tile(TRUTH.translation, (count, 1)), nothing, nothing)


class Registering:
    """Stands in for the registration; each answer is made of the rods that are put to the spots, in their order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *put: Sequence[int], refused: Reason | None = None) -> None:
        self.spots_px: list[Array] = []
        self.area_mm2 = 0.0
        self._put, self._refused = put, refused
        self.pose = TRUTH
        monkeypatch.setattr("stereoreg_ros.frames.ambiguity.register_spots", self._register)

    def _register(self, spots_px: Array, *_: object, slice_area_mm2: float) -> Registration | Refusal:
        self.spots_px.append(spots_px)
        self.area_mm2 = slice_area_mm2
        estimates = tuple(self._estimate(put) for put in self._put)
        if self._refused is not None:
            return Refusal(FRAME, SliceSpots(spots_px, SCALE), self._refused, "refused", estimates)
        return Registration(FRAME, SliceSpots(spots_px, SCALE), PERFECT, estimates[0])

    def _estimate(self, put: Sequence[int]) -> PoseEstimate:
        # Matches come in the order of the rods, not of the spots.
        matches = sorted((line, spot) for spot, line in enumerate(put))
        made = (Match(FRAME.line_names[line], line, spot, np.zeros(2), np.zeros(2), 0.0) for line, spot in matches)
        return PoseEstimate(self.pose, self.pose, np.eye(6), tuple(made), 0.0, -9.0)


def tried(options: RegistrationOptions = PERFECT, out: int | None = None, count: int = 1) -> list[Trial]:
    return list(trials(FRAME, meeting(count), SCALE, options, [out], np.random.default_rng(0)))


@pytest.mark.parametrize("out", [None, 0, 2, 5])
def test_the_spots_are_those_of_all_rods_but_the_one_that_is_left_out(
    monkeypatch: pytest.MonkeyPatch, out: int | None
) -> None:
    put = [row for row in range(6) if row != out]
    registering = Registering(monkeypatch, put)
    (trial,) = tried(out=out)
    np.testing.assert_allclose(registering.spots_px[0], project(FRAME, TRUTH, SCALE)[0][put], atol=0.01)
    assert registering.area_mm2 == pytest.approx(512 * 512 * 0.4 * 0.7)
    assert (trial.left_out, trial.reason, trial.right, trial.twins) == (out, "", True, ())


def test_the_spots_have_the_stated_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    registering = Registering(monkeypatch, range(6))
    tried(replace(PERFECT, spot_noise_px=0.4), count=300)
    off = np.array(registering.spots_px) - project(FRAME, TRUTH, SCALE)[0]
    np.testing.assert_allclose(off.std(axis=(0, 1)), 0.4, rtol=0.06)


def test_an_accepted_pose_that_exchanges_two_rods_is_wrong_and_a_twin_with_what_it_puts_where(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    registering = Registering(monkeypatch, [1, 0, 2, 4, 5])
    turn = rotation_exp(np.array([0.0, 0.0, math.radians(10.0)]))
    registering.pose = Pose(turn @ TRUTH.rotation, TRUTH.translation + np.array([3.0, 4.0, 0.0]))
    (trial,) = tried(out=3)
    assert (trial.left_out, trial.reason, trial.right) == (3, "", False)
    ((exchange, angle_deg, distance_mm),) = trial.twins
    assert exchange == "a,b,c,e,f -> b,a,c,e,f"
    assert (angle_deg, distance_mm) == pytest.approx((10.0, 5.0))


def test_of_a_refused_slice_the_best_explanation_counts_and_every_other_is_a_twin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Registering(monkeypatch, range(6), [1, 2, 3, 4, 5, 0], refused="ambiguous")
    (trial,) = tried()
    assert (trial.reason, trial.right) == ("ambiguous", True)
    assert [exchange for exchange, *_ in trial.twins] == ["a,b,c,d,e,f -> b,c,d,e,f,a"]
    Registering(monkeypatch, [1, 2, 3, 4, 5, 0], range(6), refused="ambiguous")
    assert not tried()[0].right
    Registering(monkeypatch, refused="no_consensus")
    (trial,) = tried()
    assert (trial.reason, trial.right, trial.twins) == ("no_consensus", False, ())


def test_outcomes_are_counted_by_their_reasons() -> None:
    made: Any = [Trial(None, reason, True, ()) for reason in ("", "ambiguous", "", "no_consensus", "")]
    assert reasons(made) == {"accepted": 3, "ambiguous": 1, "no_consensus": 1}
