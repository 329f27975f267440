"""The DICOM receiver as a process of its own: scanners on one side, DDS on the other."""

from __future__ import annotations

import contextlib
import signal
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from pydicom.uid import CTImageStorage, RTStructureSetStorage

from support.dicom_clients import association, connect, echo, run_dcmtk, send
from support.dicom_files import write_slice

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from stereoreg_ros.dicom import read_slice
from stereoreg_ros.nodes.common.conversions import pose_to_message
from support.ros_process import REPOSITORY, RosClient, node_process
from support.scanner_nodes import (
    CANNOT_UNDERSTAND,
    OUT_OF_RESOURCES,
    SUCCESS,
    Received,
    hung_up,
    pixels,
    play,
    port_of,
    receiver,
    receiving_process,
    seconds,
)

IMAGE = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)


@pytest.fixture
def client():
    with RosClient() as ros:
        yield ros


def test_slices_come_out_as_the_player_publishes_them(client, tmp_path):
    tilt = np.radians(25)
    tilted = [1.0, 0.0, 0.0, 0.0, np.cos(tilt), -np.sin(tilt)]
    elements: list[dict[str, Any]] = [
        {"PixelSpacing": [0.7, 0.4]},
        {"ImageOrientationPatient": tilted, "GantryDetectorTilt": 25.0},
        {"ImageOrientationPatient": [0.0, 1.0, 0.0, 0.6, 0.0, -0.8]},
        {"RescaleSlope": 0.5, "RescaleIntercept": "-1024.25"},
        {"PixelData": (IMAGE.astype(np.int16) - 50).tobytes(), "PixelRepresentation": 1, "RescaleIntercept": 0.0},
        {"PixelPaddingValue": 3},
    ]
    paths = [write_slice(tmp_path / f"{n}.dcm", IMAGE + n, 2.5 * n, **one) for n, one in enumerate(elements)]
    with receiver(client) as received:
        assert [one.Status for one in send(received.port, *paths)] == [SUCCESS] * len(paths)
        received.wait(len(paths))
    for number, (path, pose, image) in enumerate(zip(paths, list(received.poses), list(received.images), strict=True)):
        assert pose.header == image.header
        assert pose.header.frame_id == "scanner"
        read = read_slice(path).ct_slice
        np.testing.assert_array_equal(pixels(image), read.hu)
        assert pose.pose == pose_to_message(read.scanner_from_slice)
        assert image.encoding == ("32FC1" if number == 3 else "16SC1")
    for path in paths[1:3]:
        with play(path) as player:
            # It is heard by the same subscriptions.
            received.wait(len(received.images) + 1)
            assert player.wait() == 0
    for number, played in ((1, -2), (2, -1)):
        assert received.poses[number].pose == received.poses[played].pose
        received.images[number].header = received.images[played].header
        assert received.images[number] == received.images[played]


def test_they_come_in_order_with_the_time_of_arrival(client, tmp_path):
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE + z, -float(z)) for z in range(30)]
    with receiver(client) as received:
        send(received.port, *paths)
        images = received.wait(30)
        arrived = time.time()
    assert [pixels(image)[0, 0] for image in images] == [z - 1024 for z in range(30)]
    stamps = np.array([seconds(image.header) for image in images])
    assert (np.diff(stamps) > 0).all()
    assert (np.abs(stamps - arrived) < 60).all()


def test_a_slice_that_waits_keeps_the_time_of_its_arrival(client, tmp_path):
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    with receiving_process() as process:
        port = port_of(process, client)
        (response,) = send(port, path)
        arrived = time.time()
        assert response.Status == SUCCESS
        with pytest.raises(AssertionError, match="in vain"):
            client.wait_for(lambda: False, "nobody to listen", 1.0)
        received = Received(process, client)
        received.wait(1)
    assert abs(seconds(received.images[0].header) - arrived) < 0.5


@pytest.mark.parametrize(
    ("elements", "comment"),
    [
        ({"PixelSpacing": None}, "Pixel Spacing (0028,0030) is missing, expected 2 finite numbers"),
        ({"PixelSpacing": [0.5, 500.0]}, "Pixel Spacing (0028,0030) is [0.5, 500.0], expected 0.00"),
        ({"PixelData": IMAGE.tobytes()[:100]}, "Pixel Data (7FE0,0010) has 100 bytes, expected 384 bytes"),
        (
            {"ImagePositionPatient": None, "ImageOrientationPatient": None},
            "Image Position (Patient) (0020,0032) is",
        ),
        ({"RescaleSlope": None, "RescaleIntercept": None}, "Rescale Slope (0028,1053) is missing, expected that of a"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "LOCALIZER"]}, "Image Type (0008,0008) is ['ORIGINAL', 'PRIMARY', 'LOC"),
        ({"HighBit": 11}, "High Bit (0028,0102) is 11, expected 15"),
        ({"Rows": 8000, "Columns": 8000}, "its pixels take 128000000 bytes, expected 67108864 at most"),
        ({"NumberOfFrames": 2}, "Number of Frames (0028,0008) is"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name_and_the_next_is_taken(tmp_path, broken_slices, elements, comment):
    received = broken_slices
    before = len(received.images)
    bad = write_slice(tmp_path / "bad.dcm", IMAGE, **elements)
    good = write_slice(tmp_path / "good.dcm", IMAGE + before + 1)
    refused, taken = send(received.port, bad, good)
    assert refused.Status == CANNOT_UNDERSTAND
    assert refused.ErrorComment.startswith(comment[:64])
    assert taken.Status == SUCCESS
    received.wait(before + 1)
    assert pixels(received.images[-1])[0, 0] == before + 1 - 1024
    assert len(received.images) == before + 1
    assert "refused with status 0xC000 what 'SCANNER' at 127.0.0.1 sent: " in received.process.output


@pytest.fixture(scope="module")
def broken_slices():
    # By its namespace, as it runs while the other tests do.
    with RosClient(namespace="/broken") as ros, receiver(ros, namespace="/broken") as received:
        yield received


def test_other_objects_are_not_negotiated(tmp_path, broken_slices):
    with association(broken_slices.port, [(CTImageStorage, None), (RTStructureSetStorage, None)]) as opened:
        accepted = {one.abstract_syntax for one in opened.accepted_contexts}
    assert CTImageStorage in accepted
    assert RTStructureSetStorage not in accepted


def test_echo(broken_slices):
    assert echo(broken_slices.port) == SUCCESS


def test_echo_and_store_of_dcmtk(tmp_path, client):
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE + z, float(z)) for z in range(3)]
    with receiver(client) as received:
        at = ["-aet", "SCANNER", "-aec", "STEREOREG", "127.0.0.1", received.port]
        assert run_dcmtk("echoscu", *map(str, at)).returncode == 0
        sent = run_dcmtk("storescu", *map(str, at), *paths)
        assert sent.returncode == 0, sent.stderr
        images = received.wait(3)
    assert [pixels(image)[0, 0] for image in images] == [-1024, -1023, -1022]


def test_callers_that_are_not_allowed_are_rejected(client, tmp_path):
    with receiver(client, allowed_callers=["CT1", "CT2"]) as received:
        assert echo(received.port, caller="CT2") == SUCCESS
        with association(received.port, caller="OTHER") as opened:
            assert opened.is_rejected
        received.wait_for_log("association of 'OTHER' at 127.0.0.1 rejected: 'OTHER' is not among the allowed callers")
        with association(received.port, caller="CT1", called="ANY-SCP") as opened:
            assert opened.is_rejected
        received.wait_for_log("rejected: it called 'ANY-SCP', expected 'STEREOREG'")
        assert echo(received.port, caller="CT1") == SUCCESS


def test_too_many_associations_are_rejected_until_one_ends(client):
    with receiver(client, max_associations=2) as received:
        with association(received.port) as first, association(received.port) as second:
            assert first.is_established
            assert second.is_established
            with association(received.port) as third:
                assert third.is_rejected
            received.wait_for_log("association of 'SCANNER' at 127.0.0.1 rejected: 2 are open already")
            assert first.send_c_echo().Status == SUCCESS
        client.wait_for(lambda: echo(received.port) == SUCCESS, "a place")


def test_oversized_objects(client, tmp_path):
    just_too_large = write_slice(tmp_path / "a.dcm", np.zeros((725, 725), np.uint16))
    huge = write_slice(tmp_path / "b.dcm", np.zeros((2048, 2048), np.uint16))
    good = write_slice(tmp_path / "c.dcm", IMAGE)
    with receiver(client, max_object_mb=1) as received:
        refused, taken = send(received.port, just_too_large, good)
        assert (refused.Status, taken.Status) == (OUT_OF_RESOURCES, SUCCESS)
        assert refused.ErrorComment.endswith("expected 1048576 at most")
        # Not even received: the association is aborted.
        (response,) = send(received.port, huge)
        assert "Status" not in response
        received.wait_for_log("association of 'SCANNER' at 127.0.0.1 aborted: an object has more than 1048576 bytes")
        assert send(received.port, good)[0].Status == SUCCESS
        received.wait(2)
    assert len(received.images) == 2


GARBAGE = {
    "text": b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "zeros": bytes(5000),
    "noise": np.random.default_rng(3).bytes(200_000),
    "huge associate request": b"\x01\x00\xff\xff\xff\xff" + bytes(1000),
    "huge data": b"\x04\x00\x7f\xff\xff\xff" + bytes(1000),
    "data without an association": b"\x04\x00\x00\x00\x00\x06\x00\x00\x00\x02\x01\x03",
    "associate request of nothing": b"\x01\x00\x00\x00\x00\x44" + bytes(0x44),
    "abort": b"\x07\x00\x00\x00\x00\x04\x00\x00\x00\x00",
}


@pytest.mark.parametrize("garbage", GARBAGE.values(), ids=GARBAGE.keys())
def test_garbage_is_hung_up_on(broken_slices, garbage):
    with connect(broken_slices.port) as connection:
        try:
            connection.sendall(garbage)
            while connection.recv(4096):
                pass
        except ConnectionError:
            pass
    assert echo(broken_slices.port) == SUCCESS


def test_clients_that_stall_are_let_go_and_others_served_meanwhile(client, tmp_path):
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    with (
        receiver(client, max_associations=2, association_timeout=2.0, network_timeout=3.0) as received,
        connect(received.port) as silent,
        connect(received.port) as halting,
        association(received.port) as idle,
    ):
        begun = time.monotonic()
        halting.sendall(b"\x01\x00\x00\x00\x01\x00half of a req")
        assert send(received.port, path)[0].Status == SUCCESS
        assert time.monotonic() - begun < 2.0
        for stalled in (silent, halting):
            assert hung_up(stalled)
        assert 1.0 < time.monotonic() - begun < 10.0
        client.wait_for(lambda: not idle.is_established, "the end of the idle association")
        received.wait(1)


def test_connections_that_never_ask_for_an_association_leave_room_for_one(client):
    with receiver(client, max_associations=2, association_timeout=2.0) as received:
        connections = [connect(received.port) for _ in range(30)]
        received.wait_for_log("closed: too many are open")
        client.wait_for(lambda: echo(received.port) == SUCCESS, "a place")
        for connection in connections:
            connection.close()
        # Those that hang up are not waited for.
        connections = [connect(received.port) for _ in range(2)]
        for connection in connections:
            connection.close()
        client.wait_for(lambda: echo(received.port) == SUCCESS, "a place", 1.5)


def test_a_full_queue_refuses_and_loses_nothing(client, tmp_path):
    paths = [write_slice(tmp_path / f"{z}.dcm", IMAGE + z, float(z)) for z in range(5)]
    with receiving_process(max_queue=3) as process:
        port = port_of(process, client)
        responses = send(port, *paths)
        assert [one.Status for one in responses] == [SUCCESS] * 3 + [OUT_OF_RESOURCES] * 2
        assert responses[-1].ErrorComment == "3 slices are already waiting, no room for 1 more"
        received = Received(process, client)
        received.wait(3)
        assert [one.Status for one in send(port, *paths[3:])] == [SUCCESS] * 2
        images = received.wait(5)
    assert [pixels(image)[0, 0] + 1024 for image in images] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("with_signal", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_within_a_second_with_open_associations(client, tmp_path, with_signal):
    with receiver(client) as received, association(received.port) as opened, connect(received.port) as halting:
        assert opened.is_established
        halting.sendall(b"\x01\x00\x00\x00\x01\x00half of a req")
        assert echo(received.port) == SUCCESS
        code, duration_s = received.process.stop(with_signal)
        assert code == 0
        # Within a second on a machine that has nothing else to do.
        assert duration_s < 3.0
        client.wait_for(lambda: not opened.is_established, "the abort of the association")


def test_it_says_what_it_could_not_publish(client, tmp_path):
    with receiving_process() as process:
        port = port_of(process, client)
        send(port, write_slice(tmp_path / "a.dcm", IMAGE))
        assert process.stop()[0] == 0
        assert "ended with 1 slices that were not published" in process.output


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"port": 70000}, "port"),
        ({"allowed_callers": "CT1"}, "allowed_callers is 'CT1', expected a list of AE titles"),
        ({"network_timeout": 5}, "network_timeout"),
        ({"address": "no.such.host.invalid"}, "cannot listen at no.such.host.invalid port 0"),
        ({"tls_certificate": "/no/c.pem", "tls_key": "/no/k.pem"}, "TLS certificate /no/c.pem: no such file"),
        ({"watch_folder": "/nowhere"}, "watch_folder is '/nowhere', expected a folder"),
        ({"register_node": "two words"}, "'two words' is no name of a node"),
    ],
)
def test_it_does_not_start_on_wrong_parameters(parameters, sentence):
    with receiving_process(**parameters) as process:
        assert process.wait() == 1
        assert sentence in process.output
        assert "Traceback" not in process.output


def test_it_does_not_start_where_another_listens(broken_slices):
    with receiving_process(port=broken_slices.port) as process:
        assert process.wait() == 1
        assert f"cannot listen at 127.0.0.1 port {broken_slices.port}" in process.output


def test_the_shipped_parameter_file_starts_it(client, tmp_path):
    text = (REPOSITORY / "config" / "receive_dicom_node.yaml").read_text(encoding="utf-8")
    file = tmp_path / "parameters.yaml"
    file.write_text(text.replace("port: 11112", "port: 0"), encoding="utf-8")
    with node_process("receive_dicom_node", "--ros-args", "--params-file", str(file)) as process:
        assert echo(port_of(process, client)) == SUCCESS


def test_files_of_a_watched_folder_come_out_beside_those_of_the_network(client, tmp_path):
    folder = tmp_path / "export"
    folder.mkdir()
    write_slice(folder / "old.dcm", IMAGE)
    with receiver(client, watch_folder=str(folder), watch_period=0.1) as received:
        write_slice(folder / "new.part", IMAGE + 5).rename(folder / "new.dcm")
        received.wait(1)
        write_slice(folder / "broken.dcm", IMAGE, PixelSpacing=None)
        received.wait_for_log("broken.dcm: Pixel Spacing (0028,0030) is missing")
        assert send(received.port, write_slice(tmp_path / "sent.dcm", IMAGE + 6))[0].Status == SUCCESS
        images = received.wait(2)
        assert received.process.output.count("broken.dcm") == 1
    assert [pixels(image)[0, 0] + 1024 for image in images] == [5, 6]


def test_sessions_with_flipped_bytes_leave_it_serving(client, tmp_path):
    """What a client sends from the first byte to the last, spoilt here and there, on connections of their own."""
    path = write_slice(tmp_path / "a.dcm", IMAGE)
    rng = np.random.default_rng(17)
    with receiver(client, association_timeout=1.0, network_timeout=1.0) as received:
        session = recorded_session(received.port, path)
        for _ in range(150):
            spoilt = np.frombuffer(session, np.uint8).copy()
            spoilt[rng.integers(0, len(spoilt), rng.integers(1, 8))] = rng.integers(0, 256)
            with connect(received.port) as connection, contextlib.suppress(ConnectionError):
                connection.sendall(spoilt.tobytes())
                connection.shutdown(socket.SHUT_WR)
                assert hung_up(connection)
        client.wait_for(lambda: echo(received.port) == SUCCESS, "a place")
        assert send(received.port, path)[0].Status == SUCCESS
        assert "Traceback" not in received.process.output


def recorded_session(port: int, path: Path) -> bytes:
    """Everything that a client sends to ask for an association, store a file and release."""
    sent: list[bytes] = []
    dataset = pydicom.dcmread(path)
    with association(port, [(CTImageStorage, dataset.file_meta.TransferSyntaxUID)], sent=sent) as opened:
        assert opened.send_c_store(dataset).Status == SUCCESS
    return b"".join(sent)
