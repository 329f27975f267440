"""The listening end: accepts connections up to a limit, and lets none of them block the others."""

from __future__ import annotations

import logging
import queue
import socket
import threading
import time
from typing import Any, Final

from pynetdicom import evt
from pynetdicom.association import Association
from pynetdicom.events import Event
from pynetdicom.transport import AssociationServer, RequestHandler

from stereoreg_ros.reception.bounded_socket import BoundedSocket, Limits, describe
from stereoreg_ros.reception.ending_state_machine import EndingStateMachine

# Connections beyond the allowed associations: those that have not requested one yet, or are being rejected.
# Each takes two threads, which poll a thousand times a second.
SPARE_CONNECTIONS: Final = 8
# Rejected (transient) by the provider's presentation layer: PS3.8 9.3.4.
_LOCAL_LIMIT_EXCEEDED: Final = (2, 3, 2)
_ABORTED_BY_USER: Final = 0
_POLL_S: Final = 0.1
_FAREWELL_S: Final = 0.2
_LOG = logging.getLogger(__name__)


class _Connection(RequestHandler):
    """Has a connection's association read through a BoundedSocket."""

    server: BoundedServer

    def _create_association(self) -> Association:
        association = super()._create_association()
        # A new socket announces the connection a second time; drop one of the two events.
        association.dul.event_queue.get_nowait()
        association.dul.socket = BoundedSocket(association, self.request, self.server.limits)
        association.dul.state_machine = EndingStateMachine(association.dul)
        # A thread that waits for a client must not keep the process alive.
        association.dul.daemon = True
        return association


class BoundedServer(AssociationServer):
    """pynetdicom's server, in a thread of its own, with a limit on connections; for AE.make_server.

    limits: see Limits. The other arguments are those of AssociationServer.
    """

    def __init__(self, *arguments: Any, limits: Limits, **keywords: Any) -> None:
        self.limits = limits
        keywords["request_handler"] = _Connection
        super().__init__(*arguments, **keywords)
        self._admitted: list[Association] = []
        self._admission = threading.Lock()
        self.bind(evt.EVT_REQUESTED, self._admit)
        self.bind(evt.EVT_CONN_CLOSE, _on_close)
        self.bind(evt.EVT_DIMSE_SENT, _note_answer)
        self._thread = threading.Thread(target=self.serve_forever, args=(_POLL_S,), name="dicom-listener", daemon=True)

    def start(self) -> None:
        """Start to accept connections."""
        self._thread.start()

    def stop(self) -> None:
        """Accept no more connections and abort the open ones; takes half a second at most."""
        # Not this class's shutdown(), which expects the server to have been started by the AE.
        super(AssociationServer, self).shutdown()
        self.server_close()
        open_associations = self.active_associations
        for association in open_associations:
            association.acse.send_abort(_ABORTED_BY_USER)
        end_s = time.monotonic() + _FAREWELL_S
        for association in open_associations:
            # The others have no client that waits for the abort.
            if association.is_established:
                association.dul.join(max(end_s - time.monotonic(), 0.0))

    def get_request(self) -> tuple[socket.socket, Any]:
        """The next connection. Its TLS handshake happens at the first read: here it would block all others."""
        assert self.socket is not None
        connection, address = self.socket.accept()
        if self.ssl_context is not None:
            connection = self.ssl_context.wrap_socket(connection, server_side=True, do_handshake_on_connect=False)
        return connection, address

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is room for one more connection; if not, it is closed at once."""
        if len(self.active_associations) < self.limits.max_associations + SPARE_CONNECTIONS:
            return True
        _LOG.warning("connection from %s closed: too many are open", client_address[0])
        return False

    def _admit(self, event: Event) -> None:
        """Reject an association beyond the limit. pynetdicom's own limit would count connections without one."""
        with self._admission:
            self._admitted = [one for one in self._admitted if not _is_over(one)]
            if len(self._admitted) < self.limits.max_associations:
                self._admitted.append(event.assoc)
                return
        _LOG.warning(
            "association of %s rejected: %d are open already", describe(event.assoc), self.limits.max_associations
        )
        event.assoc.acse.send_reject(*_LOCAL_LIMIT_EXCEEDED)
        event.assoc.kill()


def _is_over(association: Association) -> bool:
    ended = association.is_released or association.is_aborted or association.is_rejected
    return ended or not association.is_alive()


def _note_answer(event: Event) -> None:
    connection = event.assoc.dul.socket
    if isinstance(connection, BoundedSocket):
        connection.answered()


def _on_close(event: Event) -> None:
    """Free the place of a connection that closes before its association request now, not after the timeout."""
    if isinstance(event.assoc.dul.socket, BoundedSocket):
        event.assoc.dul.socket.release()
    waiting: queue.Queue[Any] = event.assoc.dul.to_user_queue
    if event.assoc.requestor.primitive is None:
        # What the wait itself would return at the timeout.
        waiting.put(None)
