"""The services `~/recalibrate` and `~/reset_calibration`."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from queue import Empty, SimpleQueue
from typing import Final, TypeAlias

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.recalibration import Recalibration
from stereoreg_ros.nodes.register.scale_keeper import ScaleKeeper

_POLL_S: Final = 0.05
_ENDING: Final = "calibration refused: the node is ending"
_Answer: TypeAlias = "Future[tuple[bool, str]]"


class ScaleServices:
    """Recalibration goes on beside the slices: the call waits in a thread of its own, all else happens in the node's.

    state: the settings, the frame to measure with (None where none could be loaded), and whether anybody sends slices.
    """

    def __init__(
        self, node: Node, keeper: ScaleKeeper, state: Callable[[], tuple[NodeSettings, Frame | None, bool]]
    ) -> None:
        self._node, self._keeper, self._state = node, keeper, state
        self._recalibration: Recalibration | None = None
        self._answer: _Answer = Future()
        self._calls: SimpleQueue[_Answer] = SimpleQueue()
        self._closed = False
        self._called = node.create_guard_condition(self._begin)
        self._poll = node.create_timer(_POLL_S, self._go_on, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._poll.cancel()
        own_thread = ReentrantCallbackGroup()
        node.create_service(Trigger, "~/recalibrate", self._on_recalibrate, callback_group=own_thread)
        node.create_service(Trigger, "~/reset_calibration", self._on_reset_calibration)

    def close(self) -> None:
        """Answer the calls that wait: the node ends."""
        self._closed = True
        self._end(False, _ENDING)
        self._refuse_waiting(_ENDING)

    def _on_recalibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answer: _Answer = Future()
        self._calls.put(answer)
        if self._closed:
            self._refuse_waiting(_ENDING)
        else:
            self._called.trigger()
        response.success, response.message = answer.result()
        return response

    def _refuse_waiting(self, message: str) -> None:
        while (answer := self._next_call()) is not None:
            answer.set_result((False, message))

    def _next_call(self) -> _Answer | None:
        try:
            return self._calls.get_nowait()
        except Empty:
            return None

    def _begin(self) -> None:
        while (answer := self._next_call()) is not None:
            if self._recalibration is not None:
                answer.set_result((False, "a recalibration is running already, wait for its answer"))
                continue
            settings, frame, images_come = self._state()
            scale = self._keeper.to_measure
            if frame is None or scale is None or not (self._keeper.sightings or images_come):
                answer.set_result((False, "no slice has been accepted yet, nothing to calibrate from"))
                continue
            deadline_s = time.monotonic() + (settings.calibration_timeout if images_come else 0.0)
            self._recalibration = Recalibration(frame, scale.scale, settings.options, settings.calibration, deadline_s)
            self._answer = answer
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
            self._recalibration = None
            self._poll.cancel()
            self._answer.set_result((success, message))

    def _on_reset_calibration(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running, wait for its answer"
        else:
            response.success, response.message = self._keeper.reset()
        return response
