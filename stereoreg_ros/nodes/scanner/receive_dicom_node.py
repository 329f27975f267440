"""Receives CT slices from a scanner, by DICOM push or through a folder, and publishes them on topics."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Final, Literal

from builtin_interfaces.msg import Time as TimeMessage
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

import stereoreg_ros.reception
from stereoreg_ros.nodes.common.parameters import ParameterError
from stereoreg_ros.nodes.common.process import run
from stereoreg_ros.nodes.common.slice_publisher import SlicePublisher
from stereoreg_ros.nodes.scanner.reception_log import NodeLogHandler
from stereoreg_ros.nodes.scanner.reception_parameters import ReceptionSettings, declare_reception
from stereoreg_ros.nodes.scanner.registration_answers import RegistrationAnswers
from stereoreg_ros.reception.intake import Intake
from stereoreg_ros.reception.kept_objects import KeptObjects
from stereoreg_ros.reception.slice_queue import ReceivedSlice, SliceQueue
from stereoreg_ros.reception.storage_service import Endpoint, StorageService
from stereoreg_ros.reception.tls import TlsError, server_context
from stereoreg_ros.reception.watched_folder import WatchedFolder

# A search that is given up takes ten seconds or so.
ANSWER_S: Final = 15.0
TRIES: Final = 3
_POLL_S: Final = 0.01
# Where nobody answers: subscribers keep the last few only, and need time to take them.
_UNANSWERED_S: Final = 0.02
_NS_PER_S: Final = 10**9


class ReceiveDicomNode(Node):
    """Publishes each slice as `slice_spacing`, `slice_pose` and `image` (in HU), in the order of arrival.

    Their stamp is the time of arrival. register_node gets a slice when it has answered the one before, so that none
    overflows its queue.
    """

    def __init__(self) -> None:
        super().__init__("receive_dicom_node")
        self._settings = settings = declare_reception(self)
        self._queue = SliceQueue(settings.max_queue)
        self._publisher = SlicePublisher(self, settings.frame_id)
        self._answers = RegistrationAnswers(self, settings.register_node)
        self._sent: ReceivedSlice | None = None
        self._sent_stamp = TimeMessage()
        self._answer_by_s = 0.0
        self._tries = 0
        self._answers_before = 0
        self._sent_to: set[bytes] = set()
        self._waits_for = ""
        self._log_handler = NodeLogHandler(self)
        log = logging.getLogger(stereoreg_ros.reception.__name__)
        log.setLevel(logging.INFO)
        log.addHandler(self._log_handler)
        intake = Intake(self._queue, settings.limits.max_object_bytes)
        self._watched = self._watch(settings, intake)
        self._service = self._listen(settings, intake)
        self.create_timer(_POLL_S, self._step, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._service.start()
        if self._watched is not None:
            self._watched.start()
        self.get_logger().info(
            f"{settings.ae_title} listens at {settings.address} port {self._service.port}"
            f"{', with TLS' if settings.tls_certificate else ''}"
        )

    def destroy_node(self) -> None:
        """End: clients' associations are aborted; what waits in the queue is lost, and said to be."""
        self._queue.close()
        if self._watched is not None:
            self._watched.stop()
        self._service.stop()
        if len(self._queue):
            self.get_logger().warning(f"ended with {len(self._queue)} slices that were not published")
        logging.getLogger(stereoreg_ros.reception.__name__).removeHandler(self._log_handler)
        super().destroy_node()

    @staticmethod
    def _watch(settings: ReceptionSettings, intake: Intake) -> WatchedFolder | None:
        if not settings.watch_folder:
            return None
        folder = Path(settings.watch_folder)
        try:
            return WatchedFolder(folder, settings.watch_period, settings.limits.max_object_bytes, intake)
        except OSError as error:
            raise ParameterError(f"watch_folder {folder} cannot be listed: {error.strerror}") from None

    def _listen(self, settings: ReceptionSettings, intake: Intake) -> StorageService:
        kept = None
        if settings.keep_folder:
            kept = KeptObjects(Path(settings.keep_folder))
            try:
                kept.remove_unfinished()
            except OSError as error:
                self.get_logger().warning(f"keep_folder {settings.keep_folder}: {error.strerror}")
        try:
            tls = None
            if settings.tls_certificate:
                client_ca = Path(settings.tls_client_ca) if settings.tls_client_ca else None
                tls = server_context(Path(settings.tls_certificate), Path(settings.tls_key), client_ca)
            endpoint = Endpoint(settings.address, settings.port, settings.ae_title, settings.allowed_callers, tls)
            return StorageService(endpoint, settings.limits, intake, kept)
        except TlsError as error:
            raise ParameterError(str(error)) from None
        except OSError as error:
            raise ParameterError(f"cannot listen at {settings.address} port {settings.port}: {error}") from None

    def _step(self) -> None:
        received = self._queue.first()
        if received is None:
            return
        if self._sent is received:
            if not self._is_done(received):
                return
            self._queue.remove_first()
            self._sent, self._tries = None, 0
            received = self._queue.first()
        if received is not None and self._may_publish():
            self._publish(received)

    def _may_publish(self) -> bool:
        """Whether somebody takes the slice, and register_node too where it has to answer."""
        if self._settings.register_node and not self._answers.processes():
            return self._wait_for(f"{self._settings.register_node} to take images")
        if self._settings.wait_for_subscriber and not self._publisher.listened_to():
            return self._wait_for("a subscriber of image")
        self._waits_for = ""
        return True

    def _wait_for(self, what: str) -> Literal[False]:
        if self._waits_for != what:
            self._waits_for = what
            self.get_logger().info(f"slices wait for {what}")
        return False

    def _publish(self, received: ReceivedSlice) -> None:
        if self._tries == 0:
            self._sent_stamp = self._stamp_of(received)
            self._answers.expect(self._sent_stamp)
        self._answers_before = self._answers.count
        self._sent_to = self._answers.processes()
        self._publisher.publish(received.dicom_slice, self._sent_stamp)
        self._sent = received
        self._tries += 1
        self._answer_by_s = time.monotonic() + (ANSWER_S if self._settings.register_node else _UNANSWERED_S)

    def _is_done(self, sent: ReceivedSlice) -> bool:
        """Whether the slice that was sent can be let go; one that register_node did not get is sent again."""
        overdue = time.monotonic() > self._answer_by_s
        name = self._settings.register_node
        if not name:
            return overdue
        answered = self._answers.count > self._answers_before
        if answered and self._answers.came_with(sent.dicom_slice.ct_slice.scale):
            return True
        replaced = bool(self._answers.processes() - self._sent_to)
        if not answered and not overdue and not replaced:
            return False
        if answered:
            fault = f"{name} answered a slice with another pixel spacing"
        else:
            fault = f"{name} was started anew" if replaced else f"{name} did not answer a slice within {ANSWER_S:g} s"
        if self._tries < TRIES:
            self.get_logger().warning(f"{fault}: the slice is sent again")
            self._sent = None
            return False
        self.get_logger().error(f"{fault} for the {TRIES}rd time, going on with the next slice")
        return True

    def _stamp_of(self, received: ReceivedSlice) -> TimeMessage:
        """When the slice arrived, by the node's clock; no two slices have the same stamp."""
        age_ns = int((time.monotonic() - received.arrival_s) * _NS_PER_S)
        return self._publisher.unique_stamp(self.get_clock().now().nanoseconds - age_ns)


def main() -> int:
    """Entry point of the executable."""
    return run(ReceiveDicomNode)


if __name__ == "__main__":
    raise SystemExit(main())
