"""The end of an association that receives: for how long it waits, by a clock of its own, and for how much."""

from __future__ import annotations

import queue
from types import SimpleNamespace
from typing import Any

import pytest

from stereoreg_ros.reception.bounded_socket import MAX_PDU_BYTES, BoundedSocket, Limits
from stereoreg_ros.reception.ending_state_machine import EndingStateMachine

ASSOCIATION_S, NETWORK_S = 5.0, 30.0


class Client:
    """A client that sends up to `part` bytes at a time, after a pause of `pause_s` before each; and the clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, part: int, pause_s: float, established: bool) -> None:
        self.now_s, self._part, self._pause_s = 0.0, part, pause_s
        self.sent, self.timeouts, self.is_open = b"", list[float](), True
        monkeypatch.setattr(
            "stereoreg_ros.reception.bounded_socket.time", SimpleNamespace(monotonic=lambda: self.now_s)
        )
        requestor = SimpleNamespace(primitive=None, address="here")
        dul = SimpleNamespace(event_queue=queue.Queue())
        association: Any = SimpleNamespace(is_established=established, requestor=requestor, dul=dul)
        connection: Any = self
        self.socket = BoundedSocket(association, connection, Limits(2**20, 1, ASSOCIATION_S, NETWORK_S))
        # What it answers goes to nobody.
        monkeypatch.setattr(BoundedSocket, "send", lambda _, content: setattr(self, "sent", content))

    def close(self) -> None:
        self.is_open = False

    def settimeout(self, seconds: float) -> None:
        self.timeouts.append(seconds)

    def recv(self, count: int) -> bytes:
        if self._pause_s > self.timeouts[-1]:
            self.now_s += self.timeouts[-1]
            raise TimeoutError
        self.now_s += self._pause_s
        return bytes(min(count, self._part))


@pytest.mark.parametrize(("established", "limit_s"), [(False, ASSOCIATION_S), (True, NETWORK_S)])
def test_a_pdu_must_be_complete_in_time_however_often_a_part_of_it_arrives(
    monkeypatch: pytest.MonkeyPatch, established: bool, limit_s: float
) -> None:
    client = Client(monkeypatch, 1, 1.0, established)
    with pytest.raises(OSError, match="the rest of a PDU did not come in time"):
        client.socket.recv(100)
    assert client.now_s == limit_s
    # An abort by the service provider.
    assert client.sent == b"\x07\0\0\0\0\x04\0\0\x02\0"


@pytest.mark.parametrize("established", [False, True])
def test_what_comes_in_time_is_taken_and_an_answer_may_take_as_long_as_silence(
    monkeypatch: pytest.MonkeyPatch, established: bool
) -> None:
    client = Client(monkeypatch, 30, 1.0, established)
    assert client.socket.recv(100) == bytes(100)
    assert client.now_s == 4.0
    assert client.timeouts[-1] == NETWORK_S


def test_a_pdu_may_be_as_long_as_is_announced_to_clients_with_its_header_and_no_longer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client = Client(monkeypatch, MAX_PDU_BYTES, 0.0, True)
    assert len(client.socket.recv(MAX_PDU_BYTES + 6)) == MAX_PDU_BYTES + 6
    assert not client.sent
    with pytest.raises(OSError, match="a PDU of 262151 bytes was announced, expected at most 262144"):
        client.socket.recv(MAX_PDU_BYTES + 7)
    assert client.sent


def test_a_pdu_that_makes_no_sense_where_it_comes_ends_the_association_and_closes_its_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    client = Client(monkeypatch, 1, 0.0, True)
    ended: list[bool] = []
    dul: Any = SimpleNamespace(socket=client.socket, assoc=client.socket.assoc, kill_dul=lambda: ended.append(True))
    machine = EndingStateMachine(dul)
    # Data, before there is a connection at all.
    machine.do_action("Evt10")
    assert not client.is_open
    assert ended == [True]
