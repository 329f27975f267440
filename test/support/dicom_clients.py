"""DICOM clients for the tests: pynetdicom's own, and those of dcmtk where that is installed."""

from __future__ import annotations

import shutil
import socket
import ssl
import subprocess
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pydicom
import pytest
from pynetdicom import AE, evt
from pynetdicom.association import Association
from pynetdicom.sop_class import Verification  # type: ignore[attr-defined]

TITLE = "STEREOREG"
_PATIENCE_S = 60.0


def dcmtk(tool: str) -> str:
    """Where a program of dcmtk is, or the test is skipped with the reason."""
    found = shutil.which(tool)
    if found is None:
        pytest.skip(f"{tool} of dcmtk is not installed: apt install dcmtk")
    return found


def run_dcmtk(tool: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a program of dcmtk to its end."""
    command = [dcmtk(tool), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)


def entity(caller: str = "SCANNER") -> AE:
    """A client that waits patiently."""
    client = AE(caller)
    client.acse_timeout = client.dimse_timeout = client.network_timeout = client.connection_timeout = _PATIENCE_S
    return client


@contextmanager
def association(
    port: int,
    contexts: Iterable[tuple[str, str | list[str] | None]] = (),
    caller: str = "SCANNER",
    called: str = TITLE,
    tls: ssl.SSLContext | None = None,
    sent: list[bytes] | None = None,
    address: str = "127.0.0.1",
) -> Iterator[Association]:
    """An association, established or not, with the presentation contexts (SOP class, transfer syntaxes).

    sent: takes every PDU that goes to the receiver.
    """
    pdus = sent if sent is not None else []
    client = entity(caller)
    client.add_requested_context(Verification)
    for sop_class, syntaxes in contexts:
        client.add_requested_context(sop_class, syntaxes)
    sockets: list[socket.socket] = []
    opened = client.associate(
        address,
        port,
        ae_title=called,
        tls_args=(tls, "localhost") if tls else None,
        evt_handlers=[
            (evt.EVT_CONN_OPEN, lambda event: sockets.append(event.assoc.dul.socket.socket)),
            (evt.EVT_DATA_SENT, lambda event: pdus.append(event.data)),
        ],
    )
    try:
        yield opened
    finally:
        if opened.is_established:
            opened.release()
        # pynetdicom leaves it open where the other end was the first to hang up.
        for one in sockets:
            one.close()


def send(port: int, *paths: Path, **named: Any) -> list[Any]:
    """Send files in one association, each in its own transfer syntax; returns the responses."""
    with warnings.catch_warnings():
        # Files that are wrong on purpose.
        warnings.simplefilter("ignore")
        datasets = [pydicom.dcmread(path, force=True) for path in paths]
    contexts = {(one.SOPClassUID, one.file_meta.TransferSyntaxUID) for one in datasets}
    with association(port, sorted(contexts), **named) as opened:
        assert opened.is_established
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return [opened.send_c_store(one) for one in datasets]


def echo(port: int, **named: Any) -> int | None:
    """Status of a C-ECHO, None where there was no association or no response."""
    with association(port, **named) as opened:
        if not opened.is_established:
            return None
        status = opened.send_c_echo()
        return int(status.Status) if "Status" in status else None


def connect(port: int) -> socket.socket:
    """A bare connection, for what no DICOM client would send."""
    return socket.create_connection(("127.0.0.1", port), timeout=_PATIENCE_S)
