"""The services `~/recalibrate` and `~/reset_calibration`."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Generator
from typing import Final

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.nodes.register.recalibration import Recalibration
from stereoreg_ros.nodes.register.scale_keeper import ScaleKeeper

_PAUSE_S: Final = 0.002


class ScaleServices:
    """Recalibration goes on beside the slices: the call waits over many turns of the node's callbacks.

    state: the settings, the frame to measure with (None where none could be loaded), and whether anybody sends slices.
    """

    def __init__(
        self, node: Node, keeper: ScaleKeeper, state: Callable[[], tuple[NodeSettings, Frame | None, bool]]
    ) -> None:
        self._node, self._keeper, self._state = node, keeper, state
        self._recalibration: Recalibration | None = None
        # A call goes on over many turns of the executor, and must keep neither slices nor other calls from theirs.
        node.create_service(Trigger, "~/recalibrate", self._on_recalibrate, callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, "~/reset_calibration", self._on_reset_calibration)

    def close(self) -> None:
        """Have a measurement that goes on end early: the node ends."""
        if self._recalibration is not None:
            self._recalibration.close()

    @property
    def is_measuring(self) -> bool:
        """Whether the thread of a measurement is at work."""
        return self._recalibration is not None and self._recalibration.is_measuring

    async def _on_recalibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recalibration is not None:
            response.success, response.message = False, "a recalibration is running already, wait for its answer"
            return response
        settings, frame, images_come = self._state()
        scale = self._keeper.to_measure
        if frame is None or scale is None or not (self._keeper.sightings or images_come):
            response.success, response.message = False, "no slice has been accepted yet, nothing to calibrate from"
            return response
        deadline_s = time.monotonic() + (settings.calibration_timeout if images_come else 0.0)
        self._recalibration = Recalibration(frame, scale.scale, settings.options, settings.calibration, deadline_s)
        try:
            response.success, response.message = await self._recalibrate(self._recalibration)
        except Exception as error:
            self._node.get_logger().error(f"internal error in recalibrate\n{traceback.format_exc()}")
            response.success, response.message = False, f"internal error: {type(error).__name__}: {error}"
        finally:
            self._recalibration.close()
            self._recalibration = None
        return response

    async def _recalibrate(self, recalibration: Recalibration) -> tuple[bool, str]:
        """Whether the scale was changed, and the sentence for the operator."""
        while (outcome := recalibration.poll(self._keeper.sightings, time.monotonic())) is None:
            # rclpy resumes this without a pause, and the thread that measures needs the interpreter.
            time.sleep(_PAUSE_S)
            await _NextTurn()
        _, frame, _ = self._state()
        in_use = self._keeper.to_measure
        if frame is not recalibration.frame or in_use is None or in_use.scale != recalibration.scale:
            return False, "calibration refused: the frame or the pixel spacing was changed meanwhile"
        return self._keeper.take(outcome, recalibration.frame) if outcome else (False, outcome.message)

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
