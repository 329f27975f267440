"""The DICOM receiver with TLS: whom it serves, and whom it does not."""

from __future__ import annotations

import ssl
import time

import numpy as np
import pytest

from support.certificates import Certificate, make_certificate
from support.dicom_clients import connect, echo, run_dcmtk, send
from support.dicom_files import write_slice

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.reception.tls import TlsError, server_context
from support.ros_process import RosClient
from support.scanner_nodes import SUCCESS, hung_up, receiver

IMAGE = np.arange(600 * 16, dtype=np.uint16).reshape(600, 16)


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    return make_certificate(tmp_path_factory.mktemp("tls"), "authority")


@pytest.fixture(scope="module")
def secure(authority):
    """A receiver that wants certificates of the authority."""
    server = make_certificate(authority.key.parent, "localhost", authority)
    with (
        RosClient() as client,
        receiver(
            client,
            tls_certificate=str(server.certificate),
            tls_key=str(server.key),
            tls_client_ca=str(authority.certificate),
            association_timeout=2.0,
            max_associations=2,
        ) as running,
    ):
        yield running


def client_context(authority: Certificate, own: Certificate | None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=authority.certificate)
    if own is not None:
        context.load_cert_chain(own.certificate, own.key)
    return context


def test_a_client_with_a_certificate_is_served(tmp_path, authority, secure):
    own = make_certificate(tmp_path, "scanner", authority)
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    before = len(secure.images)
    assert echo(secure.port, tls=client_context(authority, own)) == SUCCESS
    assert [one.Status for one in send(secure.port, path, path, tls=client_context(authority, own))] == [SUCCESS] * 2
    secure.wait(before + 2)


def test_storescu_with_a_certificate_is_served(tmp_path, authority, secure):
    own = make_certificate(tmp_path, "scanner", authority)
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    before = len(secure.images)
    certificates = ("+tls", own.key, own.certificate, "+cf", authority.certificate)
    sent = run_dcmtk("storescu", *certificates, "-aec", "STEREOREG", "localhost", str(secure.port), path)
    assert sent.returncode == 0, sent.stderr
    secure.wait(before + 1)


def test_clients_without_a_fitting_certificate_are_not_served(tmp_path, authority, secure):
    other_authority = make_certificate(tmp_path, "other")
    foreign = make_certificate(tmp_path, "scanner", other_authority)
    assert echo(secure.port, tls=client_context(authority, foreign)) is None
    assert echo(secure.port, tls=client_context(authority, None)) is None
    # Without TLS at all.
    assert echo(secure.port) is None


def test_a_client_that_stalls_while_agreeing_on_tls_keeps_nobody_waiting(tmp_path, authority, secure):
    own = make_certificate(tmp_path, "scanner", authority)
    with connect(secure.port) as silent, connect(secure.port) as halting:
        begun = time.monotonic()
        # The start of a handshake record, whose rest does not come.
        halting.sendall(b"\x16\x03\x01\x02\x00\x01")
        assert echo(secure.port, tls=client_context(authority, own)) == SUCCESS
        assert time.monotonic() - begun < 2.0
        assert hung_up(silent)
        assert hung_up(halting)
        assert time.monotonic() - begun < 20.0


def test_without_a_client_ca_no_certificate_is_asked_for(tmp_path):
    server = make_certificate(tmp_path, "localhost")
    parameters = {"tls_certificate": str(server.certificate), "tls_key": str(server.key)}
    with RosClient() as client, receiver(client, **parameters) as received:
        assert echo(received.port, tls=client_context(server, None)) == SUCCESS


def test_old_versions_of_tls_are_not_spoken(tmp_path):
    server = make_certificate(tmp_path, "localhost")
    assert server_context(server.certificate, server.key, None).minimum_version == ssl.TLSVersion.TLSv1_2


def test_a_faulty_certificate_is_named(tmp_path):
    server, other = (make_certificate(tmp_path, name) for name in ("localhost", "other"))
    text = tmp_path / "text.pem"
    text.write_text("no certificate")
    with pytest.raises(TlsError, match=r"TLS certificate .*localhost.pem with key .*other.key"):
        server_context(server.certificate, other.key, None)
    with pytest.raises(TlsError, match=r"TLS certificate .*text.pem"):
        server_context(text, server.key, None)
    with pytest.raises(TlsError, match=r"TLS client CA .*text.pem"):
        server_context(server.certificate, server.key, text)
