"""All kinds of input, by name."""

from __future__ import annotations

from typing import Final

from fuzzing.calibration_yaml import CALIBRATION
from fuzzing.dicom_object import DICOM
from fuzzing.frame_yaml import FRAME
from fuzzing.image_message import IMAGE
from fuzzing.kind import Kind
from fuzzing.parameter_request import PARAMETERS

KINDS: Final[dict[str, Kind]] = {kind.name: kind for kind in (IMAGE, FRAME, CALIBRATION, DICOM, PARAMETERS)}
