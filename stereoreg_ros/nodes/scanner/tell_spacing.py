"""Tells another node the pixel spacing of the slices that it is about to get, through its parameter service."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from stereoreg_ros.geometry.slice import PixelScale
from stereoreg_ros.nodes.register.parameters import ParameterError

ANSWER_S: Final = 5.0
RETRY_S: Final = 2.0


@dataclass(frozen=True, eq=False)
class _Request:
    scale: PixelScale
    answer: Future
    deadline_s: float


class SpacingTeller:
    """Sets `pixel_spacing` and `pixel_shear` of the node `target`, both or neither, without ever blocking.

    target: the node's name; a relative one is taken in the namespace of `node`. with_slice_poses: whether each slice
    comes with a slice_pose; told too, as a slice without its own would be registered in the wrong axes. Raises
    ParameterError on a name that ROS does not allow.
    """

    def __init__(self, node: Node, target: str, *, with_slice_poses: bool) -> None:
        self._target = target
        self._with_slice_poses = with_slice_poses
        self._logger = node.get_logger()
        try:
            self._client = node.create_client(SetParametersAtomically, f"{target}/set_parameters_atomically")
        except NameValidationException as error:
            raise ParameterError(f"'{target}' is no name of a node: {error}") from None
        self._node = node
        # Every node publishes its parameter events, each process of it with a publisher of its own.
        service = node.resolve_service_name(self._client.srv_name)
        self._full_name = service.removesuffix("/set_parameters_atomically")
        self._processes: set[bytes] = set()
        self._seen = 0
        self._accepted: PixelScale | None = None
        self._request: _Request | None = None
        self._retry_at_s = 0.0
        self._last_said = ""

    def tell(self, scale: PixelScale) -> bool:
        """Take the next step, if one is due; true once the target has accepted exactly this scale.

        To be called again and again, from a timer. When the target goes away, or another process comes up in its place,
        what was accepted is forgotten, and it is told again.
        """
        self.processes_seen()
        if not self._client.service_is_ready():
            self.forget()
            self._say(f"waiting for the parameter service of {self._target}")
            return False
        if self._request is not None:
            self._take_answer(self._request)
        if self._accepted == scale:
            return True
        if self._request is None and time.monotonic() >= self._retry_at_s:
            self._send(scale)
        return False

    def forget(self) -> None:
        """Take nothing for accepted: the target may be another process than before, and is told anew."""
        self._accepted = None
        if self._request is not None:
            self._client.remove_pending_request(self._request.answer)
            self._request = None

    def processes_seen(self) -> int:
        """How many processes have been seen under the target's name so far; a new one is told anew.

        DDS counts a killed process on for a while, and its service as ready: this tells it from the one in its place.
        """
        processes = {
            bytes(one.endpoint_gid)
            for one in self._node.get_publishers_info_by_topic("/parameter_events")
            if f"{one.node_namespace.rstrip('/')}/{one.node_name}" == self._full_name
        }
        if processes - self._processes:
            self._seen += len(processes - self._processes)
            self.forget()
        self._processes = processes
        return self._seen

    def _send(self, scale: PixelScale) -> None:
        parameters = [
            Parameter("pixel_spacing", Parameter.Type.DOUBLE_ARRAY, [float(scale.sx), float(scale.sy)]),
            Parameter("pixel_shear", Parameter.Type.DOUBLE, float(scale.shear)),
            Parameter("slice_pose_required", Parameter.Type.BOOL, self._with_slice_poses),
        ]
        request = SetParametersAtomically.Request(parameters=[one.to_parameter_msg() for one in parameters])
        answer = self._client.call_async(request)
        self._request = _Request(scale, answer, time.monotonic() + ANSWER_S)

    def _take_answer(self, request: _Request) -> None:
        if not request.answer.done():
            if time.monotonic() > request.deadline_s:
                self.forget()
                self._say(f"{self._target} did not answer within {ANSWER_S:g} s, asking again")
            return
        self._request = None
        result: Any = request.answer.result().result
        if result.successful:
            self._accepted = request.scale
            self._say(
                f"{self._target} accepted the pixel spacing {request.scale.sx:g} x {request.scale.sy:g} mm, "
                f"shear {request.scale.shear:g} mm"
            )
        else:
            self._retry_at_s = time.monotonic() + RETRY_S
            self._say(f"{self._target} refused the pixel spacing: {result.reason}", refused=True)

    def _say(self, sentence: str, *, refused: bool = False) -> None:
        if sentence == self._last_said:
            return
        self._last_said = sentence
        if refused:
            self._logger.error(sentence)
        else:
            self._logger.info(sentence)
