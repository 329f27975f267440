"""The DICOM node: C-ECHO, and C-STORE of CT, Enhanced CT and MR images."""

from __future__ import annotations

import logging
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydicom.dataset import Dataset
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, MRImageStorage
from pynetdicom import AE, evt
from pynetdicom.events import Event
from pynetdicom.sop_class import Verification  # type: ignore[attr-defined]

from stereoreg_ros.reception.association_server import SPARE_CONNECTIONS, BoundedServer
from stereoreg_ros.reception.bounded_socket import MAX_PDU_BYTES, Limits, describe
from stereoreg_ros.reception.intake import CANNOT_UNDERSTAND, Intake, ObjectRefusedError
from stereoreg_ros.reception.kept_objects import KeptObjects, is_uid
from stereoreg_ros.reception.transfer_syntaxes import readable

_SUCCESS: Final = 0x0000
_MAX_COMMENT_CHARACTERS: Final = 64
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Endpoint:
    """Where a storage receiver listens, and to whom.

    address, port: of the interface; port 0: any that is free. ae_title: what clients must call. allowed_callers: AE
    titles of the clients that are served; empty: all. tls: None for plain connections.
    """

    address: str
    port: int
    ae_title: str
    allowed_callers: tuple[str, ...] = ()
    tls: ssl.SSLContext | None = None


class StorageService:
    """A storage receiver that passes objects to an Intake, and acknowledges those that it has taken.

    kept: where objects are kept; None: nowhere.
    Raises OSError where it cannot listen there, ValueError for an invalid AE title.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        limits: Limits,
        intake: Intake,
        kept: KeptObjects | None,
    ) -> None:
        self._intake = intake
        self._kept = kept
        self._entity = entity = AE(endpoint.ae_title)
        entity.require_called_aet = True
        entity.require_calling_aet = list(endpoint.allowed_callers)
        # The server has a limit of its own, so that this one is never reached.
        entity.maximum_associations = limits.max_associations + SPARE_CONNECTIONS
        entity.maximum_pdu_size = MAX_PDU_BYTES
        entity.acse_timeout = limits.association_timeout_s
        entity.network_timeout = limits.network_timeout_s
        entity.dimse_timeout = limits.network_timeout_s
        entity.add_supported_context(Verification)
        for storage in (CTImageStorage, EnhancedCTImageStorage, MRImageStorage):
            entity.add_supported_context(storage, list(readable()))
        self._server: Any = entity.make_server(
            (endpoint.address, endpoint.port),
            ssl_context=endpoint.tls,
            server_class=BoundedServer,
            evt_handlers=[
                (evt.EVT_C_STORE, self._store),
                (evt.EVT_ESTABLISHED, _say_established),
                (evt.EVT_REJECTED, self._say_rejected),
            ],
            limits=limits,
        )

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    def start(self) -> None:
        """Start to serve."""
        self._server.start()

    def stop(self) -> None:
        """End all associations; takes half a second at most."""
        self._server.stop()

    def _store(self, event: Event) -> int | Dataset:
        uid, caller = str(getattr(event.request, "AffectedSOPInstanceUID", "")), describe(event.assoc)
        try:
            if not is_uid(uid):
                raise ObjectRefusedError(CANNOT_UNDERSTAND, f"SOP Instance UID {uid!r} is no UID")
            slices = self._intake.take(Path(uid), event.encoded_dataset(), uid, self._kept)
        except ObjectRefusedError as refusal:
            _LOG.warning("refused with status 0x%04X what %s sent: %s", refusal.status, caller, refusal)
            return _response(refusal.status, str(refusal))
        _LOG.info("took %s from %s: %d slice%s", uid, caller, slices, "s"[: slices != 1])
        return _SUCCESS

    def _say_rejected(self, event: Event) -> None:
        request: Any = event.assoc.requestor.primitive
        entity = self._entity
        called, calling = request.called_ae_title.strip(), request.calling_ae_title.strip()
        if called != entity.ae_title:
            why = f"it called {called!r}, expected {entity.ae_title!r}"
        else:
            why = f"{calling!r} is not among the allowed callers"
        _LOG.warning("association of %s rejected: %s", describe(event.assoc), why)


def _response(status: int, reason: str) -> Dataset:
    response = Dataset()
    response.Status = status
    # The element has few characters and must not contain the separator of values; the client knows the name anyway.
    comment = reason.partition(": ")[2] or reason
    response.ErrorComment = comment.encode("ascii", "replace").decode().replace("\\", "/")[:_MAX_COMMENT_CHARACTERS]
    return response


def _say_established(event: Event) -> None:
    _LOG.info("association with %s", describe(event.assoc))
