"""One input, tried: a result, a refusal that says what is wrong, or a finding."""

from __future__ import annotations

import resource
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fuzzing.kind import Kind

# Of the processor's time; and of time, for an input that waits for something.
HANG_S: Final = 1.0
WAIT_S: Final = 5.0
_LONGEST_REFUSAL: Final = 4000
_OUT_OF_MEMORY: Final = ("MemoryError", "bad_alloc", "Unable to allocate", "allocate memory")


@dataclass(frozen=True)
class Outcome:
    """finding: what went wrong, in a line that is the same for the same fault; empty where nothing did.

    accepted: whether the input was taken; details: of a finding, its traceback.
    """

    accepted: bool
    finding: str = ""
    details: str = ""


def outcome_of(kind: Kind, data: bytes) -> Outcome:
    """Try an input. A warning of numpy, as of an overflow, counts as an error."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            kind.attempt(data)
    except Exception as error:
        finding = _fault_of(kind, error)
        if not finding:
            return Outcome(accepted=False)
        return Outcome(False, finding, "".join(traceback.format_exception(error)))
    return Outcome(accepted=True)


def bound_memory(more_bytes: int) -> None:
    """Limit how much more memory this process may allocate; beyond it, an allocation fails with an error."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    bound = pages * resource.getpagesize() + more_bytes
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))


def peak_memory_bytes() -> int:
    """The most that this process has held so far, since it became this program.

    Not what getrusage says, which begins with what the process held that started it.
    """
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
    return 1024 * int(line.split()[1])


def _fault_of(kind: Kind, error: Exception) -> str:
    """What is wrong with a refusal; empty where it is one."""
    text = str(error)
    place = _place_of(error)
    if type(error) not in kind.refusals:
        return f"{type(error).__name__} at {place}"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) or any(word in str(cause) for word in _OUT_OF_MEMORY):
            return f"out of memory at {place}"
        cause = cause.__cause__ or cause.__context__
    if not kind.names(text):
        return f"{type(error).__name__} that names nothing at {place}"
    if len(text) > _LONGEST_REFUSAL:
        return f"{type(error).__name__} of more than {_LONGEST_REFUSAL} characters at {place}"
    try:
        # A message of ROS is UTF-8, which has no half of a surrogate pair.
        text.encode()
    except UnicodeEncodeError:
        return f"{type(error).__name__} that cannot be sent at {place}"
    return ""


def _place_of(error: Exception) -> str:
    """The innermost line of the package in the traceback, and the innermost of all."""
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return "an unknown place"
    own = [frame for frame in frames if "stereoreg_ros" in Path(frame.filename).parts[-4:]]
    places = [f"{Path(frame.filename).name}:{frame.name}" for frame in (own[-1:] + frames[-1:])]
    return " in ".join(dict.fromkeys(places))
