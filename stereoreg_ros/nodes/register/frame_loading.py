"""The frames that a node registers, from the files that its parameters name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import load_frame

_TOPIC_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def load_frames(sources: Sequence[str]) -> tuple[Frame, ...]:
    """The frames; ValueError where one cannot be loaded, or several cannot have topics of their own."""
    frames = tuple(load_frame(source) for source in sources)
    names = [frame.name for frame in frames]
    for name in names:
        if len(names) > 1 and not _TOPIC_NAME.fullmatch(name):
            raise ValueError(
                f"frame_files: frame '{name}' cannot name a topic, expected a letter and then letters, digits and '_'"
            )
        if names.count(name) > 1:
            raise ValueError(f"frame_files: two frames are called '{name}', expected distinct names")
    return frames
