"""What memory a process holds, on Linux."""

from __future__ import annotations

from pathlib import Path


def memory_kib(pid: int) -> tuple[int, int]:
    """What the process holds that no file holds too, in memory or swapped out; and all that it has in memory.

    Its USS would not do: it goes up where another program that maps the same libraries ends.
    """
    kib = {}
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if value.endswith(" kB"):
            kib[name] = int(value.removesuffix(" kB"))
    return kib["RssAnon"] + kib["RssShmem"] + kib["VmSwap"], kib["VmRSS"]
