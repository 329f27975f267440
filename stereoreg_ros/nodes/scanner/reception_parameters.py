"""The parameters of `receive_dicom_node`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node

from stereoreg_ros.nodes.common.parameters import ParameterError, declare, entries_of, setting
from stereoreg_ros.reception.bounded_socket import Limits

_MAX_TITLE_CHARACTERS = 16
_BYTES_PER_MB = 2**20


@dataclass(frozen=True)
class ReceptionSettings:
    """The settings of `receive_dicom_node`, valid as a whole.

    Raises ValueError, naming the parameter, what was found and what was expected.
    """

    address: str = setting("127.0.0.1", "address to listen at; 0.0.0.0: at every network interface")
    port: int = setting(11112, "TCP port to listen at; 0: any that is free", 0, 65535)
    ae_title: str = setting("STEREOREG", "AE title of this DICOM node; clients that call another are rejected")
    allowed_callers: tuple[str, ...] = setting((), "AE titles of the clients that are served; empty: all")
    tls_certificate: str = setting("", "certificate file (PEM) of this DICOM node; empty: connections without TLS")
    tls_key: str = setting("", "file with the key (PEM) of tls_certificate")
    tls_client_ca: str = setting(
        "", "file with the CA certificates (PEM), one of which must have signed a client's; empty: none is asked for"
    )
    max_object_mb: int = setting(64, "largest object, as sent and unpacked, MB", 1, 2047)
    max_associations: int = setting(4, "most associations at a time", 1, 100)
    max_queue: int = setting(256, "most slices that wait to be published; beyond, objects are refused", 1, 10000)
    association_timeout: float = setting(
        5.0, "time from a connection to its association request, TLS included, s", 0.1, 600.0
    )
    network_timeout: float = setting(
        30.0, "longest silence within an association, and longest time for one PDU, s", 0.1, 600.0
    )
    keep_folder: str = setting("", "folder in which each object is stored before it is acknowledged; empty: nowhere")
    watch_folder: str = setting("", "folder watched for DICOM files, its subfolders too; empty: none")
    watch_period: float = setting(1.0, "time between two looks into watch_folder, s", 0.05, 600.0)
    frame_id: str = setting("scanner", "frame_id of the images and slice poses: the patient axes of the DICOM objects")
    register_node: str = setting(
        "register_node",
        "node that must have answered a slice before the next is published; empty: no answer is waited for",
    )
    wait_for_subscriber: bool = setting(True, "publish nothing before somebody subscribes to image")

    def __post_init__(self) -> None:
        _require_title("ae_title", self.ae_title)
        if not isinstance(self.allowed_callers, tuple):
            raise ValueError(f"allowed_callers is {self.allowed_callers!r:.200}, expected a list of AE titles")
        for title in self.allowed_callers:
            _require_title("allowed_callers", title)
        if bool(self.tls_certificate) != bool(self.tls_key):
            raise ValueError("one of tls_certificate and tls_key is empty, expected both or neither")
        if self.tls_client_ca and not self.tls_certificate:
            raise ValueError("tls_client_ca is set without tls_certificate, expected both")
        if self.watch_folder and not os.path.isdir(self.watch_folder):
            raise ValueError(f"watch_folder is {self.watch_folder!r:.200}, expected a folder")
        if self.keep_folder and self.watch_folder:
            kept, watched = (Path(os.path.realpath(folder)) for folder in (self.keep_folder, self.watch_folder))
            if kept == watched or watched in kept.parents:
                raise ValueError(f"keep_folder {kept} lies in watch_folder {watched}: every slice would come twice")

    @property
    def limits(self) -> Limits:
        """What clients may ask for."""
        return Limits(
            max_object_bytes=self.max_object_mb * _BYTES_PER_MB,
            max_associations=self.max_associations,
            association_timeout_s=self.association_timeout,
            network_timeout_s=self.network_timeout,
        )


ENTRIES = entries_of(ReceptionSettings)


def declare_reception(node: Node) -> ReceptionSettings:
    """Declare all parameters of `receive_dicom_node` and return its settings; raises ParameterError."""
    values = declare(node, ENTRIES)
    # An empty list in a parameter file comes as no value at all.
    if values["allowed_callers"] is None:
        values["allowed_callers"] = ()
    try:
        return ReceptionSettings(**values)
    except ValueError as error:
        raise ParameterError(str(error)) from None


def _require_title(name: str, title: object) -> None:
    # PS3.5 6.2, value representation AE.
    usable = isinstance(title, str) and title.isascii() and title.isprintable() and "\\" not in title
    if not isinstance(title, str) or not usable or title != title.strip():
        raise ValueError(f"{name}: found {title!r:.60}, expected an AE title of printable ASCII without a backslash")
    if not 0 < len(title) <= _MAX_TITLE_CHARACTERS:
        raise ValueError(
            f"{name}: found {title!r:.60}, expected an AE title of 1 to {_MAX_TITLE_CHARACTERS} characters"
        )
