"""The services `~/recalibrate` and `~/reset_calibration`."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Generator
from concurrent.futures import Future
from typing import Final

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.recalibration import Recalibration
from stereoreg_ros.nodes.register.scale_keeper import ScaleKeeper

_POLL_S: Final = 0.05
_PAUSE_S: Final = 0.002
_ENDING: Final = (False, "calibration refused: the node is ending")


class ScaleServices:
    """Recalibration goes on beside the slices: the call waits over many turns of the node's callbacks.

    state: the settings, the frame to measure with (None where none could be loaded), and whether anybody sends slices.
    """

    def __init__(
        self, node: Node, keeper: ScaleKeeper, state: Callable[[], tuple[NodeSettings, Frame | None, bool]]
    ) -> None:
        self._node, self._keeper, self._state = node, keeper, state
        self._recalibration: Recalibration | None = None
        self._last: Recalibration | None = None
        self._answer: Future[tuple[bool, str]] = Future()
        self._poll = node.create_timer(_POLL_S, self._go_on, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._poll.cancel()
        # A call goes on over many turns of the executor, and must keep neither slices nor other calls from theirs.
        node.create_service(Trigger, "~/recalibrate", self._on_recalibrate, callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, "~/reset_calibration", self._on_reset_calibration)

    def close(self) -> None:
        """Answer a call that waits: the node ends."""
        self._end(*_ENDING)

    @property
    def is_measuring(self) -> bool:
        """Whether a measurement is at work, be it one that nobody waits for any more."""
        return any(one is not None and one.is_measuring for one in (self._recalibration, self._last))

    async def _on_recalibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running already, wait for its answer"
            return response
        answer: Future[tuple[bool, str]] = Future()
        self._answer = answer
        self._begin()
        while not answer.done():
            # rclpy asks again without a pause, and the thread that measures needs the interpreter.
            time.sleep(_PAUSE_S)
            await _NextTurn()
        response.success, response.message = answer.result()
        return response

    def _begin(self) -> None:
        settings, frame, images_come = self._state()
        scale = self._keeper.to_measure
        if frame is None or scale is None or not (self._keeper.sightings or images_come):
            self._end(False, "no slice has been accepted yet, nothing to calibrate from")
            return
        deadline_s = time.monotonic() + (settings.calibration_timeout if images_come else 0.0)
        self._recalibration = Recalibration(frame, scale.scale, settings.options, settings.calibration, deadline_s)
        self._poll.reset()
        self._go_on()

    def _go_on(self) -> None:
        recalibration = self._recalibration
        if recalibration is None:
            return
        try:
            outcome = recalibration.poll(self._keeper.sightings, time.monotonic())
            if outcome is None:
                return
            _, frame, _ = self._state()
            in_use = self._keeper.to_measure
            if frame is not recalibration.frame or in_use is None or in_use.scale != recalibration.scale:
                self._end(False, "calibration refused: the frame or the pixel spacing was changed meanwhile")
            elif outcome:
                self._end(*self._keeper.take(outcome, recalibration.frame))
            else:
                self._end(False, outcome.message)
        except Exception as error:
            self._node.get_logger().error(f"internal error in recalibrate\n{traceback.format_exc()}")
            self._end(False, f"internal error: {type(error).__name__}: {error}")

    def _end(self, success: bool, message: str) -> None:
        if self._recalibration is not None:
            self._recalibration.close()
            self._last, self._recalibration = self._recalibration, None
            self._poll.cancel()
        if not self._answer.done():
            self._answer.set_result((success, message))

    def _on_reset_calibration(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running, wait for its answer"
        else:
            response.success, response.message = self._keeper.reset()
        return response


class _NextTurn:
    """Awaited by a callback that lets others have their turn first."""

    def __await__(self) -> Generator[None, None, None]:
        yield
