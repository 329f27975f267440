"""What `/diagnostics` says of one slice; the node puts its name before those of the statuses."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from stereoreg_ros.nodes.common.diagnostic_status import NAME, status_with
from stereoreg_ros.nodes.register.scale_keeper import ScaleInUse
from stereoreg_ros.nodes.register.slice_registration import Unusable
from stereoreg_ros.result import NOTHING_FOUND, Refusal, Registration, diagnostics


def status_of(
    result: Registration | Refusal, calibration: str, duration_s: float, hardware_id: str
) -> DiagnosticStatus:
    """Status of a slice that was registered: OK, WARN where the pose has a caution, ERROR where it was refused."""
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
    unusable: Unusable, frame_name: str, rods: int, scale: ScaleInUse | None, hardware_id: str
) -> DiagnosticStatus:
    """Status of a slice that could not be registered; rods: of the frame, 0 where no frame could be loaded."""
    values = NOTHING_FOUND | {
        "reason": unusable.reason,
        "frame": frame_name,
        "lines": rods,
        "pixel_spacing_x_mm": scale.scale.sx if scale else 0.0,
        "pixel_spacing_y_mm": scale.scale.sy if scale else 0.0,
        "calibration": scale.source if scale else "configured",
        "duration_ms": 1e3 * unusable.duration_s,
    }
    return status_with(DiagnosticStatus.ERROR, NAME, unusable.message, values, hardware_id)
