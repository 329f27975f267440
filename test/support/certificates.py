"""Certificates for the tests, made by the program openssl."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Certificate:
    """A certificate and its key, files in PEM."""

    certificate: Path
    key: Path


def _openssl(*arguments: str | Path) -> None:
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("the program openssl is not installed")
    subprocess.run([program, *map(str, arguments)], capture_output=True, timeout=60, check=True)


def make_certificate(folder: Path, name: str, signed_by: Certificate | None = None) -> Certificate:
    """A certificate of `name`, by which TLS knows the host; signed by itself, and then fit to sign, or by another."""
    made = Certificate(folder / f"{name}.pem", folder / f"{name}.key")
    request = ("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-keyout", made.key)
    subject = ("-subj", f"/CN={name}", "-out", made.certificate)
    if signed_by is None:
        _openssl(*request, "-x509", "-days", "2", *subject)
        return made
    _openssl(*request, *subject)
    names = folder / f"{name}.names"
    names.write_text(f"subjectAltName=DNS:{name}\n")
    signing = ("-CA", signed_by.certificate, "-CAkey", signed_by.key, "-CAcreateserial", "-days", "2")
    _openssl("x509", "-req", "-in", made.certificate, *signing, "-extfile", names, "-out", made.certificate)
    return made
