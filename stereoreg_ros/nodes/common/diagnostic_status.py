"""What `/diagnostics` says about one image; the node puts its name before those of the statuses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from stereoreg_ros.result import Reason, Refusal, Registration, diagnostics

NAME: Final = "registration"


def name_of_status(node_name: str, what: str) -> str:
    """Name of a status: the fully qualified name of the node that it is of, and what it is about.

    Two nodes in two namespaces would take each other's place in a table that goes by the name.
    """
    return f"{node_name.lstrip('/')}: {what}"


def status_of(
    result: Registration | Refusal, calibration: str, duration_s: float, hardware_id: str
) -> DiagnosticStatus:
    """Status of a slice that came to registration: OK, WARN where the result bears a caution, ERROR where refused."""
    values = diagnostics(result, calibration, duration_s)
    if not result:
        return status_with(DiagnosticStatus.ERROR, NAME, result.message, values, hardware_id)
    message = (
        f"registered {len(result.matches)} of {len(result.frame)} rods, "
        f"residual {result.estimate.residual_rms_mm:.2g} mm"
    )
    if result.caution:
        return status_with(DiagnosticStatus.WARN, NAME, f"{message}; {result.caution}", values, hardware_id)
    return status_with(DiagnosticStatus.OK, NAME, message, values, hardware_id)


def status_of_unusable(
    reason: Reason,
    message: str,
    frame_name: str,
    lines: int,
    pixel_spacing: tuple[float, float],
    calibration: str,
    duration_s: float,
    hardware_id: str,
) -> DiagnosticStatus:
    """Status of an image that never came to registration: the keys of `diagnostics`, with nothing found.

    lines: rods of the frame, 0 where there is none; pixel_spacing: sx, sy in mm/pixel, 0 where not told.
    """
    nan = math.nan
    values: dict[str, str | int | float] = {
        "outcome": "refused",
        "reason": reason,
        "frame": frame_name,
        "spots": 0,
        "lines": lines,
        "inliers": 0,
        "residual_rms_mm": nan,
        "residual_rms_px": nan,
        "log10_false_alarms": nan,
        "ambiguous_poses": 0,
        "position_std_mm": nan,
        "rotation_std_deg": nan,
        "target_error_95_mm": nan,
        "pixel_spacing_x_mm": pixel_spacing[0],
        "pixel_spacing_y_mm": pixel_spacing[1],
        "calibration": calibration,
        "duration_ms": 1e3 * duration_s,
    }
    return status_with(DiagnosticStatus.ERROR, NAME, message, values, hardware_id)


def status_with(
    level: bytes, name: str, message: str, values: Mapping[str, str | int | float], hardware_id: str
) -> DiagnosticStatus:
    """A status; numbers as plain text, those that do not exist as `nan`."""
    return DiagnosticStatus(
        level=level,
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
    )


def _text(value: str | int | float) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)
