"""TLS for the storage receiver."""

from __future__ import annotations

import ssl
from pathlib import Path


class TlsError(ValueError):
    """A certificate or key that cannot be used; the text names the file."""


def server_context(certificate: Path, key: Path, client_ca: Path | None) -> ssl.SSLContext:
    """TLS 1.2 or newer with our certificate and key (PEM); with `client_ca` clients need a certificate signed by it."""
    for what, path in (("certificate", certificate), ("key", key), ("client CA", client_ca)):
        if path is not None and not path.is_file():
            raise TlsError(f"TLS {what} {path}: no such file, expected one in PEM")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # Without a password of our own OpenSSL would ask for it on the terminal.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, OSError) as error:
        raise TlsError(f"TLS certificate {certificate} with key {key}: {error}") from None
    if client_ca is not None:
        context.verify_mode = ssl.CERT_REQUIRED
        try:
            context.load_verify_locations(client_ca)
        except (ssl.SSLError, OSError) as error:
            raise TlsError(f"TLS client CA {client_ca}: {error}") from None
    return context
