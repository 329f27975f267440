"""The receiving end of an association, bounded in size and in time."""

from __future__ import annotations

import logging
import socket
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from pynetdicom.pdu import A_ABORT_RQ
from pynetdicom.transport import AssociationSocket

if TYPE_CHECKING:
    from pynetdicom.association import Association

# Announced to clients, which then send no longer PDUs. An association request, to which it does not apply, is shorter.
MAX_PDU_BYTES: Final = 2**18
_PDU_HEADER_BYTES: Final = 6
_READ_BYTES: Final = 2**16
_ABORTED_BY_PROVIDER: Final = 2
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Limits:
    """The limits for a client.

    max_object_bytes: of one object. max_associations: at a time. association_timeout_s: from the connection to the
    association request. network_timeout_s: of silence, and for one PDU to arrive.
    """

    max_object_bytes: int
    max_associations: int
    association_timeout_s: float
    network_timeout_s: float

    @property
    def max_message_bytes(self) -> int:
        """An object with its command, and the overhead of small PDUs."""
        return self.max_object_bytes + self.max_object_bytes // 64 + MAX_PDU_BYTES


class BoundedSocket(AssociationSocket):
    """Ends an association before it takes more memory, or occupies its thread longer, than the limits allow.

    pynetdicom itself would wait forever for the rest of a PDU, and accept PDUs of 4 GB and messages of any size.
    """

    def __init__(self, association: Association, client_socket: socket.socket, limits: Limits) -> None:
        super().__init__(association, client_socket=client_socket)
        self._connection = client_socket
        self._limits = limits
        self._unanswered_bytes = 0

    def answered(self) -> None:
        """Note that the client's message has been answered: only now is its memory free, and the next one allowed."""
        self._unanswered_bytes = 0

    def release(self) -> None:
        """Close the connection; pynetdicom does not where the client closed it first."""
        self._connection.close()

    def recv(self, nr_bytes: int) -> bytearray:
        """`nr_bytes`, or fewer where the client hangs up; beyond a limit OSError, which ends the association."""
        if nr_bytes > MAX_PDU_BYTES + _PDU_HEADER_BYTES:
            self._refuse(f"a PDU of {nr_bytes} bytes was announced, expected at most {MAX_PDU_BYTES}")
        self._unanswered_bytes += nr_bytes
        if self._unanswered_bytes > self._limits.max_message_bytes:
            self._refuse(f"an object has more than {self._limits.max_object_bytes} bytes")
        try:
            return self._read(nr_bytes)
        except TimeoutError:
            self._refuse("the rest of a PDU did not come in time")
            raise

    def _read(self, nr_bytes: int) -> bytearray:
        connection = self.socket
        if connection is None:
            raise OSError("the connection is closed")
        limits = self._limits
        wait_s = limits.network_timeout_s if self.assoc.is_established else limits.association_timeout_s
        deadline_s = time.monotonic() + wait_s
        received = bytearray()
        while len(received) < nr_bytes:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError
            connection.settimeout(left_s)
            part = connection.recv(min(nr_bytes - len(received), _READ_BYTES))
            if not part:
                break
            received += part
        # For the responses too: a client that does not read them is disconnected.
        connection.settimeout(limits.network_timeout_s)
        return received

    def _refuse(self, why: str) -> None:
        _LOG.warning("association of %s aborted: %s", describe(self.assoc), why)
        abort = A_ABORT_RQ()
        abort.source = _ABORTED_BY_PROVIDER
        abort.reason_diagnostic = 0
        self.send(abort.encode())
        raise OSError(why)


def describe(association: Association) -> str:
    """The caller, for the log: AE title, once it is known, and host."""
    requestor = association.requestor
    title = str(requestor.primitive.calling_ae_title).strip() if requestor.primitive else "an unknown caller"
    return f"{title!r} at {requestor.address}"
