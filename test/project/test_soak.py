"""What `make soak` judges: a leak and a rising latency are told from noise, from warming up and from other work."""

from __future__ import annotations

import numpy as np
import pytest

from support.soak_verdict import Sample, Verdict, verdict_of, windows_of

RATE_HZ, SAMPLE_S, UNIT_S = 20.0, 2.0, 0.001


def run(minutes: float, *, memory_mib=lambda t: 200.0, latency_s=lambda t: 0.01, load=lambda t: 1.0) -> Verdict:
    """A run whose memory, latency and slowness of the machine are functions of the seconds since its start."""
    rng, begun = np.random.default_rng(0), 1_800_000_000 * 10**9
    seconds = np.arange(0.0, 60 * minutes, 1 / RATE_HZ)
    latencies = np.array([latency_s(t) * load(t) for t in seconds]) * rng.lognormal(0.0, 0.3, seconds.size)
    samples = [
        Sample(begun + int(1e9 * t), memory_mib(t) + rng.uniform(0, 0.05), 300.0, UNIT_S * load(t))
        for t in np.arange(0.0, 60 * minutes, SAMPLE_S)
    ]
    stamps = begun + (1e9 * seconds).astype(np.int64)
    return verdict_of(windows_of(stamps, latencies, samples), latencies)


@pytest.mark.parametrize("minutes", [5.0, 60.0])
def test_a_steady_run_is_as_it_has_to_be(minutes):
    verdict = run(minutes, memory_mib=lambda t: 210.0 - 40.0 * np.exp(-t / 8.0))
    assert verdict.missed == []
    assert verdict.growth_mb == pytest.approx(0.0, abs=0.1)
    assert verdict.p50_y == pytest.approx([10.0] * 6, rel=0.05)


@pytest.mark.parametrize("minutes", [5.0, 60.0])
def test_a_leak_is_seen(minutes):
    leak_mib = 1.5
    verdict = run(minutes, memory_mib=lambda t: 200.0 + leak_mib * t / (60 * minutes))
    assert verdict.missed == [f"memory grew by {verdict.growth_mb:.2f} MB, expected less than 1"]
    assert 1.0 <= verdict.growth_mb <= 1.048576 * leak_mib


def test_growth_that_is_given_back_later_counts():
    verdict = run(60.0, memory_mib=lambda t: 202.0 if 1800 <= t < 2000 else 200.0)
    assert verdict.growth_mb == pytest.approx(2.1, abs=0.1)


def test_one_sample_of_a_window_does_not():
    assert run(60.0, memory_mib=lambda t: 250.0 if 1800 <= t < 1802 else 200.0).missed == []


def test_a_rising_latency_is_seen():
    verdict = run(60.0, latency_s=lambda t: 0.01 * (1 + t / 3600))
    assert verdict.missed == [
        f"p99 of the last sixth is {verdict.p99_y[-1] / verdict.p99_y[0]:.2f} times that of the first, "
        "expected at most 1.5"
    ]


def test_a_slower_machine_is_not_taken_for_it():
    assert run(60.0, load=lambda t: 3.0 if t > 3000 else 1.0).missed == []


def test_nor_is_other_work_for_a_minute():
    assert run(60.0, latency_s=lambda t: 0.1 if 3300 <= t < 3360 else 0.01).missed == []


def test_a_window_without_an_answer_is_told():
    samples = [Sample(10**9 * t, 200.0, 300.0, UNIT_S) for t in range(120)]
    stamps = np.array([*range(0, 40), *range(80, 120)]) * 10**9
    with pytest.raises(ValueError, match="no slice was answered or no sample taken between"):
        windows_of(stamps, np.full(stamps.size, 0.01), samples)
