"""One call of `~/recalibrate`: measures in a thread of its own, as often as new slices make it worth trying."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Final

from stereoreg_ros.calibration.calibrate import Calibration, CalibrationRefusal, calibrate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.geometry.spots import SliceSpots
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions

# Longest search for the scale, seconds; without it slices full of false spots would be searched for minutes.
SEARCH_S: Final = 60.0


class Recalibration:
    """Polled until it has an outcome; the slices that come meanwhile are registered as ever."""

    def __init__(
        self,
        frame: Frame,
        scale: PixelScale,
        options: RegistrationOptions,
        calibration: CalibrationOptions,
        deadline_s: float,
    ) -> None:
        """deadline_s: monotonic time until which slices are waited for."""
        self.frame, self.scale = frame, scale
        self._options, self._calibration, self._deadline_s = options, calibration, deadline_s
        self._closed = False
        self._attempt: Future[Calibration | CalibrationRefusal] | None = None
        self._refusal = CalibrationRefusal("no slice has been accepted yet, nothing to calibrate from")
        # Held, so that a later slice cannot be mistaken for one of these.
        self._tried: tuple[SliceSpots, ...] = ()

    def poll(self, sightings: Sequence[SliceSpots], now_s: float) -> Calibration | CalibrationRefusal | None:
        """The outcome, or None where it is not there yet. sightings: the last slices; now_s: monotonic time."""
        if self._attempt is not None:
            if not self._attempt.done():
                return None
            outcome, self._attempt = self._attempt.result(), None
            if isinstance(outcome, Calibration):
                return outcome
            self._refusal = outcome
        at_hand = tuple(sightings)
        if at_hand and at_hand != self._tried:
            self._tried = at_hand
            self._attempt = Future()
            # A daemon, so that the node's end does not wait for it.
            threading.Thread(target=self._measure, args=(at_hand, self._attempt), daemon=True).start()
            return None
        return self._refusal if now_s >= self._deadline_s else None

    @property
    def is_measuring(self) -> bool:
        """Whether its thread is at work."""
        return self._attempt is not None and not self._attempt.done()

    def close(self) -> None:
        """Have a measurement that goes on end early; nobody waits for it."""
        self._closed = True

    def _measure(self, sightings: Sequence[SliceSpots], attempt: Future[Calibration | CalibrationRefusal]) -> None:
        give_up_s = time.monotonic() + SEARCH_S

        def go_on(_share: float) -> bool:
            return not self._closed and time.monotonic() < give_up_s

        try:
            attempt.set_result(
                calibrate(sightings, self.frame, self.scale, self._options, self._calibration, progress=go_on)
            )
        except Exception as error:  # handed to whoever polls
            attempt.set_exception(error)
