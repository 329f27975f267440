"""What was found by fuzzing stays mended; and the fuzzer does see hangs, crashes, memory and errors without a name."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from fuzzing import watch
from fuzzing.kind import CORPUS, Kind
from fuzzing.kinds import KINDS
from fuzzing.outcome import outcome_of
from support.harmful_kinds import KINDS as HARMFUL

TESTS = Path(__file__).parents[1]
FOUND = [(kind, path) for kind in KINDS.values() for path in kind.found]


@pytest.mark.parametrize(("kind", "path"), FOUND, ids=[f"{kind.name}-{path.stem}" for kind, path in FOUND])
def test_what_was_found_does_no_harm(kind: Kind, path: Path) -> None:
    outcome = outcome_of(kind, path.read_bytes())
    assert not outcome.finding, outcome.details
    if path.name.startswith("valid-"):
        assert outcome.accepted


def test_the_corpus_holds_nothing_that_is_not_tried() -> None:
    tried = {path for kind in KINDS.values() for path in kind.found}
    assert tried == {path for path in CORPUS.rglob("*") if path.is_file()}


@pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))
def test_valid_inputs_are_accepted_and_changed_ones_do_no_harm(kind: Kind) -> None:
    rng = random.Random(20)
    seeds = kind.seeds()
    for seed in seeds:
        outcome = outcome_of(kind, seed)
        assert outcome.accepted, outcome.details
    accepted = 0
    for _ in range(400):
        data = kind.mutate(rng.choice(seeds), rng)
        outcome = outcome_of(kind, data)
        assert not outcome.finding, outcome.details
        accepted += outcome.accepted
    # Neither is everything refused at the door, nor is anything taken.
    assert 10 < accepted < 390


@pytest.fixture
def harmful_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that tries inputs finds `harmful_kinds`."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(TESTS), str(TESTS.parent))))


@pytest.mark.usefixtures("harmful_found")
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("hangs", "hang"),
        ("waits", "hang"),
        ("crashes", "crash: SIGSEGV"),
        ("swells", "too much memory"),
        ("asks for much", "out of memory"),
        ("fails", "KeyError"),
        ("names nothing", "ValueError that names nothing"),
        ("warns", "RuntimeWarning"),
    ],
)
def test_harm_is_seen_and_kept(name: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "_AGAIN_S", 1.5)
    kind = HARMFUL[name]
    report = watch.run(kind, 8, 1, tmp_path / "run", kinds="support.harmful_kinds")
    assert report.inputs >= 8
    assert report.accepted > 0
    assert report.findings
    assert all(finding.startswith(told) for finding in report.findings), report.findings
    kept = list((tmp_path / "run").glob("*.txt"))
    assert kept
    for text in kept:
        assert told in text.read_text(encoding="utf-8")
        assert b"!" in text.with_suffix(kind.ending).read_bytes()


@pytest.mark.usefixtures("harmful_found")
def test_what_does_no_harm_is_counted(tmp_path: Path) -> None:
    report = watch.run(HARMFUL["harmless"], 300, 1, tmp_path / "run", kinds="support.harmful_kinds")
    assert not report.findings
    assert report.inputs == 300
    assert 0 < report.accepted < 300
