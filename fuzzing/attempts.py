"""The process that tries inputs of one kind, in a loop of atheris or in one of our own."""

from __future__ import annotations

import argparse
import hashlib
import importlib
import importlib.util
import json
import os
import random
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Final

from fuzzing.heartbeat import Heartbeat
from fuzzing.kind import Kind
from fuzzing.outcome import HANG_S, WAIT_S, bound_memory, outcome_of, peak_memory_bytes

HAS_ATHERIS: Final = importlib.util.find_spec("atheris") is not None
# Inputs that are kept of one fault.
_KEPT: Final = 2
# An exit status of its own: the last input made the process too large.
OUT_OF_MEMORY: Final = 87
_HANGS: Final = 88
# Share of atheris' inputs that are mutated by the kind's own function; the others by its engine.
_KNOWING: Final = 0.7
# Share that start again from an initial input: those that reach new branches drift into nonsense.
_AFRESH: Final = 0.6
# Numerical code; to count its branches would only slow it down.
_UNCOUNTED: Final = ["stereoreg_ros.matching", "stereoreg_ros.solvers", "stereoreg_ros.simulation"]
# Longer ones are tried, but not changed again and again: they take long. Valid ones may be of any length.
_LONGEST_CHANGED: Final = 4096
# A signal that ends the process is to be seen by the watcher.
_SIGNALS: Final = ("segv", "bus", "abrt", "ill", "fpe")


class _Attempts:
    """Tries inputs, says so to the watcher, and writes down findings to `folder`."""

    def __init__(self, kind: Kind, folder: Path) -> None:
        self._kind = kind
        self._folder = folder
        self.heartbeat = Heartbeat(folder / "heartbeat")
        self._kept: Counter[str] = Counter()
        for seed in kind.seeds():
            outcome_of(kind, seed)
        # The engine needs some as well.
        bound_memory(kind.memory_bytes + 2**31)
        self._most_memory = peak_memory_bytes() + kind.memory_bytes

    def try_input(self, data: bytes) -> None:
        self.heartbeat.begin(data)
        outcome = outcome_of(self._kind, data)
        if peak_memory_bytes() > self._most_memory:
            os._exit(OUT_OF_MEMORY)
        self.heartbeat.end(outcome.accepted)
        if outcome.finding:
            self._keep(data, outcome.finding, outcome.details)

    def _keep(self, data: bytes, finding: str, details: str) -> None:
        self._kept[finding] += 1
        with (self._folder / "findings").open("a", encoding="utf-8") as findings:
            findings.write(json.dumps({"finding": finding}) + "\n")
        if self._kept[finding] <= _KEPT:
            name = hashlib.sha256(data).hexdigest()[:12]
            (self._folder / f"{name}{self._kind.ending}").write_bytes(data)
            (self._folder / f"{name}.txt").write_text(f"{finding}\n\n{details}", "utf-8", "backslashreplace")


def _known(kind: Kind) -> list[bytes]:
    """Valid inputs, and what was found before."""
    return kind.seeds() + [path.read_bytes() for path in kind.found]


def _short(known: list[bytes], kind: Kind) -> list[bytes]:
    most = max(_LONGEST_CHANGED, *map(len, kind.seeds()))
    return [data for data in known if len(data) <= most]


def _run_own(attempts: _Attempts, kind: Kind, inputs: int, seed: int) -> None:
    """Inputs made from the known ones."""
    rng = random.Random(seed)
    known = _known(kind)
    short = _short(known, kind)
    for data in known[:inputs]:
        attempts.try_input(data)
    for _ in range(inputs - len(known)):
        attempts.try_input(kind.mutate(rng.choice(short), rng))


def _run_atheris(attempts: _Attempts, kind: Kind, inputs: int, seed: int, folder: Path) -> None:
    """Inputs made from those that reached new branches of the package; ends the process."""
    import atheris

    grown = folder / "corpus"
    grown.mkdir(exist_ok=True)
    known = _known(kind)
    for number, data in enumerate(known):
        (grown / f"known-{number}").write_bytes(data)

    short = _short(known, kind)
    longest = max(map(len, short))

    def mutated(data: bytes, most: int, number: int) -> bytes:
        rng = random.Random(number)
        if rng.random() < _AFRESH or len(data) > longest:
            data = rng.choice(short)
        if rng.random() < _KNOWING:
            changed: bytes = kind.mutate(data, rng)
        else:
            changed = atheris.Mutate(data, most)
        return changed[:most]

    options = [
        *(f"-runs={inputs}", f"-seed={seed % 2**31 + 1}", "-max_len=90000", "-len_control=0", "-print_final_stats=0"),
        # Hangs and memory are the watcher's task.
        *("-timeout=100000", "-rss_limit_mb=0", "-malloc_limit_mb=0", "-verbosity=0", f"-artifact_prefix={folder}/"),
        *(f"-handle_{signal}=0" for signal in _SIGNALS),
    ]
    atheris.Setup(["fuzzing", *options, str(grown)], attempts.try_input, custom_mutator=mutated)
    atheris.Fuzz()


def _hangs(kind: Kind, data: bytes) -> bool:
    """Whether an input does so three times in a row: what is filled once is there the second time."""
    for _ in range(3):
        started_s, started_cpu_s = time.monotonic(), time.process_time()
        outcome_of(kind, data)
        if time.process_time() - started_cpu_s <= HANG_S and time.monotonic() - started_s <= WAIT_S:
            return False
    return True


def main() -> int:
    """Entry point: try `inputs` inputs; or, with --again, one input alone, to see whether it really hangs."""
    parser = argparse.ArgumentParser(prog="python -m fuzzing.attempts", description=__doc__)
    parser.add_argument("kinds", help="module with KINDS")
    parser.add_argument("kind")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--inputs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--again", type=Path)
    arguments = parser.parse_args()
    if HAS_ATHERIS and not arguments.again:
        import atheris

        # Imported here for the first time, so that branches count.
        with atheris.instrument_imports(include=["stereoreg_ros"], exclude=_UNCOUNTED, enable_loader_override=False):
            kinds = importlib.import_module(arguments.kinds).KINDS
    else:
        kinds = importlib.import_module(arguments.kinds).KINDS
    kind = kinds[arguments.kind]
    attempts = _Attempts(kind, arguments.folder)
    if arguments.again:
        attempts.heartbeat.begin(arguments.again.read_bytes())
        hangs = _hangs(kind, arguments.again.read_bytes())
        attempts.heartbeat.end(accepted=False)
        return _HANGS if hangs else 0
    if HAS_ATHERIS:
        _run_atheris(attempts, kind, arguments.inputs, arguments.seed, arguments.folder)
    else:
        _run_own(attempts, kind, arguments.inputs, arguments.seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
