"""One call of `~/recalibrate`: measures in a thread of its own, as often as new slices make it worth trying."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from stereoreg_ros.calibration import Calibration, CalibrationRefusal, Sighting, calibrate
from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.options import CalibrationOptions, RegistrationOptions


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
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="recalibration")
        self._attempt: Future[Calibration | CalibrationRefusal] | None = None
        self._refusal = CalibrationRefusal("no slice has been accepted yet, nothing to calibrate from")
        # Held, so that a later slice cannot be mistaken for one of these.
        self._tried: tuple[Sighting, ...] = ()

    def poll(self, sightings: Sequence[Sighting], now_s: float) -> Calibration | CalibrationRefusal | None:
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
            self._attempt = self._pool.submit(
                calibrate, at_hand, self.frame, self.scale, self._options, self._calibration
            )
            return None
        return self._refusal if now_s >= self._deadline_s else None

    def close(self) -> None:
        """End the thread when its work is done; nobody waits for it."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class NextTurn:
    """Awaited by a callback that lets others have their turn first."""

    def __await__(self) -> Generator[None, None, None]:
        yield
