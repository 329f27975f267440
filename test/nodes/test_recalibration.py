"""One call of recalibration by itself: when it measures, from which slices, and when it answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereoreg_ros.calibration.calibrate import Calibration, CalibrationRefusal
from stereoreg_ros.geometry.frame_file import load_frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.nodes.register import recalibration
from stereoreg_ros.nodes.register.recalibration import Recalibration
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions

DEADLINE_S = 100.0
SCALE = PixelScale(0.5, 0.6, 0.01)
ONE, TWO, THREE = (SliceSpots(np.full((6, 2), float(k)), SCALE) for k in range(3))
MEASURED = Calibration(SCALE, SCALE, (0.0, 0.0), np.zeros((2, 2)), (0.0, 0.0), 1, 6, 0.0, 0.0, (), "measured")


class Measuring:
    """Stands for `calibrate`: notes what it was called with, and answers as it is told."""

    def __init__(self) -> None:
        self.calls: list[tuple[tuple[SliceSpots, ...], tuple[Any, ...]]] = []
        self.answers: list[Calibration | CalibrationRefusal | Exception] = []
        self.progress: Callable[[float], bool] | None = None

    def __call__(
        self, sightings: Sequence[SliceSpots], *told: Any, progress: Callable[[float], bool]
    ) -> Calibration | CalibrationRefusal:
        self.calls.append((tuple(sightings), told))
        self.progress = progress
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture
def measuring(monkeypatch: pytest.MonkeyPatch) -> Measuring:
    stand_in = Measuring()
    monkeypatch.setattr(recalibration, "calibrate", stand_in)
    return stand_in


def begun(options: RegistrationOptions | None = None, calibration: CalibrationOptions | None = None) -> Recalibration:
    return Recalibration(
        load_frame("cube6"), SCALE, options or RegistrationOptions(), calibration or CalibrationOptions(), DEADLINE_S
    )


def after_the_attempt(
    running: Recalibration, sightings: Sequence[SliceSpots], now_s: float
) -> Calibration | CalibrationRefusal | None:
    """What it answers once the measurement that it has begun is done."""
    assert running._attempt is not None
    running._attempt.exception(timeout=20.0)
    return running.poll(sightings, now_s)


def test_is_told_all_that_the_node_was(measuring: Measuring) -> None:
    options, calibration = RegistrationOptions(spot_noise_px=0.7), CalibrationOptions(calibrate_shear=True)
    running = begun(options, calibration)
    measuring.answers = [MEASURED]
    assert running.poll([ONE, TWO], 0.0) is None
    assert after_the_attempt(running, [ONE, TWO], 0.0) is MEASURED
    assert measuring.calls == [((ONE, TWO), (running.frame, SCALE, options, calibration))]


def test_without_slices_it_waits_until_the_deadline(measuring: Measuring) -> None:
    running = begun()
    assert running.poll([], DEADLINE_S - 0.1) is None
    refusal = running.poll([], DEADLINE_S)
    assert isinstance(refusal, CalibrationRefusal)
    assert "no slice has been accepted yet" in refusal.message
    assert measuring.calls == []


def test_tries_again_with_other_slices_however_many_they_are(measuring: Measuring) -> None:
    """Of a full window one is gone for each that comes."""
    running = begun()
    measuring.answers = [CalibrationRefusal("too few"), CalibrationRefusal("still too few"), MEASURED]
    assert running.poll([ONE, TWO], 0.0) is None
    assert after_the_attempt(running, [TWO, THREE], 0.0) is None
    assert after_the_attempt(running, [TWO, THREE], 0.0) is None
    # Nothing new: not tried once more, and not answered before the deadline.
    assert running.poll([TWO, THREE], DEADLINE_S - 1) is None
    assert [sightings for sightings, _ in measuring.calls] == [(ONE, TWO), (TWO, THREE)]
    assert running.poll([ONE], DEADLINE_S + 1) is None
    assert after_the_attempt(running, [ONE], DEADLINE_S + 1) is MEASURED


def test_the_last_refusal_is_the_answer(measuring: Measuring) -> None:
    running = begun()
    measuring.answers = [CalibrationRefusal("first"), CalibrationRefusal("second")]
    assert running.poll([ONE], 0.0) is None
    assert after_the_attempt(running, [TWO], 0.0) is None
    outcome = after_the_attempt(running, [TWO], DEADLINE_S)
    assert isinstance(outcome, CalibrationRefusal)
    assert outcome.message == "second"


def test_a_search_ends_where_nobody_waits_or_it_takes_too_long(
    measuring: Measuring, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 1000.0
    monkeypatch.setattr(recalibration, "time", SimpleNamespace(monotonic=lambda: now_s))
    running = begun()
    measuring.answers = [MEASURED]
    running.poll([ONE], 0.0)
    after_the_attempt(running, [ONE], 0.0)
    assert measuring.progress is not None
    assert measuring.progress(0.5)
    now_s += recalibration.SEARCH_S - 1
    assert measuring.progress(0.5)
    now_s += 2
    assert not measuring.progress(0.5)
    now_s = 1000.0
    assert measuring.progress(0.5)
    running.close()
    assert not measuring.progress(0.5)


def test_an_error_is_that_of_whoever_polls(measuring: Measuring) -> None:
    running = begun()
    measuring.answers = [RuntimeError("out of luck")]
    running.poll([ONE], 0.0)
    with pytest.raises(RuntimeError, match="out of luck"):
        after_the_attempt(running, [ONE], 0.0)
