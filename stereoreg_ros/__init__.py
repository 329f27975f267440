"""Where a stereotactic frame is in the CT scanner, from a single slice (after Maurin et al. 2009)."""

from stereoreg_ros.geometry.frame import Frame
from stereoreg_ros.geometry.frame_file import FrameFileError, load_frame
from stereoreg_ros.geometry.pose import Pose
from stereoreg_ros.geometry.slice import PixelScale, Slice
from stereoreg_ros.options import RegistrationOptions
from stereoreg_ros.registration import register_frames, register_slice, register_spots
from stereoreg_ros.result import Match, PoseEstimate, Refusal, Registration

__all__ = [
    "Frame",
    "FrameFileError",
    "Match",
    "PixelScale",
    "Pose",
    "PoseEstimate",
    "Refusal",
    "Registration",
    "RegistrationOptions",
    "Slice",
    "load_frame",
    "register_frames",
    "register_slice",
    "register_spots",
]
