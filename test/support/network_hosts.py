"""Hosts of their own on one machine: network namespaces, each joined to a switch by a cable that can be pulled.

A host has the interface `robot0`, and no shared memory with another: what it hears came over the network.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest

INTERFACE = "robot0"
_CLONE_NEWNET = 0x40000000
_NAMESPACES = Path("/run/netns")


class HostsError(Exception):
    """Namespaces cannot be made here, for the reason given."""


class Hosts:
    """Hosts, the switch between them, and their addresses on it."""

    _numbers = count()

    def __init__(self) -> None:
        self._prefix = f"stereoreg-{os.getpid()}-{next(self._numbers)}"
        self._made: list[str] = []
        self.addresses: dict[str, str] = {}

    def make(self, *names: str) -> None:
        """Make the hosts, and join them."""
        self.addresses = {name: f"10.77.0.{number}" for number, name in enumerate(names, 1)}
        self._switch = self._make("switch")
        _ip("-n", self._switch, "link", "add", "bridge", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "bridge", "up")
        for name, address in self.addresses.items():
            host = self._make(name)
            cable = ["link", "add", f"to-{name}", "type", "veth", "peer", "name", INTERFACE, "netns", host]
            _ip("-n", self._switch, *cable)
            _ip("-n", self._switch, "link", "set", f"to-{name}", "master", "bridge", "up")
            _ip("-n", host, "address", "add", f"{address}/24", "dev", INTERFACE)
            _ip("-n", host, "link", "set", INTERFACE, "up")

    def _make(self, name: str) -> str:
        namespace = self._namespace(name)
        _ip("netns", "add", namespace)
        self._made.append(namespace)
        _ip("-n", namespace, "link", "set", "lo", "up")
        return namespace

    def _namespace(self, name: str) -> str:
        return f"{self._prefix}-{name}"

    def remove(self) -> None:
        """Take everything away, cables included."""
        for namespace in self._made:
            _ip("netns", "delete", namespace)
        self._made = []

    def pull_cable(self, host: str) -> None:
        """From now on nothing reaches the host or comes from it."""
        _ip("-n", self._switch, "link", "set", f"to-{host}", "down")

    def plug_in(self, host: str) -> None:
        """The cable is back."""
        _ip("-n", self._switch, "link", "set", f"to-{host}", "up")

    def add_network(self, interface: str, *hosts: str) -> None:
        """Join two hosts by a second network besides."""
        first, second = (self._namespace(host) for host in hosts)
        _ip("-n", first, "link", "add", interface, "type", "veth", "peer", "name", interface, "netns", second)
        for number, namespace in enumerate((first, second), 1):
            _ip("-n", namespace, "address", "add", f"10.88.0.{number}/24", "dev", interface)
            _ip("-n", namespace, "link", "set", interface, "up")

    def multicast_groups(self, host: str, interface: str) -> str:
        """What the host listens to on an interface."""
        return _ip("-n", self._namespace(host), "maddress", "show", "dev", interface)

    def command(self, host: str) -> list[str]:
        """What a command begins with that runs on a host."""
        alone = 'mount -t tmpfs tmpfs /dev/shm && exec "$@"'
        return ["ip", "netns", "exec", self._namespace(host), "sh", "-c", alone, "sh"]

    @contextmanager
    def on(self, host: str) -> Iterator[None]:
        """Sockets that this thread, and threads it starts, open meanwhile are on a host."""
        with Path("/proc/thread-self/ns/net").open() as here, (_NAMESPACES / self._namespace(host)).open() as there:
            _enter(there.fileno())
            try:
                yield
            finally:
                _enter(here.fileno())


@contextmanager
def hosts(*names: str) -> Iterator[Hosts]:
    """Hosts for a test, which is skipped with the reason where they cannot be made."""
    if shutil.which("ip") is None:
        pytest.skip("several hosts: ip is not installed: apt install iproute2")
    made = Hosts()
    try:
        try:
            made.make(*names)
        except HostsError as error:
            pytest.skip(f"several hosts: network namespaces cannot be made here: {error}")
        yield made
    finally:
        made.remove()


def _ip(*arguments: str) -> str:
    ran = subprocess.run(["ip", *arguments], capture_output=True, text=True, timeout=20, check=False)
    if ran.returncode:
        raise HostsError(f"ip {' '.join(arguments)}: {ran.stderr.strip()}")
    return ran.stdout


def _enter(descriptor: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(descriptor, _CLONE_NEWNET):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
