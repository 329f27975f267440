"""The target to be reached: from the scanner's axes into the frame's, with its error, or a refusal with its reason."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped
from std_msgs.msg import Header

from stereoreg_ros.geometry.pose import Array
from stereoreg_ros.nodes.common import conversions
from stereoreg_ros.nodes.common.conversions import MessageError
from stereoreg_ros.nodes.common.diagnostic_status import status_with
from stereoreg_ros.nodes.register.parameters import NodeSettings
from stereoreg_ros.result import Registration
from stereoreg_ros.uncertainty import error_ball_95, point_covariance

NAME: Final = "target"


@dataclass(frozen=True, eq=False)
class KeptTarget:
    """A target as it was sent, and when it came, seconds of the steady clock."""

    message: PointStamped
    received_s: float


@dataclass(frozen=True, eq=False)
class Accepted:
    """The latest pose of a frame: its header, the registration, and when its slice came, seconds of a steady clock."""

    header: Header
    registration: Registration
    received_s: float


@dataclass(frozen=True, eq=False)
class TargetInFrame:
    """A target in the frame's axes. point_mm: (3,); error_95_mm: radius of the ball that holds 95 % of its errors;
    header: of the pose it rests on; pose_age_s. True as a condition."""

    point_mm: Array
    error_95_mm: float
    header: Header
    pose_age_s: float

    def __bool__(self) -> Literal[True]:
        return True


@dataclass(frozen=True)
class TargetRefusal:
    """No target that can be steered to: reason, a sentence, the pose's age in s. False as a condition."""

    reason: Literal["bad_target", "no_pose", "pose_too_old", "target_too_old", "other_frame_of_reference", "inaccurate"]
    message: str
    pose_age_s: float = math.nan

    def __bool__(self) -> Literal[False]:
        return False


def target_in_frame(
    target: KeptTarget, latest: Accepted | None, now_s: float, settings: NodeSettings
) -> TargetInFrame | TargetRefusal:
    """Where the target, in scanner axes, is in the frame, by the frame's latest pose; now_s: of the steady clock."""
    if latest is None:
        return TargetRefusal(
            "no_pose",
            "there is no pose to rest on: the last slice was refused, or none has come since the start or since the "
            "frame or the pixel spacing was changed",
        )
    age_s = now_s - latest.received_s
    header, registration = latest.header, latest.registration
    try:
        in_scanner = conversions.point_from_message(target.message)
        if target.message.header.frame_id != header.frame_id:
            raise MessageError(
                f"its frame_id is '{target.message.header.frame_id}', expected that of the pose, '{header.frame_id}'"
            )
    except MessageError as error:
        return TargetRefusal("bad_target", f"target ignored: {error}", age_s)
    if age_s > settings.max_pose_age:
        return TargetRefusal(
            "pose_too_old", f"the pose is {age_s:.1f} s old, at most {settings.max_pose_age:g} s are allowed", age_s
        )
    target_age_s = now_s - target.received_s
    if target_age_s > settings.max_target_age:
        return TargetRefusal(
            "target_too_old",
            f"the target is {target_age_s:.1f} s old, at most {settings.max_target_age:g} s are allowed: send it again",
            age_s,
        )
    point_mm = registration.scanner_from_frame.inverse() @ in_scanner
    error_mm = error_ball_95(point_covariance(registration.covariance, registration.scanner_from_frame, point_mm))
    most_mm = settings.options.max_target_error_mm
    if error_mm > most_mm:
        return TargetRefusal(
            "inaccurate",
            f"the target's 95 % error is {error_mm:.2f} mm, at most {most_mm:g} mm are allowed",
            age_s,
        )
    return TargetInFrame(point_mm, error_mm, header, age_s)


def status_of_target(outcome: TargetInFrame | TargetRefusal, frame_name: str, hardware_id: str) -> DiagnosticStatus:
    """What `/diagnostics` says of a target."""
    nan = math.nan
    x, y, z = outcome.point_mm if outcome else (nan, nan, nan)
    values: dict[str, str | int | float] = {
        "outcome": "accepted" if outcome else "refused",
        "reason": "" if outcome else outcome.reason,
        "frame": frame_name,
        "target_x_mm": float(x),
        "target_y_mm": float(y),
        "target_z_mm": float(z),
        "target_error_95_mm": outcome.error_95_mm if outcome else nan,
        "pose_age_s": outcome.pose_age_s,
    }
    if outcome:
        message = f"target at ({x:.1f}, {y:.1f}, {z:.1f}) mm in the frame, to {outcome.error_95_mm:.2f} mm (95 %)"
        return status_with(DiagnosticStatus.OK, NAME, message, values, hardware_id)
    return status_with(DiagnosticStatus.ERROR, NAME, outcome.message, values, hardware_id)
