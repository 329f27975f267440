"""Inputs tried in a process of their own, which is watched: a hang or a crash in C code ends that, not the run."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tqdm import tqdm

from fuzzing.attempts import OUT_OF_MEMORY
from fuzzing.heartbeat import Heartbeat
from fuzzing.kind import Kind
from fuzzing.outcome import HANG_S, WAIT_S

_POLL_S: Final = 0.02
# To start Python and ROS on a busy machine.
_START_S: Final = 120.0
# An input that is tried three times again may take so long; then it hangs for good.
_AGAIN_S: Final = 3 * WAIT_S


@dataclass
class Report:
    """What came of the inputs of one kind. findings: number of inputs for each."""

    kind: str
    inputs: int = 0
    accepted: int = 0
    slowest_ms: float = 0.0
    findings: Counter[str] = field(default_factory=Counter)


def run(kind: Kind, inputs: int, seed: int, folder: Path, kinds: str = "fuzzing.kinds") -> Report:
    """Try inputs; findings then lie in `folder`, with what went wrong beside each.

    kinds: the module in whose KINDS the process finds the kind.
    """
    name = kind.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    heartbeat = Heartbeat(folder / "heartbeat")
    report = Report(name)
    with (
        (folder / "log").open("wb") as log,
        tqdm(total=inputs, desc=name, unit="input", unit_scale=True, disable=None) as bar,
    ):
        restarts = 0
        while heartbeat.tried < inputs:
            command = [sys.executable, "-W", "ignore", "-m", "fuzzing.attempts", kinds, name, str(folder)]
            command += ["--inputs", str(inputs - heartbeat.tried), "--seed", str(seed + restarts)]
            with subprocess.Popen(command, stdout=log, stderr=log) as process:
                ending = _watched(process, heartbeat, bar)
            if ending and heartbeat.started_ns:
                data = heartbeat.current
                heartbeat.given_up()
                finding = _again(kinds, name, data, ending, folder)
                if finding:
                    _keep(kind, data, finding, folder)
            elif ending:
                raise RuntimeError(f"{' '.join(command)} {ending}; its output is in {folder / 'log'}")
            restarts += 1
        bar.update(heartbeat.tried - bar.n)
    report.inputs, report.accepted = heartbeat.tried, heartbeat.accepted
    report.slowest_ms = heartbeat.slowest_ns / 1e6
    (folder / f"slowest{kind.ending}").write_bytes(heartbeat.slowest)
    if (folder / "findings").exists():
        lines = (folder / "findings").read_text(encoding="utf-8").splitlines()
        report.findings.update(json.loads(line)["finding"] for line in lines)
    return report


def _watched(process: subprocess.Popen[bytes], heartbeat: Heartbeat, bar: tqdm) -> str:
    """Wait for the end; returns what was wrong with it, or nothing."""
    started_s = time.monotonic()
    first = heartbeat.tried
    while process.poll() is None:
        time.sleep(_POLL_S)
        bar.update(heartbeat.tried - bar.n)
        began_ns = heartbeat.started_ns
        if began_ns and _hangs(process.pid, heartbeat, began_ns):
            process.kill()
            process.wait()
            return "hang"
        if heartbeat.tried == first and not began_ns and time.monotonic() - started_s > _START_S:
            process.kill()
            return f"did not start within {_START_S:g} s"
    if process.returncode == 0:
        return ""
    if process.returncode == OUT_OF_MEMORY:
        return "too much memory"
    if process.returncode < 0:
        return f"crash: {signal.Signals(-process.returncode).name}"
    return f"ended with status {process.returncode}"


def _hangs(pid: int, heartbeat: Heartbeat, began_ns: int) -> bool:
    waited_s = (time.monotonic_ns() - began_ns) / 1e9
    if waited_s <= HANG_S:
        return False
    try:
        used = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[11:13]
    except OSError:
        return False
    used_s = sum(map(int, used)) / os.sysconf("SC_CLK_TCK") - heartbeat.started_cpu_ns / 1e9
    # The next input may have begun meanwhile.
    return heartbeat.started_ns == began_ns and (used_s > HANG_S or waited_s > WAIT_S)


def _again(kinds: str, name: str, data: bytes, ending: str, folder: Path) -> str:
    """Try an input alone in a fresh process: what was wrong with it, or nothing, where the machine was only busy."""
    if ending != "hang":
        return ending
    alone = folder / "again"
    shutil.rmtree(alone, ignore_errors=True)
    alone.mkdir()
    (alone / "input").write_bytes(data)
    command = [sys.executable, "-W", "ignore", "-m", "fuzzing.attempts", kinds, name, str(alone)]
    with subprocess.Popen([*command, "--again", str(alone / "input")], stderr=subprocess.DEVNULL) as process:
        heartbeat = Heartbeat(alone / "heartbeat")
        while process.poll() is None:
            time.sleep(_POLL_S)
            began_ns = heartbeat.started_ns
            if began_ns and time.monotonic_ns() - began_ns > 1e9 * _AGAIN_S:
                process.kill()
    return "" if process.returncode == 0 else ending


def _keep(kind: Kind, data: bytes, finding: str, folder: Path) -> None:
    with (folder / "findings").open("a", encoding="utf-8") as findings:
        findings.write(json.dumps({"finding": finding}) + "\n")
    stem = hashlib.sha256(data).hexdigest()[:12]
    (folder / f"{stem}{kind.ending}").write_bytes(data)
    (folder / f"{stem}.txt").write_text(finding + "\n", encoding="utf-8")
