"""The status of the stream of slices: what it counts, and since when."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from diagnostic_msgs.msg import DiagnosticStatus

from stereoreg_ros.nodes.register.stream_status import NAME, StreamCounts, StreamStatus

STALE_S = 10.0


def report(
    stream: StreamStatus, now_s: float, received: int = 0, skipped: int = 0, waiting: int = 0, missing: str = ""
) -> dict[str, str]:
    """What is said: the values, and under "" the level and the message."""
    status = stream.report(now_s, StreamCounts(received, skipped, waiting), STALE_S, "the robot", missing)
    assert (status.name, status.hardware_id) == (NAME, "the robot")
    level = {DiagnosticStatus.OK: "OK", DiagnosticStatus.WARN: "WARN", DiagnosticStatus.ERROR: "ERROR"}[status.level]
    return {"": f"{level}: {status.message}"} | {one.key: one.value for one in status.values}


def test_before_the_first_slice_it_is_waited_for_and_has_no_age() -> None:
    stream = StreamStatus(100.0)
    said = report(stream, 1e6)
    assert said[""] == "OK: waiting for the first slice"
    assert (said["last_slice_age_s"], said["latency_ms"], said["latency_max_ms"]) == ("nan", "nan", "nan")


def test_counts_are_since_the_start_but_rates_and_latencies_since_the_last_report() -> None:
    stream = StreamStatus(100.0)
    for now_s, latency_ms in ((101.0, 30.0), (102.0, 50.0), (103.0, 20.0), (103.5, math.nan)):
        stream.registered(now_s, latency_ms)
    said = report(stream, 108.0, received=7, skipped=2, waiting=1)
    assert said == {
        "": "WARN: 2 slices skipped: they come faster than registered",
        "slices_received": "7",
        "slices_registered": "4",
        "slices_skipped": "2",
        "slices_waiting": "1",
        "slices_per_second": "0.5",
        "last_slice_age_s": "4.5",
        # The last that is known, and the longest.
        "latency_ms": "20",
        "latency_max_ms": "50",
    }
    stream.registered(109.0, 5.0)
    said = report(stream, 110.0, received=9, skipped=2)
    assert said[""] == "OK: 2 slices received"
    assert (said["slices_received"], said["slices_registered"], said["slices_skipped"]) == ("9", "5", "2")
    assert (said["slices_per_second"], said["latency_ms"], said["latency_max_ms"]) == ("0.5", "5", "5")


def test_a_stream_that_stops_is_stale_and_says_so_again_and_again() -> None:
    stream = StreamStatus(0.0)
    stream.registered(50.0, 10.0)
    report(stream, 51.0, received=1)
    assert report(stream, 59.5, received=1)[""] == "OK: 0 slices received"
    assert report(stream, 61.5, received=1)[""] == "WARN: stale: no slice for 11.5 s"
    assert report(stream, 62.5, received=1)[""] == "WARN: stale: no slice for 12.5 s"
    # One slice, and it is not.
    stream.registered(72.0, 10.0)
    assert report(stream, 72.5, received=2)[""] == "OK: 1 slices received"


def test_as_long_as_is_allowed_is_not_stale() -> None:
    stream = StreamStatus(0.0)
    stream.registered(50.0, 10.0)
    assert report(stream, 50.0 + STALE_S, received=1)[""] == "OK: 1 slices received"


@pytest.mark.parametrize("has_slices", [False, True])
def test_what_has_to_be_set_first_is_told_before_all_else(has_slices: bool) -> None:
    stream = StreamStatus(0.0)
    if has_slices:
        stream.registered(1.0, 10.0)
    said = report(stream, 30.0, received=5, skipped=3, missing="no pixel spacing: set the parameter pixel_spacing")
    assert said[""] == "ERROR: no pixel spacing: set the parameter pixel_spacing"


def test_stale_is_told_before_skipped() -> None:
    stream = StreamStatus(0.0)
    stream.registered(1.0, 10.0)
    assert report(stream, 30.0, received=5, skipped=3)[""].startswith("WARN: stale")
